"""Phase resonance of a model: the orbit whose u leads the table's acceleration by 90 degrees."""

import math

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.dynamics.arclength import NoConvergence, correct, weighted_length
from twin.dynamics.continuation import continue_branch, make_problem, orbit_weights
from twin.dynamics.linearized_orbit import find_harmonics
from twin.dynamics.orbits import Orbit, settle_to_orbit
from twin.dynamics.period_map import FREQUENCY, PeriodMap

RANGE_MARGIN = 1.2  # ratio of frequencies by which the branch is followed beyond the range
PHASE_TOLERANCE_DEG = 1e-3
MAX_BISECTIONS = 40
LEAD_RATIO = 1.04  # of the frequencies of two orbits on the way from rest to the resonance


def find_phase_resonance(period_map: PeriodMap, range_hz: tuple[float, float]) -> Orbit:
    """Return the largest orbit in phase resonance within a frequency range, at one level.

    The branch is that of the orbit to which rest settles above the range. InputError without one,
    with the phases of the branch in the range.
    """
    return find_resonance_approach(period_map, range_hz)[-1]


def find_resonance_approach(period_map: PeriodMap, range_hz: tuple[float, float]) -> list[Orbit]:
    """Return orbits from below all folds up to the one in phase resonance, which is the last.

    From rest the first is reached without any other solution to fall to; where the branch has no
    fold the resonance alone is returned. InputError as in `find_phase_resonance`.
    """
    high_hz = range_hz[1] * RANGE_MARGIN
    start = settle_to_orbit(period_map.with_parameter(FREQUENCY, high_hz))
    level_g = period_map.acceleration_m_s2 / GRAVITY_M_S2
    if start is None:
        raise InputError(
            f"from rest, the model does not settle to an orbit of period 1 at {high_hz:.4g} Hz and "
            f"{level_g:.4g} g",
            key="excitation.stop_hz",
            value=range_hz[1],
            remedy="choose another range",
        )
    branch = continue_branch(start, FREQUENCY, (range_hz[0] / RANGE_MARGIN, high_hz))
    orbits = [point.orbit for point in branch.points]
    phases = np.array([measure_orbit_phase(orbit) for orbit in orbits])
    is_crossing = np.diff(np.sign(phases - 90.0)) != 0.0
    resonances = {
        int(k): _locate(orbits[k], orbits[k + 1], float(phases[k]))
        for k in np.flatnonzero(is_crossing)
    }
    inside = [
        k for k, orbit in resonances.items() if range_hz[0] <= orbit.frequency_hz <= range_hz[1]
    ]
    if not inside:
        raise _make_phase_error(branch.values, phases, range_hz, level_g, [*resonances.values()])
    k = max(inside, key=lambda k: resonances[k].u_max - resonances[k].u_min)
    # The branch comes from higher frequencies: the way up to the resonance lies on the other side.
    below = orbits[k::-1] if orbits[0].frequency_hz < orbits[-1].frequency_hz else orbits[k + 1 :]
    folds_hz = [bifurcation.value for bifurcation in branch.folds]
    return [*_select_leads(below, resonances[k], folds_hz), resonances[k]]


def _select_leads(below: list[Orbit], resonance: Orbit, folds_hz: list[float]) -> list[Orbit]:
    """Return orbits by rising frequency from below all folds to the resonance, LEAD_RATIO apart.

    below: the branch away from the resonance, towards lower frequencies.
    """
    lowest_hz = min(folds_hz, default=resonance.frequency_hz)
    if lowest_hz >= resonance.frequency_hz:
        return []
    leads, next_hz = [], resonance.frequency_hz / LEAD_RATIO
    for orbit in below:
        if orbit.frequency_hz <= next_hz:
            leads.append(orbit)
            next_hz = orbit.frequency_hz / LEAD_RATIO
        if orbit.frequency_hz < lowest_hz / LEAD_RATIO:
            break
    return leads[::-1]


def measure_orbit_phase(orbit: Orbit) -> float:
    """Return the phase in degrees by which u leads the table's acceleration, -90 to 270."""
    fundamental = complex(find_harmonics(orbit, 1)[1])
    return math.degrees(math.atan2(fundamental.imag, fundamental.real)) + 90.0


def _locate(first: Orbit, second: Orbit, first_phase: float) -> Orbit:
    """Return the orbit in phase resonance between two of a branch, by bisection of the arc."""
    problem = make_problem(first, FREQUENCY)
    z0, z1 = (np.append(orbit.x, orbit.frequency_hz) for orbit in (first, second))
    weights = np.append(orbit_weights(first), 1.0)
    length = weighted_length(z1 - z0, weights)
    low, high = 0.0, 1.0
    for _ in range(MAX_BISECTIONS):
        middle = (low + high) / 2
        guess = z0 + middle * (z1 - z0)
        try:
            point = correct(problem.evaluate, guess, (z1 - z0) / length, weights, length)
        except NoConvergence:  # between orbits of different contacts
            return first if middle < 0.5 else second
        orbit = problem.make_orbit(point.z, point.linearization.result)
        phase = measure_orbit_phase(orbit)
        if abs(phase - 90.0) < PHASE_TOLERANCE_DEG:
            break
        if (phase > 90.0) == (first_phase > 90.0):
            low = middle
        else:
            high = middle
    return orbit


def _make_phase_error(
    frequencies: Float1D,
    phases: Float1D,
    range_hz: tuple[float, float],
    level_g: float,
    resonances: list[Orbit],
) -> InputError:
    """Return the error that a range has no phase resonance, with what the branch has."""
    inside = (frequencies >= range_hz[0]) & (frequencies <= range_hz[1])
    own = phases[inside]
    extent = f" (u leads by {own.min():.4g} to {own.max():.4g} degrees)" if own.size else ""
    others_hz = [orbit.frequency_hz for orbit in resonances]
    return InputError(
        f"the model has no phase resonance at {level_g:.4g} g from {range_hz[0]:g} to "
        f"{range_hz[1]:g} Hz{extent}",
        key="excitation.start_hz",
        value=range_hz[0],
        allowed=f"a range that contains {max(others_hz):.4g} Hz" if others_hz else "",
        remedy="choose another range, levels or model",
    )
