"""Floquet multiplier of an orbit, measured while its feedback is released.

Without the feedback a small departure e = x - x_ref from the orbit grows by the multiplier mu every
period. With t in periods at the phase of the drive, in release r

    e_r(t) = d(t) + a_r mu^(t - t_r) p(t),    d and p of period 1

where d is what the reference is off the orbit, p the shape of the growing departure and t_r the
start of the release. d and p are harmonics up to SHAPE_HARMONICS, so the samples of a few releases
give mu by least squares. The feedback takes no part in it: neither its latency nor its gains
matter, and no model is used. The smaller multipliers are assumed to have decayed, and mu to be real
and positive, as it is near folds.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D

BINS_PER_PERIOD = 16  # over which samples are averaged
SHAPE_HARMONICS = 3
MIN_PERIODS = 1.2  # of a release: mu shows only where a period is followed by the next
MIN_RELEASES = 2
TRIAL_MULTIPLIERS = (0.5, 1.0, 2.0, 5.0)
TRIAL_ROUNDS = 2
MAX_ITERATIONS = 20
EXPONENT_TOLERANCE = 1e-6  # largest change of ln mu
MAX_HALVINGS = 8
MAX_EXPONENT = 5.0  # |ln mu|
RANK_TOLERANCE = 1e-7  # of the largest singular value


@dataclass(frozen=True, slots=True, eq=False)
class Departure:
    """Departure from an orbit in m without feedback, (sample,), at the drive's phase in cycles."""

    phase: Float1D
    values_m: Float1D


@dataclass(frozen=True, slots=True)
class MultiplierEstimate:
    """Floquet multiplier with its standard deviation; both NaN if it cannot be estimated."""

    value: float
    sd: float


NO_MULTIPLIER = MultiplierEstimate(math.nan, math.nan)


@dataclass(frozen=True, slots=True, eq=False)
class _Release:
    """Bin means of a release, (bin,): periods since its start, basis functions, e in m."""

    periods: Float1D
    basis: Float2D
    values_m: Float1D


def estimate_multiplier(departures: Sequence[Departure]) -> MultiplierEstimate:
    """Return the Floquet multiplier by least squares over the releases of one orbit.

    Releases that are too short or have lost samples are left out. The standard deviation is the
    larger of that from the residuals and that from leaving out one release at a time.
    """
    releases = [
        _average(departure)
        for departure in departures
        if departure.phase.size
        and np.ptp(departure.phase) >= MIN_PERIODS
        and np.isfinite(departure.values_m).all()
    ]
    if len(releases) < MIN_RELEASES:
        return NO_MULTIPLIER
    trials = [_start(releases, math.log(multiplier)) for multiplier in TRIAL_MULTIPLIERS]
    fit = _fit(releases, min(trials, key=lambda trial: trial[0])[1])
    if fit is None:
        return NO_MULTIPLIER
    exponent, sd = float(fit.unknowns[0]), fit.exponent_sd
    count = len(releases)
    if count > MIN_RELEASES:
        first = fit.unknowns.size - count
        parts = [
            _fit(releases[:k] + releases[k + 1 :], np.delete(fit.unknowns, first + k))
            for k in range(count)
        ]
        exponents = np.array([part.unknowns[0] for part in parts if part is not None])
        if exponents.size < count:
            return NO_MULTIPLIER
        share = (count - 1) / count
        sd = max(sd, math.sqrt(share * float(np.sum((exponents - exponents.mean()) ** 2))))
    return MultiplierEstimate(math.exp(exponent), math.exp(exponent) * sd)


def _average(departure: Departure) -> _Release:
    """Return the means of a departure over bins of the phase; incomplete bins are left out."""
    position = departure.phase * BINS_PER_PERIOD
    bins = np.floor(position).astype(np.int64)
    complete = (bins > bins[0]) & (bins < bins[-1])
    index = bins[complete] - bins[0] - 1
    counts = np.maximum(np.bincount(index), 1)
    values = np.bincount(index, departure.values_m[complete]) / counts
    phase = np.bincount(index, departure.phase[complete]) / counts
    angles = 2.0 * math.pi * np.outer(phase, np.arange(1, SHAPE_HARMONICS + 1))
    basis = np.column_stack([np.ones_like(phase), np.cos(angles), np.sin(angles)])
    return _Release(phase - phase[0], basis, values)


@dataclass(frozen=True, slots=True, eq=False)
class _Fit:
    """Unknowns (ln mu, d, p, a_r) of a least-squares fit, and the standard deviation of ln mu."""

    unknowns: Float1D
    exponent_sd: float


def _fit(releases: Sequence[_Release], start: Float1D) -> _Fit | None:
    """Return the fit from starting values by Gauss-Newton; None if it does not converge.

    Only the product a_r p is defined, so steps are those of least norm. A step that makes the
    residuals larger is halved.
    """
    unknowns = start
    residuals, slopes = _linearize(releases, unknowns)
    for _ in range(MAX_ITERATIONS):
        scale = np.linalg.norm(slopes, axis=0)
        step = np.linalg.lstsq(slopes / scale, -residuals, rcond=RANK_TOLERANCE)[0] / scale
        square = residuals @ residuals
        for _ in range(MAX_HALVINGS):
            trial = unknowns + step
            if abs(trial[0]) < MAX_EXPONENT:
                residuals, slopes = _linearize(releases, trial)
                if residuals @ residuals <= square * (1.0 + EXPONENT_TOLERANCE):
                    break
            step = step / 2.0
        else:
            return None
        unknowns = trial
        if abs(step[0]) < EXPONENT_TOLERANCE:
            break
    else:
        return None
    freedom = residuals.size - slopes.shape[1] + 1
    if freedom <= 0:
        return None
    scale = np.linalg.norm(slopes, axis=0)
    normal = (slopes / scale).T @ (slopes / scale)
    covariance = np.linalg.pinv(normal, rcond=RANK_TOLERANCE**2)[0, 0] / scale[0] ** 2
    return _Fit(unknowns, math.sqrt(float(residuals @ residuals) / freedom * covariance))


def _start(releases: Sequence[_Release], exponent: float) -> tuple[float, Float1D]:
    """Return (sum of squared residuals in m2, unknowns) at a fixed ln mu, by alternating fits."""
    size = releases[0].basis.shape[1]
    growth = [np.exp(exponent * release.periods) for release in releases]
    ends = []  # harmonics of the grown departure by the last period of each release
    for release in releases:
        late = release.periods >= release.periods[-1] - 1.0
        grown = np.exp(exponent * (release.periods[late] - release.periods[-1]))
        solution = np.linalg.lstsq(
            grown[:, None] * release.basis[late], release.values_m[late], rcond=RANK_TOLERANCE
        )
        ends.append(solution[0])
    left, sizes, _ = np.linalg.svd(np.array(ends), full_matrices=False)
    last = np.array([release.periods[-1] for release in releases])
    amplitudes = left[:, 0] * sizes[0] * np.exp(-exponent * last)
    values = np.concatenate([release.values_m for release in releases])
    shapes = np.zeros(2 * size)
    for _ in range(TRIAL_ROUNDS):
        columns = np.vstack([
            np.hstack([release.basis, amplitude * factor[:, None] * release.basis])
            for release, factor, amplitude in zip(releases, growth, amplitudes, strict=True)
        ])  # fmt: skip
        shapes = np.linalg.lstsq(columns, values, rcond=RANK_TOLERANCE)[0]
        for k, (release, factor) in enumerate(zip(releases, growth, strict=True)):
            grown = factor * (release.basis @ shapes[size:])
            rest = release.values_m - release.basis @ shapes[:size]
            amplitudes[k] = float(grown @ rest) / max(float(grown @ grown), 1e-300)
    unknowns = np.concatenate([[exponent], shapes, amplitudes])
    residuals, _ = _linearize(releases, unknowns)
    return float(residuals @ residuals), unknowns


def _linearize(releases: Sequence[_Release], unknowns: Float1D) -> tuple[Float1D, Float2D]:
    """Return (model minus measured in m, (bin,), its derivatives by the unknowns)."""
    size = releases[0].basis.shape[1]
    exponent, offset, shape = unknowns[0], unknowns[1 : 1 + size], unknowns[1 + size : 1 + 2 * size]
    residuals, slopes = [], []
    for k, release in enumerate(releases):
        factor = np.exp(exponent * release.periods)
        grown = factor * (release.basis @ shape)
        amplitude = unknowns[1 + 2 * size + k]
        residuals.append(release.basis @ offset + amplitude * grown - release.values_m)
        rows = np.zeros((release.values_m.size, unknowns.size))
        rows[:, 0] = amplitude * grown * release.periods
        rows[:, 1 : 1 + size] = release.basis
        rows[:, 1 + size : 1 + 2 * size] = amplitude * factor[:, None] * release.basis
        rows[:, 1 + 2 * size + k] = grown
        slopes.append(rows)
    return np.concatenate(residuals), np.vstack(slopes)
