"""Closed-form motion in one contact regime of the SNM, and location of the event that ends it.

    M u'' + C u' + K u + F_R + F_L = -M A(t)
    contact: F_j = C_j u_j' + K_j u_j, u_R = u - G0R, u_L = u + G0L;   flight: F_j = 0, u_j relaxes

SI, right positive, F_R >= 0, F_L <= 0. Source: Stefani, De Angelis, Andreaus, Sect. 5; the linear
oscillator. Each mode = contact_r + 2 contact_l is linear, M u'' + c u' + k u = -M A + f0, so only
event times need root finding. A guard is a quantity that stays positive until its event.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from table_io.block import Float1D
from table_io.compilation import jit_helper
from twin.model.event_location import Accuracy, find_root, locate_event

Sinusoid = tuple[float, float, float]  # peak in m/s2, angular frequency in 1/s, phase in rad
# Returned by `mode_solution`.
ModeSolution = tuple[float, float, float, float, float, float, Sinusoid, float, float]
Kinematics = tuple[float, float, float, float]  # u, u', u'', u'''
Quantity = tuple[float, float, float, float, float]  # q = q0 + qu u + qv u' + qj exp(-r t)
Motion = tuple[float, float, float]  # u, u', u''
Departure = tuple[float, float]  # u and u' of the homogeneous part of a motion
# u_j at the end of a step; a guard at its start and end; its slope there
StepGuard = tuple[float, float, float, float, float]

# Indices of `state`
U, V, U_R, U_L, CONTACT_R, CONTACT_L, BASE, IMPULSE_R, IMPULSE_L, STATE_SIZE = range(10)
# Indices of `params`: parameters, step in s, substeps, bumper relaxation rates in 1/s and decay
# factors over the step; then for each mode k, c, f0, a = c/2M, w2 = k/M and the transition matrix
# over the step, row by row.
MASS, K_R, K_L, C_R, C_L, G_R, G_L, STEP, SUBSTEPS, R_R, R_L, E_R, E_L, MODES = range(14)
MODE_SIZE = 9
PARAMS_SIZE = MODES + 4 * MODE_SIZE


class ModeSegment(NamedTuple):
    """Motion in one mode up to an event on `side` (0 right, 1 left, -1 none), dt s long.

    `begin` in s since the start of the step; `faces`: u_r and u_l in m there; x0, x1: the motion at
    both ends.
    """

    mode: int
    begin: float
    dt: float
    side: int
    faces: tuple[float, float]
    solution: ModeSolution
    x0: Kinematics
    x1: Kinematics


class ModeStep(NamedTuple):
    """A step in one mode, if no guard has turned negative within it (`is_clear`).

    u, v, u_r, u_l and total acceleration `a` at its end; u'' at both ends; guards of right and
    left as `StepGuard`.
    """

    u: float
    v: float
    u_r: float
    u_l: float
    a: float
    d0: float
    d1: float
    right: StepGuard
    left: StepGuard
    is_clear: bool


# (what is recorded, its count, state at the end, parameters, segment) -> count
Observer = Callable[[Any, int, Float1D, Float1D, ModeSegment], int]

PENETRATION_TOL_M = 1e-14  # m: smaller penetrations are rounding errors
DENORMAL_LIMIT = 1e-30  # m: smaller bumper deformations are set to zero
MAX_EVENTS_PER_STEP = 40  # only rounding at a grazing contact can come near it
# The square of the last Newton step is below float resolution, in time or in the value there.
ACCURACY = Accuracy(value_tolerance=1e-8, slope_tolerance=1e-6, is_analytic=True)


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


@jit_helper(inlined=True)
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


@jit_helper(inlined=True)
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


@jit_helper(inlined=True)
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


@jit_helper(inlined=True)
def stays_positive(h: float, guard: StepGuard) -> bool:
    """Return False if a guard may turn negative within a step of h s.

    Within a substep the slope changes sign at most once, so it hides a minimum only from - to +,
    and not if the guard begins high enough. False for NaN.
    """
    _, g0, g1, s0, s1 = guard
    return g1 >= 0 and (s0 >= 0 or s1 <= 0 or g0 > -2 * h * s0)


@jit_helper(inlined=True)
def flush_denormal(uj: float) -> float:
    """Return a bumper deformation in m, 0 if it is below DENORMAL_LIMIT."""
    return uj if abs(uj) > DENORMAL_LIMIT else 0.0


@jit_helper(inlined=True)
def take_step(
    params: Float1D,
    mode: int,
    h: float,
    x: tuple[float, float, float, float],
    departure: Departure,
    particular: tuple[float, float],
    base: tuple[float, float],
) -> ModeStep:
    """Return the step over h s of the discretized parameters from x = (u, v, u_r, u_l).

    departure: u and u' of the homogeneous part at the start; particular: those of the particular
    part at the end; base: A in m/s2 at both ends.
    """
    b, mass = MODES + mode * MODE_SIZE, params[MASS]
    k, c, f0 = params[b], params[b + 1], params[b + 2]
    u, v, ur, ul = x
    y, z = departure
    u1 = particular[0] + params[b + 5] * y + params[b + 6] * z
    v1 = particular[1] + params[b + 7] * y + params[b + 8] * z
    a1 = (f0 - c * v1 - k * u1) / mass
    d0, d1 = (f0 - c * v - k * u) / mass - base[0], a1 - base[1]
    right = step_guard(params, mode, 0, (u, v, d0), (u1, v1, d1), ur)
    left = step_guard(params, mode, 1, (u, v, d0), (u1, v1, d1), ul)
    is_clear = stays_positive(h, right) and stays_positive(h, left)
    return ModeStep(u1, v1, right[0], left[0], a1, d0, d1, right, left, is_clear)


@jit_helper(inlined=True)
def evaluate_motion(t: float, m: ModeSolution, q: Quantity) -> tuple[float, float, float]:
    """Return (q, q', q'') at t s of a mode solution."""
    return evaluate_quantity(t, solution_at(t, m), q)


@jit_helper(inlined=True)
def find_extremum(
    lo: float, hi: float, start: float, sign: float, m: ModeSolution, q: Quantity
) -> float:
    """Return the time in s in [lo, hi] at which the slope of q changes to `sign`, from `start`."""
    return find_root(lo, hi, start, sign, 0.0, 1, ACCURACY, evaluate_motion, m, q)


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
        q = contact_guard(params, mode, s, state[U_R + s])
        g0, d0, _ = evaluate_quantity(0.0, x0, q)
        g1, d1, _ = evaluate_quantity(h, x1, q)
        tolerance = PENETRATION_TOL_M * abs(q[1])
        event_time = locate_event(
            h, (g0, d0), (g1, d1), tolerance, True, ACCURACY, evaluate_motion, m, q
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


@jit_helper()
def advance_through_events(
    state: Float1D,
    params: Float1D,
    h: float,
    base: float,
    slope: float,
    wave: Sinusoid,
    observe: Observer,
    record: Any,
    count: int,
) -> int:
    """Advance `state` over h s and its events under A = base + slope t + wave; return the count.

    `observe` is called after each segment and returns the `count` of what it records.
    """
    peak, w, phase = wave
    t = 0.0
    for attempt in range(MAX_EVENTS_PER_STEP):
        mode, faces = contact_mode(state), (state[U_R], state[U_L])
        dt, side, m, x0, x1 = advance_to_event(
            state,
            params,
            h - t,
            base + slope * t,
            slope,
            (peak, w, phase + w * t),
            attempt + 1 < MAX_EVENTS_PER_STEP,
        )
        count = observe(
            record, count, state, params, ModeSegment(mode, t, dt, side, faces, m, x0, x1)
        )
        t += dt
        if side < 0:
            break
    return count
