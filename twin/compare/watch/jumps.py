"""Where the model jumps on the way of the sweep, and whether the specimen does.

The model alone is driven slowly up and down; where its two directions part (`curves`) lie its
jumps. Measured, a jump has come where eta_d changes in the
same sense by at least half of the model's change (as logarithms).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from table_io.block import Float1D
from table_io.profile import Profile
from table_io.records import Ahead, Event, Point, Quantities, Record, Step
from twin.compare.curves import Jump, branches, sudden
from twin.model.ideal import swept
from twin.model.model import Model

LEAST = 0.15  # of log eta_d: smaller changes of the model are no jumps that a person would see
PART = 0.5  # of the model's change: so much of it, and it is the same jump
FINE_HZ, HOLD, LAST = 0.02, 20, 5  # of the slow drive: step, cycles at each, cycles that count
NEAR = 3  # steps about a jump in which the model's own course is no guide


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
    """What the model does up and down the sweep's range, driven slowly.

    In steps of at most `FINE_HZ`; in those of the test where effects make every cycle dear.
    """
    grid = np.array(profile.sweep.frequencies_hz)
    closed = all(one.effect.acts in ("parameters", "sensor") for one in model.present)
    parts = max(1, math.ceil(profile.sweep.step_hz / FINE_HZ)) if closed else 1
    up = np.interp(np.arange((grid.size - 1) * parts + 1) / parts, np.arange(grid.size), grid)
    way = np.concatenate([up, up[::-1]])
    level = max(step.acceleration_m_s2 for step in steps)
    motion = swept(model, way, level, HOLD if closed else profile.sweep.cycles)
    reach = 0.5 * (motion.column("u_max") - motion.column("u_min"))[:, -LAST:]
    ways = ["forward"] * up.size + ["backward"] * up.size
    points = [_point(*one) for one in zip(ways, way.tolist(), reach, strict=True)]
    found = [
        one for jump in branches(points, "measured")[0]
        if (one := _between_steps(jump, points, steps)) is not None
    ]  # fmt: skip
    sizes = {(one.direction, one.frequency_hz): one.measured for one in points}
    known = {step.index: sizes.get((step.direction, step.frequency_hz)) for step in steps}
    return Foreseen(
        tuple(sorted(found, key=lambda one: one.after.index)),
        {index: math.log(own.eta_d) for index, own in known.items() if own is not None},
    )


def _point(direction: str, frequency_hz: float, reach: Float1D) -> Point:
    """A point of the model: half of its u from peak to peak over the last cycles, as eta_d."""
    nothing, mean = float("nan"), float(reach.mean())
    own = Quantities(
        mean, nothing, nothing, nothing, nothing, nothing, (), (), nothing,
        float(np.ptp(reach)) / mean,
    )  # fmt: skip
    return Point(0, 0, direction, frequency_hz, own, None, nothing, nothing, nothing)


def _between_steps(jump: Jump, points: Sequence[Point], steps: tuple[Step, ...]) -> Expected | None:
    """The jump between the two steps of the test where it lies; None where there are none."""
    at_hz = 0.5 * (jump.from_hz + jump.to_hz)
    sense = 1.0 if jump.to_hz > jump.from_hz else -1.0
    for before, after in pairwise(steps):
        here = before.direction == after.direction == jump.direction
        if here and sense * before.frequency_hz < sense * at_hz <= sense * after.frequency_hz:
            ends = {
                one.frequency_hz: one.measured.eta_d
                for one in points
                if one.direction == jump.direction and one.measured is not None
            }
            change = math.log(ends[jump.to_hz] / ends[jump.from_hz])
            return Expected(before, after, change, at_hz) if abs(change) > LEAST else None
    return None


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
