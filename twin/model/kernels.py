"""Closed-form motion of the SNM, compiled: all numba functions of the room, since numba's cache does
not notice a change in another file.

    M u'' + C u' + K u + F_R + F_L = -M A(t)
    contact: F_j = C_j u_j' + K_j u_j, u_R = u - G0R, u_L = u + G0L;   flight: F_j = 0, u_j relaxes

SI, right positive, F_R >= 0, F_L <= 0. Source: Stefani, De Angelis, Andreaus, Sect. 5; the linear
oscillator. In each mode = contact_r + 2 contact_l it is M u'' + c u' + k u = -M A + f0, linear, so
only event times need a root. A guard is a quantity that stays positive until an event.
"""

import math
from collections.abc import Callable
from typing import Any, TypeVar

from numba import float64, int64, njit, types

from table_io.block import Float1D, Float2D, Int1D

Wave = tuple[float, float, float]  # peak in m/s2, angular frequency in 1/s, phase of a sinusoid
Motion = tuple[float, float, float, float, float, float, Wave, float, float]  # made by `motion`
Point = tuple[float, float, float, float]  # u, u', u'', and the third derivative
Quantity = tuple[float, float, float, float, float]  # q = q0 + qu u + qv u' + qj exp(-r t)

# `state`
U, V, U_R, U_L, CONTACT_R, CONTACT_L, BASE, IMPULSE_R, IMPULSE_L, STATE_SIZE = range(10)
# `constants`: parameters, step in s, its parts, bumper relaxation rates and factors over the step;
# then for each mode k, c, f0, a = c/2M, w2 = k/M and the flow matrix over the step, row by row.
MASS, K_R, K_L, C_R, C_L, G_R, G_L, STEP, SUBSTEPS, R_R, R_L, E_R, E_L, MODES = range(14)
MODE_SIZE = 9
CONSTANTS_SIZE = MODES + 4 * MODE_SIZE

TOUCH = 1e-14  # m: penetration below this is rounding
DENORMAL = 1e-30  # m: a bumper this near to relaxed is relaxed
MOST_EVENTS = 40  # in one step; only rounding at a graze can come near it

F = TypeVar("F", bound=Callable[..., Any])


def compiled(*signature: Any) -> Callable[[F], F]:
    """numba.njit as this room uses it, with types that survive it."""
    decorator: Callable[[F], F] = njit(*signature, cache=True, nogil=True)
    return decorator


@compiled()
def flow(t: float, a: float, w2: float) -> tuple[float, float, float, float]:
    """Matrix over t s that takes (y, y') of y'' + 2 a y' + w2 y = 0 onwards, row by row.

    Under-, over- and critically damped; the series bridges the limit where both forms cancel.
    """
    x = (w2 - a * a) * t * t
    if x > 1e-4:
        w = math.sqrt(w2 - a * a)
        e = math.exp(-a * t)
        c, s = e * math.cos(w * t), e * math.sin(w * t) / w
    elif x < -1e-4:
        w = math.sqrt(a * a - w2)
        slow, fast = math.exp(-w2 / (a + w) * t), math.exp(-(a + w) * t)
        c, s = 0.5 * (slow + fast), 0.5 * (slow - fast) / w
    else:
        e = math.exp(-a * t)
        c, s = e * (1 - x / 2 + x * x / 24), e * t * (1 - x / 6 + x * x / 120)
    return c + a * s, s, -w2 * s, c - a * s


@compiled()
def motion(
    con: Float1D, mode: int, u: float, v: float, base: float, slope: float, wave: Wave
) -> Motion:
    """The solution of one mode from (u, v) at t = 0 under A = base + slope t + wave, m/s2.

    Particular part q0 + q1 t + alpha sin + beta cos, homogeneous part from (y, z).
    """
    b = MODES + mode * MODE_SIZE
    mass, k, c, a, w2 = con[MASS], con[b], con[b + 1], con[b + 3], con[b + 4]
    q1 = -mass * slope / k
    q0 = (con[b + 2] - mass * base - c * q1) / k
    peak, w, phase = wave
    if peak == 0.0:
        return a, w2, u - q0, v - q1, q0, q1, wave, 0.0, 0.0
    re, im = k - mass * w * w, c * w
    scale = mass * peak / (re * re + im * im)
    alpha, beta = -re * scale, im * scale
    s, co = math.sin(phase), math.cos(phase)
    y, z = u - q0 - alpha * s - beta * co, v - q1 - w * (alpha * co - beta * s)
    return a, w2, y, z, q0, q1, wave, alpha, beta


@compiled()
def motion_at(t: float, m: Motion) -> Point:
    """(u, u', u'', third derivative) of a motion at t s."""
    a, w2, y0, z0, q0, q1, (peak, w, phase), alpha, beta = m
    e11, e12, e21, e22 = flow(t, a, w2)
    y, z = e11 * y0 + e12 * z0, e21 * y0 + e22 * z0
    d = -2 * a * z - w2 * y
    u, v, j = q0 + q1 * t + y, q1 + z, -2 * a * d - w2 * z
    if peak != 0.0:
        s, c = math.sin(phase + w * t), math.cos(phase + w * t)
        p, pv = alpha * s + beta * c, w * (alpha * c - beta * s)
        u, v, d, j = u + p, v + pv, d - w * w * p, j - w * w * pv
    return u, v, d, j


@compiled()
def value(t: float, x: Point, q: Quantity) -> tuple[float, float, float]:
    """(q, q', q'') at t s, where the motion is at x."""
    u, v, d, j = x
    q0, qu, qv, qj, r = q
    e = qj * math.exp(-r * t) if qj != 0.0 else 0.0
    return q0 + qu * u + qv * v + e, qu * v + qv * d - r * e, qu * d + qv * j + r * r * e


@compiled()
def guard(con: Float1D, mode: int, side: int, uj: float) -> Quantity:
    """Clearance in m (flight) or push in N (contact) of side 0 = right, 1 = left."""
    k, c, gap = con[K_R + side], con[C_R + side], con[G_R + side]
    right = 1.0 - 2.0 * side
    if (mode >> side) & 1:
        return -k * gap, right * k, right * c, 0.0, 0.0
    return gap, -right, 0.0, right * uj, con[R_R + side]


@compiled()
def root(lo: float, hi: float, m: Motion, q: Quantity, order: int) -> float:
    """Time in s at which q (order 0) or q' (order 1) changes sign between lo and hi.

    Newton kept in the bracket. It starts from hi, so that a zero at lo which is only the start of
    a phase is not found again.
    """
    values = value(hi, motion_at(hi, m), q)
    f, df = values[order], values[order + 1]
    sign = math.copysign(1.0, f)
    t = hi
    for _ in range(80):
        new = t - f / df if df != 0.0 else lo
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
        moved = abs(new - t)
        t = new
        if moved <= 1e-10 * hi:
            break
        values = value(t, motion_at(t, m), q)
        f, df = values[order], values[order + 1]
        if f * sign > 0:
            hi = t
        else:
            lo = t
    return t


@compiled()
def crossing(h: float, m: Motion, q: Quantity, x0: Point, x1: Point) -> float:
    """First time in s in [0, h] at which the guard q turns negative, inf if none; x at both ends."""
    g0, d0, _ = value(0.0, x0, q)
    g1, d1, _ = value(h, x1, q)
    touch = TOUCH * abs(q[1])
    hi = h
    if not (g1 < -touch or (g1 < 0 and d1 < 0)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        hi = root(0.0, h, m, q, 1)
        if not value(hi, motion_at(hi, m), q)[0] < -touch:
            return math.inf
    if g0 > 0:
        return root(0.0, hi, m, q, 0)
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(60):
        lo *= 0.5
        if value(lo, motion_at(lo, m), q)[0] > touch:
            return root(lo, 2 * lo, m, q, 0)
    return 0.0


@compiled()
def span(h: float, m: Motion, q: Quantity, x0: Point, x1: Point) -> tuple[float, float]:
    """(least, greatest) q over a phase of h s, from the root of its slope; x at both ends."""
    a, da, _ = value(0.0, x0, q)
    b, db, _ = value(h, x1, q)
    lo, hi = min(a, b), max(a, b)
    if da * db < 0:
        t = root(0.0, h, m, q, 1)
        a = value(t, motion_at(t, m), q)[0]
        lo, hi = min(a, lo), max(a, hi)
    return lo, hi


@compiled()
def widen(
    extremes: Float1D, con: Float1D, mode: int, h: float, m: Motion, x0: Point, x1: Point
) -> None:
    """Widens `extremes` (layout in `stepped`) by a phase of h s."""
    b = MODES + mode * MODE_SIZE
    mass = con[MASS]
    lo, hi = span(h, m, (0.0, 1.0, 0.0, 0.0, 0.0), x0, x1)
    extremes[0], extremes[1] = max(extremes[0], hi), min(extremes[1], lo)
    total = (con[b + 2] / mass, -con[b] / mass, -con[b + 1] / mass, 0.0, 0.0)
    lo, hi = span(h, m, total, x0, x1)
    extremes[2], extremes[3] = max(extremes[2], hi), min(extremes[3], lo)
    if mode & 1:
        extremes[4] = max(extremes[4], span(h, m, guard(con, mode, 0, 0.0), x0, x1)[1])
    if mode & 2:
        extremes[5] = min(extremes[5], -span(h, m, guard(con, mode, 1, 0.0), x0, x1)[1])


@compiled()
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


@compiled()
def record(
    state: Float1D, con: Float1D, t: float, side: int, onset: int, log: Float2D, count: int
) -> int:
    """Writes the event at `state` into row `count` of `log` if there is one; the new count."""
    right = 1.0 - 2.0 * side
    if count < log.shape[0]:
        closing = right * (state[V] + con[R_R + side] * state[U_R + side])
        log[count, 0], log[count, 1], log[count, 2] = t, right, onset
        log[count, 3], log[count, 4] = closing * onset, state[IMPULSE_R + side]
    state[IMPULSE_R + side] = 0.0
    return count + 1


@compiled()
def eventful(
    state: Float1D, con: Float1D, start: float, h: float, slope: float, wave: Wave,
    log: Float2D, count: int, extremes: Float1D,
) -> int:  # fmt: skip
    """Moves `state` over h s through any events under A = state[BASE] + slope t + wave.

    Logs events from row `count` on and returns their new count; widens `extremes` if not empty.
    """
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    t = 0.0
    for attempt in range(MOST_EVENTS):
        base = state[BASE] + slope * t
        now = (wave[0], wave[1], wave[2] + wave[1] * t)
        m = motion(con, mode, state[U], state[V], base, slope, now)
        x0, x1 = motion_at(0.0, m), motion_at(h - t, m)
        dt, side = h - t, -1
        for s in range(2 if attempt + 1 < MOST_EVENTS else 0):
            found = crossing(h - t, m, guard(con, mode, s, state[U_R + s]), x0, x1)
            if found < dt or (side < 0 and found == dt):
                dt, side = found, s
        if side >= 0:
            x1 = motion_at(dt, m)
        if extremes.size:
            widen(extremes, con, mode, dt, m, x0, x1)
        elif mode:
            mean = base + 0.5 * slope * dt
            impulses(state, con, mode, dt, x1[0] - state[U], x1[1] - state[V], mean)
        state[U], state[V] = x1[0], x1[1]
        for s in range(2):
            # In contact u_j follows the mass, recomputed from it, so nothing drifts.
            if (mode >> s) & 1 or side == s:
                state[U_R + s] = x1[0] - (1.0 - 2.0 * s) * con[G_R + s]
            else:
                state[U_R + s] *= math.exp(-con[R_R + s] * dt)
                if abs(state[U_R + s]) < DENORMAL:
                    state[U_R + s] = 0.0
        t += dt
        if side < 0:
            break
        mode ^= 1 << side
        onset = (mode >> side) & 1
        state[CONTACT_R + side] = onset
        if extremes.size:
            extremes[6 + side] += onset
        count = record(state, con, start + t, side, onset, log, count)
    return count


@compiled()
def calm(con: Float1D, mode: int, side: int, x0: Point, uj0: float, x1: Point, uj1: float) -> bool:
    """True if the guard of a side surely stays positive over one step between x0 and x1.

    Within a substep its slope turns at most once, so only a slope from - to + can hide a minimum,
    and then not if the guard begins high enough. NaN is not calm.
    """
    g0, d0, _ = value(0.0, x0, guard(con, mode, side, uj0))
    g1, d1, _ = value(0.0, x1, guard(con, mode, side, uj1))
    return g1 >= 0 and (d0 >= 0 or d1 <= 0 or g0 > -2 * con[STEP] * d0)


# One signature, so that slices and read-only arrays of Blocks need no further compilation.
_READ = types.Array(float64, 1, "A", readonly=True)
_WRITE = types.Array(float64, 2, "A")


@compiled(int64(float64[::1], _READ, _READ, _WRITE, _WRITE))
def march(state: Float1D, con: Float1D, base_acc: Float1D, out: Float2D, log: Float2D) -> int:
    """Moves `state` through the samples of A in m/s2, (n,), linear in between; number of events.

    out (7, n) and log (m, 5) as in `exact.advance_logged`. Steps that are not calm are done again
    in `eventful`.
    """
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
        ur1 = u1 - con[G_R] if mode & 1 else ur * con[E_R]
        ul1 = u1 + con[G_L] if mode & 2 else ul * con[E_L]
        x0 = (u, v, (f0 - c * v - k * u) / mass - base, 0.0)
        x1 = (u1, v1, (f0 - c * v1 - k * u1) / mass - next_base, 0.0)
        if calm(con, mode, 0, x0, ur, x1, ur1) and calm(con, mode, 1, x0, ul, x1, ul1):
            if mode:
                impulses(state, con, mode, h, u1 - u, v1 - v, 0.5 * (base + next_base))
            u, v = u1, v1
            ur, ul = ur1 if abs(ur1) > DENORMAL else 0.0, ul1 if abs(ul1) > DENORMAL else 0.0
        else:
            state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
            count = eventful(
                state, con, i * h, h, slope, (0.0, 0.0, 0.0), log, count, state[STATE_SIZE:]
            )
            u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
            mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
        base = next_base
        if part + 1 == parts:
            b = MODES + mode * MODE_SIZE
            out[0, sample], out[1, sample] = u, v
            out[2, sample] = (con[b + 2] - con[b + 1] * v - con[b] * u) / mass
            out[3, sample] = max(0.0, con[C_R] * v + con[K_R] * ur) if mode & 1 else 0.0
            out[4, sample] = min(0.0, con[C_L] * v + con[K_L] * ul) if mode & 2 else 0.0
            out[5, sample], out[6, sample] = ur, ul
    state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
    return count


@compiled(types.void(float64[::1], _READ, _READ, _READ, int64, int64[::1],
                     types.Array(float64, 3, "C"), _WRITE, _WRITE))  # fmt: skip
def stepped(
    state: Float1D, con: Float1D, w: Float1D, peaks: Float1D, cycles: int, steps: Int1D,
    extremes: Float2D, ends: Float2D, log: Float2D,
) -> None:  # fmt: skip
    """Whole cycles of A = peak sin(w t) at each w in 1/s, `steps` steps a cycle, carried through.

    extremes (w, cycle, 8): greatest and least u and a, greatest F_R, least F_L, onsets on the right
    and on the left. ends (w, STATE_SIZE): the state after each w.
    """
    for i in range(w.size):
        turn = 2 * math.pi / steps[i]
        for cycle in range(cycles):
            row = extremes[i, cycle]
            row[0], row[1], row[2], row[3] = -math.inf, math.inf, -math.inf, math.inf
            row[4:] = 0.0
            for k in range(steps[i]):
                wave = (peaks[i], w[i], turn * k)
                eventful(state, con, 0.0, turn / w[i], 0.0, wave, log, 0, row)
        ends[i] = state
