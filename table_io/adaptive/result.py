"""Results that an adaptive policy receives, and the requests that it can make."""

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.control.order_tracking import HarmonicFit, track_harmonics
from table_io.records import Step
from table_io.units import GRAVITY_M_S2

MIN_JUMP_RATIO = 1.6  # of swings at neighboring steps; a smooth branch stays below


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


SWING_HARMONICS = 30  # of u: an impact on a bumper takes a tenth of a cycle or more
MIN_HARMONIC_SIGMA = 3.0  # standard errors below which a harmonic is noise
SWING_PHASES = 720  # of a cycle, at which the extremes are looked for: 1e-5 of the swing
MAX_UNREPEATED = 0.02  # of the swing: rms by which cycles differ beyond the noise


def mean_swing(u: Float1D, phase: Float1D) -> float:
    """Return half of max u - min u in m, over whole cycles of `phase`; NaN if any is lost.

    Of the harmonics of the motion: extremes of single cycles are larger by the noise of the
    sensor. Where the cycles differ, the mean of their extremes.
    """
    fit = track_harmonics(u, phase, SWING_HARMONICS)
    if not math.isfinite(fit.residual_rms):
        return _mean_range(u, phase)
    error = fit.residual_rms * math.sqrt(2.0 / u.size)
    kept = np.where(np.abs(fit.amplitudes) > MIN_HARMONIC_SIGMA * error, fit.amplitudes, 0.0)
    turns = np.exp(2j * np.pi * np.arange(SWING_PHASES) / SWING_PHASES)
    swing = 0.5 * float(np.ptp(np.polyval([*kept[::-1], 0.0], turns).imag))
    # White noise of unit rms has a third difference of rms sqrt(20); the motion itself has none.
    noise = float(np.sqrt(np.mean(np.diff(u, 3) ** 2) / 20.0))
    unrepeated = math.sqrt(max(fit.residual_rms**2 - noise**2, 0.0))
    return swing if unrepeated <= MAX_UNREPEATED * swing else _mean_range(u, phase)


def _mean_range(u: Float1D, phase: Float1D) -> float:
    """Return half of max u - min u in m of each cycle, averaged; NaN if any is lost."""
    if not u.size:
        return math.nan
    cycles = np.floor(phase - phase[0] + 1e-9)
    starts = np.flatnonzero(np.diff(cycles, prepend=-1.0))
    ranges = np.maximum.reduceat(u, starts) - np.minimum.reduceat(u, starts)
    # A cycle need not be a whole number of samples: the window may end with a sample of the next.
    complete = np.diff(np.append(starts, u.size)) > 0.5 * u.size / starts.size
    return float(0.5 * ranges[complete].mean())
