"""Stepped sine: held sine steps of constant peak acceleration, up and down a frequency grid.

The table [sweep] of a profile is this kind under its older name.
"""

from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import Count, Number, Positive
from table_io.config.excitation import (
    MIN_BLEND_CYCLES,
    Excitation,
    ExcitationPlan,
    register_excitation,
)
from table_io.errors import InputError
from table_io.records import Step
from table_io.units import GRAVITY_M_S2


@register_excitation("stepped_sine")
class Sweep(Excitation):
    """Stepped sine sweep of constant peak table acceleration, up and down one frequency grid."""

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

    def plan(self, rate_hz: float) -> ExcitationPlan:
        """Return the steps to approach, tune and measure."""
        steps = self.steps
        return ExcitationPlan(
            steps[0].acceleration_m_s2,
            self.start_hz,
            self.stop_hz,
            steps,
            blend_cycles=self.blend_cycles,
        )
