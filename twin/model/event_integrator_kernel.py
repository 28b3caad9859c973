"""Compiled kernel of `event_integrator` on sampled table acceleration: state in, state out.

The state is float64 (STATE_SIZE,):
    u, v, u_r, u_l, contact_r, contact_l, A      as in `closed_form`
    f, b_r, b_l                                  branch forces in N, of u's sign
    z, direction                                 hysteresis; sign of u', 0 where the mass sticks
    clock                                        samples since sample 0 of the run
There is no other memory: results are bit-identical for any division of the samples into blocks.
"""

import math
from collections.abc import Callable

from numba import float64, types

from table_io.block import Float1D, Float2D
from twin.model.compilation import jit_helper, jit_kernel, source_revision
from twin.model.event_location import REVERSAL_GUARD, StateAndRates, integrate_to_event
from twin.model.event_location import REVISION as EVENTS_REVISION
from twin.model.force_laws import (
    C_L,
    C_R,
    CH,
    DRIFT,
    FC,
    FY,
    G_L,
    G_R,
    GAP_L,
    GAP_R,
    KB,
    KERNEL_PARAMS_SIZE,
    PERIOD,
    PLUGIN_FORCE_TYPE,
    STEP,
    SUBSTEPS,
    U_0,
    U_L,
    U_R,
    UY,
    Z_0,
    KernelParams,
    PluginForce,
    StateVector,
    StepContext,
    U,
    V,
    bumper_deformation,
    bumper_force,
    hysteretic_variable,
    static_friction,
    table_acceleration,
)  # fmt: skip
from twin.model.solver import OUTPUT_COUNT

(
    CONTACT_R,
    CONTACT_L,
    STATE_BASE,
    STATE_F,
    STATE_B_R,
    STATE_B_L,
    STATE_Z,
    DIRECTION,
    CLOCK,
    STATE_SIZE,
) = range(4, 14)
DENORMAL_LIMIT = 1e-30  # m, N, 1: smaller values are set to zero
MAX_EVENTS_PER_STEP = 60  # only rounding can come near it


@jit_helper(inlined=True)
def next_step_context(
    context: StepContext, x: StateVector, t: float, direction: float, params: KernelParams
) -> StepContext:
    """Return the context of a step that begins at state x, t s into this one."""
    z = context[Z_0]
    if params[FY] > 0.0 and direction != 0.0:
        z = hysteretic_variable(z, x[U] - context[U_0], direction, params[UY])
    _, _, gap_r, gap_l, base, slope, peak, w, phase = context
    opening = params[DRIFT] * t
    return (
        x[U],
        z,
        gap_r + opening,
        gap_l + opening,
        base + slope * t,
        slope,
        peak,
        w,
        phase + w * t,
    )


@jit_helper()
def apply_event(
    guard_index: int,
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
) -> tuple[StateVector, int, float]:
    """Return (state, mode, direction) after an event at x, where `context` begins."""
    u, v, u_r, u_l, f, b_r, b_l = x
    if guard_index == REVERSAL_GUARD:
        v = 0.0
        x = (u, v, u_r, u_l, f, b_r, b_l)
        friction = static_friction(x, context, params, mode, 0.0, plugin_force)
        if direction != 0.0 and abs(friction) <= params[FC]:
            direction = 0.0 if params[FC] > 0.0 else -direction
        else:
            direction = math.copysign(1.0, friction)
        return x, mode, direction
    mode ^= 1 << guard_index
    # A face without memory returns immediately.
    c = params[C_R] if guard_index == 0 else params[C_L]
    memoryless = c + params[CH] == 0.0 and params[KB] == 0.0
    if guard_index == 0 and mode & 1:
        u_r = u - context[GAP_R]
    elif guard_index == 0 and memoryless:
        u_r = 0.0
    elif guard_index == 1 and mode & 2:
        u_l = u + context[GAP_L]
    elif guard_index == 1 and memoryless:
        u_l = 0.0
    return (u, v, u_r, u_l, f, b_r, b_l), mode, direction


@jit_helper(inlined=True)
def flush_to_zero(u_j: float, sign: float, b: float) -> float:
    """Return u_j of a free face: zero once decayed, or overshot with no branch force driving it."""
    return 0.0 if abs(u_j) < DENORMAL_LIMIT or (sign * u_j < 0.0 and b == 0.0) else u_j


@jit_helper()
def advance_step(
    h: float,
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    propagators: Float2D,
    mode: int,
    direction: float,
    plugin_force: PluginForce,
) -> tuple[StateAndRates, StepContext, int, float]:
    """Return (state and rates, context, mode, direction) after h s through any events."""
    t, motion = 0.0, (x, x)
    for attempt in range(MAX_EVENTS_PER_STEP):
        search = attempt + 1 < MAX_EVENTS_PER_STEP
        dt, guard_index, motion = integrate_to_event(
            h - t, x, context, params, propagators, mode, direction, plugin_force, search
        )
        x = motion[0]
        context = next_step_context(context, x, dt, direction, params)
        t += dt
        if guard_index < 0:
            break
        x, mode, direction = apply_event(
            guard_index, x, context, params, mode, direction, plugin_force
        )
    u, v, u_r, u_l, f, b_r, b_l = x
    f, b_r = f if abs(f) > DENORMAL_LIMIT else 0.0, b_r if abs(b_r) > DENORMAL_LIMIT else 0.0
    b_l = b_l if abs(b_l) > DENORMAL_LIMIT else 0.0
    u_r = u_r if mode & 1 else flush_to_zero(u_r, 1.0, b_r)
    u_l = u_l if mode & 2 else flush_to_zero(u_l, -1.0, b_l)
    return ((u, v, u_r, u_l, f, b_r, b_l), motion[1]), context, mode, direction


@jit_helper(inlined=True)
def set_step_context(
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    mode: int,
    time: float,
    base: float,
    slope: float,
) -> tuple[StateVector, StepContext]:
    """Return x and the context at a time in s since sample 0; gaps and drive do not accumulate."""
    gap_r, gap_l = params[G_R] + params[DRIFT] * time, params[G_L] + params[DRIFT] * time
    u, v, u_r, u_l, f, b_r, b_l = x
    x = (u, v, u - gap_r if mode & 1 else u_r, u + gap_l if mode & 2 else u_l, f, b_r, b_l)
    return x, (u, context[Z_0], gap_r, gap_l, base, slope, context[6], context[7], context[8])


@jit_helper(inlined=True)
def contact_force(
    x: StateVector, context: StepContext, params: KernelParams, mode: int, side: int
) -> float:
    """Return F_R >= 0 or F_L <= 0 in N at the start of a step."""
    if not (mode >> side) & 1:
        return 0.0
    d, dd, b = bumper_deformation(x, context, params, mode, side, 0.0)
    return (1.0 - 2.0 * side) * max(0.0, bumper_force(params, side, d, dd, b))


_READ = types.Array(float64, 1, "A", readonly=True)
_OUT = types.Array(float64, 2, "A")
REVISION = source_revision(globals()) ^ EVENTS_REVISION


_PARAMS = types.UniTuple(float64, KERNEL_PARAMS_SIZE)
_KERNEL = types.void(float64[::1], _PARAMS, float64[:, ::1], PLUGIN_FORCE_TYPE, _READ, _OUT)


def _build_kernel(revision: int) -> Callable[..., None]:
    """Return the kernel; `revision` is a free variable of it and so part of numba's cache key."""

    @jit_kernel(_KERNEL, cache=True)
    def integrate_samples(
        state: Float1D,
        params: KernelParams,
        propagators: Float2D,
        plugin_force: PluginForce,
        base_acc: Float1D,
        out: Float2D,
    ) -> None:
        """Advance `state` through the samples of A in m/s2, (n,), linear between; fill out (7, n).

        After a sample that is not finite all but the clock is NaN until a restart.
        """
        if revision < 0:
            return
        if state.size < STATE_SIZE or out.shape[0] < OUTPUT_COUNT or out.shape[1] < base_acc.size:
            raise ValueError("state or out is too small for these samples; see Solver.advance")
        substeps, h = int(params[SUBSTEPS]), params[STEP]
        x = (
            state[U],
            state[V],
            state[U_R],
            state[U_L],
            state[STATE_F],
            state[STATE_B_R],
            state[STATE_B_L],
        )
        mode = int(state[CONTACT_R] > 0) + 2 * int(state[CONTACT_L] > 0)
        direction, clock, base = state[DIRECTION], state[CLOCK], state[STATE_BASE]
        context = (x[U], state[STATE_Z], 0.0, 0.0, base, 0.0, 0.0, 0.0, 0.0)
        for i in range(base_acc.size):
            for substep in range(substeps):
                slope = (base_acc[i] - base) / (h * (substeps - substep))
                time = (clock + i + substep / substeps) * params[PERIOD]
                x, context = set_step_context(x, context, params, mode, time, base, slope)
                motion, context, mode, direction = advance_step(
                    h, x, context, params, propagators, mode, direction, plugin_force
                )
                x, base = motion[0], base + slope * h if substep + 1 < substeps else base_acc[i]
            if not math.isfinite(base) or not math.isfinite(x[U]):
                base = math.nan
                x = (base, base, base, base, base, base, base)
            x, context = set_step_context(
                x, context, params, mode, (clock + i + 1) * params[PERIOD], base, 0.0
            )
            flight_force = base - base
            out[0, i], out[1, i], out[2, i] = (
                x[U],
                x[V],
                motion[1][V] + table_acceleration(context, 0.0),
            )
            out[3, i] = contact_force(x, context, params, mode, 0) + flight_force
            out[4, i] = contact_force(x, context, params, mode, 1) + flight_force
            out[5, i], out[6, i] = x[U_R], x[U_L]
        (
            state[U],
            state[V],
            state[U_R],
            state[U_L],
            state[STATE_F],
            state[STATE_B_R],
            state[STATE_B_L],
        ) = x
        state[CONTACT_R], state[CONTACT_L] = float(mode & 1), float(mode >> 1)
        state[STATE_BASE], state[STATE_Z], state[DIRECTION] = base, context[Z_0], direction
        if math.isnan(base):
            state[:CLOCK] = math.nan
        state[CLOCK] = clock + base_acc.size

    return integrate_samples


integrate_samples = _build_kernel(REVISION)
