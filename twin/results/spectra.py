"""Response, shock and Fourier spectra, and intensity measures, of an acceleration record.

A record is taken as piecewise linear between its samples. The motion of a linear oscillator of one
degree of freedom on it,

    d2u/dt2 + 2 zeta w du/dt + w^2 u = -a(t),    w = 2 pi f,

is then advanced exactly from sample to sample (Nigam and Jennings, 1969; the ramp-invariant filter
of ISO 18431-4). The state is z = w^2 u and y = w du/dt over the time w t: both are accelerations,
and the coefficients, a matrix exponential, lose no digits at low frequencies.

Before its first sample the ground is at rest: the acceleration rises from 0 in one interval, as in
ISO 18431-4. After the last one it falls to 0 likewise, and each oscillator is followed for one
period more, in which a peak after the record is found (the residual part of a shock spectrum).
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D, Int1D
from table_io.compilation import jit_kernel
from table_io.units import GRAVITY_M_S2

DEFAULT_DAMPING = 0.05
USUAL_PER_OCTAVE, FINE_PER_OCTAVE = 6, 72  # natural frequencies
# Within a sample the record is known, so the peaks are sought at this many points of a period or
# more: at 36 a peak is low by 1 - cos(pi / 36) = 0.4 % at most.
POINTS_PER_CYCLE = 36
SERIES_TERMS = 20  # of the matrix exponential
MAX_SERIES_ANGLE = 0.5  # rad, to which the argument is halved before
Float3D = npt.NDArray[np.float64]


class OscillatorSteps(NamedTuple):
    """How oscillators advance by a substep: coefficients (frequency, 2, 4), counts (frequency,).

    The rows give (z, y) at the end, the columns multiply z, y and the ground acceleration at the
    begin and at the end. A sample interval has `substeps` of them; `rest` intervals of samples
    follow the record.
    """

    coefficients: Float3D
    substeps: Int1D
    rest: Int1D
    damping: float


def list_octave_frequencies(low_hz: float, high_hz: float, per_octave: int) -> Float1D:
    """Return the frequencies 2^(k / per_octave) Hz within low_hz .. high_hz, ascending, (k,).

    They lie on one grid, with 1 Hz on it, so that spectra of different bands can be compared.
    ValueError if a limit is not positive.
    """
    if not 0.0 < low_hz <= high_hz < math.inf:
        raise ValueError(f"{low_hz:g} to {high_hz:g} Hz is no range of frequencies")
    margin = 1e-9  # of a grid step: a limit on the grid belongs to the range
    first = math.ceil(per_octave * math.log2(low_hz) - margin)
    last = math.floor(per_octave * math.log2(high_hz) + margin)
    return np.asarray(2.0 ** (np.arange(first, last + 1) / per_octave), dtype=np.float64)


def compute_response_spectrum(
    acceleration: Float1D,
    rate_hz: float,
    frequencies_hz: Float1D,
    damping: float = DEFAULT_DAMPING,
    points_per_cycle: float = POINTS_PER_CYCLE,
) -> Float1D:
    """Return the elastic response spectrum of a ground acceleration in m/s2, (frequency,).

    Of the absolute acceleration: that of the mass in the laboratory frame, what an accelerometer on
    it reads. `points_per_cycle` at least are searched for the peaks; 0 searches the samples alone.
    ValueError if a sample is missing (NaN), or the damping is not that of an oscillation.
    """
    shock = compute_shock_spectrum(acceleration, rate_hz, frequencies_hz, damping, points_per_cycle)
    return np.maximum(*shock)


def compute_shock_spectrum(
    acceleration: Float1D,
    rate_hz: float,
    frequencies_hz: Float1D,
    damping: float = DEFAULT_DAMPING,
    points_per_cycle: float = POINTS_PER_CYCLE,
) -> tuple[Float1D, Float1D]:
    """Return the shock response spectrum (positive, negative) in m/s2, (frequency,) each.

    The largest absolute accelerations in either direction, during and after the record, as
    magnitudes (ISO 18431-4; Q = 1 / (2 zeta)). Above a tenth of the sampling rate the straight
    lines between the samples are no longer the shock. Arguments and ValueError as
    `compute_response_spectrum`.
    """
    frequencies = np.ascontiguousarray(frequencies_hz, dtype=np.float64)
    _require_known(acceleration)
    if not 0.0 <= damping < 1.0:
        raise ValueError(f"a damping ratio of {damping:g} is not in 0 .. 1")
    if frequencies.size and not (frequencies.min() > 0.0 and math.isfinite(frequencies.max())):
        raise ValueError("a natural frequency is not positive")
    record = np.ascontiguousarray(acceleration, dtype=np.float64)
    steps = _prepare_steps(frequencies, rate_hz, damping, points_per_cycle)
    largest, smallest = follow_oscillators(record, steps)
    return largest, -smallest


def compute_fourier_spectrum(acceleration: Float1D, rate_hz: float) -> tuple[Float1D, Float1D]:
    """Return (frequency in Hz, Fourier amplitude |integral a exp(-i w t) dt| in m/s), (bin,) each.

    ValueError if a sample is missing.
    """
    _require_known(acceleration)
    amplitudes = np.abs(np.fft.rfft(acceleration)) / rate_hz
    frequencies = np.arange(amplitudes.size, dtype=np.float64) * (rate_hz / acceleration.size)
    return frequencies, amplitudes


def compute_arias_intensity(acceleration: Float1D, rate_hz: float) -> Float1D:
    """Return the Arias intensity pi / (2 g) integral a^2 dt in m/s up to each sample, (sample,).

    The last one is that of the record; over it, the others are the Husid plot. ValueError if a
    sample is missing.
    """
    _require_known(acceleration)
    before, after = acceleration[:-1], acceleration[1:]
    squares = (before**2 + before * after + after**2) / (3.0 * rate_hz)
    return math.pi / (2.0 * GRAVITY_M_S2) * np.concatenate([[0.0], np.cumsum(squares)])


def compute_absolute_velocity(acceleration: Float1D, rate_hz: float) -> float:
    """Return the cumulative absolute velocity, integral |a| dt, in m/s (CAV; EPRI NP-5930).

    ValueError if a sample is missing.
    """
    _require_known(acceleration)
    before, after = np.abs(acceleration[:-1]), np.abs(acceleration[1:])
    crosses = acceleration[:-1] * acceleration[1:] < 0.0
    total = np.where(before + after > 0.0, before + after, 1.0)
    # Two triangles where the line passes through 0, else a trapezium.
    areas = np.where(crosses, (before**2 + after**2) / (2.0 * total), (before + after) / 2.0)
    return float(areas.sum() / rate_hz)


def _require_known(acceleration: Float1D) -> None:
    if acceleration.ndim != 1 or acceleration.size < 2:
        raise ValueError(f"an acceleration of shape {acceleration.shape} is no record")
    lost = int(np.count_nonzero(~np.isfinite(acceleration)))
    if lost:
        raise ValueError(f"{lost} samples are missing: a spectrum needs every sample")


def _prepare_steps(
    frequencies_hz: Float1D, rate_hz: float, damping: float, points_per_cycle: float
) -> OscillatorSteps:
    """Return the exact steps of the oscillators at a sampling rate."""
    substeps = np.maximum(np.ceil(points_per_cycle * frequencies_hz / rate_hz - 1e-9), 1.0)
    angle = 2 * math.pi * frequencies_hz / (rate_hz * substeps)
    matrices = _exponentiate(angle, damping)
    slope = matrices[:, :2, 3] / angle[:, None]
    coefficients = np.stack(
        [matrices[:, :2, 0], matrices[:, :2, 1], matrices[:, :2, 2] - slope, slope], axis=2
    )
    return OscillatorSteps(
        np.ascontiguousarray(coefficients),
        substeps.astype(np.int64),
        np.ceil(rate_hz / frequencies_hz).astype(np.int64),
        damping,
    )


def _exponentiate(angle: Float1D, damping: float) -> Float3D:
    """Return exp(M angle), (frequency, 4, 4), of the state z, y, ground acceleration and its slope.

    By its power series after halving the angle. Its entries have the accuracy of single numbers at
    any angle, where the closed form loses them in differences: 1e-16 / angle^3 of them.
    """
    matrix = np.zeros((4, 4))
    matrix[0, 1], matrix[1, 0], matrix[1, 1], matrix[1, 2] = 1.0, -1.0, -2.0 * damping, -1.0
    matrix[2, 3] = 1.0
    largest = float(angle.max(initial=0.0))
    halvings = max(0, math.ceil(math.log2(largest / MAX_SERIES_ANGLE))) if largest > 0 else 0
    scaled = (angle / 2**halvings)[:, None, None] * matrix
    term = np.broadcast_to(np.eye(4), scaled.shape).copy()
    total = term.copy()
    for order in range(1, SERIES_TERMS + 1):
        term = term @ scaled / order
        total += term
    for _ in range(halvings):
        total = total @ total
    return total


@jit_kernel()
def follow_oscillators(acceleration: Float1D, steps: OscillatorSteps) -> Float2D:
    """Follow oscillators through a record and one period after it; return (2, frequency) in m/s2.

    Largest and smallest absolute acceleration -(z + 2 zeta y). Equation of the module: dz = y,
    dy = -z - 2 zeta y - a over the time w t.
    """
    peaks = np.zeros((2, steps.substeps.size))
    for k in range(steps.substeps.size):
        zz, zy, z0, z1 = steps.coefficients[k, 0]
        yz, yy, y0, y1 = steps.coefficients[k, 1]
        zeta2, n = 2.0 * steps.damping, steps.substeps[k]
        z = y = largest = smallest = before = 0.0
        for i in range(acceleration.size + steps.rest[k]):
            after = acceleration[i] if i < acceleration.size else 0.0
            a, slope = before, (after - before) / n
            for j in range(n):
                b = after if j == n - 1 else before + (j + 1) * slope
                z, y, a = zz * z + zy * y + z0 * a + z1 * b, yz * z + yy * y + y0 * a + y1 * b, b
                response = -(z + zeta2 * y)
                largest, smallest = max(largest, response), min(smallest, response)
            before = after
        peaks[0, k], peaks[1, k] = largest, smallest
    return peaks
