"""Plant of the simulated table: servo or hydraulics, specimen, bumpers, with its own integrator.

Laboratory frame, right positive: mass x, table y, u = x - y. A bumper is a massless face on a
Kelvin-Voigt layer; d_j >= 0 is its compression on either side, N_j the compressive force:

    R + C u' + K u + N_R - N_L = 0   with R = M x''   (force on the mass)
    y'' = p^2 (s - y) - 2 p y' - R / m   (servo; the last term only with payload reaction)
    free face:     N_j = 0,  C_j d_j' = -K_j d_j
    touched face:  d_j' = +-u',  N_j = C_j d_j' + K_j d_j, for as long as N_j > 0

s is the delayed command, smoothed by the output stage to a quadratic B-spline through three samples
(straight lines would leave a ripple p^2 h^2 / 12 of y'' at the sample rate, which aliases into a
gain error: 0.3 % at 1 kHz). p = 2 pi f / sqrt(sqrt(2) - 1) puts the -3 dB point of the double pole
at f. With oil, `hydraulic_table.py` gives y'' instead of the servo.

Hidden laws, those of `ground_truth.DEFINITION_BY_ID`, add to this:

    R + damper + N_R - N_L + M g sin(tilt y + pitch y'') = m2 p
    free face:     static_j + dashpot_j d_j' = 0
    touched face:  d_j' = +-u' - drift, N_j = static_j + dashpot_j d_j', for as long as N_j > -pull

p is the pull of the appendage over m2, tilt and pitch are those of the table. The laws are smooth
versions of their textbook forms. Where a plant has none, `hidden` is None, and the compiled kernel
holds none of their terms.

Within a sub-step s is one parabola and the contacts are fixed; the step is divided where a contact
changes, so classical Runge-Kutta keeps its fourth order (except for z of Bouc-Wen at z = 0, where
it is once differentiable only). A contact that begins and ends within one sub-step is missed (less
than 0.2 N with the paper's rig).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.compilation import inline_jit, jit_untyped_kernel
from table_io.errors import InputError
from table_io.sim.hidden_laws import (
    MEMORY_SIZE,
    StrangeLaws,
    memory_force,
    memory_rates,
    softening_rate,
    strange_damper_force,
    strange_dashpot_push,
    strange_recovery_rate,
    strange_resonator,
    strange_spring_force,
    strange_spring_push,
)
from table_io.sim.hydraulic_table import (
    MAX_HYDRAULIC_SUBSTEP_S,
    HydraulicCoefficients,
    write_hydraulic_rates,
)
from table_io.units import GRAVITY_M_S2

MAX_SUBSTEP_S = 6.25e-5  # bounds missed contacts; the integration error is far smaller
MAX_SUBSTEP_RATIO = 0.25  # sub-step over the shortest time; Runge-Kutta is unstable above 2.8
MAX_SUBSTEPS = 400  # per sample; more would be slower than real time
SIGNALS = (
    "table_disp", "table_acc", "mass_disp", "mass_acc", "force_right", "force_left", "damper_force",
)  # fmt: skip
RECORDED_SIGNALS = SIGNALS[:6]  # in a flight record

# Indices of the state: positions in m, velocities in m/s, compressions in m, 1.0 where touched.
X, VX, Y, VY, D, TOUCHED, BASE_STATE_SIZE = 0, 1, 2, 3, 4, 6, 8
# With hidden laws: z, Maxwell forces of damper and bumpers in N, position and velocity of the
# appendage, time in s. The states of a hydraulic table follow, and those of strange laws come last.
Z, F, B, W, VW, T, STATE_SIZE = 8, 9, 10, 12, 13, 14, 15
TRIAL, WORK_ROWS = 5, 6  # rows of the work space: four rates, a stage, a trial
# Above the rounding error of positions, so that it cannot re-close a contact just released.
TOUCH_TOLERANCE_M = 1e-14
MAX_CONTACT_CHANGES = 12  # per sub-step; more means grazing at rounding level
DENORMAL_M = 1e-30
PITCH_ITERATIONS = 4  # reduce the error of the pitch to 1e-8 of it
BISECTION_STEPS = 45  # reduce a sub-step to rounding error
FALSE_POSITION_STEPS = 60  # the same, at most, without hidden laws
ROUNDING_SPEED_M_S = 1e-3  # below it |u'| is smoothed
# Length scales of the force laws; see `ground_truth.DEFINITION_BY_ID`.
STRETCH_SCALE_M = 0.15
HARDENING_SCALE_M = 0.1
DAMPING_SCALE_M = 0.03
# Of a fast motion, to bound the sub-step.
FAST_SPEED_M_S = 0.5
FAST_ACCELERATION_M_S2 = 2.0


class _PlantParameters(NamedTuple):
    """Kernel parameters, SI: M K C, K_j C_j, gaps, pole, 1/m (0: no payload reaction), h, phi.

    h is the sample interval in s, phi the fraction of it at which the spline has a knot, with
    `substeps_before` and `substeps_after` sub-steps on either side.
    """

    m: float
    k: float
    c: float
    kj: float
    cj: float
    gap: tuple[float, float]
    p: float
    inv_table_mass: float
    h: float
    phi: float
    substeps_before: int
    substeps_after: int


class HiddenCoefficients(NamedTuple):
    """Coefficients of the hidden force laws in SI; defaults make all effects vanish."""

    k3: float = 0.0
    k5: float = 0.0
    ke: float = 0.0
    dead_width: float = 0.0
    c2: float = 0.0
    c3: float = 0.0
    cu: float = 0.0
    fc: float = 0.0
    fs: float = 0.0
    vs: float = 1.0
    v0: float = ROUNDING_SPEED_M_S
    fy: float = 0.0
    uy: float = 1.0
    n: float = 1.5
    beta: float = 0.6
    k1: float = 0.0
    tau: float = 1.0
    k2: float = 0.0
    kc: float = 0.0
    ch: float = 0.0
    kb: float = 0.0
    tau_b: float = 1.0
    pull: float = 0.0
    gap_rate: float = 0.0
    stiffness_rate: float = 0.0
    tilt: float = 0.0
    pitch: float = 0.0
    stiffness_ratio: tuple[float, float] = (1.0, 1.0)  # K_R and K_L over the mean
    m2: float = 0.0
    w2: float = 0.0
    z2: float = 0.0
    is_strange: bool = False  # any of `strange`
    strange: StrangeLaws = StrangeLaws()

    def shortest_time_s(self, plant: "Plant") -> float:
        """Return the shortest time scale of the force laws in s."""
        dry_force = max(self.fc, self.fs, 1e-9)
        kj, cj = plant.bumper_stiffness_n_m * max(self.stiffness_ratio), plant.bumper_damping_n_s_m
        return min(
            cj / (kj + self.kb),
            self.tau,
            self.tau_b,
            self.v0 * min(plant.mass_kg / dry_force, 1.0 / FAST_ACCELERATION_M_S2),
            self.uy / (self.n * FAST_SPEED_M_S),
            1.0 / max(self.w2, 1e-9),
            self.strange.shortest_time_s,
        )


@inline_jit
def _evaluate_path(path, t):  # type: ignore[no-untyped-def]
    """Evaluate the parabola path = (m, m/s, m/s2) at t seconds: command in m."""
    return path[0] + t * (path[1] + t * path[2])


@inline_jit
def _shift_path(path, t):  # type: ignore[no-untyped-def]
    """Shift the time origin of a parabola to t."""
    return _evaluate_path(path, t), path[1] + 2.0 * t * path[2], path[2]


@inline_jit
def _spline_path(command, k, h):  # type: ignore[no-untyped-def]
    """Return the parabola of the quadratic B-spline over one sample interval h."""
    a, b, c = command[k], command[k + 1], command[k + 2]
    return 0.5 * (a + b), (b - a) / h, 0.5 * (a - 2.0 * b + c) / (h * h)


@inline_jit
def _spring_force(u, t, params, hidden):  # type: ignore[no-untyped-def]
    """Return the elastic force of the damper in N; u in m, t in s."""
    u2 = u * u
    force = (
        u * (params.k * (1.0 + hidden.stiffness_rate * t) + hidden.k5 * u2 * u2) + hidden.ke * u2
    )
    if hidden.k3 != 0.0:
        force += hidden.k3 * u * u2 / math.sqrt(1.0 + u2 / STRETCH_SCALE_M**2)
    if hidden.dead_width > 0.0:
        force -= params.k * hidden.dead_width * math.tanh(u / hidden.dead_width)
    if hidden.is_strange:
        force += strange_spring_force(u, hidden.strange)
    return force


@inline_jit
def _damper_force(s, params, hidden):  # type: ignore[no-untyped-def]
    """Return the damper force in N: springs, dashpots, dry friction, hysteresis, relaxation."""
    u, v = s[X] - s[Y], s[VX] - s[VY]
    if hidden is None:
        return params.k * u + params.c * v
    viscous = (
        params.c
        + hidden.c2 * math.sqrt(v * v + ROUNDING_SPEED_M_S**2)
        + hidden.c3 * v * v
        + hidden.cu * u * u
    )
    force = _spring_force(u, s[T], params, hidden) + viscous * v + hidden.fy * s[Z] + s[F]
    if hidden.fc > 0.0 or hidden.fs > 0.0:
        dry_force = hidden.fc + (hidden.fs - hidden.fc) * math.exp(-((v / hidden.vs) ** 2))
        force += dry_force * math.tanh(v / hidden.v0)
    if hidden.is_strange:
        force += strange_damper_force(u, v, s[Y], s[VY], s[T], params.c, hidden.strange)
        force += memory_force(s[s.size - MEMORY_SIZE], s[s.size - 3], hidden.strange)
    return force


@inline_jit
def _bumper_coefficients(d, b, softened, j, params, hidden):  # type: ignore[no-untyped-def]
    """Return (static force in N, dashpot in N s/m) of bumper j; d in m, Maxwell force b in N."""
    static = params.kj * hidden.stiffness_ratio[j] * d + hidden.kc * d * d * d + b
    dashpot = params.cj
    if hidden.k2 != 0.0:
        static += (
            2.0
            * hidden.k2
            * HARDENING_SCALE_M**2
            * (math.expm1(d / HARDENING_SCALE_M) - d / HARDENING_SCALE_M)
        )
    if hidden.ch != 0.0:
        dashpot += hidden.ch * DAMPING_SCALE_M * math.tanh(abs(d) / DAMPING_SCALE_M)
    if hidden.is_strange:
        static += strange_spring_push(d, j, softened, hidden.strange)
    return static, dashpot


@inline_jit
def _face_state(s, j, params, hidden):  # type: ignore[no-untyped-def]
    """Return (N_j in N, d_j' in m/s) of the face j."""
    if hidden is None:
        if s[TOUCHED + j] == 0.0:
            return 0.0, -params.kj / params.cj * s[D + j]
        closing = (1 - 2 * j) * (s[VX] - s[VY])
        return params.kj * s[D + j] + params.cj * closing, closing
    softened = s[s.size - 2 + j] if hidden.is_strange else 0.0
    static, dashpot = _bumper_coefficients(s[D + j], s[B + j], softened, j, params, hidden)
    if s[TOUCHED + j] == 0.0:
        return 0.0, strange_recovery_rate(static, dashpot, hidden.strange)
    closing = (1 - 2 * j) * (s[VX] - s[VY]) - hidden.gap_rate
    push = static + dashpot * closing
    if hidden.is_strange:
        push += strange_dashpot_push(closing, hidden.strange)
    return push, closing


@inline_jit
def _rates(s, path, t, params, hidden, oil, rate):  # type: ignore[no-untyped-def]
    """Write the time derivative of the state into `rate`, at t seconds on the command's path."""
    right, right_rate = _face_state(s, 0, params, hidden)
    left, left_rate = _face_state(s, 1, params, hidden)
    specimen_force = _damper_force(s, params, hidden) + right - left
    command = _evaluate_path(path, t)
    if oil is None:
        servo = params.p * (params.p * (command - s[Y]) - 2.0 * s[VY])
    else:
        command_rate = path[1] + 2.0 * t * path[2]
        drive = write_hydraulic_rates(s, s[Y], s[VY], command, command_rate, oil, rate)
        servo = drive / oil.table_mass
    if hidden is not None:
        specimen_force += _tilt_force(s, servo, specimen_force, params, hidden)
    rate[X] = s[VX]
    rate[VX] = -specimen_force / params.m
    rate[Y] = s[VY]
    rate[VY] = servo + specimen_force * params.inv_table_mass
    rate[D], rate[D + 1] = right_rate, left_rate
    rate[TOUCHED], rate[TOUCHED + 1] = 0.0, 0.0
    if hidden is not None:
        _hidden_rates(s, specimen_force, params, hidden, rate)


@inline_jit
def _tilt_force(s, servo, specimen_force, params, hidden):  # type: ignore[no-untyped-def]
    """Return the share of gravity along the tilted table in N; `servo` in m/s2."""
    if hidden.pitch != 0.0:
        # Table acceleration and pitch cause each other; their loop gain is below 0.01.
        table_acc, thrust = servo + specimen_force * params.inv_table_mass, 0.0
        for _ in range(PITCH_ITERATIONS):
            angle = hidden.tilt * s[Y] + hidden.pitch * table_acc
            thrust = params.m * GRAVITY_M_S2 * math.sin(angle)
            table_acc = servo + (specimen_force + thrust) * params.inv_table_mass
        return thrust
    if hidden.tilt != 0.0:
        return params.m * GRAVITY_M_S2 * math.sin(hidden.tilt * s[Y])
    return 0.0


@inline_jit
def _hidden_rates(s, specimen_force, params, hidden, rate):  # type: ignore[no-untyped-def]
    """Write the rates of the states of hidden laws; add the pull of the appendage to the mass."""
    v = s[VX] - s[VY]
    swing = hidden.w2 * (hidden.w2 * (s[W] - s[X]) + 2.0 * hidden.z2 * (s[VW] - s[VX]))
    rate[VX] = (hidden.m2 * swing - specimen_force) / params.m
    rate[Z] = 0.0
    if hidden.fy != 0.0:
        hysteresis = (
            hidden.beta * math.tanh(v / ROUNDING_SPEED_M_S) * np.sign(s[Z]) + 1.0 - hidden.beta
        )
        rate[Z] = v / hidden.uy * (1.0 - abs(s[Z]) ** hidden.n * hysteresis)
    rate[F] = hidden.k1 * v - s[F] / hidden.tau
    for j in range(2):
        rate[B + j] = hidden.kb * rate[D + j] - s[B + j] / hidden.tau_b
    rate[W], rate[VW], rate[T] = s[VW], -swing, 1.0
    if hidden.is_strange:
        laws, memory = hidden.strange, s.size - MEMORY_SIZE
        pull, second_acc = strange_resonator(
            s[W] - s[X], s[VW] - s[VX], s[W] - s[Y], s[VW] - s[VY], laws
        )
        rate[VX] += pull / params.m
        rate[VW] += second_acc
        rate[memory], rate[memory + 1] = memory_rates(v, s[memory], s[memory + 1], laws)
        for j in range(2):
            rate[memory + 2 + j] = softening_rate(s[TOUCHED + j], s[memory + 2 + j], laws)


@inline_jit
def _step_runge_kutta(s, path, h, params, hidden, oil, work):  # type: ignore[no-untyped-def]
    """Integrate one step of h seconds, contacts fixed, into row TRIAL of `work`."""
    stage, end = work[TRIAL - 1], work[TRIAL]
    _rates(s, path, 0.0, params, hidden, oil, work[0])
    for i in range(1, 4):
        dt = h if i == 3 else 0.5 * h
        for n in range(s.size):
            stage[n] = s[n] + dt * work[i - 1, n]
        _rates(stage, path, dt, params, hidden, oil, work[i])
    for n in range(s.size):
        mean = work[0, n] + 2.0 * (work[1, n] + work[2, n]) + work[3, n]
        end[n] = s[n] + h / 6.0 * mean


@inline_jit
def _contact_margin(s, j, params, hidden):  # type: ignore[no-untyped-def]
    """Return the margin in m to a contact change of face j: clearance, or N_j/K_j if touched."""
    pull = 0.0 if hidden is None else hidden.pull
    if s[TOUCHED + j] != 0.0:
        return (_face_state(s, j, params, hidden)[0] + pull) / params.kj
    gap = params.gap[j] + _gap_drift(s, hidden)
    return gap + s[D + j] - (1 - 2 * j) * (s[X] - s[Y])


@inline_jit
def _gap_drift(s, hidden):  # type: ignore[no-untyped-def]
    """Return by how much m either gap has grown."""
    return 0.0 if hidden is None else hidden.gap_rate * s[T]


@inline_jit
def _find_changed_contact(s, params, hidden):  # type: ignore[no-untyped-def]
    """Find the face (0 right, 1 left) whose contact has changed, or -1."""
    for j in range(2):
        if _contact_margin(s, j, params, hidden) < -TOUCH_TOLERANCE_M:
            return j
    return -1


@inline_jit
def _locate_change_of(s, j, path, h, params, hidden, oil, work):  # type: ignore[no-untyped-def]
    """Locate the contact change of face j: time in s within h at which its margin vanishes.

    Illinois false position over Runge-Kutta steps. The result is late rather than early: a face
    released early would be touched again.
    """
    _step_runge_kutta(s, path, h, params, hidden, oil, work)
    low, margin_low = 0.0, _contact_margin(s, j, params, hidden)
    high, margin_high = h, _contact_margin(work[TRIAL], j, params, hidden)
    if margin_low <= 0.0:
        return 0.0
    weight_low, weight_high, last_side = margin_low, margin_high, 0
    for _ in range(FALSE_POSITION_STEPS):
        if margin_high > -0.1 * TOUCH_TOLERANCE_M or high - low < 1e-15 * h:
            break
        middle = (low * weight_high - high * weight_low) / (weight_high - weight_low)
        _step_runge_kutta(s, path, middle, params, hidden, oil, work)
        margin = _contact_margin(work[TRIAL], j, params, hidden)
        if margin > 0.0:
            low, weight_low = middle, margin
            weight_high *= 0.5 if last_side == 1 else 1.0
            last_side = 1
        else:
            high, margin_high, weight_high = middle, margin, margin
            weight_low *= 0.5 if last_side == -1 else 1.0
            last_side = -1
    return high


@inline_jit
def _locate_first_change(s, path, h, params, hidden, oil, work):  # type: ignore[no-untyped-def]
    """Locate the first contact change within h seconds: (time in s, face).

    Row TRIAL of `work` holds the state after h. Force laws of any shape are bisected; without any,
    the margins are smooth enough for the faster false position.
    """
    if hidden is None:
        has_changed = (
            _contact_margin(work[TRIAL], 0, params, hidden) < -TOUCH_TOLERANCE_M,
            _contact_margin(work[TRIAL], 1, params, hidden) < -TOUCH_TOLERANCE_M,
        )
        earliest, side = h, -1
        for j in range(2):
            if has_changed[j]:
                time = _locate_change_of(s, j, path, h, params, hidden, oil, work)
                if side < 0 or time < earliest:
                    earliest, side = time, j
        return earliest, side
    low, high = 0.0, h
    for _ in range(BISECTION_STEPS):
        middle = 0.5 * (low + high)
        _step_runge_kutta(s, path, middle, params, hidden, oil, work)
        if _find_changed_contact(work[TRIAL], params, hidden) < 0:
            low = middle
        else:
            high = middle
    _step_runge_kutta(s, path, high, params, hidden, oil, work)
    return high, _find_changed_contact(work[TRIAL], params, hidden)


@inline_jit
def _tie_faces(s, params, hidden):  # type: ignore[no-untyped-def]
    """Tie touched faces to the mass against rounding errors; flush denormals to zero."""
    for j in range(2):
        if s[TOUCHED + j] != 0.0:
            s[D + j] = (1 - 2 * j) * (s[X] - s[Y]) - params.gap[j] - _gap_drift(s, hidden)
    _flush_denormals(s, D, 2)
    if hidden is not None:
        _flush_denormals(s, F, 3)


@inline_jit
def _flush_denormals(s, first, count):  # type: ignore[no-untyped-def]
    for n in range(first, first + count):
        if abs(s[n]) < DENORMAL_M:
            s[n] = 0.0


@inline_jit
def _advance_substep(s, path, h, params, hidden, oil, work):  # type: ignore[no-untyped-def]
    """Advance the state by h, divided at contact changes."""
    remaining, trial = h, work[TRIAL]
    for switch in range(MAX_CONTACT_CHANGES + 1):
        _step_runge_kutta(s, path, remaining, params, hidden, oil, work)
        if switch == MAX_CONTACT_CHANGES or _find_changed_contact(trial, params, hidden) < 0:
            break
        time, side = _locate_first_change(s, path, remaining, params, hidden, oil, work)
        _step_runge_kutta(s, path, time, params, hidden, oil, work)
        s[:] = trial
        s[TOUCHED + side] = 1.0 - s[TOUCHED + side]
        _tie_faces(s, params, hidden)
        path = _shift_path(path, time)
        remaining -= time
    s[:] = trial
    _tie_faces(s, params, hidden)


@jit_untyped_kernel
def _advance_samples(s, command, params, hidden, oil, work, out):  # type: ignore[no-untyped-def]
    """Advance `s` by out.shape[1] samples; command[k : k + 4] spans the delayed sample k."""
    corner, rest = params.phi * params.h, (1.0 - params.phi) * params.h
    for k in range(out.shape[1]):
        path = _shift_path(_spline_path(command, k, params.h), rest)
        h = corner / max(params.substeps_before, 1)
        for i in range(params.substeps_before):
            _advance_substep(s, _shift_path(path, i * h), h, params, hidden, oil, work)
        path = _spline_path(command, k + 1, params.h)
        h = rest / params.substeps_after
        for i in range(params.substeps_after):
            _advance_substep(s, _shift_path(path, i * h), h, params, hidden, oil, work)
        _rates(s, path, rest, params, hidden, oil, work[0])
        out[0, k], out[1, k] = s[Y], work[0, VY]
        out[2, k], out[3, k] = s[X], work[0, VX]
        out[4, k] = _face_state(s, 0, params, hidden)[0]
        out[5, k] = -_face_state(s, 1, params, hidden)[0]
        out[6, k] = _damper_force(s, params, hidden)


@dataclass(frozen=True)
class Plant:
    """Table with a specimen, sampled at rate_hz; gaps in m: inf no bumper, negative precompressed.

    `state` arrays are float64 (8,): x, x', y, y', compression right and left, and 1.0 where the
    right and the left face are touched; then (15,) with hidden laws, with oil those of
    `HydraulicCoefficients.state_size`, and MEMORY_SIZE more with strange laws. The plant itself is
    stateless. The output stage takes half a sample, so a shorter servo_delay_s counts as half a
    sample. With oil the bandwidth is not used, and `hidden` must be given.
    """

    mass_kg: float
    damper_stiffness_n_m: float
    damper_damping_n_s_m: float
    bumper_stiffness_n_m: float
    bumper_damping_n_s_m: float
    gap_right_m: float
    gap_left_m: float
    table_mass_kg: float
    servo_bandwidth_hz: float
    servo_delay_s: float
    payload_reaction: bool
    rate_hz: float
    substep_s: float = MAX_SUBSTEP_S
    hidden: HiddenCoefficients | None = None
    oil: HydraulicCoefficients | None = None

    def __post_init__(self) -> None:
        min_damping = self.bumper_stiffness_n_m / (MAX_SUBSTEP_RATIO * MAX_SUBSTEPS * self.rate_hz)
        if self.bumper_damping_n_s_m < min_damping:
            raise InputError(
                "the bumpers relax too fast for the integrator of the simulated table",
                key="bumper_damping_n_s_m",
                value=self.bumper_damping_n_s_m,
                allowed=f"at least {min_damping:.3g} at {self.rate_hz:g} Hz",
            )
        longest_s = self.substep_s if self.oil is None else MAX_HYDRAULIC_SUBSTEP_S
        if self.hidden is not None:
            longest_s = min(longest_s, MAX_SUBSTEP_RATIO * self._check_hidden(self.hidden))
        object.__setattr__(self, "substep_s", longest_s)

    def _check_hidden(self, hidden: HiddenCoefficients) -> float:
        """Return the shortest time scale of the hidden laws in s; InputError if it is too short."""
        softening = hidden.strange.softening_bumper[0]
        softest = self.bumper_stiffness_n_m * min(hidden.stiffness_ratio)
        if softening >= softest:
            raise InputError(
                f"bumpers that soften by {softening:g} N/m push with a negative stiffness",
                where="ground truth",
                key="softening_bumper.stiffness",
                value=softening,
                allowed=f"less than {softest:g} N/m, the stiffness of the softer bumper",
                remedy="let them soften less",
            )
        shortest_s = hidden.shortest_time_s(self)
        min_time_s = 1.0 / (MAX_SUBSTEP_RATIO * MAX_SUBSTEPS * self.rate_hz)
        if shortest_s < min_time_s:
            raise InputError(
                f"the fastest effect has a time scale of {shortest_s:.2g} s, too short for the "
                "integrator",
                where="ground truth",
                allowed=f"at least {min_time_s:.2g} s at {self.rate_hz:g} Hz",
                remedy="change the parameters of the effects, or raise the sampling rate",
            )
        return shortest_s

    def with_servo_share(self, share: float) -> Self:
        """Return the plant with this share of its oil supply, or of its servo's bandwidth."""
        if self.oil is not None:
            return replace(self, oil=self.oil.with_supply(share))
        return replace(self, servo_bandwidth_hz=share * self.servo_bandwidth_hz)

    @property
    def history_samples(self) -> int:
        """Samples of command before the first sample that `advance` needs."""
        return self._corner_lag[0] + 3

    @property
    def _corner_lag(self) -> tuple[int, float]:
        """Lag of the spline's knots behind the samples: whole samples and fraction of one."""
        lag = max(self.servo_delay_s * self.rate_hz - 0.5, 0.0)
        whole_samples = math.floor(
            lag + 1e-9
        )  # no tiny interval from rounding if the lag is a whole number of samples
        return whole_samples, lag - whole_samples if lag - whole_samples > 1e-9 else 0.0

    @cached_property
    def _params(self) -> _PlantParameters:
        h, phi = 1.0 / self.rate_hz, self._corner_lag[1]
        kj, cj = self.bumper_stiffness_n_m, self.bumper_damping_n_s_m
        longest = min(self.substep_s, MAX_SUBSTEP_RATIO * cj / kj)
        before, after = (math.ceil(share * h / longest - 1e-9) for share in (phi, 1.0 - phi))
        return _PlantParameters(
            self.mass_kg, self.damper_stiffness_n_m, self.damper_damping_n_s_m, kj, cj,
            (self.gap_right_m, self.gap_left_m),
            2 * math.pi * self.servo_bandwidth_hz / math.sqrt(math.sqrt(2.0) - 1.0),
            1.0 / self.table_mass_kg if self.payload_reaction else 0.0,
            h, phi, before, after,
        )  # fmt: skip

    def rest_state(self) -> Float1D:
        """Return the state of static equilibrium with the table at 0 and all forces relaxed."""
        u = self._rest_position()
        compressions = np.array(self._compress_bumpers(u))
        state = np.zeros(self._state_size)
        state[X] = u
        state[D : D + 2] = compressions
        state[TOUCHED : TOUCHED + 2] = compressions > 0.0
        if self.hidden is not None:
            state[W] = u
            state[T] = -1.0 / self.rate_hz  # sample 0 is then at 0 s
        return state

    def _compress_bumpers(self, u: float) -> tuple[float, float]:
        return max(u - self.gap_right_m, 0.0), max(-u - self.gap_left_m, 0.0)

    def _rest_position(self) -> float:
        """Return u in m at which spring(u) + N_R - N_L = 0.

        In closed form without hidden laws; else by bisection, since the laws are nonlinear.
        """
        params, hidden = self._params, self.hidden
        if hidden is None:
            right, left, u = self.gap_right_m, self.gap_left_m, 0.0
            for on_r, on_l in ((False, False), (True, False), (False, True), (True, True)):
                preload_gap = (right if on_r else 0.0) - (left if on_l else 0.0)
                u = params.kj * preload_gap / (params.k + params.kj * (on_r + on_l))
                if (u > right) == on_r and (-u > left) == on_l:
                    break
            return u

        def force(u: float) -> float:
            right, left = (
                _bumper_coefficients.py_func(d, 0.0, 0.0, j, params, hidden)[0]
                for j, d in enumerate(self._compress_bumpers(u))
            )
            return float(_spring_force.py_func(u, 0.0, params, hidden) + right - left)

        low, high = -0.05, 0.05
        for _ in range(80 if force(0.0) != 0.0 else 0):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if force(middle) < 0.0 else (low, middle)
        return 0.5 * (low + high)

    @property
    def _state_size(self) -> int:
        if self.hidden is None:
            return BASE_STATE_SIZE
        size = STATE_SIZE if self.oil is None else self.oil.state_size
        return size + MEMORY_SIZE if self.hidden.is_strange else size

    def advance(self, state: Float1D, command_m: Float1D, out: Float2D) -> None:
        """Advance `state` in place by out.shape[1] samples; write SIGNALS to `out`, (7, sample).

        command_m, (history + sample,), ends at the last sample of `out`. SI: forces F_R >= 0 and
        F_L <= 0 in N; accelerations are total, in m/s2.
        """
        samples = out.shape[1]
        if command_m.shape != (self.history_samples + samples,) or len(out) != len(SIGNALS):
            raise ValueError(f"command {command_m.shape} does not span output {out.shape}")
        work = np.empty((WORK_ROWS, state.size))
        _advance_samples(state, command_m, self._params, self.hidden, self.oil, work, out)
