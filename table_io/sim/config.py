"""Section `[simulated]` of a rig file: the simulated table, its specimen and injected faults.

`hydraulic_table.py` states the equations of `[simulated.hydraulic]`.
"""

import math
from typing import Annotated, Literal, NamedTuple

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import ConfigModel, Finite, NonNegative, Positive, require_both
from table_io.config.rig import BackendConfig, RigConfig
from table_io.errors import InputError, suggest
from table_io.sim.ground_truth import GroundTruth

Percent = Annotated[float, Field(ge=0.0, le=20.0)]
Share = Annotated[float, Field(gt=-0.9, lt=0.9)]
Slope = Annotated[float, Field(ge=-1000.0, le=1000.0)]
# Time constants that the sub-step of the integrator, 32 us, still resolves.
MIN_TRANSDUCER_LAG_MS, MAX_FREQUENCY_HZ = 0.2, 1000.0


class HydraulicTableConfig(ConfigModel):
    """Servo valve, actuator, friction, controller and frame of a hydraulic table."""

    piston_area_cm2: Positive = Field(description="Effective area of the piston, A.")
    oil_volume_cm3: Positive = Field(description="Oil under pressure in both chambers, V.")
    bulk_modulus_mpa: Positive = Field(description="Effective bulk modulus of the oil, B.")
    supply_pressure_mpa: Positive = Field(description="Supply above the return, P.")
    leakage_l_min_mpa: NonNegative = Field(description="Leakage across the piston, L.")
    rated_flow_l_min: Positive = Field(
        description="Flow of the open valve, Q_r, at the drop below."
    )
    rated_drop_mpa: Positive = Field(7.0, description="Pressure drop of the rated flow, P_r.")
    valve_frequency_hz: Positive = Field(description="Natural frequency of the spool; -90 degrees.")
    valve_damping: Positive = Field(description="Damping ratio of the spool, z.")
    friction_n: NonNegative = Field(description="Friction in motion, F_c.")
    static_friction_n: NonNegative = Field(description="Friction that must be overcome, F_s.")
    stribeck_speed_m_s: Positive = Field(0.01, description="Speed of the fall to F_c, v_s.")
    stick_stiffness_n_m: Positive = Field(2.5e7, description="Stiffness while it sticks, s0.")
    stick_damping_n_s_m: NonNegative = Field(2.0e4, description="Damping while it sticks, s1.")
    viscous_friction_n_s_m: NonNegative = Field(description="Viscous friction, c.")
    gain_1_s: Positive = Field(description="Gain of the stroke loop: speed over error, k.")
    velocity_feedforward: NonNegative = Field(
        description="Feed-forward of the command's speed, k_ff; 1 in full."
    )
    pressure_feedback: NonNegative = Field(
        description="Valve opening that the supply pressure takes back as load pressure, k_p."
    )
    pressure_corner_hz: Positive = Field(
        1.0, description="Below it the load pressure is not fed back, 1 / (2 pi t_p)."
    )
    frame_mass_kg: Positive = Field(description="Mass of the frame that bears the actuator, m_f.")
    frame_frequency_hz: Positive = Field(description="Its natural frequency, w_f / (2 pi).")
    frame_damping: NonNegative = Field(description="Its damping ratio, z_f.")
    valve_overlap_percent: Percent = Field(
        0.0, description="Overlap of the spool on either side, of its travel; no flow within it."
    )
    valve_hysteresis_percent: Percent = Field(
        0.0, description="Width of the valve's hysteresis loop, of its travel."
    )
    flow_asymmetry: Share = Field(
        0.0, description="Flow gain more in the positive direction, and less in the negative."
    )
    friction_asymmetry: Share = Field(
        0.0, description="Friction more in the positive direction, and less in the negative."
    )
    friction_slope_1_m: Slope = Field(
        0.0, description="Relative rise of the friction along the stroke, at its centre."
    )
    friction_drift_1_s: Finite = Field(
        0.0,
        description="Relative change of the friction per second from the start of the simulated "
        "table, linear: it grows without limit, or falls to a twentieth; warm oil: it falls.",
    )
    coupling_play_mm: NonNegative = Field(
        0.0, description="Play between piston and table, from stop to stop."
    )
    coupling_stiffness_n_m: Positive = Field(
        2e8, description="Stiffness of its stops; used with play only."
    )
    piston_mass_kg: Positive = Field(
        40.0, validate_default=True, description="Piston and rod; used with play only."
    )
    transducer_gain_error: Share = Field(
        0.0, description="Gain error of the transducer that closes the stroke loop."
    )
    transducer_lag_ms: NonNegative = Field(
        0.0, description="Delay of its filter, of two equal first-order stages."
    )
    attached_mass_kg: NonNegative = Field(
        0.0, description="Mass attached to the frame, m_a: a floor or a wall that moves with it."
    )
    attached_frequency_hz: Positive = Field(
        30.0, validate_default=True, description="Its frequency on a fixed frame."
    )
    attached_damping: NonNegative = Field(0.05, description="Its damping ratio on a fixed frame.")

    @field_validator("static_friction_n")
    @classmethod
    def _check_static_friction(cls, static_n: float, info: ValidationInfo) -> float:
        if static_n < info.data.get("friction_n", 0.0):
            raise InputError("static_friction_n is below friction_n", allowed="at least friction_n")
        return static_n

    @field_validator("transducer_lag_ms")
    @classmethod
    def _check_lag(cls, lag_ms: float) -> float:
        if 0.0 < lag_ms < MIN_TRANSDUCER_LAG_MS:
            raise InputError(
                "transducer_lag_ms is too short for the integrator",
                allowed=f"0, or at least {MIN_TRANSDUCER_LAG_MS:g}",
            )
        return lag_ms

    @field_validator("piston_mass_kg")
    @classmethod
    def _check_stops(cls, piston_kg: float, info: ValidationInfo) -> float:
        stiffness_n_m = info.data.get("coupling_stiffness_n_m", 0.0)
        stop_hz = math.sqrt(stiffness_n_m / piston_kg) / math.tau
        if info.data.get("coupling_play_mm", 0.0) > 0.0 and stop_hz > MAX_FREQUENCY_HZ:
            raise InputError(
                f"the piston between its stops, at {stop_hz:.4g} Hz, is too fast to integrate",
                allowed=f"at most {MAX_FREQUENCY_HZ:g} Hz",
                remedy="lower coupling_stiffness_n_m or raise piston_mass_kg",
            )
        return piston_kg

    @field_validator("attached_frequency_hz")
    @classmethod
    def _check_attached(cls, frequency_hz: float, info: ValidationInfo) -> float:
        attached_kg = info.data.get("attached_mass_kg", 0.0)
        # Of mass and frame against each other; on a fixed frame it is lower.
        frame_kg = info.data.get("frame_mass_kg", math.inf)
        free_hz = frequency_hz * math.sqrt(1.0 + attached_kg / frame_kg)
        if attached_kg > 0.0 and free_hz > MAX_FREQUENCY_HZ:
            raise InputError(
                f"the attached mass against the frame, at {free_hz:.4g} Hz, is too fast to "
                "integrate",
                allowed=f"at most {MAX_FREQUENCY_HZ:g} Hz",
                remedy="lower attached_frequency_hz or attached_mass_kg",
            )
        return frequency_hz


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
    tares_as_set_up: bool = Field(
        False,
        description="Whether bumpers that press on the mass do so in a tare too, as on a real "
        "table; else a tare answers as if they were clear.",
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
        require_both("truth_sha256", sha256, "truth", info)
        if sha256 is not None and info.data.get("hidden") is not None:
            raise InputError("[simulated.hidden] and truth are given", allowed="one of them")
        return sha256

    @property
    def tares_without_bumpers(self) -> bool:
        """True if a tare is the truth of clear bumpers."""
        return not self.tares_as_set_up

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
