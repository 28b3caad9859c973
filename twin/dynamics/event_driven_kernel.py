"""Compiled kernel of `event_driven_map`: whole periods of a periodic drive for many states."""

import math

from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_kernel
from twin.model.event_integrator_kernel import (
    CONTACT_L,
    CONTACT_R,
    DIRECTION,
    STATE_B_L,
    STATE_B_R,
    STATE_BASE,
    STATE_F,
    STATE_Z,
    U_L,
    U_R,
    U,
    V,
    advance_step,
    contact_force,
    read_states,
    set_start,
    write_states,
)  # fmt: skip
from twin.model.force_laws import (
    LAWS_TYPES,
    PLAIN_TYPES,
    AddedLaws,
    Coefficients,
    Motion,
    Start,
)

_KERNELS = [
    types.void(
        float64[:, ::1], coefficients, float64[:, ::1], laws, float64[::1], int64,
        float64[:, ::1], float64[:, ::1],
    )
    for coefficients, laws in (PLAIN_TYPES, LAWS_TYPES)
]  # fmt: skip


@jit_kernel(_KERNELS, cache=True)
def advance_periods(
    states: Float2D,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
    base_acc: Float1D,
    periods: int,
    events: Float2D,
    motion: Float2D,
) -> None:
    """Advance each row of states (m, STATE_SIZE) through whole periods of A in m/s2, (n,).

    The samples of A are those after the start of a period, A is linear between them, and
    periodic. events: as in `advance_step`, of all rows in turn, times from the start of the
    row. motion (7, n periods), unless empty: u, u', u'' + A, F_R, F_L, u_r and u_l of the
    last row. A row that becomes infinite is NaN.
    """
    for row in range(states.shape[0]):
        state = states[row]
        x = Motion(
            state[U], state[V], state[U_R], state[U_L],
            state[STATE_F], state[STATE_B_R], state[STATE_B_L], read_states(state, laws),
        )  # fmt: skip
        mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
        base = base_acc[-1]
        start = Start(x.u, state[STATE_Z], 0.0, 0.0, base, 0.0, mode, state[DIRECTION])
        for i in range(periods * base_acc.size):
            sample = base_acc[i % base_acc.size]
            acceleration = 0.0
            for substep in range(p.substeps):
                slope = (sample - base) / (p.step * (p.substeps - substep))
                x, start = set_start(x, start, p, 0.0, base, slope)
                events[-1, 1] = (i + substep / p.substeps) * p.period
                end, start = advance_step(p.step, x, start, p, propagators, laws, events)
                x, acceleration = end[0], end[1].v + start.base
                base = base + slope * p.step if substep + 1 < p.substeps else sample
            if motion.size:
                motion[0, i], motion[1, i], motion[2, i] = x.u, x.v, acceleration
                motion[3, i] = contact_force(x, start, p, 0, laws)
                motion[4, i] = contact_force(x, start, p, 1, laws)
                motion[5, i], motion[6, i] = x.u_r, x.u_l
            if not math.isfinite(x.u):
                break
        state[U], state[V], state[U_R], state[U_L] = x.u, x.v, x.u_r, x.u_l
        state[STATE_F], state[STATE_B_R], state[STATE_B_L] = x.f, x.b_r, x.b_l
        state[CONTACT_R], state[CONTACT_L] = float(start.mode & 1), float(start.mode >> 1)
        state[STATE_BASE], state[STATE_Z], state[DIRECTION] = base, start.z, start.direction
        write_states(state, x.s)
        if not math.isfinite(x.u):
            state[:] = math.nan
