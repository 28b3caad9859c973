"""Refine: narrow the jumps that a sweep found, in the sweep's own direction.

After a jump the motion is on the other branch. So the table goes back to where the branches meet,
comes up again in steps of the sweep, holds the last good frequency, and goes on from there in
smaller steps. A step that jumps costs the whole way back: steps are chosen so that the worst case
needs the fewest visits, which is a bisection only where the way back costs little.
"""

import math
from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

from table_io.policies.result import SUDDEN, Decision, Move, Result, Tool, visited
from table_io.profile import Profile
from table_io.records import Step
from table_io.tool_cards import Refine

NARROW, STEEP = 1 / 7, 3.0  # shares of an interval: there is a jump in a part with more change
MEET = 3  # visits for which a branch is waited for, at least


@dataclass(frozen=True, slots=True)
class Jump:
    """A jump beyond `good` and not beyond `bad`, in Hz; `way` leads to `good` along its branch."""

    direction: str
    way: tuple[float, ...]
    good: float
    bad: float
    before_m: float  # swing of u at good
    after_m: float  # and at bad
    middle_m: float  # between the two branches
    level_g: float  # at good
    proven: bool = False  # good was held for as long as the card wants

    @property
    def kind(self) -> str:
        return "down" if self.after_m < self.before_m else "up"

    def left(self, result: Result) -> bool:
        """True where a motion is no longer on the branch."""
        return (result.swing_m < self.middle_m) == (self.after_m < self.before_m)

    def follows(self, a: Result, b: Result) -> bool:
        """True where the change from a to b goes on with this jump."""
        here = (a.step.direction, a.step.frequency_hz) == (self.direction, self.bad)
        return here and (b.swing_m < a.swing_m) == (self.after_m < self.before_m)

    def parts(self, resolution_hz: float) -> int:
        """Of the interval, each no wider than the resolution."""
        return max(math.ceil(abs(self.bad - self.good) / resolution_hz - 1e-6), 1)


Search = Generator[Move, Result, tuple[Jump | None, int]]  # (None: not reached, visits spent)


def words(card: Refine, profile: Profile) -> str:
    """The plan in words."""
    cycles = profile.sweep.cycles
    back = "where its direction begins" if card.approach_hz is None else f"{card.approach_hz:g} Hz"
    return (
        f"after the sweep, each of its jumps to {card.resolution_hz:g} Hz: again from {back} on "
        f"along its branch, then in smaller steps, each held {_holds(card, profile) * cycles} "
        f"cycles; at most {_visits(card, profile) * cycles} held cycles in all"
    )


def begin(card: Refine, profile: Profile) -> Tool:
    """The tool; it says between which frequencies each jump lies."""
    seen = []
    for _ in profile.sweep.steps[profile.first_step :]:
        seen.append((yield from visited(None)))
    left, found = _visits(card, profile), []
    for jump in jumps(seen, card.approach_hz):
        last, spent = yield from _narrowed(jump, card, profile, left)
        left -= spent
        found.append(_told(jump, last, card, profile, spent))
    return "refine: " + ("; ".join(found) or "the sweep found no jump")


def _holds(card: Refine, profile: Profile) -> int:
    """Visits for which a frequency is held before it counts as passed."""
    return math.ceil((card.hold_cycles or profile.sweep.cycles) / profile.sweep.cycles)


def _visits(card: Refine, profile: Profile) -> int:
    """Visits in all."""
    return card.cycles // profile.sweep.cycles


def jumps(swept: Sequence[Result], approach_hz: float | None) -> list[Jump]:
    """The jumps of a sweep, in the order in which they were met.

    A jump that takes more than one step of the sweep is one.
    """
    found: list[Jump] = []
    for a, b in pairwise(swept):
        if b.step.direction != a.step.direction or not _sudden(a.swing_m, b.swing_m):
            continue
        last = found[-1] if found and found[-1].follows(a, b) else None
        if last is None:
            last = Jump(
                a.step.direction,
                _way(swept, a.step, approach_hz),
                a.step.frequency_hz,
                b.step.frequency_hz,
                a.swing_m,
                b.swing_m,
                math.nan,
                a.level_g,
            )
        else:
            found.pop()
        middle = math.sqrt(last.before_m * b.swing_m)
        found.append(replace(_jumped(last, b), middle_m=middle))
    return found


def _way(swept: Sequence[Result], to: Step, approach_hz: float | None) -> tuple[float, ...]:
    """Frequencies of the sweep that lead to a step, from where the approach begins."""
    same = [one.step for one in swept if one.step.direction == to.direction]
    way = [one.frequency_hz for one in same if one.index <= to.index]
    up = 1 if to.direction == "forward" else -1
    late = [f for f in way if approach_hz is None or up * f >= up * approach_hz - 1e-9]
    return tuple(late or way)


def _sudden(a: float, b: float) -> bool:
    return max(a, b) > SUDDEN * min(a, b)


def _narrowed(jump: Jump, card: Refine, profile: Profile, left: int) -> Search:
    """The jump as narrow as the resolution asks for, or as the visits left allow."""
    holds, spent, there = _holds(card, profile), 0, False
    while not jump.proven or jump.parts(card.resolution_hz) > 1:
        back, parts = len(jump.way) + 1, jump.parts(card.resolution_hz)
        if spent + holds + (0 if there else back + max(holds, MEET)) > left:
            break
        if there:
            part = cheapest(parts, holds, back)[1]
            f = round(jump.good + part * (jump.bad - jump.good) / parts, 9)
            why = f"part {part} of {parts} from {jump.good:g} to {jump.bad:g} Hz"
            result, visits = yield from _hold(jump, f, holds, why)
            there = not jump.left(result)
            jump = _passed(jump, result) if there else _jumped(jump, result)
        else:
            again, visits = yield from _again(jump, holds)
            if again is None:
                return None, spent + visits
            jump, there = again, again.proven
        spent += visits
    return jump, spent


@lru_cache(maxsize=1024)
def cheapest(parts: int, hold: int, back: int) -> tuple[int, int]:
    """(visits in the worst case, part to hold next) where a jump lies in one of `parts`.

    Holding costs `hold` visits; a jump costs `back` more, unless it ends the search.
    """
    best = [(0, 0), (0, 0)]
    for n in range(2, parts + 1):
        best.append(
            min(
                (hold + max(best[n - k][0], best[k][0] + (back if k > 1 else 0)), k)
                for k in range(1, n)
            )
        )
    return best[parts]


def _again(jump: Jump, holds: int) -> Search:
    """Back to where the way begins and along it to the last good frequency, which is held.

    Where the motion leaves the branch before, the jump lies before; None where it was never on it.
    """
    along = jump.way if jump.good == jump.way[-1] else (*jump.way, jump.good)
    why = f"back to where the {jump.direction} branch of the {jump.kind}-jump is met"
    result, spent = yield from _hold(jump, along[0], max(holds, MEET), why, until=False)
    if jump.left(result):
        return None, spent
    for place, f in enumerate(along[1:] or along):
        last = f == jump.good
        why = f"last good frequency of the {jump.kind}-jump" if last else "along the branch again"
        result, visits = yield from _hold(jump, f, holds if last and not jump.proven else 1, why)
        spent += visits
        if jump.left(result):
            if f == along[0]:
                return None, spent
            way, good = jump.way[: place + 1], along[place]
            return replace(_jumped(jump, result), way=way, good=good, proven=False), spent
    return _passed(jump, result), spent


def _hold(
    jump: Jump, f: float, most: int, why: str, until: bool = True
) -> Generator[Move, Result, tuple[Result, int]]:
    """(the last result at a frequency, visits): until the branch is left, or met (until=False)."""
    visits = 0
    while True:
        result = yield from visited(Decision(f, jump.direction, why))
        visits += 1
        if jump.left(result) == until or visits == most:
            return result, visits


def _passed(jump: Jump, result: Result) -> Jump:
    good, swing, level = result.step.frequency_hz, result.swing_m, result.level_g
    return replace(jump, good=good, before_m=swing, level_g=level, proven=True)


def _jumped(jump: Jump, result: Result) -> Jump:
    return replace(jump, bad=result.step.frequency_hz, after_m=result.swing_m)


def _told(first: Jump, jump: Jump | None, card: Refine, profile: Profile, spent: int) -> str:
    """What was found of a jump, in words."""
    cycles = profile.sweep.cycles
    name = f"{first.kind}-jump {first.direction}"
    if jump is None:
        return (
            f"{name}: its branch was not met again at {first.way[0]:g} Hz; it lies between "
            f"{first.good:g} and {first.bad:g} Hz as in the sweep; set approach_hz, or begin the "
            "sweep, where the branches meet"
        )
    if not jump.proven:
        return (
            f"{name} between {jump.good:g} and {jump.bad:g} Hz: the {card.cycles} cycles allowed "
            f"do not suffice to reach it again, {spent * cycles} were spent"
        )
    held = _holds(card, profile) * cycles
    text = (
        f"{name} between {jump.good:.4f} and {jump.bad:.4f} Hz, {1e3 * jump.before_m:.4g} to "
        f"{1e3 * jump.after_m:.4g} mm at {jump.level_g:.4f} g: the passage at {held} held cycles a "
        f"frequency; it comes late, so the fold lies there or before; {spent * cycles} cycles spent"
    )
    if _steady(first, jump):
        text += "; the swing changes as much beside it, so this is steep, but no jump"
    if jump.parts(card.resolution_hz) > 1:
        text += f"; {card.cycles} are allowed, {card.resolution_hz:g} Hz would take more"
    return text


def _steady(first: Jump, jump: Jump) -> bool:
    """True where a change was narrowed a lot, and shrank nearly as the interval did."""
    share = abs((jump.bad - jump.good) / (first.bad - first.good))
    change, whole = (math.log(one.after_m / one.before_m) for one in (jump, first))
    return share < NARROW and change / whole < STEEP * share
