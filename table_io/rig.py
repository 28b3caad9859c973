"""The machine card: a table, what it can do, its output, its sensors.

Human units stand in the key names here (`span_mm`, `lead_s`); the properties hand out SI.
"""

import difflib
from typing import Literal, NamedTuple

from pydantic import Field, ValidationInfo, field_validator

from table_io.calibration_record import Calibration
from table_io.card import BadInput, Card, Finite, NonNegative, Number, Positive
from table_io.sensor import Sensor
from table_io.wiring.follow import FollowWiring
from table_io.wiring.ni import NiWiring
from table_io.wiring.opendaq import OpenDaqWiring
from table_io.wiring.udp import UdpWiring


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


class FaultKind(NamedTuple):
    """What a card of this kind says: a channel or not, a size or not ("": none), how it lasts."""

    channel: bool
    size: str
    lasts: Literal["must", "may", "no"]  # for_s is needed, allowed (none: for ever), not allowed


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


class PlantedFault(Card):
    """Something that goes wrong in the simulated machine; `backends/faults.py` says what each is.

    The keys that a kind does not use are left out.
    """

    at_s: NonNegative = Field(description="From the start of the run.")
    for_s: Positive | None = None
    channel: str | None = None
    size: Finite | None = None
    kind: str = Field(description="Last: the others are judged by it.")

    @field_validator("kind")
    @classmethod
    def _complete(cls, kind: str, info: ValidationInfo) -> str:
        if kind not in FAULT_KINDS:
            near = difflib.get_close_matches(kind, FAULT_KINDS, 1, 0.4)
            raise ValueError(
                f"kind {kind!r} is unknown"
                + (f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(FAULT_KINDS)}")
            )
        needs = FAULT_KINDS[kind]
        keys = (
            ("channel", needs.channel, needs.channel, "one of the rig's sensors"),
            ("size", bool(needs.size), bool(needs.size), needs.size),
            ("for_s", needs.lasts == "must", needs.lasts != "no", "seconds"),
        )
        for key, must, may, what in keys:
            given = info.data.get(key) is not None
            if must and key in info.data and not given:
                raise ValueError(f"kind {kind!r} needs {key} ({what}); add it")
            if given and not may:
                raise ValueError(f"kind {kind!r} has no {key}; leave it out")
        size = info.data.get("size")
        if kind in ("late", "oil_loss") and size is not None and size <= 0:
            raise ValueError(f"kind {kind!r} has size {size:g}; allowed: above 0 ({needs.size})")
        return kind


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
    faults: tuple[PlantedFault, ...] = ()
    truth: str | None = Field(None, description="Path of a sealed file: `backends/truth.py`.")
    truth_sha256: str | None = Field(None, pattern=r"^[0-9a-fA-F]{64}$", validate_default=True)

    @field_validator("truth_sha256")
    @classmethod
    def _sealed(cls, sha256: str | None, info: ValidationInfo) -> str | None:
        if "truth" in info.data and (info.data["truth"] is None) != (sha256 is None):
            raise ValueError("truth and truth_sha256 go together; give both or neither")
        return sha256


class Machine(Card):
    """A machine in a process of its own: `shaketwin table` plays its [simulated] table."""

    endpoint: str = Field(description="tcp/127.0.0.1:PORT or unix/PATH; this computer only.")


class Rig(Card):
    """Machine card: a table, its limits, its output and its sensors."""

    name: str = Field(pattern=r"^[a-z0-9_]+$")
    title: str
    backend: Literal["simulated", "machine", "ni", "opendaq", "udp", "follow"]
    rates_hz: tuple[Positive, ...] = Field(min_length=1)
    moving_mass_kg: Positive = Field(description="Table without payload, for the force margin.")
    limits: Limits
    output: Output
    sensors: tuple[Sensor, ...] = Field(min_length=1)
    simulated: SimulatedTable | None = Field(None, validate_default=True)
    machine: Machine | None = Field(None, validate_default=True)
    ni: NiWiring | None = Field(None, validate_default=True)
    opendaq: OpenDaqWiring | None = Field(None, validate_default=True)
    udp: UdpWiring | None = Field(None, validate_default=True)
    follow: FollowWiring | None = Field(None, validate_default=True)
    calibrations: tuple[Calibration, ...] = Field(
        (), description="Records of `shaketwin calibrate`, as they lie beside the card."
    )

    @field_validator("sensors")
    @classmethod
    def _complete(cls, sensors: tuple[Sensor, ...], info: ValidationInfo) -> tuple[Sensor, ...]:
        names = [sensor.channel for sensor in sensors]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise ValueError(
                f"sensors name {', '.join(twice)} more than once; one sensor a channel"
            )
        missing = {"drive_disp_m", "table_disp_m", "table_acc_m_s2"} - set(names)
        if info.data.get("backend") == "follow":
            missing -= {"drive_disp_m"}  # a controller may show its command to nobody
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
    def _reached(cls, table: Card | None, info: ValidationInfo) -> Card | None:
        if table is None and info.data.get("backend") == info.field_name:
            raise ValueError(
                f"backend {info.field_name!r} needs a [{info.field_name}] table: what is wired "
                "where; see CONNECT.md"
            )
        if isinstance(table, FollowWiring) and info.data.get("backend") == "follow":
            if info.data.get(table.source) is None:
                raise ValueError(
                    f"source {table.source!r} needs a [{table.source}] table: who acquires what"
                )
            wired = [sensor.channel for sensor in info.data.get("sensors", ())]
            if wired and table.command not in wired:
                raise ValueError(
                    f"command {table.command!r} is no sensor of the card; allowed: one of them, "
                    "table_disp_m where no command is wired"
                )
        return table

    @property
    def any_speed(self) -> bool:
        """True where any clock may pace the machine: it is simulated in the rig's own process."""
        return self.backend == "simulated"

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(sensor.channel for sensor in self.sensors)

    def refuse_rate(self, rate_hz: float) -> None:
        """BadInput where the rig does not sample at this rate."""
        if rate_hz not in self.rates_hz:
            allowed = ", ".join(f"{rate:g}" for rate in self.rates_hz)
            raise BadInput(
                f"acquisition.rate_hz = {rate_hz:g}: rig {self.name} does not sample so; "
                f"allowed: {allowed}"
            )
