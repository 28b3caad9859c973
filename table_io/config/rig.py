"""Rig file: limits, command output, sensors and wiring of a shaking table.

Keys carry their unit in the name (`span_mm`, `lead_s`); properties return SI.
"""

import difflib
from typing import Literal, NamedTuple

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import ConfigModel, Finite, NonNegative, Number, Positive
from table_io.config.calibration_record import CalibrationRecord
from table_io.config.sensor import SensorConfig
from table_io.config.wiring.follow import FollowWiring
from table_io.config.wiring.ni import NiWiring
from table_io.config.wiring.opendaq import OpenDaqWiring
from table_io.config.wiring.udp import UdpWiring
from table_io.errors import InputError


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


class FaultKind(NamedTuple):
    """Keys of a fault kind: channel needed, meaning of its size ("": none), its duration."""

    channel: bool
    size: str
    duration: Literal["must", "may", "no"]  # for_s required, optional (else permanent), forbidden


FAULT_KINDS = {
    "dropped": FaultKind(False, "", "must"),
    "repeated": FaultKind(False, "", "must"),
    "replayed": FaultKind(False, "", "must"),
    "late": FaultKind(False, "seconds", "no"),
    "stall": FaultKind(False, "", "no"),
    "stuck": FaultKind(True, "", "may"),
    "cable_off": FaultKind(True, "", "may"),
    "gain": FaultKind(True, "relative error, 0.1 reads a tenth too much", "may"),
    "polarity": FaultKind(True, "", "may"),
    "rail": FaultKind(True, "", "may"),
    "drift": FaultKind(True, "units of the sensor a second", "may"),
    "spike": FaultKind(True, "units of the sensor", "no"),
    "nan": FaultKind(True, "", "may"),
    "power_loss": FaultKind(False, "", "no"),
    "oil_loss": FaultKind(False, "share of the servo's bandwidth that is left", "no"),
}


class InjectedFault(ConfigModel):
    """Fault injected into the simulated machine; `sim/faults.py` describes each kind.

    Keys that a kind does not use must be omitted.
    """

    at_s: NonNegative = Field(description="Time from the start of the run.")
    for_s: Positive | None = None
    channel: str | None = None
    size: Finite | None = None
    kind: str = Field(description="Last key: it decides which others are needed.")

    @field_validator("kind")
    @classmethod
    def _complete(cls, kind: str, info: ValidationInfo) -> str:
        if kind not in FAULT_KINDS:
            near = difflib.get_close_matches(kind, FAULT_KINDS, 1, 0.4)
            raise ValueError(
                f"kind {kind!r} is unknown"
                + (f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(FAULT_KINDS)}")
            )
        requirements = FAULT_KINDS[kind]
        keys = (
            ("channel", requirements.channel, requirements.channel, "one of the rig's sensors"),
            ("size", bool(requirements.size), bool(requirements.size), requirements.size),
            ("for_s", requirements.duration == "must", requirements.duration != "no", "seconds"),
        )
        for key, required, permitted, meaning in keys:
            given = info.data.get(key) is not None
            if required and key in info.data and not given:
                raise ValueError(f"kind {kind!r} needs {key} ({meaning}); add it")
            if given and not permitted:
                raise ValueError(f"kind {kind!r} has no {key}; leave it out")
        size = info.data.get("size")
        if kind in ("late", "oil_loss") and size is not None and size <= 0:
            raise ValueError(
                f"kind {kind!r} has size {size:g}; allowed: above 0 ({requirements.size})"
            )
        return kind


class SimulatedTableConfig(ConfigModel):
    """Simulated machine: servo, payload reaction and the true specimen on it."""

    servo_bandwidth_hz: Positive = Field(description="-3 dB of the closed displacement loop.")
    servo_delay_ms: NonNegative
    moving_mass_kg: Positive
    payload_reaction: bool = True
    seed: int = 0
    damper_stiffness_n_m: Positive
    damper_damping_n_s_m: NonNegative
    bumper_stiffness_n_m: Positive
    bumper_damping_n_s_m: Positive
    faults: tuple[InjectedFault, ...] = ()
    truth: str | None = Field(None, description="Path of a sealed file, see `sim/ground_truth.py`.")
    truth_sha256: str | None = Field(None, pattern=r"^[0-9a-fA-F]{64}$", validate_default=True)

    @field_validator("truth_sha256")
    @classmethod
    def _check_truth_pair(cls, sha256: str | None, info: ValidationInfo) -> str | None:
        if "truth" in info.data and (info.data["truth"] is None) != (sha256 is None):
            raise ValueError("truth and truth_sha256 go together; give both or neither")
        return sha256


class MachineConfig(ConfigModel):
    """Machine in a separate process: `shaketwin table` simulates its [simulated] table."""

    endpoint: str = Field(description="tcp/127.0.0.1:PORT or unix/PATH, on this computer only.")


class RigConfig(ConfigModel):
    """Rig file of a shaking table: its limits, output, sensors and wiring."""

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    title: str
    backend: Literal["simulated", "machine", "ni", "opendaq", "udp", "follow"]
    rates_hz: tuple[Positive, ...] = Field(min_length=1)
    moving_mass_kg: Positive = Field(description="Table without payload, for the force margin.")
    limits: MachineLimits
    output: OutputConfig
    sensors: tuple[SensorConfig, ...] = Field(min_length=1)
    simulated: SimulatedTableConfig | None = Field(None, validate_default=True)
    machine: MachineConfig | None = Field(None, validate_default=True)
    ni: NiWiring | None = Field(None, validate_default=True)
    opendaq: OpenDaqWiring | None = Field(None, validate_default=True)
    udp: UdpWiring | None = Field(None, validate_default=True)
    follow: FollowWiring | None = Field(None, validate_default=True)
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
        if info.data.get("backend") == "follow":
            missing -= {"drive_disp_m"}  # an external controller may have no command output
        if missing:
            raise ValueError(
                f"sensors lack {', '.join(sorted(missing))}; the amplitude control needs them"
            )
        return sensors

    @field_validator("simulated")
    @classmethod
    def _check_simulated(
        cls, simulated: SimulatedTableConfig | None, info: ValidationInfo
    ) -> SimulatedTableConfig | None:
        if simulated is None and info.data.get("backend") == "simulated":
            raise ValueError(
                "backend 'simulated' needs a [simulated] table with servo and specimen"
            )
        names = [sensor.channel for sensor in info.data.get("sensors", ())]
        for fault in simulated.faults if simulated and names else ():
            if fault.channel is not None and fault.channel not in names:
                near = difflib.get_close_matches(fault.channel, names, 1, 0.4)
                raise ValueError(
                    f"fault {fault.kind!r}: the rig has no sensor {fault.channel!r}"
                    + (f"; did you mean {near[0]!r}?" if near else f"; it has: {', '.join(names)}")
                )
        return simulated

    @field_validator("machine", "ni", "opendaq", "udp", "follow")
    @classmethod
    def _check_wiring(cls, wiring: ConfigModel | None, info: ValidationInfo) -> ConfigModel | None:
        if wiring is None and info.data.get("backend") == info.field_name:
            raise ValueError(
                f"backend {info.field_name!r} needs a [{info.field_name}] table with its "
                "wiring; see CONNECT.md"
            )
        if isinstance(wiring, FollowWiring) and info.data.get("backend") == "follow":
            if info.data.get(wiring.source) is None:
                raise ValueError(
                    f"source {wiring.source!r} needs a [{wiring.source}] table with its wiring"
                )
            wired = [sensor.channel for sensor in info.data.get("sensors", ())]
            if wired and wiring.command not in wired:
                raise ValueError(
                    f"command {wiring.command!r} is not a sensor of the rig; allowed: a sensor, "
                    "table_disp_m if no command is wired"
                )
        return wiring

    @property
    def runs_at_any_speed(self) -> bool:
        """True if any clock may pace the machine: it is simulated in the process of the rig."""
        return self.backend == "simulated"

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
