"""Backend for a DAQmx device, whose output buffer holds the queued command.

A separate thread reads the inputs (`InputReader`). Output and heartbeat are written by the caller's
thread in every call and every wait, so the heartbeat of a rig that hangs stops. `driver.py` states
the consequence of each driver error, `tasks.py` has the checks before anything moves.

The device's clock differs from the computer's by 10 to 50 ppm, 36 to 180 ms in an hour. The time of
sample 0 therefore follows two rules: no sample arrives before it is taken, and the smallest delay
in each window of samples equals the smallest delay in the first window.
"""

import contextlib
import math
import threading
from collections.abc import Callable
from queue import Empty, Queue
from typing import Any, NoReturn, TypeVar

import numpy as np
from nidaqmx.errors import DaqError, Error

from table_io.backends import HEARTBEAT_TIMEOUT_S, SAMPLE_TIMEOUT_S, MachineLost
from table_io.backends.command_buffer import (
    CommandBuffer,
    SampleBuffer,
    find_newest_sample,
    refuse_late_command,
)
from table_io.backends.ni.driver import (
    REMEDIES,
    ErrorSource,
    connect_server,
    describe_error,
    describe_interlock_fault,
    describe_loss,
    require_ni_wiring,
)
from table_io.backends.ni.tasks import (
    BUFFER_S,
    HEARTBEAT_PERIOD_S,
    SETTLE_S,
    RigTasks,
    clear_leftover_tasks,
    read_at_rest,
    replace_after_samples,
    require_rest,
    verify_output_replacement,
    verify_sample_rate,
)
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError

WINDOW_S = 5.0
MAX_SHIFT_S = 1e-3  # correction per window, at most: 200 ppm


class ClockSync:
    """Estimate of `epoch_s`, the time of sample 0 in s, from the arrival times of samples."""

    def __init__(self, rate_hz: float, epoch_s: float) -> None:
        self.epoch_s = epoch_s
        self._rate_hz = rate_hz
        self._reference_delay_s: float | None = None
        self._min_delay_s = math.inf
        self._window_start = 0

    def update(self, last: int, now_s: float) -> None:
        """Update the estimate: sample `last` had arrived at `now_s`, in s."""
        delay_s = now_s - last / self._rate_hz - self.epoch_s
        if delay_s < 0:
            self.epoch_s += delay_s
            delay_s = 0.0
        self._min_delay_s = min(self._min_delay_s, delay_s)
        if last < self._window_start + WINDOW_S * self._rate_hz:
            return
        if self._reference_delay_s is None:
            self._reference_delay_s = self._min_delay_s
        shift_s = self._min_delay_s - self._reference_delay_s
        self.epoch_s += max(-MAX_SHIFT_S, min(shift_s, MAX_SHIFT_S))
        self._window_start, self._min_delay_s = last, math.inf


ReadInputs = Callable[[int], Float2D]


class InputReader:
    """Reader thread for one request at a time: a driver that hangs does not block the caller."""

    def __init__(self, read_inputs: ReadInputs) -> None:
        self._read_inputs = read_inputs
        self._requests: Queue[int] = Queue(1)
        self._results: Queue[Float2D | Exception] = Queue(1)
        self._thread = threading.Thread(target=self._run, name="input", daemon=True)
        self._thread.start()

    def request(self, samples: int) -> None:
        """Request the next `samples` samples, 1 or more."""
        self._requests.put_nowait(samples)

    def poll(self, timeout_s: float) -> Float2D | None:
        """Return the requested volts, (channel, sample), or None; raise the error of the read."""
        try:
            result = self._results.get(timeout=timeout_s)
        except Empty:
            return None
        if isinstance(result, Exception):
            raise result
        return result

    def close(self, timeout_s: float) -> None:
        """End the thread; abandon it if the driver blocks it longer than the timeout."""
        if self._requests.empty():
            self._requests.put_nowait(0)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while samples := self._requests.get():
            try:
                self._results.put(self._read_inputs(samples))
            except Exception as error:
                self._results.put(error)


HOLD_S = 2.0  # of the last value after the queued command, against an output underrun
POLL_S = 0.002  # of real time, between checks whether a heartbeat is due
READER_CLOSE_TIMEOUT_S = 0.5  # for the reader thread to end
NO_LONGER_WRITEABLE = -200289
MAX_WRITE_INDEX = (1 << 31) - 1  # last sample at which the driver can place a write

T = TypeVar("T")


class NiBackend:
    """Rig's side of one connection to a DAQmx device; `channel` is an open gRPC channel."""

    def __init__(
        self, rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock, channel: Any = None
    ) -> None:
        self._wiring = require_ni_wiring(rig)
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = replace_after_samples(rig, rate_hz)
        self._rig, self._clock, self._channel = rig, clock, channel
        self._tasks: RigTasks | None = None
        self._reader: InputReader | None = None
        self._clock_sync: ClockSync | None = None
        self._commands = CommandBuffer()
        self._written = 0  # samples of output handed to the driver
        self._samples = SampleBuffer(len(rig.channels))
        self._last_beat_s = 0.0
        self._loss_reason = ""  # why the device is lost; empty: it is not

    def open(self) -> None:
        """Claim the device once the table is at rest; plays zeros to test output replacement."""
        rig, rate, clock = self._rig, self.rate_hz, self._clock
        rig.check_rate(rate)
        if self._wiring.endpoint and self._channel is None:
            self._channel = connect_server(rig, self._wiring.endpoint)
        try:
            if self._channel is not None:
                clear_leftover_tasks(rig, self._channel, clock)
            tasks = RigTasks(rig, rate, self._channel)
            try:
                verify_sample_rate(tasks, rate)
                require_rest(rig, tasks, rate, clock)
                verify_output_replacement(rig, tasks, rate)
            finally:
                tasks.clear()  # tasks that have played cannot be started again at sample 0
            clock.wait_until(clock.now() + SETTLE_S)
            tasks = RigTasks(rig, rate, self._channel)
        except Error as error:
            code = error.error_code if isinstance(error, DaqError) else 0
            hint = "compare the [ni] table of the rig file with the device's properties in NI MAX"
            raise InputError(
                f"the device rejects the configuration of the rig file: {describe_error(error)}",
                where=f"rig {rig.name}",
                remedy=REMEDIES.get(code, hint),
            ) from None
        self._tasks = tasks
        self._reader = InputReader(tasks.read)
        self._last_beat_s = -math.inf
        # From now on, so that a latch that the silence has opened can be reset before the start.
        self._send_heartbeat()

    def tare(self, samples: int) -> Float2D:
        """Return volts at rest, (channel, sample)."""
        tasks = self._require_tasks()

        def read_volts() -> Float2D:
            return read_at_rest(tasks, samples, self.rate_hz, self._send_heartbeat)

        return self._call_driver("input", read_volts)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, volts (sample,); the last value is held."""
        self._require_tasks()
        earliest = 0 if self._clock_sync is None else self._newest_sample() + self.replace_after
        refuse_late_command(index, earliest, self.replace_after, "device")
        if not volts.size or not np.isfinite(volts).all():
            raise ValueError(
                f"the command from sample {index} on is empty or contains NaN or inf; send volts"
            )
        self._send_heartbeat()
        end = index + volts.size
        max_end = (0 if self._clock_sync is None else self._newest_sample()) + round(
            BUFFER_S * self.rate_hz
        )
        if end + round(HOLD_S * self.rate_hz) > max_end:
            raise ValueError(
                f"the command ends at sample {end}, beyond the driver's buffer; allowed: up to "
                f"{BUFFER_S - HOLD_S:g} s ahead"
            )
        first = min(index, self._written)
        self._write_output(first, np.append(self._commands.values(first, index), volts))
        self._commands.replace_from(index, volts)
        self._commands.discard_before(self._samples.received - 3)

    def start(self) -> None:
        """Start output and inputs at sample 0: the inputs trigger the armed output."""
        tasks = self._require_tasks()
        if self._clock_sync is not None:
            raise RuntimeError("NI device: start() was called already; one start() a connection")
        # A command of zeros may start with an open latch, so that it can be reset.
        moves = self._commands.values(0, self._commands.end).any()
        if moves and (fault := describe_interlock_fault(self._wiring, self._channel)):
            self._raise_lost("start", RuntimeError(fault))
        self._call_driver("start", tasks.output.start)
        self._send_heartbeat()
        # The time before the call is the lower bound; set first, as the answer may be lost.
        self._clock_sync = ClockSync(self.rate_hz, self._clock.now())
        try:
            tasks.input.start()
        except DaqError as error:
            self._clock_sync = None
            self._raise_lost("start", error)
        except Error as error:
            self._raise_lost("server", error)

    def read(self, samples: int) -> Float2D:
        """Wait for the next samples and return their volts, (channel, sample)."""
        last = self._samples.next_read + samples
        deadline_s = self.scheduled_time_s(last - 1) + SAMPLE_TIMEOUT_S
        self._require_tasks()
        self._send_heartbeat()
        while self._samples.received < last:
            self._receive(last, deadline_s)
            self._send_heartbeat()
        return self._samples.take(samples)

    def scheduled_time_s(self, index: int) -> float:
        """Return the time in s, on the session's clock, at which sample `index` is taken.

        It follows the device's clock, see `ClockSync`.
        """
        if self._clock_sync is None:
            raise RuntimeError("NI device: call start() first")
        return self._clock_sync.epoch_s + index / self.rate_hz

    def close(self) -> None:
        """Release the device once the queue is played: a stop would freeze the voltage."""
        tasks = self._tasks
        if tasks is None:
            return
        self._play_out()
        self._tasks = None
        tasks.clear()
        if self._reader is not None:
            self._reader.close(READER_CLOSE_TIMEOUT_S)

    def _play_out(self) -> None:
        """Wait until the queue has been played; send heartbeats unless the device is lost."""
        deadline_s = 0.0 if self._clock_sync is None else self.scheduled_time_s(self._commands.end)
        while self._clock.now() < deadline_s:
            if not self._loss_reason:
                with contextlib.suppress(MachineLost):
                    self._send_heartbeat()
            self._clock.wait_until(min(deadline_s, self._clock.now() + HEARTBEAT_PERIOD_S))

    def _receive(self, last: int, deadline_s: float) -> None:
        """Wait for the next samples, at most up to `last`, and send heartbeats meanwhile."""
        assert self._reader is not None
        reader, max_count = self._reader, round(HEARTBEAT_PERIOD_S * self.rate_hz)
        count = min(last - self._samples.received, max_count)  # with a heartbeat after each
        reader.request(count)
        while True:
            try:
                volts = reader.poll(POLL_S)
                if volts is None and self._clock.now() > deadline_s:
                    raise TimeoutError(
                        f"the samples up to {last - 1} have not arrived {SAMPLE_TIMEOUT_S:g} s "
                        "after their scheduled time"
                    )
            except (Error, TimeoutError) as error:
                self._play_out()  # without inputs, but smoothly: the interlock need not act
                self._raise_lost("input", error)
            if volts is not None:
                break
            self._send_heartbeat()
        self._samples.put(volts)
        if self._clock_sync is not None:
            self._clock_sync.update(self._samples.received - 1, self._clock.now())

    def _send_heartbeat(self) -> None:
        """Toggle the heartbeat line and extend the held output, if due."""
        tasks = self._tasks
        if tasks is None:
            return
        if self._check_silence_s() >= HEARTBEAT_PERIOD_S:
            if self._clock_sync is not None and self._call_driver(
                "output", tasks.output.is_task_done
            ):
                self._raise_lost("output", RuntimeError("it has ended by itself"))
            sent_s = self._clock.now()
            self._call_driver("heartbeat", tasks.toggle_heartbeat)
            self._check_silence_s()  # the call may have been slow: its edge may have left only now
            self._last_beat_s = sent_s
        if self._clock_sync is None:
            return
        if self._written - self._newest_sample() < 0.5 * HOLD_S * self.rate_hz:
            try:
                self._write_output(
                    self._written, self._commands.values(self._written, self._written + 1)
                )
            except ValueError as error:
                self._raise_lost("output", error)

    def _check_silence_s(self) -> float:
        """Return the longest possible silence of the line in s; MachineLost beyond the limit."""
        silence_s = self._clock.now() - self._last_beat_s
        if self._clock_sync is not None and silence_s > HEARTBEAT_TIMEOUT_S:
            problem = f"no heartbeat from this rig for {silence_s:.2f} s, beyond the watchdog limit"
            self._raise_lost("heartbeat", TimeoutError(problem))
        return silence_s

    def _write_output(self, first: int, volts: Float1D) -> None:
        """Write output to the driver, followed by a hold that covers all earlier output.

        Raises ValueError if the device has already taken these samples from the buffer.
        """
        assert self._tasks is not None
        tasks, newest = self._tasks, 0 if self._clock_sync is None else self._newest_sample()
        end = max(first + volts.size, newest) + round(HOLD_S * self.rate_hz)
        end = max(end, self._written)
        if end > MAX_WRITE_INDEX:
            self._raise_lost(
                "counter",
                RuntimeError(f"the driver cannot place output after sample {MAX_WRITE_INDEX}"),
            )
        padded = np.append(volts, np.full(end - first - volts.size, volts[-1]))
        try:
            tasks.write(first, padded)
        except DaqError as error:
            too_late = error.error_code == NO_LONGER_WRITEABLE
            if too_late and not self._call_driver("output", tasks.output.is_task_done):
                raise ValueError(
                    f"the device has already taken these samples: {describe_error(error)}"
                ) from None
            self._raise_lost("output", error)
        except Error as error:
            self._raise_lost("server", error)
        self._written = end

    def _newest_sample(self) -> int:
        """Return the index of the newest sample taken by now, read or not."""
        elapsed_s = self._clock.now() - self.scheduled_time_s(0)
        return find_newest_sample(self._samples.received, elapsed_s, self.rate_hz)

    def _call_driver(self, source: ErrorSource, call: Callable[[], T]) -> T:
        """Return the result of a driver call; raise its error as MachineLost."""
        try:
            return call()
        except Error as error:
            self._raise_lost(source, error)

    def _raise_lost(self, source: ErrorSource, error: Exception) -> NoReturn:
        """Raise MachineLost with cause, consequence and remedy, now and in every later call."""
        driver_answered = isinstance(error, DaqError) or not isinstance(error, Error)
        self._loss_reason = self._loss_reason or describe_loss(
            source if driver_answered else "server", error, self._clock_sync is not None
        )
        raise MachineLost(self._loss_reason) from None

    def _require_tasks(self) -> RigTasks:
        if self._loss_reason:
            raise MachineLost(self._loss_reason)
        if self._tasks is None:
            raise RuntimeError("NI device: closed, or open() was not called")
        return self._tasks
