"""`devices`: everybody is asked at once, who hangs is not waited for, what fails is a sentence."""

import json
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent import futures
from functools import partial
from pathlib import Path

import grpc
import pytest
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc
from nidaqmx.errors import DaqNotFoundError
from nidaqmx.system import System

from table_io.backends import ChannelGroup, DiscoveredDevice
from table_io.backends.ni import driver as ni_found
from table_io.backends.opendaq import source as daq_found
from table_io.backends.opendaq.source import discover_devices as discover_opendaq_devices
from table_io.config import folders
from table_io.errors import InputError
from tests.builders.rigs import read_rig_text
from tests.command_line import invoke
from tests.input_errors import raises_input_error
from twin.rig import devices as command

MACHINE = read_rig_text("machine")
LASER = DiscoveredDevice(
    "opendaq", "daq.nd://lab", "discovery", "Maker X1", "S1", False,
    (ChannelGroup("AI", ("Sig/AI0", "Sig/AI1"), ((-10.0, 10.0), (-5.0, 5.0)), 1e5),),
)  # fmt: skip
Run = Callable[..., tuple[int, str]]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """`devices ...` in an empty folder, with two shipped cards and one openDAQ device."""
    rigs = tmp_path / "shipped" / "rigs"
    rigs.mkdir(parents=True)
    for name in ("simulated", "machine"):
        (rigs / f"{name}.toml").write_text(read_rig_text(name))
    monkeypatch.setattr(folders, "PROFILES_DIR", tmp_path / "shipped")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(daq_found, "discover_devices", lambda addresses: (LASER,))

    return partial(invoke, "devices")


def cards(text: str) -> dict[str, dict[str, object]]:
    return {entry["card"]: entry for entry in json.loads(text)["cards"]}


def test_every_shipped_card_stands_there_and_whether_it_answers(run: Run) -> None:
    code, text = run("--json")
    by_card = cards(text)
    assert code == 0
    assert set(by_card) == {"simulated", "machine"}
    assert by_card["simulated"]["answers"] is True
    assert by_card["machine"]["where"] == "tcp/127.0.0.1:7450"


def test_cards_of_the_working_directory_too_good_and_bad(run: Run, tmp_path: Path) -> None:
    here = tmp_path / "table"
    (tmp_path / "mine.toml").write_text(MACHINE.replace("tcp/127.0.0.1:7450", f"unix/{here}"))
    (tmp_path / "broken.toml").write_text(MACHINE.replace("span_mm", "spam_mm"))
    (tmp_path / "test.toml").write_text('title = "a test"\n[specimen]\nmass_kg = 1.0\n')
    (tmp_path / "latin.toml").write_bytes(b'backend = "\xe9"\n')
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(here))
        listener.listen()
        code, text = run("--json")
    by_card = cards(text)
    assert code == 0
    assert by_card[str(tmp_path / "mine.toml")]["answers"] is True
    assert by_card[str(tmp_path / "broken.toml")]["answers"] is False
    assert "did you mean 'span_mm'" in str(by_card[str(tmp_path / "broken.toml")]["why"])
    assert not any("test.toml" in name or "latin.toml" in name for name in by_card)
    assert "start it first" in str(cards(run("--json")[1])[str(tmp_path / "mine.toml")]["why"])


def test_devices_stand_in_a_table_with_what_they_have(run: Run) -> None:
    _, text = run()
    assert "daq.nd://lab" in text
    assert "2 AI -10 to 10 V up to 100000 Hz" in text
    devices = json.loads(run("--json")[1])["devices"]
    (laser,) = (device for device in devices if device["kind"] == "opendaq")
    assert laser["ports"][0]["names"] == ["Sig/AI0", "Sig/AI1"]


def test_a_library_that_is_missing_is_said_with_the_pip_line(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "nidaqmx", None)
    monkeypatch.setitem(sys.modules, "opendaq", None)
    monkeypatch.setattr(daq_found, "discover_devices", discover_opendaq_devices)
    code, text = run("--json")
    silent = json.loads(text)["not_found"]
    assert code == 0
    assert "shaketwin[ni]" in silent["NI, local driver"]
    assert "shaketwin[opendaq]" in silent["openDAQ"]


def test_who_hangs_is_not_waited_for_and_who_breaks_is_a_sentence() -> None:
    ever = threading.Event()

    def broken() -> None:
        raise OSError("the driver is gone")

    def refuse() -> None:
        raise InputError("start it first")

    asked = {"good": lambda: 1, "hung": ever.wait, "broken": broken, "refused": refuse}
    answers = command.ask_all(asked, 0.2)
    assert answers["good"] == 1
    assert isinstance(answers["hung"], InputError)
    assert "no answer within 0.2 s" in str(answers["hung"])
    assert str(answers["refused"]) == "start it first"
    assert str(answers["broken"]) == "OSError: the driver is gone"
    ever.set()


def test_all_are_asked_at_once() -> None:
    everybody = threading.Barrier(8)  # passed only where all wait for it together
    asked = {str(k): lambda: everybody.wait(20.0) >= 0 for k in range(8)}
    assert set(command.ask_all(asked, 20.0).values()) == {True}


class Lab(rpc.NiDAQmxServicer):  # type: ignore[misc]  # untyped: its package is skipped
    """A device server with one device that has two inputs, one output and no digital lines."""

    def GetSystemInfoAttributeString(self, request, context):
        return pb.GetSystemInfoAttributeStringResponse(value="Dev1")

    def GetDeviceAttributeString(self, request, context):
        name = pb.DeviceStringAttribute.Name(request.attribute_raw)
        known = {
            "DEVICE_ATTRIBUTE_PRODUCT_TYPE": "PCIe-6363",
            "DEVICE_ATTRIBUTE_AI_PHYSICAL_CHANS": "Dev1/ai0, Dev1/ai1",
            "DEVICE_ATTRIBUTE_AO_PHYSICAL_CHANS": "Dev1/ao0",
        }
        return pb.GetDeviceAttributeStringResponse(value=known.get(name, ""))

    def GetDeviceAttributeDoubleArray(self, request, context):
        return pb.GetDeviceAttributeDoubleArrayResponse(value=[-10.0, 10.0])

    def GetDeviceAttributeUInt32(self, request, context):
        return pb.GetDeviceAttributeUInt32Response(value=0x1A2B)


@pytest.fixture
def server() -> Iterator[str]:
    rpc_server = grpc.server(futures.ThreadPoolExecutor(2))
    port = rpc_server.add_insecure_port("127.0.0.1:0")
    rpc.add_NiDAQmxServicer_to_server(Lab(), rpc_server)
    rpc_server.start()
    yield f"127.0.0.1:{port}"
    rpc_server.stop(None)


def test_a_device_server_is_asked_by_the_vendors_own_client(server: str) -> None:
    (device,) = ni_found.discover_devices(server)
    assert (device.name, device.product, device.serial) == ("Dev1", "PCIe-6363", "1A2B")
    assert device.where == server
    ports = {port.kind: port for port in device.ports}
    assert set(ports) == {"AI", "AO"}
    assert ports["AI"].names == ("Dev1/ai0", "Dev1/ai1")
    assert ports["AI"].ranges_v == ((-10.0, 10.0),)
    assert ports["AI"].most_hz is None  # this server does not say


def test_no_device_server_there_and_no_driver_here(monkeypatch: pytest.MonkeyPatch) -> None:
    with raises_input_error(where="127.0.0.1:9"):
        ni_found.discover_devices("127.0.0.1:9")

    def none() -> object:
        raise DaqNotFoundError("Could not find NI-DAQmx.\nInstall it.")

    monkeypatch.setattr(System, "local", none)
    with pytest.raises(InputError, match=r"^Could not find NI-DAQmx\.$"):
        ni_found.discover_devices(None)
