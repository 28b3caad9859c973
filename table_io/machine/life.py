"""One controller's life on the machine: what it queued, what the plant makes of it, until rest."""

import math
from collections import deque

import numpy as np

from table_io.backends.simulated import SimulatedBackend
from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock
from table_io.machine.blackbox import BlackBox
from table_io.machine.queued import Queued, is_still, landing
from table_io.machine.wire import Kind, Message, carry
from table_io.profile import Specimen
from table_io.rig import Rig

REST_S, REST_M = 0.2, 5e-5  # the table is at rest where it has stayed so near for so long
MOST_AHEAD = 1 << 20  # samples that are kept for later
PIECE_S = 0.25  # most that is computed at once where this process was away


class Life:
    """The machine with a specimen on it, at rest until `start`; it is told the time.

    BadInput where the machine does not sample at this rate. What it plays always ends still, at the
    mean: a command that ends in motion is brought there by a landing of the machine's own.
    """

    def __init__(self, rig: Rig, specimen: Specimen, rate_hz: float, box: BlackBox | None) -> None:
        self._clock = ManualClock()
        self.plant = SimulatedBackend(rig, specimen, rate_hz, self._clock)
        self.plant.open()
        self.plant.witness = self._witness
        self.taken = 0
        self.started = False
        self.ending = ""  # why nobody has it any more
        self.rest_from = 0  # once it is ending: the command is at its mean from here on
        self._output = rig.output
        self._span_m = 1e-3 * rig.output.span_mm
        self._box = box
        self._queued = Queued()
        self._epoch_s = math.inf
        self._held: deque[tuple[float, Message]] = deque()  # (when it is handed over, what)
        self._place_m = 0.0  # where the table is
        self._moved = 0  # sample at which it came there
        if box is not None:
            box.life(rate_hz, rig.output.volts_per_m)

    @property
    def at_rest(self) -> bool:
        """True once it is over: command and table have come to rest."""
        still = self.taken - max(self.rest_from, self._moved)
        return bool(self.ending) and still >= REST_S * self.plant.rate_hz

    def start(self, now: float) -> None:
        """Sample 0 is now."""
        self._clock.time_s = now
        self.plant.start()
        self._epoch_s = now
        self.started = True
        if self._box is not None:
            self._box.started(now)

    def queue(self, index: int, volts: Float1D, now: float) -> None:
        """Replace the command from sample `index` on; ValueError where it cannot be."""
        if not volts.size:
            raise ValueError("an empty command; send at least one value")
        if not 0 <= index <= self.taken + MOST_AHEAD - volts.size:
            raise ValueError(
                f"a command of samples {index} to {index + volts.size}; allowed: from 0 on, at "
                f"most {MOST_AHEAD} ahead"
            )
        scale, rate = self._output.volts_per_m, self.plant.rate_hz
        end = np.concatenate([self._queued.take(index - 3, index), volts])[-3:] / scale
        if np.isfinite(end).all() and not is_still(end, rate):
            volts = np.concatenate([volts, landing(end, rate, self._span_m) * scale])
        self.play(now)
        self._put(index, volts)

    def play(self, now: float) -> None:
        """Take the samples that are due; they are handed over in order, when they come."""
        self._clock.time_s = now
        rate = self.plant.rate_hz
        while self.started:
            due = math.floor((now - self._epoch_s) * rate + 1e-6) + 1 - self.taken
            due = min(due, round(PIECE_S * rate))
            if due <= 0:
                break
            first, self.taken = self.taken, self.taken + due
            comes_s = now + self.plant.late_s(first, self.taken)
            volts = self.plant.take(due)
            if not self.ending:
                self._held.append((comes_s, carry(Kind.TAKEN, volts.T, first)))

    def handed_over(self, now: float) -> list[Message]:
        """What has come by now and was not handed over."""
        out = []
        while self._held and self._held[0][0] <= now:
            out.append(self._held.popleft()[1])
        return out

    def end(self, why: str, now: float) -> float:
        """Go on alone, to the mean; the seconds until the command rests there."""
        self.play(now)
        self.ending = why
        self._held.clear()
        queued, rate = self._queued, self.plant.rate_hz
        last = queued.take(queued.end - 1, queued.end) / self._output.volts_per_m
        if abs(float(last[0])) > 0.5 * self._output.lsb_m:
            earliest = self.taken - 1 + self.plant.replace_after
            home = landing(np.repeat(last, 3), rate, self._span_m) * self._output.volts_per_m
            self._put(max(queued.end, earliest), home)
        self.rest_from = queued.end - 1
        self.note(why)
        return max(self.rest_from - self.taken, 0) / rate

    def note(self, text: str) -> None:
        """Something to remember."""
        if self._box is not None:
            self._box.note(self.taken, text)

    def _put(self, index: int, volts: Float1D) -> None:
        self.plant.queue(index, volts)
        self._queued.put(index, volts)
        self._queued.forget(self.taken - 3)
        if self._box is not None:
            self._box.queued(index, volts)

    def _witness(self, first: int, command_m: Float1D, signals: Float2D) -> None:
        """What was truly played, and what the plant did."""
        table_m = signals[0]
        if np.abs(table_m - self._place_m).max() > REST_M:
            self._place_m, self._moved = float(table_m[-1]), first + table_m.size
        if self._box is not None:
            self._box.played(first, command_m, signals)
