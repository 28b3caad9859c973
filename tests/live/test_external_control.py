"""What a run beside a controller of its own asks of the disk, the warm-up and the stopwatch."""

import platform
import tomllib
from pathlib import Path
from typing import Any

import pytest

from table_io.backends.follow import FollowWiring
from table_io.backends.opendaq.config import OpenDaqWiring
from table_io.backends.opendaq.source import check_reachable
from table_io.config.base import load_config
from table_io.config.folders import find_config
from table_io.config.rig import RigConfig
from table_io.records import RunStart, Timing
from table_io.sim.opendaq import OpenDaqServer
from tests.input_errors import raises_input_error
from twin.live.twin_process import TwinProcess
from twin.results.contracts import Latency
from twin.results.summary import summarise_timing
from twin.setup.disk import bytes_per_s, planned_bytes
from twin.setup.run_config import compile_rig_kernels, read_run_config

SPARE = "drive_disp_m"


def no_command(folder: Path) -> Path:
    """The card without a wire for the command."""
    text = find_config("follow_simulated", "rigs").read_text()
    first = text.index(f'[[sensors]]\nchannel = "{SPARE}"')
    after = text.index("[[sensors]]", first + 1)
    text = (text[:first] + text[after:]).replace(f'{SPARE} = "command"\n', "")
    path = folder / "follow_bare.toml"
    path.write_text(text.replace(f'command = "{SPARE}"', 'command = "table_disp_m"'))
    assert SPARE not in tomllib.loads(path.read_text())["opendaq"]["signals"]
    return path


def test_a_card_without_a_command_is_warmed_up(tmp_path: Path) -> None:
    compile_rig_kernels(
        read_run_config(find_config("quickstart", "tests"), str(no_command(tmp_path)))
    )


def test_the_time_that_is_waited_for_the_controller_needs_room() -> None:
    here = read_run_config(find_config("quickstart", "tests"), "simulated")
    followed = read_run_config(find_config("quickstart", "tests"), "follow_simulated")
    wiring = followed.rig.get_section(FollowWiring)
    assert wiring is not None
    more = bytes_per_s(followed) * wiring.wait_s
    assert planned_bytes(followed) - planned_bytes(here) == pytest.approx(more)


@pytest.mark.parametrize("follows", [False, True])
def test_held_back_blocks_have_no_latency(follows: bool) -> None:
    absent: Any = None
    twin = TwinProcess("r", absent, absent, absent, absent, "", external_clock=follows)
    start = RunStart(
        0, "r", "n", "table", "", "", "", 2000.0, 20, (), (), 0, {}, {}, platform.node(), "", 5.0
    )
    twin.handle_record(start)
    assert twin.epoch_s == (None if follows else 5.0)


def test_histogram_without_blocks_has_no_latency() -> None:
    timing = summarise_timing((Timing(0, "twin", 0.0, 0.0, 0.0, 0, 0, 0.1, "normal"),))
    assert timing.latency_ms == Latency(p50=None, p99=None, max=None)


def test_malformed_address_is_reported() -> None:
    pytest.importorskip("opendaq")
    rig, _ = load_config(find_config("follow_simulated", "rigs"), RigConfig, "card")
    wiring = rig.get_section(OpenDaqWiring)
    assert wiring is not None
    wiring = wiring.model_copy(update={"device": "daq.nd://a..b"})
    with raises_input_error(where="daq.nd://a..b"):
        check_reachable(rig.model_copy(update={"opendaq": wiring}))


class Signal:
    """One that so many acquire."""

    def __init__(self, connections: int) -> None:
        self.connections = [None] * connections


def test_client_of_the_last_signal_alone_is_noticed() -> None:
    device = object.__new__(OpenDaqServer)
    device._signals = [(Signal(0), None), (Signal(1), None)]
    assert device.has_client
