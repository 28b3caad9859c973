"""The kernel of the sampled driver: table acceleration linear between samples."""

import math

from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from twin.model.compiled import compiled, inner
from twin.model.phase import (
    BASE,
    C_L,
    C_R,
    CONTACT_L,
    CONTACT_R,
    DENORMAL,
    E_L,
    E_R,
    G_L,
    G_R,
    IMPULSE_L,
    IMPULSE_R,
    K_L,
    K_R,
    MASS,
    MODE_SIZE,
    MODES,
    MOST_EVENTS,
    R_L,
    R_R,
    REVISION,
    STATE_SIZE,
    STEP,
    SUBSTEPS,
    U_L,
    U_R,
    U,
    V,
    leap,
)  # fmt: skip
from twin.model.solver import OUTPUTS


@inner()
def impulses(
    state: Float1D, con: Float1D, mode: int, t: float, du: float, dv: float, base: float
) -> None:
    """Adds the integrals of F_R, F_L over t s of contact, `base` the mean A; exact by momentum."""
    b = MODES + mode * MODE_SIZE
    area = (con[b + 2] * t - con[MASS] * (dv + base * t) - con[b + 1] * du) / con[b]
    if mode & 1:
        state[IMPULSE_R] += con[C_R] * du + con[K_R] * (area - con[G_R] * t)
    if mode & 2:
        state[IMPULSE_L] += con[C_L] * du + con[K_L] * (area + con[G_L] * t)


@inner()
def record(state: Float1D, con: Float1D, t: float, side: int, log: Float2D, count: int) -> int:
    """Writes the event at `state` into row `count` of `log` if there is one; the new count."""
    right, onset = 1.0 - 2.0 * side, state[CONTACT_R + side]
    if count < log.shape[0]:
        closing = right * (state[V] + con[R_R + side] * state[U_R + side])
        log[count, 0], log[count, 1], log[count, 2] = t, right, onset
        log[count, 3], log[count, 4] = closing * onset, state[IMPULSE_R + side]
    state[IMPULSE_R + side] = 0.0
    return count + 1


@inner()
def eventful(
    state: Float1D, con: Float1D, start: float, slope: float, log: Float2D, count: int
) -> int:
    """Moves `state` over a step through any events, A = state[BASE] + slope t; their new count."""
    h, t = con[STEP], 0.0
    for attempt in range(MOST_EVENTS):
        u, v, base = state[U], state[V], state[BASE] + slope * t
        mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
        search = attempt + 1 < MOST_EVENTS
        dt, side, _, _, _ = leap(state, con, h - t, base, slope, (0.0, 0.0, 0.0), search)
        t += dt
        if mode:
            mean = base + 0.5 * slope * dt
            impulses(state, con, mode, dt, state[U] - u, state[V] - v, mean)
        if side < 0:
            break
        count = record(state, con, start + t, side, log, count)
    if not abs(state[U]) + abs(state[U_R]) + abs(state[U_L]) < math.inf:
        state[:] = math.nan
    return count


# One signature, so that slices and read-only arrays of Blocks need no further compilation.
_READ = types.Array(float64, 1, "A", readonly=True)
_WRITE = types.Array(float64, 2, "A")


@compiled(int64(float64[::1], _READ, _READ, _WRITE, _WRITE, types.Omitted(REVISION)), cache=True)
def march(  # noqa: PLR0915
    state: Float1D, con: Float1D, base_acc: Float1D, out: Float2D, log: Float2D,
    revision: int = REVISION,
) -> int:  # fmt: skip
    """Moves `state` through the samples of A in m/s2, (n,), linear in between; number of events.

    out (7, n) and log (m, 5) as in `exact.advance_logged`. A step whose guards may have turned
    negative (or are NaN) is done again in `eventful`: within a substep a guard's slope s turns at
    most once, so only from - to + can it hide a minimum, and not if the guard g begins high enough.
    """
    if state.size < STATE_SIZE or out.shape[0] < OUTPUTS or out.shape[1] < base_acc.size:
        raise ValueError("state or out is too small for these samples; see exact.advance")
    h, parts, mass, count = con[STEP], int(con[SUBSTEPS]), con[MASS], 0
    u, v, ur, ul, base = state[U], state[V], state[U_R], state[U_L], state[BASE]
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    for i in range(base_acc.size * parts):
        sample, part = i // parts, i % parts
        slope = (base_acc[sample] - base) / (h * (parts - part))
        next_base = base + slope * h if part + 1 < parts else base_acc[sample]
        b = MODES + mode * MODE_SIZE
        k, c, f0 = con[b], con[b + 1], con[b + 2]
        q1 = -mass * slope / k
        q0 = (f0 - mass * base - c * q1) / k
        y, z = u - q0, v - q1
        u1 = q0 + q1 * h + con[b + 5] * y + con[b + 6] * z
        v1 = q1 + con[b + 7] * y + con[b + 8] * z
        d0 = (f0 - c * v - k * u) / mass - base
        d1 = (f0 - c * v1 - k * u1) / mass - next_base
        if mode & 1:
            ur1 = u1 - con[G_R]
            g0, g1 = con[C_R] * v + con[K_R] * ur, con[C_R] * v1 + con[K_R] * ur1
            s0, s1 = con[C_R] * d0 + con[K_R] * v, con[C_R] * d1 + con[K_R] * v1
        else:
            ur1 = ur * con[E_R]
            g0, g1 = con[G_R] + ur - u, con[G_R] + ur1 - u1
            s0, s1 = -con[R_R] * ur - v, -con[R_R] * ur1 - v1
        calm = g1 >= 0 and (s0 >= 0 or s1 <= 0 or g0 > -2 * h * s0)
        if mode & 2:
            ul1 = u1 + con[G_L]
            g0, g1 = -con[C_L] * v - con[K_L] * ul, -con[C_L] * v1 - con[K_L] * ul1
            s0, s1 = -con[C_L] * d0 - con[K_L] * v, -con[C_L] * d1 - con[K_L] * v1
        else:
            ul1 = ul * con[E_L]
            g0, g1 = con[G_L] + u - ul, con[G_L] + u1 - ul1
            s0, s1 = v + con[R_L] * ul, v1 + con[R_L] * ul1
        if calm and g1 >= 0 and (s0 >= 0 or s1 <= 0 or g0 > -2 * h * s0):
            if mode:
                impulses(state, con, mode, h, u1 - u, v1 - v, 0.5 * (base + next_base))
            u, v = u1, v1
            ur, ul = ur1 if abs(ur1) > DENORMAL else 0.0, ul1 if abs(ul1) > DENORMAL else 0.0
        else:
            state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
            count = eventful(state, con, i * h, slope, log, count)
            u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
            mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
            next_base += state[BASE] - base  # NaN stays
        base = next_base
        if part + 1 == parts:
            b = MODES + mode * MODE_SIZE
            out[0, sample], out[1, sample] = u, v
            out[2, sample] = (con[b + 2] - con[b + 1] * v - con[b] * u) / mass
            idle = state[BASE] - state[BASE]  # the force in flight: 0, or NaN once all is
            out[3, sample] = max(0.0, con[C_R] * v + con[K_R] * ur) if mode & 1 else idle
            out[4, sample] = min(0.0, con[C_L] * v + con[K_L] * ul) if mode & 2 else idle
            out[5, sample], out[6, sample] = ur, ul
    state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
    return count
