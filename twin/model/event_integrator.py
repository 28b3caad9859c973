"""Event-driven solver of models with force laws or extra states: integrated, or exact if linear."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import expm

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.model import closed_form, force_laws
from twin.model.effects import bumper_hardening, cubic_stiffness
from twin.model.event_integrator_kernel import (
    CLOCK,
    DIRECTION,
    STATE_BASE,
    STATE_F,
    STATE_SIZE,
    STATE_Z,
    integrate_samples,
)
from twin.model.parameters import Parameters
from twin.model.solver import GRAVITY_M_S2, StateEstimate

if TYPE_CHECKING:
    from twin.model.model import Model

MAX_PHASE_STEP_RAD = 0.5  # rad per substep in the fastest mode
MAX_RELAXATIONS = 0.6  # relaxation times per substep, where it is integrated
MAX_LINEAR_RELAXATIONS = 2.0  # where it is propagated: the series converges without cancellation
MAX_SUBSTEPS = 500
HARDENING_DEPTH_M = 0.003  # m: compression at which the stiffness of a hardening bumper is taken

# (effect, parameter, coefficient index) of parameters that enter unchanged
EFFECT_COEFFICIENTS = (
    ("cubic_stiffness", "k3", force_laws.K3),
    ("quadratic_damping", "c2", force_laws.C2),
    ("coulomb_friction", "fc", force_laws.FC),
    ("bouc_wen", "force", force_laws.FY),
    ("bouc_wen", "yield_displacement", force_laws.UY),
    ("maxwell_damper", "k1", force_laws.K1),
    ("bumper_hardening", "k2", force_laws.K2),
    ("hunt_crossley", "ch", force_laws.CH),
    ("bumper_maxwell", "kb", force_laws.KB),
    ("gap_drift", "rate", force_laws.DRIFT),
)
RELAXATION_COEFFICIENTS = (
    ("maxwell_damper", "tau", force_laws.RATE_1),
    ("bumper_maxwell", "tau", force_laws.RATE_B),
)


@dataclass(frozen=True, slots=True, eq=False)
class EventDrivenSolver:
    """Event-driven solver of a model at one sampling rate.

    `parameters` at sample 0; `period` in s; `tilt` as in `ClosedFormSolver`.
    """

    parameters: Parameters
    period: float
    tilt: float
    params: force_laws.KernelParams
    propagators: Float2D
    plugin_force: force_laws.PluginForce

    @classmethod
    def from_model(cls, model: "Model", rate_hz: float) -> "EventDrivenSolver":
        params, plugin_force = kernel_params(model)
        set_substeps(params, rate_hz)
        tilt = GRAVITY_M_S2 * (model.effect_parameter("table_tilt", "tilt") or 0.0)
        return cls(
            model.parameters,
            1 / rate_hz,
            tilt,
            tuple(params.tolist()),
            build_propagators(params),
            plugin_force,
        )

    def rest_state(self, index: int = 0) -> Float1D:
        p = self._parameters_at(index)
        linear_state = closed_form.rest_state(p)
        u, coefficients = float(linear_state[0]), self.params
        if coefficients[force_laws.K3] or coefficients[force_laws.K2]:
            u = equilibrium_disp(p, u, coefficients[force_laws.K3], coefficients[force_laws.K2])
        state = self._blank_state(index)
        state[:6] = linear_state[:6]
        state[0] = u
        state[2], state[3] = max(u - p.gap_r, 0.0), min(u + p.gap_l, 0.0)
        return state

    def restart_state(self, start: StateEstimate) -> Float1D:
        base = start.base_acc + (self.tilt * start.table_disp if self.tilt else 0.0)
        state = self._blank_state(start.index)
        state[: STATE_BASE + 1] = closed_form.restart_state(
            start.u, start.v, start.u_r, start.u_l, start.contact_r, start.contact_l, base,
            self._parameters_at(start.index),
        )[: STATE_BASE + 1]  # fmt: skip
        if start.hidden is not None and np.isfinite(start.hidden).all():
            state[STATE_F : STATE_Z + 1] = start.hidden[STATE_F : STATE_Z + 1]
        if math.isnan(state[0]):
            state[:CLOCK] = math.nan
        elif start.v != 0:
            state[DIRECTION] = math.copysign(1.0, start.v)
        return state

    def set_clock(self, state: Float1D, samples: float) -> None:
        state[CLOCK] = samples

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        base = base_acc + self.tilt * table_disp if self.tilt else base_acc
        integrate_samples(state, self.params, self.propagators, self.plugin_force, base, out)
        if self.tilt:
            out[2] -= self.tilt * table_disp

    def _parameters_at(self, index: int) -> Parameters:
        """Return the parameters with the gaps at a sample."""
        opening = self.params[force_laws.DRIFT] * index * self.period
        p = self.parameters
        return replace(p, gap_r=p.gap_r + opening, gap_l=p.gap_l + opening) if opening else p

    def _blank_state(self, index: int) -> Float1D:
        """Return a relaxed state at rest; with friction it sticks until the solver detects slip."""
        state = np.zeros(STATE_SIZE)
        state[DIRECTION], state[CLOCK] = 0.0 if self.params[force_laws.FC] > 0 else 1.0, index
        return state


def kernel_params(model: "Model") -> tuple[Float1D, force_laws.PluginForce]:
    """Return (step-independent coefficients of `force_laws`, compiled force of the plug-ins)."""
    plugins = [plugin for plugin in model.present_effects if plugin.effect.force is not None]
    plugin_values = [plugin.values[p.name] for plugin in plugins for p in plugin.effect.parameters]
    if len(plugin_values) > force_laws.MAX_PLUGIN_PARAMETERS:
        raise InputError(
            f"plug-in effects have {len(plugin_values)} parameters in total",
            allowed=f"at most {force_laws.MAX_PLUGIN_PARAMETERS}",
            remedy="remove an effect",
        )
    params = np.zeros(force_laws.KERNEL_PARAMS_SIZE)
    p = model.parameters
    params[: force_laws.C_L + 1] = (
        p.mass, p.stiffness, p.damping, p.bumper_stiffness_r, p.bumper_stiffness_l,
        p.bumper_damping_r, p.bumper_damping_l,
    )  # fmt: skip
    params[force_laws.G_R], params[force_laws.G_L] = (
        min(p.gap_r, force_laws.NO_WALL_M),
        min(p.gap_l, force_laws.NO_WALL_M),
    )
    params[force_laws.UY] = 1.0
    for effect, parameter, index in EFFECT_COEFFICIENTS:
        params[index] = model.effect_parameter(effect, parameter) or params[index]
    for effect, parameter, index in RELAXATION_COEFFICIENTS:
        tau = model.effect_parameter(effect, parameter)
        params[index] = 1 / tau if tau else 0.0
    params[force_laws.HAS_PLUGIN], params[force_laws.PLUGIN_FIRST :][: len(plugin_values)] = (
        len(plugins),
        plugin_values,
    )
    params[force_laws.REVERSAL_EVENTS] = float(
        params[[force_laws.C2, force_laws.FC, force_laws.FY, force_laws.HAS_PLUGIN]].any()
    )
    nonlinear = (
        params[[force_laws.K3, force_laws.K2, force_laws.CH]].any()
        or params[force_laws.REVERSAL_EVENTS]
    )
    params[force_laws.IS_LINEAR] = float(not nonlinear)
    forces = tuple(
        (force, len(plugin.effect.parameters))
        for plugin in plugins
        if (force := plugin.effect.force)
    )
    return params, force_laws.combine_forces(forces) if forces else force_laws.no_plugin_force


def set_substeps(params: Float1D, rate_hz: float) -> None:
    """Write period, substeps and step, limiting phase and relaxation per substep; else InputError.

    A face relaxes with (K_j + k2 d + kb) / C_j: Hunt-Crossley damping vanishes at touch.
    """
    both_contacts = params[force_laws.G_R] + params[force_laws.G_L] <= 0
    sides = [
        params[force_laws.K_R + s]
        + 2 * params[force_laws.K2] * HARDENING_DEPTH_M
        + params[force_laws.KB]
        for s in range(2)
    ]
    k = params[force_laws.K] + params[force_laws.K1] + params[force_laws.FY] / params[force_laws.UY]
    max_frequency = math.sqrt(
        (k + (sum(sides) if both_contacts else max(sides))) / params[force_laws.MASS]
    )
    relaxation_rates = [params[force_laws.RATE_1], params[force_laws.RATE_B]]
    for s in range(2):
        if params[force_laws.C_R + s] > 0 and params[force_laws.G_R + s] < force_laws.NO_WALL_M / 2:
            relaxation_rates.append(
                (
                    params[force_laws.K_R + s]
                    + params[force_laws.K2] * HARDENING_DEPTH_M
                    + params[force_laws.KB]
                )
                / params[force_laws.C_R + s]
                + params[force_laws.RATE_B]
            )
    max_relaxations = MAX_LINEAR_RELAXATIONS if params[force_laws.IS_LINEAR] else MAX_RELAXATIONS
    substeps = max(
        1,
        math.ceil(max_frequency / MAX_PHASE_STEP_RAD / rate_hz),
        math.ceil(max(relaxation_rates) / max_relaxations / rate_hz),
    )
    if substeps > MAX_SUBSTEPS:
        raise InputError(
            f"too low for a relaxation in {1e3 / max(relaxation_rates):.2g} ms, which needs "
            f"{substeps} substeps per sample",
            key="rate_hz",
            value=float(rate_hz),
            allowed=f"at most {MAX_SUBSTEPS} substeps",
            remedy="raise rate_hz, tau or the bumper damping (or set the damping to 0: a bumper "
            "without memory)",
        )
    params[force_laws.PERIOD], params[force_laws.SUBSTEPS], params[force_laws.STEP] = (
        1 / rate_hz,
        substeps,
        1 / (rate_hz * substeps),
    )


def build_propagators(params: Float1D) -> Float2D:
    """Return generators of the four modes, then propagators, (8 x LINEAR_SIZE, LINEAR_SIZE).

    Propagators span one substep. Rows are derivatives as in `_generator_matrix`; zero if the model
    is nonlinear.
    """
    n = force_laws.LINEAR_SIZE
    result = np.zeros((8 * n, n))
    if not params[force_laws.IS_LINEAR]:
        return result
    for mode in range(4):
        generator = _generator_matrix(params, mode)
        result[mode * n : (mode + 1) * n] = generator
        result[(4 + mode) * n : (5 + mode) * n] = expm(generator * params[force_laws.STEP])
    return result


def _generator_matrix(params: Float1D, mode: int) -> Float2D:
    """Return d/dt of (u, v, u_R, u_L, f, b_R, b_L, A, its slope, gap R, gap L, 1) as a matrix."""
    u, v, f, base, slope, unit = 0, 1, 4, 7, 8, 11
    mass, drift, kb, rate = params[
        [force_laws.MASS, force_laws.DRIFT, force_laws.KB, force_laws.RATE_B]
    ]
    rows = np.zeros((force_laws.LINEAR_SIZE, force_laws.LINEAR_SIZE))
    rows[u, v], rows[v, base], rows[base, slope] = 1.0, -1.0, 1.0
    rows[v, u], rows[v, v], rows[v, f] = (
        -params[force_laws.K] / mass,
        -params[force_laws.C] / mass,
        -1 / mass,
    )
    rows[f, v], rows[f, f] = params[force_laws.K1], -params[force_laws.RATE_1]
    for side, sign in ((0, 1.0), (1, -1.0)):
        uj, b, gap = 2 + side, 5 + side, 9 + side
        k, c = params[force_laws.K_R + side], params[force_laws.C_R + side]
        rows[gap, unit] = drift
        if (mode >> side) & 1:
            # u_j = u -+ gap and the wall moves: F_j = c (u' -+ drift) + k (u -+ gap) + b
            rows[uj, v], rows[uj, unit] = 1.0, -sign * drift
            rows[v, u] -= k / mass
            rows[v, v] -= c / mass
            rows[v, b] -= 1 / mass
            rows[v, gap] += sign * k / mass
            rows[v, unit] += sign * c * drift / mass
        elif c > 0:
            rows[uj, uj], rows[uj, b] = -k / c, -1 / c
        else:
            rows[uj, b] = rate / (k + kb)
        rows[b] = kb * rows[uj]
        rows[b, b] -= rate
    return rows


def equilibrium_disp(p: Parameters, linear_disp: float, k3: float, k2: float) -> float:
    """Return u in m where the springs balance: `linear_disp` if it already does.

    Bisection on a force that grows with u; k3 < 0 softens it less than the bumpers stiffen it.
    """

    def push(d: float, k: float) -> float:
        return k * d + bumper_hardening.force(d, k2) if d > 0 else 0.0

    def force(u: float) -> float:
        right, left = (
            push(u - p.gap_r, p.bumper_stiffness_r),
            push(-u - p.gap_l, p.bumper_stiffness_l),
        )
        return p.stiffness * u + cubic_stiffness.force(u, k3) + right - left

    if force(linear_disp) == 0.0:
        return linear_disp
    bound = max(abs(gap) for gap in (p.gap_r, p.gap_l, linear_disp) if math.isfinite(gap))
    return bisect(force, -bound, bound)


def bisect(function: Callable[[float], float], low: float, high: float) -> float:
    """Return the root of an increasing function between low and high, to the last bit."""
    for _ in range(200):
        middle = 0.5 * (low + high)
        if function(middle) > 0:
            high = middle
        else:
            low = middle
    return 0.5 * (low + high)
