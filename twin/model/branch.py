"""Branches of periodic motions over frequency: how far a stable one goes, and what lies between."""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from twin.model.exact import restart
from twin.model.orbit import Orbit, periodic
from twin.model.parameters import Parameters
from twin.model.phase import CONTACT_L, CONTACT_R
from twin.model.sweep import stepped_sine

NEAR = 0.2  # of the amplitude: neighbours on a branch differ by less
FINEST_HZ = 1e-6  # a branch ends where no step this small goes on
SETTLE = 400  # cycles to a periodic motion, where it is stable
FALL = 40  # cycles after which it is plain to which of two motions a state falls


@dataclass(frozen=True, slots=True, eq=False)
class Branch:
    """Stable motions in the order of travel; `end_hz` where they end before the goal: a fold."""

    orbits: tuple[Orbit, ...]
    end_hz: float | None


def settled(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D | None = None
) -> Orbit | None:
    """The stable periodic motion that a state (or rest) falls to at this frequency, if any."""
    sweep = stepped_sine(parameters, [frequency_hz], acceleration, SETTLE, state=state)
    found = periodic(parameters, frequency_hz, acceleration, sweep.states[0])
    return found if found is not None and found.stable else None


def follow(
    parameters: Parameters, acceleration: float, start: Orbit, to_hz: float, step_hz: float
) -> Branch:
    """Slow continuation of a stable motion by Newton, in ever smaller steps until it ends."""
    orbits, step = [start], float(np.copysign(step_hz, to_hz - start.frequency_hz))
    while abs(step) > FINEST_HZ:
        last = orbits[-1]
        frequency = last.frequency_hz + step
        if (to_hz - frequency) * step < 0:
            frequency = to_hz
        found = periodic(parameters, frequency, acceleration, last.state)
        if found is None or not found.stable or not _near(found, last):
            step /= 2
            continue
        orbits.append(found)
        if frequency == to_hz:
            return Branch(tuple(orbits), None)
    return Branch(tuple(orbits), orbits[-1].frequency_hz)


def _near(one: Orbit, other: Orbit) -> bool:
    size = other.u_max - other.u_min
    return abs(one.u_max - one.u_min - size) <= NEAR * size


def between(parameters: Parameters, acceleration: float, one: Orbit, other: Orbit) -> Orbit | None:
    """The unstable motion on the border between two stable ones at the same frequency.

    Bisection on the line between them by where a state falls to; what falls to neither for longest
    passes close by the motion on the border, and Newton does the rest.
    """
    frequency = one.frequency_hz
    middle = (one.u_max + other.u_max) / 2
    low, high = 0.0, 1.0  # of the way from `other` to `one`
    for _ in range(50):
        half = (low + high) / 2
        state = _blend(parameters, other.state, one.state, half)
        fallen = stepped_sine(parameters, [frequency], acceleration, FALL, state=state)
        if (fallen.column("u_max")[0, -1] > middle) == (one.u_max > middle):
            high = half
        else:
            low = half
    state = _blend(parameters, other.state, one.state, high)
    for _ in range(FALL // 2):
        found = periodic(parameters, frequency, acceleration, state)
        if found is not None and not found.stable:
            return found
        state = stepped_sine(parameters, [frequency], acceleration, 1, state=state).states[0]
    return None


def _blend(parameters: Parameters, far: Float1D, near: Float1D, share: float) -> Float1D:
    state = far + share * (near - far)
    u, v, u_r, u_l = state[:4]
    right, left = bool(state[CONTACT_R] > 0.5), bool(state[CONTACT_L] > 0.5)
    return restart(u, v, u_r, u_l, right, left, 0.0, parameters)
