"""The machine over a socket: controllers, strangers, and what a controller is told."""

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from table_io.backends import SAMPLE_TIMEOUT_S, MachineLost, check_reachable
from table_io.backends.machine.client import MachineBackend
from table_io.backends.machine.protocol import (
    Endpoint,
    MachineConfig,
    MachineMessage,
    MessageKind,
    MessageParser,
    encode_message,
    open_listener,
    parse_endpoint,
    values_message,
)
from table_io.clock import Clock, RealClock
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.sim.machine import server
from table_io.sim.machine.flight_recorder import FlightRecorder
from table_io.sim.machine.table import SimulatedMachine
from tests.builders.drives import make_bump
from tests.builders.flight_records import read_flight_record
from tests.input_errors import raises_input_error
from tests.table_io.sim.test_machine import RATE_HZ, RIG, SPECIMEN, claim


def at(where: str) -> RigConfig:
    return RIG.model_copy(update={"machine": MachineConfig(endpoint=where)})


def controller(where: str, clock: Clock | None = None) -> MachineBackend:
    return MachineBackend(at(where), SPECIMEN, RATE_HZ, clock or RealClock())


START = "shaketwin table --table machine"


@dataclass
class Served:
    """A machine that runs beside the test."""

    where: str
    notices: list[str]
    table: SimulatedMachine


@contextmanager
def serve_machine(where: Endpoint, box: FlightRecorder | None = None) -> Iterator[Served]:
    notices: list[str] = []
    table = SimulatedMachine(RIG, notices.append, box)
    listener = open_listener(where)
    text = where.text
    if where.family is socket.AF_INET:
        text = f"tcp/127.0.0.1:{listener.getsockname()[1]}"
    going = [True]
    thread = threading.Thread(
        target=server.serve_machine, args=(listener, table, RealClock(), lambda: bool(going))
    )
    thread.start()
    try:
        yield Served(text, notices, table)
    finally:
        going.clear()
        thread.join()


@pytest.fixture
def machine() -> Iterator[Served]:
    with serve_machine(parse_endpoint("tcp/127.0.0.1:0")) as table_server:
        yield table_server


def start_motion(where: str) -> MachineBackend:
    """A controller whose table moves for a little, to rest."""
    backend = controller(where)
    backend.open()
    backend.queue(0, make_bump(0.1, 600))
    backend.start()
    backend.read(20)
    return backend


def test_absent_machine_is_refused_with_a_remedy(tmp_path: Path) -> None:
    with raises_input_error(remedy=START):
        controller(f"unix/{tmp_path / 'none'}").open()
    with raises_input_error(remedy=START):
        check_reachable(at(f"unix/{tmp_path / 'none'}"))


def test_check_reachable_claims_nothing(machine: Served) -> None:
    check_reachable(at(machine.where))
    backend = controller(machine.where)
    backend.open()
    check_reachable(at(machine.where))
    assert backend.tare(10).shape == (len(RIG.sensors), 10)
    backend.close()
    check_reachable(RIG.model_copy(update={"backend": "simulated"}))


def test_other_server_is_refused() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as mute:
        where = f"tcp/127.0.0.1:{mute.getsockname()[1]}"
        with pytest.raises(InputError) as error:
            controller(where, RealClock(40.0)).open()  # which has no patience
    assert error.value.where == where
    assert START in error.value.remedy


def test_controller_at_a_time(machine: Served) -> None:
    first = start_motion(machine.where)
    with raises_input_error(where=machine.where):
        controller(machine.where).open()
    first.read(200)
    first.close()


def test_machine_that_is_switched_off_ends_at_rest(tmp_path: Path) -> None:
    box = FlightRecorder(tmp_path / "box", print)
    with serve_machine(parse_endpoint(f"unix/{tmp_path / 'table'}"), box) as table_server:
        backend = start_motion(table_server.where)
    with pytest.raises(MachineLost, match="switched off"):
        backend.read(20000)
    (life,) = read_flight_record(tmp_path / "box")
    assert life.command_m[-1] == 0.0
    assert life.samples.shape[1] >= 600
    assert "switched off" in life.notes[-2][1]
    assert life.notes[-1][1] == "at rest"


@pytest.mark.parametrize(
    "data",
    [
        b"GET / HTTP/1.1\r\n\r\n",
        encode_message(claim()),
        encode_message(MachineMessage(MessageKind.QUEUE, 9, b"1")),
    ],
)
def test_garbage_loses_the_controller_and_not_the_machine(machine: Served, data: bytes) -> None:
    backend = start_motion(machine.where)
    backend._require_connection().sendall(data)
    with pytest.raises(MachineLost, match="invalid message"):
        backend.read(20000)
    with pytest.raises(MachineLost, match="invalid message"):
        backend.queue(5000, np.zeros(2))
    backend.close()
    again = controller(machine.where)
    again.open()  # waits for the rest
    assert "at rest" in machine.notices[-1]
    again.close()


def test_received_samples_are_read_before_the_loss(machine: Served) -> None:
    backend = start_motion(machine.where)
    while backend._samples.received < 200:
        backend._receive()
    backend._require_connection().shutdown(socket.SHUT_RDWR)
    assert np.isfinite(backend.read(100)).all()
    with pytest.raises(MachineLost, match="connection"):
        backend.read(4000)
    assert backend.scheduled_time_s(2000) > backend.scheduled_time_s(0)
    again = controller(machine.where)
    again.open()  # waits for the rest
    again.close()
    assert "the connection closed" in machine.notices[-1]


def test_strangers_at_the_door_do_not_disturb(machine: Served) -> None:
    backend = start_motion(machine.where)
    host, port = "127.0.0.1", int(machine.where.rpartition(":")[2])
    for data in (b"", b"\0" * 5000, encode_message(claim()), b"STM1"):
        with closing(socket.create_connection((host, port))) as stranger:
            stranger.sendall(data)
    assert backend.read(400).shape == (len(RIG.sensors), 400)
    backend.close()


def test_samples_that_do_not_come_are_a_lost_machine(tmp_path: Path) -> None:
    """A machine that answers and then hands over nothing: patience, then MachineLost."""
    path = str(tmp_path / "mute")
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(path)
    listener.listen()

    def answer() -> None:
        connection, _ = listener.accept()
        parser, answers = MessageParser(), 0
        replies = [
            MachineMessage(MessageKind.GRANTED, 60),
            MachineMessage(MessageKind.QUEUED),
            values_message(MessageKind.STARTED, np.array([RealClock().now()])),
        ]
        while data := connection.recv(1 << 16):
            for message in parser.feed(data):
                if message.kind is not MessageKind.BEAT and answers < 3:
                    connection.sendall(encode_message(replies[answers]))
                    answers += 1
        connection.close()

    thread = threading.Thread(target=answer)
    thread.start()
    backend = controller(f"unix/{path}")
    backend.open()
    backend.queue(0, np.zeros(2))
    backend.start()
    with pytest.raises(MachineLost, match=f"{SAMPLE_TIMEOUT_S:g} s after"):
        backend.read(20)
    assert RealClock().now() >= backend.scheduled_time_s(19) + SAMPLE_TIMEOUT_S
    thread.join()
    listener.close()


def test_endpoint_in_use_is_refused_and_a_dead_one_taken_over(tmp_path: Path) -> None:
    where = parse_endpoint(f"unix/{tmp_path / 'table'}")
    with closing(open_listener(where)), pytest.raises(InputError) as error:
        open_listener(where)
    assert error.value.where == f"--listen {where.text}"
    open_listener(where).close()  # its file was left behind
    with closing(open_listener(parse_endpoint("tcp/127.0.0.1:0"))) as taken:
        port = taken.getsockname()[1]
        with raises_input_error(where=f"--listen tcp/127.0.0.1:{port}"):
            open_listener(parse_endpoint(f"tcp/127.0.0.1:{port}"))


@pytest.mark.parametrize("key", ["machine", "simulated"])
def test_card_without_its_table_is_refused(key: str) -> None:
    rig = RIG.model_copy(update={key: None})
    make: Callable[[], object] = (
        (lambda: MachineBackend(rig, SPECIMEN, RATE_HZ, RealClock()))
        if key == "machine"
        else (lambda: SimulatedMachine(rig, print))
    )
    with raises_input_error(key=f"[{key}]"):
        make()
