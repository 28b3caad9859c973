"""Response curves of a model by continuation; by stepped sweeps where that does not apply."""

import math
from collections.abc import Callable

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError
from twin.compare.curves import MIN_BRANCH_DIFFERENCE
from twin.discovery.features.config import FeatureTest
from twin.discovery.features.curve import MIN_EXCESS_M, ResponseCurve, join_directions
from twin.dynamics.continuation import continue_branch
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.orbits import Orbit, settle_to_orbit
from twin.dynamics.period_map import FREQUENCY, set_total_gap
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model

# Lowest frequency of a curve over a linear one below which the primary resonance cannot lie: that
# of free flight, of the flight that grazes a bumper with falling frequency, or of the mass on one
# bumper. Below, motions have several impacts or are chaotic, and cost most of the time.
MIN_FLIGHT_RATIO, MIN_GRAZING_RATIO, MIN_CONTACT_RATIO = 0.6, 0.85, 0.6
SWEEP_CYCLES = 30  # per frequency of a stepped sweep
MOTION_SAMPLES = 128  # of an orbit in permanent contact, for its smallest forces
MIN_LARGE_SHARE = 0.5  # of the largest amplitude: smaller orbits are far from leaving a bumper
GAP_ROUNDS = 2  # of the search for permanent contact; a linear bumper needs one
MAX_DEEPENINGS = 3  # doublings of the precompression from which that search starts

CurveMaker = Callable[[Model], "ResponseCurve | None"]


def find_curve_limits(model: Model, test: FeatureTest) -> tuple[float, float]:
    """Return the lowest and the highest frequency in Hz of the primary resonance's curve."""
    p = model.parameters
    w2, ratio = p.stiffness / p.mass, MIN_FLIGHT_RATIO
    if p.gap_r + p.gap_l <= 0:
        w2 += min(p.bumper_stiffness_r, p.bumper_stiffness_l) / p.mass
        ratio = MIN_CONTACT_RATIO
    elif math.isfinite(p.gap_r + p.gap_l):
        w2 += 2 * test.acceleration_m_s2 / (p.gap_r + p.gap_l)
        ratio = MIN_GRAZING_RATIO
    low_hz = ratio * math.sqrt(w2) / (2 * math.pi)
    return max(test.start_hz, min(low_hz, 0.5 * test.end_hz)), test.end_hz


@np.errstate(all="ignore")  # a trial of a fit may diverge, and then has no curve
def compute_curve(model: Model, test: FeatureTest) -> ResponseCurve | None:
    """Return the curve by continuation from the upper end; by stepped sweeps if it breaks off.

    A branch that is not connected to the motion at the upper end is not looked for.
    """
    limits = find_curve_limits(model, test)
    try:
        orbit = settle_to_orbit(make_period_map(model, limits[1], test.acceleration_m_s2))
        branch = continue_branch(orbit, FREQUENCY, limits, -1) if orbit else None
    except InputError:  # the model cannot be solved with these parameters
        return None
    if branch is None or branch.ends[1].reason != "range end":
        return sweep_curve(model, test)
    orbits = [point.orbit for point in reversed(branch.points)]
    amplitudes = np.array([(orbit.u_max - orbit.u_min) / 2 for orbit in orbits])
    large = amplitudes >= MIN_LARGE_SHARE * amplitudes.max()
    excess = [_measure_excess(*pair) for pair in zip(orbits, large.tolist(), strict=True)]
    return ResponseCurve(
        branch.values[::-1], amplitudes, np.array(excess), branch.stable[::-1], "continuation"
    )


def _measure_excess(orbit: Orbit, is_large: bool) -> float:
    """Return by how many m an orbit passes the touch of a bumper; see `ResponseCurve`.

    In permanent contact it follows from the smallest force, over the stiffness of the bumper.
    """
    p = orbit.period_map.model.parameters
    is_precompressed = p.gap_r + p.gap_l <= 0
    if not is_precompressed:
        return max(orbit.u_max - p.gap_r, -orbit.u_min - p.gap_l)
    excess = max(orbit.u_max + p.gap_l, -orbit.u_min + p.gap_r)
    regime, *events = orbit.contacts
    if regime != 3 or events:
        return max(excess, MIN_EXCESS_M)
    if not is_large:
        return excess
    motion = orbit.sample_motion(MOTION_SAMPLES)
    push = min(
        float(motion[3].min()) / p.bumper_stiffness_r,
        -float(motion[4].max()) / p.bumper_stiffness_l,
    )
    return -max(push, MIN_EXCESS_M)


@np.errstate(all="ignore")
def sweep_curve(model: Model, test: FeatureTest) -> ResponseCurve | None:
    """Return the curve of a stepped sweep, forward and backward, at the test's frequency step."""
    low_hz, high_hz = find_curve_limits(model, test)
    count = round((high_hz - low_hz) / test.step_hz)
    grid_hz: Float1D = high_hz - test.step_hz * np.arange(count, -1, -1, dtype=np.float64)
    try:
        sweep = simulate_sweep(
            model, [*grid_hz, *grid_hz[::-1]], test.acceleration_m_s2, SWEEP_CYCLES, 1
        )
    except InputError:
        return None
    swings = (sweep.column("u_max") - sweep.column("u_min"))[:, -1] / 2
    if not np.isfinite(swings).all():
        return None
    forward_m, backward_m = swings[: grid_hz.size], swings[grid_hz.size :][::-1]
    differs = np.abs(forward_m - backward_m) > MIN_BRANCH_DIFFERENCE * np.maximum(
        forward_m, backward_m
    )
    hz, amplitude_m = join_directions(grid_hz, forward_m, backward_m, differs)
    p = model.parameters
    touch_m = min(abs(p.gap_r), abs(p.gap_l))
    return ResponseCurve(
        hz, amplitude_m, amplitude_m - touch_m, np.ones(hz.size, dtype=bool), "stepped sweeps"
    )


def find_permanent_gap_mm(model: Model, gap_mm: float, make_curve: CurveMaker) -> float:
    """Return the largest total gap in mm at which no bumper is left at any frequency; NaN if none.

    From `gap_mm` < 0, deepened until contact is permanent, upwards by the precompression that is
    not used.
    """
    excess_m = math.nan
    for _ in range(MAX_DEEPENINGS + 1):
        curve = make_curve(set_total_gap(model, gap_mm / 1e3))
        excess_m = math.nan if curve is None else curve.largest_excess_m
        if excess_m < 0:
            break
        gap_mm *= 2
    for _ in range(GAP_ROUNDS - 1):
        if not excess_m < 0:
            return math.nan
        gap_mm -= 2e3 * 0.9 * excess_m  # stays in permanent contact
        curve = make_curve(set_total_gap(model, gap_mm / 1e3))
        excess_m = math.nan if curve is None else curve.largest_excess_m
    return gap_mm - 2e3 * excess_m
