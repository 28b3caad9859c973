"""Compiled kernel of `event_integrator` on sampled table acceleration: state in, state out.

The state is float64 (STATE_SIZE,):
    u, v, u_r, u_l, contact_r, contact_l, A      as in `closed_form`
    f, b_r, b_l                                  branch forces in N, of u's sign
    z, s                                         hysteresis; states of added laws, `MAX_STATES`
    direction                                    sign of u', 0 where the mass sticks
    clock                                        samples since sample 0 of the run
There is no other memory: results are bit-identical for any division of the samples into blocks.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import float64, types

from table_io.block import Float1D, Float2D
from table_io.compilation import (
    jit_helper,
    jit_helper_unless_none,
    jit_kernel,
)
from twin.laws.properties import MAX_STATES
from twin.model.event_location import REVERSAL_GUARD, StateAndRates, integrate_to_event
from twin.model.force_laws import (
    LAWS_TYPES,
    PLAIN_TYPES,
    AddedLaws,
    Coefficients,
    LawInputs,
    Motion,
    Start,
    bumper_coefficients,
    bumper_dashpot,
    bumper_deformation,
    bumper_force,
    hysteretic_variable,
    set_drive,
    static_friction,
)
from twin.model.solver import OUTPUT_COUNT

U, V, U_R, U_L, CONTACT_R, CONTACT_L, STATE_BASE, STATE_F, STATE_B_R, STATE_B_L, STATE_Z = range(11)
STATE_S = STATE_Z + 1
DIRECTION, CLOCK, STATE_SIZE = (STATE_S + MAX_STATES + n for n in range(3))
DENORMAL_LIMIT = 1e-30  # m, N, 1: smaller values are set to zero
MAX_EVENTS_PER_STEP = 60  # only rounding can come near it


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
    """Return 0 for a value that has decayed."""
    return value if abs(value) > DENORMAL_LIMIT else 0.0


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


@jit_helper_unless_none("events", lambda events, t, guard, start: None)
def log_event(events: Any, t: float, guard: int, start: Start) -> None:
    """Append (time in s, guard, contact or direction after it, u in m); see `advance_step`."""
    log = events[-1]
    index = int(log[0])
    if index < events.shape[0] - 1:
        after = start.direction if guard == REVERSAL_GUARD else float((start.mode >> guard) & 1)
        events[index, 0], events[index, 1] = log[1] + t, guard
        events[index, 2], events[index, 3] = after, start.u
    log[0] += 1.0


@jit_helper()
def advance_step(
    h: float, x: Motion, start: Start, p: Coefficients, propagators: Float2D,
    laws: AddedLaws | None, events: Float2D | None,
) -> tuple[StateAndRates, Start]:  # fmt: skip
    """Return (state and rates, start of the next step) after h s through any events.

    events (m + 1, 4), or None: (time in s, guard 0 right, 1 left or 2 reversal, contact or
    direction after it, u in m) of up to m events; the last row holds their number, which may be
    more, and the time at which this step starts.
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
        log_event(events, t, guard, start)
    u, v, u_r, u_l, f, b_r, b_l, s = x
    f, b_r, b_l = flush_value(f), flush_value(b_r), flush_value(b_l)
    s = flush_states(s)
    may_stretch = p.has_bumper_states or p.pull > 0.0
    u_r = u_r if start.mode & 1 else flush_face(u_r, 1.0, b_r != 0.0 or may_stretch)
    u_l = u_l if start.mode & 2 else flush_face(u_l, -1.0, b_l != 0.0 or may_stretch)
    return (Motion(u, v, u_r, u_l, f, b_r, b_l, s), motion[1]), start


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


def _integrate_samples(
    state: Float1D,
    p: Coefficients,
    propagators: Float2D,
    laws: AddedLaws | None,
    base_acc: Float1D,
    out: Float2D,
) -> None:
    """Advance `state` through the samples of A in m/s2, (n,), linear between; fill out (7, n).

    After a sample that is not finite all but the clock is NaN until a restart.
    """
    if state.size < STATE_SIZE or out.shape[0] < OUTPUT_COUNT or out.shape[1] < base_acc.size:
        raise ValueError("state or out is too small for these samples; see Solver.advance")
    x = Motion(
        state[U], state[V], state[U_R], state[U_L],
        state[STATE_F], state[STATE_B_R], state[STATE_B_L], read_states(state, laws),
    )  # fmt: skip
    mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
    clock, base = state[CLOCK], state[STATE_BASE]
    start = Start(x.u, state[STATE_Z], 0.0, 0.0, base, 0.0, mode, state[DIRECTION])
    for i in range(base_acc.size):
        for substep in range(p.substeps):
            slope = (base_acc[i] - base) / (p.step * (p.substeps - substep))
            time = (clock + i + substep / p.substeps) * p.period
            x, start = set_start(x, start, p, time, base, slope)
            motion, start = advance_step(p.step, x, start, p, propagators, laws, None)
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


def _compile_kernel(coefficients_type: types.Type, laws_type: types.Type) -> Callable[..., None]:
    kernel_type = types.void(
        float64[::1], coefficients_type, float64[:, ::1], laws_type, _READ, _OUT
    )
    return jit_kernel(kernel_type, cache=True)(_integrate_samples)


integrate_samples = _compile_kernel(*PLAIN_TYPES)


@cache
def build_laws_kernel() -> Callable[..., None]:
    """Return `integrate_samples` for models with added laws; only they wait for its compilation."""
    return _compile_kernel(*LAWS_TYPES)
