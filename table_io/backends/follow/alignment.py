"""Where in the planned drive a measured sample lies: found once, then followed.

The measured command is m(i) = gain d(i + offset + 1e-6 ppm (i - pivot)) + bias: d is the drive,
its index a sample of the plan; a clock that runs beside ours makes ppm. Found by correlation over
a grid of offsets and by Gauss-Newton from the best of them; followed by a Kalman filter of these
four, a chunk of samples at a time. The gain may wander: the amplitude is what a controller makes
it. No measured sample is ever moved: only where it lies in the plan is told.
"""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from table_io.block import Float1D, Float2D, Int1D

SEARCH_S = 1.0  # either side of where the motion would begin
GRID_HZ = 200.0  # of the search; what follows is on every sample
ITERATIONS = 8
PPM_BEFORE = 50.0  # standard deviation of a clock that nobody knows
# What wanders in a second, as standard deviations: samples, ppm, gain, bias over the noise.
WANDER = (3e-4, 3e-3, 5e-3, 3e-3)


class Plan(Protocol):
    """A drive as a follower needs it."""

    def command(self, first: int, count: int) -> Float1D:
        """Displacement in m of samples first .. first + count - 1; zero before and after."""

    @property
    def rest_from(self) -> int:
        """Index from which it is zero."""


@dataclass(frozen=True, eq=False)
class Fit:
    """The four of them, how well they are known, and how well the drive was recognised."""

    offset: float  # samples
    ppm: float
    gain: float
    bias: float  # m
    pivot: int
    covariance: Float2D
    correlation: float
    noise: float  # rms of the measured command about the drive, m

    @property
    def theta(self) -> Float1D:
        return np.array([self.offset, self.ppm, self.gain, self.bias])

    def at(self, index: Int1D) -> Float1D:
        """Drive index of measured samples, not whole, (sample,)."""
        return index + self.offset + 1e-6 * self.ppm * (index - self.pivot)

    def sd(self, index: int) -> float:
        """Standard deviation of `at`, in samples."""
        row = np.array([1.0, 1e-6 * (index - self.pivot)])
        return float(np.sqrt(row @ self.covariance[:2, :2] @ row))


def evaluated(plan: Plan, at: Float1D) -> tuple[Float1D, Float1D]:
    """(drive in m, its slope in m a sample) at indices that need not be whole, (sample,)."""
    low = int(np.floor(at.min())) - 2
    whole = np.rint(at).astype(np.int64)
    d = plan.command(low, int(whole.max()) - low + 3)
    k, part = whole - low, at - whole
    slope, bend = 0.5 * (d[k + 1] - d[k - 1]), d[k + 1] - 2.0 * d[k] + d[k - 1]
    # the cubic through four neighbours, on the side where the index lies
    side = np.where(part >= 0, 1, -1)
    third = side * (d[k + 2 * side] - 3.0 * d[k + side] + 3.0 * d[k] - d[k - side])
    slope = slope - third / 6.0
    value = d[k] + part * (slope + part * (0.5 * bend + part * third / 6.0))
    return value, slope + part * (bend + 0.5 * part * third)


def begins(plan: Plan, threshold: float, rate_hz: float) -> int:
    """The first sample of the drive that is beyond the threshold; its end where there is none."""
    piece, first = int(10 * rate_hz), 0
    while first < plan.rest_from:
        beyond = np.flatnonzero(np.abs(plan.command(first, piece)) > threshold)
        if beyond.size:
            return first + int(beyond[0])
        first += piece
    return plan.rest_from


def found(
    plan: Plan, first: int, heard: Float1D, guess: float, rate_hz: float, lsb: float
) -> Fit | None:
    """The fit to samples `first` and on, (sample,); None where they are not this drive.

    `guess` is where the offset should be, to SEARCH_S. A drive of the other sign correlates with
    -1, and its fit has a negative gain.
    """
    index = first + np.flatnonzero(~np.isnan(heard))
    m = heard[index - first]
    if m.size < 8:
        return None
    offset, correlation = _searched(plan, index, m, guess, rate_hz)
    gain, bias = 1.0, 0.0
    columns, normal, residual = np.ones((3, m.size)), np.eye(3), m
    for _ in range(ITERATIONS):
        d, slope = evaluated(plan, np.asarray(index + offset, dtype=np.float64))
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
    known = noise**2 * np.linalg.inv(normal)
    covariance = np.zeros((4, 4))
    covariance[np.ix_([0, 2, 3], [0, 2, 3])] = known
    covariance[1, 1] = PPM_BEFORE**2
    # where the offset is known best: a clock's error turns about it
    pivot = round(float(columns[0] ** 2 @ index / (columns[0] ** 2).sum()))
    return Fit(offset, 0.0, float(gain), float(bias), pivot, covariance, correlation, noise)


def _searched(
    plan: Plan, index: Int1D, m: Float1D, guess: float, rate_hz: float
) -> tuple[float, float]:
    """(offset, correlation) of the best place on a grid."""
    every = max(round(rate_hz / GRID_HZ), 1)
    index, m = index[::every], m[::every]
    reach = round(SEARCH_S * rate_hz)
    offsets = round(guess) + np.arange(-reach, reach + 1, every)
    low = int(index[0] + offsets[0])
    d = plan.command(low, int(index[-1] + offsets[-1]) - low + 1)
    table = d[index[None, :] + offsets[:, None] - low]
    table = table - table.mean(axis=1, keepdims=True)
    m = m - m.mean()
    power = np.sqrt((table**2).sum(axis=1) * (m**2).sum())
    correlation = np.divide(table @ m, power, out=np.zeros(offsets.size), where=power > 0)
    best = int(np.abs(correlation).argmax())
    return float(offsets[best]), float(correlation[best])


def followed(fit: Fit, plan: Plan, first: int, heard: Float1D, rate_hz: float) -> Fit:
    """The fit after one more chunk of samples from `first` on, (sample,)."""
    index = first + np.flatnonzero(~np.isnan(heard))
    wander = np.array(WANDER) * np.array([1.0, 1.0, 1.0, fit.noise])
    before = fit.covariance + np.diag(wander**2) * heard.size / rate_hz
    if index.size < heard.size // 2:
        return replace(fit, covariance=before)
    d, slope = evaluated(plan, fit.at(index))
    residual = heard[index - first] - fit.gain * d - fit.bias
    columns = np.stack(
        [fit.gain * slope, 1e-6 * fit.gain * slope * (index - fit.pivot), d, np.ones(d.size)]
    )
    gathered = columns @ columns.T / fit.noise**2
    after: Float2D = np.linalg.inv(np.linalg.inv(before) + gathered).astype(np.float64)
    change = after @ (columns @ residual) / fit.noise**2
    offset, ppm, gain, bias = (fit.theta + change).tolist()
    return replace(fit, offset=offset, ppm=ppm, gain=gain, bias=bias, covariance=after)


def astray(fit: Fit, plan: Plan, first: int, heard: Float1D, rate_hz: float) -> tuple[float, float]:
    """(rms of what is not the drive in a chunk, the drive's largest of about that time), m.

    NaN where the chunk is lost.
    """
    index = first + np.flatnonzero(~np.isnan(heard))
    if index.size < heard.size // 2:
        return np.nan, np.nan
    d, _ = evaluated(plan, fit.at(index))
    off = heard[index - first] - fit.gain * d - fit.bias
    around = round(rate_hz)
    near = plan.command(int(fit.at(index[:1])[0]) - around, heard.size + 2 * around)
    return float(np.sqrt(np.mean(off**2))), float(np.abs(fit.gain * near).max())
