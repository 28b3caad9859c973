"""The Backend contract on a machine in a process of its own, over a socket (`shaketwin table`).

Every wait in here also sends the heartbeat that the machine watches, so the rig needs no thread
for it: a rig that is not heard for HEARTBEAT_S has lost the machine, which plays to rest.
"""

import json
import math
import select
import socket
from typing import NoReturn

import numpy as np

from table_io.backends import PATIENCE_S, MachineLost
from table_io.block import Float1D, Float2D
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.machine.endpoint import connected, endpoint
from table_io.machine.wire import (
    REPLACE_AFTER_S,
    Garbage,
    Kind,
    Message,
    Parser,
    Refusal,
    carry,
    encode,
    say,
)
from table_io.profile import Specimen
from table_io.rig import Machine, Rig

BEAT_S = 0.03  # between heartbeats
ANSWER_S = 2.0  # that the machine may take for an answer
RESTING_S = 30.0  # that a machine may still need to come to rest after its last controller
FAREWELL_S = 0.2  # that it may take to hear of the end
RECEIVED_BYTES = 1 << 18


def answers(rig: Rig) -> None:
    """BadInput where the card names a machine of its own and none answers; claims nothing."""
    if rig.machine is not None:
        _reached(rig, rig.machine).close()


def _reached(rig: Rig, machine: Machine) -> socket.socket:
    """A connection to the machine of a card; BadInput says how to start one."""
    where = endpoint(machine.endpoint)
    try:
        return connected(where, ANSWER_S)
    except OSError as error:
        raise BadInput(
            f"no table answers at {where.text} ({error.strerror or error}); start it first, in "
            f"another terminal: shaketwin table --rig {rig.name}"
        ) from None


class MachineBackend:
    """A controller's side of one life on the machine."""

    def __init__(self, rig: Rig, specimen: Specimen, rate_hz: float, clock: Clock) -> None:
        if rig.machine is None:
            raise BadInput(f"rig {rig.name}: no [machine] table; add it, or name another backend")
        self.channels = rig.channels
        self.rate_hz = rate_hz
        self.replace_after = round(REPLACE_AFTER_S * rate_hz)
        self._rig = rig
        self._specimen = specimen
        self._clock = clock
        self._machine = rig.machine
        self._socket: socket.socket | None = None
        self._parser = Parser()
        self._answers: list[Message] = []
        self._samples: list[Float2D] = []  # that have come and were not read, (channel, sample)
        self._come = 0  # samples that have come
        self._read = 0
        self._epoch: float | None = None
        self._spoke_s = 0.0
        self._lost = ""  # why the machine does not answer any more

    def open(self) -> None:
        """Claim the machine; waits where it still comes to rest. BadInput says how to start one."""
        claim = {
            "rate_hz": self.rate_hz,
            "specimen": self._specimen.model_dump(),
            "output": self._rig.output.model_dump(),
            "sensors": [sensor.model_dump() for sensor in self._rig.sensors],
        }
        until = self._clock.now() + RESTING_S
        while True:
            self._socket, self._parser = _reached(self._rig, self._machine), Parser()
            try:
                answer = self._ask(say(Kind.CLAIM, json.dumps(claim)), Kind.GRANTED)
            except MachineLost:
                raise BadInput(
                    f"what answers at {self._machine.endpoint} is no table, or one that is ill; "
                    f"end it, then: shaketwin table --rig {self._rig.name}"
                ) from None
            if answer.kind is Kind.GRANTED:
                return
            self.close()
            if answer.index != Refusal.RESTING or self._clock.now() > until:
                raise BadInput(f"{self._machine.endpoint}: {answer.text}")
            self._clock.wait_until(self._clock.now() + 0.1)

    def tare(self, samples: int) -> Float2D:
        """Volts at rest before precompression, (channel, sample)."""
        answer = self._granted(Message(Kind.TARE, samples), Kind.TARED)
        return self._matrix(answer)

    def queue(self, index: int, volts: Float1D) -> None:
        """Replace the command from sample `index` on, (sample,); the last value is held."""
        if self._epoch is not None and index < self._newest() + self.replace_after:
            raise ValueError(
                f"the command from sample {index} on is already in the machine; allowed: from "
                f"{self._newest() + self.replace_after} on ({self.replace_after} after the newest "
                "sample taken)"
            )
        self._granted(carry(Kind.QUEUE, volts, index), Kind.QUEUED)

    def start(self) -> None:
        """Start output and input at sample 0, now."""
        self._epoch = float(self._granted(Message(Kind.START), Kind.STARTED).values[0])

    def read(self, samples: int) -> Float2D:
        """Volts of the next samples, (channel, sample), when they have been taken."""
        last = self._read + samples
        until = self.scheduled(last - 1) + PATIENCE_S
        if not self._lost:
            self._alive()
        try:
            self._beat()
            while self._come < last:
                if not self._listen() and self._clock.now() > until:
                    self._lose(
                        f"it has not sent the samples up to {last - 1}, {PATIENCE_S:g} s after "
                        "their schedule"
                    )
                self._beat()
        except MachineLost:
            if self._come < last:
                raise
            # What has come is handed out first; the next call says it.
        whole = np.concatenate([np.empty((len(self.channels), 0)), *self._samples], axis=1)
        self._samples = [whole[:, samples:]]
        self._read = last
        return whole[:, :samples]

    def scheduled(self, index: int) -> float:
        """Time on the session's clock at which sample `index` is taken, in s."""
        if self._epoch is None:
            raise RuntimeError("machine: start() comes first")
        return self._epoch + index / self.rate_hz

    def close(self) -> None:
        """Release the machine; where it moves it plays what is queued. Safe to call twice."""
        if self._socket is None:
            return
        try:
            self._socket.sendall(encode(Message(Kind.RELEASE)))
            self._socket.settimeout(FAREWELL_S)
            while self._socket.recv(RECEIVED_BYTES):
                pass  # closing on unread samples could take the last word back
        except OSError:
            pass  # it sees by itself that nobody is there
        finally:
            self._socket.close()
            self._socket = None

    def _newest(self) -> int:
        """The newest sample that the machine has taken by now, read or not."""
        since = self._clock.now() - self.scheduled(0)
        return max(self._come - 1, math.floor(since * self.rate_hz + 1e-6))

    def _granted(self, request: Message, kind: Kind) -> Message:
        """The answer to a request; what a refusal stands for is raised."""
        answer = self._ask(request, kind)
        if answer.kind is not Kind.REFUSED:
            return answer
        raise (ValueError if answer.index == Refusal.VALUE else RuntimeError)(answer.text)

    def _ask(self, request: Message, kind: Kind) -> Message:
        """The answer of this kind, or a refusal."""
        self._send(request)
        until = self._clock.now() + ANSWER_S
        while not self._answers:
            if not self._listen() and self._clock.now() > until:
                self._lose(f"it has not answered {request.kind.name} for {ANSWER_S:g} s")
        answer = self._answers.pop(0)
        if answer.kind not in (kind, Kind.REFUSED):
            self._lose(f"it answers {request.kind.name} with {answer.kind.name}")
        return answer

    def _send(self, message: Message) -> None:
        connection = self._alive()
        try:
            connection.sendall(encode(message))
        except OSError as error:
            self._listen()  # its last word may lie there
            self._lose(f"the connection broke ({error.strerror or error})")
        self._spoke_s = self._clock.now()

    def _beat(self) -> None:
        if self._clock.now() - self._spoke_s >= BEAT_S:
            self._send(Message(Kind.BEAT))

    def _listen(self) -> bool:
        """Take in what comes within a heartbeat; False where nothing did."""
        connection = self._alive()
        try:
            if not select.select([connection], [], [], BEAT_S)[0]:
                return False
            data = connection.recv(RECEIVED_BYTES)
        except OSError as error:
            self._lose(f"the connection broke ({error.strerror or error})")
        if not data:
            self._lose("it closed the connection")
        try:
            for message in self._parser.feed(data):
                self._take(message)
        except Garbage as error:
            self._lose(f"it says what no machine says ({error})")
        return True

    def _take(self, message: Message) -> None:
        if message.kind is Kind.LOST:
            self._lose(f"it goes on without this rig: {message.text}")
        if message.kind is not Kind.TAKEN:
            self._answers.append(message)
            return
        samples = self._matrix(message)
        if message.index != self._come:
            self._lose(f"sample {self._come} is missing, {message.index} came")
        self._samples.append(samples)
        self._come += samples.shape[1]

    def _matrix(self, message: Message) -> Float2D:
        """Volts, (channel, sample)."""
        values = message.values
        if values.size % len(self.channels):
            raise Garbage("samples of other channels")
        return np.ascontiguousarray(values.reshape(-1, len(self.channels)).T)

    def _alive(self) -> socket.socket:
        if self._lost:
            raise MachineLost(self._lost)
        if self._socket is None:
            raise RuntimeError("machine: it is closed, or open() was not called")
        return self._socket

    def _lose(self, why: str) -> NoReturn:
        """The machine is lost, for good: MachineLost says why and what happens now."""
        self._lost = (
            f"the table at {self._machine.endpoint} is lost: {why}. What is queued plays to rest; "
            "look after the machine, then start anew"
        )
        self.close()
        raise MachineLost(self._lost)
