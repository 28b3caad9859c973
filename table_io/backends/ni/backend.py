"""The Backend contract on a DAQmx device, whose buffer holds what is queued.

Input is read by a thread of its own (`reader.py`); output and heartbeat are written by the
caller's, in every call and every wait, so a rig that hangs lets its heartbeat stop. What happens at
each error: `codes.py`. What is looked at before anything moves: `opening.py`.
"""

import contextlib
import math
from collections.abc import Callable
from typing import Any, NoReturn, TypeVar

import numpy as np
from nidaqmx.errors import DaqError, Error

from table_io.backends import HEARTBEAT_S, PATIENCE_S, MachineLost
from table_io.backends.ni import opening
from table_io.backends.ni.channel import reached
from table_io.backends.ni.codes import REMEDY, Where, lost, said
from table_io.backends.ni.entry import unwell, wired
from table_io.backends.ni.pace import Pace
from table_io.backends.ni.reader import Reader
from table_io.backends.ni.tasks import BEAT_S, BUFFER_S, Tasks
from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.machine.queued import Queued
from table_io.profile import Specimen
from table_io.rig import Rig

HOLD_S = 2.0  # of the last value, behind what is queued: so the output does not run out
LOOK_S = 0.002  # of real time, between two looks at a heartbeat that is due
PARTING_S = 0.5  # that the reader may take to end
NO_LONGER_WRITEABLE = -200289
MOST_INDEX = (1 << 31) - 1  # that the driver can place a write at

T = TypeVar("T")


class NiBackend:
    """A rig's side of one life of a DAQmx device; `channel` is a way to it that is open already."""

    def __init__(
        self, rig: Rig, specimen: Specimen, rate_hz: float, clock: Clock, channel: Any = None
    ) -> None:
        self._wiring = wired(rig)
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = opening.replaceable(rig, rate_hz)
        self._rig, self._clock, self._channel = rig, clock, channel
        self._tasks: Tasks | None = None
        self._reader: Reader | None = None
        self._pace: Pace | None = None
        self._queued = Queued()
        self._written = 0  # samples of output that the driver has
        self._come: list[Float2D] = []  # that were not read, (channel, sample)
        self._taken = 0  # samples that have come
        self._read = 0
        self._beat_s = 0.0
        self._lost = ""  # why the device does not answer any more

    def open(self) -> None:
        """Claim the device; waits where the table still comes to rest. Plays zeros, to be sure."""
        rig, rate, clock = self._rig, self.rate_hz, self._clock
        rig.refuse_rate(rate)
        if self._wiring.endpoint and self._channel is None:
            self._channel = reached(rig, self._wiring.endpoint)
        try:
            if self._channel is not None:
                opening.cleared(rig, self._channel, clock)
            tasks = Tasks(rig, rate, self._channel)
            try:
                opening.sampled(tasks, rate)
                opening.at_rest(rig, tasks, rate, clock)
                opening.rehearsed(rig, tasks, rate)
            finally:
                tasks.clear()  # used up: they have played
            clock.wait_until(clock.now() + opening.SETTLED_S)
            tasks = Tasks(rig, rate, self._channel)
        except Error as error:
            code = error.error_code if isinstance(error, DaqError) else 0
            see = "see the [ni] table, and NI MAX for what the device can do"
            raise BadInput(
                f"rig {rig.name}: the device does not do what the card asks: {said(error)}; "
                f"{REMEDY.get(code, see)}"
            ) from None
        self._tasks = tasks
        self._reader = Reader(tasks.read)
        self._beat_s = -math.inf
        self._beat()  # from now on, so that a latch that fell with it can be reset before a start

    def tare(self, samples: int) -> Float2D:
        """Volts at rest before precompression, (channel, sample)."""
        tasks = self._alive()

        def look() -> Float2D:
            return opening.look(tasks, samples, self.rate_hz, self._beat)

        return self._driven("input", look)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, (sample,); the last value is held."""
        self._alive()
        earliest = 0 if self._pace is None else self._newest() + self.replace_after
        if index < earliest:
            raise ValueError(
                f"the command from sample {index} on is already in the device; allowed: from "
                f"{earliest} on ({self.replace_after} after the newest sample taken)"
            )
        if not volts.size or not np.isfinite(volts).all():
            raise ValueError(
                f"the command from sample {index} on is empty or holds NaN or inf; send volts"
            )
        self._beat()
        end = index + volts.size
        most = (0 if self._pace is None else self._newest()) + round(BUFFER_S * self.rate_hz)
        if end + round(HOLD_S * self.rate_hz) > most:
            raise ValueError(
                f"a command up to sample {end}; allowed: {BUFFER_S - HOLD_S:g} s ahead, as much as "
                "the driver holds"
            )
        first = min(index, self._written)
        self._place(first, np.append(self._queued.take(first, index), volts))
        self._queued.put(index, volts)
        self._queued.forget(self._taken - 3)

    def start(self) -> None:
        """Start output and input at sample 0: the output waits for the trigger of the input."""
        tasks = self._alive()
        if self._pace is not None:
            raise RuntimeError("NI device: it runs already; one start() a life")
        moves = self._queued.take(0, self._queued.end).any()  # else a latch may be reset now
        if moves and (low := unwell(self._wiring, self._channel)):
            self._lose("start", RuntimeError(low))
        self._driven("start", tasks.output.start)
        self._beat()
        # The early end of what is not known better. Before the call: its answer may be lost.
        self._pace = Pace(self.rate_hz, self._clock.now())
        try:
            tasks.input.start()
        except DaqError as error:
            self._pace = None
            self._lose("start", error)
        except Error as error:
            self._lose("server", error)

    def read(self, samples: int) -> Float2D:
        """Volts of the next samples, (channel, sample), when they have been taken."""
        last = self._read + samples
        until = self.scheduled(last - 1) + PATIENCE_S
        self._alive()
        self._beat()
        while self._taken < last:
            self._fetch(last, until)
            self._beat()
        whole = np.concatenate([np.empty((len(self.channels), 0)), *self._come], axis=1)
        self._come = [whole[:, samples:]]
        self._read = last
        return whole[:, :samples]

    def scheduled(self, index: int) -> float:
        """Time on the session's clock at which sample `index` is taken, in s; see `pace.py`."""
        if self._pace is None:
            raise RuntimeError("NI device: start() comes first")
        return self._pace.epoch_s + index / self.rate_hz

    def close(self) -> None:
        """Release the device once it has played what is queued: a stop would freeze the voltage."""
        tasks = self._tasks
        if tasks is None:
            return
        self._play_out()
        self._tasks = None
        tasks.clear()
        if self._reader is not None:
            self._reader.close(PARTING_S)

    def _play_out(self) -> None:
        """Wait until what is queued has been played; the heartbeat goes on if nothing is lost."""
        until = 0.0 if self._pace is None else self.scheduled(self._queued.end)
        while self._clock.now() < until:
            if not self._lost:
                with contextlib.suppress(MachineLost):
                    self._beat()
            self._clock.wait_until(min(until, self._clock.now() + BEAT_S))

    def _fetch(self, last: int, until: float) -> None:
        """Wait for the next samples, up to `last`; the heartbeat goes on."""
        assert self._reader is not None
        reader, piece = self._reader, round(BEAT_S * self.rate_hz)
        count = min(last - self._taken, piece)  # a heartbeat goes between
        reader.ask(count)
        while True:
            try:
                come = reader.come(LOOK_S)
                if come is None and self._clock.now() > until:
                    raise TimeoutError(
                        f"the samples up to {last - 1} have not come, {PATIENCE_S:g} s after their "
                        "schedule"
                    )
            except (Error, TimeoutError) as error:
                self._play_out()  # blind, but smoothly: the interlock need not act
                self._lose("input", error)
            if come is not None:
                break
            self._beat()
        self._come.append(come)
        self._taken += count
        if self._pace is not None:
            self._pace.came(self._taken - 1, self._clock.now())

    def _beat(self) -> None:
        """Keep heartbeat and output alive, where they are due."""
        tasks = self._tasks
        if tasks is None:
            return
        if self._away_s() >= BEAT_S:
            if self._pace is not None and self._driven("output", tasks.output.is_task_done):
                self._lose("output", RuntimeError("it has ended by itself"))
            before_s = self._clock.now()
            self._driven("heartbeat", tasks.beat)
            self._away_s()  # the edge may have left so late
            self._beat_s = before_s
        if self._pace is None:
            return
        if self._written - self._newest() < 0.5 * HOLD_S * self.rate_hz:
            try:
                self._place(self._written, self._queued.take(self._written, self._written + 1))
            except ValueError as error:
                self._lose("output", error)

    def _away_s(self) -> float:
        """How long the line may have been silent by now; MachineLost where the machine moves on."""
        away_s = self._clock.now() - self._beat_s
        if self._pace is not None and away_s > HEARTBEAT_S:
            away = f"this rig was away for {away_s:.2f} s, and the machine goes on without it"
            self._lose("heartbeat", TimeoutError(away))
        return away_s

    def _place(self, first: int, volts: Float1D) -> None:
        """Hand output over to the driver, with a hold behind it that reaches beyond all before.

        ValueError where the device has it already.
        """
        assert self._tasks is not None
        tasks, newest = self._tasks, 0 if self._pace is None else self._newest()
        end = max(first + volts.size, newest) + round(HOLD_S * self.rate_hz)
        end = max(end, self._written)
        if end > MOST_INDEX:
            self._lose("counter", RuntimeError(f"the driver counts to sample {MOST_INDEX}"))
        padded = np.append(volts, np.full(end - first - volts.size, volts[-1]))
        try:
            tasks.write(first, padded)
        except DaqError as error:
            late = error.error_code == NO_LONGER_WRITEABLE
            if late and not self._driven("output", tasks.output.is_task_done):
                raise ValueError(f"the device has this command already: {said(error)}") from None
            self._lose("output", error)
        except Error as error:
            self._lose("server", error)
        self._written = end

    def _newest(self) -> int:
        """The newest sample that the machine has taken by now, read or not."""
        since = self._clock.now() - self.scheduled(0)
        return max(self._taken - 1, math.floor(since * self.rate_hz + 1e-6))

    def _driven(self, where: Where, act: Callable[[], T]) -> T:
        """What the driver answers; its error is MachineLost."""
        try:
            return act()
        except Error as error:
            self._lose(where, error)

    def _lose(self, where: Where, error: Exception) -> NoReturn:
        """The device is lost, for good: MachineLost says why and what happens now."""
        spoke = isinstance(error, DaqError) or not isinstance(error, Error)
        self._lost = self._lost or lost(where if spoke else "server", error, self._pace is not None)
        raise MachineLost(self._lost) from None

    def _alive(self) -> Tasks:
        if self._lost:
            raise MachineLost(self._lost)
        if self._tasks is None:
            raise RuntimeError("NI device: it is closed, or open() was not called")
        return self._tasks
