"""UDP server of the simulated target: the socket for `target.py`."""

import contextlib
import select
import socket
from collections.abc import Callable

from table_io.backends.udp.config import UdpWiring
from table_io.backends.udp.packets import RIG_PACKET_BYTES
from table_io.clock import Clock
from table_io.errors import InputError
from table_io.sim.machine.table import SimulatedMachine
from table_io.sim.table_service import TableService
from table_io.sim.udp.target import Address, UdpTarget

TICK_S = 0.004  # of real time, between two updates of the plant
IDLE_TICK_S = 0.1  # the same while no rig has claimed the machine
MAX_PACKETS_PER_TICK = 256  # received between two updates
BUFFER_BYTES = 1 << 20


def bind_socket(address: Address) -> socket.socket:
    """Return a socket bound to this address only; InputError if that fails."""
    server_socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        server_socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        server_socket.setblocking(False)
        server_socket.bind(address)
    except OSError as error:
        server_socket.close()
        raise InputError(
            f"cannot listen there: {error.strerror or error}",
            key="udp.target",
            value=f"{address[0]}:{address[1]}",
            remedy="end another target that listens there, or give an address of this computer "
            "and a free port",
        ) from None
    return server_socket


def serve_udp_table(service: TableService) -> None:
    """Serve the target of a rig file."""
    wiring = service.rig.require_section("udp", UdpWiring)
    with contextlib.closing(bind_socket(wiring.address)) as server_socket:
        machine = service.make_machine()
        service.begin(wiring.target)
        serve_udp_target(server_socket, machine, service.clock, service.keep_running)


def serve_udp_target(
    server_socket: socket.socket,
    table: SimulatedMachine,
    clock: Clock,
    keep_running: Callable[[], bool],
) -> None:
    """Serve the target while `keep_running()`, and until the table is at rest."""
    target = UdpTarget(table)
    while (running := keep_running()) or table.moving:
        if not running:
            target.switch_off(clock.now())
        select.select([server_socket], [], [], TICK_S if table.is_claimed else IDLE_TICK_S)
        with contextlib.suppress(BlockingIOError):
            for _ in range(MAX_PACKETS_PER_TICK):
                data, address = server_socket.recvfrom(RIG_PACKET_BYTES + 1)
                target.handle_packet(data, address, clock.now())
        for data, address in target.tick(clock.now()):
            with contextlib.suppress(OSError):  # treated as a lost packet
                server_socket.sendto(data, address)
