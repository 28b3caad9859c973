"""Correction of a drive: displacement that a feedback adds to the nominal command."""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D


@dataclass(frozen=True, eq=False)
class Correction:
    """Displacement in m added from sample `start` on, (sample,); 0 before and after it."""

    start: int
    values_m: Float1D

    @property
    def end(self) -> int:
        """Index of the first sample after the correction."""
        return self.start + self.values_m.size

    def displacement(self, first: int, count: int) -> Float1D:
        """Return the correction in m of samples first .. first + count - 1, (count,)."""
        displacement_m = np.zeros(count)
        low, high = max(first, self.start), min(first + count, self.end)
        if low < high:
            values = self.values_m[low - self.start : high - self.start]
            displacement_m[low - first : high - first] = values
        return displacement_m

    def replace_from(self, first: int, values_m: Float1D, keep_from: int) -> "Correction":
        """Return the correction with other values from sample `first` on.

        Values before sample `keep_from` are discarded.
        """
        start = min(max(self.start, keep_from), first)
        return Correction(
            start, np.concatenate([self.displacement(start, first - start), values_m])
        )


NO_CORRECTION = Correction(0, np.empty(0))
