"""Digital inputs: a heartbeat that comes back and stops, switches that say that all is well."""

from collections.abc import Iterator
from concurrent import futures
from typing import Any

import grpc
import pytest
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc

from table_io.backends import MachineLost, find_descriptor
from table_io.backends.ni.config import NiWiring
from table_io.backends.ni.driver import NiDigitalInputs
from table_io.clock import ManualClock
from table_io.config.base import parse_toml
from table_io.config.rig import RigConfig
from table_io.safety.wiring_check import CheckLine, check_digital_inputs
from table_io.sim.ni.device import SimulatedDaqDevice
from table_io.sim.ni.service import NiDeviceService
from tests.builders.rigs import RIG_TEXT, read_rig_text
from tests.input_errors import raises_input_error

TEXT = read_rig_text("ni_simulated")
WATCHED = """
heartbeat_back = "Dev1/port0/line1"
well = { "stroke limit right" = "Dev1/port0/line2" }
"""
LOOKS, SECONDS = 200, 4.0


def make_looks(hz: float, count: int = LOOKS, well: bool = True) -> list[dict[str, bool]]:
    """Looks fifty times a second at a heartbeat, and at a switch."""
    return [{"heartbeat": (2.0 * hz * k / 50.0) % 2.0 >= 1.0, "limit": well} for k in range(count)]


def check_inputs(held: list[dict[str, bool]], after: list[dict[str, bool]]) -> dict[str, CheckLine]:
    return {line.name: line for line in check_digital_inputs(held, SECONDS, after, True, True)}


def test_heartbeat_that_beats_and_stops_passes() -> None:
    lines = check_inputs(make_looks(10.0), make_looks(0.0, 25))
    assert {line.verdict for line in lines.values()} == {"pass"}
    assert lines["heartbeat comes back"].value == pytest.approx(10.0, abs=0.2)


@pytest.mark.parametrize("hz", [0.0, 2.0, 20.0])
def test_heartbeat_of_another_frequency_fails(hz: float) -> None:
    lines = check_inputs(make_looks(hz), make_looks(0.0, 25))
    assert lines["heartbeat comes back"].verdict == "fail"
    assert lines["heartbeat comes back"].do


def test_heartbeat_without_the_rig_fails() -> None:
    assert check_inputs(make_looks(10.0), make_looks(10.0, 25))["heartbeat stops"].verdict == "fail"


def test_open_switch_fails_even_once() -> None:
    held = make_looks(10.0)
    held[77]["limit"] = False
    line = check_inputs(held, make_looks(0.0, 25))["all is well"]
    assert (line.verdict, line.channel) == ("fail", "limit")


def test_unwired_inputs_are_not_tested() -> None:
    lines = {line.name: line for line in check_digital_inputs([], SECONDS, [], True, False)}
    assert {line.verdict for line in lines.values()} == {"not tested"}
    assert "heartbeat_back" in lines["heartbeat comes back"].do
    assert "by hand" in lines["stroke limits and emergency stop"].do
    assert check_digital_inputs([], SECONDS, [], False, True) == ()


def test_card_without_such_inputs_opens_none() -> None:
    rig = parse_toml(TEXT, RigConfig, "card")
    open_digital_inputs = find_descriptor(rig).open_digital_inputs
    assert open_digital_inputs is not None
    assert open_digital_inputs(rig) is None
    text = RIG_TEXT
    assert find_descriptor(parse_toml(text, RigConfig, "c")).open_digital_inputs is None


class Nothing:
    """A table that stands still."""

    moving = False

    def play(self, now_s: float) -> list[Any]:
        return []


@pytest.fixture
def lab() -> Iterator[tuple[NiWiring, NiDeviceService, grpc.Server]]:
    """A device server with the card's digital inputs, and the way to it."""
    wiring = parse_toml(TEXT.replace("[ni]\n", f"[ni]{WATCHED}"), RigConfig, "card").get_section(
        NiWiring
    )
    assert wiring is not None
    clock = ManualClock()
    service = NiDeviceService(SimulatedDaqDevice(Nothing(), (2000.0,), 0.0), wiring, clock)  # type: ignore[arg-type]
    server = grpc.server(futures.ThreadPoolExecutor(2))
    port = server.add_insecure_port("127.0.0.1:0")
    rpc.add_NiDAQmxServicer_to_server(service, server)
    server.start()
    yield wiring.model_copy(update={"endpoint": f"127.0.0.1:{port}"}), service, server
    server.stop(None)


Lab = tuple[NiWiring, NiDeviceService, grpc.Server]


def test_vendors_client_reads_the_lines_of_the_card(lab: Lab) -> None:
    wiring, service, _ = lab
    lines = NiDigitalInputs(wiring)
    assert lines.read_levels() == {"heartbeat": False, "stroke limit right": True}
    service._heartbeat_level = True
    assert lines.read_levels() == {"heartbeat": True, "stroke limit right": True}
    lines.close()
    lines.close()
    assert service.device.tasks == ()
    NiDigitalInputs(wiring).close()  # and once more


def test_missing_line_is_refused(lab: Lab) -> None:
    wiring, service, _ = lab
    with raises_input_error(remedy="heartbeat_back and well") as error:
        NiDigitalInputs(wiring.model_copy(update={"well": {"limit": "Dev1/port9/line9"}}))
    assert "Dev1/port9/line9" in error.value.key
    assert service.device.tasks == ()


def test_server_that_goes_is_a_lost_machine(lab: Lab) -> None:
    wiring, _, server = lab
    lines = NiDigitalInputs(wiring)
    server.stop(None).wait()
    with pytest.raises(MachineLost):
        lines.read_levels()
    lines.close()
