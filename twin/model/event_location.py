"""One step of the integrated model up to its first event, located to roundoff.

Between events the right-hand side is smooth, so the Runge-Kutta formula keeps its order: an event
lies where a step of exactly that length makes a guard zero. A guard is a quantity that stays
positive until its event: clearance or push of a side, u' in its direction, or the friction reserve
while the mass sticks. Linear models use their exact propagator instead.

Source of the formula: Dormand and Prince 1980, J. Comput. Appl. Math. 6(1), the order 5 part.
"""

import math

from table_io.block import Float1D, Float2D
from twin.model.compilation import jit_helper, source_revision
from twin.model.force_laws import (
    BASE,
    C_L,
    C_R,
    CH,
    DRIFT,
    FC,
    GAP_L,
    GAP_R,
    IS_LINEAR,
    K2,
    K_L,
    K_R,
    KB,
    LINEAR_SIZE,
    PEAK,
    RATE_B,
    REVERSAL_EVENTS,
    SLOPE,
    STEP,
    U_L,
    U_R,
    KernelParams,
    PluginForce,
    StateVector,
    StepContext,
    U,
    V,
    bumper_deformation,
    bumper_force,
    hunt_crossley_damping,
    state_rates,
    static_friction,
)  # fmt: skip
from twin.model.force_laws import REVISION as LAWS_REVISION

GUARD_TOL = 1e-14  # m and m/s: smaller values are rounding errors
MAX_SERIES_TERMS = 60  # of the Taylor series; a step needs far fewer
REVERSAL_GUARD = 2  # 0 and 1 are the guards of the sides

StateAndRates = tuple[StateVector, StateVector]  # a state and its rates


@jit_helper(inlined=True)
def add_scaled(x: StateVector, h: float, k: StateVector) -> StateVector:
    """Return x + h k."""
    return (
        x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4],
        x[5] + h * k[5], x[6] + h * k[6],
    )  # fmt: skip


@jit_helper()
def runge_kutta(
    t: float,
    x: StateVector,
    k1: StateVector,
    context: StepContext,
    params: KernelParams,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
) -> StateVector:
    """Return the state t s after x by one Runge-Kutta step; k1 are the rates at x."""
    y = add_scaled(x, t / 5, k1)
    k2 = state_rates(y, context, params, mode, direction, t / 5, plugin_force)
    y = add_scaled(add_scaled(x, t * 3 / 40, k1), t * 9 / 40, k2)
    k3 = state_rates(y, context, params, mode, direction, t * 3 / 10, plugin_force)
    y = add_scaled(add_scaled(add_scaled(x, t * 44 / 45, k1), t * -56 / 15, k2), t * 32 / 9, k3)
    k4 = state_rates(y, context, params, mode, direction, t * 4 / 5, plugin_force)
    y = add_scaled(add_scaled(x, t * 19372 / 6561, k1), t * -25360 / 2187, k2)
    y = add_scaled(add_scaled(y, t * 64448 / 6561, k3), t * -212 / 729, k4)
    k5 = state_rates(y, context, params, mode, direction, t * 8 / 9, plugin_force)
    y = add_scaled(add_scaled(x, t * 9017 / 3168, k1), t * -355 / 33, k2)
    y = add_scaled(
        add_scaled(add_scaled(y, t * 46732 / 5247, k3), t * 49 / 176, k4), t * -5103 / 18656, k5
    )
    k6 = state_rates(y, context, params, mode, direction, t, plugin_force)
    y = add_scaled(add_scaled(x, t * 35 / 384, k1), t * 500 / 1113, k3)
    return add_scaled(
        add_scaled(add_scaled(y, t * 125 / 192, k4), t * -2187 / 6784, k5), t * 11 / 84, k6
    )


@jit_helper()
def propagate_linear(
    t: float,
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    propagators: Float2D,
    mode: int,
) -> StateVector:
    """Return the state t s after x of a linear model: by propagator over a step, else by series.

    propagators (8 x LINEAR_SIZE, LINEAR_SIZE): as from `event_integrator.build_propagators`.
    """
    base, slope, gap_r, gap_l = context[BASE], context[SLOPE], context[GAP_R], context[GAP_L]
    if t == params[STEP]:
        row = (4 + mode) * LINEAR_SIZE
        return multiply_map(propagators, row, x, base, slope, gap_r, gap_l, 1.0)
    row, unit, term = mode * LINEAR_SIZE, 1.0, x
    for n in range(1, MAX_SERIES_TERMS):
        # t^n / n! of the n-th derivative; drive and gaps are linear in time.
        term = multiply_map(propagators, row, term, base, slope, gap_r, gap_l, unit)
        term = add_scaled((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), t / n, term)
        base, gap_r, gap_l = (
            slope * (t / n),
            params[DRIFT] * unit * (t / n),
            params[DRIFT] * unit * (t / n),
        )
        slope, unit = 0.0, 0.0
        new = add_scaled(x, 1.0, term)
        if n > 2 and new == x:
            break
        x = new
    return x


@jit_helper()
def multiply_map(
    propagators: Float2D,
    row: int,
    x: StateVector,
    base: float,
    slope: float,
    gap_r: float,
    gap_l: float,
    unit: float,
) -> StateVector:
    """Return seven rows of a map times (x, base, slope, right gap, left gap, unit)."""
    return (
        multiply_row(propagators[row], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 1], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 2], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 3], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 4], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 5], x, base, slope, gap_r, gap_l, unit),
        multiply_row(propagators[row + 6], x, base, slope, gap_r, gap_l, unit),
    )


@jit_helper(inlined=True)
def multiply_row(
    m: Float1D, x: StateVector, base: float, slope: float, gap_r: float, gap_l: float, unit: float
) -> float:
    """Return one row of `multiply_map`."""
    total = m[0] * x[0] + m[1] * x[1] + m[2] * x[2] + m[3] * x[3] + m[4] * x[4] + m[5] * x[5]
    return (
        total
        + m[6] * x[6]
        + m[7] * base
        + m[8] * slope
        + m[9] * gap_r
        + m[10] * gap_l
        + m[11] * unit
    )


@jit_helper()
def advance_in_mode(
    t: float,
    x: StateVector,
    k1: StateVector,
    context: StepContext,
    params: KernelParams,
    propagators: Float2D,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
) -> StateAndRates:
    """Return (state, its rates) t s after x in one mode; k1 are the rates at x."""
    if params[IS_LINEAR] > 0.0 and context[PEAK] == 0.0:
        y = propagate_linear(t, x, context, params, propagators, mode)
    else:
        y = runge_kutta(t, x, k1, context, params, mode, direction, plugin_force)
    # In contact u_j is recomputed from u, so that no error accumulates.
    u_r = y[U] - context[GAP_R] - params[DRIFT] * t if mode & 1 else y[U_R]
    u_l = y[U] + context[GAP_L] + params[DRIFT] * t if mode & 2 else y[U_L]
    y = (y[0], y[1], u_r, u_l, y[4], y[5], y[6])
    return y, state_rates(y, context, params, mode, direction, t, plugin_force)


@jit_helper(inlined=True)
def guard_value(
    t: float,
    motion: StateAndRates,
    context: StepContext,
    params: KernelParams,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
    guard_index: int,
) -> tuple[float, float]:
    """Return (guard, its slope) of side 0 or 1, or of the sign of u'.

    Clearance in m, push in N, u' in m/s; while stuck the friction reserve in N, without slope.
    """
    x, dx = motion
    if guard_index == REVERSAL_GUARD:
        if direction == 0.0:
            return params[FC] - abs(static_friction(x, context, params, mode, t, plugin_force)), 0.0
        return direction * x[V], direction * dx[V]
    d, dd, b = bumper_deformation(x, context, params, mode, guard_index, t)
    sign = 1.0 - 2.0 * guard_index
    if not (mode >> guard_index) & 1:
        gap = (context[GAP_L] if guard_index else context[GAP_R]) + params[DRIFT] * t
        return gap + d - sign * x[U], params[DRIFT] + dd - sign * x[V]
    k, c = (params[K_L], params[C_L]) if guard_index else (params[K_R], params[C_R])
    slope = (k + 2.0 * params[K2] * abs(d)) * dd + (
        c + hunt_crossley_damping(d, params[CH])
    ) * sign * dx[V]
    slope += params[CH] * math.copysign(1.0, d) * dd * dd + params[KB] * dd - params[RATE_B] * b
    return bumper_force(params, guard_index, d, dd, b), slope


@jit_helper()
def find_guard_root(
    lo: float,
    hi: float,
    order: int,
    x: StateVector,
    k1: StateVector,
    context: StepContext,
    params: KernelParams,
    propagators: Float2D,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
    guard_index: int,
) -> float:
    """Return the time in s in [lo, hi] at which a guard (order 0) or its slope (1) changes sign.

    Bracketed Newton iteration from hi, so that a zero at lo, the start of a mode, is not found
    again. Without a slope it uses that of the chord.
    """
    motion, sign, chord, t = (x, k1), 0.0, 0.0, lo
    for attempt in range(82):
        if attempt > 0 or lo > 0.0:
            motion = advance_in_mode(
                t, x, k1, context, params, propagators, mode, direction, plugin_force
            )
        g, slope = guard_value(
            t, motion, context, params, mode, direction, plugin_force, guard_index
        )
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
    x: StateVector,
    k1: StateVector,
    end: StateAndRates,
    context: StepContext,
    params: KernelParams,
    propagators: Float2D,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
    guard_index: int,
) -> float:
    """Return the first time in s in [0, h] at which a guard turns negative, else inf.

    `end` is at h. As `contact_regime.contact_event_time`, finds a guard that dips within the step
    and skips the zero of the last event.
    """
    g0, d0 = guard_value(0.0, (x, k1), context, params, mode, direction, plugin_force, guard_index)
    g1, d1 = guard_value(h, end, context, params, mode, direction, plugin_force, guard_index)
    if g1 >= 0 and (d0 >= 0 or d1 <= 0 or g0 > -2 * h * d0):
        return math.inf
    tolerance, hi = GUARD_TOL, h
    if guard_index < REVERSAL_GUARD and (mode >> guard_index) & 1:
        tolerance = GUARD_TOL * (params[K_L] if guard_index else params[K_R])
    elif direction == 0.0 and guard_index == REVERSAL_GUARD:
        tolerance = 1e-12 * params[FC]
    if not (g1 < -tolerance or (g1 < 0 and d1 < 0 and guard_index < REVERSAL_GUARD)):
        if not (d0 < 0 < d1) or g0 > -2 * h * d0:
            return math.inf
        hi = find_guard_root(
            0.0,
            h,
            1,
            x,
            k1,
            context,
            params,
            propagators,
            mode,
            direction,
            plugin_force,
            guard_index,
        )
        motion = advance_in_mode(
            hi, x, k1, context, params, propagators, mode, direction, plugin_force
        )
        if (
            not guard_value(
                hi, motion, context, params, mode, direction, plugin_force, guard_index
            )[0]
            < -tolerance
        ):
            return math.inf
    if g0 > 0:
        return find_guard_root(
            0.0,
            hi,
            0,
            x,
            k1,
            context,
            params,
            propagators,
            mode,
            direction,
            plugin_force,
            guard_index,
        )
    # Just after an event the guard starts at zero, rounded either way: find where it is positive.
    lo = hi
    for _ in range(45):
        lo *= 0.5
        motion = advance_in_mode(
            lo, x, k1, context, params, propagators, mode, direction, plugin_force
        )
        if (
            guard_value(lo, motion, context, params, mode, direction, plugin_force, guard_index)[0]
            > tolerance
        ):
            return find_guard_root(
                lo,
                2 * lo,
                0,
                x,
                k1,
                context,
                params,
                propagators,
                mode,
                direction,
                plugin_force,
                guard_index,
            )
    return 0.0


@jit_helper()
def integrate_to_event(
    h: float,
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    propagators: Float2D,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
    search: bool,
) -> tuple[float, int, StateAndRates]:
    """Return (time in s, guard or -1, state and rates) at the first event within h s, else at h."""
    k1 = state_rates(x, context, params, mode, direction, 0.0, plugin_force)
    end = advance_in_mode(h, x, k1, context, params, propagators, mode, direction, plugin_force)
    dt, event_guard = h, -1
    for guard_index in range((2 + int(params[REVERSAL_EVENTS])) if search else 0):
        t = guard_event_time(
            h, x, k1, end, context, params, propagators, mode, direction, plugin_force, guard_index
        )
        if t < dt or (event_guard < 0 and t == dt):
            dt, event_guard = t, guard_index
    if event_guard >= 0:
        end = advance_in_mode(
            dt, x, k1, context, params, propagators, mode, direction, plugin_force
        )
    return dt, event_guard, end


REVISION = source_revision(globals()) ^ LAWS_REVISION
