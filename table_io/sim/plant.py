"""Plant of the simulated table: servo, specimen and bumpers with their own integrator.

Laboratory frame, right positive: mass x, table y, u = x - y. A bumper is a massless face on a
Kelvin-Voigt layer; d_j >= 0 is its compression on either side, N_j the compressive force:

    R + C u' + K u + N_R - N_L = 0   with R = M x''   (force on the mass)
    y'' = p^2 (s - y) - 2 p y' - R / m   (servo; the last term only with payload reaction)
    free face:     N_j = 0,  C_j d_j' = -K_j d_j
    touched face:  d_j' = +-u',  N_j = C_j d_j' + K_j d_j, for as long as N_j > 0

s is the delayed command, smoothed by the output stage to a quadratic B-spline through three samples
(straight lines would leave a ripple p^2 h^2 / 12 of y'' at the sample rate, which aliases into a
gain error: 0.3 % at 1 kHz). p = 2 pi f / sqrt(sqrt(2) - 1) puts the -3 dB point of the double pole
at f. Within a sub-step s is one parabola and the contacts are fixed; the step is divided where a
contact changes, so classical Runge-Kutta keeps its fourth order. A contact that begins and ends
within one sub-step is missed (less than 0.2 N with the paper's rig).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_untyped_kernel
from table_io.errors import InputError

MAX_SUBSTEP_S = 6.25e-5  # bounds missed contacts; the integration error is far smaller
MAX_SUBSTEP_RATIO = 0.25  # sub-step over C_j/K_j; Runge-Kutta is unstable above 2.8
MAX_SUBSTEPS = 400  # per sample; more would be slower than real time
SIGNALS = ("table_disp", "table_acc", "mass_disp", "mass_acc", "force_right", "force_left")

# Indices of the state, float64 (8,): positions in m, velocities in m/s, compressions in m, 1.0
# where touched.
X, VX, Y, VY, D, TOUCHED = 0, 1, 2, 3, 4, 6
RATE_COUNT, WORK_ROWS = 6, 6  # entries with a rate; work space: four rates, a stage, a trial
# Above the rounding error of positions, so that it cannot re-close a contact just released.
TOUCH_TOLERANCE_M = 1e-14
MAX_CONTACT_CHANGES = 12  # per sub-step; more means grazing at rounding level
DENORMAL_M = 1e-30


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


@jit_untyped_kernel
def _contact_force(s, j, params):  # type: ignore[no-untyped-def]
    """Return the contact force N_j >= 0 in N of the face j (0 right, 1 left)."""
    if s[TOUCHED + j] == 0.0:
        return 0.0
    closing = (1 - 2 * j) * (s[VX] - s[VY])
    return params.kj * s[D + j] + params.cj * closing


@jit_untyped_kernel
def _evaluate_path(path, t):  # type: ignore[no-untyped-def]
    """Evaluate the parabola path = (m, m/s, m/s2) at t seconds: command in m."""
    return path[0] + t * (path[1] + t * path[2])


@jit_untyped_kernel
def _shift_path(path, t):  # type: ignore[no-untyped-def]
    """Shift the time origin of a parabola to t."""
    return _evaluate_path(path, t), path[1] + 2.0 * t * path[2], path[2]


@jit_untyped_kernel
def _rates(s, command, params, rate):  # type: ignore[no-untyped-def]
    """Write the time derivative of the first RATE_COUNT states into `rate`; command in m."""
    v = s[VX] - s[VY]
    specimen_force = (
        params.k * (s[X] - s[Y])
        + params.c * v
        + _contact_force(s, 0, params)
        - _contact_force(s, 1, params)
    )
    rate[X] = s[VX]
    rate[VX] = -specimen_force / params.m
    rate[Y] = s[VY]
    rate[VY] = (
        params.p * (params.p * (command - s[Y]) - 2.0 * s[VY])
        + specimen_force * params.inv_table_mass
    )
    for j in range(2):
        free = s[TOUCHED + j] == 0.0
        rate[D + j] = -params.kj / params.cj * s[D + j] if free else (1 - 2 * j) * v


@jit_untyped_kernel
def _step_runge_kutta(s, path, h, params, work):  # type: ignore[no-untyped-def]
    """Integrate one step of h seconds, contacts fixed, into the last row of `work`."""
    stage, end = work[4], work[5]
    _rates(s, path[0], params, work[0])
    for i in range(1, 4):
        dt = h if i == 3 else 0.5 * h
        for n in range(RATE_COUNT):
            stage[n] = s[n] + dt * work[i - 1, n]
        stage[TOUCHED], stage[TOUCHED + 1] = s[TOUCHED], s[TOUCHED + 1]
        _rates(stage, _evaluate_path(path, dt), params, work[i])
    for n in range(RATE_COUNT):
        mean = work[0, n] + 2.0 * (work[1, n] + work[2, n]) + work[3, n]
        end[n] = s[n] + h / 6.0 * mean
    end[TOUCHED], end[TOUCHED + 1] = s[TOUCHED], s[TOUCHED + 1]


@jit_untyped_kernel
def _contact_margin(s, j, params):  # type: ignore[no-untyped-def]
    """Return the margin in m to a contact change of face j: clearance, or N_j/K_j if touched."""
    if s[TOUCHED + j] != 0.0:
        return _contact_force(s, j, params) / params.kj
    return params.gap[j] + s[D + j] - (1 - 2 * j) * (s[X] - s[Y])


@jit_untyped_kernel
def _find_contact_change(s, j, path, h, params, work):  # type: ignore[no-untyped-def]
    """Locate the contact change of face j: time in s within h at which its margin vanishes.

    Illinois false position over Runge-Kutta steps. The result is late rather than early: a face
    released early would be touched again.
    """
    low, margin_low = 0.0, _contact_margin(s, j, params)
    high, margin_high = h, _contact_margin(work[5], j, params)
    if margin_low <= 0.0:
        return 0.0
    weight_low, weight_high, last_side = margin_low, margin_high, 0
    for _ in range(60):
        if margin_high > -0.1 * TOUCH_TOLERANCE_M or high - low < 1e-15 * h:
            break
        middle = (low * weight_high - high * weight_low) / (weight_high - weight_low)
        _step_runge_kutta(s, path, middle, params, work)
        margin = _contact_margin(work[5], j, params)
        if margin > 0.0:
            low, weight_low = middle, margin
            weight_high *= 0.5 if last_side == 1 else 1.0
            last_side = 1
        else:
            high, margin_high, weight_high = middle, margin, margin
            weight_low *= 0.5 if last_side == -1 else 1.0
            last_side = -1
    return high


@jit_untyped_kernel
def _tie_faces(s, params):  # type: ignore[no-untyped-def]
    """Tie touched faces to the mass against rounding errors; flush denormals to zero."""
    for j in range(2):
        if s[TOUCHED + j] != 0.0:
            s[D + j] = (1 - 2 * j) * (s[X] - s[Y]) - params.gap[j]
        elif abs(s[D + j]) < DENORMAL_M:
            s[D + j] = 0.0


@jit_untyped_kernel
def _advance_substep(s, path, h, params, work):  # type: ignore[no-untyped-def]
    """Advance the state by h, divided at contact changes."""
    remaining = h
    for _ in range(MAX_CONTACT_CHANGES):
        _step_runge_kutta(s, path, remaining, params, work)
        crossed = (
            _contact_margin(work[5], 0, params) < -TOUCH_TOLERANCE_M,
            _contact_margin(work[5], 1, params) < -TOUCH_TOLERANCE_M,
        )
        if not (crossed[0] or crossed[1]):
            break
        earliest, side = remaining, -1
        for j in range(2):
            if crossed[j]:
                _step_runge_kutta(s, path, remaining, params, work)
                time = _find_contact_change(s, j, path, remaining, params, work)
                if side < 0 or time < earliest:
                    earliest, side = time, j
        _step_runge_kutta(s, path, earliest, params, work)
        s[:] = work[5]
        s[TOUCHED + side] = 1.0 - s[TOUCHED + side]
        _tie_faces(s, params)
        path = _shift_path(path, earliest)
        remaining -= earliest
        _step_runge_kutta(s, path, remaining, params, work)
    s[:] = work[5]
    _tie_faces(s, params)


@jit_untyped_kernel
def _spline_path(command, k, h):  # type: ignore[no-untyped-def]
    """Return the parabola of the quadratic B-spline over one sample interval h."""
    a, b, c = command[k], command[k + 1], command[k + 2]
    return 0.5 * (a + b), (b - a) / h, 0.5 * (a - 2.0 * b + c) / (h * h)


@jit_untyped_kernel
def _advance_samples(s, command, params, work, out):  # type: ignore[no-untyped-def]
    """Advance `s` by out.shape[1] samples; command[k : k + 4] spans the delayed sample k."""
    corner, rest = params.phi * params.h, (1.0 - params.phi) * params.h
    for k in range(out.shape[1]):
        path = _shift_path(_spline_path(command, k, params.h), rest)
        h = corner / max(params.substeps_before, 1)
        for i in range(params.substeps_before):
            _advance_substep(s, _shift_path(path, i * h), h, params, work)
        path = _spline_path(command, k + 1, params.h)
        h = rest / params.substeps_after
        for i in range(params.substeps_after):
            _advance_substep(s, _shift_path(path, i * h), h, params, work)
        _rates(s, _evaluate_path(path, rest), params, work[0])
        out[0, k], out[1, k] = s[Y], work[0, VY]
        out[2, k], out[3, k] = s[X], work[0, VX]
        out[4, k], out[5, k] = _contact_force(s, 0, params), -_contact_force(s, 1, params)


@dataclass(frozen=True)
class Plant:
    """Table with a specimen, sampled at rate_hz; gaps in m: inf no bumper, negative precompressed.

    `state` arrays are float64 (8,): x, x', y, y', compression right and left, and 1.0 where the
    right and the left face are touched. The plant itself is stateless. The output stage takes half
    a sample, so a shorter servo_delay_s counts as half a sample.
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
    signals: ClassVar[tuple[str, ...]] = SIGNALS

    def __post_init__(self) -> None:
        min_damping = self.bumper_stiffness_n_m / (MAX_SUBSTEP_RATIO * MAX_SUBSTEPS * self.rate_hz)
        if self.bumper_damping_n_s_m < min_damping:
            raise InputError(
                "the bumpers relax too fast for the integrator of the simulated table",
                key="bumper_damping_n_s_m",
                value=self.bumper_damping_n_s_m,
                allowed=f"at least {min_damping:.3g} at {self.rate_hz:g} Hz",
            )

    def with_servo_share(self, share: float) -> Self:
        """Return the plant with this share of its servo's bandwidth."""
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
        """Return the state of static equilibrium: table at 0, bumpers precompressed if gaps < 0.

        K u + N_R - N_L = 0, N_R = K_j (u - G_R) where that is > 0, N_L = K_j (-u - G_L) likewise.
        """
        k, kj = self.damper_stiffness_n_m, self.bumper_stiffness_n_m
        right, left = self.gap_right_m, self.gap_left_m
        for on_r, on_l in ((False, False), (True, False), (False, True), (True, True)):
            preload_gap = (right if on_r else 0.0) - (left if on_l else 0.0)
            u = kj * preload_gap / (k + kj * (on_r + on_l))
            if (u > right) == on_r and (-u > left) == on_l:
                break
        compressions = max(u - right, 0.0), max(-u - left, 0.0)
        return np.array([u, 0.0, 0.0, 0.0, *compressions, float(on_r), float(on_l)])

    def advance(self, state: Float1D, command_m: Float1D, out: Float2D) -> None:
        """Advance `state` in place by out.shape[1] samples; write SIGNALS to `out`, (6, sample).

        command_m, (history + sample,), ends at the last sample of `out`. SI: forces F_R >= 0 and
        F_L <= 0 in N; accelerations are total, in m/s2.
        """
        if command_m.shape != (self.history_samples + out.shape[1],) or out.shape[0] != len(
            SIGNALS
        ):
            raise ValueError(f"command {command_m.shape} does not span output {out.shape}")
        work = np.empty((WORK_ROWS, state.size))
        _advance_samples(state, command_m, self._params, work, out)
