"""Order tracking: least-squares fit of harmonics at the phase of the drive, and the table's FRF.

x(t) = offset + sum over k of Im(c_k exp(2 pi i k phase)), so a real c_1 is in phase with the
acceleration sine of the drive. The phase is the closed form of the drive at each sample, so only
amplitudes are estimated, and a cycle need not be a whole number of samples.

The FRF is interpolated and extrapolated from the identified frequencies. Two quantities are nearly
polynomials for any displacement servo: 1 / gain^2 in f^2 (exactly, of second degree, for a loop
with two poles) and the phase, odd in f, linear where a delay dominates. Up to three terms of the
first and two of the second are fitted, limited by the number of points.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from table_io.records import FrequencyResponse

HARMONIC_COUNT = 10
Complex1D = npt.NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class HarmonicFit:
    """Harmonic fit: offset, c_1 .. c_n and rms residual, in the unit of the samples."""

    offset: float
    amplitudes: Complex1D
    residual_rms: float

    @property
    def fundamental(self) -> float:
        """Amplitude of the fundamental."""
        return float(abs(self.amplitudes[0]))


NO_FIT = HarmonicFit(float("nan"), np.full(HARMONIC_COUNT, complex("nan")), float("nan"))


def track_harmonics(
    values: Float1D, phase: Float1D, harmonics: int = HARMONIC_COUNT
) -> HarmonicFit:
    """Fit the harmonics of `values`, (sample,), at the drive `phase` in cycles, (sample,).

    Harmonics with fewer than four samples per cycle are not fitted (zero). All NaN if samples are
    lost or too few.
    """
    return track_channels(values[None], phase, harmonics)[0]


def track_channels(
    values: Float1D, phase: Float1D, harmonics: int = HARMONIC_COUNT
) -> list[HarmonicFit]:
    """Apply `track_harmonics` to several channels, (channel, sample), with one phase."""
    basis = _harmonic_basis(phase, harmonics)
    normal = _normal_matrix(basis)
    return [_fit_harmonics(basis, normal, row, harmonics) for row in values]


def _harmonic_basis(phase: Float1D, harmonics: int) -> Float1D:
    """Return the basis columns 1, sin, cos, sin 2, cos 2, ..., (sample, 2 orders + 1)."""
    cycles = float(np.ptp(phase)) if phase.size else 0.0
    resolvable = int(phase.size / (4 * cycles)) if cycles > 0 else 0
    orders = min(harmonics, resolvable)
    rotation = np.exp(2j * np.pi * phase)
    basis = np.ones((phase.size, 2 * orders + 1))
    wave = np.ones_like(rotation)
    for k in range(orders):
        wave = wave * rotation
        basis[:, 2 * k + 1], basis[:, 2 * k + 2] = wave.imag, wave.real
    return basis


def _normal_matrix(basis: Float2D) -> Float2D:
    # Not BLAS: on a busy computer its threads can wait seconds for one another.
    return np.asarray(np.einsum("ij,ik->jk", basis, basis))


def _fit_harmonics(basis: Float2D, normal: Float2D, values: Float1D, harmonics: int) -> HarmonicFit:
    columns = basis.shape[1]
    if columns < 3 or values.size < 2 * columns or not np.isfinite(values).all():
        return NO_FIT
    solution = np.linalg.solve(normal, np.einsum("ij,i->j", basis, values))
    amplitudes = np.zeros(harmonics, dtype=np.complex128)
    # a sin + b cos = Im((a + i b) exp(i theta))
    amplitudes[: columns // 2] = solution[1::2] + 1j * solution[2::2]
    rms = float(np.sqrt(np.mean((values - np.einsum("ij,j->i", basis, solution)) ** 2)))
    return HarmonicFit(float(solution[0]), amplitudes, rms)


def estimate_harmonic_error(values: Float1D, phase: Float1D, harmonics: int) -> float:
    """Return the standard error of all harmonics of `track_harmonics`, their root sum of squares.

    From the scatter of offset, sines and cosines between the cycles of `values`, (sample,), at the
    `phase` in cycles, so noise of any spectrum counts as it passed a control loop. NaN if samples
    are lost or of less than two cycles.
    """
    basis = _harmonic_basis(phase, harmonics)
    cycles = math.floor(np.ptp(phase) + 0.5) if phase.size else 0
    if cycles < 2 or not np.isfinite(values).all():
        return math.nan
    solution = np.linalg.solve(_normal_matrix(basis), np.einsum("ij,i->j", basis, values))
    residual = values - np.einsum("ij,j->i", basis, solution)
    starts = np.searchsorted(phase, phase[0] + np.arange(cycles))
    means = np.add.reduceat(residual[:, None] * basis, starts)
    means /= np.diff(np.append(starts, phase.size))[:, None]
    means[:, 1:] *= 2.0  # the mean square of a sine is a half
    return float(np.sqrt(means.var(axis=0, ddof=1).sum() / cycles))


GAIN_TERMS, PHASE_TERMS = 3, 2
MAX_GAIN_EXTRAPOLATION = 4.0  # a gain stays within this factor of the identified range
LSTSQ_RCOND = 1e-3  # points closer together than this do not determine a slope


def evaluate_transfer(response: FrequencyResponse, frequency_hz: float) -> complex:
    """Evaluate the complex FRF, table acceleration over command, at a frequency in Hz."""
    frequencies = np.array(response.frequencies_hz)
    top = float(frequencies.max())
    powers = 2 * np.arange(min(PHASE_TERMS, frequencies.size)) + 1
    coefficients = _solve_least_squares(
        (frequencies / top)[:, None] ** powers, np.array(response.phase_rad)
    )
    angle = float(coefficients @ (frequency_hz / top) ** powers)
    return evaluate_gain(response, frequency_hz) * complex(math.cos(angle), math.sin(angle))


def evaluate_gain(response: FrequencyResponse, frequency_hz: float) -> float:
    """Evaluate the gain of the table, acceleration over command, at a frequency in Hz.

    Below the identified band it is constant, because a servo is flat there. Above it 1 / gain^2
    continues linearly in f^2, because the curvature from a few points is mostly noise.
    """
    frequencies = np.array(response.frequencies_hz)
    inverse = np.array(response.gain) ** -2.0
    low, top = float(frequencies.min()), float(frequencies.max())
    z = (frequencies / top) ** 2
    curve = _fit_polynomial(z, inverse, min(GAIN_TERMS, frequencies.size))
    value = _evaluate_polynomial(curve, min(max(frequency_hz, low), top) / top)
    if frequency_hz > top:
        chord = _fit_polynomial(z, inverse, min(2, frequencies.size))
        value += _evaluate_polynomial(chord, frequency_hz / top) - _evaluate_polynomial(chord, 1.0)
    min_inverse = float(inverse.min()) / MAX_GAIN_EXTRAPOLATION**2
    max_inverse = float(inverse.max()) * MAX_GAIN_EXTRAPOLATION**2
    return float(min(max(value, min_inverse), max_inverse) ** -0.5)


def _fit_polynomial(z: Float1D, values: Float1D, terms: int) -> Float1D:
    """Fit a polynomial to values at z, (point,), by least squares; coefficients, (terms,)."""
    return _solve_least_squares(z[:, None] ** np.arange(terms), values)


def _evaluate_polynomial(coefficients: Float1D, ratio: float) -> float:
    return float(coefficients @ ratio ** (2 * np.arange(coefficients.size)))


def _solve_least_squares(basis: Float1D, values: Float1D) -> Float1D:
    return np.asarray(np.linalg.lstsq(basis, values, rcond=LSTSQ_RCOND)[0], dtype=np.float64)
