"""Samples of several channels on one clock, put in their places as they come.

Each channel comes by itself, in pieces; the time stamp says where a piece belongs.
"""

import numpy as np

from table_io.block import Float1D, Float2D, Int1D

OFF = 0.25  # of a sample that a time stamp may lie beside its place
ROOM = 4096  # samples by which the store grows
FAR = 1 << 16  # samples: no loss is so long, the clock was set


class UnevenError(ValueError):
    """Time stamps that are not those of one even clock."""


def places(ticks: Int1D, first_tick: int, ticks_per_sample: float, drifted: float = 0.0) -> Int1D:
    """Sample index of each time stamp, (sample,); UnevenError where one lies between samples.

    `drifted` is how many ticks the stamps have run ahead of their samples since the first.
    """
    exact = (ticks - first_tick - drifted) / ticks_per_sample
    index = np.rint(exact).astype(np.int64)
    if index.size and np.abs(exact - index).max() > OFF:
        at = int(np.abs(exact - index).argmax())
        raise UnevenError(
            f"time stamp {ticks[at]} lies {abs(exact[at] - index[at]):.2f} samples off the others"
        )
    return index


class JumpError(UnevenError):
    """A clock that was set while it ran."""

    def __init__(self, samples: int) -> None:
        super().__init__(f"the clock jumped by {samples} samples")
        self.samples = samples


class Assembly:
    """What has come and was not handed out; NaN where nothing came."""

    def __init__(self, channels: int, far: int = FAR) -> None:
        self.first = 0  # index of the first sample that is not handed out
        self._values = np.full((channels, ROOM), np.nan)
        self._ends = np.zeros(channels, dtype=np.int64)  # index after the newest, each channel
        self._silent = np.zeros(channels, dtype=bool)
        self._far = far

    @property
    def complete(self) -> int:
        """Index before which every channel that still speaks has come, or is known to be lost."""
        return int(self._ends[~self._silent].min(initial=self.end))

    @property
    def end(self) -> int:
        """Index after the newest sample of any channel."""
        return int(self._ends.max())

    def give_up(self, before: int) -> None:
        """Wait no more for channels that have not come so far, until they speak again."""
        self._silent |= self._ends < before

    def put(self, row: int, index: Int1D, values: Float1D) -> None:
        """Samples of a channel; what was handed out already, or comes before sample 0, is dropped.

        UnevenError where they go back in time, JumpError where they are far ahead of all that came.
        """
        if not index.size:
            return
        known = self._ends[row]
        if np.diff(index).min(initial=1) < 1 or (known and index[0] < known):
            raise UnevenError(f"time goes back, from sample {known - 1} to {index[0]}")
        ahead = np.diff(index, prepend=max(self.end, self.first)).max()
        if ahead > self._far:
            raise JumpError(int(ahead))
        self._silent[row] = False
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
