"""Section `[simulated]` of a rig file: the simulated table, its specimen and injected faults."""

from typing import Literal, NamedTuple

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.backend import BackendConfig
from table_io.config.base import ConfigModel, Finite, NonNegative, Positive
from table_io.config.rig import RigConfig
from table_io.errors import InputError, suggest
from table_io.sim.ground_truth import GroundTruth
from table_io.sim.hydraulic_config import HydraulicTableConfig


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
    for_s: Positive | None = Field(
        None, description="Duration; omitted: to the end, where the kind allows it."
    )
    channel: str | None = Field(None, description="Channel of the fault, for kinds of one channel.")
    size: Finite | None = Field(
        None, description="Size of the fault, in the unit that its kind states."
    )
    kind: str = Field(description="Last key: it decides which others are needed.")

    @field_validator("kind")
    @classmethod
    def _complete(cls, kind: str, info: ValidationInfo) -> str:
        if kind not in FAULT_KINDS:
            raise InputError(f"kind {kind!r} is unknown", remedy=suggest(kind, FAULT_KINDS))
        requirements = FAULT_KINDS[kind]
        keys = (
            ("channel", requirements.channel, requirements.channel, "one of the rig's sensors"),
            ("size", bool(requirements.size), bool(requirements.size), requirements.size),
            ("for_s", requirements.duration == "must", requirements.duration != "no", "seconds"),
        )
        for key, required, permitted, meaning in keys:
            given = info.data.get(key) is not None
            if required and key in info.data and not given:
                raise InputError(f"kind {kind!r} needs {key} ({meaning})", remedy="add it")
            if given and not permitted:
                raise InputError(f"kind {kind!r} has no {key}", remedy="leave it out")
        size = info.data.get("size")
        if kind in ("late", "oil_loss") and size is not None and size <= 0:
            raise InputError(
                f"kind {kind!r} has size {size:g}", allowed=f"above 0 ({requirements.size})"
            )
        return kind


class SimulatedTableConfig(BackendConfig):
    """Simulated machine: servo, payload reaction and the true specimen on it."""

    hydraulic: HydraulicTableConfig | None = Field(
        None, description="A hydraulic table; omitted: an ideal servo of a bandwidth."
    )
    servo_bandwidth_hz: Positive | None = Field(
        None,
        validate_default=True,
        description="-3 dB of the closed displacement loop of an ideal servo.",
    )
    servo_delay_ms: NonNegative = Field(description="Delay from the output to the servo.")
    moving_mass_kg: Positive = Field(description="Moving mass of the table without payload.")
    payload_reaction: bool = Field(
        True, description="Whether the force of the specimen moves the table."
    )
    seed: int = Field(0, description="Seed of the noise.")
    damper_stiffness_n_m: Positive = Field(description="True stiffness of the damper.")
    damper_damping_n_s_m: NonNegative = Field(description="True damping of the damper.")
    bumper_stiffness_n_m: Positive = Field(description="True stiffness of each bumper.")
    bumper_damping_n_s_m: Positive = Field(description="True damping of each bumper.")
    faults: tuple[InjectedFault, ...] = ()
    hidden: GroundTruth | None = Field(
        None,
        description="What the model does not know: true parameters (base), effects, imperfections.",
    )
    truth: str | None = Field(
        None, description="The same in a sealed file: its path; relative to the working folder."
    )
    truth_sha256: str | None = Field(
        None,
        pattern=r"^[0-9a-fA-F]{64}$",
        validate_default=True,
        description="SHA-256 of the sealed file.",
    )

    @field_validator("servo_bandwidth_hz")
    @classmethod
    def _check_servo(cls, bandwidth_hz: float | None, info: ValidationInfo) -> float | None:
        if "hydraulic" in info.data and (info.data["hydraulic"] is None) == (bandwidth_hz is None):
            raise InputError(
                "what moves the table is not stated once",
                allowed="servo_bandwidth_hz, or a table [simulated.hydraulic]",
            )
        return bandwidth_hz

    @field_validator("truth_sha256")
    @classmethod
    def _check_truth_pair(cls, sha256: str | None, info: ValidationInfo) -> str | None:
        if "truth" in info.data and (info.data["truth"] is None) != (sha256 is None):
            raise InputError("truth and truth_sha256 go together", remedy="give both or neither")
        if sha256 is not None and info.data.get("hidden") is not None:
            raise InputError("[simulated.hidden] and truth are given", allowed="one of them")
        return sha256

    def list_faults(self, rig: RigConfig) -> list[str]:
        """List channels without a simulated signal, and faults of channels without a sensor."""
        faults = [
            f"the simulated table has no signal for {channel.name}; add `simulated = {{ ... }}` to "
            "its [[channels]] table (factors of canonical channels, or `constant`), or remove its "
            "[[sensors]] table"
            for channel in rig.extra_channels
            if channel.name in rig.channels and channel.simulated is None
        ]
        for fault in self.faults:
            if fault.channel is not None and fault.channel not in rig.channels:
                faults.append(
                    f"fault {fault.kind!r}: the rig has no sensor {fault.channel!r}; "
                    f"{suggest(fault.channel, rig.channels)}"
                )
        return faults
