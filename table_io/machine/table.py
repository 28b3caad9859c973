"""The machine: one controller at a time, and its watch over the heartbeat.

    free --CLAIM--> claimed --START--> running --(lost or released)--> ending --(at rest)--> free

It thinks in messages and in times that it is told; the sockets are in `server.py`. A machine that
lost its controller plays what is queued, comes to rest at its mean, says so until the next one
comes, and begins with that one from rest at sample 0.
"""

import math
from collections.abc import Callable

import numpy as np
from pydantic import Field, ValidationError

from table_io.backends import HEARTBEAT_S
from table_io.card import BadInput, Card, Positive
from table_io.machine.blackbox import BlackBox
from table_io.machine.life import Life
from table_io.machine.wire import (
    MOST_BYTES,
    REPLACE_AFTER_S,
    Garbage,
    Kind,
    Message,
    Refusal,
    carry,
    say,
)
from table_io.profile import Specimen
from table_io.rig import Output, Rig
from table_io.sensor import Sensor

SILENCE_S = 30.0  # without a word from a controller before its start, where nothing moves


class Claim(Card):
    """What a controller says when it wants the machine: how, and what stands on it."""

    rate_hz: Positive
    specimen: Specimen
    output: Output
    sensors: tuple[Sensor, ...] = Field(min_length=1)


class Table:
    """The machine of a card that has a [simulated] table; `tell` shows a line to people."""

    def __init__(self, rig: Rig, tell: Callable[[str], None], box: BlackBox | None = None) -> None:
        if rig.simulated is None:
            raise BadInput(
                f"rig {rig.name}: no [simulated] table, so there is nothing to play; add it, or "
                "name another machine card"
            )
        self.rig = rig
        self.latched = ""  # how the last controller was lost
        self.tell = tell
        self.box = box
        self._life: Life | None = None
        self._heard_s = 0.0

    def prepare(self) -> None:
        """Compile what a claim needs, so that the first one is answered in time."""
        Life(self.rig, Specimen(mass_kg=1.0, gap_mm=math.inf), self.rig.rates_hz[0], None)

    @property
    def claimed(self) -> bool:
        """True while a controller has it, and while it comes to rest after one."""
        return self._life is not None

    @property
    def life(self) -> Life | None:
        """What the machine does for whoever has it, for a far side of another protocol."""
        return self._life

    @property
    def moving(self) -> bool:
        """True from a start until rest."""
        return self._life is not None and self._life.started

    def busy(self) -> Message | None:
        """Why nobody else can have the machine now, or None."""
        if self._life is None:
            return None
        if self._life.ending:
            text = f"the table {self.rig.name!r} is still coming to rest ({self._life.ending})"
            return say(Kind.REFUSED, text, Refusal.RESTING)
        text = f"the table {self.rig.name!r} has a controller already; end that one first"
        return say(Kind.REFUSED, text, Refusal.INPUT)

    def hear(self, message: Message, now: float) -> list[Message]:
        """The answers to a message of the controller; Garbage where it makes no sense."""
        self._heard_s = now
        if self._life is None:
            if message.kind is not Kind.CLAIM:
                raise Garbage(f"{message.kind.name} before CLAIM")
            return [self._claim(message)]
        try:
            return self._answer(self._life, message, now)
        except ValueError as error:
            if isinstance(error, Garbage):
                raise
            return [say(Kind.REFUSED, str(error), Refusal.VALUE)]
        except RuntimeError as error:
            return [say(Kind.REFUSED, str(error), Refusal.ORDER)]

    def tick(self, now: float) -> list[Message]:
        """Play up to now; what has to be said to the controller."""
        life = self._life
        if life is None:
            return []
        life.play(now)
        out = life.handed_over(now)
        patience = HEARTBEAT_S if life.started else SILENCE_S
        if not life.ending and now - self._heard_s > patience:
            out.append(self.lost(f"no word from the controller for {patience:g} s", now))
        elif life.at_rest:
            life.note("at rest")
            self.tell(f"at rest; {life.ending}; waiting for a controller")
            self._free()
        return out

    def lost(self, why: str, now: float) -> Message:
        """Go on without the controller, and latch why; what to tell it if it still listens."""
        life = self._life
        if life is not None and not life.ending:
            if life.started:
                self.latched = f"controller lost at sample {life.taken}: {why}"
                self._end(life, self.latched, now)
            else:
                self.tell(f"controller lost before its start: {why}")
                self._free()
        return say(Kind.LOST, why)

    def _claim(self, message: Message) -> Message:
        """The machine is the controller's, or why it cannot be."""
        try:
            claim = Claim.model_validate(message.json)
        except ValidationError:
            raise Garbage("a claim that is none") from None
        for ours, theirs, what in (
            (self.rig.output, claim.output, "[output]"),
            (self.rig.sensors, claim.sensors, "[[sensors]]"),
        ):
            if ours != theirs:
                text = (
                    f"the table was started with another machine card: {what} differs; start it "
                    "with the card of this run"
                )
                return say(Kind.REFUSED, text, Refusal.INPUT)
        if claim.rate_hz not in self.rig.rates_hz:
            rates = ", ".join(f"{rate:g}" for rate in self.rig.rates_hz)
            text = f"the table does not sample at {claim.rate_hz:g} Hz; allowed: {rates}"
            return say(Kind.REFUSED, text, Refusal.INPUT)
        try:
            self._life = Life(self.rig, claim.specimen, claim.rate_hz, self.box)
        except BadInput as error:
            return say(Kind.REFUSED, str(error), Refusal.INPUT)
        self._life.note(f"claimed; {self.latched or 'at rest'}")
        return Message(Kind.GRANTED, round(REPLACE_AFTER_S * claim.rate_hz))

    def _answer(self, life: Life, message: Message, now: float) -> list[Message]:
        """The answers to a controller that has the machine."""
        match message.kind:
            case Kind.BEAT:
                return []
            case Kind.TARE:
                samples, most = message.index, MOST_BYTES // (8 * len(life.plant.channels))
                if not 0 <= samples <= most:
                    raise ValueError(f"a tare of {samples} samples; at most {most}")
                return [carry(Kind.TARED, life.plant.tare(samples).T)]
            case Kind.QUEUE:
                life.queue(message.index, message.values, now)
                return [Message(Kind.QUEUED, message.index)]
            case Kind.START:
                life.start(now)
                self.latched = ""
                self.tell("a controller drives the table")
                return [carry(Kind.STARTED, np.array([now]))]
            case Kind.RELEASE:
                if life.started:
                    self._end(life, f"released by its controller at sample {life.taken}", now)
                else:
                    self._free()
                return []
            case _:
                raise Garbage(f"{message.kind.name} is nothing that a controller says here")

    def _end(self, life: Life, why: str, now: float) -> None:
        left_s = life.end(why, now)
        self.tell(f"{why}; it plays what is queued, at rest in {left_s:.2f} s")

    def _free(self) -> None:
        if self._life is not None:
            self._life.plant.close()
        self._life = None
