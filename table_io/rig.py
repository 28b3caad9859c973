"""The machine card: a table, what it can do, its output, its sensors.

Human units stand in the key names here (`span_mm`, `lead_s`); the properties hand out SI.
"""

import difflib
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.card import Card, Finite, NonNegative, Number, Positive
from table_io.channels import BY_NAME
from table_io.units import UNITS


class Sensor(Card):
    """A channel's way from the quantity to volts: volts = (value + offset) * volts_per_unit."""

    channel: str
    unit: str
    range: Positive = Field(description="Full scale either side, in `unit`.")
    volts_per_unit: Finite
    bits: int = Field(ge=8, le=32)
    noise_rms: NonNegative = Field(0.0, description="In `unit`; the simulated table's noise.")
    offset: Finite = Field(0.0, description="In `unit`; the simulated table's sensor offset.")

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

    @property
    def si_per_unit(self) -> float:
        return UNITS[self.unit][1]

    @property
    def range_si(self) -> float:
        return self.range * self.si_per_unit

    @property
    def volts_per_si(self) -> float:
        return self.volts_per_unit / self.si_per_unit


class Limits(Card):
    """What the machine can do, either side of its mean position."""

    stroke_mm: Positive
    velocity_mm_s: Positive
    acceleration_g: Positive
    force_kn: Positive
    frequency_hz: Positive


class Output(Card):
    """The command channel: +-span_mm is +-span_v."""

    span_mm: Positive
    span_v: Positive = 10.0
    bits: int = Field(ge=8, le=32)
    lead_s: Number = Field(0.5, ge=0.2, le=5.0, description="Checked command queued ahead.")
    warn_lsb: int = Field(100, ge=1, description="Warn where an amplitude has fewer LSB.")
    least_lsb: int = Field(20, ge=1, description="Refuse where an amplitude has fewer LSB.")

    @property
    def volts_per_m(self) -> float:
        return self.span_v / (self.span_mm * 1e-3)

    @property
    def lsb_m(self) -> float:
        """Displacement of one DAC step in m."""
        return 2 * self.span_mm * 1e-3 / 2**self.bits


class SimulatedTable(Card):
    """The simulated machine: servo, payload reaction and the true specimen on it."""

    servo_bandwidth_hz: Positive = Field(description="-3 dB of the closed displacement loop.")
    servo_delay_ms: NonNegative
    moving_mass_kg: Positive
    payload_reaction: bool = True
    seed: int = 0
    damper_stiffness_n_m: Positive
    damper_damping_n_s_m: NonNegative
    bumper_stiffness_n_m: Positive
    bumper_damping_n_s_m: Positive


class Rig(Card):
    """Machine card: a table, its limits, its output and its sensors."""

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    title: str
    backend: Literal["simulated"]
    rates_hz: tuple[Positive, ...] = Field(min_length=1)
    moving_mass_kg: Positive = Field(description="Table without payload, for the force margin.")
    limits: Limits
    output: Output
    sensors: tuple[Sensor, ...] = Field(min_length=1)
    simulated: SimulatedTable | None = Field(None, validate_default=True)

    @field_validator("sensors")
    @classmethod
    def _complete(cls, sensors: tuple[Sensor, ...]) -> tuple[Sensor, ...]:
        names = [sensor.channel for sensor in sensors]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(
                f"sensors name {', '.join(twice)} more than once; one sensor a channel"
            )
        missing = {"drive_disp_m", "table_disp_m", "table_acc_m_s2"} - set(names)
        if missing:
            raise ValueError(
                f"sensors lack {', '.join(sorted(missing))}; the controller needs them"
            )
        return sensors

    @field_validator("simulated")
    @classmethod
    def _present(
        cls, simulated: SimulatedTable | None, info: ValidationInfo
    ) -> SimulatedTable | None:
        if simulated is None and info.data.get("backend") == "simulated":
            raise ValueError(
                "backend 'simulated' needs a [simulated] table with servo and specimen"
            )
        return simulated

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(sensor.channel for sensor in self.sensors)
