"""The test profile: specimen, sweep, acquisition, comparison.

Human units stand in the key names here (`gap_mm`, `start_hz`); the properties hand out SI.
"""

import math
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.card import Card, Count, Finite, Number, Positive
from table_io.records import Step
from table_io.tool_cards import Dwell, Grid, Refine, Track
from table_io.units import GRAVITY_M_S2


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


class LoopCheck(Card):
    """The loop check at low level that comes before every run, and the rest after it."""

    enabled: bool = True
    level: Number = Field(0.1, gt=0, le=0.1, description="Of the test's acceleration.")
    cycles: Count = Field(5, ge=3, le=50, description="Held cycles at each frequency.")
    frequencies_hz: tuple[Positive, ...] = Field(
        (), max_length=10, description="None: three between the sweep's ends."
    )
    rest_s: Number = Field(5.0, ge=5.0, le=60, description="Of rest after it.")


class Control(Card):
    """How the demanded level is reached: the command is corrected before the measured cycles."""

    enabled: bool = True
    tolerance: Number = Field(0.02, ge=0.002, le=0.1, description="Of the demanded level.")
    updates: Count = Field(3, ge=1, le=10, description="At a step, at most.")
    gain: Number = Field(0.8, ge=0.1, le=1.0, description="Share of an error that is corrected.")
    clamp_db: Number = Field(2.0, gt=0, le=6.0, description="Most that one update may change.")
    harmonics: bool = Field(False, description="Cancel the table's harmonics 2 to 5.")
    harmonic_updates: Count = Field(5, ge=1, le=10)


class Protection(Card):
    """Tracked bands and what a broken sensor does; the machine card holds the limits."""

    alarm: Number = Field(0.1, gt=0, le=1.0, description="Of the level: an alarm beyond it.")
    abort_db: Number = Field(6.0, gt=0, le=12.0, description="From the level: beyond it a stop.")
    sensor: Literal["stop", "warn"] = Field(
        "stop", description="At a fault of a sensor that the controller does not need."
    )


class SetUp(Card):
    """What an operator was asked to do before a run, and who said that it was done."""

    campaign: str
    label: str
    asked: str
    answer: str
    who: str
    at: str  # ISO 8601
    notes: str = ""


class Resume(Card):
    """Where a test that was interrupted goes on, in a recording of its own."""

    first_step: Count = Field(ge=0, description="The first that is driven; steps keep their index.")
    of: str = Field(description="The run that was interrupted.")


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
    loop_check: LoopCheck = LoopCheck()
    control: Control = Control()
    protection: Protection = Protection()
    on_death: OnDeath = OnDeath()
    dwell: Dwell | None = None
    track: Track | None = None
    refine: Refine | None = None
    set_up: SetUp | None = None
    resume: Resume | None = None

    @property
    def first_step(self) -> int:
        """Place of the first step that is driven."""
        return self.resume.first_step if self.resume is not None else 0

    @field_validator("dwell", "track", "refine")
    @classmethod
    def _one_tool(
        cls, tool: Dwell | Track | Refine | None, info: ValidationInfo
    ) -> Dwell | Track | Refine | None:
        others = [name for name in ("dwell", "track") if info.data.get(name) is not None]
        if tool is not None and others:
            raise ValueError(f"[{others[0]}] is there too; allowed: one of dwell, track, refine")
        sweep = info.data.get("sweep")
        if tool is not None and sweep is not None:
            tool.fits(Grid(sweep.start_hz, sweep.stop_hz, sweep.step_hz))
        return tool

    @field_validator("resume")
    @classmethod
    def _within(cls, resume: Resume | None, info: ValidationInfo) -> Resume | None:
        sweep = info.data.get("sweep")
        if resume is not None and sweep is not None and resume.first_step >= len(sweep.steps):
            raise ValueError(
                f"first_step {resume.first_step} is beyond the last step; allowed: 0 to "
                f"{len(sweep.steps) - 1}"
            )
        return resume

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
