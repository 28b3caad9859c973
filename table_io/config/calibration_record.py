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
    """Record of one calibration; the module describes each key."""

    channel: str
    unit: str
    serial: str = ""
    at: str
    by: str
    method: Literal["points", "shunt"]
    applied: tuple[Finite, ...] = Field(min_length=2)
    applied_sd: NonNegative = 0.0
    volts: tuple[Finite, ...]
    volts_sd: tuple[NonNegative, ...]
    volts_per_unit: Finite
    volts_per_unit_sd: NonNegative
    offset: Finite
    offset_sd: NonNegative
    linearity_percent: NonNegative | None = None
    card_volts_per_unit: Finite
    departure_percent: Finite
    departure_sd: Finite | None = None  # None if the standard deviation is 0
    tolerance_percent: Positive
    passed: bool


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
