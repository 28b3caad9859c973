"""Server of the simulated DAQ device and its table, with NI's gRPC protocol."""

import contextlib
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc

from table_io.backends.ni.config import NiWiring
from table_io.clock import Clock
from table_io.config.profile import Specimen
from table_io.errors import InputError
from table_io.sim.machine.table import SimulatedMachine
from table_io.sim.ni.device import SimulatedDaqDevice
from table_io.sim.ni.interlock import InterlockedTable
from table_io.sim.ni.service import NiDeviceService
from table_io.sim.table_service import TableService

TICK_S = 0.005  # between two updates of the device
IDLE_TICK_S = 0.1  # the same while nothing moves
MAX_CONCURRENT_CALLS = 8  # a read that waits must not block other calls


class ServerEndpoint:
    """Address of the server, tested to be free; `serve_ni_device` opens it.

    It is opened late because gRPC's threads inherit the priority of the thread that creates them.
    """

    def __init__(self, wiring: NiWiring) -> None:
        self.wiring = wiring
        self._server: Any = None
        if not wiring.endpoint:
            raise InputError(
                "empty, but the simulated table needs an address to listen at",
                key="ni.endpoint",
                remedy="give one, for example 127.0.0.1:31763",
            )
        host, _, port = wiring.endpoint.rpartition(":")
        try:
            socket.create_server((host.strip("[]"), int(port))).close()
        except OSError as error:
            raise InputError(
                f"cannot listen there: {error.strerror}",
                key="ni.endpoint",
                value=wiring.endpoint,
                remedy="end another server that listens there, or give another endpoint",
            ) from None

    def open(self, service: NiDeviceService) -> Any:
        """Start and return the gRPC server."""
        options = (("grpc.so_reuseport", 0),)
        self._server = grpc.server(ThreadPoolExecutor(MAX_CONCURRENT_CALLS), options=options)
        rpc.add_NiDAQmxServicer_to_server(service, self._server)
        self._server.add_insecure_port(self.wiring.endpoint)
        self._server.start()
        return self._server

    def close(self) -> None:
        if self._server is not None:
            self._server.stop(0)


def serve_ni_table(service: TableService) -> None:
    """Serve the device of a rig file."""
    wiring = service.rig.require_section("ni", NiWiring)
    with contextlib.closing(ServerEndpoint(wiring)) as endpoint:
        machine = service.make_machine()
        service.begin(wiring.endpoint)
        serve_ni_device(service.specimen, endpoint, machine, service.clock, service.keep_running)


def serve_ni_device(
    specimen: Specimen,
    endpoint: ServerEndpoint,
    machine: SimulatedMachine,
    clock: Clock,
    keep_running: Callable[[], bool],
) -> None:
    """Serve device and table while `keep_running()`, and until the table is at rest.

    DAQmx calls carry no specimen, so it is an argument.
    """
    rig = machine.rig
    table = InterlockedTable(rig, specimen, machine.notify, machine.recorder)
    table.warm_up()
    device = SimulatedDaqDevice(table, rig.rates_hz, clock.now())
    device.faults = list(endpoint.wiring.faults)
    service = NiDeviceService(device, endpoint.wiring, clock)
    server = endpoint.open(service)
    while keep_running():
        service.advance()
        server.wait_for_termination(TICK_S if device.moving else IDLE_TICK_S)
    server.stop(0)  # no heartbeat from here on
    while device.moving:
        service.advance()
        clock.wait_until(clock.now() + TICK_S)
