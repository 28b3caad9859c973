"""TOML files -> validated, frozen models. Every fault of a file stands in one message.

Human units stand in the key names here (`gap_mm`, `start_hz`); the properties hand out SI.
"""

import difflib
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
)

from table_io.channels import BY_NAME
from table_io.records import Step

GRAVITY_M_S2 = 9.80665
PROFILES = Path(__file__).resolve().parent.parent / "profiles"

# Strict: `true` or "0.05" where a number belongs is a slip, not a 1 or a 0.05.
Number = Annotated[float, Field(strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(strict=True)]


class BadInput(ValueError):
    """Something a person must mend: says where, what, what is allowed, what to do. Exit code 2."""


class Card(BaseModel):
    """Base of everything read from a file: no unknown keys, nothing changes afterwards.

    What a value must be beside another one is checked where the later of the two keys is read, from
    the valid ones before it (`info.data`): so a fault elsewhere hides nothing.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)


UNITS: dict[str, tuple[str, float]] = {
    "m": ("m", 1.0), "mm": ("m", 1e-3), "um": ("m", 1e-6),
    "m/s2": ("m/s2", 1.0), "g": ("m/s2", GRAVITY_M_S2),
    "N": ("N", 1.0), "kN": ("N", 1e3),
}  # fmt: skip


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


class Specimen(Card):
    """What stands on the table. Gaps are totals, right plus left; negative = precompressed."""

    mass_kg: Positive
    gap_mm: Number = Field(description="Nominal total gap; inf = no bumpers.")
    gap_right_mm: Number | None = Field(None, description="Measured gap on the right.")
    gap_left_mm: Number | None = Field(
        None, validate_default=True, description="Measured gap on the left."
    )
    temperature_c: Finite | None = None

    @field_validator("gap_mm", "gap_right_mm", "gap_left_mm")
    @classmethod
    def _is_a_gap(cls, gap: float | None, info: ValidationInfo) -> float | None:
        if gap is not None and (math.isnan(gap) or gap == -math.inf):
            raise ValueError(
                f"{info.field_name} is {gap}; allowed: a number of mm, or inf for no bumpers"
            )
        return gap

    @field_validator("gap_left_mm")
    @classmethod
    def _pair(cls, left: float | None, info: ValidationInfo) -> float | None:
        if "gap_right_mm" in info.data and (info.data["gap_right_mm"] is None) != (left is None):
            raise ValueError("gap_right_mm and gap_left_mm go together; give both or neither")
        return left

    @property
    def gaps_m(self) -> tuple[float, float]:
        """(right, left) initial gap in m: the measured ones where stated, else half the nominal."""
        if self.gap_right_mm is None or self.gap_left_mm is None:
            return self.gap_mm / 2e3, self.gap_mm / 2e3
        return self.gap_right_mm / 1e3, self.gap_left_mm / 1e3


class Sweep(Card):
    """Stepped sine of constant peak table acceleration, through the grid up and back down."""

    start_hz: float = Field(ge=0.01, allow_inf_nan=False)
    stop_hz: Positive
    step_hz: Positive
    cycles: Count = Field(ge=2, le=1000, description="Held cycles a step.")
    measured_cycles: Count = Field(
        3, ge=1, validate_default=True, description="The last of them enter the PRC point."
    )
    acceleration_g: Positive = 0.05
    directions: tuple[Literal["forward", "backward"], ...] = ("forward", "backward")
    blend_cycles: Number = Field(1.5, ge=1.5, le=20, description="Least length of a blend.")

    @field_validator("stop_hz")
    @classmethod
    def _upwards(cls, stop: float, info: ValidationInfo) -> float:
        start = info.data.get("start_hz", 0.0)
        if stop < start:
            raise ValueError(
                f"stop_hz {stop} lies below start_hz {start}; give the grid "
                "upwards, `directions` says which way it is driven"
            )
        return stop

    @field_validator("step_hz")
    @classmethod
    def _grid(cls, step: float, info: ValidationInfo) -> float:
        if not {"start_hz", "stop_hz"} <= info.data.keys():
            return step
        start, stop = info.data["start_hz"], info.data["stop_hz"]
        if (stop - start) / step > 5000.5:
            raise ValueError(
                f"step_hz {step} makes more than 5001 steps from {start} to {stop} Hz; "
                f"allowed: at least {(stop - start) / 5000:.6g}"
            )
        whole = round((stop - start) / step)
        if abs(start + whole * step - stop) > 1e-6:
            raise ValueError(
                f"step_hz {step} does not divide {start} to {stop} Hz; "
                f"nearest: {(stop - start) / max(whole, 1):.6g}"
            )
        return step

    @field_validator("measured_cycles")
    @classmethod
    def _held(cls, measured: int, info: ValidationInfo) -> int:
        cycles = info.data.get("cycles", measured)
        if measured > cycles:
            raise ValueError(f"measured_cycles {measured} is more than cycles {cycles}")
        return measured

    @field_validator("directions")
    @classmethod
    def _some(cls, directions: tuple[str, ...]) -> tuple[str, ...]:
        if not directions:
            raise ValueError("directions is empty; allowed: 'forward', 'backward', in any order")
        if len(set(directions)) < len(directions):
            raise ValueError("directions names one twice; allowed: each once, in any order")
        return directions

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """The grid, upwards, each value as written in decimal."""
        whole = round((self.stop_hz - self.start_hz) / self.step_hz)
        return tuple(round(self.start_hz + k * self.step_hz, 9) for k in range(whole + 1))

    @property
    def steps(self) -> tuple[Step, ...]:
        """Every step in the order in which it is driven; both directions on the identical grid."""
        acceleration = self.acceleration_g * GRAVITY_M_S2
        return tuple(
            Step(index, direction, frequency, acceleration)
            for index, (direction, frequency) in enumerate(
                (direction, frequency)
                for direction in self.directions
                for frequency in self.frequencies_hz[:: 1 if direction == "forward" else -1]
            )
        )


class Acquisition(Card):
    """How the streams are sampled."""

    rate_hz: Positive = 2000.0
    block_samples: Count = Field(20, ge=1, le=10000)
    rest_s: Number = Field(0.5, ge=0.2, le=60, description="Recorded rest before and after.")


class ComparisonCard(Card):
    """How model and measurement are compared."""

    window_s: Number = Field(0.25, ge=0.05, le=60, description="Restart from the measured state.")
    contact_n: Positive = Field(10.0, description="A bumper force above this is contact.")


class OnDeath(Card):
    """What the table does when a process beside it dies; it is restarted either way."""

    twin: Literal["continue", "stop"] = "continue"
    recorder: Literal["continue", "stop"] = "continue"
    viewer: Literal["continue", "stop"] = "continue"
    supervisor: Literal["continue", "stop"] = "stop"


class Profile(Card):
    """A test: specimen, sweep, acquisition, comparison."""

    title: str
    citation: str = ""
    notes: str = ""
    rig: str = "simulated"
    model: str = "snm"
    specimen: Specimen
    sweep: Sweep
    acquisition: Acquisition = Field(Acquisition(), validate_default=True)
    comparison: ComparisonCard = ComparisonCard()
    on_death: OnDeath = OnDeath()

    @field_validator("acquisition")
    @classmethod
    def _sampled(cls, acquisition: Acquisition, info: ValidationInfo) -> Acquisition:
        sweep = info.data.get("sweep")
        if sweep is not None and acquisition.rate_hz < 100 * sweep.stop_hz:
            raise ValueError(
                f"rate_hz {acquisition.rate_hz:g} gives fewer than 100 samples a cycle at "
                f"sweep.stop_hz {sweep.stop_hz:g}; allowed: at least {100 * sweep.stop_hz:g}"
            )
        return acquisition


C = TypeVar("C", bound=Card)


def _known_keys(card: type[BaseModel], where: tuple[int | str, ...]) -> list[str]:
    """Keys allowed at the table that holds the last key of `where`."""
    current: Any = card
    for key in where[:-1]:
        if isinstance(key, int):
            continue
        annotation: Any = current.model_fields[key].annotation
        stack = [annotation]
        while stack:
            item = stack.pop()
            if isinstance(item, type) and issubclass(item, BaseModel):
                current = item
                break
            stack.extend(getattr(item, "__args__", ()))
    return list(current.model_fields)


def _sentence(card: type[BaseModel], error: Any) -> str:
    """One fault in words: key, value, what is allowed, what to do."""
    where: tuple[int | str, ...] = error["loc"]
    key = ".".join(str(part) for part in where) or "file"
    if error["type"] == "extra_forbidden":
        known = _known_keys(card, where)
        near = difflib.get_close_matches(str(where[-1]), known, 1, 0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        return f"{key}: unknown key; {hint}"
    if error["type"] == "missing":
        return f"{key}: missing; add it"
    message = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] == "value_error":
        return f"{key}: {message}"
    return f"{key} = {error['input']!r}: {message[0].lower()}{message[1:]}"


def parse(text: str, card: type[C], where: str) -> C:
    """A validated card from TOML text; BadInput with every fault of it, `where` names the file."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"{where}: not valid TOML: {error}. Mend the line it names.") from None
    try:
        return card.model_validate(raw)
    except ValidationError as error:
        faults = [_sentence(card, one) for one in error.errors(include_url=False)]
        raise BadInput("\n".join([f"{where}:", *(f"  {fault}" for fault in faults)])) from None


def read_text(path: Path, what: str) -> str:
    """The file's text; BadInput says what kind of file was wanted and what lies near it."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        there = sorted(other.name for other in path.parent.glob("*.toml"))
        hint = f"there: {', '.join(there)}" if there else "give the path of a TOML file"
        raise BadInput(f"{path}: no such {what}; {hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot read this {what}: {error}") from None


def find(name: str, folder: str, beside: Path | None = None) -> Path:
    """Path of the card `name`: a path, or a name in `folder`, beside a profile or ours."""
    direct = Path(name)
    if direct.suffix == ".toml":
        by_profile = beside.parent / direct if beside is not None else direct
        return by_profile if by_profile.is_file() else direct
    places = [PROFILES / folder]
    if beside is not None:
        places.insert(0, beside.resolve().parent.parent / folder)
    for place in places:
        if (place / f"{name}.toml").is_file():
            return place / f"{name}.toml"
    known = sorted({path.stem for place in places for path in place.glob("*.toml")})
    near = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    where = f"{beside}: " if beside is not None else ""
    raise BadInput(
        f"{where}{name}: not found in {folder}; {hint}known: {', '.join(known) or 'none'}; "
        "or give the path of a .toml file"
    )


def load(path: Path, card: type[C], what: str) -> tuple[C, str]:
    """(validated card, the file's text)."""
    text = read_text(path, what)
    return parse(text, card, str(path)), text
