"""A DAQmx device and its driver as a model that is told the time: tasks, buffers, clocks, errors.

Sample i of a task is taken, or leaves, at its start + i / rate. The PC buffer of an output is
filled by writes, placed or one after another; `held` samples ahead of the output lie in the device,
where nothing reaches them. Where the model had a choice, it is the unfriendly one: what lies behind
the end of the last write is forgotten, and an output that errs or is stopped freezes its voltage.
Simplified: a write that finds no room fails at once; sample clocks are exact.
"""

import contextlib
from typing import Protocol

import numpy as np

from table_io.backends.ni.task import FIRST_SAMPLE, Code, DriverError, Task
from table_io.block import Float1D, Float2D
from table_io.machine.queued import Queued
from table_io.wiring.ni import NiFault

STEP_S = 0.01  # most that is played between two transfers; `held` is longer
MOST_SESSIONS = 64


class Table(Protocol):
    """What stands behind the device."""

    @property
    def moving(self) -> bool:
        """True from a start until rest."""

    def arm(self, rate_hz: float) -> None:
        """Be ready to start at this rate; DriverError where it still moves."""

    def feed(self, index: int, volts: Float1D) -> None:
        """The output plays these from sample `index` on, and then holds the last."""

    def start(self, now: float) -> None:
        """Output sample 0 is now."""

    def freeze(self, why: str) -> None:
        """The output holds its voltage from now on; no task drives it."""

    def beat(self, now: float) -> None:
        """The heartbeat line has changed."""

    def play(self, now: float) -> list[Float2D]:
        """Move up to now; the volts of the inputs that have come, (channel, sample)."""

    def resting(self, rate_hz: float, samples: int) -> Float2D:
        """Volts of the inputs at rest, (channel, sample)."""


class Device:
    """One device with one input, one output and one line."""

    def __init__(self, table: Table, rates_hz: tuple[float, ...], now: float) -> None:
        self.faults: list[NiFault] = []
        self._table = table
        self.rates_hz = rates_hz
        self._tasks: dict[int, Task] = {}
        self._numbers = 0
        self._now = now

    @property
    def tasks(self) -> tuple[Task, ...]:
        return tuple(self._tasks.values())

    @property
    def moving(self) -> bool:
        return self._table.moving

    def create(self, name: str, how: int) -> tuple[Task, bool]:
        """(a session, True where it is a new one); `how` 0: either, 1: new, 2: an existing one."""
        there = [task for task in self.tasks if task.name == name and name]
        if there and how != 1:
            return there[0], False
        if there or how == 2 or len(self._tasks) >= MOST_SESSIONS:
            raise KeyError(name)
        self._numbers += 1
        task = Task(name or f"_unnamedTask<{self._numbers}>", self._numbers)
        self._tasks[task.number] = task
        return task, True

    def task(self, number: int) -> Task:
        """A task by its number."""
        try:
            return self._tasks[number]
        except KeyError:
            raise DriverError(Code.INVALID_TASK) from None

    def channel(self, task: Task, kind: str, physical: str) -> None:
        """Add a channel to a task."""
        if task.kind not in ("", kind):
            raise DriverError(Code.NOT_SUPPORTED)
        task.kind = kind
        task.channels.append(physical)

    def timing(self, task: Task, rate_hz: float, clock: str, samples: int) -> None:
        """Continuous samples at a rate, and a buffer of at least so many."""
        if not task.channels:
            raise DriverError(Code.NO_CHANNELS)
        if rate_hz not in self.rates_hz:
            raise DriverError(Code.INVALID_VALUE)
        task.rate_hz, task.clock, task.buffer = rate_hz, clock, max(samples, 2)

    def reserve(self, task: Task) -> None:
        """Have the device's part that a task needs; it keeps it until it is cleared."""
        if any(one.reserved and one.kind == task.kind and one is not task for one in self.tasks):
            raise DriverError(Code.RESERVED)
        task.reserved = True

    def start(self, task: Task, now: float) -> None:
        """Start a task; an output with a trigger waits for the input that gives it."""
        self.advance(now)
        if task.kind == "ai":
            self._inject("start", task, now)
        if task.running or task.armed:
            return
        if any(one.kind == task.kind and (one.running or one.armed) for one in self.tasks):
            raise DriverError(Code.RESERVED)
        task.error = 0
        if task.kind == "ao":
            if task.written < min(task.held, task.buffer):
                raise DriverError(Code.NOT_ENOUGH_WRITTEN)
            self._table.arm(task.rate_hz)
            task.armed = True
            if not task.trigger:
                self._trigger(task, now)
        elif task.kind == "ai":
            task.come, task.unread, task.total = [], 0, 0
            task.running, task.since_s = True, now
            for one in self.tasks:
                if one.armed and one.trigger.endswith("/ai/StartTrigger"):
                    self._trigger(one, now)
        else:
            task.running = True

    def stop(self, task: Task, now: float, why: str = "stopped") -> None:
        """Stop a task; what an output has not played is forgotten, and its voltage freezes."""
        self.advance(now)
        if task.kind == "ao" and task.running:
            at = task.generated(now)
            self._table.feed(at, task.volts.take(at - 1, at))
            self._table.freeze(f"output {why} at sample {at}")
        if task.kind == "ai":
            for one in self.tasks:
                if one.running and one.clock.endswith("/ai/SampleClock"):
                    self.stop(one, now, "without a clock")
        task.running = task.armed = False
        task.volts, task.written, task.transferred = Queued(), 0, 0

    def clear(self, task: Task, now: float) -> None:
        """Stop a task and forget it."""
        self.stop(task, now)
        self._tasks.pop(task.number, None)

    def done(self, task: Task, now: float) -> bool:
        """True where a task does not run; the error that ended it is raised."""
        self.advance(now)
        if task.error:
            raise DriverError(task.error)
        return not (task.running or task.armed)

    def write(self, task: Task, volts: Float1D, now: float) -> None:
        """Write an output's buffer where its placement says."""
        self.advance(now)
        self._inject("write", task, now)
        if task.error:
            raise DriverError(task.error)
        first = task.offset + (0 if task.relative_to == FIRST_SAMPLE else task.written)
        generated = task.generated(now)
        if first < 0:
            raise DriverError(Code.NEGATIVE_WRITE)
        if first < task.transferred:
            raise DriverError(Code.NO_LONGER_WRITEABLE)
        if first + volts.size > generated + task.buffer:
            raise DriverError(Code.NOT_YET_WRITEABLE if task.running else Code.NO_MORE_SPACE)
        if first > task.written:  # nobody has said what lies between
            raise DriverError(Code.NOT_YET_WRITEABLE)
        task.volts.put(first, volts)
        task.written = first + volts.size

    def line(self, task: Task, now: float) -> None:
        """The heartbeat line has been written."""
        self.advance(now)
        self._inject("heartbeat", task, now)
        if task.error:
            raise DriverError(task.error)
        self._table.beat(now)

    def ready(self, task: Task, samples: int, now: float) -> bool:
        """True where so many samples of input have come; the error that ended them is raised."""
        self.advance(now)
        self._inject("read", task, now)
        if task.error:
            raise DriverError(task.error)
        if not task.running:
            raise DriverError(Code.NOT_YET_AVAILABLE)
        return task.unread >= samples

    def read(self, task: Task, samples: int) -> Float2D:
        """The next samples of input, (channel, sample), as many as have come."""
        whole = np.concatenate([np.empty((len(task.channels), 0)), *task.come], axis=1)
        task.come = [whole[:, samples:]]
        task.unread = task.come[0].shape[1]
        return whole[:, :samples]

    def advance(self, now: float) -> None:
        """Let everything happen that happens by now."""
        while self._now < now:
            busy = self._table.moving or any(task.running for task in self.tasks)
            self._now = min(now, self._now + STEP_S) if busy else now
            for task in self.tasks:
                if task.kind == "ao" and task.running:
                    self._transfer(task)
                    with contextlib.suppress(DriverError):  # nobody is there to be told
                        self._inject("output", task, self._now)
            come = self._table.play(self._now)
            for task in self.tasks:
                if task.kind == "ai" and task.running:
                    self._acquire(task, come)

    def _transfer(self, task: Task) -> None:
        """Bring output into the device; without new samples it ends, or begins anew."""
        due = task.due(self._now)
        first, last = task.transferred, due + task.held
        if task.regenerates:
            again = np.arange(first, last) % task.written
            volts = task.volts.take(0, task.written)[again]
        else:
            last = min(last, task.written)
            volts = task.volts.take(first, last)
            task.volts.forget(due - 3)
        if volts.size:
            self._table.feed(first, volts)
            task.transferred = last
        if due > task.transferred:
            task.error = Code.STOPPED_TO_PREVENT_REGENERATION
            task.running = False
            self._table.freeze(f"output ran out at sample {task.transferred}")

    def _acquire(self, task: Task, come: list[Float2D]) -> None:
        """Take in input; what nobody fetches ends it."""
        if not self._table.moving and (missing := task.due(self._now) - task.total) > 0:
            come = [*come, self._table.resting(task.rate_hz, missing)]
        for volts in come:
            task.come.append(volts)
            task.unread += volts.shape[1]
            task.total += volts.shape[1]
        if task.unread > task.buffer:
            self._fail(task, Code.NO_LONGER_AVAILABLE)

    def _trigger(self, task: Task, now: float) -> None:
        """The first sample leaves now."""
        task.transferred = min(task.held, task.written)
        self._table.feed(0, task.volts.take(0, task.transferred))
        self._table.start(now)
        task.armed, task.running, task.since_s = False, True, now

    def _fail(self, task: Task, code: int) -> None:
        self.stop(task, self._now, f"ended by error {code}")
        task.error = code

    def _inject(self, call: str, task: Task, now: float) -> None:
        """A planted error whose time has come ends the task."""
        for fault in self.faults:
            since = [one.since_s for one in self.tasks if one.kind == "ao" and one.running]
            due = call == "start" or (since and now >= since[0] + fault.at_s)
            if fault.call == call and due:
                self.faults.remove(fault)
                self._fail(task, fault.code)
                raise DriverError(fault.code)
