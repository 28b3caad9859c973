"""Inverse dynamics: forces of a model along a measured motion, without integrating a motion.

    damper  D = K u + C u' + every force law that acts in flight too
    bumpers F_R >= 0 and F_L <= 0 where contact was measured

Hidden states (hysteresis, relaxation) are carried along the measured motion from rest. Where
contact was not measured the model decides: a face is touched while its force pushes. Along the
motion every force is a smooth function of the parameters, even where trajectories are chaotic:
this is what makes a fit converge (see `twin.discovery`).
"""

import math
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import float64, types

from table_io.block import Float1D, Float2D
from table_io.compilation import (
    jit_helper,
    jit_helper_unless_none,
    jit_kernel,
)
from twin.laws.effect import DAMPER, PLACES, Effect
from twin.laws.properties import sum_law_properties
from twin.model.event_integrator import kernel_coefficients
from twin.model.force_laws import (
    LAWS_TYPES,
    NO_STATES,
    NO_WALL_M,
    PLAIN_TYPES,
    AddedLaws,
    Coefficients,
    LawInputs,
    add_law_force,
    add_scaled_inputs,
    bumper_coefficients,
    bumper_dashpot,
    bumper_force,
    coulomb_force,
    cubic_force,
    free_face_rate,
    hysteretic_variable,
    law_rates,
    quadratic_force,
    set_drive,
)
from twin.model.model import Model

PULL_WIDTH = 0.1  # of the pull-off force: over which an adhesive contact lets go along a motion
MAX_RELAXATIONS, MAX_FACE_RELAXATIONS = 50.0, 5.0  # of a state and of a free face in a sample
MAX_STATE_RELAXATIONS = 0.5  # relaxation times of an added law per step of its integration
STILL_FACE_M = 1e-9  # a face that would move less in a sample stays: it has relaxed
# One signature: numba never caches a kernel specialized to the function of an effect.
_READ = types.Array(float64, 1, "A", readonly=True)
_KERNELS = [
    types.void(
        _READ,
        _READ,
        _READ,
        _READ,
        float64[:, ::1],
        coefficients,
        laws,
        float64,
        float64,
        float64[:, ::1],
    )
    for coefficients, laws in (PLAIN_TYPES, LAWS_TYPES)
]
CONTACT_UNKNOWN, NO_CONTACT, IN_CONTACT = -1, 0, 1  # measured contact state


@jit_helper()
def relax_branch(
    branch: float, rate: float, stiffness: float, displacement: float, h: float
) -> float:
    """Return the force of a Maxwell branch after h s at constant speed: f' = k v - f / tau."""
    if rate * h == 0.0:
        return branch + stiffness * displacement
    decay = math.exp(-rate * h)
    return branch * decay + stiffness * displacement * (1.0 - decay) / (rate * h)


@jit_helper()
def recover_bumper(p: Coefficients, side: int, d: float, b: float, h: float) -> tuple[float, float]:
    """Return (deformation, branch force) of a free bumper after h s.

    Closed form of d' = -(K_j d + b) / C_j and b' = kb d' - b / tau: two real rates, never equal
    while kb > 0. Without a dashpot K_j d + b = 0 at every time.
    """
    k, c = bumper_coefficients(p, side)
    kb, rate = p.kb, p.rate_b
    if c <= 0.0:
        b = b * math.exp(-h * rate / (1.0 + kb / k))
        return -b / k, b
    half = 0.5 * ((k + kb) / c + rate)
    root = math.sqrt(half * half - k * rate / c)
    fast, slow = math.exp(-(half + root) * h), math.exp(-(half - root) * h)
    mean, rate_part = 0.5 * (slow + fast), 0.5 * (slow - fast) / root
    d_rate = -(k * d + b) / c
    b_rate = kb * d_rate - rate * b
    return mean * d + rate_part * (half * d + d_rate), mean * b + rate_part * (half * b + b_rate)


@jit_helper()
def track_face(
    p: Coefficients,
    side: int,
    d: float,
    face: float,
    b: float,
    was_in_contact: bool,
    contact: float,
    h: float,
) -> tuple[float, float]:
    """Return (face position in m, branch force in N) after h s, with the mass at d.

    A face that the mass meets meanwhile jumps to it; at the first sample (h = 0) it has relaxed.
    """
    if was_in_contact:
        return d, relax_branch(b, p.rate_b, p.kb, d - face, h)
    face, b = recover_bumper(p, side, face, b, h)
    if contact > 0.5 or (contact < -0.5 and d > face):
        return d, b + (p.kb * (d - face) if h > 0.0 else 0.0)
    return face, b


class StateRates(NamedTuple):
    """Rates in 1/s of the fastest state of the added laws, and of a free face; -1 without any."""

    states: float
    faces: float


@jit_helper()
def count_steps(h: float, rate: float) -> int:
    """Return the number of steps over h s for what relaxes at a rate in 1/s."""
    return 1 + int(h * rate / MAX_STATE_RELAXATIONS)


@jit_helper_unless_none("laws", lambda place, s, q, w, slope, h, rate, p, laws: None)
def advance_law_states(
    place: int, s: Any, q: float, w: float, slope: float, h: float, rate: float,
    p: Coefficients, laws: Any,
) -> LawInputs | None:  # fmt: skip
    """Return the inputs of the added laws after h s with the states of one place advanced.

    From deformation q at rate w and with the slope of the base acceleration in m/s3. Classical
    fourth-order Runge-Kutta in equal steps, by the `rate` in 1/s of the fastest state.
    """
    steps = count_steps(h, rate)
    dt = h / steps
    for n in range(steps):
        q0 = q + n * dt * w
        k1 = law_rates(place, q0, w, s, slope, p, laws)
        middle = q0 + 0.5 * dt * w
        k2 = law_rates(place, middle, w, add_scaled_inputs(s, 0.5 * dt, k1), slope, p, laws)
        k3 = law_rates(place, middle, w, add_scaled_inputs(s, 0.5 * dt, k2), slope, p, laws)
        k4 = law_rates(place, q0 + dt * w, w, add_scaled_inputs(s, dt, k3), slope, p, laws)
        s = add_scaled_inputs(s, dt / 6.0, k1)
        s = add_scaled_inputs(add_scaled_inputs(s, dt / 3.0, k2), dt / 3.0, k3)
        s = add_scaled_inputs(s, dt / 6.0, k4)
    return s


@jit_helper()
def recover_face_and_states(
    side: int, face: float, b: float, s: Any, slope: float, h: float, rates: StateRates,
    p: Coefficients, laws: Any,
) -> tuple[float, float, LawInputs | None]:  # fmt: skip
    """Return (face position, branch force, inputs of added laws) of a free bumper after h s.

    The face moves so that the bumper's force is zero; midpoint rule in equal steps. Most of the
    time it has relaxed, and only the states change, which are slower.
    """
    push = bumper_force(p, side, face, 0.0, b, s, laws)
    if abs(push) * h <= STILL_FACE_M * bumper_dashpot(p, side, face, s, laws):
        # Laws that are not linear in the rate would only slow it down.
        s = advance_law_states(side, s, face, 0.0, slope, h, rates.states, p, laws)
        return face, relax_branch(b, p.rate_b, p.kb, 0.0, h), s
    steps = count_steps(h, max(rates.states, rates.faces))
    dt = h / steps
    for _ in range(steps):
        middle, middle_b, middle_s = face, b, s
        for length in (0.5 * dt, dt):
            dashpot = bumper_dashpot(p, side, middle, middle_s, laws)
            if dashpot <= 0.0:
                return 0.0, 0.0, s
            w = free_face_rate(p, side, middle, middle_b, dashpot, middle_s, laws)
            s_rates = law_rates(side, middle, w, middle_s, slope, p, laws)
            b_rate = p.kb * w - p.rate_b * middle_b
            middle, middle_b = face + length * w, b + length * b_rate
            middle_s = add_scaled_inputs(s, length, s_rates)
        face, b, s = middle, middle_b, middle_s
    return face, b, s


@jit_helper_unless_none(
    "laws", lambda side, d, dd, face, b, s, slope, was, contact, h, rates, p, laws: (face, b, s)
)
def track_face_with_laws(
    side: int, d: float, dd: float, face: float, b: float, s: Any, slope: float,
    was_in_contact: bool, contact: float, h: float, rates: StateRates, p: Coefficients, laws: Any,
) -> tuple[float, float, LawInputs | None]:  # fmt: skip
    """Return (face position in m, branch force in N, inputs of added laws) as `track_face`."""
    if h == 0.0:
        return max(d, 0.0) if contact > 0.5 else face, b, s
    if was_in_contact:
        s = advance_law_states(side, s, face, (d - face) / h, slope, h, rates.states, p, laws)
        return d, relax_branch(b, p.rate_b, p.kb, d - face, h), s
    free_face, free_b, free_s = recover_face_and_states(side, face, b, s, slope, h, rates, p, laws)
    if contact > 0.5 or (contact < -0.5 and d > free_face):
        # The mass met the face on the way; the face follows it from where both were.
        share = 1.0
        if d > free_face and dd > 0.0:
            share = min(1.0, (d - free_face) / (dd * h))
        free_face, free_b, free_s = recover_face_and_states(
            side, face, b, s, slope, h * (1.0 - share), rates, p, laws
        )
        w = (d - free_face) / (h * share) if share > 0.0 else 0.0
        free_s = advance_law_states(
            side, free_s, free_face, w, slope, h * share, rates.states, p, laws
        )
        return d, free_b + p.kb * (d - free_face), free_s
    return free_face, free_b, free_s


@jit_helper_unless_none("laws", lambda laws: None)
def relaxed_states(laws: Any) -> LawInputs | None:
    """Return the inputs of the added laws with relaxed states."""
    return LawInputs(NO_STATES, 0.0, 0.0)


@jit_helper()
def pull_share(push: float, pull: float) -> float:
    """Return the share of a push in N that is held: 1 down to -pull, then 0, smooth for fits."""
    if push >= 0.0 or pull <= 0.0:
        return 1.0
    return 0.5 + 0.5 * math.tanh((push + pull) / (PULL_WIDTH * pull))


@jit_kernel(_KERNELS)
def _force_kernel(
    u: Float1D,
    v: Float1D,
    base: Float1D,
    time: Float1D,
    contact: Float2D,
    p: Coefficients,
    laws: AddedLaws | None,
    state_rate: float,
    face_rate: float,
    out: Float2D,
) -> None:
    """Fill `out` (3, sample): D, F_R, F_L in N; `contact` (2, sample) as `CONTACT_UNKNOWN`."""
    z, f, b_r, b_l, s = 0.0, 0.0, 0.0, 0.0, relaxed_states(laws)
    face_r, face_l = 0.0, 0.0  # face positions in m, tracked only with relaxation
    in_contact_r, in_contact_l = False, False
    slope = 0.0  # of the base acceleration in m/s3, where states follow it
    rates = StateRates(state_rate, face_rate)
    for k in range(u.size):
        previous = max(k - 1, 0)
        h = time[k] - time[k - 1] if k else 0.0
        if k:
            du = u[k] - u[k - 1]
            if p.fy > 0.0 and du != 0.0:
                z = hysteretic_variable(z, du, math.copysign(1.0, du), p.uy)
            if p.k1 > 0.0 or f != 0.0:
                f = relax_branch(f, p.rate_1, p.k1, du, h)
            if state_rate >= 0.0:
                slope = (base[k] - base[k - 1]) / h
                s = set_drive(s, base[previous], time[previous])
                s = advance_law_states(DAMPER, s, u[k - 1], du / h, slope, h, state_rate, p, laws)
        s = set_drive(s, base[k], time[k])
        direction = 1.0 if v[k] > 0.0 else -1.0
        damper = p.k * u[k] + p.c * v[k] + cubic_force(u[k], p.k3)
        damper += (
            quadratic_force(v[k], direction, p.c2) + coulomb_force(direction, p.fc) + p.fy * z + f
        )
        damper = add_law_force(damper, DAMPER, u[k], v[k], s, p, laws)
        opening = p.drift * time[k]
        out[0, k] = damper
        for side in range(2):
            sign = 1.0 if side == 0 else -1.0
            gap = (p.gap_r if side == 0 else p.gap_l) + opening
            d, dd = sign * u[k] - gap, sign * v[k] - p.drift
            b, face, was_in_contact = (
                (b_r, face_r, in_contact_r) if side == 0 else (b_l, face_l, in_contact_l)
            )
            if p.has_bumper_states:
                s = set_drive(s, base[previous], time[previous])
                face, b, s = track_face_with_laws(
                    side, d, dd, face, b, s, slope, was_in_contact, contact[side, k], h,
                    rates, p, laws,
                )  # fmt: skip
                s = set_drive(s, base[k], time[k])
            elif p.kb > 0.0:
                face, b = track_face(p, side, d, face, b, was_in_contact, contact[side, k], h)
            push = bumper_force(p, side, d, dd, b, s, laws) if d > -0.5 * NO_WALL_M else 0.0
            if contact[side, k] > 0.5:
                in_contact, is_held = True, 1.0
            else:
                in_contact = push > -(1.0 + 3.0 * PULL_WIDTH) * p.pull and (
                    was_in_contact or (contact[side, k] < -0.5 and d >= face)
                )
                # measured: without adhesion a contact ends where the cells say so
                in_contact = in_contact and (contact[side, k] < -0.5 or p.pull > 0.0)
                is_held = pull_share(push, p.pull)
            if side == 0:
                b_r, face_r, in_contact_r = b, face, in_contact
            else:
                b_l, face_l, in_contact_l = b, face, in_contact
            out[1 + side, k] = sign * push * is_held if in_contact else 0.0


class PreparedForces(NamedTuple):
    """Coefficients of a model's forces, prepared once for many short motions."""

    coefficients: Coefficients
    laws: AddedLaws | None
    law_rate: float  # of the fastest state in 1/s; -1 without states
    face_stiffness: tuple[float, float]  # of right and left in N/m; 0 without states

    @classmethod
    def from_model(cls, model: Model) -> "PreparedForces":
        law_rate, face_stiffness = -1.0, (0.0, 0.0)
        if any(effect.states for effect, _ in model.added_laws):
            properties, p = sum_law_properties(model.added_laws), model.parameters
            law_rate = max(law.relaxation_rate for law in properties.values())
            face_stiffness = (
                p.bumper_stiffness_r + properties[0].stiffness,
                p.bumper_stiffness_l + properties[1].stiffness,
            )
        return cls(*kernel_coefficients(model), law_rate, face_stiffness)

    def evaluate(
        self,
        u: Float1D,
        v: Float1D,
        base_acc: Float1D,
        time_s: Float1D,
        contact: npt.NDArray[np.int8],
    ) -> Float2D:
        """Return D, F_R and F_L in N, (3, sample); see `forces_along`."""
        out = np.empty((3, u.size))
        touched = contact.astype(np.float64, order="C")
        p, laws, state_rate, face_rate = self.coefficients, self.laws, self.law_rate, -1.0
        if state_rate >= 0.0 and u.size > 1:
            # What relaxes within a small part of a sample, as a fit may try, would take steps
            # without end. Such a face is as good as relaxed; a state that is faster overflows.
            sample_s = float(np.median(np.diff(time_s)))
            state_rate = min(state_rate, MAX_RELAXATIONS / sample_s)
            if p.has_bumper_states:
                limit = MAX_FACE_RELAXATIONS / sample_s
                right, left = self.face_stiffness
                p = p._replace(c_r=max(p.c_r, right / limit), c_l=max(p.c_l, left / limit))
                face_rate = max(right / p.c_r, left / p.c_l)
        _force_kernel(u, v, base_acc, time_s, touched, p, laws, state_rate, face_rate, out)
        return out


def forces_along(
    model: Model,
    u: Float1D,
    v: Float1D,
    base_acc: Float1D,
    time_s: Float1D,
    contact: npt.NDArray[np.int8],
) -> Float2D:
    """Return D, F_R >= 0 and F_L <= 0 in N, (3, sample), of a model along a motion.

    u in m, v in m/s and the acceleration `base_acc` in m/s2 of the table as the mass feels it,
    (sample,), at times `time_s` in s since the start of the run; `contact` (2, sample) right and
    left: IN_CONTACT, NO_CONTACT, or CONTACT_UNKNOWN where the model decides. Effects on the input
    (see `Model.added_acceleration`) and on sensors are not included.
    """
    compiled, on_arrays = _split_laws(model, bool((contact >= 0).all()))
    prepared = PreparedForces.from_model(compiled)
    coefficients, out = prepared.coefficients, prepared.evaluate(u, v, base_acc, time_s, contact)
    for effect, values in on_arrays:
        inputs = {"v": v, "a": base_acc, "t": time_s}
        for place in PLACES[effect.place]:
            if place == DAMPER:
                out[0] += effect.evaluate_force(values, inputs | {"u": u})
                continue
            sign, gap = (1.0, coefficients.gap_r) if place == 0 else (-1.0, coefficients.gap_l)
            opening = gap + coefficients.drift * time_s
            inputs |= {"d": sign * u - opening, "v": sign * v - coefficients.drift}
            push = effect.evaluate_force(values, inputs)
            out[1 + place] += np.where(contact[place] == IN_CONTACT, sign * push, 0.0)
    return out


def _split_laws(
    model: Model, is_contact_known: bool
) -> tuple[Model, list[tuple[Effect, dict[str, float]]]]:
    """Return (model to compile, laws of effect files that can be evaluated on whole arrays).

    A search tries hundreds of laws, and compiling one takes a second. Laws with states, and those
    in bumpers where the model decides on contact, depend on the motion before.
    """
    direct = []
    faces_have_memory = model.coefficients.get("kb", 0.0) or any(
        effect.is_in_bumpers and effect.states for effect, _ in model.added_laws
    )
    for instance in model.present_effects:
        effect = instance.effect
        if not effect.is_of_file or effect.states or effect.acts != "force":
            continue
        if effect.place == "damper" or (is_contact_known and not faces_have_memory):
            direct.append((effect, dict(instance.values)))
    if not direct:
        return model, []
    own = [effect for effect, _ in direct]
    rest = tuple(instance for instance in model.effects if instance.effect not in own)
    return Model(model.base, rest), direct


def depends_on_history(model: Model) -> bool:
    """Return True if a force depends on the motion before it, where contact was measured.

    Where it was not, every force does: a face that is touched stays touched while it pushes.
    """
    if any(effect.states for effect, _ in model.added_laws):
        return True
    return any(model.coefficients.get(name, 0.0) > 0.0 for name in ("fy", "k1", "kb", "pull"))
