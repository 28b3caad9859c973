"""One controller's connection to the machine: command buffer and plant, until rest."""

import math
from collections import deque

import numpy as np

from table_io.backends.command_buffer import CommandBuffer, can_hold, plan_stop
from table_io.backends.machine.protocol import MachineMessage, MessageKind, values_message
from table_io.block import Float1D, Float2D
from table_io.clock import ManualClock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.simulated_table import SimulatedBackend

MIN_REST_S = 0.2  # for which the table stays within MAX_REST_MOTION_M when at rest
MAX_REST_MOTION_M = 5e-5
MAX_AHEAD_SAMPLES = 1 << 20  # command samples that can be queued
MAX_STEP_S = 0.25  # computed in one step, at most, after a pause of this process


class MachineSession:
    """Machine with a specimen, at rest until `start`; the caller supplies the time.

    Raises InputError if the machine does not support the sample rate. Everything it plays ends at
    rest at the mean: a command that ends in motion is extended by `plan_stop`.
    """

    def __init__(
        self, rig: RigConfig, specimen: Specimen, rate_hz: float, recorder: FlightRecorder | None
    ) -> None:
        self._clock = ManualClock()
        self.plant = SimulatedBackend(rig, specimen, rate_hz, self._clock)
        self.plant.open()
        self.plant.observer = self._record_samples
        self.taken = 0
        self.started = False
        self.end_reason = ""  # why the controller was dropped; empty: it was not
        self.rest_from = 0  # while ending: sample from which the command is at its mean
        self._output = rig.output
        self._span_m = 1e-3 * rig.output.span_mm
        self._recorder = recorder
        self._queued = CommandBuffer()
        self._epoch_s = math.inf
        # (time of delivery in s, message)
        self._undelivered: deque[tuple[float, MachineMessage]] = deque()
        self._rest_position_m = 0.0  # position of the table
        self._last_moved = 0  # sample at which it reached it
        if recorder is not None:
            recorder.begin_session(rate_hz, rig.output.volts_per_m)

    @property
    def at_rest(self) -> bool:
        """True once the connection has ended and command and table are at rest."""
        still = self.taken - max(self.rest_from, self._last_moved)
        return bool(self.end_reason) and still >= MIN_REST_S * self.plant.rate_hz

    def start(self, now_s: float) -> None:
        """Start with sample 0 at `now_s`."""
        self._clock.time_s = now_s
        self.plant.start()
        self._epoch_s = now_s
        self.started = True
        if self._recorder is not None:
            self._recorder.record_start(now_s)

    def queue(self, index: int, volts: Float1D, now_s: float) -> None:
        """Replace the command from sample `index` on; ValueError if it cannot be replaced."""
        if not volts.size:
            raise ValueError("an empty command; send at least one value")
        if not 0 <= index <= self.taken + MAX_AHEAD_SAMPLES - volts.size:
            raise ValueError(
                f"the command has samples {index} to {index + volts.size}; allowed: from 0 on, at "
                f"most {MAX_AHEAD_SAMPLES} ahead"
            )
        scale, rate = self._output.volts_per_m, self.plant.rate_hz
        end = np.concatenate([self._queued.values(index - 3, index), volts])[-3:] / scale
        if np.isfinite(end).all() and not can_hold(end, rate):
            volts = np.concatenate([volts, plan_stop(end, rate, self._span_m) * scale])
        self.play(now_s)
        self._replace_command(index, volts)

    def play(self, now_s: float) -> None:
        """Take the samples that are due, and put them in the delivery queue in order."""
        self._clock.time_s = now_s
        rate = self.plant.rate_hz
        while self.started:
            due = math.floor((now_s - self._epoch_s) * rate + 1e-6) + 1 - self.taken
            due = min(due, round(MAX_STEP_S * rate))
            if due <= 0:
                break
            first, self.taken = self.taken, self.taken + due
            arrival_s = now_s + self.plant.lateness_s(first, self.taken)
            volts = self.plant.take(due)
            if not self.end_reason:
                self._undelivered.append(
                    (arrival_s, values_message(MessageKind.TAKEN, volts.T, first))
                )

    def pop_arrived(self, now_s: float) -> list[MachineMessage]:
        """Remove and return the messages whose delivery is due."""
        out = []
        while self._undelivered and self._undelivered[0][0] <= now_s:
            out.append(self._undelivered.popleft()[1])
        return out

    def end(self, reason: str, now_s: float) -> float:
        """Continue without the controller, to the mean; return the seconds until rest there."""
        self.play(now_s)
        self.end_reason = reason
        self._undelivered.clear()
        queued, rate = self._queued, self.plant.rate_hz
        last = queued.values(queued.end - 1, queued.end) / self._output.volts_per_m
        if abs(float(last[0])) > 0.5 * self._output.lsb_m:
            earliest = self.taken - 1 + self.plant.replace_after
            path = plan_stop(np.repeat(last, 3), rate, self._span_m) * self._output.volts_per_m
            self._replace_command(max(queued.end, earliest), path)
        self.rest_from = queued.end - 1
        self.note(reason)
        return max(self.rest_from - self.taken, 0) / rate

    def note(self, text: str) -> None:
        """Record a note at the present sample."""
        if self._recorder is not None:
            self._recorder.note(self.taken, text)

    def _replace_command(self, index: int, volts: Float1D) -> None:
        self.plant.queue(index, volts)
        self._queued.replace_from(index, volts)
        self._queued.discard_before(self.taken - 3)
        if self._recorder is not None:
            self._recorder.record_command(index, volts)

    def _record_samples(self, first: int, command_m: Float1D, signals: Float2D) -> None:
        """Record the command played, m, and the plant signals; update the last motion."""
        table_m = signals[0]
        if np.abs(table_m - self._rest_position_m).max() > MAX_REST_MOTION_M:
            self._rest_position_m, self._last_moved = float(table_m[-1]), first + table_m.size
        if self._recorder is not None:
            self._recorder.record_samples(first, command_m, signals)
