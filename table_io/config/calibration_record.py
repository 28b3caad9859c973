"""Calibration record: applied values, measured volts and the resulting sensitivity and offset.

`shaketwin calibrate` writes each record to a new file `<date>-<time>-<channel>.toml` in the folder
RIG.calibrations/ next to the rig file RIG.toml. It is TOML with one `[[calibrations]]` table, which
also fits at the end of a rig file. When the rig file is read for a run (`rig_file.py`), the newest
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

import json
from typing import Literal

from pydantic import Field

from table_io.config.base import ConfigModel, Finite, NonNegative, Positive


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
    lines = ["[[calibrations]]"]
    for key, value in record.model_dump(exclude_none=True).items():
        lines.append(f"{key} = {_format_toml_value(value)}")
    return "\n".join(lines) + "\n"


def _format_toml_value(value: str | bool | float | tuple[float, ...]) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            # a JSON string is a TOML basic string, except that TOML also requires DEL to be escaped
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case tuple():
            return f"[{', '.join(repr(float(number)) for number in value)}]"
        case _:
            return repr(float(value))
