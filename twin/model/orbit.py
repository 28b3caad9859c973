"""The one-period map of the SNM under A = a sin(2 pi f t), with its exact Jacobian.

A state is what `exact` carries, at a zero upcrossing of A. A variation of it is (u, v, u_r, u_l) in
m and m/s; through a phase it follows the phase's own linear flow, through an event the saltation:
    onset on j      delta_v += (C_j / M) (delta_uj - delta_u), then delta_uj = delta_u
    detachment      nothing: force and clearance rate are zero there
The Jacobian is the product of both. At a graze it jumps by a finite amount.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from twin.model.compiled import compiled, inner
from twin.model.exact import parameter_constants, restart, substeps
from twin.model.parameters import Parameters
from twin.model.phase import (
    BASE,
    C_R,
    CONTACT_L,
    CONTACT_R,
    DENORMAL,
    MASS,
    MODE_SIZE,
    MODES,
    MOST_EVENTS,
    R_R,
    REVISION,
    flow,
    leap,
)  # fmt: skip
from twin.model.sweep import held, stepped_sine

Complex1D = npt.NDArray[np.complex128]

LEAST_STEPS = 16  # a cycle
MOST_ONSETS = 40  # a cycle and side that `onsets` makes room for
EXACT = 1e-13  # m: a state that comes back this near is periodic


@inner()
def carry(variations: Float2D, con: Float1D, mode: int, dt: float, side: int, onset: bool) -> None:
    """Moves `variations` (4, n) through dt s of a mode and the event on `side` at its end."""
    b = MODES + mode * MODE_SIZE
    e11, e12, e21, e22 = flow(dt, con[b + 3], con[b + 4])
    fade_r, fade_l = math.exp(-con[R_R] * dt), math.exp(-con[R_R + 1] * dt)
    for i in range(variations.shape[1]):
        u, v = variations[0, i], variations[1, i]
        variations[0, i], variations[1, i] = e11 * u + e12 * v, e21 * u + e22 * v
        variations[2, i] = variations[0, i] if mode & 1 else fade_r * variations[2, i]
        variations[3, i] = variations[0, i] if mode & 2 else fade_l * variations[3, i]
        if onset:
            apart = variations[2 + side, i] - variations[0, i]
            variations[1, i] += con[C_R + side] / con[MASS] * apart
            variations[2 + side, i] = variations[0, i]


@compiled(
    int64(
        float64[::1], float64[::1], float64, float64, int64, int64, float64[:, ::1],
        float64[::1], float64[:, ::1], types.Omitted(REVISION),
    ),
    cache=True,
)  # fmt: skip
def turns(
    state: Float1D, con: Float1D, peak: float, w: float, steps: int, cycles: int,
    variations: Float2D, growth: Float1D, log: Float2D, revision: int = REVISION,
) -> int:  # fmt: skip
    """Moves `state` and `variations` (4, n) through whole cycles; the number of events.

    log (m, 3): time in cycles, side (0 right, 1 left) and onset 1 or release 0 of each. growth
    (cycles,), where it has room: logarithm of the growth of variation 0 over each cycle, which is
    then made 1 m long.
    """
    h, turn, count = 2 * math.pi / (w * steps), 2 * math.pi / steps, 0
    for cycle in range(cycles):
        for k in range(steps):
            t = 0.0
            for attempt in range(MOST_EVENTS):
                mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
                search, wave = attempt + 1 < MOST_EVENTS, (peak, w, turn * k + w * t)
                dt, side, _, _, _ = leap(state, con, h - t, 0.0, 0.0, wave, search)
                t += dt
                onset = side >= 0 and state[CONTACT_R + side] > 0
                if variations.shape[1]:
                    carry(variations, con, mode, dt, side, onset)
                if side < 0:
                    break
                if count < log.shape[0]:
                    log[count, 0] = cycle + (k + t / h) / steps
                    log[count, 1], log[count, 2] = side, state[CONTACT_R + side]
                count += 1
        if growth.size:
            size = 0.0
            for j in range(4):
                size += variations[j, 0] ** 2
            size = math.sqrt(size)
            growth[cycle] = math.log(max(size, DENORMAL))
            for j in range(4):
                variations[j, 0] /= max(size, DENORMAL)
    return count


def _turn(
    parameters: Parameters,
    frequency_hz: float,
    acceleration: float,
    state: Float1D,
    cycles: int,
    variations: Float2D,
    growth: Float1D,
    log: Float2D,
) -> tuple[Float1D, int]:
    """(the state `cycles` later, the number of events)."""
    held([frequency_hz], acceleration, cycles)
    con, moved = parameter_constants(parameters), state.copy()
    moved[BASE] = 0.0
    steps = LEAST_STEPS * substeps(con, 1 / (frequency_hz * LEAST_STEPS))
    w = 2 * math.pi * frequency_hz
    count = turns(moved, con, acceleration, w, steps, cycles, variations, growth, log)
    return moved, int(count)


_NONE, _NO_LOG = np.empty(0), np.empty((0, 3))


def period_map(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D
) -> tuple[Float1D, Float2D]:
    """(state one period later, its Jacobian (4, 4) in u, v, u_r, u_l) under a sin(2 pi f t)."""
    jacobian = np.eye(4)
    for side in range(2):
        if state[CONTACT_R + side] > 0:  # slaved to u: it cannot vary on its own
            jacobian[2 + side] = jacobian[0]
    moved, _ = _turn(parameters, frequency_hz, acceleration, state, 1, jacobian, _NONE, _NO_LOG)
    return moved, jacobian


def lyapunov(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[float, Float1D]:
    """(largest Lyapunov exponent per cycle, the state `cycles` later), from a settled state."""
    variation, growth = np.zeros((4, 1)), np.empty(cycles)
    variation[:2, 0] = 1.0
    moved, _ = _turn(
        parameters, frequency_hz, acceleration, state, cycles, variation, growth, _NO_LOG
    )
    return float(growth.mean()), moved


def events(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[Float2D, Float1D]:
    """(contacts in the order of time, the state `cycles` later).

    Each contact event (n, 3): time in cycles, side 0 right or 1 left, onset 1 or release 0.
    """
    log = np.empty((4 * MOST_ONSETS * cycles, 3))
    moved, count = _turn(
        parameters, frequency_hz, acceleration, state, cycles, np.empty((4, 0)), _NONE, log
    )
    return log[:count], moved


def onsets(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[Float1D, Float1D, Float1D]:
    """(right, left: times in cycles at which contact begins; the state `cycles` later)."""
    seen, moved = events(parameters, frequency_hz, acceleration, state, cycles)
    right, left = (seen[(seen[:, 1] == side) & (seen[:, 2] == 1), 0] for side in (0, 1))
    return right, left, moved


@dataclass(frozen=True, slots=True, eq=False)
class Orbit:
    """A periodic motion: its state at a zero upcrossing of A, and its multipliers, largest first.

    It is stable where every multiplier is less than 1 in size.
    """

    frequency_hz: float
    state: Float1D
    multipliers: Complex1D
    u_max: float
    u_min: float

    @property
    def stable(self) -> bool:
        return bool(abs(self.multipliers[0]) < 1)


def periodic(
    parameters: Parameters, frequency_hz: float, acceleration: float, guess: Float1D
) -> Orbit | None:
    """The periodic motion that Newton finds from a guess, stable or not; None where it fails."""
    state = guess
    for _ in range(40):
        moved, jacobian = period_map(parameters, frequency_hz, acceleration, state)
        error = moved[:4] - state[:4]
        if not np.isfinite(error).all():
            return None
        if np.abs(error).max() < EXACT:
            break
        try:
            u, v, u_r, u_l = state[:4] - np.linalg.solve(jacobian - np.eye(4), error)
        except np.linalg.LinAlgError:
            return None
        right, left = bool(moved[CONTACT_R] > 0), bool(moved[CONTACT_L] > 0)
        state = restart(u, v, u_r, u_l, right, left, 0.0, parameters)
    else:
        return None
    multipliers = np.linalg.eigvals(jacobian).astype(np.complex128)
    multipliers = multipliers[np.argsort(-np.abs(multipliers))]
    cycle = stepped_sine(parameters, [frequency_hz], acceleration, 1, LEAST_STEPS, state)
    top, bottom = cycle.column("u_max")[0, 0], cycle.column("u_min")[0, 0]
    return Orbit(frequency_hz, state, multipliers, float(top), float(bottom))
