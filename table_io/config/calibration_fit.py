"""Calibration fit: sensitivity and offset of a sensor from applied values and measured volts.

volts = volts_per_unit * (value + offset)
"""

import math
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError

CHUNKS_PER_POINT = 10  # of the second at each point; their scatter gives the standard error


@dataclass(frozen=True, slots=True)
class MeanVoltage:
    """Mean voltage of a channel at one calibration point and its standard error, both in V."""

    volts: float
    sd: float


@dataclass(frozen=True, slots=True)
class CalibrationFit:
    """Straight line through the calibration points; `*_sd` are standard uncertainties.

    `linearity_percent`: largest residual in per cent of the span; None with only two points.
    """

    volts_per_unit: float
    volts_per_unit_sd: float
    offset: float
    offset_sd: float
    linearity_percent: float | None


def mean_voltage(volts: Float1D) -> MeanVoltage:
    """Return the mean of samples at rest, (sample,), and its standard error in V; NaN is ignored.

    Noise may be correlated, so the error is taken from the means of `CHUNKS_PER_POINT` consecutive
    chunks. Tenths of a second are whole periods of 50 and of 60 Hz. NaN if fewer than two chunks
    have samples.
    """
    parts = np.array([part[np.isfinite(part)].mean() if np.isfinite(part).any() else np.nan
                      for part in np.array_split(volts, CHUNKS_PER_POINT)])  # fmt: skip
    known = parts[np.isfinite(parts)]
    if known.size < 2:
        return MeanVoltage(math.nan, math.nan)
    return MeanVoltage(float(known.mean()), float(known.std(ddof=1) / math.sqrt(known.size)))


def fit_calibration(
    applied: tuple[float, ...], applied_sd: float, means: tuple[MeanVoltage, ...]
) -> CalibrationFit:
    """Fit the line by weighted least squares; ValueError if all applied values are equal.

    Each point is weighted by its standard error and by `applied_sd` times the sensitivity. With
    three or more points, a larger scatter increases the uncertainties accordingly.
    """
    x, y = np.array(applied), np.array([mean.volts for mean in means])
    span, centre = float(np.ptp(x)), float(x.mean())
    x = x - centre  # so that slope and constant are nearly uncorrelated
    if span == 0:
        raise InputError("all applied values are equal", remedy="apply at least two different ones")
    rough_slope = float(np.polyfit(x, y, 1)[0])
    sd = np.sqrt(np.array([mean.sd for mean in means]) ** 2 + (rough_slope * applied_sd) ** 2)
    known = bool((sd > 0).all())
    weight = 1.0 / sd**2 if known else np.ones_like(x)
    rows = np.stack([x, np.ones_like(x)])
    covariance = np.linalg.inv((rows * weight) @ rows.T)
    slope, constant = (covariance @ (rows * weight) @ y).tolist()
    residuals = y - slope * x - constant
    dof = x.size - 2
    scatter = float((weight * residuals**2).sum() / dof) if dof else 0.0
    covariance = covariance * (max(scatter, 1.0) if known else scatter)
    # offset = constant / slope - centre
    gradient = np.array([-constant / slope**2, 1.0 / slope]) if slope else np.full(2, np.nan)
    return CalibrationFit(
        slope,
        math.sqrt(covariance[0, 0]),
        constant / slope - centre if slope else math.nan,
        math.sqrt(float(gradient @ covariance @ gradient)) if slope else math.nan,
        100.0 * float(np.abs(residuals).max()) / abs(slope * span) if dof and slope else None,
    )
