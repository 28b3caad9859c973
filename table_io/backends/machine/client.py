"""Backend for a machine in a separate process, over a socket (`shaketwin table`).

Every wait also sends the heartbeat, so no thread is needed for it. If the machine receives nothing
for HEARTBEAT_TIMEOUT_S, it drops the rig and plays the queued command to rest.
"""

import json
import select
import socket
from typing import NoReturn

import numpy as np

from table_io.backends import SAMPLE_TIMEOUT_S, MachineLost
from table_io.backends.command_buffer import SampleBuffer, find_newest_sample, refuse_late_command
from table_io.backends.machine.protocol import (
    REPLACE_AFTER_S,
    MachineConfig,
    MachineMessage,
    MessageKind,
    MessageParser,
    ProtocolError,
    Refusal,
    connect,
    encode_message,
    parse_endpoint,
    text_message,
    values_message,
)
from table_io.block import Float1D, Float2D
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError

HEARTBEAT_PERIOD_S = 0.03  # between heartbeats
ANSWER_TIMEOUT_S = 2.0  # of a request
REST_TIMEOUT_S = 30.0  # for the machine to come to rest after its previous controller
RELEASE_TIMEOUT_S = 0.2  # for the machine to read the last message
RECEIVE_BYTES = 1 << 18


def check_reachable(rig: RigConfig) -> None:
    """Raise InputError if the machine of the rig file does not answer; claim nothing."""
    machine = rig.get_section(MachineConfig)
    if machine is not None:
        _connect(rig, machine).close()


def _connect(rig: RigConfig, machine: MachineConfig) -> socket.socket:
    """Connect to the machine of a rig file; InputError with the remedy if it does not answer."""
    endpoint = parse_endpoint(machine.endpoint)
    try:
        return connect(endpoint, ANSWER_TIMEOUT_S)
    except OSError as error:
        raise InputError(
            f"no table answers there ({error.strerror or error})",
            where=endpoint.text,
            remedy=f"start it first, in another terminal: shaketwin table --table {rig.name}",
        ) from None


class MachineBackend:
    """Controller's side of one connection to the machine."""

    def __init__(self, rig: RigConfig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        machine = rig.require_section("machine", MachineConfig)
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = round(REPLACE_AFTER_S * rate_hz)
        self._rig = rig
        self._specimen = specimen
        self._clock = clock
        self._machine = machine
        self._socket: socket.socket | None = None
        self._parser = MessageParser()
        self._answers: list[MachineMessage] = []
        self._samples = SampleBuffer(len(rig.channels))
        self._epoch_s: float | None = None
        self._last_sent_s = 0.0
        self._loss_reason = ""  # why the machine is lost; empty: it is not

    def open(self) -> None:
        """Claim the machine, after waiting for it to come to rest; InputError if it refuses."""
        claim = {
            "rate_hz": self.rate_hz,
            "specimen": self._specimen.model_dump(),
            "output": self._rig.output.model_dump(),
            "sensors": [sensor.model_dump() for sensor in self._rig.sensors],
        }
        deadline_s = self._clock.now() + REST_TIMEOUT_S
        while True:
            self._socket, self._parser = _connect(self._rig, self._machine), MessageParser()
            try:
                answer = self._exchange(
                    text_message(MessageKind.CLAIM, json.dumps(claim)), MessageKind.GRANTED
                )
            except MachineLost:
                raise InputError(
                    "the program that listens there does not answer as a simulated table",
                    where=self._machine.endpoint,
                    remedy=f"end it, then start: shaketwin table --table {self._rig.name}",
                ) from None
            if answer.kind is MessageKind.GRANTED:
                return
            self.close()
            if answer.index != Refusal.RESTING or self._clock.now() > deadline_s:
                raise InputError(answer.text, where=self._machine.endpoint)
            self._clock.wait_until(self._clock.now() + 0.1)

    def tare(self, samples: int) -> Float2D:
        """Return volts at rest, (channel, sample)."""
        answer = self._request(MachineMessage(MessageKind.TARE, samples), MessageKind.TARED)
        return self._to_matrix(answer)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, volts (sample,); the last value is held."""
        if self._epoch_s is not None:
            elapsed_s = self._clock.now() - self._epoch_s
            newest = find_newest_sample(self._samples.received, elapsed_s, self.rate_hz)
            earliest = newest + self.replace_after
            refuse_late_command(index, earliest, self.replace_after, "machine")
        self._request(values_message(MessageKind.QUEUE, volts, index), MessageKind.QUEUED)

    def start(self) -> None:
        """Start output and inputs at sample 0, at once."""
        self._epoch_s = float(
            self._request(MachineMessage(MessageKind.START), MessageKind.STARTED).values[0]
        )

    def read(self, samples: int) -> Float2D:
        """Wait for the next samples and return their volts, (channel, sample)."""
        last = self._samples.next_read + samples
        deadline_s = self.scheduled_time_s(last - 1) + SAMPLE_TIMEOUT_S
        if not self._loss_reason:
            self._require_connection()
        try:
            self._send_heartbeat()
            while self._samples.received < last:
                if not self._receive() and self._clock.now() > deadline_s:
                    self._raise_lost(
                        f"the samples up to {last - 1} have not arrived {SAMPLE_TIMEOUT_S:g} s "
                        "after their scheduled time"
                    )
                self._send_heartbeat()
        except MachineLost:
            if self._samples.received < last:
                raise
            # Return the samples that have arrived; the next call raises the loss.
        return self._samples.take(samples)

    def scheduled_time_s(self, index: int) -> float:
        """Return the time in s, on the session's clock, at which sample `index` is taken."""
        if self._epoch_s is None:
            raise RuntimeError("machine: call start() first")
        return self._epoch_s + index / self.rate_hz

    def close(self) -> None:
        """Release the machine; if it moves, it plays what is queued. Safe to call twice."""
        if self._socket is None:
            return
        try:
            self._socket.sendall(encode_message(MachineMessage(MessageKind.RELEASE)))
            self._socket.settimeout(RELEASE_TIMEOUT_S)
            while self._socket.recv(RECEIVE_BYTES):
                pass  # closing with unread samples could discard the last message sent
        except OSError:
            pass  # the machine detects the closed connection by itself
        finally:
            self._socket.close()
            self._socket = None

    def _request(self, request: MachineMessage, kind: MessageKind) -> MachineMessage:
        """Send a request and return its answer; raise ValueError or RuntimeError for a refusal."""
        answer = self._exchange(request, kind)
        if answer.kind is not MessageKind.REFUSED:
            return answer
        raise (ValueError if answer.index == Refusal.VALUE else RuntimeError)(answer.text)

    def _exchange(self, request: MachineMessage, kind: MessageKind) -> MachineMessage:
        """Send a request and return the answer of this kind, or the refusal."""
        self._send(request)
        deadline_s = self._clock.now() + ANSWER_TIMEOUT_S
        while not self._answers:
            if not self._receive() and self._clock.now() > deadline_s:
                self._raise_lost(f"no answer to {request.kind.name} within {ANSWER_TIMEOUT_S:g} s")
        answer = self._answers.pop(0)
        if answer.kind not in (kind, MessageKind.REFUSED):
            self._raise_lost(f"unexpected answer {answer.kind.name} to {request.kind.name}")
        return answer

    def _send(self, message: MachineMessage) -> None:
        connection = self._require_connection()
        try:
            connection.sendall(encode_message(message))
        except OSError as error:
            self._receive()  # its last message may be unread
            self._raise_lost(f"the connection broke ({error.strerror or error})")
        self._last_sent_s = self._clock.now()

    def _send_heartbeat(self) -> None:
        if self._clock.now() - self._last_sent_s >= HEARTBEAT_PERIOD_S:
            self._send(MachineMessage(MessageKind.BEAT))

    def _receive(self) -> bool:
        """Receive for one heartbeat period at most; return False if nothing arrived."""
        connection = self._require_connection()
        try:
            if not select.select([connection], [], [], HEARTBEAT_PERIOD_S)[0]:
                return False
            data = connection.recv(RECEIVE_BYTES)
        except OSError as error:
            self._raise_lost(f"the connection broke ({error.strerror or error})")
        if not data:
            self._raise_lost("the table closed the connection")
        try:
            for message in self._parser.feed(data):
                self._handle_message(message)
        except ProtocolError as error:
            self._raise_lost(f"invalid message ({error})")
        return True

    def _handle_message(self, message: MachineMessage) -> None:
        if message.kind is MessageKind.LOST:
            self._raise_lost(f"the table has dropped this rig: {message.text}")
        if message.kind is not MessageKind.TAKEN:
            self._answers.append(message)
            return
        samples = self._to_matrix(message)
        if message.index != self._samples.received:
            self._raise_lost(f"expected sample {self._samples.received}, received {message.index}")
        self._samples.put(samples)

    def _to_matrix(self, message: MachineMessage) -> Float2D:
        """Return volts, (channel, sample), of a message (sample, channel)."""
        values = message.values
        if values.size % len(self.channels):
            raise ProtocolError("samples with another number of channels")
        return np.ascontiguousarray(values.reshape(-1, len(self.channels)).T)

    def _require_connection(self) -> socket.socket:
        if self._loss_reason:
            raise MachineLost(self._loss_reason)
        if self._socket is None:
            raise RuntimeError("machine: closed, or open() was not called")
        return self._socket

    def _raise_lost(self, reason: str) -> NoReturn:
        """Raise MachineLost with cause, consequence and remedy, now and in every later call."""
        self._loss_reason = (
            f"the table at {self._machine.endpoint} is lost: {reason}. The queued command plays to "
            "rest; check the machine, then start again"
        )
        self.close()
        raise MachineLost(self._loss_reason)
