"""Profile tables [dwell], [track] and [refine]: adaptive steps after the planned sweep.

A profile has at most one of them. All their steps stay between the ends of the sweep, so the
pre-flight margins hold for them too.
"""

from dataclasses import dataclass
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.config.base import ConfigModel, Count, Number, Positive
from table_io.errors import InputError

MAX_REFINEMENT = 128  # largest ratio of the sweep's step to the resolution of a refinement


@dataclass(frozen=True, slots=True)
class SweepGrid:
    """Ends and step of the sweep in Hz, which an adaptive table must fit."""

    start_hz: float
    stop_hz: float
    step_hz: float

    def require_inside(self, key: str, value: float | None) -> None:
        """Raise ValueError if a frequency in Hz lies outside the sweep."""
        if value is not None and not self.start_hz <= value <= self.stop_hz:
            raise InputError(
                f"{key} {value:g} lies outside the sweep",
                allowed=f"{self.start_hz:g} to {self.stop_hz:g}",
            )

    def require_range(self, purpose: str) -> None:
        """Raise ValueError if the sweep has one frequency only."""
        if self.stop_hz <= self.start_hz:
            raise InputError(
                "the sweep has one frequency",
                remedy=f"{purpose} needs a range: set stop_hz above start_hz",
            )


class DwellConfig(ConfigModel):
    """Dwell at the last step of the sweep and measure it again every `sweep.cycles` cycles.

    `cycles` and `seconds` count held cycles only; cycles for tuning the level come in addition.
    """

    cycles: Count | None = Field(
        None, ge=1, le=1_000_000, description="Length in held cycles; or give `seconds`."
    )
    seconds: Positive | None = Field(
        None, le=86_400, validate_default=True, description="Length in held time; or give `cycles`."
    )

    @field_validator("seconds")
    @classmethod
    def _check_duration(cls, seconds: float | None, info: ValidationInfo) -> float | None:
        if "cycles" in info.data and (info.data["cycles"] is None) == (seconds is None):
            raise ValueError("give either cycles or seconds as the length of the dwell")
        return seconds

    def check_sweep(self, _: SweepGrid) -> None:
        """Accept every sweep."""


class TrackConfig(ConfigModel):
    """Track the first resonance of the sweep: find it, then follow it.

    By phase: where the fundamental of u leads that of the table acceleration by `phase_deg`. At 90
    degrees a linear specimen is at its undamped natural frequency and a hardening one just before
    the end of its branch; for others the phase is a choice. By peak: where half of the swing of u
    over the measured level is largest.
    """

    by: Literal["phase", "peak"] = Field(description="Definition of the resonance.")
    step_hz: Positive = Field(
        description="Largest change between visits, to stay on the branch; by peak: their spacing."
    )
    resolution_hz: Positive = Field(description="Converged when the next visit would move by less.")
    lowest_hz: Positive | None = Field(None, description="Omitted: start of the sweep.")
    highest_hz: Positive | None = Field(None, description="Omitted: end of the sweep.")
    phase_deg: Number | None = Field(None, ge=20, le=160, description="Omitted: 90.")
    visits: Count = Field(30, ge=3, le=10_000, description="Limit for finding it.")
    follow: Count = Field(0, ge=0, le=10_000, description="Visits after it is found.")

    @field_validator("resolution_hz")
    @classmethod
    def _check_resolution(cls, resolution: float, info: ValidationInfo) -> float:
        step = info.data.get("step_hz")
        if step is not None and resolution > step / 2:
            raise InputError(
                f"resolution_hz {resolution:g} is more than half of step_hz {step:g}",
                allowed=f"at most {step / 2:g}",
            )
        return resolution

    @field_validator("phase_deg")
    @classmethod
    def _check_phase(cls, phase: float | None, info: ValidationInfo) -> float | None:
        if phase is not None and info.data.get("by") == "peak":
            raise InputError("phase_deg does not apply to by = 'peak'", remedy="remove it")
        return phase

    def check_sweep(self, grid: SweepGrid) -> None:
        """Raise ValueError if the range does not fit the sweep."""
        grid.require_range("tracking")
        grid.require_inside("lowest_hz", self.lowest_hz)
        grid.require_inside("highest_hz", self.highest_hz)
        low, high = self.range_hz(grid.start_hz, grid.stop_hz)
        if high - low < 2 * self.step_hz:
            raise InputError(
                f"{low:g} to {high:g} Hz is too narrow for steps of {self.step_hz:g}",
                allowed="a range of at least two steps",
            )

    def range_hz(self, start_hz: float, stop_hz: float) -> tuple[float, float]:
        """Return the range (lowest, highest) in Hz for a sweep from start to stop."""
        low = start_hz if self.lowest_hz is None else self.lowest_hz
        return low, stop_hz if self.highest_hz is None else self.highest_hz


class RefineConfig(ConfigModel):
    """Refine every jump of the sweep to `resolution_hz`, in the direction of the sweep.

    The branch is reached again from `approach_hz`, where the branches meet, in steps of the sweep.
    """

    resolution_hz: Positive = Field(
        description="Width of the interval to which a jump is bisected."
    )
    cycles: Count = Field(ge=1, le=1_000_000, description="Limit on held cycles, approaches too.")
    hold_cycles: Count | None = Field(
        None, ge=1, le=100_000, description="Held per frequency; omitted: as in a step."
    )
    approach_hz: Positive | None = Field(
        None, description="For jumps beyond it; omitted: start of the sweep's direction."
    )

    def check_sweep(self, grid: SweepGrid) -> None:
        """Raise ValueError if the refinement does not fit the sweep."""
        grid.require_range("refining")
        grid.require_inside("approach_hz", self.approach_hz)
        if not grid.step_hz / MAX_REFINEMENT <= self.resolution_hz < grid.step_hz:
            raise InputError(
                f"resolution_hz {self.resolution_hz:g} does not refine a sweep with steps of "
                f"{grid.step_hz:g}",
                allowed=f"{grid.step_hz / MAX_REFINEMENT:.3g} to below {grid.step_hz:g}",
            )
