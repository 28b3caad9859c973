"""Hysteresis intervals and jumps of a run, from its PRC points.

The two directions differ at a grid frequency if their eta_d differ by more than a tenth of the
larger one plus their spread (drift and scatter) over the measured cycles. An interval of such
frequencies is a right hysteresis (hardening) if the forward branch is larger, a left one
(softening) if it is smaller. Each end of an interval is a jump of one direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from table_io.records import NormalizedResponse, PrcPoint

MIN_BRANCH_DIFFERENCE = 0.10  # of the larger eta_d: beyond it the solutions differ
MIN_JUMP_RATIO = 1.6  # ratio of eta_d between neighbors that no smooth branch reaches


@dataclass(frozen=True, slots=True)
class PrcJump:
    """A jump of one direction between two neighbouring grid frequencies, in driving order."""

    direction: str
    from_hz: float
    to_hz: float
    kind: str  # "up" or "down": change of eta_d


@dataclass(frozen=True, slots=True)
class Hysteresis:
    """First and last grid frequency at which the directions differ."""

    kind: str  # "right" or "left"
    from_hz: float
    to_hz: float


@dataclass(frozen=True, slots=True)
class _DirectionPair:
    frequency_hz: float
    forward: NormalizedResponse
    backward: NormalizedResponse

    @property
    def sign(self) -> int:
        """+1 forward branch larger, -1 smaller, 0 the same solution within its scatter."""
        f, b = self.forward, self.backward
        larger = max(f.eta_d, b.eta_d)
        scatter = f.eta_d * f.spread + b.eta_d * b.spread
        difference = f.eta_d - b.eta_d
        return (
            int(np.sign(difference))
            if abs(difference) > MIN_BRANCH_DIFFERENCE * larger + scatter
            else 0
        )


def _pair_directions(points: Sequence[PrcPoint], source: str) -> list[_DirectionPair]:
    """Return both directions of every grid frequency that has both, by frequency."""
    by_direction: dict[str, dict[float, NormalizedResponse]] = {"forward": {}, "backward": {}}
    for point in points:
        values = getattr(point, source)
        if values is not None:
            by_direction[point.direction][point.frequency_hz] = values
    common = sorted(by_direction["forward"].keys() & by_direction["backward"].keys())
    return [
        _DirectionPair(f, by_direction["forward"][f], by_direction["backward"][f]) for f in common
    ]


def detect_hysteresis(
    points: Sequence[PrcPoint], source: str
) -> tuple[list[PrcJump], list[Hysteresis]]:
    """Detect jumps and hysteresis intervals of the "measured" or "twin" points."""
    pairs = _pair_directions(points, source)
    jumps: list[PrcJump] = []
    intervals: list[Hysteresis] = []
    for sign, group in groupby(range(len(pairs)), key=lambda index: pairs[index].sign):
        indices = list(group)
        first, last = indices[0], indices[-1]
        if sign == 0:
            continue
        ends = _interval_jumps(pairs, first, last, sign)
        if not ends:
            continue
        kind = "right" if sign > 0 else "left"
        intervals.append(Hysteresis(kind, pairs[first].frequency_hz, pairs[last].frequency_hz))
        jumps.extend(ends)
    return jumps, intervals


def _interval_jumps(pairs: list[_DirectionPair], first: int, last: int, sign: int) -> list[PrcJump]:
    """Return the jumps at the ends of an interval; none if neither direction changes branch.

    Without a jump at either end the difference is scatter of an irregular motion, not hysteresis.
    """
    jumps = []
    if last + 1 < len(pairs):  # the forward sweep leaves its branch at the upper end
        a, b = pairs[last].forward.eta_d, pairs[last + 1].forward.eta_d
        if (a - b) * sign > MIN_BRANCH_DIFFERENCE * max(a, b):
            kind = "down" if sign > 0 else "up"
            jumps.append(
                PrcJump("forward", pairs[last].frequency_hz, pairs[last + 1].frequency_hz, kind)
            )
    if first > 0:  # the backward sweep leaves its branch at the lower end
        a, b = pairs[first].backward.eta_d, pairs[first - 1].backward.eta_d
        if (b - a) * sign > MIN_BRANCH_DIFFERENCE * max(a, b):
            kind = "up" if sign > 0 else "down"
            jumps.append(
                PrcJump("backward", pairs[first].frequency_hz, pairs[first - 1].frequency_hz, kind)
            )
    return jumps


def describe_sudden_change(before: PrcPoint | None, after: PrcPoint) -> str | None:
    """Describe a jump of measured eta_d between neighbors of one direction; None without one.

    Only a hint during the test: `detect_hysteresis` decides on jumps, with both directions.
    """
    if before is None or before.measured is None or after.measured is None:
        return None
    if before.direction != after.direction:
        return None
    a, b = before.measured.eta_d, after.measured.eta_d
    if max(a, b) < MIN_JUMP_RATIO * min(a, b) or min(a, b) <= 0:
        return None
    verb = "rises" if b > a else "falls"
    return (
        f"{after.direction}: eta_d {verb} from {a:.3f} to {b:.3f} between "
        f"{before.frequency_hz:g} and {after.frequency_hz:g} Hz"
    )
