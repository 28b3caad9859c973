"""NI's client and our device in one process, on one clock, with no socket between: for tests."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
from nidaqmx._stubs import nidaqmx_pb2 as pb

from table_io.backends.ni.backend import NiBackend
from table_io.backends.ni.config import NiWiring
from table_io.clock import Clock, ManualClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.ni.device import SimulatedDaqDevice
from table_io.sim.ni.server import InterlockedTable
from table_io.sim.ni.service import NiDeviceService
from tests.builders.profiles import SPECIMEN
from tests.builders.rigs import read_rig_text

CARD = read_rig_text("ni_simulated")


def get_wiring(rig: RigConfig) -> NiWiring:
    wiring = rig.get_section(NiWiring)
    assert wiring is not None
    return wiring


class Answer(grpc.RpcError):  # type: ignore[misc]  # grpc is skipped
    """What a client sees of an error: its code, its words, its metadata."""

    def __init__(self, code: Any, details: str, trailing: Any) -> None:
        super().__init__(details)
        self._answer = (code, details, trailing)

    def code(self) -> Any:
        return self._answer[0]

    def details(self) -> Any:
        return self._answer[1]

    def trailing_metadata(self) -> Any:
        return [SimpleNamespace(key=key, value=value) for key, value in self._answer[2]]


class Context:
    """What a server's call sees of its client."""

    trailing: tuple[Any, ...] = ()

    def set_trailing_metadata(self, metadata: tuple[Any, ...]) -> None:
        self.trailing = metadata

    def abort(self, code: Any, details: str) -> None:
        raise Answer(code, details, self.trailing)

    def is_active(self) -> bool:
        return True


class Wire:
    """A channel whose calls arrive at once, through the same bytes as on a socket."""

    def __init__(self, service: NiDeviceService) -> None:
        self._service = service
        self._calls: dict[str, Callable[..., Any]] = {}

    def unary_unary(
        self,
        path: str,
        request_serializer: Callable[[Any], bytes],
        response_deserializer: Callable[[bytes], Any],
        **_: Any,
    ) -> Callable[..., Any]:
        name = path.rsplit("/", 1)[1]
        if name in self._calls:
            return self._calls[name]
        request_type = getattr(pb, f"{name}Request", None)

        def call(request: Any, timeout: float = 0.0, metadata: Any = None) -> Any:
            sent = request_type.FromString(request_serializer(request))  # type: ignore[union-attr]
            answer = getattr(self._service, name)(sent, Context())
            return response_deserializer(answer.SerializeToString())

        self._calls[name] = call
        return call

    def unary_stream(self, *_: Any, **__: Any) -> None:
        return None

    stream_unary = stream_stream = unary_stream


class Bed:
    """A device with its table, and backends that reach it; both on one clock unless stated."""

    def __init__(
        self,
        text: str = CARD,
        box: Path | None = None,
        clock: Clock | None = None,
        device_clock: Clock | None = None,
    ) -> None:
        self.rig = parse_toml(text, RigConfig, "ni_simulated")
        self.clock: Clock = clock or ManualClock(100.0)
        device_clock = device_clock or self.clock
        self.notices: list[str] = []
        self.box = FlightRecorder(box, self.notices.append) if box is not None else None
        self.table = InterlockedTable(self.rig, SPECIMEN, self.notices.append, self.box)
        self.table.warm_up()
        self.device = SimulatedDaqDevice(self.table, self.rig.rates_hz, device_clock.now())
        wiring = get_wiring(self.rig)
        self.device.faults = list(wiring.faults)
        self.service = NiDeviceService(self.device, wiring, device_clock)
        self.wire = Wire(self.service)

    def backend(self, rate_hz: float = 2000.0, clock: Clock | None = None) -> NiBackend:
        return NiBackend(self.rig, SPECIMEN, rate_hz, clock or self.clock, self.wire)

    def rest(self) -> None:
        """Let it come to rest."""
        while self.device.moving:
            self.clock.wait_until(self.clock.now() + 0.1)
            self.service.advance()


def note_heartbeats(bed: Bed) -> list[float]:
    """The times in s, to be, at which the table receives an edge of the heartbeat."""
    times: list[float] = []
    receive = bed.table.receive_heartbeat

    def note(now_s: float) -> None:
        times.append(now_s)
        receive(now_s)

    bed.table.receive_heartbeat = note  # type: ignore[method-assign]
    return times
