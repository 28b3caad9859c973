"""Consistency of sensors: displacement against acceleration, load cell against load cell.

No force law is used: the comparison holds for any motion, including chaotic ones.

Weak form: integral phi'' x dt = integral phi a dt, for phi that vanishes with its slope at both
ends of a window. phi = sin^4(pi t / T) exp(-i k (w t + theta)) at the drive's frequency (k = 1, 2)
differentiates no noise and cancels offsets of x; with k = 0 an offset of a remains.

A sound accelerometer may have a low cut, and filters may delay one sensor more than the other:
    a = gain hp(x'') delayed,  hp = s / (s + w_c),  hp(x'') = x'' - w_c x' + w_c^2 hp(x)
so   <phi, a> = gain <phi'', x> + gain w_c (<phi', x> + w_c <phi, hp(x)>) + delay <phi', a>
for any motion, with hp(x) a recursion over all samples since rest (`sensor_errors.highpass`).
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from table_io.sensor_errors import FIT_ERROR_RATIO, PairErrors, solve_errors

WINDOW_ORDERS = (0, 1, 2)
NOISE_SIGMAS = 6.0
# Amplitude over its standard error, and over the motion, from which a ratio is evaluated.
MIN_AMPLITUDE_SNR = 20.0
MIN_AMPLITUDE_RATIO = 0.3
# Displacements, which add up, and the acceleration of one body.
SENSOR_PAIRS = (
    (("table_disp_m",), "table_acc_m_s2"),
    (("mass_disp_m",), "mass_acc_m_s2"),
    (("rel_disp_m", "table_disp_m"), "mass_acc_m_s2"),
)
MAX_CELL_OFFSET_RATIO = 0.5  # of the contact threshold: force of a cell without contact
Complex1D = npt.NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class WeakFormPair:
    """Acceleration amplitudes from a displacement and from an acceleration in one window, m/s2.

    All at 0, 1 and 2 times the drive's frequency, (3,). `constant` is the response to a constant of
    1 m/s2, `sigma` the standard error of the difference of the amplitudes. `low_cut_term` (m/s) and
    `delay_term` (m/s3) are the changes of the acceleration per rad/s of low cut and s of delay.
    """

    displacement: Complex1D
    acceleration: Complex1D
    constant: Complex1D
    sigma: Float1D
    low_cut_term: Complex1D
    delay_term: Complex1D

    def remove_errors(self, errors: PairErrors) -> "WeakFormPair":
        """Return the pair as sensors without these errors would show it."""
        return replace(
            self,
            displacement=errors.gain * (self.displacement + errors.low_cut * self.low_cut_term),
            acceleration=self.acceleration - errors.delay_s * self.delay_term,
        )

    def normal_equations(self) -> tuple[Float2D, Float1D]:
        """Return (matrix (3, 3), right side (3,)) of gain, gain x low cut and delay.

        An offset of the acceleration is eliminated, so that its drift is not taken for them.
        """
        constant, *rows = self._weighted_parts(slice(None))
        constant = constant / np.linalg.norm(constant)
        columns = np.array([row - (row @ constant) * constant for row in rows])
        products = columns @ columns.T
        return products[:3, :3], products[:3, 3]

    def fit_phase_errors(self) -> PairErrors:
        """Fit the low cut and delay of sound sensors that reduce the mismatch most, at gain 1."""
        columns = np.array(self._weighted_parts(slice(1, None))[1:])
        products = columns @ columns.T
        return solve_errors(products[:3, :3], products[:3, 3], fixed_gain=True)

    def _weighted_parts(self, orders: slice) -> list[Float1D]:
        """Return real and imaginary parts over their error of constant, three terms and values."""
        weight = 1.0 / np.hypot(FIT_ERROR_RATIO * self.size, self.sigma)
        amplitudes = (
            self.constant,
            self.displacement,
            self.low_cut_term,
            self.delay_term,
            self.acceleration,
        )
        weighted = [(weight * each)[orders] for each in amplitudes]
        return [np.concatenate([each.real, each.imag]) for each in weighted]

    @cached_property
    def size(self) -> float:
        """Largest amplitude of the motion, m/s2."""
        pair = self.displacement[1:], self.acceleration[1:]
        return float(max(np.abs(amplitudes).max() for amplitudes in pair))

    @cached_property
    def average(self) -> float:
        """Larger of the two averages, m/s2; a gain error is proportional to it."""
        return float(max(abs(self.displacement[0].real), abs(self.acceleration[0].real)))

    @cached_property
    def mismatch(self) -> float:
        """Largest difference in excess of six standard errors, m/s2."""
        return self._beyond_noise(self.acceleration - self.displacement)

    @cached_property
    def offset(self) -> float:
        """Offset of the acceleration that explains the differences best (least squares), m/s2."""
        difference = self.acceleration - self.displacement
        return float((self.constant.conj() @ difference).real / self._weight)

    @property
    def sigma_offset(self) -> float:
        """Standard error of `offset`, m/s2."""
        return float(np.linalg.norm(np.abs(self.constant) * self.sigma)) / self._weight

    @property
    def mismatch_without_offset(self) -> float:
        """Mismatch after subtraction of `offset`, m/s2."""
        difference = self.acceleration - self.displacement
        return self._beyond_noise(difference - self.offset * self.constant)

    @property
    def is_clear(self) -> bool:
        """True if the motion at the drive's frequency is large enough to compare the sensors."""
        threshold = max(MIN_AMPLITUDE_SNR * float(self.sigma[1]), MIN_AMPLITUDE_RATIO * self.size)
        return bool(abs(self.displacement[1]) > threshold)

    @property
    def fundamental_mismatch(self) -> float:
        """Difference at the drive's frequency in excess of six standard errors, m/s2."""
        difference = abs(self.displacement[1] - self.acceleration[1])
        return float(max(difference - NOISE_SIGMAS * self.sigma[1], 0.0))

    def _beyond_noise(self, difference: Complex1D) -> float:
        return float(max((np.abs(difference) - NOISE_SIGMAS * self.sigma)[1:].max(), 0.0))

    @property
    def _weight(self) -> float:
        return float(np.sum(np.abs(self.constant) ** 2))


@dataclass(frozen=True, slots=True, eq=False)
class WeakFormWindow:
    """Test functions phi, phi' and phi'' of one window, orders 0 to 2, complex (order, sample)."""

    phi: npt.NDArray[np.complex128]
    phi_d: npt.NDArray[np.complex128]
    phi_dd: npt.NDArray[np.complex128]


def make_window(samples: int, cycles: float, middle: float, rate_hz: float) -> WeakFormWindow:
    """Make the window over `samples` samples in which the drive turns `cycles` cycles.

    `middle` is the phase in cycles at its center. A tone of amplitude 1 gives amplitude 1.
    """
    t = (np.arange(samples) + 0.5) / samples
    length = samples / rate_hz
    sin, cos = np.sin(np.pi * t), np.cos(np.pi * t)
    bell = sin**4
    slope = 4 * math.pi / length * sin**3 * cos
    curvature = (math.pi / length) ** 2 * (12 * sin**2 * cos**2 - 4 * sin**4)
    omega = 2 * math.pi * cycles / length
    tone = np.exp(-2j * np.pi * (middle + cycles * (t - 0.5)))
    total = float(bell.sum())
    phi = np.empty((len(WINDOW_ORDERS), samples), dtype=np.complex128)
    phi_d, phi_dd = np.empty_like(phi), np.empty_like(phi)
    wave = np.ones_like(tone)
    for k in WINDOW_ORDERS:
        scale = (2.0 if k else 1.0) / total
        phi[k] = scale * bell * wave
        phi_d[k] = scale * (slope - 1j * k * omega * bell) * wave
        phi_dd[k] = scale * (curvature - 2j * k * omega * slope - (k * omega) ** 2 * bell) * wave
        wave = wave * tone
    return WeakFormWindow(phi, phi_d, phi_dd)


def compare_motion(
    window: WeakFormWindow,
    x: Float1D,
    a: Float1D,
    noise: tuple[float, float],
    filtered: tuple[Float1D, float],
) -> WeakFormPair:
    """Compare displacement x in m with acceleration a in m/s2, (sample,); `noise`: rms of each.

    `filtered`: displacement behind a high-pass, (sample,), and its corner in rad/s.
    """
    errors = np.hypot(
        noise[0] * np.linalg.norm(window.phi_dd, axis=1),
        noise[1] * np.linalg.norm(window.phi, axis=1),
    )
    return WeakFormPair(
        window.phi_dd @ x,
        window.phi @ a,
        window.phi.sum(axis=1),
        errors,
        window.phi_d @ x + filtered[1] * (window.phi @ filtered[0]),
        window.phi_d @ a,
    )


@dataclass(frozen=True, slots=True)
class CellPairFit:
    """Distribution of a force over two load cells, from their principal axis.

    `angle` in rad of the axis (pi/4: equal shares, 0: the first alone, -pi/4: one is reversed),
    `rms` along it and `means` of both in N. `sigma_angle` and `sigma` are the standard errors of
    angle and means.
    """

    angle: float
    means: tuple[float, float]
    rms: float
    sigma_angle: float
    sigma: float


def fit_cell_pair(first: Float1D, second: Float1D, noise: float) -> CellPairFit:
    """Fit the principal axis of the forces of two cells in N, (sample,); `noise`: rms of either."""
    means = float(first.mean()), float(second.mean())
    a, b = first - means[0], second - means[1]
    aa, bb, ab = float(a @ a), float(b @ b), float(a @ b)
    angle = 0.5 * math.atan2(2 * ab, aa - bb)
    if angle < -math.pi / 4 - 1e-3:
        angle += math.pi
    rms = math.sqrt(0.5 * (aa + bb + math.hypot(aa - bb, 2 * ab)) / first.size)
    sigma = noise / math.sqrt(first.size)
    return CellPairFit(angle, means, rms, sigma / rms if rms else math.inf, sigma)


def remove_spikes(values: Float2D, limit: Float2D) -> Float2D:
    """Replace spikes by the median of three samples, (channel, sample).

    A spike deviates by more than `limit`, (channel, 1), from the median with its neighbors.
    """
    left, middle, right = values[:, :-2], values[:, 1:-1], values[:, 2:]
    median = np.maximum(np.minimum(left, middle), np.minimum(np.maximum(left, middle), right))
    clean = values.copy()
    clean[:, 1:-1] = np.where(np.abs(middle - median) > limit, median, middle)
    return clean
