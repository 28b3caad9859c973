"""Hidden plant: the plant of `plant.py` with all effects of `ground_truth.DEFINITION_BY_ID`,
on a servo or on the table of `hydraulic_table.py`.

    R + damper + N_R - N_L + M g sin(tilt y + pitch y'') = m2 p,  R = M x''
    free face:     static_j + dashpot_j d_j' = 0
    touched face:  d_j' = +-u' - drift, N_j = static_j + dashpot_j d_j', for as long as N_j > -pull

p is the pull of the appendage over m2, tilt and pitch are those of the table.
Force laws are smooth versions of their textbook forms, so classical Runge-Kutta with steps divided
at contact changes keeps its fourth order (except for z of Bouc-Wen at z = 0, where it is once
differentiable only). The table bears R of the mass and of the appendage. Without a ground truth
and without oil `Plant` is used instead.
"""

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Self

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_untyped_kernel
from table_io.errors import InputError
from table_io.sim import plant as base_plant
from table_io.sim.hidden_laws import (
    MEMORY_SIZE,
    StrangeLaws,
    inline_jit,
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
    _write_hydraulic_rates,
)
from table_io.sim.plant import (
    TOUCHED,
    VX,
    VY,
    D,
    Plant,
    X,
    Y,
    _evaluate_path,
    _shift_path,
    _spline_path,
)
from table_io.units import GRAVITY_M_S2

# Continues the state of `plant.py`, float64 (15,): z, Maxwell forces of damper and bumpers in N,
# position and velocity of the appendage, time in s. The states of strange laws come last, if any.
Z, F, B, W, VW, T, STATE_SIZE = 8, 9, 10, 12, 13, 14, 15
PITCH_ITERATIONS = 4  # reduce the error of the pitch to 1e-8 of it
BISECTION_STEPS = 45  # reduce a sub-step to rounding error
ROUNDING_SPEED_M_S = 1e-3  # below it |u'| is smoothed
STRETCH_SCALE_M, HARDENING_SCALE_M, DAMPING_SCALE_M = (
    0.15,
    0.1,
    0.03,
)  # length scales of the force laws; see `ground_truth.DEFINITION_BY_ID`
FAST_SPEED_M_S, FAST_ACCELERATION_M_S2 = 0.5, 2.0  # of a fast motion, to bound the sub-step


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

    def shortest_time_s(self, plant: Plant) -> float:
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
    v = s[VX] - s[VY]
    right, right_rate = _face_state(s, 0, params, hidden)
    left, left_rate = _face_state(s, 1, params, hidden)
    specimen_force = _damper_force(s, params, hidden) + right - left
    command = _evaluate_path(path, t)
    if oil.area > 0.0:
        command_rate = path[1] + 2.0 * t * path[2]
        drive = _write_hydraulic_rates(s, s[Y], s[VY], command, command_rate, oil, rate)
        servo = drive / oil.table_mass
    else:
        servo = params.p * (params.p * (command - s[Y]) - 2.0 * s[VY])
    if hidden.pitch != 0.0:
        # Table acceleration and pitch cause each other; their loop gain is below 0.01.
        table_acc, thrust = servo + specimen_force * params.inv_table_mass, 0.0
        for _ in range(PITCH_ITERATIONS):
            angle = hidden.tilt * s[Y] + hidden.pitch * table_acc
            thrust = params.m * GRAVITY_M_S2 * math.sin(angle)
            table_acc = servo + (specimen_force + thrust) * params.inv_table_mass
        specimen_force += thrust
    elif hidden.tilt != 0.0:
        specimen_force += params.m * GRAVITY_M_S2 * math.sin(hidden.tilt * s[Y])
    swing = hidden.w2 * (hidden.w2 * (s[W] - s[X]) + 2.0 * hidden.z2 * (s[VW] - s[VX]))
    rate[X] = s[VX]
    rate[VX] = (hidden.m2 * swing - specimen_force) / params.m
    rate[Y] = s[VY]
    rate[VY] = servo + specimen_force * params.inv_table_mass
    rate[D], rate[D + 1] = right_rate, left_rate
    rate[TOUCHED], rate[TOUCHED + 1] = 0.0, 0.0
    rate[Z] = 0.0
    if hidden.fy != 0.0:
        hysteresis = (
            hidden.beta * math.tanh(v / ROUNDING_SPEED_M_S) * np.sign(s[Z]) + 1.0 - hidden.beta
        )
        rate[Z] = v / hidden.uy * (1.0 - abs(s[Z]) ** hidden.n * hysteresis)
    rate[F] = hidden.k1 * v - s[F] / hidden.tau
    rate[B] = hidden.kb * right_rate - s[B] / hidden.tau_b
    rate[B + 1] = hidden.kb * left_rate - s[B + 1] / hidden.tau_b
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
    """Integrate one step of h seconds, contacts fixed, into the last row of `work`."""
    stage, end = work[4], work[5]
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
def _find_changed_contact(s, params, hidden):  # type: ignore[no-untyped-def]
    """Find the face (0 right, 1 left) whose contact has changed, or -1."""
    for j in range(2):
        if s[TOUCHED + j] != 0.0:
            margin = (_face_state(s, j, params, hidden)[0] + hidden.pull) / params.kj
        else:
            margin = params.gap[j] + hidden.gap_rate * s[T] + s[D + j] - (1 - 2 * j) * (s[X] - s[Y])
        if margin < -base_plant.TOUCH_TOLERANCE_M:
            return j
    return -1


@inline_jit
def _tie_faces(s, params, hidden):  # type: ignore[no-untyped-def]
    """Tie touched faces to the mass against rounding errors; flush denormals to zero."""
    for j in range(2):
        if s[TOUCHED + j] != 0.0:
            s[D + j] = (1 - 2 * j) * (s[X] - s[Y]) - params.gap[j] - hidden.gap_rate * s[T]
    for n in (D, D + 1, F, B, B + 1):
        if abs(s[n]) < base_plant.DENORMAL_M:
            s[n] = 0.0


@inline_jit
def _advance_substep(s, path, h, params, hidden, oil, work):  # type: ignore[no-untyped-def]
    """Advance the state by h, divided at contact changes."""
    remaining, trial = h, work[5]
    for switch in range(base_plant.MAX_CONTACT_CHANGES + 1):
        _step_runge_kutta(s, path, remaining, params, hidden, oil, work)
        if (
            switch == base_plant.MAX_CONTACT_CHANGES
            or _find_changed_contact(trial, params, hidden) < 0
        ):
            break
        low, high = 0.0, remaining
        for _ in range(BISECTION_STEPS):
            middle = 0.5 * (low + high)
            _step_runge_kutta(s, path, middle, params, hidden, oil, work)
            if _find_changed_contact(trial, params, hidden) < 0:
                low = middle
            else:
                high = middle
        _step_runge_kutta(s, path, high, params, hidden, oil, work)
        side = _find_changed_contact(trial, params, hidden)
        s[:] = trial
        s[TOUCHED + side] = 1.0 - s[TOUCHED + side]
        _tie_faces(s, params, hidden)
        path = _shift_path(path, high)
        remaining -= high
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
        out[4, k], out[5, k] = (
            _face_state(s, 0, params, hidden)[0],
            -_face_state(s, 1, params, hidden)[0],
        )
        out[6, k] = _damper_force(s, params, hidden)


@dataclass(frozen=True)
class HiddenPlant(Plant):
    """Plant with hidden effects; a signal `damper_force` is added.

    `state` is float64 (15,), or on a hydraulic table that of `HydraulicCoefficients.state_size`:
    then the bandwidth is not used. Strange laws add `MEMORY_SIZE` states.
    """

    hidden: HiddenCoefficients = field(default_factory=HiddenCoefficients)
    oil: HydraulicCoefficients = field(default_factory=HydraulicCoefficients)
    signals = (*base_plant.SIGNALS, "damper_force")

    def __post_init__(self) -> None:
        super().__post_init__()
        softening = self.hidden.strange.softening_bumper[0]
        softest = self.bumper_stiffness_n_m * min(self.hidden.stiffness_ratio)
        if softening >= softest:
            raise InputError(
                f"bumpers that soften by {softening:g} N/m push with a negative stiffness",
                where="ground truth",
                key="softening_bumper.stiffness",
                value=softening,
                allowed=f"less than {softest:g} N/m, the stiffness of the softer bumper",
                remedy="let them soften less",
            )
        shortest_s, min_time_s = (
            self.hidden.shortest_time_s(self),
            1.0 / (base_plant.MAX_SUBSTEP_RATIO * base_plant.MAX_SUBSTEPS * self.rate_hz),
        )
        if shortest_s < min_time_s:
            raise InputError(
                f"the fastest effect has a time scale of {shortest_s:.2g} s, too short for the "
                "integrator",
                where="ground truth",
                allowed=f"at least {min_time_s:.2g} s at {self.rate_hz:g} Hz",
                remedy="change the parameters of the effects, or raise the sampling rate",
            )
        longest_s = MAX_HYDRAULIC_SUBSTEP_S if self.oil.area else self.substep_s
        object.__setattr__(
            self, "substep_s", min(longest_s, base_plant.MAX_SUBSTEP_RATIO * shortest_s)
        )

    def with_servo_share(self, share: float) -> Self:
        """Return the plant with this share of its oil supply, or of its servo's bandwidth."""
        if not self.oil.area:
            return super().with_servo_share(share)
        return replace(self, oil=self.oil.with_supply(share))

    def rest_state(self) -> Float1D:
        """Return the state of static equilibrium with the table at 0 and all forces relaxed.

        Bisection of spring(u) + N_R - N_L = 0, since the force laws are nonlinear.
        """
        params = self._params

        def compress_bumpers(u: float) -> tuple[float, float]:
            return max(u - self.gap_right_m, 0.0), max(-u - self.gap_left_m, 0.0)

        def force(u: float) -> float:
            right, left = (
                _bumper_coefficients.py_func(d, 0.0, 0.0, j, params, self.hidden)[0]
                for j, d in enumerate(compress_bumpers(u))
            )
            return float(_spring_force.py_func(u, 0.0, params, self.hidden) + right - left)

        low, high = -0.05, 0.05
        for _ in range(80 if force(0.0) != 0.0 else 0):
            middle = 0.5 * (low + high)
            low, high = (middle, high) if force(middle) < 0.0 else (low, middle)
        u = 0.5 * (low + high)
        size = self.oil.state_size if self.oil.area else STATE_SIZE
        size += MEMORY_SIZE if self.hidden.is_strange else 0
        state, compressions = np.zeros(size), compress_bumpers(u)
        state[[X, W, T]] = u, u, -1.0 / self.rate_hz  # sample 0 is then at 0 s
        state[D : D + 2], state[TOUCHED : TOUCHED + 2] = compressions, np.array(compressions) > 0.0
        return state

    def advance(self, state: Float1D, command_m: Float1D, out: Float2D) -> None:
        """Advance as `Plant.advance`; `out` is (7, sample)."""
        if command_m.shape != (self.history_samples + out.shape[1],) or len(out) != len(
            self.signals
        ):
            raise ValueError(f"command {command_m.shape} does not span output {out.shape}")
        _advance_samples(
            state,
            command_m,
            self._params,
            self.hidden,
            self.oil,
            np.empty((base_plant.WORK_ROWS, state.size)),
            out,
        )
