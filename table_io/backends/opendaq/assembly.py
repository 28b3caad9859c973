"""Reassembly of samples of several channels on one clock, by their time stamps.

Each channel arrives separately, in pieces.
"""

import numpy as np

from table_io.block import Float1D, Float2D, Int1D

MAX_STAMP_ERROR_SAMPLES = 0.25  # deviation of a time stamp from an even clock
GROWTH_SAMPLES = 4096  # increment of the buffer
MAX_LOSS_SAMPLES = 1 << 16  # a longer gap means that the clock was set


class UnevenClockError(ValueError):
    """Time stamps that are not evenly spaced."""


def sample_indices(
    ticks: Int1D, first_tick: int, ticks_per_sample: float, drift_ticks: float = 0.0
) -> Int1D:
    """Return the sample index of each time stamp, (sample,); UnevenClockError if between samples.

    `drift_ticks` is the drift of the stamps against an even clock since `first_tick`, in ticks.
    """
    exact = (ticks - first_tick - drift_ticks) / ticks_per_sample
    index = np.rint(exact).astype(np.int64)
    if index.size and np.abs(exact - index).max() > MAX_STAMP_ERROR_SAMPLES:
        at = int(np.abs(exact - index).argmax())
        raise UnevenClockError(
            f"time stamp {ticks[at]} is off by {abs(exact[at] - index[at]):.2f} samples"
        )
    return index


class ClockJumpError(UnevenClockError):
    """Jump of the clock by `samples`: it was set while it ran."""

    def __init__(self, samples: int) -> None:
        super().__init__(f"the clock jumped by {samples} samples")
        self.samples = samples


class Assembly:
    """Buffer of samples that have arrived and were not returned; missing ones are NaN."""

    def __init__(self, channels: int, max_loss: int = MAX_LOSS_SAMPLES) -> None:
        self.first = 0  # index of the next sample to return
        self._values = np.full((channels, GROWTH_SAMPLES), np.nan)
        self._ends = np.zeros(channels, dtype=np.int64)  # after the newest sample, per channel
        self._silent = np.zeros(channels, dtype=bool)
        self._max_loss = max_loss

    @property
    def complete(self) -> int:
        """Index before which all samples of the channels that still send have arrived."""
        return int(self._ends[~self._silent].min(initial=self.end))

    @property
    def end(self) -> int:
        """Index after the newest sample of any channel."""
        return int(self._ends.max())

    def give_up(self, index: int) -> None:
        """Stop waiting for channels that have not reached `index`, until they send again."""
        self._silent |= self._ends < index

    def put(self, row: int, index: Int1D, values: Float1D) -> None:
        """Insert samples of a channel; drop those already returned or before sample 0.

        Raises UnevenClockError if the index goes back, and ClockJumpError if it is more than
        `max_loss` ahead of everything received.
        """
        if not index.size:
            return
        end = self._ends[row]
        if np.diff(index).min(initial=1) < 1 or (end and index[0] < end):
            raise UnevenClockError(f"time goes back from sample {end - 1} to {index[0]}")
        ahead = np.diff(index, prepend=max(self.end, self.first)).max()
        if ahead > self._max_loss:
            raise ClockJumpError(int(ahead))
        self._silent[row] = False
        is_new = index >= self.first
        index, values = index[is_new] - self.first, values[is_new]
        if not index.size:
            return
        missing = int(index[-1]) + 1 - self._values.shape[1]
        if missing > 0:
            self._values = np.pad(
                self._values, ((0, 0), (0, missing + GROWTH_SAMPLES)), constant_values=np.nan
            )
        self._values[row, index] = values
        self._ends[row] = self.first + index[-1] + 1

    def take(self, count: int) -> Float2D:
        """Remove and return the next samples, (channel, sample); missing ones are NaN."""
        out = np.full((self._values.shape[0], count), np.nan)
        available = self._values[:, :count]
        out[:, : available.shape[1]] = available
        self._values = np.pad(
            self._values[:, count:],
            ((0, 0), (0, max(GROWTH_SAMPLES - self._values.shape[1] + count, 0))),
            constant_values=np.nan,
        )
        self.first += count
        return out
