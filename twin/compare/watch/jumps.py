"""Where the model jumps on the way of the sweep, and whether the specimen does.

The model alone is driven through the same steps; where its two directions part (`curves`) lie its
jumps, each between two neighbouring steps. Measured, a jump has come where eta_d changes in the
same sense by at least half of the model's change (as logarithms).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from table_io.block import Float1D
from table_io.profile import Profile
from table_io.records import Ahead, Event, Point, Quantities, Record, Step
from twin.compare.curves import branches, sudden
from twin.model.ideal import swept
from twin.model.model import Model
from twin.model.sweep import SteppedSine, stepped_sine

PART = 0.5  # of the model's change: so much of it, and it is the same jump
FINE, HOLD = 20, 30  # frequencies between two steps, and cycles at each, where it is driven slowly
NEAR = 3  # steps about a jump in which the model's own course is no guide
EARLIER, LATER = 3, 1  # steps from before the jump to behind it that are driven so


@dataclass(frozen=True, slots=True)
class Expected:
    """A jump of the model between steps `before` and `after`; `change` of log eta_d, `at_hz` it."""

    before: Step
    after: Step
    change: float
    at_hz: float

    @property
    def kind(self) -> str:
        return "up" if self.change > 0 else "down"


@dataclass(frozen=True, slots=True)
class Foreseen:
    """The jumps of the model in driving order, and the logarithm of its amplitude by step."""

    jumps: tuple[Expected, ...] = ()
    reach: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Passing:
    """Jumps that are still to come, and those that are overdue; the last point of the sweep."""

    reach: Mapping[int, float] = field(default_factory=dict)
    ahead: tuple[Expected, ...] = ()
    overdue: tuple[Expected, ...] = ()
    last: Point | None = None
    came: int = -2  # the step at which one came last


def foreseen(profile: Profile, model: Model, steps: tuple[Step, ...]) -> Foreseen:
    """What the model does on the ideal sweep."""
    frequencies = np.array([step.frequency_hz for step in steps])
    level = max(step.acceleration_m_s2 for step in steps)
    motion = swept(model, frequencies, level, profile.sweep.cycles)
    used = slice(-profile.sweep.measured_cycles, None)
    reach = 0.5 * (motion.column("u_max") - motion.column("u_min"))[:, used]
    points = [_point(step, one) for step, one in zip(steps, reach, strict=True)]
    found = [
        (after, _expected(model, motion, steps, before, after, level))
        for jump in branches(points, "measured")[0]
        for before, after in pairwise(range(len(steps)))
        if (steps[before].direction, steps[after].direction) == (jump.direction, jump.direction)
        and (steps[before].frequency_hz, steps[after].frequency_hz) == (jump.from_hz, jump.to_hz)
    ]
    jumps = tuple(one for _, one in sorted(found, key=lambda one: one[0]))
    logs = np.log(reach.mean(axis=1)).tolist()
    return Foreseen(jumps, {step.index: one for step, one in zip(steps, logs, strict=True)})


def _point(step: Step, reach: Float1D) -> Point:
    """A point of the model: half of its u from peak to peak over the measured cycles, as eta_d."""
    nothing, mean = float("nan"), float(reach.mean())
    own = Quantities(
        mean, nothing, nothing, nothing, nothing, nothing, (), (), nothing,
        float(np.ptp(reach)) / mean,
    )  # fmt: skip
    return Point(
        0, step.index, step.direction, step.frequency_hz, own, None, nothing, nothing, nothing
    )


def _expected(
    model: Model,
    motion: SteppedSine,
    steps: tuple[Step, ...],
    before: int,
    after: int,
    level: float,
) -> Expected:
    """The jump near two neighbouring steps, as the model leaves its branch when driven slowly.

    Where it cannot be carried on from a state: in the middle between them.
    """
    one, other = steps[before].frequency_hz, steps[after].frequency_hz
    reach = motion.column("u_max")[:, -1] - motion.column("u_min")[:, -1]
    change = float(np.log(reach[after] / reach[before]))
    if not all(one.effect.acts in ("parameters", "sensor") for one in model.present):
        return Expected(steps[before], steps[after], change, 0.5 * (one + other))
    same = [i for i, step in enumerate(steps) if step.direction == steps[after].direction]
    first = max(before - EARLIER, same[0])
    last = min(after + LATER, same[-1])
    way = np.linspace(
        steps[first].frequency_hz, steps[last].frequency_hz, FINE * (last - first) + 1
    )
    slow = stepped_sine(model.parameters, way, level, HOLD, state=motion.states[first])
    size = np.log((slow.column("u_max") - slow.column("u_min"))[:, -1])
    place = int(np.argmax(np.diff(size) * np.sign(change)))
    at_hz = float(0.5 * (way[place] + way[place + 1]))
    passed = [i for i in range(first, last) if (steps[i].frequency_hz - at_hz) * (other - one) < 0]
    before = passed[-1] if passed else first
    change = float(size[place + 1] - size[place])
    return Expected(steps[before], steps[before + 1], change, at_hz)


def begin(known: Foreseen) -> Passing:
    """Before the first step."""
    return Passing(known.reach, known.jumps)


def passed(passing: Passing, point: Point) -> tuple[Passing, list[Record]]:
    """After a planned step: what came, what did not, and what is ahead."""
    last = passing.last
    passing = replace(passing, last=point)
    items: list[Record] = []
    before = last.measured if last and last.direction == point.direction else None
    if before is not None and point.measured is not None:
        change = math.log(max(point.measured.eta_d, 1e-12) / max(before.eta_d, 1e-12))
        hint = None if _smooth(passing, last, point, change) else sudden(last, point)
        passing, said = _matched(passing, point, change, hint)
        items += [Event(point.index, kind, text) for kind, text in said]
    gone = tuple(one for one in passing.ahead if one.after.index <= point.step)
    passing = replace(passing, ahead=tuple(one for one in passing.ahead if one not in gone))
    return passing, [*items, ahead(passing, point)]


def _smooth(passing: Passing, last: Point | None, point: Point, change: float) -> bool:
    """True where the model's own branch changes as much: the flank of a resonance is no jump."""
    if last is None or not {last.step, point.step} <= passing.reach.keys():
        return False
    jumps = (*passing.ahead, *passing.overdue)
    near = any(abs(one.after.index - point.step) <= NEAR for one in jumps)
    own = passing.reach[point.step] - passing.reach[last.step]
    return not near and abs(change - own) < PART * abs(change)


def _matched(
    passing: Passing, point: Point, change: float, hint: str | None
) -> tuple[Passing, list[tuple[str, str]]]:
    """(without what has come, (kind, text) of what to say)."""
    due = [one for one in passing.ahead if one.after.index == point.step]
    said: list[tuple[str, str]] = []
    overdue = list(passing.overdue)
    for one in due:
        if change * one.change > 0 and abs(change) >= PART * abs(one.change):
            said.append(("jump", f"{_here(one)} came where the model expects it"))
            passing, hint = replace(passing, came=point.step), None
        else:
            said.append(("no jump", f"{_here(one)}, as the model has it, did not come"))
            overdue.append(one)
    # What jumps while it is measured does so in part only, and goes on at the next step.
    if hint is not None and point.step != passing.came + 1:
        passing = replace(passing, came=point.step)
        for one in (*overdue, *passing.ahead):
            same_way = one.after.direction == point.direction and one not in due
            if same_way and change * one.change > 0 and abs(change) >= PART * abs(one.change):
                steps = point.step - one.after.index
                when = "later" if steps > 0 else "earlier"
                text = f"{hint}; {abs(steps)} steps {when} than the model ({one.at_hz:.3f} Hz)"
                said.append(("jump", text))
                overdue = [other for other in overdue if other != one]
                passing = replace(passing, ahead=tuple(a for a in passing.ahead if a != one))
                break
        else:
            said.append(("jump", f"{hint}; the model expects none here"))
    return replace(passing, overdue=tuple(overdue)), said


def _here(one: Expected) -> str:
    return (
        f"{one.after.direction}: the jump {one.kind} between {one.before.frequency_hz:g} and "
        f"{one.after.frequency_hz:g} Hz"
    )


def ahead(passing: Passing, point: Point) -> Ahead:
    """The next jump on the way, as seen from a step."""
    nothing = float("nan")
    here = (point.index, point.step, point.direction, point.frequency_hz)
    if not passing.ahead:
        return Ahead(*here, "", nothing, nothing, nothing)
    one = passing.ahead[0]
    ends = sorted((one.before.frequency_hz, one.after.frequency_hz))
    return Ahead(*here, one.kind, one.at_hz, *ends)
