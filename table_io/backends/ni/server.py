"""The far side of an NI card: the simulated table behind a device behind NI's gRPC protocol."""

import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc

from table_io.backends.ni.device import Device
from table_io.backends.ni.interlock import GuardedTable
from table_io.backends.ni.service import Service
from table_io.card import BadInput
from table_io.clock import Clock
from table_io.machine.table import Table
from table_io.profile import Specimen
from table_io.wiring.ni import NiWiring

TICK_S = 0.005  # between two looks at the device
IDLE_S = 0.1  # the same where nothing moves
CALLS = 8  # at once: a read waits, and another may


class Door:
    """The address of a card's server, free when it was tried; opened by `serve`.

    Not before: gRPC's threads are as urgent as the thread that makes the first of them.
    """

    def __init__(self, wiring: NiWiring) -> None:
        self.wiring = wiring
        self._server: Any = None
        if not wiring.endpoint:
            raise BadInput(
                "ni.endpoint is empty: the table needs an address to listen at; give one, as "
                "127.0.0.1:31763"
            )
        host, _, port = wiring.endpoint.rpartition(":")
        try:
            socket.create_server((host.strip("[]"), int(port))).close()
        except OSError as error:
            raise BadInput(
                f"ni.endpoint = {wiring.endpoint!r}: nobody can listen there ({error.strerror}); "
                "is another server there? End it, or give another endpoint"
            ) from None

    def open(self, service: Service) -> Any:
        """gRPC's server, started."""
        options = (("grpc.so_reuseport", 0),)
        self._server = grpc.server(ThreadPoolExecutor(CALLS), options=options)
        rpc.add_NiDAQmxServicer_to_server(service, self._server)
        self._server.add_insecure_port(self.wiring.endpoint)
        self._server.start()
        return self._server

    def close(self) -> None:
        if self._server is not None:
            self._server.stop(0)


def serve(
    specimen: Specimen, door: Door, machine: Table, clock: Clock, going: Callable[[], bool]
) -> None:
    """Be the device and the table of a card while `going()`, and until the table is at rest.

    A driver is told nothing of a specimen, so it is given here.
    """
    rig = machine.rig
    table = GuardedTable(rig, specimen, machine.tell, machine.box)
    table.prepare()
    device = Device(table, rig.rates_hz, clock.now())
    device.faults = list(door.wiring.faults)
    service = Service(device, door.wiring, clock)
    server = door.open(service)
    while going():
        service.turn()
        server.wait_for_termination(TICK_S if device.moving else IDLE_S)
    server.stop(0)  # whoever drives is gone now, as far as the table knows
    while device.moving:
        service.turn()
        clock.wait_until(clock.now() + TICK_S)
