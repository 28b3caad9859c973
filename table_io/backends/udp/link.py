"""A rig's socket towards a UDP target: what it says is numbered, what comes is checked."""

import contextlib
import secrets
import select
import socket
import zlib
from dataclasses import replace

from table_io.backends.udp.packets import (
    STATE_BYTES,
    Kind,
    Reason,
    State,
    Word,
    decode_state,
    encode_word,
)
from table_io.card import BadInput
from table_io.clock import Clock, RealClock
from table_io.rig import Rig
from table_io.wiring.udp import UdpWiring

ANSWER_S = 1.0  # that a target may take for an answer
BUFFER_BYTES = 1 << 20

WORDS = {
    Reason.NONE: "it does not say why",
    Reason.BUSY: "it has a rig already; end that one first",
    Reason.RATE: "it does not sample at that rate; ask for one that it has",
    Reason.CHANNELS: "it has another number of channels than the card has [[sensors]]; make them "
    "the same",
    Reason.SILENCE: "it heard no word from this rig for too long and goes on alone",
    Reason.RELEASED: "its rig released it",
    Reason.SWITCHED_OFF: "it is being switched off",
    Reason.CARD: "it was started with another machine card; start it with the card of this run",
}


def digest(rig: Rig) -> int:
    """A number that differs where [output] or [[sensors]] of two cards differ; never 0."""
    told = rig.model_dump_json(include={"output", "sensors"})
    return zlib.crc32(told.encode()) or 1


class Link:
    """One life's words to the target and back; BadInput where the address cannot be used."""

    def __init__(self, wiring: UdpWiring, clock: Clock, port: int | None = None) -> None:
        self.session = secrets.randbits(63) + 1
        self.spoke_s = clock.now()
        self._clock = clock
        self._sequence = 0
        port = wiring.rig_port if port is None else port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
            self._socket.setblocking(False)
            self._socket.bind(("", port))
            self._socket.connect(wiring.address)  # nobody else is heard
        except OSError as error:
            self._socket.close()
            raise BadInput(
                f"udp.target = {wiring.target!r}, udp.rig_port = {wiring.rig_port}: "
                f"{error.strerror or error}; give an address that this computer can reach, and a "
                "port that is free (0: any)"
            ) from None

    def say(self, word: Word) -> None:
        """Send a word; whether it arrived is told by what comes back."""
        self._sequence = (self._sequence + 1) & 0xFFFFFFFF
        self.spoke_s = self._clock.now()
        packet = encode_word(replace(word, session=self.session, sequence=self._sequence))
        with contextlib.suppress(OSError):
            self._socket.send(packet)

    def hear(self, timeout_s: float) -> list[State]:
        """What lies there, or comes first within this time; what is no state is left out."""
        states: list[State] = []
        if not select.select([self._socket], [], [], timeout_s)[0]:
            return states
        with contextlib.suppress(OSError):  # nothing more lies there, or nobody listens there now
            while True:
                state = decode_state(self._socket.recv(STATE_BYTES + 1))
                if state is not None:
                    states.append(state)
        return states

    def close(self) -> None:
        self._socket.close()


def state_of(wiring: UdpWiring, clock: Clock, timeout_s: float = ANSWER_S) -> State:
    """What a target says of itself; BadInput where nobody answers. Claims nothing.

    From any port first, for another rig may have rig_port; then from that one, for some targets
    answer no other.
    """
    for port in dict.fromkeys((0, wiring.rig_port)):
        state = _told(Link(wiring, clock, port), clock, timeout_s)
        if state is not None:
            return state
    raise BadInput(
        f"no UDP target answers at {wiring.target}; start it, and see that its address and port "
        "are those of the machine card (the simulated one: shaketwin table --rig udp_simulated)"
    )


def _told(link: Link, clock: Clock, timeout_s: float) -> State | None:
    """What a target says when it is asked; None where it says nothing."""
    try:
        until = clock.now() + timeout_s
        while clock.now() < until:
            link.say(Word(Kind.BEAT))
            states = link.hear(timeout_s / 20)
            if states:
                return states[-1]
            clock.wait_until(min(clock.now() + timeout_s / 100, until))
    finally:
        link.close()
    return None


def answers(rig: Rig) -> None:
    """BadInput where the card's target does not answer; claims nothing."""
    if rig.udp is not None:
        state_of(rig.udp, RealClock())
