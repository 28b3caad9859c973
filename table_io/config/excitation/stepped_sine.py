"""Stepped sine: held sine steps of stated peak acceleration, up and down a frequency grid.

The level is constant, or follows break points over frequency, and a schedule of levels repeats the
sweep, from the lowest level to the full one, say. The table [sweep] of a profile is this kind under
its older name.
"""

from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D
from table_io.config.base import Count, Finite, Number, Positive
from table_io.config.excitation import (
    MIN_BLEND_CYCLES,
    Excitation,
    ExcitationPlan,
    register_excitation,
)
from table_io.config.excitation.waveform import LevelPoints, check_points_in_band, interpolate_level
from table_io.errors import InputError
from table_io.records import Step
from table_io.units import GRAVITY_M_S2

MIN_LEVEL_DB, MAX_LEVEL_DB = -60.0, 20.0  # of a schedule


@register_excitation("stepped_sine")
class Sweep(Excitation):
    """Stepped sine sweep of stated peak table acceleration, up and down one frequency grid."""

    MIN_SAMPLES_PER_CYCLE: ClassVar[float] = 100.0

    start_hz: float = Field(ge=0.01, allow_inf_nan=False, description="Lowest frequency.")
    stop_hz: Positive = Field(description="Highest frequency.")
    step_hz: Positive = Field(description="Step of the grid; it divides the range.")
    cycles: Count = Field(ge=2, le=1000, description="Held cycles per step.")
    measured_cycles: Count = Field(
        3, ge=1, validate_default=True, description="Last held cycles, which enter the PRC point."
    )
    acceleration_g: Positive = Field(
        0.05, description="Peak table acceleration, the same at every frequency."
    )
    level_points: LevelPoints = Field(
        (),
        max_length=100,
        description="Instead of acceleration_g: [[frequency in Hz, level in g], ...], "
        "interpolated in logarithms.",
    )
    schedule_db: tuple[Finite, ...] = Field(
        (),
        max_length=10,
        description="Levels of whole sweeps one after another, relative to the stated one: "
        "[-12, -6, 0]; empty: one sweep.",
    )
    directions: tuple[Literal["forward", "backward"], ...] = Field(
        ("forward", "backward"), description="Order of the passes over the grid."
    )
    blend_cycles: Number = Field(
        MIN_BLEND_CYCLES, ge=MIN_BLEND_CYCLES, le=20, description="Shortest blend between steps."
    )

    @field_validator("stop_hz")
    @classmethod
    def _check_ascending(cls, stop: float, info: ValidationInfo) -> float:
        start = info.data.get("start_hz", 0.0)
        if stop < start:
            raise InputError(
                f"stop_hz {stop} lies below start_hz {start}",
                remedy=(
                    "give the grid in ascending order and set the order of the sweep in "
                    "`directions`"
                ),
            )
        return stop

    @field_validator("step_hz")
    @classmethod
    def _check_step(cls, step: float, info: ValidationInfo) -> float:
        if not {"start_hz", "stop_hz"} <= info.data.keys():
            return step
        start, stop = info.data["start_hz"], info.data["stop_hz"]
        if (stop - start) / step > 5000.5:
            raise InputError(
                f"step_hz {step} makes more than 5001 steps from {start} to {stop} Hz",
                allowed=f"at least {(stop - start) / 5000:.6g}",
            )
        step_count = round((stop - start) / step)
        if abs(start + step_count * step - stop) > 1e-6:
            raise InputError(
                f"step_hz {step} does not divide {start} to {stop} Hz",
                remedy=f"nearest: {(stop - start) / max(step_count, 1):.6g}",
            )
        return step

    @field_validator("measured_cycles")
    @classmethod
    def _check_measured_cycles(cls, measured: int, info: ValidationInfo) -> int:
        cycles = info.data.get("cycles", measured)
        if measured > cycles:
            raise InputError(
                f"measured_cycles {measured} is more than cycles {cycles}", remedy="reduce it"
            )
        return measured

    @field_validator("directions")
    @classmethod
    def _check_directions(cls, directions: tuple[str, ...]) -> tuple[str, ...]:
        if not directions:
            raise InputError("directions is empty", allowed="'forward', 'backward', in any order")
        if len(set(directions)) < len(directions):
            raise InputError("directions contains one twice", allowed="each once, in any order")
        return directions

    _check_level_points = field_validator("level_points")(check_points_in_band)

    @field_validator("schedule_db")
    @classmethod
    def _check_schedule(cls, schedule_db: tuple[float, ...]) -> tuple[float, ...]:
        if any(not MIN_LEVEL_DB <= level <= MAX_LEVEL_DB for level in schedule_db):
            raise InputError(
                f"schedule_db {list(schedule_db)}",
                allowed=f"{MIN_LEVEL_DB:g} to {MAX_LEVEL_DB:g} dB each",
                remedy="change acceleration_g or level_points for other levels",
            )
        if len(set(schedule_db)) < len(schedule_db):
            raise InputError("schedule_db contains a level twice", allowed="each once")
        return schedule_db

    @property
    def has_one_level(self) -> bool:
        """True if all steps have the same level."""
        return not self.level_points and len(self.schedule_db) <= 1

    @property
    def one_level_g(self) -> float:
        """Peak table acceleration of all steps in g; InputError if it varies."""
        if not self.has_one_level:
            raise InputError(
                "this needs a sweep of one level",
                key="excitation.level_points" if self.level_points else "excitation.schedule_db",
                remedy="state acceleration_g alone",
            )
        return self.acceleration_g * 10.0 ** (sum(self.schedule_db) / 20.0)

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """Frequency grid in Hz, ascending, rounded to the decimal value."""
        step_count = round((self.stop_hz - self.start_hz) / self.step_hz)
        return tuple(round(self.start_hz + k * self.step_hz, 9) for k in range(step_count + 1))

    def levels_m_s2(self, frequencies_hz: Float1D) -> Float1D:
        """Return the peak table acceleration in m/s2 at frequencies, (frequency,), at 0 dB."""
        if self.level_points:
            return interpolate_level(self.level_points, frequencies_hz) * GRAVITY_M_S2
        return np.full(frequencies_hz.size, self.acceleration_g * GRAVITY_M_S2)

    @property
    def steps(self) -> tuple[Step, ...]:
        """All planned steps in driving order; both directions use the identical grid."""
        grid = self.frequencies_hz
        upwards = list(zip(grid, self.levels_m_s2(np.array(grid)).tolist(), strict=True))
        return tuple(
            Step(index, direction, frequency, 10.0 ** (level_db / 20.0) * acceleration)
            for index, (level_db, direction, (frequency, acceleration)) in enumerate(
                (level_db, direction, step)
                for level_db in self.schedule_db or (0.0,)
                for direction in self.directions
                for step in upwards[:: 1 if direction == "forward" else -1]
            )
        )

    def plan(self, rate_hz: float) -> ExcitationPlan:
        """Return the steps to approach, tune and measure."""
        steps = self.steps
        return ExcitationPlan(
            max(step.acceleration_m_s2 for step in steps),
            self.start_hz,
            self.stop_hz,
            steps,
            blend_cycles=self.blend_cycles,
        )
