"""Order tracking: least-squares fit of harmonics at the phase of the drive; swing and errors.

x(t) = offset + sum over k of Im(c_k exp(2 pi i k phase)), so a real c_1 is in phase with the
acceleration sine of the drive. The phase is the closed form of the drive at each sample, so only
amplitudes are estimated, and a cycle need not be a whole number of samples.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D

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
    solution, residual = _solve_harmonics(basis, normal, values)
    amplitudes = np.zeros(harmonics, dtype=np.complex128)
    # a sin + b cos = Im((a + i b) exp(i theta))
    amplitudes[: columns // 2] = solution[1::2] + 1j * solution[2::2]
    rms = float(np.sqrt(np.mean(residual**2)))
    return HarmonicFit(float(solution[0]), amplitudes, rms)


def _solve_harmonics(basis: Float2D, normal: Float2D, values: Float1D) -> tuple[Float1D, Float1D]:
    """Return (coefficients of the basis columns, residual (sample,)) by least squares."""
    solution = np.linalg.solve(normal, np.einsum("ij,i->j", basis, values))
    return solution, values - np.einsum("ij,j->i", basis, solution)


def estimate_harmonic_error(values: Float1D, phase: Float1D, harmonics: int) -> float:
    """Return the standard error of the harmonics of `track_harmonics`, their root sum of squares.

    From the changes of sines and cosines between successive cycles of `values`, (sample,), at the
    `phase` in cycles: noise of any spectrum counts as it passed a control loop, and a trend hardly.
    The offset does not count. NaN if samples are lost or of less than two cycles.
    """
    if not np.isfinite(values).all():
        return math.nan
    basis = _harmonic_basis(phase, harmonics)
    _, residual = _solve_harmonics(basis, _normal_matrix(basis), values)
    return math.sqrt(_harmonic_variances(residual, basis, phase).sum())


def _harmonic_variances(residual: Float1D, basis: Float2D, phase: Float1D) -> Float1D:
    """Return the variances of sines and cosines by the changes between cycles, (2 orders,).

    NaN with less than two cycles.
    """
    cycles = math.floor(np.ptp(phase) + 0.5) if phase.size else 0
    if cycles < 2:
        return np.full(basis.shape[1] - 1, np.nan)
    starts = np.searchsorted(phase, phase[0] + np.arange(cycles))
    # The mean square of a sine is a half.
    means = np.add.reduceat(2.0 * residual[:, None] * basis[:, 1:], starts)
    means /= np.diff(np.append(starts, phase.size))[:, None]
    variances: Float1D = 0.5 * (np.diff(means, axis=0) ** 2).mean(axis=0) / cycles
    return variances


SWING_HARMONICS = 30  # of u: an impact on a bumper takes a tenth of a cycle or more
MIN_HARMONIC_SIGMA = 3.0  # standard errors below which a harmonic is noise
SWING_PHASES = 720  # of a cycle, at which the extremes are looked for: 1e-5 of the swing
# Rms beyond the noise of what the harmonics may leave, of the swing. At 0.004 the swing next to
# bumpers is right within 1 um; single extremes of raw samples are worse than harmonics up to 0.02.
MAX_LEFT, MAX_LEFT_OF_RAW = 0.004, 0.02
NOISE_ERROR = 5.0  # over the root of the samples: three standard errors of the noise's mean square


def mean_swing(u: Float1D, phase: Float1D) -> float:
    """Return half of max u - min u in m, over whole cycles of `phase`; NaN if any is lost.

    Of the harmonics of the motion: extremes of single cycles are larger by the noise of the
    sensor. Where the cycles differ, the mean of their extremes.
    """
    ends = find_steady_extremes(u, phase, MAX_LEFT_OF_RAW)
    return _mean_range(u, phase) if ends is None else 0.5 * (ends[0] - ends[1])


def find_steady_extremes(
    u: Float1D, phase: Float1D, max_left: float = MAX_LEFT
) -> tuple[float, float] | None:
    """Return (max u, min u) in m of the harmonics of u, (sample,), over whole cycles of `phase`.

    None if samples are lost, where cycles that differ or higher harmonics leave more than the
    noise and `max_left` of the swing, or more about an extreme than elsewhere: a short impact.
    """
    basis = _harmonic_basis(phase, SWING_HARMONICS)
    fit = _fit_harmonics(basis, _normal_matrix(basis), u, SWING_HARMONICS)
    if not math.isfinite(fit.residual_rms):
        return None
    waves = np.exp(2j * np.pi * phase)
    residual = u - fit.offset - np.polyval([*fit.amplitudes[::-1], 0.0], waves).imag
    # By the upper half of the harmonics: in the lower ones the cycles themselves may differ.
    variances = _harmonic_variances(residual, basis, phase)
    error = math.sqrt(variances[variances.size // 2 :].mean())
    kept = np.where(np.abs(fit.amplitudes) > MIN_HARMONIC_SIGMA * error, fit.amplitudes, 0.0)
    turns = np.exp(2j * np.pi * np.arange(SWING_PHASES) / SWING_PHASES)
    motion = np.polyval([*kept[::-1], 0.0], turns).imag
    high, low = fit.offset + float(motion.max()), fit.offset + float(motion.min())
    model = fit.offset + np.polyval([*kept[::-1], 0.0], waves).imag
    # Noise is what differs within the shortest wave of a harmonic: that of a sensor with a filter
    # too, which is the same in successive samples. Cycles that differ do so more slowly.
    lag = max(round(u.size / (2 * SWING_HARMONICS * float(np.ptp(phase)))), 1)
    scatter = _third_difference(u - model, lag)
    # White noise of unit rms has a third difference of rms sqrt(20).
    square = float(np.mean(scatter**2)) / 20.0 * (1.0 + NOISE_ERROR * math.sqrt(lag / u.size))
    allowed = math.hypot(math.sqrt(square), 0.5 * max_left * (high - low))
    if fit.residual_rms > allowed:
        return None
    extremes = np.array([[motion.argmax()], [motion.argmin()]]) / SWING_PHASES
    near = np.abs((phase - extremes + 0.5) % 1.0 - 0.5) <= 0.5 / SWING_HARMONICS
    squares = (u - model) ** 2
    elsewhere = float(squares[~near.any(axis=0)].mean())
    sizes = near.sum(axis=1)
    most = elsewhere * sizes * (1.0 + NOISE_ERROR * np.sqrt(lag / np.maximum(sizes, 1)))
    return (high, low) if (near @ squares <= most).all() else None


def _third_difference(values: Float1D, lag: int) -> Float1D:
    """Return the third difference of samples that are `lag` samples apart, (sample - 3 lag,)."""
    difference: Float1D = values
    for _ in range(3):
        difference = difference[lag:] - difference[:-lag]
    return difference


def _mean_range(u: Float1D, phase: Float1D) -> float:
    """Return half of max u - min u in m of each cycle, averaged; NaN if any is lost."""
    if not u.size:
        return math.nan
    cycles = np.floor(phase - phase[0] + 1e-9)
    starts = np.flatnonzero(np.diff(cycles, prepend=-1.0))
    ranges = np.maximum.reduceat(u, starts) - np.minimum.reduceat(u, starts)
    # A cycle need not be a whole number of samples: the window may end with a sample of the next.
    complete = np.diff(np.append(starts, u.size)) > 0.5 * u.size / starts.size
    return float(0.5 * ranges[complete].mean())
