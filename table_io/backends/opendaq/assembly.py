"""Samples of several channels on one clock, put in their places as they come.

Each channel comes by itself, in pieces; the time stamp says where a piece belongs.
"""

import numpy as np

from table_io.block import Float1D, Float2D, Int1D

OFF = 0.25  # of a sample that a time stamp may lie beside its place
ROOM = 4096  # samples by which the store grows


class UnevenError(ValueError):
    """Time stamps that are not those of one even clock."""


def places(ticks: Int1D, first_tick: int, ticks_per_sample: float) -> Int1D:
    """Sample index of each time stamp, (sample,); UnevenError where one lies between samples."""
    exact = (ticks - first_tick) / ticks_per_sample
    index = np.rint(exact).astype(np.int64)
    if index.size and np.abs(exact - index).max() > OFF:
        at = int(np.abs(exact - index).argmax())
        raise UnevenError(
            f"time stamp {ticks[at]} lies {abs(exact[at] - index[at]):.2f} samples off the others"
        )
    return index


class Assembly:
    """What has come and was not handed out; NaN where nothing came."""

    def __init__(self, channels: int) -> None:
        self.first = 0  # index of the first sample that is not handed out
        self._values = np.full((channels, ROOM), np.nan)
        self._ends = np.zeros(channels, dtype=np.int64)  # index after the newest, each channel

    @property
    def complete(self) -> int:
        """Index before which every channel has come, or is known to be lost."""
        return int(self._ends.min())

    @property
    def end(self) -> int:
        """Index after the newest sample of any channel."""
        return int(self._ends.max())

    def put(self, row: int, index: Int1D, values: Float1D) -> None:
        """Samples of a channel; what was handed out already, or comes before sample 0, is dropped.

        UnevenError where they go back in time.
        """
        if not index.size:
            return
        known = self._ends[row]
        if np.diff(index).min(initial=1) < 1 or (known and index[0] < known):
            raise UnevenError(f"time goes back, from sample {known - 1} to {index[0]}")
        wanted = index >= self.first
        index, values = index[wanted] - self.first, values[wanted]
        if not index.size:
            return
        missing = int(index[-1]) + 1 - self._values.shape[1]
        if missing > 0:
            self._values = np.pad(
                self._values, ((0, 0), (0, missing + ROOM)), constant_values=np.nan
            )
        self._values[row, index] = values
        self._ends[row] = self.first + index[-1] + 1

    def take(self, count: int) -> Float2D:
        """The next samples, (channel, sample); NaN where none came."""
        out = np.full((self._values.shape[0], count), np.nan)
        held = self._values[:, :count]
        out[:, : held.shape[1]] = held
        self._values = np.pad(
            self._values[:, count:],
            ((0, 0), (0, max(ROOM - self._values.shape[1] + count, 0))),
            constant_values=np.nan,
        )
        self.first += count
        return out
