"""What a tool looks at, and what it can ask for."""

import math
from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D
from table_io.records import Step
from table_io.tracking import Tracked
from table_io.units import GRAVITY_M_S2

SUDDEN = 1.6  # ratio of swings between neighbours that a smooth branch does not reach


@dataclass(frozen=True, slots=True)
class Result:
    """What a step did over its measured cycles: harmonics at the drive's phase, SI.

    `swing_m` is half of max u - min u, the mean over the cycles; NaN where u was not measured.
    """

    step: Step
    table_acc: Tracked
    rel_disp: Tracked
    mass_acc: Tracked
    swing_m: float

    @property
    def level_g(self) -> float:
        """Fundamental of the table's acceleration in g."""
        return self.table_acc.fundamental / GRAVITY_M_S2

    @property
    def gain_mm_g(self) -> float:
        """Swing over the level that was measured, in mm/g: small errors of the level drop out."""
        return 1e3 * self.swing_m / self.level_g

    @property
    def phase_deg(self) -> float:
        """How far u is ahead of the table's acceleration, fundamentals, from -90 to below 270.

        From 180 far below a linear resonance through 90 to 0 far above it.
        """
        ratio = complex(self.rel_disp.amplitudes[0] / self.table_acc.amplitudes[0])
        return (math.degrees(math.atan2(ratio.imag, ratio.real)) + 90.0) % 360.0 - 90.0


@dataclass(frozen=True, slots=True)
class Decision:
    """The next step of a test that finds its way, and why."""

    frequency_hz: float
    direction: str
    reason: str


# A tool is told the results in turn and says each time what comes next: None for the next step of
# the sweep. What it returns in the end is what it found.
Move = Decision | None
Tool = Generator[Move, Result, str]
Visit = Generator[Move, Result, Result]


class Unmeasured(Exception):
    """A step did not tell what a tool needs to know."""


def visited(move: Move) -> Visit:
    """The result of a move; Unmeasured where it does not tell u and the table's acceleration."""
    result = yield move
    if not math.isfinite(result.swing_m) or not math.isfinite(result.level_g):
        raise Unmeasured(
            f"u or the table's acceleration was not measured at {result.step.frequency_hz:g} Hz, "
            "so there is nothing to go by"
        )
    return result


def swing(u: Float1D, phase: Float1D) -> float:
    """Half of max u - min u in m, the mean over the cycles of `phase`; NaN where one has a gap."""
    if not u.size:
        return math.nan
    turns = np.floor(phase - phase[0] + 1e-9)
    starts = np.flatnonzero(np.diff(turns, prepend=-1.0))
    ranges = np.maximum.reduceat(u, starts) - np.minimum.reduceat(u, starts)
    # A cycle is no whole number of samples: the window may end with one sample of the next.
    whole = np.diff(np.append(starts, u.size)) > 0.5 * u.size / starts.size
    return float(0.5 * ranges[whole].mean())
