"""Channels that a rig file declares next to the canonical ones of `table_io/channels.py`.

    [[channels]]
    name = "mass_acc_2_m_s2"     # ends with its unit
    quantity = "acceleration"    # a key of QUANTITIES
    unit = "m/s2"                # recorded unit, SI; the sensor may state g
    body = "mass"                # one of BODIES
    positive = "right"           # direction of a positive value, for motion, force and strain
    meaning = "Second accelerometer, at the upper edge of the mass."
    simulated = { mass_acc_m_s2 = 1.0, table_acc_m_s2 = 0.02 }

A `[[sensors]]` table of this channel makes it one of the rig. `simulated` is what the simulated
table gives: a sum of canonical channels times factors, plus `constant`, in SI.
"""

import re
import tomllib
from collections.abc import Iterable
from typing import Literal, NamedTuple

from pydantic import Field, ValidationError, ValidationInfo, field_validator

from table_io.channels import CHANNEL_BY_NAME, Channel
from table_io.config.base import ConfigModel, Finite, format_toml
from table_io.errors import InputError, suggest

NAME_PATTERN = r"[a-z][a-z0-9]*(_[a-z0-9]+)+"
MAX_NAME_LENGTH = 60
RESERVED_NAMES = ("level_m_s2",)  # column of an export: level of the step
RESERVED_PREFIX = "twin_"  # of the columns of the twin in an export
CONSTANT = "constant"  # key of `simulated`


# Channels that a laboratory's table may have, with quantity, body, direction and meaning. An import
# declares them where a file has columns of these names.
TABLE_CHANNELS = {
    "actuator_disp_m": ("displacement", "other", "right", "Stroke of the actuator."),
    "delta_pressure_pa": ("pressure", "other", "", "Pressure difference over the piston."),
    "valve_command_v": ("voltage", "other", "", "Command of the servo valve."),
    "table_force_n": ("force", "table", "compression", "Force of the actuator on the table."),
}
SPECIMEN_ACCELERATION = re.compile(r"specimen_acc_[a-z0-9_]+_m_s2")  # of a point of the specimen


class Quantity(NamedTuple):
    """Recorded unit, positive directions, and whether the value at rest is subtracted (tare)."""

    unit: str
    directions: tuple[str, ...]
    is_tared: bool


AXES = ("right", "left", "up", "down", "front", "back")
TURNS = ("clockwise", "counterclockwise")
LOADS = ("compression", "tension")
QUANTITIES: dict[str, Quantity] = {
    "displacement": Quantity("m", AXES, True),
    "relative_displacement": Quantity("m", AXES, True),  # of the body against the table
    "velocity": Quantity("m/s", AXES, True),
    "relative_velocity": Quantity("m/s", AXES, True),
    "acceleration": Quantity("m/s2", AXES, True),
    "rotation": Quantity("rad", TURNS, True),
    "rotation_rate": Quantity("rad/s", TURNS, True),
    "force": Quantity("N", LOADS, True),  # the whole force on the body
    "strain": Quantity("m/m", LOADS, True),
    "temperature": Quantity("degC", (), False),
    "pressure": Quantity("Pa", (), False),
    "voltage": Quantity("V", (), False),
}
Body = Literal["table", "mass", "damper", "right_bumper", "left_bumper", "ground", "other"]


class ChannelConfig(ConfigModel):
    """Channel declared next to the canonical ones."""

    quantity: str = Field(
        description="What is measured: acceleration, displacement, temperature, ..."
    )
    unit: str = Field(description="Unit of the recording: the SI unit of the quantity.")
    name: str = Field(
        max_length=MAX_NAME_LENGTH, description="Name of the channel; it ends with its unit."
    )
    body: Body = Field(description="What it is mounted on.")
    positive: str = Field("", validate_default=True, description="Direction of a positive value.")
    meaning: str = Field("", description="Description for reports and exports.")
    simulated: dict[str, Finite] | None = Field(
        None,
        min_length=1,
        description="Factors of canonical channels, or `constant`, for the simulated table.",
    )

    @field_validator("quantity")
    @classmethod
    def _check_quantity(cls, quantity: str) -> str:
        if quantity not in QUANTITIES:
            raise InputError(
                f"quantity {quantity!r} is unknown", remedy=suggest(quantity, QUANTITIES)
            )
        return quantity

    @field_validator("unit")
    @classmethod
    def _check_unit(cls, unit: str, info: ValidationInfo) -> str:
        quantity = info.data.get("quantity")
        if quantity is not None and unit != QUANTITIES[quantity].unit:
            raise InputError(
                f"unit {unit!r} does not fit",
                remedy=(
                    f"a channel of {quantity} is recorded in {QUANTITIES[quantity].unit!r}, its "
                    "sensor may state another unit"
                ),
            )
        return unit

    @field_validator("name")
    @classmethod
    def _check_name(cls, name: str, info: ValidationInfo) -> str:
        if name in CHANNEL_BY_NAME:
            raise InputError(
                f"{name} is a channel already", remedy="omit this table, or use another name"
            )
        if name in RESERVED_NAMES or name.startswith(RESERVED_PREFIX):
            raise InputError(f"{name} names a column of an export", remedy="use another name")
        if not re.fullmatch(NAME_PATTERN, name):
            raise InputError(
                f"{name!r} is no channel name", allowed="words of a to z and 0 to 9 joined by _"
            )
        suffix = f"_{info.data['unit'].lower().replace('/', '_')}" if "unit" in info.data else ""
        if not name.endswith(suffix):
            raise InputError(
                f"{name} does not end with its unit {info.data['unit']}", allowed=f"...{suffix}"
            )
        return name

    @field_validator("positive")
    @classmethod
    def _check_positive(cls, positive: str, info: ValidationInfo) -> str:
        quantity = info.data.get("quantity")
        allowed = QUANTITIES[quantity].directions if quantity else (positive,)
        if positive not in (allowed or ("",)):
            raise InputError(
                f"positive {positive!r} is not the direction of a positive {quantity}",
                allowed=", ".join(allowed) or "none, leave it out",
            )
        return positive

    @field_validator("simulated")
    @classmethod
    def _check_simulated(cls, factors: dict[str, float] | None) -> dict[str, float] | None:
        known = {**CHANNEL_BY_NAME, CONSTANT: None}
        for name in factors or {}:
            if name not in known:
                raise InputError(
                    f"{name!r} is not a signal of the table", remedy=suggest(name, known)
                )
        return factors

    @property
    def is_tared(self) -> bool:
        """True if the value at rest is subtracted; else the offset stated for the sensor is."""
        return QUANTITIES[self.quantity].is_tared

    @property
    def channel(self) -> Channel:
        """Entry of this channel in the registry."""
        return Channel(self.name, self.unit, self.positive, self.meaning, self.quantity, self.body)


def is_table_channel(name: str) -> bool:
    """Return True for a channel of a table or its specimen that a twin of the table may use."""
    return name in TABLE_CHANNELS or SPECIMEN_ACCELERATION.fullmatch(name) is not None


def declare_table_channels(rig_toml: str, columns: Iterable[str]) -> str:
    """Return a rig file that also declares the channels of a table among the columns of a file."""
    known = read_channels(rig_toml)
    for name in columns:
        if is_table_channel(name) and name not in known:
            point = ("acceleration", "other", "right", "Acceleration of a point of the specimen.")
            quantity, body, positive, meaning = TABLE_CHANNELS.get(name, point)
            declared = ChannelConfig(
                quantity=quantity,
                unit=QUANTITIES[quantity].unit,
                name=name,
                body=body,
                positive=positive,
                meaning=meaning,
            )
            table = format_toml({"channels": [declared.model_dump(exclude_none=True)]})
            rig_toml = f"{rig_toml.rstrip()}\n{table}"
    return rig_toml


def read_channels(rig_toml: str) -> dict[str, Channel]:
    """Return the canonical channels and those that a recorded rig file declares, by name.

    Invalid tables are skipped, so that the rest of a foreign recording can be shown.
    """
    try:
        tables = tomllib.loads(rig_toml).get("channels")
    except (tomllib.TOMLDecodeError, RecursionError):
        tables = None
    channels = dict(CHANNEL_BY_NAME)
    for table in tables if isinstance(tables, list) else []:
        try:
            channel = ChannelConfig.model_validate(table).channel
        except ValidationError:
            continue
        channels.setdefault(channel.name, channel)
    return channels
