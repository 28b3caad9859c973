"""What a controller with a clock of its own makes of a drive file, on the samples of another clock.

A controller's output is smooth between the values of its file: a cubic spline through them.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from table_io.block import Float1D

BESIDE = 16  # values of the file on either side of a piece, for its spline


@dataclass(frozen=True, eq=False)
class Played:
    """A file under way: its value 0 leaves at sample `start` of the other clock, also between two.

    `ppm` is how much faster the controller's clock runs, `rate_hz` that of the samples.
    """

    values_m: Float1D
    file_rate_hz: float
    rate_hz: float
    start: float
    ppm: float = 0.0

    @property
    def pace(self) -> float:
        """Values of the file for each sample."""
        return self.file_rate_hz / self.rate_hz * (1.0 + 1e-6 * self.ppm)

    @property
    def end(self) -> int:
        """Sample from which it has been played."""
        return int(np.ceil(self.start + (self.values_m.size - 1) / self.pace)) + 1

    def command(self, first: int, count: int) -> Float1D:
        """Displacement in m at samples first .. first + count - 1; the file's ends are held."""
        at = (np.arange(first, first + count) - self.start) * self.pace
        at = np.clip(at, 0.0, self.values_m.size - 1.0)
        if not at.size:
            return at
        low = max(int(at[0]) - BESIDE, 0)
        piece = self.values_m[low : int(at[-1]) + BESIDE + 2]
        if piece.size < 4:
            return np.interp(at, np.arange(self.values_m.size), self.values_m)
        spline: Float1D = CubicSpline(np.arange(low, low + piece.size), piece)(at)
        return spline
