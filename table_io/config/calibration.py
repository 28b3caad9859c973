"""Calibration: volts and SI units, tare, reminders, and the fit of a sensitivity.

volts = (value + offset) * volts_per_si. The offset is the tare: the SI value that the sensor showed
at rest, before precompression. Overdue calibrations never stop a test.
"""

import math
from dataclasses import dataclass
from datetime import date, datetime

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.clock import local_datetime
from table_io.config.rig import OutputConfig, RigConfig
from table_io.config.sensor import SensorConfig
from table_io.config.tare import MAX_TARE_AGE_H, MAX_TARE_LEAD_H, PRELOADED_CHANNELS, TareRecord
from table_io.errors import InputError


def volts_to_si(
    volts: Float2D, sensors: tuple[SensorConfig, ...], tare: dict[str, float]
) -> Float2D:
    """Convert volts, (channel, sample), to SI values of the same shape."""
    slope = np.array([1.0 / sensor.volts_per_si for sensor in sensors])
    offset = np.array([tare.get(sensor.channel, 0.0) for sensor in sensors])
    return volts * slope[:, None] - offset[:, None]


def command_to_volts(displacement_m: Float1D, output: OutputConfig) -> Float1D:
    """Convert a displacement in m, (sample,), to volts of the command channel."""
    return displacement_m * output.volts_per_m


def compute_tare(volts: Float2D, sensors: tuple[SensorConfig, ...]) -> dict[str, float]:
    """Compute the tare, the mean SI value of each channel at rest, except the command.

    Lost samples (NaN) are ignored; a sensor without any valid sample gets NaN and so stays lost.
    """
    return {
        sensor.channel: float(samples[~np.isnan(samples)].mean())
        if not np.isnan(samples).all()
        else float("nan")
        for sensor, samples in zip(sensors, volts_to_si(volts, sensors, {}), strict=True)
        if sensor.channel != "drive_disp_m"
    }


def measure_noise(
    volts: Float2D, sensors: tuple[SensorConfig, ...]
) -> dict[str, tuple[float, int]]:
    """Return (noise rms in SI, longest run of equal samples) per channel at rest, NaN ignored."""
    noise = {}
    for sensor, samples in zip(sensors, volts_to_si(volts, sensors, {}), strict=True):
        known = samples[~np.isnan(samples)]
        if known.size:
            edges = np.flatnonzero(np.diff(known, prepend=np.nan, append=np.nan))
            noise[sensor.channel] = (float(known.std()), int(np.diff(edges).max()))
    return noise


@dataclass(frozen=True, slots=True)
class ResolvedTare:
    """Offset in SI of each channel of a run, and what an event says of their source ("": none)."""

    offsets: dict[str, float]
    note: str = ""


def resolve_tare(volts: Float2D, rig: RigConfig, gaps_m: tuple[float, float]) -> ResolvedTare:
    """Return the offsets of a run by volts at rest before it, (channel, sample).

    Where bumpers may press on the mass, those that they change are taken from the rig's tare.
    """
    own = compute_tare(volts, rig.sensors) | rig.stated_offsets
    if not needs_tare(rig, gaps_m) or rig.tare is None:
        return ResolvedTare(own)
    tare, drifts = rig.tare, []
    stored = {}
    for sensor in rig.sensors:
        mean_v = tare.mean_v(sensor.channel)
        if mean_v is None or sensor.channel in rig.stated_offsets or sensor.channel not in own:
            continue
        offset = mean_v / sensor.volts_per_si
        if sensor.channel in PRELOADED_CHANNELS:
            stored[sensor.channel] = offset
        if sensor.channel == "table_disp_m" or sensor.channel not in PRELOADED_CHANNELS:
            drift = (own[sensor.channel] - offset) / sensor.si_per_unit
            drifts.append(f"{sensor.channel} {drift:+.3g} {sensor.unit}")
    age_h = measure_tare_age(tare, local_datetime())
    note = (
        f"{', '.join(stored)} from the tare of {tare.at} with the bumpers clear, {age_h:.1f} h "
        f"ago; since then the others have drifted by {', '.join(drifts)}"
    )
    return ResolvedTare(own | stored, note)


def measure_tare_age(tare: TareRecord, time: datetime) -> float:
    """Return the time in hours from a tare to `time`."""
    return (time - datetime.fromisoformat(tare.at)).total_seconds() / 3600.0


def needs_tare(rig: RigConfig, gaps_m: tuple[float, float]) -> bool:
    """Return True if bumpers may press on the mass where a run tares its sensors."""
    return min(gaps_m) <= 0.0 and not rig.tares_without_bumpers


def check_tare(rig: RigConfig, gaps_m: tuple[float, float], where: object, time: datetime) -> None:
    """Raise InputError if a run needs a tare with clear bumpers and the rig has no valid one."""
    if not needs_tare(rig, gaps_m):
        return
    tare = rig.tare
    needed = set(rig.channels).intersection(PRELOADED_CHANNELS) - rig.stated_offsets.keys()
    problem = ""
    if tare is None:
        problem = "the rig has no tare with its bumpers clear"
    elif missing := sorted(needed - set(tare.channels)):
        problem = f"the tare of {tare.at} lacks {', '.join(missing)}"
    elif not -MAX_TARE_LEAD_H <= (age_h := measure_tare_age(tare, time)) <= MAX_TARE_AGE_H:
        problem = f"the tare of {tare.at} is {age_h:.0f} h old"
    if problem:
        raise InputError(
            f"{problem}; at this gap the bumpers press on the mass, and a tare then would take "
            "their preload for an offset",
            where=where,
            key="specimen.gap_mm",
            value=round(1e3 * sum(gaps_m), 9),
            allowed=f"a tare of this rig, at most {MAX_TARE_AGE_H:g} h old",
            remedy="retract the bumpers and run `shaketwin tare --table RIG`",
        )


def find_overdue_calibrations(rig: RigConfig, today: date) -> list[str]:
    """Return one warning per sensor with an overdue calibration, and one for all undated ones.

    The command read back is not a sensor; a simulated rig needs no calibration dates.
    """
    sensors = [sensor for sensor in rig.sensors if sensor.channel != "drive_disp_m"]
    warnings = [sentence for sensor in sensors if (sentence := _format_due_warning(sensor, today))]
    undated = [
        sensor.channel for sensor in sensors if sensor.calibrated is None and sensor.due is None
    ]
    if undated and not rig.is_simulated:
        warnings.append(
            f"no date of calibration: {', '.join(undated)}; add `calibrated` and `due` to their "
            "[[sensors]] tables in the rig file"
        )
    return warnings


def _format_due_warning(sensor: SensorConfig, today: date) -> str:
    """Describe a fault in the calibration dates of one sensor; "" if there is none."""
    serial = f" (serial {sensor.serial})" if sensor.serial else ""
    due = sensor.due_date
    if due is not None and due < today.isoformat():
        ago = (today - date.fromisoformat(due)).days
        return (
            f"{sensor.channel}{serial}: its calibration was due on {due}, {ago} days ago; have it "
            "calibrated and update its [[sensors]] table in the rig file"
        )
    if sensor.calibrated is not None and sensor.calibrated > today.isoformat():
        return (
            f"{sensor.channel}{serial}: calibrated on {sensor.calibrated}, which is in the future; "
            "correct its [[sensors]] table in the rig file, or the clock of this computer"
        )
    return ""


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
