"""Rig file: limits, command output, sensors and wiring of a shaking table.

Keys carry their unit in the name (`span_mm`, `lead_s`); properties return SI.

A backend registers under its name in the entry-point group `shaketwin.backends`. Its module is
imported when a rig file names it, not before.
"""

import math
from collections.abc import Mapping
from functools import cache, cached_property
from typing import Any, Protocol, Self, TypeVar, runtime_checkable

from pydantic import (
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic.functional_validators import ModelWrapValidatorHandler
from pydantic_core import InitErrorDetails

from table_io.channels import CHANNEL_BY_NAME, CONTROL_CHANNELS, Channel
from table_io.config.base import (
    ConfigModel,
    NonNegative,
    Number,
    Positive,
    list_duplicates,
    require_both,
)
from table_io.config.channel import ChannelConfig
from table_io.config.plugins import list_entry_points, load_entry_point
from table_io.config.sensor import CalibrationRecord, SensorConfig, check_sensor_unit
from table_io.config.tare import TareRecord
from table_io.errors import InputError, suggest

BACKEND_GROUP = "shaketwin.backends"
REINSTALL = "install shaketwin again (pip install -e . in a source tree)"


class BackendConfig(ConfigModel):
    """Base class of the section `[name]` in which a rig file configures the backend `name`."""

    def list_faults(self, rig: "RigConfig") -> list[str]:
        """List contradictions between this section and the rest of the rig file."""
        return []

    def find_address(self, rig: "RigConfig") -> str:
        """Return the address of the machine as written in the rig file; "" if it has none."""
        return ""

    @property
    def warnings(self) -> list[str]:
        """Warnings of the pre-flight check about allowed but less safe settings."""
        return []

    @property
    def tares_without_bumpers(self) -> bool:
        """True if a tare is that of clear bumpers also where they press: a simulation's truth."""
        return False

    @property
    def max_start_wait_s(self) -> float:
        """Longest recorded wait for the table to be started, in s."""
        return 0.0


@runtime_checkable
class InstalledBackend(Protocol):
    """What a rig file needs of `table_io.backends.BackendDescriptor`."""

    @property
    def config(self) -> type[BackendConfig]: ...
    @property
    def drives(self) -> bool: ...
    @property
    def any_speed(self) -> bool: ...
    @property
    def is_simulated(self) -> bool: ...
    @property
    def external_control(self) -> bool: ...


@cache
def load_backend(name: str) -> InstalledBackend | None:
    """Import the backend `name`, None if it is not installed; InputError if it is unusable."""
    backend = load_entry_point(BACKEND_GROUP, name)
    if backend is not None and not isinstance(backend, InstalledBackend):
        raise InputError(
            f"is a {type(backend).__name__}",
            where=BACKEND_GROUP,
            key=name,
            allowed="a BackendDescriptor",
            remedy="fix or remove the package",
        )
    return backend


def require_backend(name: str, where: object, key: str = "backend") -> InstalledBackend:
    """Return the backend `name`; InputError if it is not installed."""
    backend = load_backend(name)
    if backend is None:
        names = ", ".join(list_entry_points(BACKEND_GROUP))
        raise InputError(
            "no installed package provides this backend",
            where=where,
            key=key,
            value=name,
            allowed=names or "none is installed",
            remedy="correct the name, or install the package that provides it"
            if names
            else REINSTALL,
        )
    return backend


SectionT = TypeVar("SectionT", bound=BackendConfig)


class MachineLimits(ConfigModel):
    """Limits of the machine, on either side of its mean position."""

    stroke_mm: Positive = Field(description="Largest displacement.")
    velocity_mm_s: Positive = Field(description="Largest velocity.")
    acceleration_g: Positive = Field(description="Largest acceleration.")
    force_kn: Positive = Field(description="Largest force of the actuator.")
    frequency_hz: Positive = Field(description="Highest frequency of a command.")
    piston_area_cm2: Positive | None = Field(
        None, description="Of a hydraulic actuator, for its flow; omitted: no limit of flow."
    )
    peak_flow_l_min: Positive | None = Field(
        None,
        validate_default=True,
        description="Largest flow of servo-valve and accumulators together.",
    )

    @field_validator("peak_flow_l_min")
    @classmethod
    def _check_flow(cls, flow: float | None, info: ValidationInfo) -> float | None:
        require_both("peak_flow_l_min", flow, "piston_area_cm2", info)
        return flow


class OutputConfig(ConfigModel):
    """Command output: +-span_v commands +-span_mm."""

    span_mm: Positive = Field(description="Displacement at `span_v`.")
    span_v: Positive = Field(10.0, description="Voltage of full scale.")
    bits: int = Field(ge=8, le=32, description="Resolution of the D/A converter.")
    lead_s: Number = Field(0.5, ge=0.2, le=5.0, description="Checked command queued ahead.")
    warn_lsb: int = Field(100, ge=1, description="Warn if an amplitude has fewer LSB.")
    least_lsb: int = Field(20, ge=1, description="Refuse if an amplitude has fewer LSB.")

    @property
    def volts_per_m(self) -> float:
        return self.span_v / (self.span_mm * 1e-3)

    @property
    def lsb_m(self) -> float:
        """Displacement of one step of the D/A converter in m."""
        return 2 * self.span_mm * 1e-3 / 2**self.bits

    def lead_samples(self, rate_hz: float, replace_after: int) -> int:
        """Return the samples queued ahead: `replace_after` fixed, then `lead_s` replaceable."""
        return replace_after + round(self.lead_s * rate_hz)


LEAST_MAX_CORRECTION = 2.0  # also of a rig that accepts smaller deviations at both ends


class TableResponse(ConfigModel):
    """What is known of the table, and what loop check and protection accept of it.

    Gains are those of the fundamental over the command at the level of the check.
    """

    least_level_g: NonNegative = Field(
        0.0,
        description="Acceleration below which friction holds the table back: the loop check moves "
        "no less than that, but no more than the test.",
    )
    gain: tuple[Positive, Positive] = Field(
        (0.8, 1.2),
        description="Gain at the lowest frequency, from and to; where `lag_ms` is stated, from the "
        "first times that of a loop with this lag.",
    )
    top_gain: tuple[Positive, Positive] = Field(
        (0.5, 1.25),
        description="Gain at the end of the sweep. Amplitude control corrects all gains accepted, "
        "and a factor of 2 in any case.",
    )
    gain_residual_percent: Positive = Field(
        10.0, description="Gain off a straight line of its logarithm over the square of frequency."
    )
    following_ratio: Positive = Field(
        0.15,
        description="Deviation of the table from the response to its command at which protection "
        "stops, over the recent peak of the command.",
    )
    stall_force_kn: Positive | None = Field(
        None,
        description="Supply pressure times piston area, for the table's twin; omitted: no load "
        "slows the flow of the valve.",
    )
    lag_ms: Positive = Field(
        15.0,
        le=200,
        description="Lag of the table behind its command near the first resonance, which the gains "
        "of a feedback and, where it is stated, the limits of `gain` allow for.",
    )
    delay_spread_ms: Positive = Field(
        5.0, description="Spread of the delay over the frequencies; at least half of its mean."
    )

    @field_validator("gain", "top_gain")
    @classmethod
    def _check_order(cls, limits: tuple[float, float]) -> tuple[float, float]:
        if limits[0] >= limits[1]:
            raise InputError(f"{limits[0]:g} to {limits[1]:g} is no range", allowed="low, high")
        return limits

    @property
    def max_correction(self) -> float:
        """Largest factor on a command for the table's gain, and of its inverse."""
        lowest, highest = zip(self.gain, self.top_gain, strict=True)
        return max(LEAST_MAX_CORRECTION, 1.0 / min(lowest), *highest)

    def find_least_gain(self, frequency_hz: float) -> float:
        """Return the least gain accepted at the lowest frequency of a test.

        A slow loop with a lag T has a gain of 1 / sqrt(1 + (w T)^2), a mere delay one of 1.
        """
        lag_s = 1e-3 * self.lag_ms if "lag_ms" in self.model_fields_set else 0.0
        roll_off = math.hypot(1.0, 2.0 * math.pi * frequency_hz * lag_s)
        return max(self.gain[0] / roll_off, 1.0 / self.max_correction)


class RigConfig(ConfigModel):
    """Rig file of a shaking table: its limits, output, channels, sensors, sections of backends.

    A section is a table named like an installed backend.
    """

    # The extras are sections, validated by the config model of their backend. Those of a backend
    # that is not installed are kept unread, so that a recording can be read without the package
    # that drove its table; `load_rig` refuses them.
    model_config = ConfigDict(extra="allow", populate_by_name=True)

    name: str = Field(
        pattern=r"^[a-z0-9_]+$", description="Name of the rig on the bus: a to z, 0 to 9 and _."
    )
    title: str = Field(description="Name of the table in every report.")
    backend: str = Field(
        description="How the table is driven: an installed backend, with a table of its name here."
    )
    rates_hz: tuple[Positive, ...] = Field(
        min_length=1, description="Sampling rates that the hardware supports."
    )
    moving_mass_kg: Positive = Field(description="Table without payload, for the force margin.")
    limits: MachineLimits
    output: OutputConfig
    table_response: TableResponse = Field(
        TableResponse(), description="What is known of the table, and accepted of it."
    )
    extra_channels: tuple[ChannelConfig, ...] = Field(
        (), alias="channels", description="Channels declared next to the canonical ones."
    )
    sensors: tuple[SensorConfig, ...] = Field(min_length=1)
    calibrations: tuple[CalibrationRecord, ...] = Field(
        (), description="Records of `shaketwin calibrate`, appended when the file is read."
    )
    tare: TareRecord | None = Field(
        None, description="Newest record of `shaketwin tare`, appended when the file is read."
    )

    @field_validator("extra_channels")
    @classmethod
    def _check_duplicates(cls, channels: tuple[ChannelConfig, ...]) -> tuple[ChannelConfig, ...]:
        duplicates = list_duplicates([channel.name for channel in channels])
        if duplicates:
            raise InputError(
                f"channels declare {', '.join(duplicates)} more than once", remedy="keep one"
            )
        return channels

    @field_validator("sensors")
    @classmethod
    def _complete(
        cls, sensors: tuple[SensorConfig, ...], info: ValidationInfo
    ) -> tuple[SensorConfig, ...]:
        if "extra_channels" in info.data:  # else their faults are reported
            _check_sensor_channels(sensors, _build_registry(info.data["extra_channels"]))
        names = [sensor.channel for sensor in sensors]
        duplicates = list_duplicates(names)
        if duplicates:
            raise InputError(
                f"sensors name {', '.join(duplicates)} more than once",
                remedy="one sensor per channel",
            )
        missing = set(CONTROL_CHANNELS) - set(names)
        backend = load_backend(info.data.get("backend", ""))
        if backend is None or not backend.drives:
            missing -= {"drive_disp_m"}  # an external controller may have no command output
        if missing:
            raise InputError(
                f"sensors lack {', '.join(sorted(missing))}",
                remedy="the amplitude control needs them",
            )
        return sensors

    @model_validator(mode="wrap")
    @classmethod
    def _validate_sections(cls, data: Any, handler: ModelWrapValidatorHandler[Self]) -> Self:
        """Validate sections and fields, so that one error lists the faults of both."""
        if not isinstance(data, Mapping):
            return handler(data)
        values, faults = dict(data), list[InitErrorDetails]()
        own_name = str(values.get("backend"))
        own_section = values.get(own_name)
        is_installed = load_backend(own_name) is not None
        if is_installed and own_section is None:
            faults.append(
                _make_fault(
                    (own_name,),
                    InputError(
                        f"backend {own_name!r} needs a [{own_name}] table with its settings",
                        remedy="see CONNECT.md",
                    ),
                )
            )
        # A section may name that of another backend, as [follow] does.
        sources = own_section.values() if isinstance(own_section, Mapping) else ()
        for name in [key for key in values if key not in {*cls.fields_by_key(), *cls.model_fields}]:
            backend = load_backend(name)
            if backend is not None:
                try:
                    values[name] = backend.config.model_validate(values[name])
                except ValidationError as error:
                    faults += _list_faults(error, (name,))
            elif is_installed and name not in sources:
                faults.append(
                    InitErrorDetails(type="extra_forbidden", loc=(name,), input=values[name])
                )
        try:
            rig = handler(values)
        except ValidationError as error:
            faults = _list_faults(error) + faults
        else:
            for name, section in rig.sections.items():
                faults += [
                    _make_fault((name,), ValueError(fault)) for fault in section.list_faults(rig)
                ]
        if faults:
            raise ValidationError.from_exception_data(cls.__name__, faults)
        return rig

    @classmethod
    def list_keys(cls) -> list[str]:
        return [*super().list_keys(), *list_entry_points(BACKEND_GROUP)]

    @classmethod
    def find_table_model(cls, key: str) -> type[ConfigModel] | None:
        backend = load_backend(key)
        return super().find_table_model(key) if backend is None else backend.config

    @property
    def sections(self) -> dict[str, BackendConfig]:
        """Sections of installed backends by name."""
        extra = self.model_extra or {}
        return {key: value for key, value in extra.items() if isinstance(value, BackendConfig)}

    @property
    def backend_section(self) -> BackendConfig:
        """Section of the rig's own backend; an empty one if that is not installed."""
        return self.sections.get(self.backend, BackendConfig())

    def get_section(self, model: type[SectionT]) -> SectionT | None:
        """Return the section of this config model; None if the rig file has none."""
        sections = self.sections.values()
        return next((section for section in sections if isinstance(section, model)), None)

    def require_section(self, name: str, model: type[SectionT]) -> SectionT:
        """Return the section `name` of this config model; InputError if the rig file has none."""
        section = self.get_section(model)
        if section is None:
            raise InputError(
                "no such table",
                where=f"rig {self.name}",
                key=f"[{name}]",
                remedy="add it, or give another rig file",
            )
        return section

    @property
    def runs_at_any_speed(self) -> bool:
        """True if any clock may pace the machine: it is simulated in the process of the rig."""
        backend = load_backend(self.backend)
        return backend is not None and backend.any_speed

    @property
    def under_external_control(self) -> bool:
        """True if another controller drives the table, and a run only records it."""
        backend = load_backend(self.backend)
        return backend is not None and backend.external_control

    @property
    def is_simulated(self) -> bool:
        """True if the rig file has the section of a simulated table, perhaps behind a protocol."""
        backends = map(load_backend, self.sections)
        return any(backend is not None and backend.is_simulated for backend in backends)

    @property
    def tares_without_bumpers(self) -> bool:
        """True if the tare of a run is that of clear bumpers, whatever the gap."""
        return any(section.tares_without_bumpers for section in self.sections.values())

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of the acquired channels, in the order of the sensors."""
        return tuple(sensor.channel for sensor in self.sensors)

    def sensor(self, channel: str) -> SensorConfig:
        """Return the sensor of a channel; ValueError if the rig has none."""
        return self.sensors[self.channels.index(channel)]

    @property
    def channel_by_name(self) -> dict[str, Channel]:
        """Registry of this rig: the canonical channels and those that it declares."""
        return _build_registry(self.extra_channels)

    @property
    def stated_offsets(self) -> dict[str, float]:
        """Stated offset in SI of each sensor whose zero is absolute, so that it is never tared."""
        absolute = {channel.name for channel in self.extra_channels if not channel.is_tared}
        return {
            sensor.channel: sensor.offset * sensor.si_per_unit
            for sensor in self.sensors
            if sensor.channel in absolute
        }

    def check_rate(self, rate_hz: float) -> None:
        """Raise InputError if the rig does not support this sampling rate in Hz."""
        if rate_hz not in self.rates_hz:
            allowed = ", ".join(f"{rate:g}" for rate in self.rates_hz)
            raise InputError(
                f"rig {self.name} does not support this rate",
                key="acquisition.rate_hz",
                value=rate_hz,
                allowed=f"{allowed} Hz",
                remedy="change rate_hz in the profile",
            )


def _make_fault(location: tuple[int | str, ...], error: ValueError) -> InitErrorDetails:
    return InitErrorDetails(type="value_error", loc=location, input=None, ctx={"error": error})


def _list_faults(error: ValidationError, location: tuple[str, ...] = ()) -> list[InitErrorDetails]:
    """Return the faults of a validation error, at a location."""
    return [
        InitErrorDetails(
            type=fault["type"],
            loc=(*location, *fault["loc"]),
            input=fault["input"],
            ctx=fault.get("ctx", {}),
        )
        for fault in error.errors(include_url=False)
    ]


def _build_registry(declared: tuple[ChannelConfig, ...]) -> dict[str, Channel]:
    return CHANNEL_BY_NAME | {channel.name: channel.channel for channel in declared}


def _check_sensor_channels(sensors: tuple[SensorConfig, ...], registry: dict[str, Channel]) -> None:
    """Raise ValidationError for each sensor of an unknown channel, or in a unit not of it."""
    faults: list[InitErrorDetails] = []
    for row, sensor in enumerate(sensors):
        channel = registry.get(sensor.channel)
        if channel is None:
            hint = f"{suggest(sensor.channel, registry)} or declare it in a [[channels]] table"
            unknown = InputError(f"channel {sensor.channel!r} is unknown", remedy=hint)
            faults.append(_make_fault((row, "channel"), unknown))
            continue
        try:
            check_sensor_unit(sensor.unit, channel)
        except ValueError as error:
            faults.append(_make_fault((row, "unit"), error))
    if faults:
        raise ValidationError.from_exception_data("sensors", faults)
