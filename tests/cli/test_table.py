"""`shaketwin table` and `run --table machine`, as a user meets them."""

import contextlib
import io
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from table_io.backends.machine.client import MachineBackend
from table_io.clock import RealClock
from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.profile import Specimen
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from tests.builders.flight_records import read_flight_record
from tests.builders.rigs import read_rig_text
from tests.input_errors import raises_input_error
from twin.live.run_command import run_test
from twin.rig.table import serve_table

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
CARD = read_rig_text("machine")
SPECIMEN = Specimen.model_validate({"mass_kg": 550.0, "gap_mm": 4.0})


def card(folder: Path) -> Path:
    """A machine card whose machine is reached in this folder."""
    path = folder / "card.toml"
    path.write_text(CARD.replace("tcp/127.0.0.1:7450", f"unix/{folder / 'table'}"))
    return path


@pytest.mark.parametrize(
    ("rig", "listen", "scale", "fields"),
    [
        ("machine", "tcp/0.0.0.0:7450", 1.0, {"key": "endpoint", "value": "tcp/0.0.0.0:7450"}),
        ("machine", "unix/none/there", 1.0, {"where": "--listen unix/none/there"}),
        ("machine", None, 0.5, {"where": "--time-scale 0.5", "allowed": "1 to 20"}),
        (
            "simulated",
            None,
            1.0,
            {"value": "simulated", "allowed": "machine", "remedy": "--listen"},
        ),
        ("machin", None, 1.0, {"remedy": "'machine'"}),
    ],
)
def test_what_is_wrong_is_said_before_anything_listens(
    rig: str, listen: str | None, scale: float, fields: dict[str, str]
) -> None:
    with raises_input_error(**fields):
        serve_table(rig, listen, None, scale, io.StringIO())


def test_a_run_without_its_table_says_how_to_start_it_and_leaves_nothing(tmp_path: Path) -> None:
    profile, rig = PROFILES_DIR / "tests" / "quickstart.toml", str(card(tmp_path))
    with raises_input_error(remedy="shaketwin table --table"):
        run_test(profile, tmp_path / "out", False, None, rig, False, "tcp/127.0.0.1:7447")
    with pytest.raises(InputError) as raised:
        run_test(profile, tmp_path / "out", True, None, rig, False, "tcp/127.0.0.1:7447")
    assert (raised.value.where, raised.value.key) == ("--speed max", "machine")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow  # 3 s each
@pytest.mark.parametrize("gone", [False, True])
def test_a_terminal_that_is_held_or_gone_does_not_hold_the_machine(
    tmp_path: Path, gone: bool
) -> None:
    path = card(tmp_path)
    ours, its = os.pipe()
    command: list[str | Path] = [SHAKETWIN, "table", "--rig", path, "--log", tmp_path / "box"]
    with subprocess.Popen(command, stdout=its) as machine:
        assert b"waiting at" in os.read(ours, 4096)
        if gone:
            os.close(ours)
        else:
            fill(its)
        rig = parse_toml(path.read_text(), RigConfig, "card")
        for _ in range(2):
            backend = MachineBackend(rig, SPECIMEN, 2000.0, RealClock())
            backend.open()
            backend.queue(0, np.zeros(2))
            backend.start()
            assert backend.read(100).shape == (len(rig.sensors), 100)
            backend.close()
        machine.terminate()
    os.close(its)
    if not gone:
        os.close(ours)
    assert machine.returncode == 0
    lives = read_flight_record(tmp_path / "box")
    assert [life.notes[-1][1] for life in lives] == ["at rest", "at rest"]


def fill(pipe: int) -> None:
    """Nobody reads it, and there is no room for another line."""
    os.set_blocking(pipe, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(pipe, b"." * 1024)
    os.set_blocking(pipe, True)
