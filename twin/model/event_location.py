"""One step of the integrated model up to its first event, located to roundoff.

Between events the right-hand side is smooth, so the Runge-Kutta formula keeps its order: an event
lies where a step of exactly that length makes a guard zero. A guard is a quantity that stays
positive until its event: clearance or push of a side, u' in its direction, or the friction reserve
while the mass sticks. Linear models use their exact propagator instead.

Source of the formula: Dormand and Prince 1980, J. Comput. Appl. Math. 6(1), the order 5 part.
"""

import math
from typing import Any

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_helper, jit_helper_unless_none
from twin.model.force_laws import (
    AddedLaws,
    Coefficients,
    Motion,
    Start,
    add_law_force,
    add_scaled_inputs,
    bumper_coefficients,
    bumper_deformation,
    bumper_force,
    hunt_crossley_damping,
    state_rates,
    static_friction,
)

GUARD_TOL = 1e-14  # m and m/s: smaller values are rounding errors
MAX_SERIES_TERMS = 60  # of the Taylor series; a step needs far fewer
REVERSAL_GUARD = 2  # 0 and 1 are the guards of the sides
LINEAR_SIZE = 12  # of the state of linear propagation, see `event_integrator._generator_matrix`
LAW_SLOPE_STEP_S = 1e-6  # s: of the difference quotient of an added law

StateAndRates = tuple[Motion, Motion]  # a state and its rates


@jit_helper(inlined=True)
def add_scaled(x: Motion, h: float, k: Motion) -> Motion:
    """Return x + h k."""
    return Motion(
        x.u + h * k.u, x.v + h * k.v, x.u_r + h * k.u_r, x.u_l + h * k.u_l, x.f + h * k.f,
        x.b_r + h * k.b_r, x.b_l + h * k.b_l, add_scaled_inputs(x.s, h, k.s),
    )  # fmt: skip


@jit_helper()
def runge_kutta(
    t: float, x: Motion, k1: Motion, start: Start, p: Coefficients, laws: AddedLaws | None
) -> Motion:
    """Return the state t s after x by one Runge-Kutta step; k1 are the rates at x."""
    y = add_scaled(x, t / 5, k1)
    k2 = state_rates(y, start, p, t / 5, laws)
    y = add_scaled(add_scaled(x, t * 3 / 40, k1), t * 9 / 40, k2)
    k3 = state_rates(y, start, p, t * 3 / 10, laws)
    y = add_scaled(add_scaled(add_scaled(x, t * 44 / 45, k1), t * -56 / 15, k2), t * 32 / 9, k3)
    k4 = state_rates(y, start, p, t * 4 / 5, laws)
    y = add_scaled(add_scaled(x, t * 19372 / 6561, k1), t * -25360 / 2187, k2)
    y = add_scaled(add_scaled(y, t * 64448 / 6561, k3), t * -212 / 729, k4)
    k5 = state_rates(y, start, p, t * 8 / 9, laws)
    y = add_scaled(add_scaled(x, t * 9017 / 3168, k1), t * -355 / 33, k2)
    y = add_scaled(
        add_scaled(add_scaled(y, t * 46732 / 5247, k3), t * 49 / 176, k4), t * -5103 / 18656, k5
    )
    k6 = state_rates(y, start, p, t, laws)
    y = add_scaled(add_scaled(x, t * 35 / 384, k1), t * 500 / 1113, k3)
    return add_scaled(
        add_scaled(add_scaled(y, t * 125 / 192, k4), t * -2187 / 6784, k5), t * 11 / 84, k6
    )


@jit_helper()
def propagate_linear(
    t: float, x: Motion, start: Start, p: Coefficients, propagators: Float2D
) -> Motion:
    """Return the state t s after x of a linear model: by propagator over a step, else by series.

    propagators (8 x LINEAR_SIZE, LINEAR_SIZE): as from `event_integrator.build_propagators`.
    """
    base, slope, gap_r, gap_l = start.base, start.slope, start.gap_r, start.gap_l
    if t == p.step:
        row = (4 + start.mode) * LINEAR_SIZE
        return multiply_map(propagators, row, x, base, slope, gap_r, gap_l, 1.0)
    row, unit, term = start.mode * LINEAR_SIZE, 1.0, x
    for n in range(1, MAX_SERIES_TERMS):
        # t^n / n! of the n-th derivative; drive and gaps are linear in time.
        term = multiply_map(propagators, row, term, base, slope, gap_r, gap_l, unit)
        term = add_scaled(Motion(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, x.s), t / n, term)
        base, gap_r, gap_l = slope * (t / n), p.drift * unit * (t / n), p.drift * unit * (t / n)
        slope, unit = 0.0, 0.0
        new = add_scaled(x, 1.0, term)
        if n > 2 and new == x:
            break
        x = new
    return x


@jit_helper()
def multiply_map(
    propagators: Float2D, row: int, x: Motion,
    base: float, slope: float, gap_r: float, gap_l: float, unit: float,
) -> Motion:  # fmt: skip
    """Return seven rows of a map times (x, base, slope, right gap, left gap, unit)."""
    return Motion(
        multiply_row(propagators[row], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 1], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 2], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 3], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 4], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 5], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 6], x, base, slope, gap_r, gap_l, unit),
        x.s,
    )


@jit_helper(inlined=True)
def multiply_row(
    m: Float1D, x: Motion, base: float, slope: float, gap_r: float, gap_l: float, unit: float
) -> float:
    """Return one row of `multiply_map`."""
    total = m[0] * x.u + m[1] * x.v + m[2] * x.u_r + m[3] * x.u_l + m[4] * x.f + m[5] * x.b_r
    return (
        total
        + m[6] * x.b_l
        + m[7] * base
        + m[8] * slope
        + m[9] * gap_r
        + m[10] * gap_l
        + m[11] * unit
    )


@jit_helper()
def advance_in_mode(
    t: float,
    x: Motion,
    k1: Motion,
    start: Start,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
) -> StateAndRates:
    """Return (state, its rates) t s after x in one mode; k1 are the rates at x."""
    if p.is_linear:
        y = propagate_linear(t, x, start, p, propagators)
    else:
        y = runge_kutta(t, x, k1, start, p, laws)
    # In contact u_j is recomputed from u, so that no error accumulates.
    u_r = y.u - start.gap_r - p.drift * t if start.mode & 1 else y.u_r
    u_l = y.u + start.gap_l + p.drift * t if start.mode & 2 else y.u_l
    y = Motion(y.u, y.v, u_r, u_l, y.f, y.b_r, y.b_l, y.s)
    return y, state_rates(y, start, p, t, laws)


@jit_helper_unless_none("laws", lambda slope, side, d, dd, d2d, s, s_rates, p, laws: slope)
def add_law_slope(
    slope: float, side: int, d: float, dd: float, d2d: float, s: Any, s_rates: Any,
    p: Coefficients, laws: Any,
) -> float:  # fmt: skip
    """Return `slope` plus d/dt in N/s of the added laws' push: central difference in time."""
    h = LAW_SLOPE_STEP_S
    after, before = add_scaled_inputs(s, h, s_rates), add_scaled_inputs(s, -h, s_rates)
    rise = add_law_force(0.0, side, d + h * dd, dd + h * d2d, after, p, laws)
    rise -= add_law_force(0.0, side, d - h * dd, dd - h * d2d, before, p, laws)
    return slope + rise / (2.0 * h)


@jit_helper(inlined=True)
def guard_value(
    t: float,
    motion: StateAndRates,
    start: Start,
    p: Coefficients,
    laws: AddedLaws | None,
    guard: int,
) -> tuple[float, float]:
    """Return (guard, its slope) of side 0 or 1, or of the sign of u'.

    Clearance in m, push in N, u' in m/s; while stuck the friction reserve in N, without slope.
    """
    x, dx = motion
    if guard == REVERSAL_GUARD:
        if start.direction == 0.0:
            return p.fc - abs(static_friction(x, start, p, t, laws)), 0.0
        return start.direction * x.v, start.direction * dx.v
    d, dd, b = bumper_deformation(x, start, p, guard, t, laws)
    sign = 1.0 - 2.0 * guard
    if not (start.mode >> guard) & 1:
        gap = (start.gap_l if guard else start.gap_r) + p.drift * t
        return gap + d - sign * x.u, p.drift + dd - sign * x.v
    k, c = bumper_coefficients(p, guard)
    slope = (k + 2.0 * p.k2 * abs(d)) * dd + (c + hunt_crossley_damping(d, p.ch)) * sign * dx.v
    slope += p.ch * math.copysign(1.0, d) * dd * dd + p.kb * dd - p.rate_b * b
    slope = add_law_slope(slope, guard, d, dd, sign * dx.v, x.s, dx.s, p, laws)
    return bumper_force(p, guard, d, dd, b, x.s, laws) + p.pull, slope


@jit_helper()
def find_guard_root(
    lo: float,
    hi: float,
    order: int,
    x: Motion,
    k1: Motion,
    start: Start,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
    guard: int,
) -> float:
    """Return the time in s in [lo, hi] at which a guard (order 0) or its slope (1) changes sign.

    Bracketed Newton iteration from hi, so that a zero at lo, the start of a mode, is not found
    again. Without a slope it uses that of the chord.
    """
    motion, sign, chord, t = (x, k1), 0.0, 0.0, lo
    for attempt in range(82):
        if attempt > 0 or lo > 0.0:
            motion = advance_in_mode(t, x, k1, start, p, propagators, laws)
        g, slope = guard_value(t, motion, start, p, laws, guard)
        f = slope if order else g
        if attempt == 0:
            chord, t = f, hi
            continue
        if attempt == 1:
            chord, sign = (f - chord) / (hi - lo), math.copysign(1.0, f)
        elif f * sign > 0:
            hi = t
        else:
            lo = t
        df = slope if order == 0 and slope != 0.0 else chord
        new = t - f / df if df != 0.0 else lo
        if df != 0.0 and abs(new - t) <= 1e-12 * hi:
            return min(max(new, lo), hi)
        if not lo < new < hi:
            new = 0.5 * (lo + hi)
            if not lo < new < hi:
                break
        t = new
    return t


@jit_helper()
def guard_event_time(
    h: float,
    x: Motion,
    k1: Motion,
    end: StateAndRates,
    start: Start,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
    guard: int,
) -> float:
    """Return the first time in s in [0, h] at which a guard turns negative, else inf.

    `end` is at h. As `contact_regime.contact_event_time`, finds a guard that dips within the step
    and skips the zero of the last event.
    """
    g0, d0 = guard_value(0.0, (x, k1), start, p, laws, guard)
    g1, d1 = guard_value(h, end, start, p, laws, guard)
    if g1 >= 0 and (d0 >= 0 or d1 <= 0 or g0 > -2 * h * d0):
        return math.inf
    tolerance, hi = GUARD_TOL, h
    if guard < REVERSAL_GUARD and (start.mode >> guard) & 1:
        tolerance = GUARD_TOL * (p.k_l if guard else p.k_r)
    elif start.direction == 0.0 and guard == REVERSAL_GUARD:
        tolerance = 1e-12 * p.fc
    if not (g1 < -tolerance or (g1 < 0 and d1 < 0 and guard < REVERSAL_GUARD)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        hi = find_guard_root(0.0, h, 1, x, k1, start, p, propagators, laws, guard)
        motion = advance_in_mode(hi, x, k1, start, p, propagators, laws)
        if not guard_value(hi, motion, start, p, laws, guard)[0] < -tolerance:
            return math.inf
    if g0 > 0:
        return find_guard_root(0.0, hi, 0, x, k1, start, p, propagators, laws, guard)
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(45):
        lo *= 0.5
        motion = advance_in_mode(lo, x, k1, start, p, propagators, laws)
        if guard_value(lo, motion, start, p, laws, guard)[0] > tolerance:
            return find_guard_root(lo, 2 * lo, 0, x, k1, start, p, propagators, laws, guard)
    return 0.0


@jit_helper()
def integrate_to_event(
    h: float,
    x: Motion,
    start: Start,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
    search: bool,
) -> tuple[float, int, StateAndRates]:
    """Return (time in s, guard or -1, state and rates) at the first event within h s, else at h."""
    k1 = state_rates(x, start, p, 0.0, laws)
    end = advance_in_mode(h, x, k1, start, p, propagators, laws)
    dt, event_guard = h, -1
    for guard in range((2 + int(p.has_reversals)) if search else 0):
        t = guard_event_time(h, x, k1, end, start, p, propagators, laws, guard)
        if t < dt or (event_guard < 0 and t == dt):
            dt, event_guard = t, guard
    if event_guard >= 0:
        end = advance_in_mode(dt, x, k1, start, p, propagators, laws)
    return dt, event_guard, end
