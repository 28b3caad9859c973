"""Sensitivity and offset of a sensor from what was applied to it and what it gave; pure.

volts = volts_per_unit * (value + offset)
"""

import math
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D

PARTS = 10  # of the second at each point: means of these tell the standard error, hum included


@dataclass(frozen=True, slots=True)
class Mean:
    """Mean of a channel in V over a point, and its standard error in V."""

    volts: float
    sd: float


@dataclass(frozen=True, slots=True)
class Fit:
    """The straight line through the points; `sd` are standard uncertainties.

    `linearity_percent`: largest distance from the line in per cent of the span; None of two points.
    """

    volts_per_unit: float
    volts_per_unit_sd: float
    offset: float
    offset_sd: float
    linearity_percent: float | None


def mean_of(volts: Float1D) -> Mean:
    """The mean of samples at rest, (sample,); lost ones do not count; NaN where none is left.

    Noise may be correlated, so the error is that of PARTS means one after another. Tenths of a
    second are whole periods of 50 and of 60 Hz.
    """
    parts = np.array([part[np.isfinite(part)].mean() if np.isfinite(part).any() else np.nan
                      for part in np.array_split(volts, PARTS)])  # fmt: skip
    known = parts[np.isfinite(parts)]
    if known.size < 2:
        return Mean(math.nan, math.nan)
    return Mean(float(known.mean()), float(known.std(ddof=1) / math.sqrt(known.size)))


def fitted(applied: tuple[float, ...], applied_sd: float, means: tuple[Mean, ...]) -> Fit:
    """The line by weighted least squares; ValueError where all that was applied is alike.

    Each point weighs by its standard error and by `applied_sd`, seen through the sensitivity. From
    three points on, a scatter larger than these makes the uncertainties as much larger.
    """
    x, y = np.array(applied), np.array([one.volts for one in means])
    span, middle = float(np.ptp(x)), float(x.mean())
    x = x - middle  # so that slope and constant hardly hang together
    if span == 0:
        raise ValueError("all that was applied is alike")
    rough = float(np.polyfit(x, y, 1)[0])
    sd = np.sqrt(np.array([one.sd for one in means]) ** 2 + (rough * applied_sd) ** 2)
    known = bool((sd > 0).all())
    weight = 1.0 / sd**2 if known else np.ones_like(x)
    rows = np.stack([x, np.ones_like(x)])
    covariance = np.linalg.inv((rows * weight) @ rows.T)
    slope, constant = (covariance @ (rows * weight) @ y).tolist()
    left = y - slope * x - constant
    free = x.size - 2
    scatter = float((weight * left**2).sum() / free) if free else 0.0
    covariance = covariance * (max(scatter, 1.0) if known else scatter)
    # offset = constant / slope - middle
    turn = np.array([-constant / slope**2, 1.0 / slope]) if slope else np.full(2, np.nan)
    return Fit(
        slope,
        math.sqrt(covariance[0, 0]),
        constant / slope - middle if slope else math.nan,
        math.sqrt(float(turn @ covariance @ turn)) if slope else math.nan,
        100.0 * float(np.abs(left).max()) / abs(slope * span) if free and slope else None,
    )
