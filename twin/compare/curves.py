"""Hysteresis intervals and jumps of a run, from its PRC points.

Two steady motions are different solutions if their eta_d or their eta_a differ by more than a tenth
of the larger one plus their scatter, the sum of both ranges over the measured cycles. With n = 3
cycles of independent noise the sum of the ranges is 4 standard deviations of the difference of the
means, so noise stays below the scatter alone. A difference above the scatter that is smaller than a
tenth counts if it is at least `MIN_COUNTED_DIFFERENCE` and no cycle of the one motion has as many
impacts on a side as any cycle of the other: a grazing contact changes the count, but neither eta.

The directions differ at a grid frequency if they show different solutions there. Neighbouring
frequencies of this kind are a right hysteresis (hardening) if the forward branch is larger, a left
one (softening) if it is smaller, provided that a direction changes its solution at an end of
them: this change is a jump. A single grid frequency has no extent and is no interval; its jumps
count if both directions jump.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import NamedTuple

import numpy as np

from table_io.records import NormalizedResponse, PrcPoint

MIN_BRANCH_DIFFERENCE = 0.10  # of the larger eta: beyond it the solutions differ
MIN_COUNTED_DIFFERENCE = 0.03  # the same, if the impact counts differ in every cycle
MAX_REMAINING_DIFFERENCE = 0.5  # of the difference before a jump; a larger rest fades, no jump
MIN_JUMP_RATIO = 1.6  # ratio of eta_d between neighbors that no smooth branch reaches


@dataclass(frozen=True, slots=True)
class PrcJump:
    """A jump of one direction between two neighbouring grid frequencies, in driving order."""

    direction: str
    from_hz: float
    to_hz: float
    kind: str  # "up" or "down": change of eta_d, or of eta_a if it changes more


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
    def difference(self) -> float:
        """Relative difference, > 0 if the forward branch is larger; 0 for the same solution."""
        return _compare_solutions(self.forward, self.backward).value


class _Difference(NamedTuple):
    """Relative difference of two solutions, > 0 if the first is larger, and what exceeds scatter.

    Both are relative to the larger one, and 0 for the same solution.
    """

    value: float
    excess: float


def _compare_solutions(
    first: NormalizedResponse,
    second: NormalizedResponse,
    limit: float | None = None,
    scatter_factor: float = 1.0,
) -> _Difference:
    """Return by how much the first solution is larger; 0 if they are the same.

    Of eta_d and eta_a the one that differs more beyond its scatter decides. A quantity of a lost
    sensor, or without a known scatter, is left out. `limit`: as in the head of this file.
    """
    if limit is None:
        has_other_counts = _have_other_counts(first, second)
        limit = MIN_COUNTED_DIFFERENCE if has_other_counts else MIN_BRANCH_DIFFERENCE
    largest = _Difference(0.0, 0.0)
    for eta, spread in (("eta_d", "spread"), ("eta_a", "spread_a")):
        a, b = getattr(first, eta), getattr(second, eta)
        spread_a, spread_b = getattr(first, spread), getattr(second, spread)
        larger = max(a, b)
        if spread_a is None or spread_b is None or not larger > 0:
            continue
        difference = (a - b) / larger
        excess = abs(difference) - limit - scatter_factor * (a * spread_a + b * spread_b) / larger
        if excess > abs(largest.excess):
            largest = _Difference(difference, math.copysign(excess, difference))
    return largest


def _have_other_counts(first: NormalizedResponse, second: NormalizedResponse) -> bool:
    """Return whether the impact counts of a side differ between all cycles of both motions."""
    return any(
        bool(a and b) and (max(a) < min(b) or max(b) < min(a))
        for a, b in (
            (first.impacts_right, second.impacts_right),
            (first.impacts_left, second.impacts_left),
        )
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
    differences = [pair.difference for pair in pairs]
    jumps: list[PrcJump] = []
    intervals: list[Hysteresis] = []
    for sign, group in groupby(range(len(pairs)), key=lambda index: np.sign(differences[index])):
        indices = list(group)
        first, last = indices[0], indices[-1]
        if sign == 0:
            continue
        ends = _interval_jumps(pairs, first, last)
        if not ends or (first == last and len(ends) < 2):
            continue
        jumps.extend(ends)
        if first < last:
            kind = "right" if sign > 0 else "left"
            intervals.append(Hysteresis(kind, pairs[first].frequency_hz, pairs[last].frequency_hz))
    return jumps, intervals


def _interval_jumps(pairs: list[_DirectionPair], first: int, last: int) -> list[PrcJump]:
    """Return the jumps at the ends of an interval; none if neither direction changes solution.

    Without a jump at either end the difference is scatter of an irregular motion, or a slow change
    of the specimen, not hysteresis.
    """
    ends = (
        ("forward", last, last + 1),  # the forward sweep leaves its branch at the upper end
        ("backward", first, first - 1),  # the backward sweep at the lower one
    )
    jumps = []
    for direction, before, after in ends:
        if not 0 <= after < len(pairs):
            continue
        inside, outside = pairs[before], pairs[after]
        # The scatter of a point in which the motion is jumping would hide the jump.
        change = _compare_solutions(
            getattr(outside, direction), getattr(inside, direction), scatter_factor=0.0
        ).value
        sign = 1 if direction == "backward" else -1
        # What the scatter explains does not remain: a motion that is jumping scatters most.
        remaining = _compare_solutions(outside.forward, outside.backward, limit=0.0).excess
        closes = remaining / inside.difference <= MAX_REMAINING_DIFFERENCE
        if change * inside.difference * sign > 0 and closes:
            kind = "up" if change > 0 else "down"
            jumps.append(PrcJump(direction, inside.frequency_hz, outside.frequency_hz, kind))
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
