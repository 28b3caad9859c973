"""Mains hum: least-squares fit of 50 or 60 Hz and harmonics to samples at rest."""

import math
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D

MAINS_HZ = (50.0, 60.0)
MAX_MAINS_DEVIATION_HZ = 0.5  # more than any public grid deviates
HARMONIC_COUNT = 5
REFINEMENT_STEPS = 16  # steps of the fine search per step of the coarse one


@dataclass(frozen=True, slots=True, eq=False)
class MainsHum:
    """Fitted mains hum: common frequency, rms of the hum in each channel, (channel,).

    `residual`: values without hum, mean and trend, (channel, sample).
    """

    frequency_hz: float
    rms: Float1D
    residual: Float2D


def fit_mains_hum(values: Float2D, rate_hz: float) -> MainsHum:
    """Fit the hum in finite values, (channel, sample); rms in their unit, corrected for noise."""
    count = values.shape[1]
    t = (np.arange(count) - 0.5 * (count - 1)) / rate_hz
    detrended = values - _project(np.stack([np.ones(count), t]), values)
    variance = np.mean(detrended**2, axis=1)
    weights = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)

    def explained_share(f: float) -> float:
        """Return the share of the channels' variance that hum of this frequency explains."""
        rows = _tone_rows(f, t, rate_hz)
        projection = rows @ detrended.T
        return (
            float(weights @ (projection * np.linalg.solve(rows @ rows.T, projection)).sum(axis=0))
            / count
        )

    step = rate_hz / (4.0 * count)
    offsets = np.arange(-MAX_MAINS_DEVIATION_HZ, MAX_MAINS_DEVIATION_HZ + 0.5 * step, step)
    frequency_hz = max((mains + off for mains in MAINS_HZ for off in offsets), key=explained_share)
    frequency_hz = max(
        frequency_hz + step * np.linspace(-1.0, 1.0, 2 * REFINEMENT_STEPS + 1), key=explained_share
    )
    rows = _tone_rows(frequency_hz, t, rate_hz)
    tones = _project(rows, detrended)
    residual = detrended - tones
    noise_power = len(rows) / count * np.mean(residual**2, axis=1)
    rms = np.sqrt(np.maximum(np.mean(tones**2, axis=1) - noise_power, 0.0))
    return MainsHum(float(frequency_hz), rms, residual)


def _tone_rows(f: float, t: Float1D, rate_hz: float) -> Float2D:
    """Return cosines and sines of f and its harmonics below 0.45 of the rate, (row, sample)."""
    orders = np.arange(1, HARMONIC_COUNT + 1)
    phase = 2 * math.pi * f * orders[orders * f < 0.45 * rate_hz][:, None] * t
    return np.concatenate([np.cos(phase), np.sin(phase)])


def _project(rows: Float2D, values: Float2D) -> Float2D:
    """Project values, (channel, sample), onto the span of rows, (row, sample)."""
    weights = np.linalg.solve(rows @ rows.T, rows @ values.T)
    projection: Float2D = (rows.T @ weights).T
    return projection
