"""Simulated machine: one controller at a time, heartbeat watchdog, and the service around it.

    free --CLAIM--> claimed --START--> running --(lost or released)--> ending --(at rest)--> free

It handles messages at times supplied by the caller; the sockets are in `server.py`. A machine that
loses its controller plays the queued command, comes to rest at its mean, keeps the reason until the
next controller starts, and starts that one from rest at sample 0.

`shaketwin table` serves a machine behind the protocol of a backend. A server registers under the
name of its backend in the entry-point group `shaketwin.simulators`: a function that serves a
`TableService` until `keep_running()` is False and the table is at rest.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import Field, ValidationError

from table_io.backends import HEARTBEAT_TIMEOUT_S
from table_io.backends.command_buffer import CommandBuffer, can_hold, plan_stop
from table_io.backends.machine.protocol import (
    MAX_PAYLOAD_BYTES,
    REPLACE_AFTER_S,
    MachineMessage,
    MessageKind,
    ProtocolError,
    Refusal,
    text_message,
    values_message,
)
from table_io.block import Float1D, Float2D
from table_io.clock import Clock, ManualClock
from table_io.config.base import ConfigModel, Positive
from table_io.config.plugins import list_entry_points, load_entry_point
from table_io.config.profile import Specimen
from table_io.config.rig import REINSTALL, OutputConfig, RigConfig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from table_io.formats import read_table
from table_io.formats.timing import measure_rate
from table_io.sim.config import SimulatedTableConfig
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


CLAIM_TIMEOUT_S = 30.0  # silence of a controller before its start, while nothing moves


class Claim(ConfigModel):
    """Payload of CLAIM: sample rate, specimen, and the rig config to compare."""

    rate_hz: Positive
    specimen: Specimen
    output: OutputConfig
    sensors: tuple[SensorConfig, ...] = Field(min_length=1)


class SimulatedMachine:
    """Simulated machine of a rig with a [simulated] table; `notify` prints a status line."""

    def __init__(
        self, rig: RigConfig, notify: Callable[[str], None], recorder: FlightRecorder | None = None
    ) -> None:
        rig.require_section("simulated", SimulatedTableConfig)  # there is a plant to simulate
        self.rig = rig
        self.latched_reason = ""  # why the last controller was lost
        self.notify = notify
        self.recorder = recorder
        self._session: MachineSession | None = None
        self._last_heard_s = 0.0

    def warm_up(self) -> None:
        """Compile the kernels that a claim needs, so that the first one is answered in time."""
        MachineSession(self.rig, Specimen(mass_kg=1.0, gap_mm=math.inf), self.rig.rates_hz[0], None)

    @property
    def is_claimed(self) -> bool:
        """True while a controller is connected, and until rest after it."""
        return self._session is not None

    @property
    def session(self) -> MachineSession | None:
        """Present session, for servers of other protocols; None if free."""
        return self._session

    @property
    def moving(self) -> bool:
        """True from a start until rest."""
        return self._session is not None and self._session.started

    def busy_refusal(self) -> MachineMessage | None:
        """Return the refusal for another controller; None if the machine is free."""
        if self._session is None:
            return None
        if self._session.end_reason:
            text = (
                f"the table {self.rig.name!r} is still coming to rest ({self._session.end_reason})"
            )
            return text_message(MessageKind.REFUSED, text, Refusal.RESTING)
        text = f"the table {self.rig.name!r} has a controller already; end that one first"
        return text_message(MessageKind.REFUSED, text, Refusal.INPUT)

    def handle_message(self, message: MachineMessage, now_s: float) -> list[MachineMessage]:
        """Handle a message of the controller and return the answers; ProtocolError if invalid."""
        self._last_heard_s = now_s
        if self._session is None:
            if message.kind is not MessageKind.CLAIM:
                raise ProtocolError(f"{message.kind.name} before CLAIM")
            return [self._claim(message)]
        try:
            return self._answer(self._session, message, now_s)
        except ValueError as error:
            if isinstance(error, ProtocolError):
                raise
            return [text_message(MessageKind.REFUSED, str(error), Refusal.VALUE)]
        except RuntimeError as error:
            return [text_message(MessageKind.REFUSED, str(error), Refusal.ORDER)]

    def tick(self, now_s: float) -> list[MachineMessage]:
        """Play up to `now_s` and return the messages for the controller."""
        session = self._session
        if session is None:
            return []
        session.play(now_s)
        out = session.pop_arrived(now_s)
        timeout_s = HEARTBEAT_TIMEOUT_S if session.started else CLAIM_TIMEOUT_S
        if not session.end_reason and now_s - self._last_heard_s > timeout_s:
            out.append(
                self.drop_controller(f"no message from the controller for {timeout_s:g} s", now_s)
            )
        elif session.at_rest:
            session.note("at rest")
            self.notify(f"at rest; {session.end_reason}; waiting for a controller")
            self._release()
        return out

    def drop_controller(self, reason: str, now_s: float) -> MachineMessage:
        """Drop the controller, latch the reason, and return the message LOST for it."""
        session = self._session
        if session is not None and not session.end_reason:
            if session.started:
                self.latched_reason = f"controller lost at sample {session.taken}: {reason}"
                self._end(session, self.latched_reason, now_s)
            else:
                self.notify(f"controller lost before its start: {reason}")
                self._release()
        return text_message(MessageKind.LOST, reason)

    def _claim(self, message: MachineMessage) -> MachineMessage:
        """Grant or refuse a claim."""
        try:
            claim = Claim.model_validate(message.json)
        except ValidationError:
            raise ProtocolError("invalid claim") from None
        for ours, theirs, what in (
            (self.rig.output, claim.output, "[output]"),
            (self.rig.sensors, claim.sensors, "[[sensors]]"),
        ):
            if ours != theirs:
                text = (
                    f"the table was started with another rig file: {what} differs; start it with "
                    "the rig file of this run"
                )
                return text_message(MessageKind.REFUSED, text, Refusal.INPUT)
        if claim.rate_hz not in self.rig.rates_hz:
            rates = ", ".join(f"{rate:g}" for rate in self.rig.rates_hz)
            text = f"the table does not support {claim.rate_hz:g} Hz; allowed: {rates}"
            return text_message(MessageKind.REFUSED, text, Refusal.INPUT)
        try:
            self._session = MachineSession(self.rig, claim.specimen, claim.rate_hz, self.recorder)
        except InputError as error:
            return text_message(MessageKind.REFUSED, str(error), Refusal.INPUT)
        self._session.note(f"claimed; {self.latched_reason or 'at rest'}")
        return MachineMessage(MessageKind.GRANTED, round(REPLACE_AFTER_S * claim.rate_hz))

    def _answer(
        self, session: MachineSession, message: MachineMessage, now_s: float
    ) -> list[MachineMessage]:
        """Execute a message of the connected controller and return the answers."""
        match message.kind:
            case MessageKind.BEAT:
                return []
            case MessageKind.TARE:
                samples = message.index
                max_samples = MAX_PAYLOAD_BYTES // (8 * len(session.plant.channels))
                if not 0 <= samples <= max_samples:
                    raise ValueError(f"tare of {samples} samples; at most {max_samples}")
                return [values_message(MessageKind.TARED, session.plant.tare(samples).T)]
            case MessageKind.QUEUE:
                session.queue(message.index, message.values, now_s)
                return [MachineMessage(MessageKind.QUEUED, message.index)]
            case MessageKind.START:
                session.start(now_s)
                self.latched_reason = ""
                self.notify("a controller drives the table")
                return [values_message(MessageKind.STARTED, np.array([now_s]))]
            case MessageKind.RELEASE:
                if session.started:
                    self._end(
                        session, f"released by its controller at sample {session.taken}", now_s
                    )
                else:
                    self._release()
                return []
            case _:
                raise ProtocolError(f"unexpected {message.kind.name} from a controller")

    def _end(self, session: MachineSession, reason: str, now_s: float) -> None:
        remaining_s = session.end(reason, now_s)
        self.notify(f"{reason}; the queued command plays on, at rest in {remaining_s:.2f} s")

    def _release(self) -> None:
        if self._session is not None:
            self._session.plant.close()
        self._session = None


SIMULATOR_GROUP = "shaketwin.simulators"


@dataclass(frozen=True, eq=False)
class PlaybackPlan:
    """Drive file in m for the controller, its rate, clock error in ppm and start delay in s."""

    values_m: Float1D
    rate_hz: float
    ppm: float = 0.0
    after_s: float = 5.0  # after a client starts to acquire


def read_drive(path: Path) -> tuple[Float1D, float]:
    """Return (displacement in m, (sample,), rate in Hz) of a csv or txt drive file.

    For the simulated controller: a real one reads the file itself. Raises InputError if the file is
    not a drive.
    """
    try:
        table = read_table(path)
        times, values = (table.read_column(name) for name in table.columns)
        if not np.isfinite([times, values]).all():
            raise ValueError("it has values that are no numbers")
        rate_hz = round(measure_rate(times, table), 3)
    except ValueError as error:  # InputError, or another number of columns
        raise InputError(
            f"no drive file ({error})",
            where=f"--play {path}",
            allowed="two columns, rising time in s and displacement in mm",
            remedy="make one: shaketwin drive PROFILE -o FILE.csv",
        ) from None
    return values * 1e-3, rate_hz


@dataclass(frozen=True, eq=False, kw_only=True)
class TableService:
    """What a server simulates, and its connection to the terminal."""

    rig: RigConfig
    specimen: Specimen  # on the table, unless the protocol transmits another
    clock: Clock
    notify: Callable[[str], None]  # prints a status line
    begin: Callable[[str], None]  # call it once, with the address, when ready to serve
    keep_running: Callable[[], bool]
    log: Path | None = None  # of the flight recorder
    plan: PlaybackPlan | None = None  # of the external controller; None: it stays at rest

    def open_recorder(self) -> FlightRecorder | None:
        """Return the flight recorder, None without a log; call it when the address is taken."""
        return FlightRecorder(self.log, self.notify) if self.log is not None else None

    def make_machine(self) -> SimulatedMachine:
        """Return the machine with its kernels compiled; call it when the address is taken."""
        machine = SimulatedMachine(self.rig, self.notify, self.open_recorder())
        machine.warm_up()
        return machine


def find_simulator(rig: RigConfig) -> Callable[[TableService], None]:
    """Return the server of a rig's backend; InputError if there is none."""
    simulator: Callable[[TableService], None] | None = load_entry_point(
        SIMULATOR_GROUP, rig.backend
    )
    if simulator is None:
        names = ", ".join(list_entry_points(SIMULATOR_GROUP))
        raise InputError(
            "there is no simulated table behind this backend",
            where=f"rig {rig.name}",
            key="backend",
            value=rig.backend,
            allowed=names or "none is installed",
            remedy="give another rig file, or --listen" if names else REINSTALL,
        )
    return simulator
