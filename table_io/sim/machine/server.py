"""Server loop of the simulated machine: sockets, and a periodic tick of the table."""

import contextlib
import select
import socket
from collections.abc import Callable
from dataclasses import dataclass, field

from table_io.backends.machine.protocol import (
    MachineConfig,
    MachineMessage,
    MessageKind,
    MessageParser,
    Refusal,
    encode_message,
    open_listener,
    parse_endpoint,
    text_message,
)
from table_io.clock import Clock
from table_io.sim.machine.table import SimulatedMachine, TableService

TICK_S = 0.005  # of real time, between two updates of the plant
IDLE_TICK_S = 0.1  # the same while nothing moves
CLAIM_TIMEOUT_S = 2.0  # from connecting to the claim
CLOSE_TIMEOUT_S = 1.0  # for the client to read the last message
RECEIVE_BYTES = 1 << 16
MAX_CLIENTS = 32
MAX_UNSENT_BYTES = 4 << 20  # a controller that falls further behind is dropped


@dataclass(slots=True, eq=False)
class _Client:
    """Connection; `close_deadline_s` is set while only its last message remains to be sent."""

    socket: socket.socket
    connected_s: float
    parser: MessageParser = field(default_factory=MessageParser)
    out: bytearray = field(default_factory=bytearray)
    close_deadline_s: float | None = None
    read_closed: bool = False  # the client has closed its side


def serve_machine_table(service: TableService, listen: str | None = None) -> None:
    """Serve the machine of a rig file at its endpoint, or at `listen`."""
    machine_config = service.rig.get_section(MachineConfig)
    address = parse_endpoint(listen or (machine_config.endpoint if machine_config else ""))
    with contextlib.closing(open_listener(address)) as listener:
        machine = service.make_machine()
        service.begin(address.text)
        serve_machine(listener, machine, service.clock, service.keep_running)


def serve_machine(
    listener: socket.socket, table: SimulatedMachine, clock: Clock, keep_running: Callable[[], bool]
) -> None:
    """Serve the machine while `keep_running()`, and until the table is at rest."""
    server = _Server(listener, table, clock)
    try:
        while (running := keep_running()) or table.moving:
            if not running:
                server.drop_controller("the table is being switched off")
            server.run_tick(TICK_S if table.moving else IDLE_TICK_S)
    finally:
        server.close()


class _Server:
    """Connected clients, and which of them is the controller."""

    def __init__(self, listener: socket.socket, table: SimulatedMachine, clock: Clock) -> None:
        self._listener = listener
        self._table = table
        self._clock = clock
        self._clients: list[_Client] = []
        self._controller: _Client | None = None

    def run_tick(self, timeout_s: float) -> None:
        """Receive messages, advance the machine, send its messages."""
        clients = self._clients
        readable, _, _ = select.select(
            [self._listener, *(client.socket for client in clients if not client.read_closed)],
            [client.socket for client in clients if client.out],
            [],
            timeout_s,
        )
        for client in [client for client in clients if client.socket in readable]:
            self._receive(client)
        if self._listener in readable:
            self._accept()
        for message in self._table.tick(self._clock.now()):
            self._send_to_controller(message)
        for client in list(clients):
            self._flush(client)

    def drop_controller(self, reason: str) -> None:
        """Drop the controller; the table comes to rest."""
        if self._controller is not None:
            self._send_to_controller(self._table.drop_controller(reason, self._clock.now()))

    def close(self) -> None:
        for client in self._clients:
            client.socket.close()
        self._listener.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return  # the client has disconnected again
        if len(self._clients) >= MAX_CLIENTS:
            connection.close()
            return
        connection.setblocking(False)
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        now_s = self._clock.now()
        client = _Client(connection, now_s)
        self._clients.append(client)
        busy = self._table.busy_refusal()
        if self._controller is not None:
            busy = busy or text_message(
                MessageKind.REFUSED, "another controller is connecting", Refusal.RESTING
            )
        if busy is None:
            self._controller = client
        else:
            self._close_client(client, busy)

    def _receive(self, client: _Client) -> None:
        """Receive messages of a client and handle those of the controller."""
        try:
            data = client.socket.recv(RECEIVE_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        client.read_closed = not data
        if client is not self._controller:
            return
        if not data:
            self._drop_client(client, "the connection closed")
            return
        try:
            for message in client.parser.feed(data):
                for answer in self._table.handle_message(message, self._clock.now()):
                    self._send_to_controller(answer)
                if message.kind is MessageKind.RELEASE:
                    self._close_client(client)
                    self._controller = None
                    return
        except Exception as error:  # no message may stop the machine
            self._drop_client(client, f"invalid message ({error})")

    def _send_to_controller(self, message: MachineMessage) -> None:
        """Send a message to the controller; close after a refused claim or a loss."""
        client = self._controller
        if client is None:
            return
        last = message.kind is MessageKind.LOST or (
            message.kind is MessageKind.REFUSED
            and message.index in (Refusal.INPUT, Refusal.RESTING)
        )
        if last:
            self._controller = None
            self._close_client(client, message)
            return
        client.out += encode_message(message)
        if len(client.out) > MAX_UNSENT_BYTES:
            self._drop_client(client, "the controller does not read the samples")

    def _drop_client(self, client: _Client, reason: str) -> None:
        """Drop a client, if it is the controller."""
        if client is self._controller:
            self._send_to_controller(self._table.drop_controller(reason, self._clock.now()))

    def _close_client(self, client: _Client, last: MachineMessage | None = None) -> None:
        """Send the last message and close once it is read; closing at once could discard it."""
        if last is not None:
            client.out += encode_message(last)
        client.close_deadline_s = self._clock.now() + CLOSE_TIMEOUT_S

    def _flush(self, client: _Client) -> None:
        now_s = self._clock.now()
        try:
            while client.out:
                del client.out[: client.socket.send(client.out)]
            if client.close_deadline_s is not None:
                client.socket.shutdown(socket.SHUT_WR)
        except BlockingIOError:
            pass
        except OSError:
            client.read_closed = True
            client.out.clear()
            self._drop_client(client, "the connection closed")
        if (
            client is self._controller
            and not self._table.is_claimed
            and now_s - client.connected_s > CLAIM_TIMEOUT_S
        ):
            self._drop_client(client, "no claim after connecting")
        if client.close_deadline_s is not None and (
            client.read_closed or now_s > client.close_deadline_s
        ):
            client.socket.close()
            self._clients.remove(client)
