"""Playback of a drive file by a controller with its own clock, sampled on another clock.

Between the values of the file the output is a cubic spline through them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from table_io.block import Float1D

SPLINE_MARGIN = 16  # values on either side of a segment that enter its spline


@dataclass(frozen=True, eq=False)
class DrivePlayback:
    """Playback in m of a file whose value 0 is output at sample `start`, which may be fractional.

    `rate_hz` is the rate of the samples; the controller's clock is fast by `ppm`.
    """

    values_m: Float1D
    file_rate_hz: float
    rate_hz: float
    start: float
    ppm: float = 0.0

    @property
    def values_per_sample(self) -> float:
        """Values of the file per sample."""
        return self.file_rate_hz / self.rate_hz * (1.0 + 1e-6 * self.ppm)

    @property
    def end(self) -> int:
        """First sample after the end of the playback."""
        return int(np.ceil(self.start + (self.values_m.size - 1) / self.values_per_sample)) + 1

    def command(self, first: int, count: int) -> Float1D:
        """Return displacement in m at samples first .. first + count - 1; file ends are held."""
        positions = (np.arange(first, first + count) - self.start) * self.values_per_sample
        positions = np.clip(positions, 0.0, self.values_m.size - 1.0)
        if not positions.size:
            return positions
        first_value = max(int(positions[0]) - SPLINE_MARGIN, 0)
        piece = self.values_m[first_value : int(positions[-1]) + SPLINE_MARGIN + 2]
        if piece.size < 4:
            return np.interp(positions, np.arange(self.values_m.size), self.values_m)
        spline: Float1D = CubicSpline(np.arange(first_value, first_value + piece.size), piece)(
            positions
        )
        return spline
