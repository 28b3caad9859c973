"""Sensor config: scaling to volts, instrument data, calibration dates and calibration records.

Dates are ISO (2026-03-01). Dates never stop a test; `calibration.py` reports overdue ones.

`shaketwin calibrate` writes each record to a new file `<date>-<time>-<channel>.toml` in the folder
RIG.calibrations/ next to the rig file RIG.toml. It is TOML with one `[[calibrations]]` table, which
also fits at the end of a rig file. When the rig file is read for a run (`load_rig`), the newest
record of each channel is appended to its text, and so enters every recording.

    channel, unit, serial      of the sensor, as in the rig file
    at, by, method             ISO 8601 time; operator; "points" or "shunt"
    applied                    in `unit`, applied values, one second each
    applied_sd                 in `unit`, standard uncertainty of the applied values; 0: not stated
    volts, volts_sd            mean at each applied value, and its standard error
    volts_per_unit, .._sd      sensitivity and its standard uncertainty; the standard error of each
                               point is at least one converter step / sqrt(12)
    offset, offset_sd          in `unit`: volts = (value + offset) * volts_per_unit
    linearity_percent          largest residual in per cent of the span; from three points on
    card_volts_per_unit        sensitivity in the rig file at that time
    departure_percent, .._sd   of the sensitivity from the rig file, in per cent and in its sd
    tolerance_percent, passed  allowed departure, and whether it was met
"""

import calendar
import re
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from table_io.channels import CHANNEL_BY_NAME, Channel
from table_io.config.base import (
    ConfigModel,
    Count,
    Finite,
    NonNegative,
    Positive,
    format_toml,
    require_both,
)
from table_io.errors import InputError
from table_io.units import UNITS

CLIP_RATIO = 0.999  # of a sensor's range, from which a sample counts as clipped
MAX_YEAR = 9999  # of a four-digit ISO date


def _parse_day(value: Any) -> Any:
    """Return the ISO text of a day that TOML parsed as a date or as text."""
    text = str(value)
    known = re.fullmatch(r"([0-9]{4})-([0-9]{2})-([0-9]{2})", text)
    year, month, day = map(int, known.groups()) if known else (0, 0, 0)
    if not (year and 1 <= month <= 12 and 1 <= day <= calendar.monthrange(year, month)[1]):
        raise InputError(f"{text} is not a date", allowed="year-month-day, e.g. 2026-03-01")
    return text


def _add_months(day: str, months: int) -> str | None:
    """Return the ISO day `months` months later; None beyond the year 9999."""
    year, month, of_month = map(int, day.split("-"))
    years, month = divmod(month - 1 + months, 12)
    year, month = year + years, month + 1
    if year > MAX_YEAR:
        return None
    return f"{year:04}-{month:02}-{min(of_month, calendar.monthrange(year, month)[1]):02}"


IsoDate = Annotated[str, BeforeValidator(_parse_day)]


def check_sensor_unit(unit: str, channel: Channel) -> None:
    """Raise ValueError if a sensor in this unit does not measure the channel."""
    allowed = [name for name, (si, _) in UNITS.items() if si == channel.unit]
    if unit not in allowed:
        raise InputError(
            f"unit {unit!r} does not measure {channel.name} ({channel.unit})",
            allowed=", ".join(allowed),
        )


class SensorConfig(ConfigModel):
    """Sensor of one channel: volts = (value + offset) * volts_per_unit."""

    channel: str = Field(description="Canonical, or declared in [[channels]] of the rig file.")
    unit: str = Field(description="Unit of `range`, `volts_per_unit` and the other values here.")
    range: Positive = Field(description="Full scale on either side, in `unit`.")
    volts_per_unit: Finite = Field(description="Sensitivity; negative if the sensor is reversed.")
    bits: int = Field(ge=8, le=32, description="Resolution of the A/D converter.")
    noise_rms: NonNegative = Field(
        0.0, description="In `unit`, measured at rest; also the noise of the simulated table."
    )
    offset: Finite = Field(0.0, description="In `unit`, reading at 0; every run tares it.")
    maker: str = Field("", description="Maker of the instrument.")
    model: str = Field("", description="Model of the instrument.")
    serial: str = Field("", description="Serial number.")
    calibrated: IsoDate | None = Field(None, description="Day of the last calibration.")
    due: IsoDate | None = Field(None, description="Day of the next one; or give interval_months.")
    interval_months: Annotated[Count, Field(ge=1, le=600)] | None = Field(
        None, description="Time between calibrations; or give `due`."
    )
    certificate: str = Field("", description="Number of the calibration certificate.")
    calibrated_by: str = Field("", description="Who calibrated it.")
    shunt: Finite | None = Field(None, description="In `unit`, shift caused by its shunt.")
    shunt_tolerance: Positive | None = Field(
        None, validate_default=True, description="In `unit`, on either side of `shunt`."
    )
    filter_hz: Positive | None = Field(None, description="-3 dB of its filter; information only.")
    delay_ms: NonNegative = Field(0.0, description="Of its electronics; information only.")

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, unit: str, info: ValidationInfo) -> str:
        channel = CHANNEL_BY_NAME.get(info.data.get("channel", ""))
        if channel is not None:
            check_sensor_unit(unit, channel)
        elif unit not in UNITS:  # of a channel that the rig file declares
            raise InputError(f"unit {unit!r} is unknown", allowed=", ".join(UNITS))
        return unit

    @field_validator("volts_per_unit")
    @classmethod
    def _check_sensitivity(cls, sensitivity: float) -> float:
        if sensitivity == 0:
            raise InputError("volts_per_unit is 0, so the signal would be lost", allowed="not 0")
        return sensitivity

    @field_validator("due", "interval_months")
    @classmethod
    def _check_due(cls, value: str | int | None, info: ValidationInfo) -> str | int | None:
        calibrated = info.data.get("calibrated")
        if value is None or "calibrated" not in info.data:
            return value
        if isinstance(value, str) and calibrated is not None and value < calibrated:
            raise InputError(
                f"due {value} lies before calibrated {calibrated}", remedy="correct one"
            )
        if isinstance(value, int) and calibrated is None:
            raise InputError(
                "interval_months counts from `calibrated`", remedy="add that, or give `due`"
            )
        if isinstance(value, int) and info.data.get("due") is not None:
            raise InputError(
                "due and interval_months both give the next calibration", remedy="keep one"
            )
        if (
            isinstance(value, int)
            and calibrated is not None
            and _add_months(calibrated, value) is None
        ):
            raise InputError(
                "its next calibration lies after the year 9999", remedy="give fewer months"
            )
        return value

    @field_validator("shunt_tolerance")
    @classmethod
    def _check_shunt(cls, tolerance: float | None, info: ValidationInfo) -> float | None:
        require_both("shunt_tolerance", tolerance, "shunt", info)
        if info.data.get("shunt") == 0.0:
            raise InputError("shunt is 0, which checks nothing", allowed="not 0")
        return tolerance

    @property
    def si_per_unit(self) -> float:
        return UNITS[self.unit][1]

    @property
    def range_si(self) -> float:
        return self.range * self.si_per_unit

    @property
    def clipping_level_si(self) -> float:
        """Level in SI from which a sample counts as clipped, just below the end of the range."""
        return CLIP_RATIO * self.range_si

    @property
    def clipping_level_v(self) -> float:
        """The same in volts, positive."""
        return abs(self.clipping_level_si * self.volts_per_si)

    @property
    def noise_si(self) -> float:
        """Stated rms noise in SI."""
        return self.noise_rms * self.si_per_unit

    @property
    def lsb_si(self) -> float:
        """One step of the A/D converter in SI."""
        return 2.0 * self.range_si / 2.0**self.bits

    @property
    def volts_per_si(self) -> float:
        return self.volts_per_unit / self.si_per_unit

    @property
    def lsb(self) -> float:
        """One step of the A/D converter in `unit`."""
        return 2.0 * self.range / 2.0**self.bits

    @property
    def due_date(self) -> str | None:
        """Day of the next calibration; None if the config does not give it."""
        if self.due is not None or self.calibrated is None or self.interval_months is None:
            return self.due
        return _add_months(self.calibrated, self.interval_months)


class CalibrationRecord(ConfigModel):
    """Record of one calibration."""

    channel: str = Field(description="Channel of the sensor.")
    unit: str = Field(description="Unit of the applied values.")
    serial: str = Field("", description="Serial number of the sensor.")
    at: str = Field(description="Time of the calibration, ISO 8601.")
    by: str = Field(description="Name of the operator.")
    method: Literal["points", "shunt"] = Field(description="Applied values or a shunt.")
    applied: tuple[Finite, ...] = Field(min_length=2, description="Applied values, in `unit`.")
    applied_sd: NonNegative = Field(
        0.0, description="Standard uncertainty of the applied values; 0: not stated."
    )
    volts: tuple[Finite, ...] = Field(description="Mean voltage at each applied value.")
    volts_sd: tuple[NonNegative, ...] = Field(description="Standard error of each mean.")
    volts_per_unit: Finite = Field(description="Sensitivity.")
    volts_per_unit_sd: NonNegative = Field(description="Standard uncertainty of the sensitivity.")
    offset: Finite = Field(description="In `unit`: volts = (value + offset) * volts_per_unit.")
    offset_sd: NonNegative = Field(description="Standard uncertainty of the offset.")
    linearity_percent: NonNegative | None = Field(
        None, description="Largest residual over the span; from three points on."
    )
    card_volts_per_unit: Finite = Field(description="Sensitivity in the rig file at that time.")
    departure_percent: Finite = Field(description="Departure of the sensitivity from the rig file.")
    departure_sd: Finite | None = Field(None, description="The same in its standard uncertainty.")
    tolerance_percent: Positive = Field(description="Allowed departure.")
    passed: bool = Field(description="Whether the departure is allowed.")


class CalibrationFile(ConfigModel):
    """File with one or more calibration records."""

    calibrations: tuple[CalibrationRecord, ...] = Field(min_length=1)


def format_calibration_toml(record: CalibrationRecord) -> str:
    """Serialize the record as TOML; numbers keep all digits."""
    return format_toml({"calibrations": [record.model_dump(exclude_none=True)]}).lstrip("\n")
