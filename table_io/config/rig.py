"""Rig file: limits, command output, sensors and wiring of a shaking table.

Keys carry their unit in the name (`span_mm`, `lead_s`); properties return SI.
"""

from collections.abc import Mapping
from typing import Any, Self, TypeVar

from pydantic import (
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import InitErrorDetails

from table_io.config.backend import BACKEND_GROUP, BackendConfig, list_entry_points, load_backend
from table_io.config.base import ConfigModel, Number, Positive
from table_io.config.calibration_record import CalibrationRecord
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError

SectionT = TypeVar("SectionT", bound=BackendConfig)


class MachineLimits(ConfigModel):
    """Limits of the machine, on either side of its mean position."""

    stroke_mm: Positive
    velocity_mm_s: Positive
    acceleration_g: Positive
    force_kn: Positive
    frequency_hz: Positive


class OutputConfig(ConfigModel):
    """Command output: +-span_v commands +-span_mm."""

    span_mm: Positive
    span_v: Positive = 10.0
    bits: int = Field(ge=8, le=32)
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


class RigConfig(ConfigModel):
    """Rig file of a shaking table: its limits, output, sensors and the sections of backends.

    A section is a table named like an installed backend and validated by its config model. Sections
    of a backend that is not installed are kept unread, so that a recording can be read without the
    package that drove its table; `load_rig` refuses them.
    """

    model_config = ConfigDict(extra="allow")  # the sections

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    title: str
    backend: str
    rates_hz: tuple[Positive, ...] = Field(min_length=1)
    moving_mass_kg: Positive = Field(description="Table without payload, for the force margin.")
    limits: MachineLimits
    output: OutputConfig
    sensors: tuple[SensorConfig, ...] = Field(min_length=1)
    calibrations: tuple[CalibrationRecord, ...] = Field(
        (), description="Records of `shaketwin calibrate`, appended when the file is read."
    )

    @field_validator("sensors")
    @classmethod
    def _complete(
        cls, sensors: tuple[SensorConfig, ...], info: ValidationInfo
    ) -> tuple[SensorConfig, ...]:
        names = [sensor.channel for sensor in sensors]
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise ValueError(
                f"sensors name {', '.join(duplicates)} more than once; one sensor per channel"
            )
        missing = {"drive_disp_m", "table_disp_m", "table_acc_m_s2"} - set(names)
        backend = load_backend(info.data.get("backend", ""))
        if backend is None or not backend.drives:
            missing -= {"drive_disp_m"}  # an external controller may have no command output
        if missing:
            raise ValueError(
                f"sensors lack {', '.join(sorted(missing))}; the amplitude control needs them"
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
                    own_name,
                    f"backend {own_name!r} needs a [{own_name}] table with its settings; see "
                    "CONNECT.md",
                )
            )
        # A section may name that of another backend, as [follow] does.
        sources = own_section.values() if isinstance(own_section, Mapping) else ()
        for name in [key for key in values if key not in cls.model_fields]:
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
                faults += [_make_fault(name, fault) for fault in section.list_faults(rig)]
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
    def channels(self) -> tuple[str, ...]:
        return tuple(sensor.channel for sensor in self.sensors)

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


def _make_fault(name: str, message: str) -> InitErrorDetails:
    error = {"error": ValueError(message)}
    return InitErrorDetails(type="value_error", loc=(name,), input=None, ctx=error)


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
