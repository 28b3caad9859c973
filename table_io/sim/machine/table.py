"""State machine of the simulated machine: one controller at a time, heartbeat watchdog.

    free --CLAIM--> claimed --START--> running --(lost or released)--> ending --(at rest)--> free

It handles messages at times supplied by the caller; the sockets are in `server.py`. A machine that
loses its controller plays the queued command, comes to rest at its mean, keeps the reason until the
next controller starts, and starts that one from rest at sample 0.
"""

import math
from collections.abc import Callable

import numpy as np
from pydantic import Field, ValidationError

from table_io.backends import HEARTBEAT_TIMEOUT_S
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
from table_io.config.base import ConfigModel, Positive
from table_io.config.profile import Specimen
from table_io.config.rig import OutputConfig, RigConfig
from table_io.config.sensor import SensorConfig
from table_io.errors import InputError
from table_io.sim.config import SimulatedTableConfig
from table_io.sim.machine.connection import MachineSession
from table_io.sim.machine.flight_recorder import FlightRecorder

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
                samples, max_samples = (
                    message.index,
                    MAX_PAYLOAD_BYTES // (8 * len(session.plant.channels)),
                )
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
