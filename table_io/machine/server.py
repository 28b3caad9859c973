"""The machine's loop: sockets on one side, the table's thoughts on the other, in small ticks."""

import contextlib
import select
import socket
from collections.abc import Callable
from dataclasses import dataclass, field

from table_io.clock import Clock
from table_io.machine.table import Table
from table_io.machine.wire import Kind, Message, Parser, Refusal, encode, say

TICK_S = 0.005  # of real time, between two looks at the plant
IDLE_S = 0.1  # the same where nothing moves
CLAIM_S = 2.0  # who has connected must say what for
PARTING_S = 1.0  # that a last word may take to be read
RECEIVED_BYTES = 1 << 16
MOST_CALLERS = 32
MOST_WAITING_BYTES = 4 << 20  # a controller that reads so much too little is no controller


@dataclass(slots=True, eq=False)
class _Caller:
    """A connection; `leaves_s` is set where only its last word is still to be delivered."""

    socket: socket.socket
    came_s: float
    parser: Parser = field(default_factory=Parser)
    out: bytearray = field(default_factory=bytearray)
    leaves_s: float | None = None
    silent: bool = False  # it has closed its side


def serve(listener: socket.socket, table: Table, clock: Clock, going: Callable[[], bool]) -> None:
    """Be the machine while `going()`, and until the table is at rest."""
    server = _Server(listener, table, clock)
    try:
        while (wanted := going()) or table.moving:
            if not wanted:
                server.refuse("the table is being switched off")
            server.turn(TICK_S if table.moving else IDLE_S)
    finally:
        server.close()


class _Server:
    """Who is connected, and which of them drives."""

    def __init__(self, listener: socket.socket, table: Table, clock: Clock) -> None:
        self._listener = listener
        self._table = table
        self._clock = clock
        self._callers: list[_Caller] = []
        self._controller: _Caller | None = None

    def turn(self, timeout_s: float) -> None:
        """Hear who speaks, let the machine play, hand over what it says."""
        callers = self._callers
        speaking, _, _ = select.select(
            [self._listener, *(one.socket for one in callers if not one.silent)],
            [one.socket for one in callers if one.out],
            [],
            timeout_s,
        )
        for one in [one for one in callers if one.socket in speaking]:
            self._hear(one)
        if self._listener in speaking:
            self._accept()
        for message in self._table.tick(self._clock.now()):
            self._tell(message)
        for one in list(callers):
            self._deliver(one)

    def refuse(self, why: str) -> None:
        """Take the machine from its controller."""
        if self._controller is not None:
            self._tell(self._table.lost(why, self._clock.now()))

    def close(self) -> None:
        for one in self._callers:
            one.socket.close()
        self._listener.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return  # it went away again
        if len(self._callers) >= MOST_CALLERS:
            connection.close()
            return
        connection.setblocking(False)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        now = self._clock.now()
        one = _Caller(connection, now)
        self._callers.append(one)
        busy = self._table.busy()
        if self._controller is not None:
            busy = busy or say(Kind.REFUSED, "somebody else is just connecting", Refusal.RESTING)
        if busy is None:
            self._controller = one
        else:
            self._part(one, busy)

    def _hear(self, one: _Caller) -> None:
        """Take in what a caller says; one that parts is no longer listened to."""
        try:
            data = one.socket.recv(RECEIVED_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        one.silent = not data
        if one is not self._controller:
            return
        if not data:
            self._leave(one, "the connection closed")
            return
        try:
            for message in one.parser.feed(data):
                for answer in self._table.hear(message, self._clock.now()):
                    self._tell(answer)
                if message.kind is Kind.RELEASE:
                    self._part(one)
                    self._controller = None
                    return
        except Exception as error:  # whatever it said: the machine plays on
            self._leave(one, f"it said what no controller says ({error})")

    def _tell(self, message: Message) -> None:
        """Say something to the controller; a refused claim and a loss are the last word."""
        one = self._controller
        if one is None:
            return
        last = message.kind is Kind.LOST or (
            message.kind is Kind.REFUSED and message.index in (Refusal.INPUT, Refusal.RESTING)
        )
        if last:
            self._controller = None
            self._part(one, message)
            return
        one.out += encode(message)
        if len(one.out) > MOST_WAITING_BYTES:
            self._leave(one, "it does not read what it is sent")

    def _leave(self, one: _Caller, why: str) -> None:
        """The controller is gone, or must go."""
        if one is self._controller:
            self._tell(self._table.lost(why, self._clock.now()))

    def _part(self, one: _Caller, last: Message | None = None) -> None:
        """Say the last word, and close once it is read: closing at once could swallow it."""
        if last is not None:
            one.out += encode(last)
        one.leaves_s = self._clock.now() + PARTING_S

    def _deliver(self, one: _Caller) -> None:
        now = self._clock.now()
        try:
            while one.out:
                del one.out[: one.socket.send(one.out)]
            if one.leaves_s is not None:
                one.socket.shutdown(socket.SHUT_WR)
        except BlockingIOError:
            pass
        except OSError:
            one.silent = True
            one.out.clear()
            self._leave(one, "the connection closed")
        if one is self._controller and not self._table.claimed and now - one.came_s > CLAIM_S:
            self._leave(one, "it connected and claimed nothing")
        if one.leaves_s is not None and (one.silent or now > one.leaves_s):
            one.socket.close()
            self._callers.remove(one)
