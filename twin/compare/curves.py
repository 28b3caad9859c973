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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from table_io.records import MIN_JUMP_RATIO, NormalizedResponse, PrcPoint

FloatND = NDArray[np.float64]
BoolND = NDArray[np.bool_]

MIN_BRANCH_DIFFERENCE = 0.10  # of the larger eta: beyond it the solutions differ
MIN_COUNTED_DIFFERENCE = 0.03  # the same, if the impact counts differ in every cycle
MAX_REMAINING_DIFFERENCE = 0.5  # of the difference before a jump; a larger rest fades, no jump


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


class Solutions(NamedTuple):
    """Motions at the frequencies of a sweep, for one model or more: arrays (..., frequency).

    Mean eta_d and eta_a, their ranges over the measured cycles relative to the means, and the
    smallest and largest count of impacts of a cycle on each side. NaN is unknown.
    """

    eta_d: FloatND
    eta_a: FloatND
    spread: FloatND
    spread_a: FloatND
    fewest_right: FloatND
    most_right: FloatND
    fewest_left: FloatND
    most_left: FloatND

    def take(self, index: Any) -> "Solutions":
        """Return the motions at an index or slice of the frequencies."""
        return Solutions(*(values[..., index] for values in self))

    @classmethod
    def from_responses(cls, responses: Sequence[NormalizedResponse]) -> "Solutions":
        """Return the motions of one direction of a sweep, (frequency,)."""
        rows = [
            (
                response.eta_d, response.eta_a, response.spread, response.spread_a,
                *(
                    limit(counts) if counts else math.nan
                    for counts in (response.impacts_right, response.impacts_left)
                    for limit in (min, max)
                ),
            )
            for response in responses
        ]  # fmt: skip
        return cls(*np.array(rows, dtype=np.float64).reshape(-1, len(cls._fields)).T)


class _Difference(NamedTuple):
    """Relative differences of two motions, > 0 if the first is larger, and what exceeds scatter.

    Both are relative to the larger motion, and 0 for the same solution.
    """

    value: FloatND
    excess: FloatND


@np.errstate(invalid="ignore", divide="ignore")
def _compare_solutions(
    first: Solutions, second: Solutions, limit: float | None = None, scatter_factor: float = 1.0
) -> _Difference:
    """Return by how much each first solution is larger; 0 if they are the same.

    Of eta_d and eta_a the one that differs more beyond its scatter decides. A quantity of a lost
    sensor, or without a known scatter, is left out. `limit`: as in the head of this file.
    """
    limits: Any = limit
    if limit is None:
        limits = np.where(
            _have_other_counts(first, second), MIN_COUNTED_DIFFERENCE, MIN_BRANCH_DIFFERENCE
        )
    value = excess = np.zeros(first.eta_d.shape)
    for a, b, spread_a, spread_b in (
        (first.eta_d, second.eta_d, first.spread, second.spread),
        (first.eta_a, second.eta_a, first.spread_a, second.spread_a),
    ):
        larger = np.maximum(a, b)
        difference = (a - b) / larger
        own = abs(difference) - limits - scatter_factor * (a * spread_a + b * spread_b) / larger
        decides = (larger > 0) & (own > abs(excess))  # False where anything is unknown
        value = np.where(decides, difference, value)
        excess = np.where(decides, np.copysign(own, difference), excess)
    return _Difference(value, excess)


def _have_other_counts(first: Solutions, second: Solutions) -> BoolND:
    """Return whether the impact counts of a side differ between all cycles of both motions."""
    a, b = first, second
    return (
        (a.most_right < b.fewest_right) | (b.most_right < a.fewest_right)
        | (a.most_left < b.fewest_left) | (b.most_left < a.fewest_left)
    )  # fmt: skip


def detect_hysteresis(
    points: Sequence[PrcPoint], source: str
) -> tuple[list[PrcJump], list[Hysteresis]]:
    """Detect jumps and hysteresis intervals of the "measured" or "twin" points."""
    by_direction: dict[str, dict[float, NormalizedResponse]] = {"forward": {}, "backward": {}}
    for point in points:
        values = getattr(point, source)
        if values is not None:
            by_direction[point.direction][point.frequency_hz] = values
    common = sorted(by_direction["forward"].keys() & by_direction["backward"].keys())
    forward, backward = (
        Solutions.from_responses([responses[frequency] for frequency in common])
        for responses in by_direction.values()
    )
    return detect_all_hysteresis(common, forward, backward)[()]


def detect_all_hysteresis(
    frequencies_hz: Sequence[float], forward: Solutions, backward: Solutions
) -> dict[tuple[int, ...], tuple[list[PrcJump], list[Hysteresis]]]:
    """Detect jumps and hysteresis of many sweeps at ascending frequencies, (..., frequency).

    Returns them by the index of each sweep; the index of a single sweep is ().
    """
    pairs = _DirectionPairs(
        _compare_solutions(forward, backward).value,
        _compare_solutions(forward, backward, limit=0.0).excess,
        # The scatter of a point in which the motion is jumping would hide the jump.
        _compare_solutions(
            forward.take(slice(1, None)), forward.take(slice(-1)), scatter_factor=0.0
        ).value,
        _compare_solutions(
            backward.take(slice(-1)), backward.take(slice(1, None)), scatter_factor=0.0
        ).value,
    )
    return {
        index: _detect_in_sweep(frequencies_hz, _DirectionPairs(*(v[index] for v in pairs)))
        for index in np.ndindex(pairs.difference.shape[:-1])
    }


class _DirectionPairs(NamedTuple):
    """Differences at each frequency of a sweep, > 0 if the forward branch is larger.

    `remaining` exceeds the scatter alone. Changes: of the next point of a direction from the point
    before, (frequency - 1,), each at the lower of the two frequencies.
    """

    difference: FloatND
    remaining: FloatND
    forward_change: FloatND
    backward_change: FloatND


def _detect_in_sweep(
    frequencies_hz: Sequence[float], pairs: _DirectionPairs
) -> tuple[list[PrcJump], list[Hysteresis]]:
    jumps: list[PrcJump] = []
    intervals: list[Hysteresis] = []
    if not pairs.difference.any():
        return jumps, intervals
    signs = np.sign(pairs.difference).tolist()
    for sign, group in groupby(range(len(signs)), key=lambda index: signs[index]):
        indices = list(group)
        first, last = indices[0], indices[-1]
        if sign == 0:
            continue
        ends = _interval_jumps(frequencies_hz, pairs, first, last)
        if not ends or (first == last and len(ends) < 2):
            continue
        jumps.extend(ends)
        if first < last:
            kind = "right" if sign > 0 else "left"
            intervals.append(Hysteresis(kind, frequencies_hz[first], frequencies_hz[last]))
    return jumps, intervals


def _interval_jumps(
    frequencies_hz: Sequence[float], pairs: _DirectionPairs, first: int, last: int
) -> list[PrcJump]:
    """Return the jumps at the ends of an interval; none if neither direction changes solution.

    Without a jump at either end the difference is scatter of an irregular motion, or a slow change
    of the specimen, not hysteresis.
    """
    ends = (
        ("forward", last, last + 1),  # the forward sweep leaves its branch at the upper end
        ("backward", first, first - 1),  # the backward sweep at the lower one
    )
    jumps = []
    for direction, inside, outside in ends:
        if not 0 <= outside < len(frequencies_hz):
            continue
        sign = 1 if direction == "backward" else -1
        changes = pairs.backward_change if direction == "backward" else pairs.forward_change
        change, difference = float(changes[min(inside, outside)]), float(pairs.difference[inside])
        # What the scatter explains does not remain: a motion that is jumping scatters most.
        closes = pairs.remaining[outside] / difference <= MAX_REMAINING_DIFFERENCE
        if change * difference * sign > 0 and closes:
            kind = "up" if change > 0 else "down"
            jumps.append(PrcJump(direction, frequencies_hz[inside], frequencies_hz[outside], kind))
    return jumps


def compare_amplitudes(
    first: NormalizedResponse, second: NormalizedResponse, allowance: float = 0.0
) -> float:
    """Return the difference of two eta_d over the largest that one steady motion explains.

    Beyond 1 they are different solutions. The largest is a tenth of the larger one, plus the ranges
    over the measured cycles, plus an `allowance` for noise and set-up, as eta_d. NaN if one is
    unknown.
    """
    a, b = first.eta_d, second.eta_d
    largest = MIN_BRANCH_DIFFERENCE * max(a, b) + a * first.spread + b * second.spread + allowance
    return abs(a - b) / largest if largest > 0 else math.nan


def find_sudden_change(before: PrcPoint | None, after: PrcPoint, source: str) -> int:
    """Return 1 or -1 where eta_d of a source jumps up or down between neighbours; 0 without a jump.

    Only a hint during the test: `detect_hysteresis` decides on jumps, with both directions.
    """
    values = None if before is None else getattr(before, source)
    next_values = getattr(after, source)
    if before is None or values is None or next_values is None:
        return 0
    low, high = sorted((values.eta_d, next_values.eta_d))
    if before.direction != after.direction or not 0 < low <= high / MIN_JUMP_RATIO:
        return 0
    return 1 if next_values.eta_d > values.eta_d else -1
