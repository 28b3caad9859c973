"""Mains hum: 50 or 60 Hz and harmonics, found in samples at rest by least squares."""

import math
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D

MAINS_HZ = (50.0, 60.0)
AROUND_HZ = 0.5  # a grid's frequency stays much nearer than this
ORDERS = 5
FINER = 16  # of the first look, the steps of the second


@dataclass(frozen=True, slots=True, eq=False)
class Hum:
    """`frequency_hz` of the mains, the same for all; rms of the hum in each channel, (channel,);
    what is left once hum, mean and trend are taken off, (channel, sample)."""

    frequency_hz: float
    rms: Float1D
    left: Float2D


def hum(values: Float2D, rate_hz: float) -> Hum:
    """The hum in values, (channel, sample), finite; rms in their unit, less what noise fakes."""
    count = values.shape[1]
    t = (np.arange(count) - 0.5 * (count - 1)) / rate_hz
    flat = values - _explained(np.stack([np.ones(count), t]), values)
    variance = np.mean(flat**2, axis=1)
    weight = np.divide(1.0, variance, out=np.zeros_like(variance), where=variance > 0)

    def share(f: float) -> float:
        """Of the channels' variances, what hum of this frequency explains."""
        rows = _tones(f, t, rate_hz)
        seen = rows @ flat.T
        return float(weight @ (seen * np.linalg.solve(rows @ rows.T, seen)).sum(axis=0)) / count

    step = rate_hz / (4.0 * count)
    around = np.arange(-AROUND_HZ, AROUND_HZ + 0.5 * step, step)
    best = max((mains + off for mains in MAINS_HZ for off in around), key=share)
    best = max(best + step * np.linspace(-1.0, 1.0, 2 * FINER + 1), key=share)
    rows = _tones(best, t, rate_hz)
    tones = _explained(rows, flat)
    left = flat - tones
    faked = len(rows) / count * np.mean(left**2, axis=1)
    rms = np.sqrt(np.maximum(np.mean(tones**2, axis=1) - faked, 0.0))
    return Hum(float(best), rms, left)


def _tones(f: float, t: Float1D, rate_hz: float) -> Float2D:
    """Cosines and sines of f and its harmonics below the half of the rate, (row, sample)."""
    orders = np.arange(1, ORDERS + 1)
    turns = 2 * math.pi * f * orders[orders * f < 0.45 * rate_hz][:, None] * t
    return np.concatenate([np.cos(turns), np.sin(turns)])


def _explained(rows: Float2D, values: Float2D) -> Float2D:
    """What of the values, (channel, sample), the rows, (row, sample), explain."""
    weights = np.linalg.solve(rows @ rows.T, rows @ values.T)
    explained: Float2D = (rows.T @ weights).T
    return explained
