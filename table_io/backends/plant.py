"""The truth behind the simulated table: servo, specimen and bumpers, stepped by its own integrator.

Laboratory frame, right positive: mass x, table y, u = x - y. A bumper is a massless face behind a
Kelvin-Voigt layer; d_j >= 0 is its compression, whichever way it faces, N_j the force that closes
it:

    R + C u' + K u + N_R - N_L = 0   with R = M x''   (force on the mass)
    y'' = p^2 (s - y) - 2 p y' - R / m   (servo; the last term only with payload reaction)
    free face:     N_j = 0,  C_j d_j' = -K_j d_j
    touched face:  d_j' = +-u',  N_j = C_j d_j' + K_j d_j, for as long as N_j > 0

s is the delayed command, smoothed by the output stage to a quadratic B-spline through three samples
(straight lines would leave a ripple p^2 h^2 / 12 of y'' at the sample rate, which sampling folds
into a false gain: 0.3 % at 1 kHz). p = 2 pi f / sqrt(sqrt(2) - 1) puts the -3 dB of the double pole
at f. Within a sub-step s is one parabola and the contacts are fixed: where one changes, the step is
cut there, so classical Runge-Kutta keeps its fourth order. A touch that begins and ends inside one
sub-step is not seen (less than 0.2 N with the paper's rig).
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numba import njit

from table_io.block import Float1D, Float2D
from table_io.card import BadInput

SUBSTEP_S = 6.25e-5  # bounds the touch that is not seen; the integration error is far below
RELAXATION = 0.25  # sub-step over C_j/K_j at most; 2.8 is where Runge-Kutta turns unstable
MOST_SUBSTEPS = 400  # a sample; more would fall behind real time
SIGNALS = ("table_disp", "table_acc", "mass_disp", "mass_acc", "force_right", "force_left")

# The state, float64 (8,): positions in m, velocities in m/s, compressions in m, 1.0 where touched.
X, VX, Y, VY, D, ON = 0, 1, 2, 3, 4, 6
MOVING, ROWS = 6, 6  # entries with a rate; work space: four rates, a stage, a trial
TOUCH_M = 1e-14  # above the rounding of positions: a face just left is not touched again by it
SWITCHES = 12  # of contact within one sub-step; more is a graze below rounding
DENORMAL_M = 1e-30


class _Law(NamedTuple):
    """What the kernels read, SI: M K C, K_j C_j, gaps, pole, 1/m (0: no payload reaction), h, phi.

    h is the sample interval in s, phi the fraction of it at which the spline has a corner, with
    `before` and `after` sub-steps on either side.
    """

    m: float
    k: float
    c: float
    kj: float
    cj: float
    gap: tuple[float, float]
    p: float
    per_table: float
    h: float
    phi: float
    before: int
    after: int


@njit(cache=True, nogil=True)
def _push(s, j, law):  # type: ignore[no-untyped-def]
    """N_j >= 0 in N: what the face j (0 right, 1 left) bears."""
    if s[ON + j] == 0.0:
        return 0.0
    closing = (1 - 2 * j) * (s[VX] - s[VY])
    return law.kj * s[D + j] + law.cj * closing


@njit(cache=True, nogil=True)
def _at(path, t):  # type: ignore[no-untyped-def]
    """Command in m at t seconds of the parabola path = (m, m/s, m/s2)."""
    return path[0] + t * (path[1] + t * path[2])


@njit(cache=True, nogil=True)
def _from(path, t):  # type: ignore[no-untyped-def]
    """The same parabola with its time counted from t on."""
    return _at(path, t), path[1] + 2.0 * t * path[2], path[2]


@njit(cache=True, nogil=True)
def _rates(s, command, law, rate):  # type: ignore[no-untyped-def]
    """Time derivative of the moving part of the state, into `rate`; command in m."""
    v = s[VX] - s[VY]
    on_table = law.k * (s[X] - s[Y]) + law.c * v + _push(s, 0, law) - _push(s, 1, law)
    rate[X] = s[VX]
    rate[VX] = -on_table / law.m
    rate[Y] = s[VY]
    rate[VY] = law.p * (law.p * (command - s[Y]) - 2.0 * s[VY]) + on_table * law.per_table
    for j in range(2):
        free = s[ON + j] == 0.0
        rate[D + j] = -law.kj / law.cj * s[D + j] if free else (1 - 2 * j) * v


@njit(cache=True, nogil=True)
def _runge_kutta(s, path, h, law, work):  # type: ignore[no-untyped-def]
    """The state h seconds on, contacts unchanged, into the last row of `work`."""
    stage, end = work[4], work[5]
    _rates(s, path[0], law, work[0])
    for i in range(1, 4):
        part = h if i == 3 else 0.5 * h
        for n in range(MOVING):
            stage[n] = s[n] + part * work[i - 1, n]
        stage[ON], stage[ON + 1] = s[ON], s[ON + 1]
        _rates(stage, _at(path, part), law, work[i])
    for n in range(MOVING):
        mean = work[0, n] + 2.0 * (work[1, n] + work[2, n]) + work[3, n]
        end[n] = s[n] + h / 6.0 * mean
    end[ON], end[ON + 1] = s[ON], s[ON + 1]


@njit(cache=True, nogil=True)
def _margin(s, j, law):  # type: ignore[no-untyped-def]
    """Metres before face j changes its contact: the clearance, or N_j/K_j where it is touched."""
    if s[ON + j] != 0.0:
        return _push(s, j, law) / law.kj
    return law.gap[j] + s[D + j] - (1 - 2 * j) * (s[X] - s[Y])


@njit(cache=True, nogil=True)
def _change(s, j, path, h, law, work):  # type: ignore[no-untyped-def]
    """Time in s within h at which the margin of face j is gone, a hair late rather than early.

    Illinois false position over Runge-Kutta steps. A face left early would be touched again.
    """
    low, at_low = 0.0, _margin(s, j, law)
    high, at_high = h, _margin(work[5], j, law)
    if at_low <= 0.0:
        return 0.0
    weight_low, weight_high, moved = at_low, at_high, 0
    for _ in range(60):
        if at_high > -0.1 * TOUCH_M or high - low < 1e-15 * h:
            break
        middle = (low * weight_high - high * weight_low) / (weight_high - weight_low)
        _runge_kutta(s, path, middle, law, work)
        at = _margin(work[5], j, law)
        if at > 0.0:
            low, weight_low = middle, at
            weight_high *= 0.5 if moved == 1 else 1.0
            moved = 1
        else:
            high, at_high, weight_high = middle, at, at
            weight_low *= 0.5 if moved == -1 else 1.0
            moved = -1
    return high


@njit(cache=True, nogil=True)
def _settle(s, law):  # type: ignore[no-untyped-def]
    """Ties touched faces to the mass, so that rounding cannot part them; drops denormals."""
    for j in range(2):
        if s[ON + j] != 0.0:
            s[D + j] = (1 - 2 * j) * (s[X] - s[Y]) - law.gap[j]
        elif abs(s[D + j]) < DENORMAL_M:
            s[D + j] = 0.0


@njit(cache=True, nogil=True)
def _substep(s, path, h, law, work):  # type: ignore[no-untyped-def]
    """Moves the state by h, cut where a contact changes."""
    left = h
    for _ in range(SWITCHES):
        _runge_kutta(s, path, left, law, work)
        gone = (_margin(work[5], 0, law) < -TOUCH_M, _margin(work[5], 1, law) < -TOUCH_M)
        if not (gone[0] or gone[1]):
            break
        first, side = left, -1
        for j in range(2):
            if gone[j]:
                _runge_kutta(s, path, left, law, work)
                when = _change(s, j, path, left, law, work)
                if side < 0 or when < first:
                    first, side = when, j
        _runge_kutta(s, path, first, law, work)
        s[:] = work[5]
        s[ON + side] = 1.0 - s[ON + side]
        _settle(s, law)
        path = _from(path, first)
        left -= first
        _runge_kutta(s, path, left, law, work)
    s[:] = work[5]
    _settle(s, law)


@njit(cache=True, nogil=True)
def _spline(command, k, h):  # type: ignore[no-untyped-def]
    """Parabola of the quadratic B-spline over one sample interval h, from three samples."""
    a, b, c = command[k], command[k + 1], command[k + 2]
    return 0.5 * (a + b), (b - a) / h, 0.5 * (a - 2.0 * b + c) / (h * h)


@njit(cache=True, nogil=True)
def _advance(s, command, law, work, out):  # type: ignore[no-untyped-def]
    """Moves `s` by out.shape[1] samples; command[k : k + 4] spans the delayed sample k."""
    corner, rest = law.phi * law.h, (1.0 - law.phi) * law.h
    for k in range(out.shape[1]):
        path = _from(_spline(command, k, law.h), rest)
        h = corner / max(law.before, 1)
        for i in range(law.before):
            _substep(s, _from(path, i * h), h, law, work)
        path = _spline(command, k + 1, law.h)
        h = rest / law.after
        for i in range(law.after):
            _substep(s, _from(path, i * h), h, law, work)
        _rates(s, _at(path, rest), law, work[0])
        out[0, k], out[1, k] = s[Y], work[0, VY]
        out[2, k], out[3, k] = s[X], work[0, VX]
        out[4, k], out[5, k] = _push(s, 0, law), -_push(s, 1, law)


@dataclass(frozen=True)
class Plant:
    """A table with a specimen on it, sampled at rate_hz. Gaps in m: inf none, negative pressed in.

    `state` arrays are float64 (8,): x, x', y, y', compression right and left, and 1.0 where the
    right and the left face are touched. Whoever holds the state holds the plant. The output stage
    takes half a sample, so a smaller servo_delay_s counts as that.
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
    substep_s: float = SUBSTEP_S
    signals: ClassVar[tuple[str, ...]] = SIGNALS

    def __post_init__(self) -> None:
        least = self.bumper_stiffness_n_m / (RELAXATION * MOST_SUBSTEPS * self.rate_hz)
        if self.bumper_damping_n_s_m < least:
            raise BadInput(
                f"bumper_damping_n_s_m = {self.bumper_damping_n_s_m:g} lets a bumper relax faster "
                "than the simulated table can follow; "
                f"allowed at {self.rate_hz:g} Hz: at least {least:.3g}"
            )

    @property
    def history(self) -> int:
        """Samples of command from before the first sample that `advance` needs."""
        return self._corner[0] + 3

    @property
    def _corner(self) -> tuple[int, float]:
        """Whole samples, and part of one, by which the spline's corners lag the samples."""
        lag = max(self.servo_delay_s * self.rate_hz - 0.5, 0.0)
        whole = math.floor(lag + 1e-9)  # a delay of whole half samples must not leave a splinter
        return whole, lag - whole if lag - whole > 1e-9 else 0.0

    @cached_property
    def _law(self) -> _Law:
        h, phi = 1.0 / self.rate_hz, self._corner[1]
        kj, cj = self.bumper_stiffness_n_m, self.bumper_damping_n_s_m
        longest = min(self.substep_s, RELAXATION * cj / kj)
        before, after = (math.ceil(part * h / longest - 1e-9) for part in (phi, 1.0 - phi))
        return _Law(
            self.mass_kg, self.damper_stiffness_n_m, self.damper_damping_n_s_m, kj, cj,
            (self.gap_right_m, self.gap_left_m),
            2 * math.pi * self.servo_bandwidth_hz / math.sqrt(math.sqrt(2.0) - 1.0),
            1.0 / self.table_mass_kg if self.payload_reaction else 0.0,
            h, phi, before, after,
        )  # fmt: skip

    def rest(self) -> Float1D:
        """State of static equilibrium with the table at 0, bumpers pressed in by negative gaps.

        K u + N_R - N_L = 0, N_R = K_j (u - G_R) where that is > 0, N_L = K_j (-u - G_L) likewise.
        """
        k, kj = self.damper_stiffness_n_m, self.bumper_stiffness_n_m
        right, left = self.gap_right_m, self.gap_left_m
        for on_r, on_l in ((False, False), (True, False), (False, True), (True, True)):
            pull = (right if on_r else 0.0) - (left if on_l else 0.0)
            u = kj * pull / (k + kj * (on_r + on_l))
            if (u > right) == on_r and (-u > left) == on_l:
                break
        pressed = max(u - right, 0.0), max(-u - left, 0.0)
        return np.array([u, 0.0, 0.0, 0.0, *pressed, float(on_r), float(on_l)])

    def advance(self, state: Float1D, command_m: Float1D, out: Float2D) -> None:
        """Moves `state` in place by out.shape[1] samples; `out`, (6, sample), receives SIGNALS, SI.

        command_m, (history + sample,), ends at the last sample of `out`. Forces are F_R >= 0 and
        F_L <= 0 in N; accelerations are total, in m/s2.
        """
        if command_m.shape != (self.history + out.shape[1],) or out.shape[0] != len(SIGNALS):
            raise ValueError(f"command {command_m.shape} does not span output {out.shape}")
        work = np.empty((ROWS, state.size))
        _advance(state, command_m, self._law, work, out)
