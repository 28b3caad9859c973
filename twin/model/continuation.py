"""Continuation of periodic orbits over frequency: stable branches, folds and unstable orbits."""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from twin.model.closed_form import restart_state
from twin.model.contact_regime import CONTACT_L, CONTACT_R
from twin.model.parameters import Parameters
from twin.model.periodic_orbit import Orbit, find_periodic_orbit
from twin.model.stepped_sine import simulate_stepped_sine

MAX_AMPLITUDE_CHANGE = 0.2  # relative change of amplitude between neighbors on a branch
MIN_STEP_HZ = 1e-6  # a branch ends where this step fails
SETTLING_CYCLES = 400  # cycles to settle on a stable periodic motion
BASIN_CYCLES = 40  # cycles that show in which basin of attraction a state lies


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """Stable orbits in order of travel; `end_hz` is the fold if the branch ends before its goal."""

    orbits: tuple[Orbit, ...]
    end_hz: float | None


def settle_to_orbit(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D | None = None
) -> Orbit | None:
    """Return the stable orbit to which a state (or rest) settles at this frequency, or None."""
    sweep = simulate_stepped_sine(
        parameters, [frequency_hz], acceleration, SETTLING_CYCLES, state=state
    )
    orbit = find_periodic_orbit(parameters, frequency_hz, acceleration, sweep.states[0])
    return orbit if orbit is not None and orbit.stable else None


def continue_branch(
    parameters: Parameters, acceleration: float, start: Orbit, to_hz: float, step_hz: float
) -> Branch:
    """Continue a stable orbit to `to_hz` by Newton's method, halving the step until it ends."""
    orbits, step = [start], float(np.copysign(step_hz, to_hz - start.frequency_hz))
    while abs(step) > MIN_STEP_HZ:
        last = orbits[-1]
        frequency = last.frequency_hz + step
        if (to_hz - frequency) * step < 0:
            frequency = to_hz
        orbit = find_periodic_orbit(parameters, frequency, acceleration, last.state)
        if orbit is None or not orbit.stable or not _on_same_branch(orbit, last):
            step /= 2
            continue
        orbits.append(orbit)
        if frequency == to_hz:
            return Branch(tuple(orbits), None)
    return Branch(tuple(orbits), orbits[-1].frequency_hz)


def _on_same_branch(orbit: Orbit, previous: Orbit) -> bool:
    amplitude = previous.u_max - previous.u_min
    return abs(orbit.u_max - orbit.u_min - amplitude) <= MAX_AMPLITUDE_CHANGE * amplitude


def find_unstable_orbit(
    parameters: Parameters, acceleration: float, first: Orbit, second: Orbit
) -> Orbit | None:
    """Return the unstable orbit on the basin boundary between two stable ones, or None.

    Bisection on the line between their states by the orbit to which a state settles; the state
    that takes longest to settle passes near the unstable orbit, from where Newton converges.
    """
    frequency = first.frequency_hz
    middle = (first.u_max + second.u_max) / 2
    low, high = 0.0, 1.0  # fraction of the way from `second` to `first`
    for _ in range(50):
        fraction = (low + high) / 2
        state = _interpolate_states(parameters, second.state, first.state, fraction)
        sweep = simulate_stepped_sine(
            parameters, [frequency], acceleration, BASIN_CYCLES, state=state
        )
        if (sweep.column("u_max")[0, -1] > middle) == (first.u_max > middle):
            high = fraction
        else:
            low = fraction
    state = _interpolate_states(parameters, second.state, first.state, high)
    for _ in range(BASIN_CYCLES // 2):
        orbit = find_periodic_orbit(parameters, frequency, acceleration, state)
        if orbit is not None and not orbit.stable:
            return orbit
        state = simulate_stepped_sine(parameters, [frequency], acceleration, 1, state=state).states[
            0
        ]
    return None


def _interpolate_states(
    parameters: Parameters, start: Float1D, end: Float1D, fraction: float
) -> Float1D:
    state = start + fraction * (end - start)
    u, v, u_r, u_l = state[:4]
    right, left = bool(state[CONTACT_R] > 0.5), bool(state[CONTACT_L] > 0.5)
    return restart_state(u, v, u_r, u_l, right, left, 0.0, parameters)
