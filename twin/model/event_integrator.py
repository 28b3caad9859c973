"""Event-driven solver of models with force laws or extra states: integrated, or exact if linear."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_kernel
from table_io.errors import InputError
from twin.laws.effect import DAMPER, PLACES, Effect
from twin.laws.expression import build_function
from twin.laws.properties import (
    MAX_CONSTANTS,
    MAX_STATES,
    LawProperties,
    is_linear_in_rate,
    sum_law_properties,
    write_laws,
)
from twin.model import closed_form
from twin.model.event_integrator_kernel import (
    CLOCK,
    DIRECTION,
    LINEAR_SIZE,
    STATE_BASE,
    STATE_F,
    STATE_SIZE,
    build_kernel,
)
from twin.model.force_laws import (
    ADDED_LAWS_SIGNATURE,
    NO_STATES,
    NO_WALL_M,
    AddedLaws,
    Coefficients,
    LawInputs,
    add_law_force,
    cubic_force,
    hardening_force,
)
from twin.model.model import Model
from twin.model.parameters import Parameters
from twin.model.solver import StateEstimate

MAX_PHASE_STEP_RAD = 0.5  # rad per substep in the fastest mode
MAX_RELAXATIONS = 0.6  # relaxation times per substep, where it is integrated
MAX_LINEAR_RELAXATIONS = 2.0  # where it is propagated: the series converges without cancellation
MAX_SUBSTEPS = 500
HARDENING_DEPTH_M = 0.003  # m: compression at which the stiffness of a hardening bumper is taken
MIN_BOUND_M, MAX_EQUILIBRIUM_M = 1e-3, 10.0  # m: range searched for a static equilibrium

_NO_EVENTS = np.empty((0, 4))


@dataclass(frozen=True, slots=True, eq=False)
class EventDrivenSolver:
    """Event-driven solver of a model at one sampling rate; `parameters` at sample 0."""

    model: Model
    parameters: Parameters
    coefficients: Coefficients
    propagators: Float2D
    laws: AddedLaws | None

    @classmethod
    def from_model(cls, model: Model, rate_hz: float) -> "EventDrivenSolver":
        coefficients, laws = kernel_coefficients(model)
        coefficients = set_substeps(coefficients, rate_hz, sum_law_properties(model.added_laws))
        propagators = build_propagators(coefficients)
        build_kernel(laws is not None)  # before time matters
        return cls(model, model.parameters, coefficients, propagators, laws)

    def rest_state(self, index: int = 0) -> Float1D:
        p = self._parameters_at(index)
        linear_state = closed_form.rest_state(p)
        u, coefficients = float(linear_state[0]), self.coefficients
        if coefficients.k3 or coefficients.k2 or self.laws:
            time_s = index * coefficients.period
            try:
                u = equilibrium_disp(p, u, coefficients, self.laws, time_s)
            except (ArithmeticError, ValueError) as error:
                raise InputError(
                    f"no static equilibrium: its laws cannot be evaluated at rest ({error})",
                    where=", ".join(f"effect {effect.id!r}" for effect, _ in self.model.added_laws),
                    remedy="use laws that are finite there",
                ) from None
        state = self._blank_state(index)
        state[:6] = linear_state[:6]
        state[0] = u
        state[2], state[3] = max(u - p.gap_r, 0.0), min(u + p.gap_l, 0.0)
        return state

    def restart_state(self, start: StateEstimate) -> Float1D:
        added = self.model.added_acceleration(start.table_disp)
        base = start.base_acc + (0.0 if added is None else added)
        state = self._blank_state(start.index)
        linear_state = closed_form.restart_state(start, base, self._parameters_at(start.index))
        state[: STATE_BASE + 1] = linear_state[: STATE_BASE + 1]
        if start.hidden is not None and np.isfinite(start.hidden).all():
            state[STATE_F:DIRECTION] = start.hidden[STATE_F:DIRECTION]
        if math.isnan(state[0]):
            state[:CLOCK] = math.nan
        elif start.v != 0:
            state[DIRECTION] = math.copysign(1.0, start.v)
        return state

    def set_clock(self, state: Float1D, samples: float) -> None:
        state[CLOCK] = samples

    def advance(self, state: Float1D, base_acc: Float1D, table_disp: Float1D, out: Float2D) -> None:
        added = self.model.added_acceleration(table_disp)
        base = base_acc if added is None else base_acc + added
        integrate = build_kernel(self.laws is not None)
        try:
            integrate(state, self.coefficients, self.propagators, self.laws, base, out, _NO_EVENTS)
        except ZeroDivisionError:  # of an added law, which has no number there
            clock = state[CLOCK] + base.size
            out[:], state[:CLOCK], state[CLOCK] = math.nan, math.nan, clock
        if added is not None:
            out[2] -= added

    def _parameters_at(self, index: int) -> Parameters:
        """Return the parameters with the gaps at a sample."""
        opening = self.coefficients.drift * index * self.coefficients.period
        p = self.parameters
        return replace(p, gap_r=p.gap_r + opening, gap_l=p.gap_l + opening) if opening else p

    def _blank_state(self, index: int) -> Float1D:
        """Return a relaxed state at rest; with friction it sticks until the solver detects slip."""
        state = np.zeros(STATE_SIZE)
        state[DIRECTION], state[CLOCK] = 0.0 if self.coefficients.fc > 0 else 1.0, index
        return state


def kernel_coefficients(model: Model) -> tuple[Coefficients, AddedLaws | None]:
    """Return (coefficients that do not depend on the rate, compiled laws that effects bring)."""
    p, added = model.parameters, model.added_laws
    of_effects: dict[str, Any] = dict(model.coefficients)
    own = Coefficients(
        m=p.mass,
        k=p.stiffness,
        c=p.damping,
        k_r=p.bumper_stiffness_r,
        k_l=p.bumper_stiffness_l,
        c_r=p.bumper_damping_r,
        c_l=p.bumper_damping_l,
        gap_r=min(p.gap_r, NO_WALL_M),
        gap_l=min(p.gap_l, NO_WALL_M),
    )._replace(**of_effects)
    has_reversals = bool(own.c2 or own.fc or own.fy or added)
    coefficients = own._replace(
        is_linear=not (has_reversals or own.k3 or own.k2 or own.ch or own.pull),
        has_reversals=has_reversals,
        has_bumper_states=any(effect.is_in_bumpers and effect.states for effect, _ in added),
        has_rate_laws=any(
            effect.is_in_bumpers and not is_linear_in_rate(effect, constants)
            for effect, constants in added
        ),
        laws=pack_constants(added),
    )
    return coefficients, compile_laws([effect for effect, _ in added])


def set_substeps(
    p: Coefficients, rate_hz: float, laws: Mapping[int, LawProperties]
) -> Coefficients:
    """Return p with period, substeps and step, limiting phase and relaxation per substep.

    A face relaxes with (K_j + k2 d + kb) / C_j: Hunt-Crossley damping vanishes at touch. `laws` by
    place; InputError where the rate is too low.
    """
    both_contacts = p.gap_r + p.gap_l <= 0
    hardening = p.k2 * HARDENING_DEPTH_M
    sides = [
        k + 2 * hardening + p.kb + laws[side].stiffness for side, k in enumerate((p.k_r, p.k_l))
    ]
    k = p.k + p.k1 + p.fy / p.uy + laws[DAMPER].stiffness
    max_frequency = math.sqrt((k + (sum(sides) if both_contacts else max(sides))) / p.m)
    relaxation_rates = [p.rate_1, p.rate_b, *(law.relaxation_rate for law in laws.values())]
    for side, (k_j, c_j, gap) in enumerate(((p.k_r, p.c_r, p.gap_r), (p.k_l, p.c_l, p.gap_l))):
        if c_j > 0 and gap < NO_WALL_M / 2:
            stiffness = k_j + hardening + p.kb + laws[side].stiffness
            relaxation_rates.append(stiffness / c_j + p.rate_b)
    max_relaxations = MAX_LINEAR_RELAXATIONS if p.is_linear else MAX_RELAXATIONS
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
    return p._replace(period=1 / rate_hz, substeps=substeps, step=1 / (rate_hz * substeps))


def build_propagators(p: Coefficients) -> Float2D:
    """Return generators of the four modes, then propagators, (8 x LINEAR_SIZE, LINEAR_SIZE).

    Propagators span one substep. Rows are derivatives as in `_generator_matrix`; zero if the model
    is nonlinear.
    """
    n = LINEAR_SIZE
    result = np.zeros((8 * n, n))
    if not p.is_linear:
        return result
    from scipy.linalg import expm  # slow to import, and the plain model needs none

    for mode in range(4):
        generator = _generator_matrix(p, mode)
        result[mode * n : (mode + 1) * n] = generator
        result[(4 + mode) * n : (5 + mode) * n] = expm(generator * p.step)
    return result


def _generator_matrix(p: Coefficients, mode: int) -> Float2D:
    """Return d/dt of (u, v, u_R, u_L, f, b_R, b_L, A, its slope, gap R, gap L, 1) as a matrix."""
    u, v, f, base, slope, unit = 0, 1, 4, 7, 8, 11
    rows = np.zeros((LINEAR_SIZE, LINEAR_SIZE))
    rows[u, v], rows[v, base], rows[base, slope] = 1.0, -1.0, 1.0
    rows[v, u], rows[v, v], rows[v, f] = -p.k / p.m, -p.c / p.m, -1 / p.m
    rows[f, v], rows[f, f] = p.k1, -p.rate_1
    for side, sign, k, c in ((0, 1.0, p.k_r, p.c_r), (1, -1.0, p.k_l, p.c_l)):
        uj, b, gap = 2 + side, 5 + side, 9 + side
        rows[gap, unit] = p.drift
        if (mode >> side) & 1:
            # u_j = u -+ gap and the wall moves: F_j = c (u' -+ drift) + k (u -+ gap) + b
            rows[uj, v], rows[uj, unit] = 1.0, -sign * p.drift
            rows[v, u] -= k / p.m
            rows[v, v] -= c / p.m
            rows[v, b] -= 1 / p.m
            rows[v, gap] += sign * k / p.m
            rows[v, unit] += sign * c * p.drift / p.m
        elif c > 0:
            rows[uj, uj], rows[uj, b] = -k / c, -1 / c
        else:
            rows[uj, b] = p.rate_b / (k + p.kb)
        rows[b] = p.kb * rows[uj]
        rows[b, b] -= p.rate_b
    return rows


def equilibrium_disp(
    p: Parameters,
    linear_disp: float,
    coefficients: Coefficients,
    laws: AddedLaws | None,
    time_s: float,
) -> float:
    """Return u in m where the springs balance at a time: `linear_disp` if it already does.

    Bisection on a force that grows with u; k3 < 0 softens it less than the bumpers stiffen it.
    """
    k3, k2, relaxed = coefficients.k3, coefficients.k2, LawInputs(NO_STATES, 0.0, time_s)

    def push(side: int, d: float, k: float) -> float:
        if d <= 0:
            return 0.0
        return add_law_force(
            k * d + hardening_force(d, k2), side, d, 0.0, relaxed, coefficients, laws
        )

    def force(u: float) -> float:
        right = push(0, u - p.gap_r, p.bumper_stiffness_r)
        left = push(1, -u - p.gap_l, p.bumper_stiffness_l)
        damper = p.stiffness * u + cubic_force(u, k3)
        damper = add_law_force(damper, DAMPER, u, 0.0, relaxed, coefficients, laws)
        return damper + right - left

    if force(linear_disp) == 0.0:
        return linear_disp
    bound = max(abs(gap) for gap in (p.gap_r, p.gap_l, linear_disp) if math.isfinite(gap))
    while not force(-bound) <= 0.0 <= force(bound) and bound < MAX_EQUILIBRIUM_M:
        bound = 2 * bound or MIN_BOUND_M  # an added law may push also where u = 0
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


def pack_constants(
    laws: Sequence[tuple[Effect, tuple[float, ...]]],
) -> tuple[float, ...] | None:
    """Return the constants of all laws, padded to `MAX_CONSTANTS`; None without, error if many."""
    if not laws:
        return None
    values = [value for _, constants in laws for value in constants]
    state_count = sum(len(PLACES[effect.place]) * len(effect.states) for effect, _ in laws)
    for count, limit, what in (
        (len(values), MAX_CONSTANTS, "constants"),
        (state_count, MAX_STATES, "states, those of each bumper counted"),
    ):
        if count > limit:
            raise InputError(
                f"the laws of {', '.join(effect.id for effect, _ in laws)} have {count} {what}",
                allowed=f"at most {limit} in total",
                remedy="remove an effect",
            )
    return (*values, *[0.0] * (MAX_CONSTANTS - len(values)))


def compile_laws(effects: Sequence[Effect]) -> AddedLaws | None:
    """Compile the laws of these effects into one function, None for none.

    They are those that the solver does not know by coefficients: a function of (place, deformation,
    rate, base acceleration, time, states, constants), so that the solver itself is compiled and
    cached only once, whatever effects a model has.
    """
    return _compile_text(write_laws(tuple(effects))) if effects else None


@cache
def _compile_text(text: str) -> AddedLaws:
    """Compile the text of laws; effects that differ in names, bounds or ranges alone share it."""
    return jit_kernel(ADDED_LAWS_SIGNATURE)(build_function(text))
