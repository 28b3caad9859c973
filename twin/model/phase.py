"""One phase of the SNM in closed form, compiled, and the first event that ends it.

    M u'' + C u' + K u + F_R + F_L = -M A(t)
    contact: F_j = C_j u_j' + K_j u_j, u_R = u - G0R, u_L = u + G0L;   flight: F_j = 0, u_j relaxes

SI, right positive, F_R >= 0, F_L <= 0. Source: Stefani, De Angelis, Andreaus, Sect. 5; the linear
oscillator. In each mode = contact_r + 2 contact_l it is M u'' + c u' + k u = -M A + f0, linear, so
only event times need a root. A guard is a quantity that stays positive until an event.
"""

import math

from table_io.block import Float1D
from twin.model.compiled import inner, revision

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


@inner()
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


@inner()
def motion(
    con: Float1D, mode: int, u: float, v: float, base: float, slope: float, wave: Wave
) -> tuple[Motion, Point]:
    """The solution of one mode under A = base + slope t + wave in m/s2, and its first point.

    Particular part q0 + q1 t + alpha sin + beta cos, homogeneous part from (y, z).
    """
    b = MODES + mode * MODE_SIZE
    mass, k, c, a, w2 = con[MASS], con[b], con[b + 1], con[b + 3], con[b + 4]
    q1 = -mass * slope / k
    q0 = (con[b + 2] - mass * base - c * q1) / k
    peak, w, phase = wave
    if peak == 0.0:
        y, z = u - q0, v - q1
        d = -2 * a * z - w2 * y
        return (a, w2, y, z, q0, q1, wave, 0.0, 0.0), (u, v, d, -2 * a * d - w2 * z)
    re, im = k - mass * w * w, c * w
    scale = mass * peak / (re * re + im * im)
    alpha, beta = -re * scale, im * scale
    s, co = math.sin(phase), math.cos(phase)
    p, pv = alpha * s + beta * co, w * (alpha * co - beta * s)
    y, z = u - q0 - p, v - q1 - pv
    d = -2 * a * z - w2 * y
    start = (u, v, d - w * w * p, -2 * a * d - w2 * z - w * w * pv)
    return (a, w2, y, z, q0, q1, wave, alpha, beta), start


@inner()
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


@inner()
def value(t: float, x: Point, q: Quantity) -> tuple[float, float, float]:
    """(q, q', q'') at t s, where the motion is at x."""
    u, v, d, j = x
    q0, qu, qv, qj, r = q
    e = qj * math.exp(-r * t) if qj != 0.0 else 0.0
    return q0 + qu * u + qv * v + e, qu * v + qv * d - r * e, qu * d + qv * j + r * r * e


@inner()
def guard(con: Float1D, mode: int, side: int, uj: float) -> Quantity:
    """Clearance in m (flight) or push in N (contact) of side 0 = right, 1 = left."""
    k, c, gap = con[K_R + side], con[C_R + side], con[G_R + side]
    right = 1.0 - 2.0 * side
    if (mode >> side) & 1:
        return -k * gap, right * k, right * c, 0.0, 0.0
    return gap, -right, 0.0, right * uj, con[R_R + side]


@inner()
def root(
    lo: float, hi: float, guess: float, sign: float, m: Motion, q: Quantity, order: int
) -> float:
    """Time in s between lo and hi at which q (order 0) or q' (order 1) takes on `sign`.

    Newton from `guess`, kept in the bracket. Its last step is so short that its square could not
    move the time (order 0) or the value there (order 1, an extreme) by what a float holds; a
    halving of the bracket promises nothing, however short.
    """
    enough = (1e-6 if order else 1e-8) * hi
    t = guess if lo < guess < hi else hi
    for _ in range(80):
        values = value(t, motion_at(t, m), q)
        f, df = values[order], values[order + 1]
        if f * sign > 0:
            hi = t
        else:
            lo = t
        new = t - f / df if df != 0.0 else lo
        if df != 0.0 and abs(new - t) <= enough:
            return min(max(new, lo), hi)
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
            if not lo < new < hi:
                break
        t = new
    return t


@inner()
def crossing(h: float, m: Motion, q: Quantity, x0: Point, x1: Point) -> float:
    """First time in s in [0, h] at which the guard q turns negative, else inf; x at both ends."""
    g0, d0, _ = value(0.0, x0, q)
    g1, d1, _ = value(h, x1, q)
    touch = TOUCH * abs(q[1])
    hi = h
    if not (g1 < -touch or (g1 < 0 and d1 < 0)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        hi = root(0.0, h, h * d0 / (d0 - d1), 1.0, m, q, 1)
        if not value(hi, motion_at(hi, m), q)[0] < -touch:
            return math.inf
    if g0 > 0:
        curve = (g1 - g0 - d0 * h) / (h * h)
        under = d0 * d0 - 4 * curve * g0
        guess = 2 * g0 / (math.sqrt(under) - d0) if under > 0 else hi
        return root(0.0, hi, guess, -1.0, m, q, 0)
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(60):
        lo *= 0.5
        if value(lo, motion_at(lo, m), q)[0] > touch:
            return root(lo, 2 * lo, 2 * lo, -1.0, m, q, 0)
    return 0.0


@inner()
def leap(
    state: Float1D, con: Float1D, h: float, base: float, slope: float, wave: Wave, search: bool
) -> tuple[float, int, Motion, Point, Point]:
    """Moves `state` under A = base + slope t + wave to its first event within h s, or by h.

    (time in s, side of the event, the motion, its points at both ends); side 0 right, 1 left, -1
    none. Without `search` there is none.
    """
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    m, x0 = motion(con, mode, state[U], state[V], base, slope, wave)
    x1 = motion_at(h, m)
    dt, side = h, -1
    for s in range(2 if search else 0):
        found = crossing(h, m, guard(con, mode, s, state[U_R + s]), x0, x1)
        if found < dt or (side < 0 and found == dt):
            dt, side = found, s
    if side >= 0:
        x1 = motion_at(dt, m)
        state[CONTACT_R + side] = 1.0 - state[CONTACT_R + side]
    state[U], state[V] = x1[0], x1[1]
    for s in range(2):
        # In contact u_j follows the mass, recomputed from it, so nothing drifts.
        if (mode >> s) & 1 or side == s:
            state[U_R + s] = x1[0] - (1.0 - 2.0 * s) * con[G_R + s]
        else:
            state[U_R + s] *= math.exp(-con[R_R + s] * dt)
            if abs(state[U_R + s]) < DENORMAL:
                state[U_R + s] = 0.0
    return dt, side, m, x0, x1


REVISION = revision(globals())
