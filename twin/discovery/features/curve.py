"""Response curve at one gap: amplitude over frequency along the primary resonance, with folds."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, find_stretches
from twin.dynamics.main_branches import locate_peak

Bool1D = npt.NDArray[np.bool_]
CurveMethod = Literal["describing functions", "continuation", "stepped sweeps"]
MIN_EXCESS_M = 1e-9  # m: of a motion that just leaves a bumper


@dataclass(frozen=True, slots=True, eq=False)
class ResponseCurve:
    """Half swing of u along a curve that begins at low frequency, (n,); it may turn back.

    `excess_m`: by how much the motion passes the touch of a bumper, with positive gaps its
    beginning, with precompressed bumpers the loss of contact; negative short of it, -inf without
    bumpers. Between the fold of the forward sweep and that of the backward one it is unstable.
    """

    frequency_hz: Float1D
    amplitude_m: Float1D
    excess_m: Float1D
    stable: Bool1D
    method: CurveMethod

    def find_peak(self) -> tuple[float, float]:
        """Return (frequency in Hz, amplitude in m) of the largest stable motion; NaN if outside."""
        top = int(np.where(self.stable, self.amplitude_m, -np.inf).argmax())
        if top in (0, self.amplitude_m.size - 1):
            return math.nan, math.nan
        if self.method == "describing functions":  # its largest amplitude is a point of it
            return float(self.frequency_hz[top]), float(self.amplitude_m[top])
        amplitude_m, hz = locate_peak(self.frequency_hz, self.amplitude_m, self.stable)
        return hz, amplitude_m

    def measure_hysteresis(self) -> tuple[float, float]:
        """Return (middle, signed width) in Hz: right > 0, left < 0; without one (peak, 0)."""
        ends = find_folds_along(self.frequency_hz)
        if ends is None:
            return self.find_peak()[0], 0.0
        forward, backward = ends
        high, low = self.frequency_hz[forward], self.frequency_hz[backward]
        sign = math.copysign(1.0, self.amplitude_m[forward] - self.amplitude_m[backward])
        return float(high + low) / 2, sign * float(high - low)

    def interpolate(self, hz: float, direction: str) -> tuple[float, float]:
        """Return (amplitude, excess) in m of a sweep in a direction; NaN outside of the curve."""
        f = self.frequency_hz
        crosses = (f[:-1] - hz) * (f[1:] - hz) <= 0
        crosses &= (f[:-1] != f[1:]) & (self.stable[:-1] | self.stable[1:])
        places = np.flatnonzero(crosses)
        if not places.size:
            return math.nan, math.nan
        k = int(places[0 if direction == "forward" else -1])
        share = (hz - f[k]) / (f[k + 1] - f[k])
        amplitude, excess = (
            float(values[k] + share * (values[k + 1] - values[k]))
            if np.isfinite(values[k : k + 2]).all()
            else float(values[k])
            for values in (self.amplitude_m, self.excess_m)
        )
        return amplitude, excess

    @property
    def largest_excess_m(self) -> float:
        """Largest excess of all stable motions in m."""
        return float(self.excess_m[self.stable].max(initial=-math.inf))


def find_folds_along(frequency_hz: Float1D) -> tuple[int, int] | None:
    """Return the indices of the (forward, backward) fold that are farthest apart; None without.

    A fold of the forward sweep is where the frequency turns back along the curve; the largest fall
    from such a point to a later one spans the hysteresis.
    """
    fall = np.maximum.accumulate(frequency_hz) - frequency_hz
    backward = int(fall.argmax())
    if fall[backward] <= 0:
        return None
    return int(frequency_hz[: backward + 1].argmax()), backward


def join_directions(
    frequency_hz: Float1D, forward_m: Float1D, backward_m: Float1D, differs: Bool1D
) -> tuple[Float1D, Float1D]:
    """Return (frequency, amplitude) along the curve that both directions of a sweep trace.

    The forward branch to the end of the widest range in which they differ, then the backward one
    from its beginning.
    """
    ranges = find_stretches(differs)
    if not ranges:
        return frequency_hz, forward_m
    first, last = max(ranges, key=lambda ends: ends[1] - ends[0])
    return (
        np.concatenate([frequency_hz[:last], frequency_hz[first:]]),
        np.concatenate([forward_m[:last], backward_m[first:]]),
    )
