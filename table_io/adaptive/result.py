"""Results that an adaptive policy receives, and the requests that it can make."""

import math
from collections.abc import Generator
from dataclasses import dataclass

from table_io.harmonics import HarmonicFit
from table_io.records import Step
from table_io.units import GRAVITY_M_S2


@dataclass(frozen=True, slots=True)
class StepResult:
    """Result of a step over its measured cycles: harmonics at the phase of the drive, SI.

    `swing_m` is half of max u - min u, averaged over the cycles; NaN if u was not measured.
    """

    step: Step
    table_acc: HarmonicFit
    rel_disp: HarmonicFit
    mass_acc: HarmonicFit
    swing_m: float

    @property
    def level_g(self) -> float:
        """Amplitude of the fundamental of the table acceleration in g."""
        return self.table_acc.fundamental / GRAVITY_M_S2

    @property
    def gain_mm_g(self) -> float:
        """Swing over measured level in mm/g, which cancels small level errors."""
        return 1e3 * self.swing_m / self.level_g

    @property
    def phase_deg(self) -> float:
        """Phase lead of u over the table acceleration (fundamentals), -90 <= phase < 270.

        180 far below a linear resonance, 90 at it and 0 far above it.
        """
        ratio = complex(self.rel_disp.amplitudes[0] / self.table_acc.amplitudes[0])
        return (math.degrees(math.atan2(ratio.imag, ratio.real)) + 90.0) % 360.0 - 90.0


@dataclass(frozen=True, slots=True)
class Decision:
    """Next step of an adaptive test, and the reason for it."""

    frequency_hz: float
    direction: str
    reason: str


# A policy generator receives the results in turn and yields its next request: None is the next step
# of the sweep. Its return value is the sentence that summarizes the outcome.
StepRequest = Decision | None
PolicyGenerator = Generator[StepRequest, StepResult, str]
VisitGenerator = Generator[StepRequest, StepResult, StepResult]


class MissingMeasurement(Exception):
    """A step lacks a measurement that the policy needs."""


def request_step(move: StepRequest) -> VisitGenerator:
    """Request a step and return its result; MissingMeasurement if u or the level is NaN."""
    result = yield move
    if not math.isfinite(result.swing_m) or not math.isfinite(result.level_g):
        raise MissingMeasurement(
            f"u or the table's acceleration was not measured at {result.step.frequency_hz:g} Hz, "
            "but the test needs both to choose the next step"
        )
    return result
