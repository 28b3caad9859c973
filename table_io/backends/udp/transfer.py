"""What crosses the wire in pieces, on the rig's side: samples that come, a command that goes.

Pure: it is told what came and what time it is.
"""

import math

import numpy as np

from table_io.backends.udp.packets import VALUES, Bool1D
from table_io.block import Float1D, Float2D

MOST_AHEAD = 1 << 18  # samples beyond the next one that are kept
WINDOW = 32  # pieces on their way at a time: what a small receive buffer holds
RESEND_S = 0.002  # a piece that was not heard of for so long is sent again
DRIFT_S = 1.0  # the target's clock is compared with ours over so long


class Arriving:
    """Samples by their index, from the next one to be handed out on; what has not come is NaN."""

    def __init__(self, channels: int, first: int = 0) -> None:
        self.first = first  # next to be handed out
        self.come = first  # all before it have come, or are lost for good
        self.seen = first  # one behind the newest that has come
        self._values = np.full((channels, 0), np.nan)
        self._known = np.zeros(0, dtype=np.bool_)

    def put(self, index: int, values: Float2D) -> None:
        """Samples, (channel, sample), from sample `index` on, in any order, as often as may be."""
        end = index + values.shape[1]
        if end <= self.come or end - self.first > MOST_AHEAD:
            return
        skip = max(self.first - index, 0)
        self._grow(end)
        span = slice(index + skip - self.first, end - self.first)
        self._values[:, span] = values[:, skip:]
        self._known[span] = True
        self.seen = max(self.seen, end)
        self._advance()

    @property
    def hole(self) -> tuple[int, int] | None:
        """The first samples that did not come while later ones did, first .. last - 1."""
        if self.seen <= self.come:
            return None
        behind = self._known[self.come - self.first : self.seen - self.first]
        return self.come, self.come + int(np.argmax(behind))

    def give_up(self, before: int) -> None:
        """Samples before this one that have not come are lost for good: they stay NaN."""
        if before > self.come:
            self._grow(before)
            self._known[: before - self.first] = True
            self.seen = max(self.seen, before)
            self._advance()

    def take(self, samples: int) -> Float2D:
        """The next samples, (channel, sample)."""
        out = self._values[:, :samples].copy()
        self._values, self._known = self._values[:, samples:], self._known[samples:]
        self.first += samples
        return out

    def _grow(self, end: int) -> None:
        more = end - self.first - self._known.size
        if more > 0:
            more += 1024
            self._values = np.pad(self._values, ((0, 0), (0, more)), constant_values=np.nan)
            self._known = np.pad(self._known, (0, more))

    def _advance(self) -> None:
        ahead = self._known[self.come - self.first :]
        self.come += int(np.argmin(ahead)) if not ahead.all() else ahead.size


class Delivery:
    """One command on its way: which pieces are to be sent now."""

    def __init__(self, volts: Float1D) -> None:
        self._volts = volts
        self.arrived = np.zeros(math.ceil(volts.size / VALUES), dtype=np.bool_)
        self._sent_s = np.full(self.arrived.size, -math.inf)

    def heard(self, pieces: Bool1D) -> None:
        """These pieces, (PIECES,), have arrived."""
        self.arrived |= pieces[: self.arrived.size]

    def due(self, now: float) -> list[tuple[int, Float1D]]:
        """(piece, its volts) of those to be sent now."""
        under_way = ~self.arrived & (now - self._sent_s < RESEND_S)
        waiting = np.flatnonzero(~self.arrived & ~under_way)
        pieces = waiting[: max(WINDOW - int(under_way.sum()), 0)]
        self._sent_s[pieces] = now
        return [(int(p), self._volts[VALUES * p : VALUES * (p + 1)]) for p in pieces]


class Offset:
    """Time of sample 0 on our clock, from when packets say that a sample has been taken.

    A packet comes later than it left, never earlier: the earliest of a while is the nearest. Two
    clocks drift apart (50 ppm are 0.18 s an hour), so it is looked at anew every DRIFT_S.
    """

    def __init__(self, epoch_s: float, now: float) -> None:
        self.epoch_s = epoch_s
        self._next_s = math.inf
        self._until_s = now + DRIFT_S

    def heard(self, newest: int, rate_hz: float, now: float) -> None:
        """A packet that came now says that sample `newest` has been taken."""
        self._next_s = min(self._next_s, now - newest / rate_hz)
        self.epoch_s = min(self.epoch_s, self._next_s)
        if now >= self._until_s:
            self.epoch_s, self._next_s = self._next_s, math.inf
            self._until_s = now + DRIFT_S
