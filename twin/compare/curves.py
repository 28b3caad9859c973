"""PRC points of a run -> hysteresis intervals and jumps.

The two directions differ at a grid frequency if their eta_d do so by more than a tenth of the
larger and by more than what drift and scatter over the measured cycles leave open. An interval of
them is a right hysteresis (hardening) where the forward branch is the larger, a left one
(softening) where it is the smaller. Each end of an interval is a jump of one direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from table_io.records import Point, Quantities

DIFFERENCE = 0.10  # of the larger eta_d: what counts as another solution
SUDDEN = 1.6  # ratio of eta_d between neighbours that a smooth branch does not reach


@dataclass(frozen=True, slots=True)
class Jump:
    """A jump of one direction between two neighbouring grid frequencies, in driving order."""

    direction: str
    from_hz: float
    to_hz: float
    kind: str  # "up" or "down": what eta_d does


@dataclass(frozen=True, slots=True)
class Hysteresis:
    """First and last grid frequency at which the directions differ."""

    kind: str  # "right" or "left"
    from_hz: float
    to_hz: float


@dataclass(frozen=True, slots=True)
class _Pair:
    frequency_hz: float
    forward: Quantities
    backward: Quantities

    @property
    def sign(self) -> int:
        """+1 forward branch larger, -1 smaller, 0 the same solution within its scatter."""
        f, b = self.forward, self.backward
        larger = max(f.eta_d, b.eta_d)
        scatter = f.eta_d * f.spread + b.eta_d * b.spread
        difference = f.eta_d - b.eta_d
        return int(np.sign(difference)) if abs(difference) > DIFFERENCE * larger + scatter else 0


def _pairs(points: Sequence[Point], source: str) -> list[_Pair]:
    """Both directions of every grid frequency that has both, by frequency."""
    found: dict[str, dict[float, Quantities]] = {"forward": {}, "backward": {}}
    for point in points:
        values = getattr(point, source)
        if values is not None:
            found[point.direction][point.frequency_hz] = values
    common = sorted(found["forward"].keys() & found["backward"].keys())
    return [_Pair(f, found["forward"][f], found["backward"][f]) for f in common]


def branches(points: Sequence[Point], source: str) -> tuple[list[Jump], list[Hysteresis]]:
    """Jumps and hysteresis intervals of the "measured" or "twin" points."""
    pairs = _pairs(points, source)
    jumps: list[Jump] = []
    intervals: list[Hysteresis] = []
    for sign, group in groupby(range(len(pairs)), key=lambda place: pairs[place].sign):
        places = list(group)
        first, last = places[0], places[-1]
        if sign == 0:
            continue
        ends = _ends(pairs, first, last, sign)
        if not ends:
            continue
        kind = "right" if sign > 0 else "left"
        intervals.append(Hysteresis(kind, pairs[first].frequency_hz, pairs[last].frequency_hz))
        jumps.extend(ends)
    return jumps, intervals


def _ends(pairs: list[_Pair], first: int, last: int, sign: int) -> list[Jump]:
    """The jumps at the ends of an interval; none where neither direction changes branch there.

    Without a jump at either end the difference is scatter of an irregular motion, not hysteresis.
    """
    jumps = []
    if last + 1 < len(pairs):  # the forward sweep leaves its branch at the upper end
        a, b = pairs[last].forward.eta_d, pairs[last + 1].forward.eta_d
        if (a - b) * sign > DIFFERENCE * max(a, b):
            kind = "down" if sign > 0 else "up"
            jumps.append(
                Jump("forward", pairs[last].frequency_hz, pairs[last + 1].frequency_hz, kind)
            )
    if first > 0:  # the backward sweep leaves its branch at the lower end
        a, b = pairs[first].backward.eta_d, pairs[first - 1].backward.eta_d
        if (b - a) * sign > DIFFERENCE * max(a, b):
            kind = "up" if sign > 0 else "down"
            jumps.append(
                Jump("backward", pairs[first].frequency_hz, pairs[first - 1].frequency_hz, kind)
            )
    return jumps


def sudden(before: Point | None, after: Point) -> str | None:
    """A sentence where measured eta_d leaps between neighbours of one direction, else None.

    Only a hint while the test runs: what is a jump is decided by `branches` with both directions.
    """
    if before is None or before.measured is None or after.measured is None:
        return None
    if before.direction != after.direction:
        return None
    a, b = before.measured.eta_d, after.measured.eta_d
    if max(a, b) < SUDDEN * min(a, b) or min(a, b) <= 0:
        return None
    verb = "rises" if b > a else "falls"
    return (
        f"{after.direction}: eta_d {verb} from {a:.3f} to {b:.3f} between "
        f"{before.frequency_hz:g} and {after.frequency_hz:g} Hz"
    )
