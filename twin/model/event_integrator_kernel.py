"""Compiled kernel of `event_integrator`: each step up to its first event, located to roundoff.

The state is float64 (STATE_SIZE,):
    u, v, u_r, u_l, contact_r, contact_l, A      as in `closed_form`
    f, b_r, b_l                                  branch forces in N, of u's sign
    z, s                                         hysteresis; states of added laws, `MAX_STATES`
    direction                                    sign of u', 0 where the mass sticks
    clock                                        samples since sample 0 of the run
There is no other memory: results are bit-identical for any division of the samples into blocks.

Between events the right-hand side is smooth, so the Runge-Kutta formula keeps its order: an event
lies where a step of exactly that length makes a guard zero. Guards are clearance or push of a side,
u' in its direction, or the friction reserve while the mass sticks. Linear models use their exact
propagator instead.

Source of the formula: Dormand and Prince 1980, J. Comput. Appl. Math. 6(1), the order 5 part.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_helper, jit_helper_unless_none, jit_kernel
from twin.laws.properties import MAX_STATES
from twin.model.event_location import Accuracy, locate_event
from twin.model.force_laws import (
    LAWS_TYPES,
    PLAIN_TYPES,
    AddedLaws,
    Coefficients,
    LawInputs,
    Motion,
    Start,
    add_law_force,
    add_scaled_inputs,
    bumper_coefficients,
    bumper_dashpot,
    bumper_deformation,
    bumper_force,
    hunt_crossley_damping,
    hysteretic_variable,
    set_drive,
    state_rates,
    static_friction,
)
from twin.model.solver import OUTPUT_COUNT

U, V, U_R, U_L, CONTACT_R, CONTACT_L, STATE_BASE, STATE_F, STATE_B_R, STATE_B_L, STATE_Z = range(11)
STATE_S = STATE_Z + 1
DIRECTION, CLOCK, STATE_SIZE = (STATE_S + MAX_STATES + n for n in range(3))

GUARD_TOL = 1e-14  # m and m/s: smaller values are rounding errors
FRICTION_TOL = 1e-12  # of the friction: a smaller reserve is a rounding error
DENORMAL_LIMIT = 1e-30  # m, N, 1: smaller values are set to zero
MAX_EVENTS_PER_STEP = 60  # only rounding can come near it
MAX_SERIES_TERMS = 60  # of the Taylor series; a step needs far fewer
REVERSAL_GUARD = 2  # 0 and 1 are the guards of the sides
LINEAR_SIZE = 12  # of the state of linear propagation, see `event_integrator._generator_matrix`
LAW_SLOPE_STEP_S = 1e-6  # s: of the difference quotient of an added law
ACCURACY = Accuracy(value_tolerance=1e-12, slope_tolerance=1e-12, is_analytic=False)

StateAndRates = tuple[Motion, Motion]  # a state and its rates
# Start of a step: state and its rates, and what the motion depends on.
StepStart = tuple[Motion, Motion, Start, Coefficients, Float2D, AddedLaws | None]


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
def evaluate_guard(t: float, step: StepStart, guard: int) -> tuple[float, float, float]:
    """Return (guard, its slope, 0: its curvature is not known) t s into a step."""
    x, k1, start, p, propagators, laws = step
    motion = advance_in_mode(t, x, k1, start, p, propagators, laws)
    g, slope = guard_value(t, motion, start, p, laws, guard)
    return g, slope, 0.0


@jit_helper()
def guard_tolerance(guard: int, start: Start, p: Coefficients) -> float:
    """Return the value of a guard up to which it is a rounding error."""
    if guard < REVERSAL_GUARD and (start.mode >> guard) & 1:
        return GUARD_TOL * (p.k_l if guard else p.k_r)
    if start.direction == 0.0 and guard == REVERSAL_GUARD:
        return FRICTION_TOL * p.fc
    return GUARD_TOL


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
    step = (x, k1, start, p, propagators, laws)
    dt, event_guard = h, -1
    for guard in range((2 + int(p.has_reversals)) if search else 0):
        g0, d0 = guard_value(0.0, (x, k1), start, p, laws, guard)
        g1, d1 = guard_value(h, end, start, p, laws, guard)
        if g1 >= 0 and (d0 >= 0 or d1 <= 0 or g0 > -2 * h * d0):
            continue
        tolerance = guard_tolerance(guard, start, p)
        is_contact = guard < REVERSAL_GUARD
        t = locate_event(
            h, (g0, d0), (g1, d1), tolerance, is_contact, ACCURACY, evaluate_guard, step, guard
        )
        if t < dt or (event_guard < 0 and t == dt):
            dt, event_guard = t, guard
    if event_guard >= 0:
        end = advance_in_mode(dt, x, k1, start, p, propagators, laws)
    return dt, event_guard, end


@jit_helper(inlined=True)
def next_start(start: Start, x: Motion, t: float, p: Coefficients) -> Start:
    """Return the start of a step that begins at state x, t s into this one."""
    z = start.z
    if p.fy > 0.0 and start.direction != 0.0:
        z = hysteretic_variable(z, x.u - start.u, start.direction, p.uy)
    opening = p.drift * t
    return Start(
        x.u, z, start.gap_r + opening, start.gap_l + opening, start.base + start.slope * t,
        start.slope, start.mode, start.direction,
    )  # fmt: skip


@jit_helper()
def apply_event(
    guard: int, x: Motion, start: Start, p: Coefficients, laws: AddedLaws | None
) -> tuple[Motion, Start]:
    """Return (state, start of the next step) after an event at x, where `start` begins."""
    u, v, u_r, u_l, f, b_r, b_l, s = x
    _, z, gap_r, gap_l, base, slope, mode, direction = start
    if guard == REVERSAL_GUARD:
        v = 0.0
        x = Motion(u, v, u_r, u_l, f, b_r, b_l, s)
        friction = static_friction(x, start, p, 0.0, laws)
        if direction != 0.0 and abs(friction) <= p.fc:
            direction = 0.0 if p.fc > 0.0 else -direction
        else:
            direction = math.copysign(1.0, friction)
        return x, Start(u, z, gap_r, gap_l, base, slope, mode, direction)
    mode ^= 1 << guard
    if (mode >> guard) & 1:
        u_r, u_l = (u - gap_r, u_l) if guard == 0 else (u_r, u + gap_l)
    elif _is_memoryless(guard, u_r if guard == 0 else -u_l, x, p, laws):
        # A face without memory returns immediately.
        u_r, u_l = (0.0, u_l) if guard == 0 else (u_r, 0.0)
    x = Motion(u, v, u_r, u_l, f, b_r, b_l, s)
    return x, Start(u, z, gap_r, gap_l, base, slope, mode, direction)


@jit_helper(inlined=True)
def _is_memoryless(side: int, d: float, x: Motion, p: Coefficients, laws: AddedLaws | None) -> bool:
    """Return whether nothing delays the recovery of a bumper released at deformation d."""
    _, c = bumper_coefficients(p, side)
    if c + p.ch != 0.0 or p.kb != 0.0:
        return False
    return bumper_dashpot(p, side, d, x.s, laws) <= 0.0


@jit_helper(inlined=True)
def flush_face(u_j: float, sign: float, is_driven: bool) -> float:
    """Return u_j of a free face: zero once decayed, or overshot with no branch driving it."""
    return 0.0 if abs(u_j) < DENORMAL_LIMIT or (sign * u_j < 0.0 and not is_driven) else u_j


@jit_helper(inlined=True)
def flush_value(value: float) -> float:
    """Return 0 for a value that has decayed; NaN stays NaN."""
    return 0.0 if abs(value) <= DENORMAL_LIMIT else value


@jit_helper_unless_none("s", lambda s: None)
def flush_states(s: Any) -> LawInputs | None:
    """Return the inputs of added laws, their states zero where decayed."""
    states, base, time = s
    states = (
        flush_value(states[0]), flush_value(states[1]), flush_value(states[2]),
        flush_value(states[3]), flush_value(states[4]), flush_value(states[5]),
    )  # fmt: skip
    return LawInputs(states, base, time)


@jit_helper_unless_none("laws", lambda state, laws: None)
def read_states(state: Float1D, laws: Any) -> LawInputs | None:
    """Return the inputs of added laws with their states in a state, before `set_start`."""
    states = (
        state[STATE_S], state[STATE_S + 1], state[STATE_S + 2], state[STATE_S + 3],
        state[STATE_S + 4], state[STATE_S + 5],
    )  # fmt: skip
    return LawInputs(states, state[STATE_BASE], 0.0)


@jit_helper_unless_none("s", lambda state, s: None)
def write_states(state: Float1D, s: Any) -> None:
    """Write the states of added laws into a state."""
    for index in range(MAX_STATES):
        state[STATE_S + index] = s.states[index]


@jit_helper()
def log_event(events: Float2D, count: int, t: float, guard: int, start: Start) -> int:
    """Write (time in s, guard, contact or direction after it, u in m) if it fits; return count."""
    if count < events.shape[0]:
        after = start.direction if guard == REVERSAL_GUARD else float((start.mode >> guard) & 1)
        events[count, 0], events[count, 1] = t, guard
        events[count, 2], events[count, 3] = after, start.u
    return count + 1


@jit_helper()
def advance_step(
    h: float,
    x: Motion,
    start: Start,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
    events: Float2D,
    count: int,
    begin: float,
) -> tuple[StateAndRates, Start, int]:
    """Return (state and rates, start of the next step, events) after h s through any events.

    events: as `integrate_samples`, of which `count` are known; the step starts at `begin` s.
    """
    t, motion = 0.0, (x, x)
    for attempt in range(MAX_EVENTS_PER_STEP):
        search = attempt + 1 < MAX_EVENTS_PER_STEP
        dt, guard, motion = integrate_to_event(h - t, x, start, p, propagators, laws, search)
        x = motion[0]
        start = next_start(start, x, dt, p)
        t += dt
        if guard < 0:
            break
        x, start = apply_event(guard, x, start, p, laws)
        count = log_event(events, count, begin + t, guard, start)
    u, v, u_r, u_l, f, b_r, b_l, s = x
    # At rest the laws see u' = REVERSAL_SPEED_M_S; the force of what that moves has no sign.
    u, v = flush_value(u), flush_value(v)
    f, b_r, b_l = flush_value(f), flush_value(b_r), flush_value(b_l)
    s = flush_states(s)
    may_stretch = p.has_bumper_states or p.pull > 0.0
    u_r = u_r if start.mode & 1 else flush_face(u_r, 1.0, b_r != 0.0 or may_stretch)
    u_l = u_l if start.mode & 2 else flush_face(u_l, -1.0, b_l != 0.0 or may_stretch)
    return (Motion(u, v, u_r, u_l, f, b_r, b_l, s), motion[1]), start, count


@jit_helper(inlined=True)
def set_start(
    x: Motion, start: Start, p: Coefficients, time: float, base: float, slope: float
) -> tuple[Motion, Start]:
    """Return x and the start at a time in s since sample 0; gaps and drive do not accumulate."""
    gap_r, gap_l = p.gap_r + p.drift * time, p.gap_l + p.drift * time
    u, v, u_r, u_l, f, b_r, b_l, s = x
    u_r = u - gap_r if start.mode & 1 else u_r
    u_l = u + gap_l if start.mode & 2 else u_l
    x = Motion(u, v, u_r, u_l, f, b_r, b_l, set_drive(s, base, time))
    return x, Start(u, start.z, gap_r, gap_l, base, slope, start.mode, start.direction)


@jit_helper(inlined=True)
def contact_force(
    x: Motion, start: Start, p: Coefficients, side: int, laws: AddedLaws | None
) -> float:
    """Return F_R >= 0 or F_L <= 0 in N at the start of a step; tension only with adhesion."""
    if not (start.mode >> side) & 1:
        return 0.0
    d, dd, b = bumper_deformation(x, start, p, side, 0.0, laws)
    return (1.0 - 2.0 * side) * max(-p.pull, bumper_force(p, side, d, dd, b, x.s, laws))


_READ = types.Array(float64, 1, "A", readonly=True)
_OUT = types.Array(float64, 2, "A")


def integrate_samples(
    state: Float1D,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
    base_acc: Float1D,
    out: Float2D,
    events: Float2D,
) -> int:
    """Advance `state` through the samples of A in m/s2, (n,), linear between; fill out (7, n).

    events (m, 4): time in s since the sample where the call began; guard 0 right, 1 left or 2
    reversal; contact or direction after it; u in m. Their number, which may be more, is returned.
    After a sample that is not finite all but the clock is NaN until a restart.
    """
    if state.size < STATE_SIZE or out.shape[0] < OUTPUT_COUNT or out.shape[1] < base_acc.size:
        raise ValueError("state or out is too small for these samples; see Solver.advance")
    x = Motion(
        state[U], state[V], state[U_R], state[U_L],
        state[STATE_F], state[STATE_B_R], state[STATE_B_L], read_states(state, laws),
    )  # fmt: skip
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    clock, base, count = state[CLOCK], state[STATE_BASE], 0
    start = Start(x.u, state[STATE_Z], 0.0, 0.0, base, 0.0, mode, state[DIRECTION])
    for i in range(base_acc.size):
        for substep in range(p.substeps):
            slope = (base_acc[i] - base) / (p.step * (p.substeps - substep))
            time = (clock + i + substep / p.substeps) * p.period
            x, start = set_start(x, start, p, time, base, slope)
            begin = (i + substep / p.substeps) * p.period
            motion, start, count = advance_step(
                p.step, x, start, p, propagators, laws, events, count, begin
            )
            x = motion[0]
            base = base + slope * p.step if substep + 1 < p.substeps else base_acc[i]
        if not math.isfinite(base) or not math.isfinite(x.u):
            base = math.nan
            x = Motion(base, base, base, base, base, base, base, x.s)
        x, start = set_start(x, start, p, (clock + i + 1) * p.period, base, 0.0)
        flight_force = base - base
        out[0, i], out[1, i], out[2, i] = x.u, x.v, motion[1].v + start.base
        out[3, i] = contact_force(x, start, p, 0, laws) + flight_force
        out[4, i] = contact_force(x, start, p, 1, laws) + flight_force
        out[5, i], out[6, i] = x.u_r, x.u_l
    state[U], state[V], state[U_R], state[U_L] = x.u, x.v, x.u_r, x.u_l
    state[STATE_F], state[STATE_B_R], state[STATE_B_L] = x.f, x.b_r, x.b_l
    state[CONTACT_R], state[CONTACT_L] = float(start.mode & 1), float(start.mode >> 1)
    state[STATE_BASE], state[STATE_Z], state[DIRECTION] = base, start.z, start.direction
    write_states(state, x.s)
    if math.isnan(base):
        state[:CLOCK] = math.nan
    state[CLOCK] = clock + base_acc.size
    return count


@cache
def build_kernel(has_laws: bool) -> Callable[..., int]:
    """Return `integrate_samples`, compiled or loaded at the first call, with added laws or without.

    Models that have a closed form never wait for it, and only those with added laws for theirs.
    """
    coefficients, laws = LAWS_TYPES if has_laws else PLAIN_TYPES
    kernel_type = int64(float64[::1], coefficients, float64[:, ::1], laws, _READ, _OUT, _OUT)
    return jit_kernel(kernel_type)(integrate_samples)
