"""Compiled kernel of `closed_form`: table acceleration linear between samples."""

import math

from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_helper, jit_kernel
from twin.model.contact_regime import (
    BASE,
    C_L,
    C_R,
    CONTACT_R,
    G_L,
    G_R,
    IMPULSE_L,
    IMPULSE_R,
    K_L,
    K_R,
    MASS,
    MAX_EVENTS_PER_STEP,
    MODE_SIZE,
    MODES,
    R_R,
    STATE_SIZE,
    STEP,
    SUBSTEPS,
    U_L,
    U_R,
    U,
    V,
    advance_to_event,
    bumper_forces,
    contact_mode,
    flush_denormal,
    stays_positive,
    step_guard,
)  # fmt: skip
from twin.model.solver import OUTPUT_COUNT


@jit_helper()
def add_impulses(
    state: Float1D, params: Float1D, mode: int, t: float, du: float, dv: float, base: float
) -> None:
    """Add the impulses of F_R, F_L over t s of contact, exact by momentum; `base` is the mean A."""
    b = MODES + mode * MODE_SIZE
    integral_u = (params[b + 2] * t - params[MASS] * (dv + base * t) - params[b + 1] * du) / params[
        b
    ]
    if mode & 1:
        state[IMPULSE_R] += params[C_R] * du + params[K_R] * (integral_u - params[G_R] * t)
    if mode & 2:
        state[IMPULSE_L] += params[C_L] * du + params[K_L] * (integral_u + params[G_L] * t)


@jit_helper()
def record_event(
    state: Float1D, params: Float1D, t: float, side: int, events: Float2D, count: int
) -> int:
    """Write the event at `state` into row `count` of `events` if it fits; return the new count."""
    sign, onset = 1.0 - 2.0 * side, state[CONTACT_R + side]
    if count < events.shape[0]:
        closing_speed = sign * (state[V] + params[R_R + side] * state[U_R + side])
        events[count, 0], events[count, 1], events[count, 2] = t, sign, onset
        events[count, 3], events[count, 4] = closing_speed * onset, state[IMPULSE_R + side]
    state[IMPULSE_R + side] = 0.0
    return count + 1


@jit_helper()
def advance_through_events(
    state: Float1D, params: Float1D, start: float, slope: float, events: Float2D, count: int
) -> int:
    """Advance `state` over a step and its events, A = state[BASE] + slope t; return the count."""
    h, t = params[STEP], 0.0
    for attempt in range(MAX_EVENTS_PER_STEP):
        u, v, base = state[U], state[V], state[BASE] + slope * t
        mode = contact_mode(state)
        search = attempt + 1 < MAX_EVENTS_PER_STEP
        dt, side, _, _, _ = advance_to_event(
            state, params, h - t, base, slope, (0.0, 0.0, 0.0), search
        )
        t += dt
        if mode:
            mean_acc = base + 0.5 * slope * dt
            add_impulses(state, params, mode, dt, state[U] - u, state[V] - v, mean_acc)
        if side < 0:
            break
        count = record_event(state, params, start + t, side, events, count)
    if not abs(state[U]) + abs(state[U_R]) + abs(state[U_L]) < math.inf:
        state[:] = math.nan
    return count


# One signature, so that slices and read-only arrays of Blocks need no further compilation.
_READ = types.Array(float64, 1, "A", readonly=True)
_WRITE = types.Array(float64, 2, "A")


@jit_kernel(int64(float64[::1], _READ, _READ, _WRITE, _WRITE), cache=True)
def advance_samples(
    state: Float1D, params: Float1D, base_acc: Float1D, out: Float2D, events: Float2D,
) -> int:  # fmt: skip
    """Advance `state` through the samples of A in m/s2, (n,), linear between; return the events.

    out (7, n), events (m, 5) and their number as in `closed_form.advance_state_logged`. A step
    whose guards may have turned negative (or are NaN) is repeated in `advance_through_events`.
    """
    if state.size < STATE_SIZE or out.shape[0] < OUTPUT_COUNT or out.shape[1] < base_acc.size:
        raise ValueError("state or out is too small for these samples; see advance_state")
    h, substeps, mass, count = params[STEP], int(params[SUBSTEPS]), params[MASS], 0
    u, v, ur, ul, base = state[U], state[V], state[U_R], state[U_L], state[BASE]
    mode = contact_mode(state)
    for i in range(base_acc.size * substeps):
        sample, substep = i // substeps, i % substeps
        slope = (base_acc[sample] - base) / (h * (substeps - substep))
        next_base = base + slope * h if substep + 1 < substeps else base_acc[sample]
        b = MODES + mode * MODE_SIZE
        k, c, f0 = params[b], params[b + 1], params[b + 2]
        q1 = -mass * slope / k
        q0 = (f0 - mass * base - c * q1) / k
        y, z = u - q0, v - q1
        u1 = q0 + q1 * h + params[b + 5] * y + params[b + 6] * z
        v1 = q1 + params[b + 7] * y + params[b + 8] * z
        d0 = (f0 - c * v - k * u) / mass - base
        d1 = (f0 - c * v1 - k * u1) / mass - next_base
        x0, x1 = (u, v, d0), (u1, v1, d1)
        ur1, r0, r1, rs0, rs1 = step_guard(params, mode, 0, x0, x1, ur)
        ul1, l0, l1, ls0, ls1 = step_guard(params, mode, 1, x0, x1, ul)
        if stays_positive(h, r0, r1, rs0, rs1) and stays_positive(h, l0, l1, ls0, ls1):
            if mode:
                add_impulses(state, params, mode, h, u1 - u, v1 - v, 0.5 * (base + next_base))
            u, v, ur, ul = u1, v1, flush_denormal(ur1), flush_denormal(ul1)
        else:
            state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
            count = advance_through_events(state, params, i * h, slope, events, count)
            u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
            mode = contact_mode(state)
            next_base += state[BASE] - base  # propagates NaN
        base = next_base
        if substep + 1 == substeps:
            b = MODES + mode * MODE_SIZE
            out[0, sample], out[1, sample] = u, v
            out[2, sample] = (params[b + 2] - params[b + 1] * v - params[b] * u) / mass
            flight_force = state[BASE] - state[BASE]  # 0, or NaN once the state is NaN
            out[3, sample], out[4, sample] = bumper_forces(params, mode, v, ur, ul, flight_force)
            out[5, sample], out[6, sample] = ur, ul
    state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
    return count
