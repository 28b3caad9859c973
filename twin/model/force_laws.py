"""Force laws of all effects in one compiled right-hand side, with their coefficients.

    M u'' + C u' + K u + k3 u^3 + c2 u' |u'| + Fc sign(u') + Fy z + f + D + F_R + F_L = -M A
    contact: F_j = (C_j + ch |u_j|) u_j' + K_j u_j + k2 u_j |u_j| + b_j + B_j, ends at F_j = -pull
             u_R = u - G0R, u_L = u + G0L
    flight:  F_j = 0, that sum is zero and u_j relaxes
    f' = k1 u' - f / tau1,  b_j' = kb u_j' - b_j / tau,  G0j grows with the gap drift

SI, right positive. Each term is a row of `twin.laws.library`, whose `compiled` names its
coefficients here; D and B_j are the forces of all other rows and plug-ins (see `added_laws`), with
their internal states `s`. An effect with a zero coefficient is absent. Sides: 0 right, 1 left.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, get_type_hints

from numba import float64, int64, types

from table_io.compilation import jit_helper, jit_helper_unless_none
from twin.laws.effect import DAMPER
from twin.laws.expression import build_function
from twin.laws.library import find_effect
from twin.laws.properties import MAX_CONSTANTS, MAX_STATES, write_force

NO_STATES = (0.0,) * MAX_STATES
REVERSAL_SPEED_M_S = 1e-300  # of the sign that follows a reversal
NO_WALL_M = 1e9  # m: gap of an absent bumper; finite, so that zero times it is zero
MAX_ROOT_STEPS = 60  # of the rate of a free face, where a law is not linear in it
RATE_TOLERANCE = 1e-13  # relative, of that rate

# (place, deformation, its rate, base acceleration, time, states, coefficients) -> (force in N, rate
# of each state)
AddedLaws = Callable[
    [int, float, float, float, float, tuple[float, ...], tuple[float, ...]], tuple[float, ...]
]
ADDED_LAWS_SIGNATURE = types.UniTuple(float64, 1 + MAX_STATES)(
    int64,
    float64,
    float64,
    float64,
    float64,
    types.UniTuple(float64, MAX_STATES),
    types.UniTuple(float64, MAX_CONSTANTS),
)


class LawInputs(NamedTuple):
    """What added laws depend on besides the motion at their place, or the rates of it.

    `base`: acceleration in m/s2 of the table as the mass feels it; `time` in s since sample 0.
    """

    states: tuple[float, ...]
    base: float
    time: float


class Motion(NamedTuple):
    """State at one time, or its rates: u, u', u_R, u_L, branch forces, inputs of added laws."""

    u: float
    v: float
    u_r: float
    u_l: float
    f: float
    b_r: float
    b_l: float
    s: LawInputs | None


class Start(NamedTuple):
    """Start of a step, in which A = base + slope t.

    `u`, `z`: displacement and hysteretic variable there; `mode` = contact_r + 2 contact_l;
    `direction` is the sign of u', 0 where the mass sticks.
    """

    u: float
    z: float
    gap_r: float
    gap_l: float
    base: float
    slope: float
    mode: int
    direction: float


class Coefficients(NamedTuple):
    """Coefficients of a model at one sampling rate; the step-dependent ones are zero before that.

    From `k3` to `drift` those of effects, absent by default: `rate_1` and `rate_b` are 1/tau, `fc`
    is the force up to which dry friction sticks. Gaps are those at sample 0; `step` is one of
    `substeps` of the sampling period. `has_reversals`: reversals of u' are events. `laws` are the
    constants of the added laws, `has_bumper_states` is true if one in a bumper has states,
    `has_rate_laws` if one there is not linear in the rate.
    """

    m: float
    k: float
    c: float
    k_r: float
    k_l: float
    c_r: float
    c_l: float
    gap_r: float
    gap_l: float
    k3: float = 0.0
    c2: float = 0.0
    fc: float = 0.0
    fy: float = 0.0
    uy: float = 1.0
    k1: float = 0.0
    rate_1: float = 0.0
    k2: float = 0.0
    ch: float = 0.0
    kb: float = 0.0
    rate_b: float = 0.0
    pull: float = 0.0
    drift: float = 0.0
    is_linear: bool = True
    has_reversals: bool = False
    has_bumper_states: bool = False
    has_rate_laws: bool = False
    laws: tuple[float, ...] | None = None
    period: float = 0.0
    substeps: int = 0
    step: float = 0.0


def _coefficients_type(constants_type: types.Type) -> types.NamedTuple:
    """Return numba's type of `Coefficients` with constants of added laws of this type."""
    numba_types = {float: float64, int: int64, bool: types.boolean}
    hints = get_type_hints(Coefficients).values()
    return types.NamedTuple([numba_types.get(hint, constants_type) for hint in hints], Coefficients)


# Types of (coefficients, laws) for which kernels are compiled: without added laws, and with them.
PLAIN_TYPES = (_coefficients_type(types.none), types.none)
LAWS_TYPES = (
    _coefficients_type(types.UniTuple(float64, MAX_CONSTANTS)),
    types.FunctionType(ADDED_LAWS_SIGNATURE),
)


def _compile_force(
    effect: str, arguments: Sequence[str], names: Mapping[str, str] | None = None
) -> Callable[..., float]:
    """Return the force of a row of the library as a helper of kernels, some names replaced."""
    text = write_force(find_effect(effect), arguments, names or {})
    return jit_helper(inlined=True)(build_function(text))


cubic_force = _compile_force("cubic_stiffness", ("u", "k3"))
hardening_force = _compile_force("bumper_hardening", ("d", "k2"))
# `direction` = +1 or -1 is the sign of v until a reversal, which rounding may not be.
quadratic_force = _compile_force(
    "quadratic_damping", ("v", "direction", "c2"), {"sign(v)": "direction"}
)
hunt_crossley_damping = _compile_force("hunt_crossley", ("d", "ch"), {"v": "1.0"})


@jit_helper(inlined=True)
def coulomb_force(direction: float, fc: float) -> float:
    """Return the dry friction in N during slip; `direction` is the sign of u', 0 if stuck."""
    return fc * direction


@jit_helper()
def hysteretic_variable(z: float, du: float, direction: float, uy: float) -> float:
    """Return z of `bouc_wen` after du m more in `direction` = +1 or -1, starting from z.

    In closed form, as z depends on the path, not on the speed:
        unloading (u' z < 0)  z = z0 + (u - u0) / uy     up to z = 0
        loading               z = tanh((u - u0) / uy + artanh z0)
    """
    start = direction * z
    step = direction * du / uy
    if start < 0.0:
        if start + step <= 0.0:
            return direction * (start + step)
        return direction * math.tanh(start + step)
    gain = math.tanh(step)
    return direction * (start + gain) / (1.0 + start * gain)


@jit_helper_unless_none("laws", lambda force, place, q, w, s, p, laws: force)
def add_law_force(
    force: float, place: int, q: float, w: float, s: Any, p: Coefficients, laws: Any
) -> float:
    """Return `force` plus that of the added laws at a place, in N."""
    return force + laws(place, q, w, s.base, s.time, s.states, p.laws)[0]


@jit_helper_unless_none("laws", lambda dashpot, side, d, s, p, laws: dashpot)
def add_law_dashpot(
    dashpot: float, side: int, d: float, s: Any, p: Coefficients, laws: Any
) -> float:
    """Return `dashpot` plus d(push)/d(rate) of the added laws in a bumper, in N s/m."""
    fast = laws(side, d, 1.0, s.base, s.time, s.states, p.laws)[0]
    return dashpot + fast - laws(side, d, 0.0, s.base, s.time, s.states, p.laws)[0]


@jit_helper(inlined=True)
def add_scaled_states(
    states: tuple[float, ...], h: float, rates: tuple[float, ...]
) -> tuple[float, ...]:
    """Return states + h rates."""
    return (
        states[0] + h * rates[0], states[1] + h * rates[1], states[2] + h * rates[2],
        states[3] + h * rates[3], states[4] + h * rates[4], states[5] + h * rates[5],
    )  # fmt: skip


@jit_helper_unless_none("s", lambda s, h, rates: None)
def add_scaled_inputs(s: Any, h: float, rates: Any) -> LawInputs | None:
    """Return s + h rates."""
    states = add_scaled_states(s.states, h, rates.states)
    return LawInputs(states, s.base + h * rates.base, s.time + h * rates.time)


@jit_helper_unless_none("s", lambda s, base, time: None)
def set_drive(s: Any, base: float, time: float) -> LawInputs | None:
    """Return s at a base acceleration in m/s2 and a time in s."""
    return LawInputs(s.states, base, time)


@jit_helper(inlined=True)
def bumper_coefficients(p: Coefficients, side: int) -> tuple[float, float]:
    """Return (stiffness, damping) of a bumper."""
    return (p.k_r, p.c_r) if side == 0 else (p.k_l, p.c_l)


@jit_helper(inlined=True)
def bumper_force(
    p: Coefficients,
    side: int,
    d: float,
    dd: float,
    b: float,
    s: LawInputs | None,
    laws: AddedLaws | None,
) -> float:
    """Return the push of a bumper in N; deformation d, rate dd, branch force b: compression > 0."""
    k, c = bumper_coefficients(p, side)
    push = k * d + (c + hunt_crossley_damping(d, p.ch)) * dd + hardening_force(d, p.k2) + b
    return add_law_force(push, side, d, dd, s, p, laws)


@jit_helper(inlined=True)
def bumper_dashpot(
    p: Coefficients, side: int, d: float, s: LawInputs | None, laws: AddedLaws | None
) -> float:
    """Return d(push)/d(rate) of a bumper in N s/m at deformation d."""
    _, c = bumper_coefficients(p, side)
    return add_law_dashpot(c + hunt_crossley_damping(d, p.ch), side, d, s, p, laws)


@jit_helper_unless_none("laws", lambda rate, side, d, b, s, p, laws: rate)
def solve_face_rate(
    rate: float, side: int, d: float, b: float, s: Any, p: Coefficients, laws: Any
) -> float:
    """Return the rate in m/s at which a free face feels no force, where a law is not linear in it.

    `rate` is the root of the linear laws alone, which dissipative ones only bring nearer to zero:
    regula falsi (Illinois) between the two.
    """
    if not p.has_rate_laws or rate == 0.0:
        return rate
    near, far = 0.0, rate
    push_near = bumper_force(p, side, d, near, b, s, laws)
    push_far = bumper_force(p, side, d, far, b, s, laws)
    for _ in range(MAX_ROOT_STEPS):
        if push_near * push_far <= 0.0:
            break
        near, push_near, far = far, push_far, 2.0 * far
        push_far = bumper_force(p, side, d, far, b, s, laws)
    for _ in range(MAX_ROOT_STEPS):
        if push_far == 0.0 or abs(far - near) <= RATE_TOLERANCE * abs(far):
            break
        middle = far - push_far * (far - near) / (push_far - push_near)
        push = bumper_force(p, side, d, middle, b, s, laws)
        if push * push_far < 0.0:
            near, push_near = far, push_far
        else:
            push_near *= 0.5
        far, push_far = middle, push
    return far


@jit_helper(inlined=True)
def free_face_rate(
    p: Coefficients, side: int, d: float, b: float, dashpot: float, s: Any, laws: Any
) -> float:
    """Return the rate in m/s of the deformation of a free bumper with a dashpot in N s/m."""
    rate = -bumper_force(p, side, d, 0.0, b, s, laws) / dashpot
    return solve_face_rate(rate, side, d, b, s, p, laws)


@jit_helper(inlined=True)
def recovery_rate(
    p: Coefficients, side: int, d: float, b: float, s: LawInputs | None, laws: AddedLaws | None
) -> float:
    """Return the rate in m/s of the deformation d of a free bumper; b as in `bumper_force`.

    Without a dashpot the face has no memory of its own: it lies where the springs balance.
    """
    if d == 0.0 and b == 0.0 and not p.has_bumper_states:
        return 0.0
    dashpot = bumper_dashpot(p, side, d, s, laws)
    if dashpot > 0.0:
        return free_face_rate(p, side, d, b, dashpot, s, laws)
    if b == 0.0:
        return 0.0
    k, _ = bumper_coefficients(p, side)
    return b * p.rate_b / (k + 2 * p.k2 * abs(d) + p.kb)


@jit_helper(inlined=True)
def bumper_deformation(
    x: Motion, start: Start, p: Coefficients, side: int, t: float, laws: AddedLaws | None
) -> tuple[float, float, float]:
    """Return (d, d', b) of a bumper, t s into the step, positive in compression."""
    if side == 0:
        sign, uj, b, gap = 1.0, x.u_r, x.b_r, start.gap_r
    else:
        sign, uj, b, gap = -1.0, x.u_l, -x.b_l, start.gap_l
    if (start.mode >> side) & 1:
        return sign * x.u - gap - p.drift * t, sign * x.v - p.drift, b
    d = sign * uj
    return d, recovery_rate(p, side, d, b, x.s, laws), b


@jit_helper(inlined=True)
def damper_rate(v: float, direction: float) -> float:
    """Return u' for the added laws: at a reversal the limit on the side that follows it."""
    return v if direction * v > 0.0 else direction * REVERSAL_SPEED_M_S


@jit_helper(inlined=True)
def internal_force(
    x: Motion, start: Start, direction: float, p: Coefficients, t: float, laws: AddedLaws | None
) -> float:
    """Return the sum in N of all forces on the left side of the equation of motion."""
    u, v = x.u, x.v
    force = p.k * u + p.c * v + x.f
    if not p.is_linear:
        force += (
            cubic_force(u, p.k3)
            + quadratic_force(v, direction, p.c2)
            + coulomb_force(direction, p.fc)
        )
        if p.fy > 0.0:
            # z is constant while the mass sticks.
            z = start.z
            if direction != 0.0:
                z = hysteretic_variable(z, u - start.u, direction, p.uy)
            force += p.fy * z
        force = add_law_force(force, DAMPER, u, damper_rate(v, direction), x.s, p, laws)
    if start.mode & 1:
        d, dd, b = bumper_deformation(x, start, p, 0, t, laws)
        force += bumper_force(p, 0, d, dd, b, x.s, laws)
    if start.mode & 2:
        d, dd, b = bumper_deformation(x, start, p, 1, t, laws)
        force -= bumper_force(p, 1, d, dd, b, x.s, laws)
    return force


@jit_helper(inlined=True)
def law_rates(
    place: int, q: float, w: float, s: Any, slope: float, p: Coefficients, laws: Any
) -> LawInputs:
    """Return d/dt of `s` by the added laws at a place; slope of the base acceleration."""
    return LawInputs(laws(place, q, w, s.base, s.time, s.states, p.laws)[1:], slope, 1.0)


@jit_helper_unless_none("laws", lambda s, slope, u, du, d_r, dd_r, d_l, dd_l, p, laws: None)
def law_input_rates(
    s: Any, slope: float, u: float, du: float, d_r: float, dd_r: float, d_l: float, dd_l: float,
    p: Coefficients, laws: Any,
) -> LawInputs | None:  # fmt: skip
    """Return d/dt of `s` by all added laws; deformations and rates of damper and bumpers."""
    rates = law_rates(DAMPER, u, du, s, slope, p, laws).states
    rates = add_scaled_states(rates, 1.0, law_rates(0, d_r, dd_r, s, slope, p, laws).states)
    rates = add_scaled_states(rates, 1.0, law_rates(1, d_l, dd_l, s, slope, p, laws).states)
    return LawInputs(rates, slope, 1.0)


@jit_helper(inlined=True)
def state_rates(
    x: Motion, start: Start, p: Coefficients, t: float, laws: AddedLaws | None
) -> Motion:
    """Return d/dt of a state, t s into the step."""
    du, dv = 0.0, 0.0
    if start.direction != 0.0 or p.fc == 0.0:
        force = internal_force(x, start, start.direction, p, t, laws)
        du, dv = x.v, -(start.base + start.slope * t) - force / p.m
    d_r, right, b_r = bumper_deformation(x, start, p, 0, t, laws)
    d_l, left, b_l = bumper_deformation(x, start, p, 1, t, laws)
    law_du = damper_rate(du, start.direction)
    s = law_input_rates(x.s, start.slope, x.u, law_du, d_r, right, d_l, left, p, laws)
    return Motion(
        du, dv, right, -left, p.k1 * du - p.rate_1 * x.f,
        p.kb * right - p.rate_b * b_r, p.rate_b * b_l - p.kb * left, s,
    )  # fmt: skip


@jit_helper(inlined=True)
def static_friction(
    x: Motion, start: Start, p: Coefficients, t: float, laws: AddedLaws | None
) -> float:
    """Return the friction in N that holds the mass in place."""
    force = internal_force(x, start, 0.0, p, t, laws)
    return -(p.m * (start.base + start.slope * t) + force)
