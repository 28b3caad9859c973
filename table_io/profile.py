"""TOML files -> validated, frozen models. Every fault of a file stands in one message.

Human units stand in the key names here (`gap_mm`, `start_hz`); the properties hand out SI.
"""

import difflib
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from table_io.channels import BY_NAME
from table_io.records import Step

GRAVITY_M_S2 = 9.80665
PROFILES = Path(__file__).resolve().parent.parent / "profiles"

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class BadInput(ValueError):
    """Something a person must mend: says where, what, what is allowed, what to do. Exit code 2."""


class Card(BaseModel):
    """Base of everything read from a file: no unknown keys, nothing changes afterwards."""

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

    @model_validator(mode="after")
    def _unit_fits(self) -> "Sensor":
        if self.channel not in BY_NAME:
            near = difflib.get_close_matches(self.channel, BY_NAME, 1)
            raise ValueError(
                f"channel {self.channel!r} is unknown"
                + (f"; did you mean {near[0]!r}?" if near else f"; known: {', '.join(BY_NAME)}")
            )
        want = BY_NAME[self.channel].unit
        allowed = [name for name, (si, _) in UNITS.items() if si == want]
        if self.unit not in allowed:
            raise ValueError(
                f"unit {self.unit!r} does not measure {self.channel} ({want}); "
                f"allowed: {', '.join(allowed)}"
            )
        if self.volts_per_unit == 0:
            raise ValueError("volts_per_unit is 0, so the channel would be silent; allowed: not 0")
        return self

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
    lead_s: float = Field(0.5, ge=0.2, le=5.0, description="Checked command queued ahead.")
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
    simulated: SimulatedTable | None = None

    @model_validator(mode="after")
    def _whole(self) -> "Rig":
        names = [sensor.channel for sensor in self.sensors]
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
        if self.backend == "simulated" and self.simulated is None:
            raise ValueError(
                "backend 'simulated' needs a [simulated] table with servo and specimen"
            )
        return self

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(sensor.channel for sensor in self.sensors)


class Specimen(Card):
    """What stands on the table. Gaps are totals, right plus left; negative = precompressed."""

    mass_kg: Positive
    gap_mm: float = Field(description="Nominal total gap; inf = no bumpers.")
    gap_right_mm: float | None = Field(None, description="Measured gap on the right.")
    gap_left_mm: float | None = Field(None, description="Measured gap on the left.")
    temperature_c: Finite | None = None

    @model_validator(mode="after")
    def _gaps(self) -> "Specimen":
        for key in ("gap_mm", "gap_right_mm", "gap_left_mm"):
            gap = getattr(self, key)
            if gap is not None and (math.isnan(gap) or gap == -math.inf):
                raise ValueError(f"{key} is {gap}; allowed: a number of mm, or inf for no bumpers")
        if (self.gap_right_mm is None) != (self.gap_left_mm is None):
            raise ValueError("gap_right_mm and gap_left_mm go together; give both or neither")
        return self

    @property
    def gaps_m(self) -> tuple[float, float]:
        """(right, left) initial gap in m: the measured ones where stated, else half the nominal."""
        if self.gap_right_mm is None or self.gap_left_mm is None:
            return self.gap_mm / 2e3, self.gap_mm / 2e3
        return self.gap_right_mm / 1e3, self.gap_left_mm / 1e3


class Sweep(Card):
    """Stepped sine of constant peak table acceleration, through the grid up and back down."""

    start_hz: Positive
    stop_hz: Positive
    step_hz: Positive
    cycles: int = Field(ge=2, le=1000, description="Held cycles a step.")
    measured_cycles: int = Field(3, ge=1, description="The last of them enter the PRC point.")
    acceleration_g: Positive = 0.05
    directions: tuple[Literal["forward", "backward"], ...] = ("forward", "backward")
    blend_cycles: float = Field(1.5, ge=1.5, le=20, description="Least length of a blend.")

    @model_validator(mode="after")
    def _grid(self) -> "Sweep":
        if self.stop_hz < self.start_hz:
            raise ValueError(
                f"stop_hz {self.stop_hz} lies below start_hz {self.start_hz}; give the grid "
                "upwards, `directions` says which way it is driven"
            )
        whole = round((self.stop_hz - self.start_hz) / self.step_hz)
        if abs(self.start_hz + whole * self.step_hz - self.stop_hz) > 1e-6:
            raise ValueError(
                f"step_hz {self.step_hz} does not divide {self.start_hz} to {self.stop_hz} Hz; "
                f"nearest: {(self.stop_hz - self.start_hz) / max(whole, 1):.6g}"
            )
        if whole > 5000:
            raise ValueError(f"the grid has {whole + 1} steps; allowed: at most 5001")
        if self.measured_cycles > self.cycles:
            raise ValueError(
                f"measured_cycles {self.measured_cycles} is more than cycles {self.cycles}"
            )
        if not self.directions:
            raise ValueError("directions is empty; allowed: 'forward', 'backward', in any order")
        return self

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
    block_samples: int = Field(20, ge=1, le=10000)
    rest_s: float = Field(0.5, ge=0.2, le=60, description="Recorded rest before and after.")


class ComparisonCard(Card):
    """How model and measurement are compared."""

    window_s: float = Field(0.25, ge=0.05, le=60, description="Restart from the measured state.")
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
    acquisition: Acquisition = Acquisition()
    comparison: ComparisonCard = ComparisonCard()
    on_death: OnDeath = OnDeath()

    @model_validator(mode="after")
    def _sampled(self) -> "Profile":
        if self.acquisition.rate_hz < 100 * self.sweep.stop_hz:
            raise ValueError(
                f"acquisition.rate_hz {self.acquisition.rate_hz:g} gives fewer than 100 samples a "
                f"cycle at sweep.stop_hz {self.sweep.stop_hz:g}; allowed: at least "
                f"{100 * self.sweep.stop_hz:g}"
            )
        return self


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
        return direct
    places = [PROFILES / folder]
    if beside is not None:
        places.insert(0, beside.resolve().parent.parent / folder)
    for place in places:
        if (place / f"{name}.toml").is_file():
            return place / f"{name}.toml"
    known = sorted({path.stem for place in places for path in place.glob("*.toml")})
    near = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise BadInput(
        f"{name}: not found in {folder}; {hint}known: {', '.join(known) or 'none'}; "
        "or give the path of a .toml file"
    )


def load(path: Path, card: type[C], what: str) -> tuple[C, str]:
    """(validated card, the file's text)."""
    text = read_text(path, what)
    return parse(text, card, str(path)), text
