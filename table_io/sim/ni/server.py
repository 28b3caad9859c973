"""Server of the simulated DAQ device and its table, with NI's gRPC protocol.

The table is behind an interlock with a watchdog on the heartbeat line. The caller supplies the
time. The output voltage is the command to the servo, also if it freezes in motion. If the heartbeat
line does not change for HEARTBEAT_TIMEOUT_S while an output drives, the watchdog assumes that the
rig is dead: the device plays what it holds, then the interlock brings the table smoothly to its
mean. An output that ends at the mean is a normal end and raises no alarm.
"""

import contextlib
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
import numpy as np
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc

from table_io.backends import HEARTBEAT_TIMEOUT_S
from table_io.backends.command_buffer import plan_stop
from table_io.backends.ni.config import NiWiring
from table_io.block import Float1D, Float2D
from table_io.clock import Clock, ManualClock
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.machine.table import (
    MAX_REST_MOTION_M,
    MIN_REST_S,
    MachineSession,
    SimulatedMachine,
    TableService,
)
from table_io.sim.ni.device import DriverError, ErrorCode, SimulatedDaqDevice
from table_io.sim.ni.service import NiDeviceService
from table_io.sim.simulated_table import SimulatedBackend

NEVER_SAMPLE = -(1 << 40)
MAX_RESTART_OFFSET_M = 1e-4  # from the mean, for a restart with the command at 0


class InterlockedTable:
    """Table of a rig with a [simulated] table; `notify` prints a status line."""

    def __init__(
        self,
        rig: RigConfig,
        specimen: Specimen,
        notify: Callable[[str], None],
        recorder: FlightRecorder | None = None,
    ) -> None:
        self._rig, self._specimen, self._notify, self._recorder = rig, specimen, notify, recorder
        self._rest_plants: dict[float, SimulatedBackend] = {}
        self._session: MachineSession | None = None
        self._rest_position_m = 0.0  # position of the table
        self._last_moved = NEVER_SAMPLE  # sample at which it reached it
        self._last_volts = np.zeros(1)  # last voltage from the device
        self._now_s = self._last_heartbeat_s = 0.0
        self._freeze_reason = ""  # why the voltage is frozen
        self._alarm = ""
        self._rest_from: int | None = None  # sample from which the command stays at its mean

    @property
    def moving(self) -> bool:
        """True from a start until rest."""
        return self._session is not None and self._session.started

    def warm_up(self) -> None:
        """Compile the kernels that a run needs."""
        for rate in self._rig.rates_hz:
            self.read_at_rest(rate, 1)

    def set_recorder(self, recorder: FlightRecorder | None) -> None:
        """Use this recorder from the next start on."""
        self._recorder = recorder

    def read_at_rest(self, rate_hz: float, samples: int) -> Float2D:
        """Return input volts at rest, (channel, sample)."""
        if rate_hz not in self._rest_plants:
            plant = SimulatedBackend(self._rig, self._specimen, rate_hz, ManualClock())
            plant.open()
            self._rest_plants[rate_hz] = plant
        return self._rest_plants[rate_hz].tare(samples)

    def arm(self, rate_hz: float) -> None:
        """Prepare a start at this rate; DriverError if the table still moves."""
        self.play(self._now_s)  # the previous session may have ended
        resting = self._rest_from is not None and abs(self._rest_position_m) <= MAX_RESTART_OFFSET_M
        if self._session is not None and resting and self._session.taken >= (self._rest_from or 0):
            self._end_session(self._session, self._now_s)
        if self.moving:
            raise DriverError(ErrorCode.RESERVED)
        self._session = MachineSession(self._rig, self._specimen, rate_hz, self._recorder)
        plant = self._session.plant
        plant.replace_after = 1  # the device in front of it holds what cannot be replaced
        inner_observer, self._rest_position_m, self._last_moved = plant.observer, 0.0, NEVER_SAMPLE

        def observe(first: int, command_m: Float1D, signals: Float2D) -> None:
            if inner_observer is not None:
                inner_observer(first, command_m, signals)
            if np.abs(signals[0] - self._rest_position_m).max() > MAX_REST_MOTION_M:
                self._rest_position_m = float(signals[0, -1])
                self._last_moved = first + command_m.size

        plant.observer = observe
        self._freeze_reason = self._alarm = ""
        self._rest_from = None

    def feed(self, index: int, volts: Float1D) -> None:
        """Play these volts, (sample,), from sample `index` on, then hold the last one."""
        if self._session is not None:
            self._last_volts = volts[-1:]
            # Last value twice: `session` then sees no motion that it has to stop.
            held = np.append(volts, self._last_volts)
            self._session.queue(index, held, self._now_s)

    def start(self, now_s: float) -> None:
        """Start with output sample 0 at `now_s`."""
        if self._session is not None:
            self._session.start(now_s)
            self._now_s = self._last_heartbeat_s = now_s
            self._notify("the output drives the table")

    def freeze(self, reason: str) -> None:
        """Freeze the output voltage, as no task drives it any longer."""
        self._freeze_reason = self._freeze_reason or reason
        if self._session is not None:
            self._session.note(reason)

    def receive_heartbeat(self, now_s: float) -> None:
        """Register an edge of the heartbeat line at `now_s`."""
        self._last_heartbeat_s = now_s

    def play(self, now_s: float) -> list[Float2D]:
        """Advance to `now_s`; return input volts that have arrived, (channel, sample) each."""
        self._now_s, session = now_s, self._session
        if session is None or not session.started:
            return []
        session.play(now_s)
        channel_count = len(self._rig.channels)
        blocks = [
            np.asarray(message.values).reshape(-1, channel_count).T
            for message in session.pop_arrived(now_s)
        ]
        if (
            not self._alarm
            and now_s - self._last_heartbeat_s > HEARTBEAT_TIMEOUT_S
            and not (self._freeze_reason and self._at_mean)
        ):
            self._alarm = f"no heartbeat for {HEARTBEAT_TIMEOUT_S:g} s at sample {session.taken}"
            session.note(self._alarm)
            self._notify(f"{self._alarm}; the device plays what it holds, then the table stops")
        if self._freeze_reason and self._rest_from is None and (self._alarm or self._at_mean):
            self._rest_from = NEVER_SAMPLE if self._at_mean else self._land(session)
        if self._rest_from is not None:
            rest_samples = session.taken - max(self._rest_from, self._last_moved)
            if rest_samples >= MIN_REST_S * session.plant.rate_hz:
                self._end_session(session, now_s)
        return blocks

    @property
    def _at_mean(self) -> bool:
        """True if the output is at its mean, 0 V, within half a step."""
        return abs(float(self._last_volts[-1])) <= 0.5 * self._rig.output.lsb_m * self._volts_per_m

    @property
    def _volts_per_m(self) -> float:
        return self._rig.output.volts_per_m

    def _land(self, session: MachineSession) -> int:
        """Bring the command to its mean; return the sample from which it rests there."""
        held_m = np.repeat(self._last_volts / self._volts_per_m, 3)
        path = plan_stop(held_m, session.plant.rate_hz) * self._volts_per_m
        session.queue(session.taken, path, self._now_s)
        session.note("stopped by the machine's interlock")
        return session.taken + path.size

    def _end_session(self, session: MachineSession, now_s: float) -> None:
        reason = "; ".join(cause for cause in (self._alarm, self._freeze_reason) if cause)
        session.end(reason, now_s)
        session.note("at rest")
        self._notify(f"at rest; {reason}")
        session.plant.close()
        self._session = None


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
