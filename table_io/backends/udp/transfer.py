"""Reassembly of received samples, retransmission of command pieces, clock offset; no I/O."""

import math

import numpy as np

from table_io.backends.udp.packets import VALUES_PER_PACKET, Bool1D
from table_io.block import Float1D, Float2D

MAX_AHEAD_SAMPLES = 1 << 18  # samples kept ahead of the next one to return
WINDOW_PIECES = 32  # pieces in flight: what a small receive buffer holds
RESEND_S = 0.002  # after which an unconfirmed piece is sent again
CLOCK_WINDOW_S = 1.0  # over which the target's clock is compared with that of the rig


class ReceiveBuffer:
    """Reassembly buffer of received samples, from the next one to return; missing ones are NaN."""

    def __init__(self, channels: int, first: int = 0) -> None:
        self.first = first  # next sample to return
        self.complete = first  # all samples before it have arrived or are lost
        self.end = first  # after the newest sample received
        self._values = np.full((channels, 0), np.nan)
        self._resolved = np.zeros(0, dtype=np.bool_)

    def put(self, index: int, values: Float2D) -> None:
        """Insert samples, (channel, sample), from `index` on; any order, repetitions allowed."""
        end = index + values.shape[1]
        if end <= self.complete or end - self.first > MAX_AHEAD_SAMPLES:
            return
        skip = max(self.first - index, 0)
        self._grow(end)
        span = slice(index + skip - self.first, end - self.first)
        self._values[:, span] = values[:, skip:]
        self._resolved[span] = True
        self.end = max(self.end, end)
        self._advance()

    @property
    def missing(self) -> tuple[int, int] | None:
        """First gap before the newest sample, first .. last - 1; None if there is no gap."""
        if self.end <= self.complete:
            return None
        resolved = self._resolved[self.complete - self.first : self.end - self.first]
        return self.complete, self.complete + int(np.argmax(resolved))

    def give_up(self, index: int) -> None:
        """Mark missing samples before `index` as lost: they stay NaN."""
        if index > self.complete:
            self._grow(index)
            self._resolved[: index - self.first] = True
            self.end = max(self.end, index)
            self._advance()

    def take(self, samples: int) -> Float2D:
        """Remove and return the next samples, (channel, sample)."""
        out = self._values[:, :samples].copy()
        self._values, self._resolved = self._values[:, samples:], self._resolved[samples:]
        self.first += samples
        return out

    def _grow(self, end: int) -> None:
        extra = end - self.first - self._resolved.size
        if extra > 0:
            extra += 1024
            self._values = np.pad(self._values, ((0, 0), (0, extra)), constant_values=np.nan)
            self._resolved = np.pad(self._resolved, (0, extra))

    def _advance(self) -> None:
        resolved = self._resolved[self.complete - self.first :]
        self.complete += int(np.argmin(resolved)) if not resolved.all() else resolved.size


class CommandTransfer:
    """Transfer of one command in pieces, with retransmission of unconfirmed ones."""

    def __init__(self, volts: Float1D) -> None:
        self._volts = volts
        self.arrived = np.zeros(math.ceil(volts.size / VALUES_PER_PACKET), dtype=np.bool_)
        self._sent_s = np.full(self.arrived.size, -math.inf)

    def confirm(self, pieces: Bool1D) -> None:
        """Mark pieces, flags (MAX_PIECES,), as received by the target."""
        self.arrived |= pieces[: self.arrived.size]

    def pop_due(self, now_s: float) -> list[tuple[int, Float1D]]:
        """Return (piece, volts) for each piece to be sent now."""
        in_flight = ~self.arrived & (now_s - self._sent_s < RESEND_S)
        waiting = np.flatnonzero(~self.arrived & ~in_flight)
        pieces = waiting[: max(WINDOW_PIECES - int(in_flight.sum()), 0)]
        self._sent_s[pieces] = now_s
        return [
            (int(p), self._volts[VALUES_PER_PACKET * p : VALUES_PER_PACKET * (p + 1)])
            for p in pieces
        ]


class ClockOffset:
    """Estimate of `epoch_s`, the time of sample 0 in s on the rig's clock, from packet arrivals.

    A packet can only be late, so the earliest of a window is the best estimate. As two clocks drift
    apart (50 ppm are 0.18 s an hour), the estimate is renewed every CLOCK_WINDOW_S.
    """

    def __init__(self, epoch_s: float, now_s: float) -> None:
        self.epoch_s = epoch_s
        self._min_epoch_s = math.inf
        self._window_end_s = now_s + CLOCK_WINDOW_S

    def update(self, newest: int, rate_hz: float, now_s: float) -> None:
        """Update the estimate: a packet at `now_s` reports that sample `newest` was taken."""
        self._min_epoch_s = min(self._min_epoch_s, now_s - newest / rate_hz)
        self.epoch_s = min(self.epoch_s, self._min_epoch_s)
        if now_s >= self._window_end_s:
            self.epoch_s, self._min_epoch_s = self._min_epoch_s, math.inf
            self._window_end_s = now_s + CLOCK_WINDOW_S
