"""The record of a calibration: what was applied to a sensor, what it gave, what follows from that.

`shaketwin calibrate` writes one into CARD.calibrations/ beside the machine card CARD.toml, a new
file each time: `<date>-<time>-<channel>.toml`. It is TOML of one `[[calibrations]]` table, so a
person can read it, and it can stand as it is at the end of a machine card. There the newest one of
each channel is put when the card is read for a run (`rig_file.py`), and so into every recording.

    channel, unit, serial      of the sensor, as on its card
    at, by, method             ISO 8601; who; "points" or "shunt"
    applied                    in `unit`, what was applied, each for a second
    applied_sd                 in `unit`, standard uncertainty of what was applied; 0: not stated
    volts, volts_sd            mean at each, and its standard error
    volts_per_unit, .._sd      sensitivity and its standard uncertainty, in which each point counts
                               with one converter step / sqrt(12) at least
    offset, offset_sd          in `unit`: volts = (value + offset) * volts_per_unit
    linearity_percent          of the span of `applied`, largest distance; from three points on
    card_volts_per_unit        what the machine card said then
    departure_percent, .._sd   of the sensitivity from that card, in per cent and in its sd
    tolerance_percent, passed  what was allowed, and whether it was kept
"""

import json
from typing import Literal

from pydantic import Field

from table_io.card import Card, Finite, NonNegative, Positive


class Calibration(Card):
    """One record; see the module for each key."""

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
    departure_sd: Finite | None = None  # none where the standard deviation is 0
    tolerance_percent: Positive
    passed: bool


class Records(Card):
    """A file of records."""

    calibrations: tuple[Calibration, ...] = Field(min_length=1)


def toml_of(record: Calibration) -> str:
    """The record as TOML; numbers with every digit that they have."""
    lines = ["[[calibrations]]"]
    for key, value in record.model_dump(exclude_none=True).items():
        lines.append(f"{key} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _toml(value: str | bool | float | tuple[float, ...]) -> str:
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            # a basic string of TOML too, which wants one character more escaped
            return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
        case tuple():
            return f"[{', '.join(repr(float(one)) for one in value)}]"
        case _:
            return repr(float(value))
