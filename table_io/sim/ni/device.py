"""Model of a DAQmx device and its driver: tasks, buffers, clocks, errors. The caller supplies time.

Sample i of a task is taken, or leaves, at its start + i / rate. The PC buffer of an output is
filled by writes, placed or appended; the next `onboard_samples` of output are in the device and
cannot be replaced. Where DAQmx is not specified, the model takes the worst case: samples after the
end of the last write are discarded, and an output that fails or is stopped freezes its voltage.
Simplifications: a write without room fails at once; sample clocks are exact.
"""

import contextlib
import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Protocol

import numpy as np

from table_io.backends.command_buffer import CommandBuffer, SampleBuffer
from table_io.backends.ni.config import NiFault
from table_io.block import Float1D, Float2D

DEFAULT_FIFO_SAMPLES = 8191
MIN_ONBOARD_S = 0.02  # smallest onboard buffer
WHEN_NOT_FULL, WHEN_EMPTY = 10242, 10235  # DAQmx: condition of a transfer to the device
FIRST_SAMPLE, CURRENT_POSITION = 10424, 10430  # DAQmx: reference of the write offset


class ErrorCode(IntEnum):
    """DAQmx codes of the errors that the model raises."""

    RESERVED = -50103
    INVALID_VALUE = -200077
    INVALID_TASK = -200088
    NO_SUCH_CHANNEL = -200170
    NO_LONGER_AVAILABLE = -200279
    NOT_YET_AVAILABLE = -200284
    NEGATIVE_WRITE = -200287
    NO_LONGER_WRITEABLE = -200289
    STOPPED_TO_PREVENT_REGENERATION = -200290
    NOT_YET_WRITEABLE = -200292
    NO_MORE_SPACE = -200293
    NOT_ENOUGH_WRITTEN = -200294
    NOT_SUPPORTED = -200452
    NO_CHANNELS = -200478


class DriverError(Exception):
    """Error of the driver, with its DAQmx code."""

    def __init__(self, code: int, details: str = "") -> None:
        super().__init__(f"driver error {code}")
        self.code = code
        self.details = details  # further lines of the message, as "Physical Channel Name: Dev1/ai0"


@dataclass(slots=True, eq=False)
class Task:
    """Task and its session; `kind` is ai, ao, di or do, empty while it has no channel."""

    name: str
    number: int
    kind: str = ""
    channels: list[str] = field(default_factory=list)
    rate_hz: float = 0.0
    buffer: int = 0
    trigger: str = ""
    clock: str = ""
    regenerates: bool = True
    relative_to: int = CURRENT_POSITION
    offset: int = 0
    transfer_condition: int = WHEN_NOT_FULL
    fifo_samples: int = DEFAULT_FIFO_SAMPLES
    reserved: bool = False
    running: bool = False
    armed: bool = False  # started, waiting for its trigger
    error: int = 0  # code of the error that ended it; 0: none
    since_s: float = 0.0  # time of sample 0
    volts: CommandBuffer = field(default_factory=CommandBuffer)  # output
    written: int = 0  # samples of output; an appended write begins here
    transferred: int = 0
    samples: SampleBuffer = field(default_factory=lambda: SampleBuffer(0))  # input

    @property
    def onboard_samples(self) -> int:
        """Samples of output that the device holds in advance."""
        min_samples = math.ceil(MIN_ONBOARD_S * self.rate_hz)
        max_samples = max(self.fifo_samples, min_samples)
        return min_samples if self.transfer_condition == WHEN_EMPTY else max_samples

    def due_samples(self, now_s: float) -> int:
        """Return the number of ticks of the sample clock up to `now_s`."""
        return math.floor((now_s - self.since_s) * self.rate_hz + 1e-6) + 1 if self.running else 0

    def generated_samples(self, now_s: float) -> int:
        return min(self.due_samples(now_s), self.transferred)


MAX_STEP_S = 0.01  # between two transfers to the device; `onboard_samples` last longer
MAX_SESSIONS = 64


class DrivenTable(Protocol):
    """Table that the device drives."""

    @property
    def moving(self) -> bool:
        """True from a start until rest."""

    def arm(self, rate_hz: float) -> None:
        """Prepare a start at this rate; DriverError if the table still moves."""

    def feed(self, index: int, volts: Float1D) -> None:
        """Play these volts, (sample,), from sample `index` on, then hold the last one."""

    def start(self, now_s: float) -> None:
        """Start with output sample 0 at `now_s`."""

    def freeze(self, reason: str) -> None:
        """Freeze the output voltage, as no task drives it any longer."""

    def receive_heartbeat(self, now_s: float) -> None:
        """Register an edge of the heartbeat line at `now_s`."""

    def play(self, now_s: float) -> list[Float2D]:
        """Advance to `now_s`; return input volts that have arrived, (channel, sample) each."""

    def read_at_rest(self, rate_hz: float, samples: int) -> Float2D:
        """Return input volts at rest, (channel, sample)."""


class SimulatedDaqDevice:
    """Device with one input task, one output task and one digital line."""

    def __init__(self, table: DrivenTable, rates_hz: tuple[float, ...], now_s: float) -> None:
        self.faults: list[NiFault] = []
        self._table = table
        self.rates_hz = rates_hz
        self._tasks: dict[int, Task] = {}
        self._last_number = 0
        self._now_s = now_s

    @property
    def tasks(self) -> tuple[Task, ...]:
        return tuple(self._tasks.values())

    @property
    def moving(self) -> bool:
        return self._table.moving

    def create_task(self, name: str, behavior: int) -> tuple[Task, bool]:
        """Return (task, True if new); KeyError if `behavior` cannot be met.

        `behavior` 0: create or attach, 1: create, 2: attach.
        """
        matches = [task for task in self.tasks if task.name == name and name]
        if matches and behavior != 1:
            return matches[0], False
        if matches or behavior == 2 or len(self._tasks) >= MAX_SESSIONS:
            raise KeyError(name)
        self._last_number += 1
        task = Task(name or f"_unnamedTask<{self._last_number}>", self._last_number)
        self._tasks[task.number] = task
        return task, True

    def find_task(self, number: int) -> Task:
        """Return a task by its number; DriverError if there is none."""
        try:
            return self._tasks[number]
        except KeyError:
            raise DriverError(ErrorCode.INVALID_TASK) from None

    def add_channel(self, task: Task, kind: str, physical: str) -> None:
        """Add a channel to a task."""
        if task.kind not in ("", kind):
            raise DriverError(ErrorCode.NOT_SUPPORTED)
        task.kind = kind
        task.channels.append(physical)

    def configure_timing(self, task: Task, rate_hz: float, clock: str, samples: int) -> None:
        """Configure continuous sampling at `rate_hz` and a buffer of `samples`."""
        if not task.channels:
            raise DriverError(ErrorCode.NO_CHANNELS)
        if rate_hz not in self.rates_hz:
            raise DriverError(ErrorCode.INVALID_VALUE)
        task.rate_hz, task.clock, task.buffer = rate_hz, clock, max(samples, 2)

    def reserve(self, task: Task) -> None:
        """Reserve the subsystem that a task needs, until the task is cleared."""
        if any(
            other.reserved and other.kind == task.kind and other is not task for other in self.tasks
        ):
            raise DriverError(ErrorCode.RESERVED)
        task.reserved = True

    def start(self, task: Task, now_s: float) -> None:
        """Start a task; an output with a trigger waits for the input task that generates it."""
        self.advance(now_s)
        if task.kind == "ai":
            self._inject("start", task, now_s)
        if task.running or task.armed:
            return
        if any(other.kind == task.kind and (other.running or other.armed) for other in self.tasks):
            raise DriverError(ErrorCode.RESERVED)
        task.error = 0
        if task.kind == "ao":
            if task.written < min(task.onboard_samples, task.buffer):
                raise DriverError(ErrorCode.NOT_ENOUGH_WRITTEN)
            self._table.arm(task.rate_hz)
            task.armed = True
            if not task.trigger:
                self._trigger(task, now_s)
        elif task.kind == "ai":
            task.samples = SampleBuffer(len(task.channels))
            task.running, task.since_s = True, now_s
            for other in self.tasks:
                if other.armed and other.trigger.endswith("/ai/StartTrigger"):
                    self._trigger(other, now_s)
        else:
            task.running = True

    def stop(self, task: Task, now_s: float, reason: str = "stopped") -> None:
        """Stop a task; an output discards its unplayed samples and freezes its voltage."""
        self.advance(now_s)
        if task.kind == "ao" and task.running:
            sample = task.generated_samples(now_s)
            self._table.feed(sample, task.volts.values(sample - 1, sample))
            self._table.freeze(f"output {reason} at sample {sample}")
        if task.kind == "ai":
            for other in self.tasks:
                if other.running and other.clock.endswith("/ai/SampleClock"):
                    self.stop(other, now_s, "without a clock")
        task.running = task.armed = False
        task.volts, task.written, task.transferred = CommandBuffer(), 0, 0

    def clear(self, task: Task, now_s: float) -> None:
        """Stop a task and remove it."""
        self.stop(task, now_s)
        self._tasks.pop(task.number, None)

    def is_done(self, task: Task, now_s: float) -> bool:
        """Return True if a task is not running; raise the error that ended it."""
        self.advance(now_s)
        if task.error:
            raise DriverError(task.error)
        return not (task.running or task.armed)

    def write(self, task: Task, volts: Float1D, now_s: float) -> None:
        """Write to an output's buffer at the position set by `relative_to` and `offset`."""
        self.advance(now_s)
        self._inject("write", task, now_s)
        if task.error:
            raise DriverError(task.error)
        first = task.offset + (0 if task.relative_to == FIRST_SAMPLE else task.written)
        generated = task.generated_samples(now_s)
        if first < 0:
            raise DriverError(ErrorCode.NEGATIVE_WRITE)
        if first < task.transferred:
            raise DriverError(ErrorCode.NO_LONGER_WRITEABLE)
        if first + volts.size > generated + task.buffer:
            raise DriverError(
                ErrorCode.NOT_YET_WRITEABLE if task.running else ErrorCode.NO_MORE_SPACE
            )
        if first > task.written:  # a gap in the command
            raise DriverError(ErrorCode.NOT_YET_WRITEABLE)
        task.volts.replace_from(first, volts)
        task.written = first + volts.size

    def write_line(self, task: Task, now_s: float) -> None:
        """Write the heartbeat line."""
        self.advance(now_s)
        self._inject("heartbeat", task, now_s)
        if task.error:
            raise DriverError(task.error)
        self._table.receive_heartbeat(now_s)

    def samples_ready(self, task: Task, samples: int, now_s: float) -> bool:
        """Return True if `samples` of input have arrived; raise the error that ended the task."""
        self.advance(now_s)
        self._inject("read", task, now_s)
        if task.error:
            raise DriverError(task.error)
        if not task.running:
            raise DriverError(ErrorCode.NOT_YET_AVAILABLE)
        return task.samples.unread >= samples

    def read(self, task: Task, samples: int) -> Float2D:
        """Remove and return up to `samples` samples of input, (channel, sample)."""
        return task.samples.take(samples)

    def advance(self, now_s: float) -> None:
        """Advance outputs, table and inputs to `now_s`."""
        while self._now_s < now_s:
            busy = self._table.moving or any(task.running for task in self.tasks)
            self._now_s = min(now_s, self._now_s + MAX_STEP_S) if busy else now_s
            for task in self.tasks:
                if task.kind == "ao" and task.running:
                    self._transfer(task)
                    with contextlib.suppress(DriverError):  # no call is there to report it to
                        self._inject("output", task, self._now_s)
            come = self._table.play(self._now_s)
            for task in self.tasks:
                if task.kind == "ai" and task.running:
                    self._acquire(task, come)

    def _transfer(self, task: Task) -> None:
        """Transfer output into the device; underrun ends the task unless it regenerates."""
        due = task.due_samples(self._now_s)
        first, last = task.transferred, due + task.onboard_samples
        if task.regenerates:
            indices = np.arange(first, last) % task.written
            volts = task.volts.values(0, task.written)[indices]
        else:
            last = min(last, task.written)
            volts = task.volts.values(first, last)
            task.volts.discard_before(due - 3)
        if volts.size:
            self._table.feed(first, volts)
            task.transferred = last
        if due > task.transferred:
            task.error = ErrorCode.STOPPED_TO_PREVENT_REGENERATION
            task.running = False
            self._table.freeze(f"output ran out at sample {task.transferred}")

    def _acquire(self, task: Task, come: list[Float2D]) -> None:
        """Add input to the buffer of the task; an overflow ends it."""
        if (
            not self._table.moving
            and (missing := task.due_samples(self._now_s) - task.samples.received) > 0
        ):
            come = [*come, self._table.read_at_rest(task.rate_hz, missing)]
        for volts in come:
            task.samples.put(volts)
        if task.samples.unread > task.buffer:
            self._fail(task, ErrorCode.NO_LONGER_AVAILABLE)

    def _trigger(self, task: Task, now_s: float) -> None:
        """Start an armed output: its first sample leaves at `now_s`."""
        task.transferred = min(task.onboard_samples, task.written)
        self._table.feed(0, task.volts.values(0, task.transferred))
        self._table.start(now_s)
        task.armed, task.running, task.since_s = False, True, now_s

    def _fail(self, task: Task, code: int) -> None:
        self.stop(task, self._now_s, f"ended by error {code}")
        task.error = code

    def _inject(self, call: str, task: Task, now_s: float) -> None:
        """End the task with an injected fault that is due, and raise it."""
        for fault in self.faults:
            since = [other.since_s for other in self.tasks if other.kind == "ao" and other.running]
            due = call == "start" or (since and now_s >= since[0] + fault.at_s)
            if fault.call == call and due:
                self.faults.remove(fault)
                self._fail(task, fault.code)
                raise DriverError(fault.code)
