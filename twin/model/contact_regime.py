"""Closed-form motion in one contact regime of the SNM, and location of the event that ends it.

    M u'' + C u' + K u + F_R + F_L = -M A(t)
    contact: F_j = C_j u_j' + K_j u_j, u_R = u - G0R, u_L = u + G0L;   flight: F_j = 0, u_j relaxes

SI, right positive, F_R >= 0, F_L <= 0. Source: Stefani, De Angelis, Andreaus, Sect. 5; the linear
oscillator. Each mode = contact_r + 2 contact_l is linear, M u'' + c u' + k u = -M A + f0, so only
event times need root finding. A guard is a quantity that stays positive until its event.
"""

import math

from table_io.block import Float1D
from table_io.compilation import jit_helper

Sinusoid = tuple[float, float, float]  # peak in m/s2, angular frequency in 1/s, phase in rad
# Returned by `mode_solution`.
ModeSolution = tuple[float, float, float, float, float, float, Sinusoid, float, float]
Kinematics = tuple[float, float, float, float]  # u, u', u'', u'''
Quantity = tuple[float, float, float, float, float]  # q = q0 + qu u + qv u' + qj exp(-r t)
Motion = tuple[float, float, float]  # u, u', u''
# u_j at the end of a step; the guard at its start and end; the guard's slope there
StepGuard = tuple[float, float, float, float, float]

# Indices of `state`
U, V, U_R, U_L, CONTACT_R, CONTACT_L, BASE, IMPULSE_R, IMPULSE_L, STATE_SIZE = range(10)
# Indices of `params`: parameters, step in s, substeps, bumper relaxation rates in 1/s and decay
# factors over the step; then for each mode k, c, f0, a = c/2M, w2 = k/M and the transition matrix
# over the step, row by row.
MASS, K_R, K_L, C_R, C_L, G_R, G_L, STEP, SUBSTEPS, R_R, R_L, E_R, E_L, MODES = range(14)
MODE_SIZE = 9
PARAMS_SIZE = MODES + 4 * MODE_SIZE

PENETRATION_TOL_M = 1e-14  # m: smaller penetrations are rounding errors
DENORMAL_LIMIT = 1e-30  # m: smaller bumper deformations are set to zero
MAX_EVENTS_PER_STEP = 40  # only rounding at a grazing contact can come near it


@jit_helper()
def transition_matrix(t: float, a: float, w2: float) -> tuple[float, float, float, float]:
    """Return the transition matrix of (y, y') over t s, y'' + 2 a y' + w2 y = 0, row by row.

    Under-, over- and critically damped; a series covers the limit where both forms cancel.
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


@jit_helper()
def mode_solution(
    params: Float1D, mode: int, u: float, v: float, base: float, slope: float, wave: Sinusoid
) -> tuple[ModeSolution, Kinematics]:
    """Return a mode's solution under A = base + slope t + wave in m/s2, and its initial motion.

    Particular part q0 + q1 t + alpha sin + beta cos, homogeneous part from (y, z).
    """
    b = MODES + mode * MODE_SIZE
    mass, k, c, a, w2 = params[MASS], params[b], params[b + 1], params[b + 3], params[b + 4]
    q1 = -mass * slope / k
    q0 = (params[b + 2] - mass * base - c * q1) / k
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


@jit_helper()
def solution_at(t: float, m: ModeSolution) -> Kinematics:
    """Return (u, u', u'', u''') of a mode solution at t s."""
    a, w2, y0, z0, q0, q1, (peak, w, phase), alpha, beta = m
    e11, e12, e21, e22 = transition_matrix(t, a, w2)
    y, z = e11 * y0 + e12 * z0, e21 * y0 + e22 * z0
    d = -2 * a * z - w2 * y
    u, v, j = q0 + q1 * t + y, q1 + z, -2 * a * d - w2 * z
    if peak != 0.0:
        s, c = math.sin(phase + w * t), math.cos(phase + w * t)
        p, pv = alpha * s + beta * c, w * (alpha * c - beta * s)
        u, v, d, j = u + p, v + pv, d - w * w * p, j - w * w * pv
    return u, v, d, j


@jit_helper()
def evaluate_quantity(t: float, x: Kinematics, q: Quantity) -> tuple[float, float, float]:
    """Return (q, q', q'') at t s, where the motion is x."""
    u, v, d, j = x
    q0, qu, qv, qj, r = q
    e = qj * math.exp(-r * t) if qj != 0.0 else 0.0
    return q0 + qu * u + qv * v + e, qu * v + qv * d - r * e, qu * d + qv * j + r * r * e


@jit_helper()
def contact_guard(params: Float1D, mode: int, side: int, uj: float) -> Quantity:
    """Return the guard of side 0 right, 1 left: clearance in m (flight) or push in N (contact)."""
    k, c, gap = params[K_R + side], params[C_R + side], params[G_R + side]
    sign = 1.0 - 2.0 * side
    if (mode >> side) & 1:
        return -k * gap, sign * k, sign * c, 0.0, 0.0
    return gap, -sign, 0.0, sign * uj, params[R_R + side]


@jit_helper()
def contact_mode(state: Float1D) -> int:
    """Return the mode of a state, contact_r + 2 contact_l."""
    return int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)


@jit_helper()
def bumper_forces(
    params: Float1D, mode: int, v: float, ur: float, ul: float, flight_force: float
) -> tuple[float, float]:
    """Return (F_R, F_L) in N; `flight_force` where there is no contact."""
    return (
        max(0.0, params[C_R] * v + params[K_R] * ur) if mode & 1 else flight_force,
        min(0.0, params[C_L] * v + params[K_L] * ul) if mode & 2 else flight_force,
    )


@jit_helper()
def step_guard(
    params: Float1D, mode: int, side: int, x0: Motion, x1: Motion, uj: float
) -> StepGuard:
    """Return u_j after a step and the guard of side 0 right, 1 left; motion x at both ends."""
    (u, v, d0), (u1, v1, d1) = x0, x1
    k, c, gap, r = params[K_R + side], params[C_R + side], params[G_R + side], params[R_R + side]
    if side == 0:
        if mode & 1:
            g0, g1 = c * v + k * uj, c * v1 + k * (u1 - gap)
            return u1 - gap, g0, g1, c * d0 + k * v, c * d1 + k * v1
        uj1 = uj * params[E_R]
        return uj1, gap + uj - u, gap + uj1 - u1, -r * uj - v, -r * uj1 - v1
    if mode & 2:
        g0, g1 = -c * v - k * uj, -c * v1 - k * (u1 + gap)
        return u1 + gap, g0, g1, -c * d0 - k * v, -c * d1 - k * v1
    uj1 = uj * params[E_L]
    return uj1, gap + u - uj, gap + u1 - uj1, v + r * uj, v1 + r * uj1


@jit_helper()
def stays_positive(h: float, g0: float, g1: float, s0: float, s1: float) -> bool:
    """Return False if a guard g with slope s at both ends of a step of h s may turn negative.

    Within a substep the slope changes sign at most once, so it hides a minimum only from - to +,
    and not if the guard begins high enough. False for NaN.
    """
    return g1 >= 0 and (s0 >= 0 or s1 <= 0 or g0 > -2 * h * s0)


@jit_helper()
def flush_denormal(uj: float) -> float:
    """Return a bumper deformation in m, 0 if it is below DENORMAL_LIMIT."""
    return uj if abs(uj) > DENORMAL_LIMIT else 0.0


@jit_helper()
def find_root(
    lo: float, hi: float, start: float, sign: float, m: ModeSolution, q: Quantity, order: int
) -> float:
    """Return the time in s in [lo, hi] at which q (order 0) or q' (order 1) changes to `sign`.

    Bracketed Newton iteration from `start`. It has converged when the square of a Newton step is
    below float resolution in time (order 0) or in the value there (order 1, an extremum); a short
    bisection step is no sign of convergence.
    """
    tolerance = (1e-6 if order else 1e-8) * hi
    t = start if lo < start < hi else hi
    for _ in range(80):
        values = evaluate_quantity(t, solution_at(t, m), q)
        f, df = values[order], values[order + 1]
        if f * sign > 0:
            hi = t
        else:
            lo = t
        new = t - f / df if df != 0.0 else lo
        if df != 0.0 and abs(new - t) <= tolerance:
            return min(max(new, lo), hi)
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
            if not lo < new < hi:
                break
        t = new
    return t


@jit_helper()
def contact_event_time(
    h: float, m: ModeSolution, q: Quantity, x0: Kinematics, x1: Kinematics
) -> float:
    """Return the first time in s in [0, h] at which the guard q turns negative, else inf.

    x0 and x1: motion at both ends.
    """
    g0, d0, _ = evaluate_quantity(0.0, x0, q)
    g1, d1, _ = evaluate_quantity(h, x1, q)
    tolerance = PENETRATION_TOL_M * abs(q[1])
    hi = h
    if not (g1 < -tolerance or (g1 < 0 and d1 < 0)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        hi = find_root(0.0, h, h * d0 / (d0 - d1), 1.0, m, q, 1)
        if not evaluate_quantity(hi, solution_at(hi, m), q)[0] < -tolerance:
            return math.inf
    if g0 > 0:
        curvature = (g1 - g0 - d0 * h) / (h * h)
        # The nearer root of the parabola; without a discriminant, or where d0 rounds it off, hi.
        discriminant = d0 * d0 - 4 * curvature * g0
        divisor = math.sqrt(discriminant) - d0 if discriminant > 0 else 0.0
        start = 2 * g0 / divisor if divisor != 0.0 else hi
        return find_root(0.0, hi, start, -1.0, m, q, 0)
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(60):
        lo *= 0.5
        if evaluate_quantity(lo, solution_at(lo, m), q)[0] > tolerance:
            return find_root(lo, 2 * lo, 2 * lo, -1.0, m, q, 0)
    return 0.0


@jit_helper()
def advance_to_event(
    state: Float1D,
    params: Float1D,
    h: float,
    base: float,
    slope: float,
    wave: Sinusoid,
    search: bool,
) -> tuple[float, int, ModeSolution, Kinematics, Kinematics]:
    """Advance `state` under A = base + slope t + wave to its first event within h s, else by h.

    Returns (time in s, side of the event, mode solution, motion at both ends); side 0 right, 1
    left, -1 none. Without `search` events are ignored.
    """
    mode = contact_mode(state)
    m, x0 = mode_solution(params, mode, state[U], state[V], base, slope, wave)
    x1 = solution_at(h, m)
    dt, side = h, -1
    for s in range(2 if search else 0):
        event_time = contact_event_time(
            h, m, contact_guard(params, mode, s, state[U_R + s]), x0, x1
        )
        if event_time < dt or (side < 0 and event_time == dt):
            dt, side = event_time, s
    if side >= 0:
        x1 = solution_at(dt, m)
        state[CONTACT_R + side] = 1.0 - state[CONTACT_R + side]
    state[U], state[V] = x1[0], x1[1]
    for s in range(2):
        # In contact u_j is recomputed from u, so that no error accumulates.
        if (mode >> s) & 1 or side == s:
            state[U_R + s] = x1[0] - (1.0 - 2.0 * s) * params[G_R + s]
        else:
            state[U_R + s] *= math.exp(-params[R_R + s] * dt)
            if abs(state[U_R + s]) < DENORMAL_LIMIT:
                state[U_R + s] = 0.0
    return dt, side, m, x0, x1
