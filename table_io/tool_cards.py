"""Cards of a test that finds its own way: what follows the planned sweep is decided as it goes.

A profile has at most one of them. Whatever they decide stays between the ends of the sweep, so the
pre-flight margins hold for it.
"""

from dataclasses import dataclass
from typing import Literal

from pydantic import Field, ValidationInfo, field_validator

from table_io.card import Card, Count, Number, Positive

FINEST = 128  # parts of a step of the sweep into which a jump can be refined


@dataclass(frozen=True, slots=True)
class Grid:
    """The sweep's ends and its step in Hz, as far as the cards below have to fit them."""

    start_hz: float
    stop_hz: float
    step_hz: float

    def holds(self, key: str, value: float | None) -> None:
        """ValueError where a frequency lies outside."""
        if value is not None and not self.start_hz <= value <= self.stop_hz:
            raise ValueError(
                f"{key} {value:g} lies outside the sweep; allowed: {self.start_hz:g} to "
                f"{self.stop_hz:g}"
            )

    def wide(self, what: str) -> None:
        """ValueError where the sweep is one frequency only."""
        if self.stop_hz <= self.start_hz:
            raise ValueError(f"the sweep holds one frequency; {what} needs a range of them")


class Dwell(Card):
    """Stay at the last step of the sweep; it is measured again every `sweep.cycles` cycles.

    Both count held cycles only; those in which the level is looked at come on top.
    """

    cycles: Count | None = Field(None, ge=1, le=1_000_000)
    seconds: Positive | None = Field(None, le=86_400, validate_default=True)

    @field_validator("seconds")
    @classmethod
    def _one_of_them(cls, seconds: float | None, info: ValidationInfo) -> float | None:
        if "cycles" in info.data and (info.data["cycles"] is None) == (seconds is None):
            raise ValueError("give either cycles or seconds, for how long to dwell")
        return seconds

    def fits(self, _: Grid) -> None:
        """It goes with every sweep."""


class Track(Card):
    """Find the resonance that the sweep meets first, and follow it.

    By phase: where the fundamental of u is `phase_deg` ahead of that of the table's acceleration.
    At 90 degrees a linear specimen is at its undamped natural frequency, a hardening one just
    before the end of its branch; for others it is a choice. By peak: where half of the swing of u,
    over the level that was measured, is largest.
    """

    by: Literal["phase", "peak"]
    step_hz: Positive = Field(
        description="Most that a visit may move, so that no branch is left; a peak's spacing too."
    )
    resolution_hz: Positive = Field(description="It is found when the next visit moves less.")
    lowest_hz: Positive | None = Field(None, description="None: the sweep's.")
    highest_hz: Positive | None = Field(None, description="None: the sweep's.")
    phase_deg: Number | None = Field(None, ge=20, le=160, description="None: 90.")
    visits: Count = Field(30, ge=3, le=10_000, description="To find it in, at most.")
    follow: Count = Field(0, ge=0, le=10_000, description="Visits after it was found.")

    @field_validator("resolution_hz")
    @classmethod
    def _finer(cls, resolution: float, info: ValidationInfo) -> float:
        step = info.data.get("step_hz")
        if step is not None and resolution > step / 2:
            raise ValueError(
                f"resolution_hz {resolution:g} is more than half of step_hz {step:g}; "
                f"allowed: at most {step / 2:g}"
            )
        return resolution

    @field_validator("phase_deg")
    @classmethod
    def _asked(cls, phase: float | None, info: ValidationInfo) -> float | None:
        if phase is not None and info.data.get("by") == "peak":
            raise ValueError("phase_deg has no meaning by peak; leave it out, or say by = 'phase'")
        return phase

    def fits(self, grid: Grid) -> None:
        """ValueError where its range and the sweep do not go together."""
        grid.wide("tracking")
        grid.holds("lowest_hz", self.lowest_hz)
        grid.holds("highest_hz", self.highest_hz)
        low, high = self.range_hz(grid.start_hz, grid.stop_hz)
        if high - low < 2 * self.step_hz:
            raise ValueError(
                f"{low:g} to {high:g} Hz is no room for steps of {self.step_hz:g}; allowed: a "
                "range of two steps at least"
            )

    def range_hz(self, start_hz: float, stop_hz: float) -> tuple[float, float]:
        """(lowest, highest) of a sweep from start to stop."""
        low = start_hz if self.lowest_hz is None else self.lowest_hz
        return low, stop_hz if self.highest_hz is None else self.highest_hz


class Refine(Card):
    """Narrow every jump that the sweep finds down to `resolution_hz`, in the sweep's direction.

    The branch is reached again from `approach_hz`, where the branches meet, in steps of the sweep.
    """

    resolution_hz: Positive
    cycles: Count = Field(ge=1, le=1_000_000, description="Held in all, at most, ways included.")
    hold_cycles: Count | None = Field(
        None, ge=1, le=100_000, description="Before a frequency counts as passed; None: a step's."
    )
    approach_hz: Positive | None = Field(
        None, description="For jumps beyond it; None: where the sweep in that direction begins."
    )

    def fits(self, grid: Grid) -> None:
        """ValueError where it does not go with the sweep."""
        grid.wide("refining")
        grid.holds("approach_hz", self.approach_hz)
        if not grid.step_hz / FINEST <= self.resolution_hz < grid.step_hz:
            raise ValueError(
                f"resolution_hz {self.resolution_hz:g} does not refine a sweep in steps of "
                f"{grid.step_hz:g}; allowed: {grid.step_hz / FINEST:.3g} to below {grid.step_hz:g}"
            )
