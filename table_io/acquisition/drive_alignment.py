"""Alignment of the measured command with the planned drive: search, then tracking.

The measured command is m(i) = gain d(i + offset + 1e-6 ppm (i - pivot)) + bias, where d is the
drive, its index a sample of the plan, and ppm the clock deviation of the controller. The search
correlates over a grid of offsets and refines the best one by Gauss-Newton; a Kalman filter of the
four parameters then tracks them chunk by chunk. The gain may wander, because the controller sets
the amplitude. No measured sample is ever moved or resampled: only its drive index is computed.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from table_io.block import Float1D, Float2D, Int1D

SEARCH_S = 1.0  # on either side of the expected start of motion
GRID_HZ = 200.0  # of the search; the refinement uses every sample
MAX_ITERATIONS = 8
PRIOR_PPM_SD = 50.0  # standard deviation of an unknown clock
# Random walk per second, standard deviations: samples, ppm, gain, bias over the noise.
PROCESS_NOISE_SD = (3e-4, 3e-3, 5e-3, 3e-3)


class PlannedDrive(Protocol):
    """Interface of a drive that can be aligned."""

    def command(self, first: int, count: int) -> Float1D:
        """Return the displacement in m of samples first .. first + count - 1; 0 outside."""

    @property
    def rest_start(self) -> int:
        """Index from which the command is zero."""


@dataclass(frozen=True, eq=False)
class DriveAlignment:
    """Alignment: the four parameters, their covariance, the correlation and the residual noise."""

    offset: float  # samples
    ppm: float
    gain: float
    bias: float  # m
    pivot: int
    covariance: Float2D
    correlation: float
    noise: float  # rms residual of the measured command, m

    @property
    def parameters(self) -> Float1D:
        return np.array([self.offset, self.ppm, self.gain, self.bias])

    def drive_index(self, index: Int1D) -> Float1D:
        """Return the fractional drive index of measured samples, (sample,)."""
        return index + self.offset + 1e-6 * self.ppm * (index - self.pivot)

    def drive_index_sd(self, index: int) -> float:
        """Return the standard deviation of `drive_index` in samples."""
        row = np.array([1.0, 1e-6 * (index - self.pivot)])
        return float(np.sqrt(row @ self.covariance[:2, :2] @ row))


def interpolate_drive(plan: PlannedDrive, position: Float1D) -> tuple[Float1D, Float1D]:
    """Interpolate (drive in m, slope in m per sample) at fractional indices, (sample,)."""
    low = int(np.floor(position.min())) - 2
    nearest = np.rint(position).astype(np.int64)
    d = plan.command(low, int(nearest.max()) - low + 3)
    k, fraction = nearest - low, position - nearest
    slope, bend = 0.5 * (d[k + 1] - d[k - 1]), d[k + 1] - 2.0 * d[k] + d[k - 1]
    # cubic through four neighbors, on the side of the index
    side = np.where(fraction >= 0, 1, -1)
    third = side * (d[k + 2 * side] - 3.0 * d[k + side] + 3.0 * d[k] - d[k - side])
    slope = slope - third / 6.0
    value = d[k] + fraction * (slope + fraction * (0.5 * bend + fraction * third / 6.0))
    return value, slope + fraction * (bend + 0.5 * fraction * third)


def find_motion_onset(plan: PlannedDrive, threshold: float, rate_hz: float) -> int:
    """Return the first drive sample beyond the threshold in m; its end if there is none."""
    chunk, first = int(10 * rate_hz), 0
    while first < plan.rest_start:
        exceeding = np.flatnonzero(np.abs(plan.command(first, chunk)) > threshold)
        if exceeding.size:
            return first + int(exceeding[0])
        first += chunk
    return plan.rest_start


def fit_alignment(
    plan: PlannedDrive,
    first: int,
    command_m: Float1D,
    expected_offset: float,
    rate_hz: float,
    lsb: float,
) -> DriveAlignment | None:
    """Fit the alignment to samples from `first`, (sample,) in m; None if they do not determine it.

    `expected_offset` in samples must be correct to SEARCH_S. A drive with inverted sign correlates
    with -1, and its fit has a negative gain.
    """
    index = first + np.flatnonzero(~np.isnan(command_m))
    m = command_m[index - first]
    if m.size < 8:
        return None
    offset, correlation = _search_offset(plan, index, m, expected_offset, rate_hz)
    gain, bias = 1.0, 0.0
    columns, normal, residual = np.ones((3, m.size)), np.eye(3), m
    for _ in range(MAX_ITERATIONS):
        d, slope = interpolate_drive(plan, np.asarray(index + offset, dtype=np.float64))
        columns = np.stack([slope, d, np.ones(m.size)])
        gain, bias = np.linalg.lstsq(columns[1:].T, m, rcond=None)[0]
        residual = m - gain * d - bias
        columns[0] *= gain
        normal = columns @ columns.T
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e30:
            return None
        step = float(np.linalg.solve(normal, columns @ residual)[0])
        offset += float(np.clip(step, -0.05 * rate_hz, 0.05 * rate_hz))
        if abs(step) < 1e-4:
            break
    noise = float(np.sqrt(np.mean(residual**2) + lsb**2 / 12.0))
    known_covariance = noise**2 * np.linalg.inv(normal)
    covariance = np.zeros((4, 4))
    covariance[np.ix_([0, 2, 3], [0, 2, 3])] = known_covariance
    covariance[1, 1] = PRIOR_PPM_SD**2
    # where the offset is known best: a clock error rotates about this sample
    pivot = round(float(columns[0] ** 2 @ index / (columns[0] ** 2).sum()))
    return DriveAlignment(
        offset, 0.0, float(gain), float(bias), pivot, covariance, correlation, noise
    )


def _search_offset(
    plan: PlannedDrive, index: Int1D, m: Float1D, expected_offset: float, rate_hz: float
) -> tuple[float, float]:
    """Return (offset in samples, correlation) of the best match on the grid."""
    stride = max(round(rate_hz / GRID_HZ), 1)
    index, m = index[::stride], m[::stride]
    max_shift = round(SEARCH_S * rate_hz)
    offsets = round(expected_offset) + np.arange(-max_shift, max_shift + 1, stride)
    low = int(index[0] + offsets[0])
    d = plan.command(low, int(index[-1] + offsets[-1]) - low + 1)
    candidates = d[index[None, :] + offsets[:, None] - low]
    candidates = candidates - candidates.mean(axis=1, keepdims=True)
    m = m - m.mean()
    power = np.sqrt((candidates**2).sum(axis=1) * (m**2).sum())
    correlation = np.divide(candidates @ m, power, out=np.zeros(offsets.size), where=power > 0)
    best = int(np.abs(correlation).argmax())
    return float(offsets[best]), float(correlation[best])


def update_alignment(
    fit: DriveAlignment, plan: PlannedDrive, first: int, command_m: Float1D, rate_hz: float
) -> DriveAlignment:
    """Update the alignment with a chunk of samples from `first`, (sample,) in m (Kalman filter)."""
    index = first + np.flatnonzero(~np.isnan(command_m))
    wander = np.array(PROCESS_NOISE_SD) * np.array([1.0, 1.0, 1.0, fit.noise])
    prior = fit.covariance + np.diag(wander**2) * command_m.size / rate_hz
    if index.size < command_m.size // 2:
        return replace(fit, covariance=prior)
    d, slope = interpolate_drive(plan, fit.drive_index(index))
    residual = command_m[index - first] - fit.gain * d - fit.bias
    columns = np.stack(
        [fit.gain * slope, 1e-6 * fit.gain * slope * (index - fit.pivot), d, np.ones(d.size)]
    )
    information = columns @ columns.T / fit.noise**2
    posterior: Float2D = np.linalg.inv(np.linalg.inv(prior) + information).astype(np.float64)
    change = posterior @ (columns @ residual) / fit.noise**2
    offset, ppm, gain, bias = (fit.parameters + change).tolist()
    return replace(fit, offset=offset, ppm=ppm, gain=gain, bias=bias, covariance=posterior)


def measure_deviation(
    fit: DriveAlignment, plan: PlannedDrive, first: int, command_m: Float1D, rate_hz: float
) -> tuple[float, float]:
    """Return (rms deviation of a chunk from the drive, peak of the drive around it), both in m.

    NaN if the chunk is lost.
    """
    index = first + np.flatnonzero(~np.isnan(command_m))
    if index.size < command_m.size // 2:
        return np.nan, np.nan
    d, _ = interpolate_drive(plan, fit.drive_index(index))
    deviation = command_m[index - first] - fit.gain * d - fit.bias
    margin = round(rate_hz)
    drive_m = plan.command(int(fit.drive_index(index[:1])[0]) - margin, command_m.size + 2 * margin)
    return float(np.sqrt(np.mean(deviation**2))), float(np.abs(fit.gain * drive_m).max())
