"""The kernel of the stepped-sine driver: whole cycles of A = peak sin(w t) at each frequency."""

import math

import numpy as np
import numpy.typing as npt
from numba import float64, int64, types

from table_io.block import Float1D, Float2D, Int1D
from twin.model.compiled import compiled, inner
from twin.model.phase import (
    C_L,
    C_R,
    CONTACT_L,
    CONTACT_R,
    DENORMAL,
    E_L,
    E_R,
    G_L,
    G_R,
    K_L,
    K_R,
    MASS,
    MODE_SIZE,
    MODES,
    MOST_EVENTS,
    R_L,
    R_R,
    REVISION,
    U_L,
    U_R,
    Motion,
    Point,
    Quantity,
    U,
    V,
    flow,
    guard,
    leap,
    motion,
    motion_at,
    root,
    value,
)  # fmt: skip

Float3D = npt.NDArray[np.float64]


@inner()
def summit(h: float, m: Motion, q: Quantity, slope0: float, slope1: float) -> float:
    """Value of q where its slope changes sign within a phase of h s; the slopes at both ends."""
    t = root(0.0, h, h * slope0 / (slope0 - slope1), slope1, m, q, 1)
    return value(t, motion_at(t, m), q)[0]


@inner()
def span(h: float, m: Motion, q: Quantity, x0: Point, x1: Point) -> tuple[float, float]:
    """(least, greatest) q over a phase of h s, from the root of its slope; x at both ends."""
    a, da, _ = value(0.0, x0, q)
    b, db, _ = value(h, x1, q)
    lo, hi = min(a, b), max(a, b)
    if da * db < 0:
        a = summit(h, m, q, da, db)
        lo, hi = min(a, lo), max(a, hi)
    return lo, hi


@inner()
def total(con: Float1D, mode: int) -> Quantity:
    """Total acceleration in m/s2: (f0 - k u - c u')/M."""
    b, mass = MODES + mode * MODE_SIZE, con[MASS]
    return con[b + 2] / mass, -con[b] / mass, -con[b + 1] / mass, 0.0, 0.0


@inner()
def widen(
    extremes: Float1D, con: Float1D, mode: int, h: float, m: Motion, x0: Point, x1: Point
) -> None:
    """Widens `extremes` (`EXTREMES`) by a phase of h s."""
    lo, hi = span(h, m, (0.0, 1.0, 0.0, 0.0, 0.0), x0, x1)
    extremes[0], extremes[1] = max(extremes[0], hi), min(extremes[1], lo)
    lo, hi = span(h, m, total(con, mode), x0, x1)
    extremes[2], extremes[3] = max(extremes[2], hi), min(extremes[3], lo)
    if mode & 1:
        extremes[4] = max(extremes[4], span(h, m, guard(con, mode, 0, 0.0), x0, x1)[1])
    if mode & 2:
        extremes[5] = min(extremes[5], -span(h, m, guard(con, mode, 1, 0.0), x0, x1)[1])


@inner()
def eventful(
    state: Float1D, con: Float1D, h: float, peak: float, w: float, phase: float, row: Float1D
) -> None:
    """Moves `state` over a step through any events, and widens `row` by what happens in it."""
    t = 0.0
    for attempt in range(MOST_EVENTS):
        mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
        search = attempt + 1 < MOST_EVENTS
        dt, side, m, x0, x1 = leap(state, con, h - t, 0.0, 0.0, (peak, w, phase + w * t), search)
        widen(row, con, mode, dt, m, x0, x1)
        t += dt
        if side < 0:
            break
        row[6 + side] += state[CONTACT_R + side]


@inner()
def tune(
    con: Float1D, table: Float2D, particular: Float2D, peak: float, w: float, steps: int
) -> None:
    """What one frequency needs: flows over a step, the sine by phase, particular solutions.

    particular (4 modes, 3): u = q0 + alpha sin + beta cos, re = k - M w^2, im = c w,
    alpha = -M peak re / (re^2 + im^2), beta = +M peak im / (re^2 + im^2).
    """
    turn = 2 * math.pi / steps
    h = turn / w
    for k in range(steps + 1):
        table[0, k], table[1, k] = math.sin(turn * k), math.cos(turn * k)
    con[E_R], con[E_L] = math.exp(-con[R_R] * h), math.exp(-con[R_L] * h)
    for mode in range(4):
        b, mass = MODES + mode * MODE_SIZE, con[MASS]
        con[b + 5], con[b + 6], con[b + 7], con[b + 8] = flow(h, con[b + 3], con[b + 4])
        re, im = con[b] - mass * w * w, con[b + 1] * w
        scale = mass * peak / (re * re + im * im)
        particular[mode, 0] = con[b + 2] / con[b]
        particular[mode, 1], particular[mode, 2] = -re * scale, im * scale


@inner()
def begin(row: Float1D, state: Float1D, con: Float1D) -> None:
    """The extremes of a cycle before its first step: where it starts."""
    u, v, mode = state[U], state[V], int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    b = MODES + mode * MODE_SIZE
    row[0] = row[1] = u
    row[2] = row[3] = (con[b + 2] - con[b + 1] * v - con[b] * u) / con[MASS]
    row[4] = max(0.0, con[C_R] * v + con[K_R] * state[U_R]) if mode & 1 else 0.0
    row[5] = min(0.0, con[C_L] * v + con[K_L] * state[U_L]) if mode & 2 else 0.0
    row[6] = row[7] = 0.0


@inner()
def cycle_of(
    state: Float1D, con: Float1D, table: Float2D, particular: Float2D,
    peak: float, w: float, steps: int, row: Float1D,
) -> None:  # fmt: skip
    """Moves `state` through one cycle in `steps` steps; row (8,) becomes its `EXTREMES`.

    A step whose guards r, l (slopes rs, ls) may have turned negative is done again in `eventful`;
    the screen is that of `sampled.march`. Else a quantity has its extreme at an end of the step, or
    where its slope changes sign, and only there is a root sought.
    """
    h, turn, mass = 2 * math.pi / (w * steps), 2 * math.pi / steps, con[MASS]
    begin(row, state, con)
    u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    for i in range(steps):
        b = MODES + mode * MODE_SIZE
        k, c, f0 = con[b], con[b + 1], con[b + 2]
        q0, alpha, beta = particular[mode, 0], particular[mode, 1], particular[mode, 2]
        s0, c0, s1, c1 = table[0, i], table[1, i], table[0, i + 1], table[1, i + 1]
        y, z = u - q0 - alpha * s0 - beta * c0, v - w * (alpha * c0 - beta * s0)
        u1 = q0 + alpha * s1 + beta * c1 + con[b + 5] * y + con[b + 6] * z
        v1 = w * (alpha * c1 - beta * s1) + con[b + 7] * y + con[b + 8] * z
        a1 = (f0 - c * v1 - k * u1) / mass
        d0, d1 = (f0 - c * v - k * u) / mass - peak * s0, a1 - peak * s1
        if mode & 1:
            ur1 = u1 - con[G_R]
            r0, r1 = con[C_R] * v + con[K_R] * ur, con[C_R] * v1 + con[K_R] * ur1
            rs0, rs1 = con[C_R] * d0 + con[K_R] * v, con[C_R] * d1 + con[K_R] * v1
        else:
            ur1 = ur * con[E_R]
            r0, r1 = con[G_R] + ur - u, con[G_R] + ur1 - u1
            rs0, rs1 = -con[R_R] * ur - v, -con[R_R] * ur1 - v1
        if mode & 2:
            ul1 = u1 + con[G_L]
            l0, l1 = -con[C_L] * v - con[K_L] * ul, -con[C_L] * v1 - con[K_L] * ul1
            ls0, ls1 = -con[C_L] * d0 - con[K_L] * v, -con[C_L] * d1 - con[K_L] * v1
        else:
            ul1 = ul * con[E_L]
            l0, l1 = con[G_L] + u - ul, con[G_L] + u1 - ul1
            ls0, ls1 = v + con[R_L] * ul, v1 + con[R_L] * ul1
        calm = r1 >= 0 and (rs0 >= 0 or rs1 <= 0 or r0 > -2 * h * rs0)
        if calm and l1 >= 0 and (ls0 >= 0 or ls1 <= 0 or l0 > -2 * h * ls0):
            row[0], row[1] = max(row[0], u1), min(row[1], u1)
            row[2], row[3] = max(row[2], a1), min(row[3], a1)
            row[4] = max(row[4], r1) if mode & 1 else row[4]
            row[5] = min(row[5], -l1) if mode & 2 else row[5]
            bent = v * v1 < 0 or (c * d0 + k * v) * (c * d1 + k * v1) < 0
            if bent or (mode & 1) * rs0 > 0 > rs1 or (mode & 2) * ls0 > 0 > ls1:
                m, x0 = motion(con, mode, u, v, 0.0, 0.0, (peak, w, turn * i))
                widen(row, con, mode, h, m, x0, motion_at(h, m))
            u, v = u1, v1
            ur, ul = ur1 if abs(ur1) > DENORMAL else 0.0, ul1 if abs(ul1) > DENORMAL else 0.0
        else:
            state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul
            eventful(state, con, h, peak, w, turn * i, row)
            u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
            mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul


@compiled(
    types.void(
        float64[::1], float64[::1], float64[::1], float64[::1], int64, int64[::1],
        float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1],
        types.Omitted(REVISION),
    ),
    cache=True,
)  # fmt: skip
def stepped(
    state: Float1D, con: Float1D, w: Float1D, peaks: Float1D, cycles: int, steps: Int1D,
    table: Float2D, particular: Float2D, extremes: Float3D, ends: Float2D, revision: int = REVISION,
) -> None:  # fmt: skip
    """Whole cycles of A = peak sin(w t) at each w in 1/s, `steps` steps a cycle, carried through.

    table (2, most steps + 1) and particular (4, 3) are room to work in, `con` is retuned for each
    w. extremes (w, cycle, 8), `EXTREMES`; ends (w, STATE_SIZE): the state after each w.
    """
    for i in range(w.size):
        if i == 0 or w[i] != w[i - 1] or peaks[i] != peaks[i - 1] or steps[i] != steps[i - 1]:
            tune(con, table, particular, peaks[i], w[i], steps[i])
        for cycle in range(cycles):
            row = extremes[i, cycle]
            cycle_of(state, con, table, particular, peaks[i], w[i], steps[i], row)
        # Entry by entry: to copy a row numba compiles an error message for unequal lengths.
        for place in range(state.size):
            ends[i, place] = state[place]
