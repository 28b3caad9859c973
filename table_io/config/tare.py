"""Tare of a rig with its bumpers clear: a dated record next to the rig file.

Bumpers that press on the mass load their cells and shift the mass, so a tare in that state would
take the preload for an offset. A run with a gap of 0 or less therefore takes the offsets of load
cells and displacements from the newest record; those of the other sensors, which no bumper moves,
it measures itself.
"""

import hashlib

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float2D
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.config.base import ConfigModel, Finite, NonNegative, format_toml
from table_io.errors import InputError

MAX_TARE_AGE_H = 168.0  # a week: load cells and amplifiers drift with temperature and cables
MAX_TARE_LEAD_H = 1.0  # in the future: a clock that was set back
# What bumpers in contact change at rest. The table is among them because u is the difference.
PRELOADED_CHANNELS = (*RIGHT_CELLS, *LEFT_CELLS, "mass_disp_m", "rel_disp_m", "table_disp_m")


class TareRecord(ConfigModel):
    """Means of all inputs at rest with the bumpers clear of the mass, and their noise."""

    rig: str = Field(description="Name of the rig.")
    at: str = Field(
        pattern=r"^\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d\d:\d\d$",
        description="Time of the tare, ISO 8601 with its zone.",
    )
    by: str = Field(description="Name of the operator.")
    seconds: NonNegative = Field(description="Length of the tare.")
    temperature_c: Finite | None = Field(None, description="Of the laboratory, if it was stated.")
    channels: tuple[str, ...] = Field(min_length=1, description="Sensors, in the rig's order.")
    volts: tuple[Finite, ...] = Field(description="Mean of each sensor.")
    noise_v: tuple[NonNegative, ...] = Field(description="Noise of each sensor, rms.")
    sha256: str = Field("", validate_default=True, description="SHA-256 of the keys above.")

    @field_validator("volts", "noise_v")
    @classmethod
    def _check_length(cls, values: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        count = len(info.data.get("channels", values))
        if len(values) != count:
            raise InputError(f"{len(values)} values for {count} channels", allowed=f"{count}")
        return values

    @field_validator("sha256")
    @classmethod
    def _check_hash(cls, stated: str, info: ValidationInfo) -> str:
        text = format_toml({key: value for key, value in info.data.items() if value is not None})
        actual = hashlib.sha256(text.encode()).hexdigest()
        if stated not in ("", actual):
            raise InputError(
                "the tare was altered after it was written", remedy="remove this file, tare again"
            )
        return actual

    def mean_v(self, channel: str) -> float | None:
        """Return the mean of a sensor in V; None if it was not there."""
        return dict(zip(self.channels, self.volts, strict=True)).get(channel)


class TareFile(ConfigModel):
    """File with the record of one tare."""

    tare: TareRecord


def format_tare_toml(record: TareRecord) -> str:
    """Serialize the record as TOML; numbers keep all digits."""
    return format_toml({"tare": record.model_dump(exclude_none=True)}).lstrip("\n")


def measure_tare(volts: Float2D) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return (mean, rms noise) in V of each row of volts at rest; lost samples are ignored."""
    return (tuple(np.nanmean(volts, axis=1).tolist()), tuple(np.nanstd(volts, axis=1).tolist()))
