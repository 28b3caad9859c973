"""Limits that a test sets on channels, those of the laboratory included.

[[limits]]
channel = "mass_acc_2_m_s2"
limit = 0.8
unit = "g"
action = "notch"
"""

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.channels import Channel
from table_io.config.base import ConfigModel, Positive
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.units import UNITS

NOTCH = "notch"


class LimitConfig(ConfigModel):
    """Limit on the magnitude of a channel, and what happens there."""

    channel: str = Field(description="A channel of the rig.")
    limit: Positive = Field(description="Largest magnitude allowed.")
    unit: str | None = Field(None, description="Of `limit`; omitted: that of the recording.")
    action: Literal["notch", "warn", "stop"] = Field(
        "stop",
        description="Any sample beyond it warns, or stops the table; a notch reduces the level of "
        "a swept sine before its fundamental gets there.",
    )

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, unit: str | None, info: ValidationInfo) -> str | None:
        channel = info.data.get("channel", "")
        if unit is None:
            return None
        if unit not in UNITS:
            raise InputError(f"unit {unit!r} is unknown", allowed=", ".join(UNITS))
        ending = "_" + UNITS[unit][0].replace("/", "_").lower()
        if not channel.lower().endswith(ending):
            raise InputError(
                f"unit {unit!r} is none of {channel}", allowed="a unit of the channel's quantity"
            )
        return unit

    @property
    def limit_si(self) -> float:
        """Largest magnitude allowed, in the unit of the recording."""
        return self.limit * (UNITS[self.unit][1] if self.unit is not None else 1.0)


def check_limited_channels(limits: tuple[LimitConfig, ...], rig: RigConfig) -> tuple[Channel, ...]:
    """Return the channel of each limit; InputError if the rig does not measure one."""
    for number, entry in enumerate(limits, 1):
        if entry.channel not in rig.channels:
            raise InputError(
                f"rig {rig.name!r} does not measure this channel",
                where=f"limit {number}",
                key="limits.channel",
                value=entry.channel,
                allowed=", ".join(rig.channels),
            )
    return tuple(rig.channel_by_name[entry.channel] for entry in limits)
