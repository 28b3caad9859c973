"""Force laws of all effects in one compiled right-hand side, with their coefficients.

    M u'' + C u' + K u + k3 u^3 + c2 u' |u'| + Fc sign(u') + Fy z + f + extra + F_R + F_L = -M A
    contact: F_j = (C_j + ch |u_j|) u_j' + K_j u_j + k2 u_j |u_j| + b_j
             u_R = u - G0R, u_L = u + G0L
    flight:  F_j = 0, that sum is zero and u_j relaxes
    f' = k1 u' - f / tau1,  b_j' = kb u_j' - b_j / tau,  G0j grows with `DRIFT`

SI, right positive. Each term is described in its file in `effects`; `extra` is the force of
plug-ins. An effect with a zero coefficient is absent. Sides are 0 = right, 1 = left; `mode` =
contact_r + 2 contact_l; `direction` is the sign of u', 0 where the mass sticks.
"""

import math
from collections.abc import Callable
from functools import cache
from typing import Any

from numba import float64, types

from twin.model.compilation import jit_helper, jit_kernel, source_revision
from twin.model.effects import (
    bouc_wen,
    bumper_hardening,
    coulomb_friction,
    cubic_stiffness,
    hunt_crossley,
    quadratic_damping,
)

# State at one time: u, u', u_R, u_L, f, b_R, b_L; or its rates.
StateVector = tuple[float, float, float, float, float, float, float]
U, V, U_R, U_L, F, B_R, B_L = range(7)
# Start of a step: u, z, gaps, and the drive A = base + slope t + peak sin(phase + w t).
StepContext = tuple[float, float, float, float, float, float, float, float, float]
U_0, Z_0, GAP_R, GAP_L, BASE, SLOPE, PEAK, W, PHASE = range(9)
# Size of the state of linear propagation, see `event_integrator._generator_matrix`.
LINEAR_SIZE = 12

# Indices of coefficients: RATE_* are 1/tau; gaps at sample 0; sampling period, number of substeps
# and their length; flags: model is linear, reversals of u' are events, plug-ins add a force, whose
# coefficients begin at PLUGIN_FIRST.
MASS, K, C, K_R, K_L, C_R, C_L, K3, C2, FC, FY, UY, K1, RATE_1, K2, CH, KB, RATE_B, DRIFT = range(
    19
)
G_R, G_L, PERIOD, SUBSTEPS, STEP, IS_LINEAR, REVERSAL_EVENTS, HAS_PLUGIN, PLUGIN_FIRST = range(
    19, 28
)
MAX_PLUGIN_PARAMETERS = 8  # in total over all plug-ins of a model
KERNEL_PARAMS_SIZE = PLUGIN_FIRST + MAX_PLUGIN_PARAMETERS
KernelParams = tuple[float, ...]

NO_WALL_M = 1e9  # m: gap of an absent bumper; finite, so that zero times it is zero
PLUGIN_FORCE_SIGNATURE = float64(float64, float64, types.UniTuple(float64, MAX_PLUGIN_PARAMETERS))
PLUGIN_FORCE_TYPE = types.FunctionType(PLUGIN_FORCE_SIGNATURE)
PluginForce = Callable[[float, float, KernelParams], float]

cubic_force = jit_helper(inlined=True)(cubic_stiffness.force)
quadratic_force = jit_helper(inlined=True)(quadratic_damping.force)
coulomb_force = jit_helper(inlined=True)(coulomb_friction.force)
hysteretic_variable = jit_helper()(bouc_wen.hysteretic_variable)
hardening_force = jit_helper(inlined=True)(bumper_hardening.force)
hunt_crossley_damping = jit_helper(inlined=True)(hunt_crossley.damping)


@jit_kernel(PLUGIN_FORCE_SIGNATURE, cache=True)
def no_plugin_force(u: float, v: float, c: KernelParams) -> float:
    """Return 0 N, the force without plug-ins."""
    return 0.0


@jit_helper(inlined=True)
def bumper_force(params: KernelParams, side: int, d: float, dd: float, b: float) -> float:
    """Return the push of a bumper in N; deformation d, rate dd, branch force b: compression > 0."""
    k, c = (params[K_R], params[C_R]) if side == 0 else (params[K_L], params[C_L])
    return (
        k * d + (c + hunt_crossley_damping(d, params[CH])) * dd + hardening_force(d, params[K2]) + b
    )


@jit_helper(inlined=True)
def recovery_rate(params: KernelParams, side: int, d: float, b: float) -> float:
    """Return the rate in m/s of the deformation d of a free bumper; b as in `bumper_force`.

    Without a dashpot the face has no memory of its own: it lies where the springs balance.
    """
    if d == 0.0 and b == 0.0:
        return 0.0
    dashpot = (params[C_R] if side == 0 else params[C_L]) + hunt_crossley_damping(d, params[CH])
    if dashpot > 0.0:
        return -bumper_force(params, side, d, 0.0, b) / dashpot
    if b == 0.0:
        return 0.0
    k = params[K_R] if side == 0 else params[K_L]
    return b * params[RATE_B] / (k + 2 * params[K2] * abs(d) + params[KB])


@jit_helper(inlined=True)
def bumper_deformation(
    x: StateVector, context: StepContext, params: KernelParams, mode: int, side: int, t: float
) -> tuple[float, float, float]:
    """Return (d, d', b) of a bumper, t s into the step, positive in compression."""
    if side == 0:
        sign, uj, b, gap = 1.0, x[U_R], x[B_R], context[GAP_R]
    else:
        sign, uj, b, gap = -1.0, x[U_L], -x[B_L], context[GAP_L]
    if (mode >> side) & 1:
        return sign * x[U] - gap - params[DRIFT] * t, sign * x[V] - params[DRIFT], b
    d = sign * uj
    return d, recovery_rate(params, side, d, b), b


@jit_helper(inlined=True)
def internal_force(
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    mode: int,
    direction: float,
    t: float,
    plugin_force: PluginForce,
) -> float:
    """Return the sum in N of all forces on the left side of the equation of motion."""
    u, v = x[U], x[V]
    force = params[K] * u + params[C] * v + x[F]
    if params[IS_LINEAR] == 0.0:
        force += (
            cubic_force(u, params[K3])
            + quadratic_force(v, direction, params[C2])
            + coulomb_force(direction, params[FC])
        )
        if params[FY] > 0.0:
            # z is constant while the mass sticks.
            z = context[Z_0]
            if direction != 0.0:
                z = hysteretic_variable(z, u - context[U_0], direction, params[UY])
            force += params[FY] * z
        if params[HAS_PLUGIN] > 0.0:
            force += plugin_force(u, v, params[PLUGIN_FIRST:])
    if mode & 1:
        d, dd, b = bumper_deformation(x, context, params, mode, 0, t)
        force += bumper_force(params, 0, d, dd, b)
    if mode & 2:
        d, dd, b = bumper_deformation(x, context, params, mode, 1, t)
        force -= bumper_force(params, 1, d, dd, b)
    return force


@jit_helper(inlined=True)
def table_acceleration(context: StepContext, t: float) -> float:
    """Return the table acceleration in m/s2, t s into the step."""
    base = context[BASE] + context[SLOPE] * t
    if context[PEAK] != 0.0:
        base += context[PEAK] * math.sin(context[PHASE] + context[W] * t)
    return base


@jit_helper(inlined=True)
def state_rates(
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    mode: int,
    direction: float,
    t: float,
    plugin_force: PluginForce,
) -> StateVector:
    """Return d/dt of a state, t s into the step."""
    du, dv = 0.0, 0.0
    if direction != 0.0 or params[FC] == 0.0:
        force = internal_force(x, context, params, mode, direction, t, plugin_force)
        du, dv = x[V], -table_acceleration(context, t) - force / params[MASS]
    _, right, b_r = bumper_deformation(x, context, params, mode, 0, t)
    _, left, b_l = bumper_deformation(x, context, params, mode, 1, t)
    return (
        du, dv, right, -left, params[K1] * du - params[RATE_1] * x[F],
        params[KB] * right - params[RATE_B] * b_r, params[RATE_B] * b_l - params[KB] * left,
    )  # fmt: skip


@jit_helper(inlined=True)
def static_friction(
    x: StateVector,
    context: StepContext,
    params: KernelParams,
    mode: int,
    t: float,
    plugin_force: PluginForce,
) -> float:
    """Return the friction in N that holds the mass in place."""
    force = internal_force(x, context, params, mode, 0.0, t, plugin_force)
    return -(params[MASS] * table_acceleration(context, t) + force)


@cache
def combine_forces(forces: tuple[tuple[Callable[..., float], int], ...]) -> PluginForce:
    """Compile one `PluginForce` from (Python force, number of parameters) of each plug-in.

    Compiled once in every process: numba's cache on disk does not notice that a plug-in changed.
    """
    plugin_force: Any = no_plugin_force
    first = 0
    for force, size in forces:
        plugin_force, first = _add_force(plugin_force, jit_kernel()(force), first), first + size
    return jit_kernel(PLUGIN_FORCE_SIGNATURE)(plugin_force.py_func)


def _add_force(sum_before: Any, force: Any, first: int) -> Any:
    """Return `sum_before` plus a force whose parameters begin at `first`."""

    def both(u, v, c):  # type: ignore[no-untyped-def]
        own = (
            c[first],
            c[(first + 1) % MAX_PLUGIN_PARAMETERS],
            c[(first + 2) % MAX_PLUGIN_PARAMETERS],
            c[(first + 3) % MAX_PLUGIN_PARAMETERS],
            c[(first + 4) % MAX_PLUGIN_PARAMETERS],
            c[(first + 5) % MAX_PLUGIN_PARAMETERS],
            c[(first + 6) % MAX_PLUGIN_PARAMETERS],
            c[(first + 7) % MAX_PLUGIN_PARAMETERS],
        )
        return sum_before(u, v, c) + force(u, v, own)

    return jit_kernel()(both)


REVISION = source_revision(globals())
