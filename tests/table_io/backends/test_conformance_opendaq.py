"""The openDAQ client keeps every clause that needs no output, against a device of ours."""

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from table_io.backends import Backend, MachineLost
from table_io.backends.opendaq.config import OpenDaqWiring
from table_io.backends.opendaq.source import OpenDaqSource, check_reachable
from table_io.block import Float1D
from table_io.clock import RealClock
from table_io.config.base import parse_toml
from table_io.config.calibration import volts_to_si
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from tests.input_errors import raises_input_error
from tests.table_io.backends.conformance import ACQUIRING, Bench, read_lossy_rig
from tests.table_io.backends.separate_processes import own_network

pytest.importorskip("opendaq")
FAR_SIDE = Path(__file__).with_name("opendaq_far_side.py")
RATE_HZ = 2000.0


@dataclass(frozen=True, kw_only=True)
class Device(Bench):
    """A Bench and the process behind it."""

    process: subprocess.Popen[str]


@contextmanager
def far_side(folder: Path, unit: str = "V") -> Iterator[Device]:
    """An openDAQ device in a process of its own, and a Bench on it."""
    rig, text = read_lossy_rig("follow_simulated")
    path = folder / "card.toml"
    path.write_text(text)
    clock = RealClock()
    command: list[str | Path] = [sys.executable, FAR_SIDE, path, unit]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        assert "waiting" in process.stdout.readline()

        def make(rate: float) -> Backend:
            return cast(Backend, OpenDaqSource(rig, rate, clock))  # the clauses need no output

        def play(source: OpenDaqSource, volts: Float1D) -> None:
            assert process.stdin is not None
            assert process.stdout is not None
            source.start()
            process.stdin.write(json.dumps(volts.tolist()) + "\n")
            process.stdin.flush()
            stamp = int(process.stdout.readline())
            source.read(round((stamp - source._first_tick) / source._ticks_per_sample))

        try:
            yield Device(rig, clock, make, play=play, process=process)
        finally:
            process.kill()


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with own_network(), far_side(tmp_path_factory.mktemp("device")) as device_bench:
        yield device_bench


@pytest.mark.parametrize("clause", ACQUIRING)
def test_client_keeps_the_contract(clause: str, bench: Bench) -> None:
    ACQUIRING[clause](bench)


def get_wiring(rig: RigConfig) -> OpenDaqWiring:
    wiring = rig.get_section(OpenDaqWiring)
    assert wiring is not None
    return wiring


def replace_signals(rig: RigConfig, **signals: str) -> RigConfig:
    """The card with other signals wired."""
    wiring = get_wiring(rig)
    wiring = wiring.model_copy(update={"signals": {**wiring.signals, **signals}})
    return rig.model_copy(update={"opendaq": wiring})


@pytest.mark.parametrize(
    ("signal", "fields"), [("cell_9", {"allowed": "/Sig/cell_r1"}), ("time", {})]
)
def test_signal_that_is_not_there_or_has_no_time_stamps_is_refused(
    bench: Bench, signal: str, fields: dict[str, str]
) -> None:
    source = OpenDaqSource(replace_signals(bench.rig, force_r1_n=signal), RATE_HZ, bench.clock)
    with raises_input_error(key="opendaq.signals.force_r1_n", value=signal, **fields):
        source.open()
    source.close()


def test_another_rate_than_the_devices_is_refused(bench: Bench) -> None:
    source = OpenDaqSource(bench.rig, 1000.0, bench.clock)
    with pytest.raises(InputError, match="2000 Hz") as error:
        source.open()
    assert (error.value.key, error.value.value) == ("acquisition.rate_hz", 1000.0)
    source.close()


def test_silent_device_is_named(bench: Bench) -> None:
    away = get_wiring(bench.rig).model_copy(update={"device": "daq.nd://127.0.0.1:7499"})
    with pytest.raises(InputError, match="7499") as error:
        check_reachable(bench.rig.model_copy(update={"opendaq": away}))
    assert "shaketwin table --table" in error.value.remedy
    check_reachable(bench.rig)


def test_signals_in_the_cards_units_are_the_volts_of_its_sensors(tmp_path: Path) -> None:
    """And in another unit they are refused."""
    with own_network(), far_side(tmp_path, "card") as bench:
        source = bench.open()
        volts = source.tare(400)
        source.close()
        rig = bench.rig
        at_rest = volts_to_si(volts, rig.sensors, {}).mean(axis=1)
        offset = [0.0 if s.channel == "drive_disp_m" else s.offset for s in rig.sensors]
        expected = np.array(offset) * [s.si_per_unit for s in rig.sensors]
        noise = np.array([s.noise_rms * s.si_per_unit + s.range_si * 1e-6 for s in rig.sensors])
        assert (np.abs(at_rest - expected) < noise).all()
        metres = parse_toml(
            (tmp_path / "card.toml").read_text().replace('unit = "mm"', 'unit = "m"', 1),
            RigConfig,
            "m",
        )
        wrong = OpenDaqSource(metres, RATE_HZ, bench.clock)
        with pytest.raises(InputError, match=" mm;") as error:
            wrong.open()
        assert error.value.key == "drive_disp_m"
        assert error.value.allowed.startswith("V, or m ")
        wrong.close()


def test_dead_device_is_a_lost_machine(tmp_path: Path) -> None:
    """Each time, and no sample is made up."""
    with own_network(), far_side(tmp_path) as bench:
        source = bench.start_playing(np.zeros(2))
        source.read(400)
        bench.process.kill()
        for _ in range(2):
            with pytest.raises(MachineLost):
                source.read(4000)
        source.close()
