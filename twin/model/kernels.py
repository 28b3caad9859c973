"""Compiled closed-form motion of the SNM: every numba function of the model room.

All of them stand in one file because numba's cache does not notice a change in another file.

    M u'' + C u' + K u + F_R + F_L = -M A(t)
    contact: F_j = C_j u_j' + K_j u_j, u_R = u - G0R, u_L = u + G0L;   flight: F_j = 0, u_j relaxes

Right is positive, F_R >= 0, F_L <= 0, u = mass minus table displacement. SI throughout.
A mode is contact_r + 2 contact_l; in a mode M u'' + c u' + k u = -M A + f0 is linear, so only event
times need a root. Source: Stefani, De Angelis, Andreaus, Sect. 5, and the closed forms of a linear
oscillator. Tuples are values: `motion` is the solution of one mode, `quantity` a linear functional
    q(t) = q0 + qu u(t) + qv v(t) + qj exp(-r t)
of it. Guards are quantities that stay positive: the clearance in flight, the push in contact.
"""

import math

from numba import float64, int64, njit, types

from table_io.block import Float1D, Float2D

Motion = tuple[float, float, float, float, float, float, float, float, float, float]
Quantity = tuple[float, float, float, float, float]

# Layout of `state`.
U, V, U_R, U_L, CONTACT_R, CONTACT_L, BASE, IMPULSE_R, IMPULSE_L, STATE_SIZE = range(10)

# Layout of `constants`: parameters, the step, bumper relaxation rates and factors over the step,
# then for each of the four modes k, c, f0, a = c/2M, w2 = k/M and the flow matrix over the step.
MASS, K_R, C_R, K_L, C_L, G_R, G_L, STEP, SUBSTEPS, R_R, R_L, E_R, E_L = range(13)
MODES, MODE_SIZE = 13, 9
CONSTANTS_SIZE = MODES + 4 * MODE_SIZE

TOUCH = 1e-14  # m: penetration below this is rounding
DENORMAL = 1e-30  # m: a bumper this near to relaxed is relaxed
MOST_EVENTS = 40  # in one step; only rounding at a graze can come near it


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def tabulate(con: Float1D, step: float) -> None:
    """Fills the parts of `constants` that depend on the step in s."""
    con[STEP] = step
    con[E_R], con[E_L] = math.exp(-con[R_R] * step), math.exp(-con[R_L] * step)
    for mode in range(4):
        b = MODES + mode * MODE_SIZE
        con[b + 5], con[b + 6], con[b + 7], con[b + 8] = flow(step, con[b + 3], con[b + 4])


@njit(cache=True, nogil=True)
def motion(
    con: Float1D, mode: int, u: float, v: float, base: float, slope: float,
    peak: float, w: float, phase: float,
) -> Motion:  # fmt: skip
    """The motion from (u, v) at t = 0 under A = base + slope t + peak sin(phase + w t), m/s2."""
    b = MODES + mode * MODE_SIZE
    mass, k, c = con[MASS], con[b], con[b + 1]
    q1 = -mass * slope / k
    q0 = (con[b + 2] - mass * base - c * q1) / k
    if w == 0.0:
        return con[b + 3], con[b + 4], u - q0, v - q1, q0, q1, 0.0, 0.0, 0.0, 0.0
    re, im = k - mass * w * w, c * w
    scale = mass * peak / (re * re + im * im)
    alpha, beta = -re * scale, im * scale
    s, co = math.sin(phase), math.cos(phase)
    y = u - q0 - alpha * s - beta * co
    z = v - q1 - w * (alpha * co - beta * s)
    return con[b + 3], con[b + 4], y, z, q0, q1, alpha, beta, w, phase


@njit(cache=True, nogil=True)
def motion_at(t: float, m: Motion) -> tuple[float, float, float, float]:
    """(u, u', u'', u''') of a motion at t s."""
    a, w2, y0, z0, q0, q1, alpha, beta, w, phase = m
    e11, e12, e21, e22 = flow(t, a, w2)
    y, z = e11 * y0 + e12 * z0, e21 * y0 + e22 * z0
    d = -2 * a * z - w2 * y
    u, v, j = q0 + q1 * t + y, q1 + z, -2 * a * d - w2 * z
    if w != 0.0:
        s, c = math.sin(phase + w * t), math.cos(phase + w * t)
        p, pv = alpha * s + beta * c, w * (alpha * c - beta * s)
        u, v, d, j = u + p, v + pv, d - w * w * p, j - w * w * pv
    return u, v, d, j


@njit(cache=True, nogil=True)
def probe(t: float, m: Motion, q: Quantity) -> tuple[float, float, float]:
    """(q, q', q'') at t s."""
    u, v, d, j = motion_at(t, m)
    q0, qu, qv, qj, r = q
    e = qj * math.exp(-r * t) if qj != 0.0 else 0.0
    return q0 + qu * u + qv * v + e, qu * v + qv * d - r * e, qu * d + qv * j + r * r * e


@njit(cache=True, nogil=True)
def guard(con: Float1D, mode: int, side: int, uj: float) -> Quantity:
    """Clearance in m (flight) or push in N (contact) of side 0 = right, 1 = left."""
    if side == 0:
        if mode & 1:
            return -con[K_R] * con[G_R], con[K_R], con[C_R], 0.0, 0.0
        return con[G_R], -1.0, 0.0, uj, con[R_R]
    if mode & 2:
        return -con[K_L] * con[G_L], -con[K_L], -con[C_L], 0.0, 0.0
    return con[G_L], 1.0, 0.0, -uj, con[R_L]


@njit(cache=True, nogil=True)
def root(lo: float, hi: float, m: Motion, q: Quantity, slope: bool) -> float:
    """Time in s of the sign change of q (or of q') between lo and hi: Newton kept in the bracket.

    Starts from hi, so a zero at lo that is only the start of a phase is not found again.
    """
    g, d, dd = probe(hi, m, q)
    f, df = (d, dd) if slope else (g, d)
    sign = -1.0 if f < 0 else 1.0  # of f on the hi side
    t = hi
    for _ in range(80):
        new = t - f / df if df != 0.0 else lo
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
        moved = abs(new - t)
        t = new
        if moved <= 1e-10 * hi:
            break
        g, d, dd = probe(t, m, q)
        f, df = (d, dd) if slope else (g, d)
        if f * sign > 0:
            hi = t
        else:
            lo = t
    return t


@njit(cache=True, nogil=True)
def crossing(h: float, m: Motion, q: Quantity) -> float:
    """First time in s within [0, h] at which the guard q turns negative; inf if it does not."""
    g0, d0, _ = probe(0.0, m, q)
    g1, d1, _ = probe(h, m, q)
    touch = TOUCH * abs(q[1])
    hi = h
    if not (g1 < -touch or (g1 < 0 and d1 < 0)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        hi = root(0.0, h, m, q, True)
        if not probe(hi, m, q)[0] < -touch:
            return math.inf
    if g0 > 0:
        return root(0.0, hi, m, q, False)
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(60):
        lo *= 0.5
        if probe(lo, m, q)[0] > touch:
            return root(lo, 2 * lo, m, q, False)
    return 0.0


@njit(cache=True, nogil=True)
def next_event(
    con: Float1D, mode: int, h: float, m: Motion, ur: float, ul: float
) -> tuple[float, int]:
    """(time in s, side) of the first event within h, side 0 right, 1 left; (h, -1) if none."""
    right = crossing(h, m, guard(con, mode, 0, ur))
    left = crossing(min(h, right), m, guard(con, mode, 1, ul))
    if left < right:
        return left, 1
    if right <= h:
        return right, 0
    return h, -1


@njit(cache=True, nogil=True)
def arrive(
    con: Float1D, mode: int, t: float, m: Motion, ur: float, ul: float
) -> tuple[float, float, float, float]:
    """(u, v, u_R, u_L) after t s in one mode; in contact u_j follows the mass, so nothing drifts."""
    u, v, _, _ = motion_at(t, m)
    ur = u - con[G_R] if mode & 1 else ur * math.exp(-con[R_R] * t)
    ul = u + con[G_L] if mode & 2 else ul * math.exp(-con[R_L] * t)
    return u, v, ur, ul


@njit(cache=True, nogil=True)
def impulses(
    con: Float1D, mode: int, t: float, du: float, dv: float, base: float
) -> tuple[float, float]:
    """Integrals of F_R and F_L in N s over t s in one mode, `base` the mean A: exact by momentum."""
    b = MODES + mode * MODE_SIZE
    area = (con[b + 2] * t - con[MASS] * (dv + base * t) - con[b + 1] * du) / con[b]
    right = con[C_R] * du + con[K_R] * (area - con[G_R] * t) if mode & 1 else 0.0
    left = con[C_L] * du + con[K_L] * (area + con[G_L] * t) if mode & 2 else 0.0
    return right, left


@njit(cache=True, nogil=True)
def eventful(
    state: Float1D, con: Float1D, start: float, h: float, slope: float, log: Float2D, count: int
) -> int:
    """Moves `state` over h s with A = state[BASE] + slope t through any events; their new count."""
    u, v, ur, ul, base = state[U], state[V], state[U_R], state[U_L], state[BASE]
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    t = 0.0
    for attempt in range(MOST_EVENTS + 1):
        m = motion(con, mode, u, v, base + slope * t, slope, 0.0, 0.0, 0.0)
        dt, side = h - t, -1
        if attempt < MOST_EVENTS:
            dt, side = next_event(con, mode, h - t, m, ur, ul)
        u0, v0 = u, v
        u, v, ur, ul = arrive(con, mode, dt, m, ur, ul)
        if mode:
            mean = base + slope * (t + 0.5 * dt)
            jr, jl = impulses(con, mode, dt, u - u0, v - v0, mean)
            state[IMPULSE_R] += jr
            state[IMPULSE_L] += jl
        t += dt
        if side < 0:
            break
        mode ^= 1 << side
        onset = (mode >> side) & 1
        closing = v + con[R_R] * ur if side == 0 else -v - con[R_L] * ul
        if count < log.shape[0]:
            log[count, 0], log[count, 1], log[count, 2] = start + t, 1.0 - 2.0 * side, onset
            log[count, 3], log[count, 4] = closing if onset else 0.0, state[IMPULSE_R + side]
        count += 1
        state[IMPULSE_R + side] = 0.0
        if onset and side == 0:
            ur = u - con[G_R]
        elif onset:
            ul = u + con[G_L]
    state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul
    state[CONTACT_R], state[CONTACT_L] = float(mode & 1), float(mode >> 1)
    return count


# One signature, so that slices and read-only arrays of Blocks need no further compilation.
_READ = types.Array(float64, 1, "A", readonly=True)
_WRITE = types.Array(float64, 2, "A")


@njit(int64(float64[::1], _READ, _READ, _WRITE, _WRITE), cache=True, nogil=True)
def march(state: Float1D, con: Float1D, base_acc: Float1D, out: Float2D, log: Float2D) -> int:
    """Moves `state` through the samples of A in m/s2, (n,), linear in between; number of events.

    out (7, n): u, v, total acceleration a = u'' + A, F_R, F_L, u_R, u_L at these samples. A step
    whose guards may have turned negative (or are NaN) is done again in `eventful`; two comparisons
    a side tell, since within a substep the guard's slope turns at most once.
    """
    h, parts, count = con[STEP], int(con[SUBSTEPS]), 0
    mass, rr, rl = con[MASS], con[R_R], con[R_L]
    u, v, ur, ul, base = state[U], state[V], state[U_R], state[U_L], state[BASE]
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    for i in range(base_acc.size * parts):
        sample, part = i // parts, i % parts
        slope = (base_acc[sample] - base) / (h * (parts - part))
        b = MODES + mode * MODE_SIZE
        k, c, f0 = con[b], con[b + 1], con[b + 2]
        d0 = (f0 - c * v - k * u) / mass - base
        q1 = -mass * slope / k
        q0 = (f0 - mass * base - c * q1) / k
        y, z = u - q0, v - q1
        u1 = q0 + q1 * h + con[b + 5] * y + con[b + 6] * z
        v1 = q1 + con[b + 7] * y + con[b + 8] * z
        base1 = base + slope * h if part + 1 < parts else base_acc[sample]
        d1 = (f0 - c * v1 - k * u1) / mass - base1
        if mode & 1:
            ur1 = u1 - con[G_R]
            g1 = con[C_R] * v1 + con[K_R] * ur1
            g0 = con[C_R] * v + con[K_R] * (u - con[G_R])
            s0, s1 = con[C_R] * d0 + con[K_R] * v, con[C_R] * d1 + con[K_R] * v1
        else:
            ur1 = ur * con[E_R]
            g1, g0 = con[G_R] + ur1 - u1, con[G_R] + ur - u
            s0, s1 = -rr * ur - v, -rr * ur1 - v1
        calm = g1 >= 0 and (s0 >= 0 or s1 <= 0 or g0 > -2 * h * s0)
        if mode & 2:
            ul1 = u1 + con[G_L]
            g1 = -con[C_L] * v1 - con[K_L] * ul1
            g0 = -con[C_L] * v - con[K_L] * (u + con[G_L])
            s0, s1 = -con[C_L] * d0 - con[K_L] * v, -con[C_L] * d1 - con[K_L] * v1
        else:
            ul1 = ul * con[E_L]
            g1, g0 = con[G_L] + u1 - ul1, con[G_L] + u - ul
            s0, s1 = v + rl * ul, v1 + rl * ul1
        if calm and g1 >= 0 and (s0 >= 0 or s1 <= 0 or g0 > -2 * h * s0):
            if mode:
                jr, jl = impulses(con, mode, h, u1 - u, v1 - v, 0.5 * (base + base1))
                state[IMPULSE_R] += jr
                state[IMPULSE_L] += jl
            u, v, ur, ul = u1, v1, ur1, ul1
        else:
            state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
            count = eventful(state, con, i * h, h, slope, log, count)
            u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
            mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
        base = base1
        if abs(ur) < DENORMAL:
            ur = 0.0
        if abs(ul) < DENORMAL:
            ul = 0.0
        if part + 1 == parts:
            b = MODES + mode * MODE_SIZE
            out[0, sample], out[1, sample] = u, v
            out[2, sample] = (con[b + 2] - con[b + 1] * v - con[b] * u) / mass
            out[3, sample] = max(0.0, con[C_R] * v + con[K_R] * ur) if mode & 1 else 0.0
            out[4, sample] = min(0.0, con[C_L] * v + con[K_L] * ul) if mode & 2 else 0.0
            out[5, sample], out[6, sample] = ur, ul
    state[U], state[V], state[U_R], state[U_L], state[BASE] = u, v, ur, ul, base
    return count
