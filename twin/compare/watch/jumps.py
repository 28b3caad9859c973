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
MOST = 4000  # cycles of a model with effects: one takes 0.3 ms
LEAVING = 3  # points on which a motion leaves its branch
PATIENCE = 1  # steps that a jump may be late before it is missed
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

    In steps of at most `FINE_HZ`; where effects make every cycle dear, in those of the test or
    coarser ones, so that no more than `MOST` cycles are computed.
    """
    grid = np.array(profile.sweep.frequencies_hz)
    if all(one.effect.acts in ("parameters", "sensor") for one in model.present):
        parts, hold = max(1, math.ceil(profile.sweep.step_hz / FINE_HZ)), HOLD
        up = np.interp(np.arange((grid.size - 1) * parts + 1) / parts, np.arange(grid.size), grid)
    else:
        hold = min(profile.sweep.cycles, HOLD // 2)
        up = grid[:: math.ceil(2 * grid.size * hold / MOST)]
    way = np.concatenate([up, up[::-1]])
    level = max(step.acceleration_m_s2 for step in steps)
    motion = swept(model, way, level, hold)
    reach = 0.5 * (motion.column("u_max") - motion.column("u_min"))[:, -LAST:]
    ways = ["forward"] * up.size + ["backward"] * up.size
    points = [_point(*one) for one in zip(ways, way.tolist(), reach, strict=True)]
    found = [
        one for jump in branches(points, "measured")[0]
        if (one := _between_steps(jump, points, steps)) is not None
    ]  # fmt: skip
    sizes = {(one.direction, one.frequency_hz): _size(one) for one in points}
    known = {step.index: sizes.get((step.direction, step.frequency_hz), 0.0) for step in steps}
    return Foreseen(
        tuple(sorted(found, key=lambda one: one.after.index)),
        {index: math.log(size) for index, size in known.items() if size > 0},
    )


def _point(direction: str, frequency_hz: float, reach: Float1D) -> Point:
    """A point of the model: half of its u from peak to peak over the last cycles, as eta_d."""
    nothing, mean = float("nan"), float(reach.mean())
    spread = float(np.ptp(reach)) / mean if mean > 0 else 0.0  # a mass that sticks moves nowhere
    own = Quantities(mean, nothing, nothing, nothing, nothing, nothing, (), (), nothing, spread)
    return Point(0, 0, direction, frequency_hz, own, None, nothing, nothing, nothing)


def _size(point: Point) -> float:
    return point.measured.eta_d if point.measured is not None else 0.0


def _between_steps(jump: Jump, points: Sequence[Point], steps: tuple[Step, ...]) -> Expected | None:
    """The jump between the two steps of the test where it lies; None where there are none.

    Its change is that from the last point before it to the farthest of the next few: with few
    cycles at each a motion takes more than one to leave its branch.
    """
    at_hz = 0.5 * (jump.from_hz + jump.to_hz)
    way = [one for one in points if one.direction == jump.direction]
    place = next(i for i, one in enumerate(way) if one.frequency_hz == jump.from_hz)
    size, after = _size(way[place]), [_size(one) for one in way[place + 1 : place + 1 + LEAVING]]
    if size <= 0 or min(after) <= 0:
        return None
    change = math.log((max(after) if jump.kind == "up" else min(after)) / size)
    sense = 1.0 if jump.to_hz > jump.from_hz else -1.0
    for one, other in pairwise(steps):
        here = one.direction == other.direction == jump.direction
        if here and sense * one.frequency_hz < sense * at_hz <= sense * other.frequency_hz:
            return Expected(one, other, change, at_hz) if abs(change) > LEAST else None
    return None


def begin(known: Foreseen) -> Passing:
    """Before the first step."""
    return Passing(known.reach, known.jumps)


def passed(passing: Passing, point: Point) -> tuple[Passing, list[Record]]:
    """After a planned step: what came, what did not, and what is ahead."""
    last = passing.last
    passing = replace(passing, last=point)
    items: list[Record] = []
    if last is not None and last.direction == point.direction and _size(last) > 0 < _size(point):
        change = math.log(_size(point) / _size(last))
        passing, said = _matched(passing, last, point, change)
        items = [Event(point.index, kind, text) for kind, text in said]
    late = tuple(one for one in passing.ahead if one.after.index + PATIENCE <= point.step)
    passing = replace(passing, ahead=tuple(one for one in passing.ahead if one not in late))
    return passing, [*items, ahead(passing, point)]


def _smooth(passing: Passing, last: Point, point: Point, change: float) -> bool:
    """True where the model's own branch changes as much: the flank of a resonance is no jump."""
    if not {last.step, point.step} <= passing.reach.keys():
        return False
    jumps = (*passing.ahead, *passing.overdue)
    near = any(abs(one.after.index - point.step) <= NEAR for one in jumps)
    own = passing.reach[point.step] - passing.reach[last.step]
    return not near and abs(change - own) < PART * abs(change)


def _matched(
    passing: Passing, last: Point, point: Point, change: float
) -> tuple[Passing, list[tuple[str, str]]]:
    """(without what has come, (kind, text) of what to say) after a change of log eta_d."""
    said: list[tuple[str, str]] = []
    waiting = [one for one in passing.ahead if one.after.direction == point.direction]
    overdue = [one for one in passing.overdue if one.after.direction == point.direction]
    due = [one for one in waiting if one.after.index <= point.step]
    leap = sudden(last, point)
    came = [one for one in due if _same(one, change) or (leap and change * one.change > 0)]
    for one in came:
        where = "where the model expects it"
        if one.after.index <= last.step:
            where = f"one step after where the model expects it ({one.at_hz:.3f} Hz)"
        said.append(("jump", f"{_here(one)} came {where}"))
    for one in due:
        if one not in came and one.after.index + PATIENCE <= point.step:
            said.append(("no jump", f"{_here(one)}, as the model has it, did not come"))
            overdue.append(one)
    hint = None if came or _smooth(passing, last, point, change) else leap
    # What jumps while it is measured does so in part only, and goes on at the next step.
    if hint is not None and point.step != passing.came + 1:
        early = [one for one in waiting if one not in due]
        found = next((one for one in (*overdue, *early) if _same(one, change)), None)
        said.append(("unexpected jump", f"{hint}; {_apart(found, point)}"))
        came = [] if found is None else [found]
    if came or hint is not None:
        passing = replace(passing, came=point.step)
    left = tuple(one for one in passing.ahead if one not in came)
    return replace(
        passing, ahead=left, overdue=tuple(one for one in overdue if one not in came)
    ), said


def _same(one: Expected, change: float) -> bool:
    return change * one.change > 0 and abs(change) >= PART * abs(one.change)


def _apart(one: Expected | None, point: Point) -> str:
    """How far from a jump of the model it came."""
    if one is None:
        return "the model expects none here"
    steps = point.step - one.after.index
    when = "later" if steps > 0 else "earlier"
    many = f"{abs(steps)} steps" if abs(steps) > 1 else "one step"
    return f"{many} {when} than the model ({one.at_hz:.3f} Hz)"


def _here(one: Expected) -> str:
    return (
        f"{one.after.direction}: the jump {one.kind} between {one.before.frequency_hz:g} and "
        f"{one.after.frequency_hz:g} Hz"
    )


def ahead(passing: Passing, point: Point) -> Ahead:
    """The next jump on the way, as seen from a step."""
    nothing = float("nan")
    here = (point.index, point.step, point.direction, point.frequency_hz)
    one = next((one for one in passing.ahead if one.after.index > point.step), None)
    if one is None:
        return Ahead(*here, "", nothing, nothing, nothing)
    ends = sorted((one.before.frequency_hz, one.after.frequency_hz))
    return Ahead(*here, one.kind, one.at_hz, *ends)
