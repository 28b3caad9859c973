"""Main branches of a model, and its resonance over a second parameter.

Main branches are those that a slow sweep from rest meets, found in a fraction of a second.
`diagram.compute_diagram` looks for all others too: longer periods, isolas, mirrored motions.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Bool1D, Float1D
from twin.dynamics.bifurcations import BifurcationKind
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.continuation import Branch, continue_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.loci import Locus, continue_locus
from twin.dynamics.orbits import Orbit, settle_to_orbit
from twin.dynamics.period_map import FREQUENCY, PeriodMap
from twin.model.model import Model

MIN_SWEEP_STEPS = 3  # over which branches say something
VALUE_COUNT = 9  # of the parameter at which a motion settles, spread evenly
SAME_LOCUS = 2e-3  # of the ranges: distance of a bifurcation from a locus on which it lies
LOCUS_KINDS: tuple[BifurcationKind, ...] = ("fold", "grazing")


def follow_main_branches(
    period_map: PeriodMap,
    limits: tuple[float, float],
    *,
    parameter: str = FREQUENCY,
    values: int = VALUE_COUNT,
) -> tuple[Branch, ...]:
    """Follow the branches of the stable orbits of period 1 that are met from rest, over `limits`.

    From the upper end of the parameter downwards, each from rest.
    """
    branches: list[Branch] = []
    for value in np.linspace(*limits, values)[::-1].tolist():
        orbit = settle_to_orbit(period_map.with_parameter(parameter, value))
        if orbit is not None and not any(branch.contains(orbit) for branch in branches):
            branches.append(continue_branch(orbit, parameter, limits))
    return tuple(branches)


def follow_sweep_branches(
    model: Model, frequencies_hz: Iterable[float], levels_m_s2: Iterable[float]
) -> tuple[Branch, ...]:
    """Follow the main branches over the frequencies of a sweep, in a fraction of a second.

    None are returned where this would take longer, with force laws, and without a range of
    frequencies or one level.
    """
    frequencies, levels = set(frequencies_hz), set(levels_m_s2)
    if len(frequencies) < MIN_SWEEP_STEPS or len(levels) != 1:
        return ()
    limits = min(frequencies), max(frequencies)
    period_map = make_period_map(model, limits[0], levels.pop())
    if not isinstance(period_map, ClosedFormMap):
        return ()
    return follow_main_branches(period_map, limits, values=3)


@dataclass(frozen=True, eq=False)
class ResonancePeaks:
    """Largest stable response over the frequency at each value of a parameter, (values,).

    Half of the swing of u in m and of the total acceleration in m/s2, each with its frequency in
    Hz; NaN where it lies at an end of the frequency range, or no stable orbit is known.
    """

    values: Float1D
    u_m: Float1D
    u_hz: Float1D
    a_m_s2: Float1D
    a_hz: Float1D


@dataclass(frozen=True, eq=False)
class ResonanceMap:
    """Peaks over a parameter, and loci of folds and grazings over the frequency and it."""

    parameter: str
    limits_hz: tuple[float, float]
    peaks: ResonancePeaks
    loci: tuple[Locus, ...]


def compute_resonance_map(
    period_map: PeriodMap,
    parameter: str,
    values: Sequence[float] | Float1D,
    limits_hz: tuple[float, float],
) -> ResonanceMap:
    """Follow the main branches over the frequency at every value of a parameter, ascending.

    The loci begin at folds and grazings of these branches.
    """
    rows, loci = [], list[Locus]()
    limits = limits_hz, (float(values[0]), float(values[-1]))
    for value in values:
        at_value = period_map.with_parameter(parameter, float(value))
        branches = follow_main_branches(at_value, limits_hz, values=3)
        rows.append(find_peaks(branches))
        _add_loci(loci, branches, parameter, limits)
    peaks = ResonancePeaks(np.asarray(values, dtype=np.float64), *np.array(rows).T)
    return ResonanceMap(parameter, limits_hz, peaks, tuple(loci))


def find_peaks(branches: Sequence[Branch]) -> tuple[float, float, float, float]:
    """Return (largest u in m, at Hz, largest total acceleration in m/s2, at Hz), half swings.

    NaN without a stable orbit, and where the largest one is at an end of the range: the peak is
    outside.
    """
    peaks = [(0.0, math.nan, True), (0.0, math.nan, True)]
    for branch in branches:
        swings = np.array([half_swings(point.orbit) for point in branch.points])
        for column in range(2):
            if branch.stable.any():
                peaks[column] = max(peaks[column], _find_peak(branch, swings[:, column]))
    swing_and_hz = [
        (math.nan, math.nan) if is_outside else (swing, at_hz) for swing, at_hz, is_outside in peaks
    ]
    return (*swing_and_hz[0], *swing_and_hz[1])


def _find_peak(branch: Branch, swings: Float1D) -> tuple[float, float, bool]:
    """Return (largest swing of a stable orbit, its frequency in Hz, whether at the range's end)."""
    stable, frequencies_hz = branch.stable, branch.values
    top = int(np.where(stable, swings, -np.inf).argmax())
    ends = {0: branch.ends[0], len(swings) - 1: branch.ends[1]}
    if top in ends and ends[top].reason == "range end":
        return float(swings[top]), float(frequencies_hz[top]), True
    return *locate_peak(frequencies_hz, swings, stable), False


def locate_peak(frequencies_hz: Float1D, swings: Float1D, stable: Bool1D) -> tuple[float, float]:
    """Return (largest swing of a stable motion along a curve, its frequency in Hz).

    Between the points by the parabola through three of them; at a fold the point itself.
    """
    top = int(np.where(stable, swings, -np.inf).argmax())
    x, y = frequencies_hz[top - 1 : top + 2], swings[top - 1 : top + 2]
    if x.size == 3 and stable[top - 1 : top + 2].all() and (x[1] - x[0]) * (x[2] - x[1]) > 0:
        bend, slope, _ = np.polyfit(x - x[1], y, 2)
        if bend < 0:
            shift = -slope / (2 * bend)
            return float(y[1] + slope * shift / 2), float(x[1] + shift)
    return float(swings[top]), float(frequencies_hz[top])


def half_swings(orbit: Orbit) -> tuple[float, float]:
    """Return half of the swing of u in m and of the total acceleration in m/s2."""
    return (
        (orbit.extreme("u_max") - orbit.extreme("u_min")) / 2,
        (orbit.extreme("a_max") - orbit.extreme("a_min")) / 2,
    )


def _add_loci(
    loci: list[Locus],
    branches: Sequence[Branch],
    parameter: str,
    limits: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    """Continue every fold and grazing of the branches that lies on no known locus."""
    for branch in branches:
        for bifurcation in branch.of_kind(*LOCUS_KINDS):
            period_map = bifurcation.orbit.period_map
            place = np.array([period_map.frequency_hz, period_map.parameter(parameter)])
            if not any(
                locus.kind == bifurcation.kind and _is_near(locus, place, limits) for locus in loci
            ):
                locus = continue_locus(bifurcation, (FREQUENCY, parameter), limits)
                if len(locus.values) > 1:
                    loci.append(locus)


def _is_near(
    locus: Locus, place: Float1D, limits: tuple[tuple[float, float], tuple[float, float]]
) -> bool:
    """Return whether a point of the plane lies on the polygon through the points of a locus."""
    scale = np.array([high - low for low, high in limits])
    points, target = locus.values / scale, place / scale
    if len(points) < 2:
        return bool(np.abs(points - target).max(initial=np.inf) < SAME_LOCUS)
    start, chord = points[:-1], np.diff(points, axis=0)
    square = np.maximum((chord * chord).sum(axis=1), 1e-30)
    along = np.clip(((target - start) * chord).sum(axis=1) / square, 0.0, 1.0)
    distance = np.hypot(*(start + along[:, None] * chord - target).T)
    return bool(distance.min() < SAME_LOCUS)
