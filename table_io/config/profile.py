"""Test profile: specimen, sweep, acquisition, comparison, control and protection.

Keys carry their unit in the name (`gap_mm`, `start_hz`); properties return SI.
"""

import math
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.adaptive import DwellConfig, RefineConfig, SweepGrid, TrackConfig
from table_io.config.base import ConfigModel, Count, Finite, Number, Positive
from table_io.records import Step
from table_io.units import GRAVITY_M_S2


class Specimen(ConfigModel):
    """Specimen on the table. `gap_mm` is the total, right plus left; negative = precompressed."""

    mass_kg: Positive
    gap_mm: Number = Field(description="Nominal total gap; inf = no bumpers.")
    gap_right_mm: Number | None = Field(None, description="Measured gap on the right.")
    gap_left_mm: Number | None = Field(
        None, validate_default=True, description="Measured gap on the left."
    )
    temperature_c: Finite | None = None

    @field_validator("gap_mm", "gap_right_mm", "gap_left_mm")
    @classmethod
    def _check_gap(cls, gap: float | None, info: ValidationInfo) -> float | None:
        if gap is not None and (math.isnan(gap) or gap == -math.inf):
            raise ValueError(
                f"{info.field_name} is {gap}; allowed: a number in mm, or inf for no bumpers"
            )
        return gap

    @field_validator("gap_left_mm")
    @classmethod
    def _check_gap_pair(cls, left: float | None, info: ValidationInfo) -> float | None:
        if "gap_right_mm" in info.data and (info.data["gap_right_mm"] is None) != (left is None):
            raise ValueError("gap_right_mm and gap_left_mm go together; give both or neither")
        return left

    @property
    def gaps_m(self) -> tuple[float, float]:
        """Initial gaps (right, left) in m: the measured ones if given, else half the nominal."""
        if self.gap_right_mm is None or self.gap_left_mm is None:
            return self.gap_mm / 2e3, self.gap_mm / 2e3
        return self.gap_right_mm / 1e3, self.gap_left_mm / 1e3


class Sweep(ConfigModel):
    """Stepped sine sweep of constant peak table acceleration, up and down one frequency grid."""

    start_hz: float = Field(ge=0.01, allow_inf_nan=False)
    stop_hz: Positive
    step_hz: Positive
    cycles: Count = Field(ge=2, le=1000, description="Held cycles per step.")
    measured_cycles: Count = Field(
        3, ge=1, validate_default=True, description="Last held cycles, which enter the PRC point."
    )
    acceleration_g: Positive = 0.05
    directions: tuple[Literal["forward", "backward"], ...] = ("forward", "backward")
    blend_cycles: Number = Field(1.5, ge=1.5, le=20, description="Shortest blend between steps.")

    @field_validator("stop_hz")
    @classmethod
    def _check_ascending(cls, stop: float, info: ValidationInfo) -> float:
        start = info.data.get("start_hz", 0.0)
        if stop < start:
            raise ValueError(
                f"stop_hz {stop} lies below start_hz {start}; give the grid in "
                "ascending order and set the order of the sweep in `directions`"
            )
        return stop

    @field_validator("step_hz")
    @classmethod
    def _check_step(cls, step: float, info: ValidationInfo) -> float:
        if not {"start_hz", "stop_hz"} <= info.data.keys():
            return step
        start, stop = info.data["start_hz"], info.data["stop_hz"]
        if (stop - start) / step > 5000.5:
            raise ValueError(
                f"step_hz {step} makes more than 5001 steps from {start} to {stop} Hz; "
                f"allowed: at least {(stop - start) / 5000:.6g}"
            )
        step_count = round((stop - start) / step)
        if abs(start + step_count * step - stop) > 1e-6:
            raise ValueError(
                f"step_hz {step} does not divide {start} to {stop} Hz; "
                f"nearest: {(stop - start) / max(step_count, 1):.6g}"
            )
        return step

    @field_validator("measured_cycles")
    @classmethod
    def _check_measured_cycles(cls, measured: int, info: ValidationInfo) -> int:
        cycles = info.data.get("cycles", measured)
        if measured > cycles:
            raise ValueError(f"measured_cycles {measured} is more than cycles {cycles}; reduce it")
        return measured

    @field_validator("directions")
    @classmethod
    def _check_directions(cls, directions: tuple[str, ...]) -> tuple[str, ...]:
        if not directions:
            raise ValueError("directions is empty; allowed: 'forward', 'backward', in any order")
        if len(set(directions)) < len(directions):
            raise ValueError("directions contains one twice; allowed: each once, in any order")
        return directions

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Frequency grid in Hz, ascending, rounded to the decimal value."""
        step_count = round((self.stop_hz - self.start_hz) / self.step_hz)
        return tuple(round(self.start_hz + k * self.step_hz, 9) for k in range(step_count + 1))

    @property
    def steps(self) -> tuple[Step, ...]:
        """All planned steps in driving order; both directions use the identical grid."""
        acceleration = self.acceleration_g * GRAVITY_M_S2
        return tuple(
            Step(index, direction, frequency, acceleration)
            for index, (direction, frequency) in enumerate(
                (direction, frequency)
                for direction in self.directions
                for frequency in self.frequencies_hz[:: 1 if direction == "forward" else -1]
            )
        )


class AcquisitionConfig(ConfigModel):
    """Sampling rate, block length and recorded rest."""

    rate_hz: Positive = 2000.0
    block_samples: Count = Field(20, ge=1, le=10000)
    rest_s: Number = Field(0.5, ge=0.2, le=60, description="Recorded rest before and after.")


class ComparisonConfig(ConfigModel):
    """Settings of the comparison of model and measurement."""

    window_s: Number = Field(0.25, ge=0.05, le=60, description="Time between restarts.")
    contact_n: Positive = Field(10.0, description="Bumper force above which it is in contact.")


class OnDeathConfig(ConfigModel):
    """Reaction of the test to the death of a helper process, which is restarted either way."""

    twin: Literal["continue", "stop"] = "continue"
    recorder: Literal["continue", "stop"] = "continue"
    viewer: Literal["continue", "stop"] = "continue"
    supervisor: Literal["continue", "stop"] = "stop"


class LoopCheckConfig(ConfigModel):
    """Loop check at low level before every run, and the rest after it."""

    enabled: bool = True
    level: Number = Field(0.1, gt=0, le=0.1, description="Share of the test's acceleration.")
    cycles: Count = Field(5, ge=3, le=50, description="Held cycles at each frequency.")
    frequencies_hz: tuple[Positive, ...] = Field(
        (), max_length=10, description="Empty: three between the ends of the sweep."
    )
    rest_s: Number = Field(5.0, ge=5.0, le=60, description="Rest after the check.")


class ControlConfig(ConfigModel):
    """Amplitude control: correction of the command before the measured cycles of a step."""

    enabled: bool = True
    tolerance: Number = Field(0.02, ge=0.002, le=0.1, description="Share of the demanded level.")
    updates: Count = Field(3, ge=1, le=10, description="Largest number per step.")
    gain: Number = Field(0.8, ge=0.1, le=1.0, description="Share of an error corrected at once.")
    clamp_db: Number = Field(2.0, gt=0, le=6.0, description="Largest change per update.")
    harmonics: bool = Field(False, description="Cancel the table's harmonics 2 to 5.")
    harmonic_updates: Count = Field(5, ge=1, le=10)


class ProtectionConfig(ConfigModel):
    """Protection bands and reaction to sensor faults; the rig file holds the machine limits."""

    alarm: Number = Field(0.1, gt=0, le=1.0, description="Deviation from the level for an alarm.")
    abort_db: Number = Field(6.0, gt=0, le=12.0, description="Deviation from the level for a stop.")
    sensor: Literal["stop", "warn"] = Field(
        "stop", description="Reaction to a fault of a sensor that the control does not need."
    )


class SetUpConfirmation(ConfigModel):
    """Setup that the operator was asked for before a run, and the operator's confirmation."""

    campaign: str
    label: str
    asked: str
    answer: str
    who: str
    at: str  # ISO 8601
    notes: str = ""


class ResumeConfig(ConfigModel):
    """Continuation of an interrupted test in a separate recording."""

    first_step: Count = Field(ge=0, description="First driven step; steps keep their index.")
    of: str = Field(description="Name of the interrupted run.")


class Profile(ConfigModel):
    """Test profile: everything that defines one test."""

    title: str
    citation: str = ""
    notes: str = ""
    rig: str = "simulated"
    model: str = "snm"
    specimen: Specimen
    sweep: Sweep
    acquisition: AcquisitionConfig = Field(AcquisitionConfig(), validate_default=True)
    comparison: ComparisonConfig = ComparisonConfig()
    loop_check: LoopCheckConfig = LoopCheckConfig()
    control: ControlConfig = ControlConfig()
    protection: ProtectionConfig = ProtectionConfig()
    on_death: OnDeathConfig = OnDeathConfig()
    dwell: DwellConfig | None = None
    track: TrackConfig | None = None
    refine: RefineConfig | None = None
    set_up: SetUpConfirmation | None = None
    resume: ResumeConfig | None = None

    @property
    def first_step(self) -> int:
        """Index of the first driven step."""
        return self.resume.first_step if self.resume is not None else 0

    @field_validator("dwell", "track", "refine")
    @classmethod
    def _check_adaptive(
        cls, tool: DwellConfig | TrackConfig | RefineConfig | None, info: ValidationInfo
    ) -> DwellConfig | TrackConfig | RefineConfig | None:
        tables = [name for name in ("dwell", "track") if info.data.get(name) is not None]
        if tool is not None and tables:
            raise ValueError(f"[{tables[0]}] is given too; allowed: one of dwell, track, refine")
        sweep = info.data.get("sweep")
        if tool is not None and sweep is not None:
            tool.check_sweep(SweepGrid(sweep.start_hz, sweep.stop_hz, sweep.step_hz))
        return tool

    @field_validator("resume")
    @classmethod
    def _check_resume(
        cls, resume: ResumeConfig | None, info: ValidationInfo
    ) -> ResumeConfig | None:
        sweep = info.data.get("sweep")
        if resume is not None and sweep is not None and resume.first_step >= len(sweep.steps):
            raise ValueError(
                f"first_step {resume.first_step} is beyond the last step; allowed: 0 to "
                f"{len(sweep.steps) - 1}"
            )
        return resume

    @field_validator("acquisition")
    @classmethod
    def _check_rate(cls, acquisition: AcquisitionConfig, info: ValidationInfo) -> AcquisitionConfig:
        sweep = info.data.get("sweep")
        if sweep is not None and acquisition.rate_hz < 100 * sweep.stop_hz:
            raise ValueError(
                f"rate_hz {acquisition.rate_hz:g} gives fewer than 100 samples per cycle at "
                f"sweep.stop_hz {sweep.stop_hz:g}; allowed: at least {100 * sweep.stop_hz:g}"
            )
        return acquisition
