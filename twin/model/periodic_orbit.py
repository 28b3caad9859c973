"""Period map and periodic orbits of the SNM under A = a sin(2 pi f t), with exact Jacobian.

A state is that of `closed_form`, at a zero upcrossing of A. A variation of it is (u, v, u_r, u_l)
in m and m/s; within a mode it follows the mode's linear flow, through an event the saltation:
    onset on j      delta_v += (C_j / M) (delta_uj - delta_u), then delta_uj = delta_u
    detachment      no change: force and clearance rate are zero there
The Jacobian is the product of both. At a grazing contact it jumps by a finite amount.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from twin.model.closed_form import continuous_params, restart_state, substep_count
from twin.model.compilation import jit_helper, jit_kernel
from twin.model.contact_regime import (
    BASE,
    C_R,
    CONTACT_L,
    CONTACT_R,
    DENORMAL_LIMIT,
    MASS,
    MAX_EVENTS_PER_STEP,
    MODE_SIZE,
    MODES,
    R_R,
    REVISION,
    advance_to_event,
    transition_matrix,
)  # fmt: skip
from twin.model.parameters import Parameters
from twin.model.stepped_sine import simulate_stepped_sine, validate_frequencies

Complex1D = npt.NDArray[np.complex128]

ORBIT_STEPS_PER_CYCLE = 16
MAX_ONSETS_PER_CYCLE = 40  # per side; room in `contact_events`
PERIODICITY_TOL_M = 1e-13  # m: a state that returns this close is periodic


@jit_helper()
def advance_variations(
    variations: Float2D, params: Float1D, mode: int, dt: float, side: int, onset: bool
) -> None:
    """Advance `variations` (4, n) through dt s of a mode and the event on `side` at its end."""
    b = MODES + mode * MODE_SIZE
    e11, e12, e21, e22 = transition_matrix(dt, params[b + 3], params[b + 4])
    decay_r, decay_l = math.exp(-params[R_R] * dt), math.exp(-params[R_R + 1] * dt)
    for i in range(variations.shape[1]):
        u, v = variations[0, i], variations[1, i]
        variations[0, i], variations[1, i] = e11 * u + e12 * v, e21 * u + e22 * v
        variations[2, i] = variations[0, i] if mode & 1 else decay_r * variations[2, i]
        variations[3, i] = variations[0, i] if mode & 2 else decay_l * variations[3, i]
        if onset:
            separation = variations[2 + side, i] - variations[0, i]
            variations[1, i] += params[C_R + side] / params[MASS] * separation
            variations[2 + side, i] = variations[0, i]


@jit_kernel(
    int64(
        float64[::1], float64[::1], float64, float64, int64, int64, float64[:, ::1],
        float64[::1], float64[:, ::1], types.Omitted(REVISION),
    ),
    cache=True,
)  # fmt: skip
def advance_cycles(
    state: Float1D, params: Float1D, peak: float, w: float, steps: int, cycles: int,
    variations: Float2D, growth: Float1D, events: Float2D, revision: int = REVISION,
) -> int:  # fmt: skip
    """Advance `state` and `variations` (4, n) through whole cycles; return the number of events.

    events (m, 3): time in cycles, side (0 right, 1 left) and onset 1 or release 0 of each. growth
    (cycles,), unless empty: logarithm of the growth of variation 0 over each cycle, which is then
    normalized to 1 m.
    """
    h, phase_step, count = 2 * math.pi / (w * steps), 2 * math.pi / steps, 0
    for cycle in range(cycles):
        for k in range(steps):
            t = 0.0
            for attempt in range(MAX_EVENTS_PER_STEP):
                mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
                search, wave = attempt + 1 < MAX_EVENTS_PER_STEP, (peak, w, phase_step * k + w * t)
                dt, side, _, _, _ = advance_to_event(state, params, h - t, 0.0, 0.0, wave, search)
                t += dt
                onset = side >= 0 and state[CONTACT_R + side] > 0
                if variations.shape[1]:
                    advance_variations(variations, params, mode, dt, side, onset)
                if side < 0:
                    break
                if count < events.shape[0]:
                    events[count, 0] = cycle + (k + t / h) / steps
                    events[count, 1], events[count, 2] = side, state[CONTACT_R + side]
                count += 1
        if growth.size:
            size = 0.0
            for j in range(4):
                size += variations[j, 0] ** 2
            size = math.sqrt(size)
            growth[cycle] = math.log(max(size, DENORMAL_LIMIT))
            for j in range(4):
                variations[j, 0] /= max(size, DENORMAL_LIMIT)
    return count


def _run_cycles(
    parameters: Parameters,
    frequency_hz: float,
    acceleration: float,
    state: Float1D,
    cycles: int,
    variations: Float2D,
    growth: Float1D,
    events: Float2D,
) -> tuple[Float1D, int]:
    """Return (the state `cycles` later, the number of events)."""
    validate_frequencies([frequency_hz], acceleration, cycles)
    params, end_state = continuous_params(parameters), state.copy()
    end_state[BASE] = 0.0
    steps = ORBIT_STEPS_PER_CYCLE * substep_count(
        params, 1 / (frequency_hz * ORBIT_STEPS_PER_CYCLE)
    )
    w = 2 * math.pi * frequency_hz
    count = advance_cycles(
        end_state, params, acceleration, w, steps, cycles, variations, growth, events
    )
    return end_state, int(count)


_NO_GROWTH, _EMPTY_LOG = np.empty(0), np.empty((0, 3))


def period_map(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D
) -> tuple[Float1D, Float2D]:
    """Return (state one period of a sin(2 pi f t) later, Jacobian (4, 4) in u, v, u_r, u_l)."""
    jacobian = np.eye(4)
    for side in range(2):
        if state[CONTACT_R + side] > 0:  # follows u: it cannot vary on its own
            jacobian[2 + side] = jacobian[0]
    end_state, _ = _run_cycles(
        parameters, frequency_hz, acceleration, state, 1, jacobian, _NO_GROWTH, _EMPTY_LOG
    )
    return end_state, jacobian


def lyapunov_exponent(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[float, Float1D]:
    """Return (largest Lyapunov exponent per cycle, state `cycles` later) from a settled state."""
    variation, growth = np.zeros((4, 1)), np.empty(cycles)
    variation[:2, 0] = 1.0
    end_state, _ = _run_cycles(
        parameters, frequency_hz, acceleration, state, cycles, variation, growth, _EMPTY_LOG
    )
    return float(growth.mean()), end_state


def contact_events(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[Float2D, Float1D]:
    """Return (contact events (n, 3) in order of time, the state `cycles` later).

    Columns: time in cycles, side 0 right or 1 left, onset 1 or release 0.
    """
    events = np.empty((4 * MAX_ONSETS_PER_CYCLE * cycles, 3))
    end_state, count = _run_cycles(
        parameters, frequency_hz, acceleration, state, cycles, np.empty((4, 0)), _NO_GROWTH, events
    )
    return events[:count], end_state


def contact_onset_times(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[Float1D, Float1D, Float1D]:
    """Return (right and left contact onset times in cycles, the state `cycles` later)."""
    events, end_state = contact_events(parameters, frequency_hz, acceleration, state, cycles)
    right, left = (events[(events[:, 1] == side) & (events[:, 2] == 1), 0] for side in (0, 1))
    return right, left, end_state


@dataclass(frozen=True, slots=True, eq=False)
class Orbit:
    """A periodic orbit: state at a zero upcrossing of A, Floquet multipliers, largest first.

    It is stable if every multiplier is less than 1 in magnitude.
    """

    frequency_hz: float
    state: Float1D
    multipliers: Complex1D
    u_max: float
    u_min: float

    @property
    def stable(self) -> bool:
        return bool(abs(self.multipliers[0]) < 1)


def find_periodic_orbit(
    parameters: Parameters, frequency_hz: float, acceleration: float, guess: Float1D
) -> Orbit | None:
    """Return the periodic orbit, stable or not, that Newton's method finds; None if it fails."""
    state = guess
    for _ in range(40):
        end_state, jacobian = period_map(parameters, frequency_hz, acceleration, state)
        error = end_state[:4] - state[:4]
        if not np.isfinite(error).all():
            return None
        if np.abs(error).max() < PERIODICITY_TOL_M:
            break
        try:
            u, v, u_r, u_l = state[:4] - np.linalg.solve(jacobian - np.eye(4), error)
        except np.linalg.LinAlgError:
            return None
        right, left = bool(end_state[CONTACT_R] > 0), bool(end_state[CONTACT_L] > 0)
        state = restart_state(u, v, u_r, u_l, right, left, 0.0, parameters)
    else:
        return None
    multipliers = np.linalg.eigvals(jacobian).astype(np.complex128)
    multipliers = multipliers[np.argsort(-np.abs(multipliers))]
    cycle = simulate_stepped_sine(
        parameters, [frequency_hz], acceleration, 1, ORBIT_STEPS_PER_CYCLE, state
    )
    u_max, u_min = cycle.column("u_max")[0, 0], cycle.column("u_min")[0, 0]
    return Orbit(frequency_hz, state, multipliers, float(u_max), float(u_min))
