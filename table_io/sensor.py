"""A sensor's card: how its channel becomes volts, which instrument it is, when it was calibrated.

Dates are ISO (2026-03-01). Nothing here stops a test: what is overdue is told (`table_io/due.py`).
"""

import calendar
import difflib
import re
from typing import Annotated, Any

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator

from table_io.card import Card, Count, Finite, NonNegative, Positive
from table_io.channels import BY_NAME
from table_io.units import UNITS

LAST_YEAR = 9999  # that a date can have


def _iso(value: Any) -> Any:
    """The ISO text of a day, as TOML (a date) or a person (text) wrote it."""
    text = str(value)
    known = re.fullmatch(r"([0-9]{4})-([0-9]{2})-([0-9]{2})", text)
    year, month, day = map(int, known.groups()) if known else (0, 0, 0)
    if not (year and 1 <= month <= 12 and 1 <= day <= calendar.monthrange(year, month)[1]):
        raise ValueError(f"{text} is no date; allowed: year-month-day, as 2026-03-01")
    return text


def _after(day: str, months: int) -> str | None:
    """The ISO day so many months later; None beyond the year 9999."""
    year, month, of_month = map(int, day.split("-"))
    years, month = divmod(month - 1 + months, 12)
    year, month = year + years, month + 1
    if year > LAST_YEAR:
        return None
    return f"{year:04}-{month:02}-{min(of_month, calendar.monthrange(year, month)[1]):02}"


Day = Annotated[str, BeforeValidator(_iso)]


class Sensor(Card):
    """A channel's way from the quantity to volts: volts = (value + offset) * volts_per_unit."""

    channel: str
    unit: str
    range: Positive = Field(description="Full scale either side, in `unit`.")
    volts_per_unit: Finite = Field(description="The sensitivity; negative where it is turned.")
    bits: int = Field(ge=8, le=32)
    noise_rms: NonNegative = Field(
        0.0, description="In `unit`, at rest, as it was found once; the simulated table's noise."
    )
    offset: Finite = Field(
        0.0, description="In `unit`, what it shows at 0; every run tares it anew."
    )
    maker: str = ""
    model: str = ""
    serial: str = Field("", description="Serial number.")
    calibrated: Day | None = Field(None, description="Day of its last calibration.")
    due: Day | None = Field(None, description="Day of its next one; or interval_months.")
    interval_months: Annotated[Count, Field(ge=1, le=600)] | None = None
    certificate: str = ""
    calibrated_by: str = ""
    shunt: Finite | None = Field(None, description="In `unit`: how much more its shunt makes it.")
    shunt_tolerance: Positive | None = Field(
        None, validate_default=True, description="In `unit`, either side of `shunt`."
    )
    filter_hz: Positive | None = Field(None, description="-3 dB of its own filter; for the record.")
    delay_ms: NonNegative = Field(0.0, description="Of its own electronics; for the record.")

    @field_validator("channel")
    @classmethod
    def _known(cls, channel: str) -> str:
        if channel not in BY_NAME:
            near = difflib.get_close_matches(channel, BY_NAME, 1)
            raise ValueError(
                f"channel {channel!r} is unknown"
                + (f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(BY_NAME)}")
            )
        return channel

    @field_validator("unit")
    @classmethod
    def _unit_fits(cls, unit: str, info: ValidationInfo) -> str:
        channel = info.data.get("channel")
        if channel is None:
            return unit
        want = BY_NAME[channel].unit
        allowed = [name for name, (si, _) in UNITS.items() if si == want]
        if unit not in allowed:
            raise ValueError(
                f"unit {unit!r} does not measure {channel} ({want}); allowed: {', '.join(allowed)}"
            )
        return unit

    @field_validator("volts_per_unit")
    @classmethod
    def _not_silent(cls, volts: float) -> float:
        if volts == 0:
            raise ValueError("volts_per_unit is 0, so the channel would be silent; allowed: not 0")
        return volts

    @field_validator("due", "interval_months")
    @classmethod
    def _follows(cls, value: str | int | None, info: ValidationInfo) -> str | int | None:
        calibrated = info.data.get("calibrated")
        if value is None or "calibrated" not in info.data:
            return value
        if isinstance(value, str) and calibrated is not None and value < calibrated:
            raise ValueError(f"due {value} lies before calibrated {calibrated}; mend one of them")
        if isinstance(value, int) and calibrated is None:
            raise ValueError("interval_months counts from `calibrated`; add it, or give `due`")
        if isinstance(value, int) and info.data.get("due") is not None:
            raise ValueError("due and interval_months say the same; give one of them")
        if isinstance(value, int) and calibrated is not None and _after(calibrated, value) is None:
            raise ValueError("its next calibration comes after the year 9999; give fewer months")
        return value

    @field_validator("shunt_tolerance")
    @classmethod
    def _judged(cls, tolerance: float | None, info: ValidationInfo) -> float | None:
        if "shunt" in info.data and (info.data["shunt"] is None) != (tolerance is None):
            raise ValueError("shunt and shunt_tolerance go together; give both or neither")
        if info.data.get("shunt") == 0.0:
            raise ValueError("shunt is 0, so it would tell nothing; allowed: not 0")
        return tolerance

    @property
    def si_per_unit(self) -> float:
        return UNITS[self.unit][1]

    @property
    def range_si(self) -> float:
        return self.range * self.si_per_unit

    @property
    def volts_per_si(self) -> float:
        return self.volts_per_unit / self.si_per_unit

    @property
    def lsb(self) -> float:
        """One step of its converter, in `unit`."""
        return 2.0 * self.range / 2.0**self.bits

    @property
    def due_on(self) -> str | None:
        """Day of its next calibration; None where the card does not say."""
        if self.due is not None or self.calibrated is None or self.interval_months is None:
            return self.due
        return _after(self.calibrated, self.interval_months)
