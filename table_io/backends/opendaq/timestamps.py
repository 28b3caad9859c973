"""Time stamps of an openDAQ device: checks of its clock, and reassembly of the samples by them.

All signals must be on one even clock, at the sample rate of the test. Each channel arrives
separately, in pieces.
"""

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from table_io.errors import InputError

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


@dataclass(frozen=True)
class TickClock:
    """Scale of the time stamps: origin, ticks per sample, seconds per tick."""

    origin: str
    ticks_per_sample: float
    seconds: float  # per tick

    def format_tick(self, tick: int) -> str:
        """Format a time stamp as ISO 8601, or as seconds after a non-standard origin."""
        seconds = tick * self.seconds
        try:
            origin = datetime.fromisoformat(self.origin.replace("Z", "+00:00"))
            return (origin + timedelta(seconds=seconds)).isoformat()
        except (ValueError, OverflowError):
            return f"{seconds:.6f} s after {self.origin or 'its start'}"


def require_common_clock(daq: Any, signals: list[Any], rate_hz: float, device: str) -> TickClock:
    """Return the clock that all signals share; InputError if uneven or at another rate."""
    clocks = set()
    for signal in signals:
        stamp = signal.domain_signal.descriptor
        rule, tick = stamp.rule, stamp.tick_resolution
        if rule.type != daq.DataRuleType.Linear or tick is None:
            raise InputError(
                "not sampled evenly",
                where=f"signal {signal.global_id}",
                remedy="set a sample rate in the device",
            )
        delta = float(rule.parameters["delta"])
        seconds = int(tick.numerator) / int(tick.denominator)
        if abs(delta * seconds * rate_hz - 1.0) > 1e-6:
            raise InputError(
                f"signal {signal.global_id} is sampled at {1.0 / (delta * seconds):g} Hz",
                key="acquisition.rate_hz",
                value=rate_hz,
                remedy="set both to the same sample rate",
            )
        domain = stamp.reference_domain_info
        source = str(domain.reference_domain_id) if domain is not None else ""
        clocks.add((str(stamp.origin), source, delta, seconds))
    if len(clocks) > 1:
        raise InputError(
            "the signals do not share one clock",
            where=device,
            remedy="use channels on one clock only",
        )
    origin, _, delta, seconds = clocks.pop()
    return TickClock(origin, delta, seconds)


def require_simultaneous(newest: dict[str, int], ticks_per_sample: float, device: str) -> None:
    """Raise InputError if two channels are not sampled at the same instants."""
    names = list(newest)
    for name in names[1:]:
        offset = (newest[name] - newest[names[0]]) / ticks_per_sample
        misalignment = abs(offset - round(offset))
        if misalignment > MAX_STAMP_ERROR_SAMPLES:
            raise InputError(
                f"sampled {misalignment:.2f} samples apart from {names[0]}",
                where=device,
                key=name,
                remedy="start all its channels together, on one clock",
            )
