"""From the exported file to the report: the programs as a person runs them, through openDAQ."""

import json
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from table_io.config.folders import find_config
from table_io.records import Event
from tests.builders.profiles import NO_LOOP_CHECK, format_test
from tests.input_errors import raises_input_error
from tests.table_io.backends.separate_processes import own_network
from twin.recording.reader import read_recording
from twin.rig.table import ExternalController, serve_table

pytest.importorskip("opendaq")
PROGRAM = Path(sys.executable).parent / "shaketwin"
PROFILE = format_test(3.0, 3.2, 0.2, directions=["forward"], tables=NO_LOOP_CHECK)
FOLLOWED = ("--table", "follow_simulated")


def shaketwin(*words: object, folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [PROGRAM, *map(str, words)], cwd=folder, capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_drive_is_exported_played_followed_recorded_and_replayed(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(PROFILE)
    with own_network():
        made = shaketwin("drive", "short.toml", *FOLLOWED, "-o", "drive.csv", folder=tmp_path)
        assert made.returncode == 0, made.stderr
        words = ["table", "--rig", "follow_simulated", "--play", "drive.csv", "--ppm", "-60"]
        with subprocess.Popen(
            [PROGRAM, *words], cwd=tmp_path, stdout=subprocess.PIPE, text=True
        ) as device:
            assert device.stdout is not None
            try:
                assert "EVERY interface" in device.stdout.readline()
                ran = shaketwin("run", "short.toml", *FOLLOWED, "--out", "run", folder=tmp_path)
                device.send_signal(signal.SIGINT)
                assert "switched off at rest" in device.stdout.read()
            finally:
                device.kill()
    assert ran.returncode == 0, ran.stdout + ran.stderr
    events = read_recording(tmp_path / "run" / "run.mcap").records(Event)
    assert [event.index for event in events if event.kind == "follow"] == [0]  # asked to play it
    alignment = [event.text for event in events if event.kind == "aligned"][-1]  # of the whole run
    clock_ppm = re.findall(r"(\S+) ppm", alignment)
    assert [float(ppm) for ppm in clock_ppm] == [pytest.approx(-60.0, abs=0.5)]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["verdict"] == "complete"
    assert summary["gaps"] == 0
    assert [step["frequency_hz"] for step in summary["steps"]] == [3.0, 3.2]
    for step in summary["steps"]:
        assert step["measured"]["eta_d"] == pytest.approx(step["twin"]["eta_d"], rel=0.02)
    again = shaketwin("replay", "run", "--out", "again", folder=tmp_path)
    assert again.returncode == 0, again.stdout + again.stderr
    assert "identical to the bit" in again.stdout


def test_only_a_followed_table_is_played_by_somebody_else() -> None:
    play = find_config("g0", "tests")
    with raises_input_error(where=f"--play {play}"):
        serve_table("simulated", None, None, 1.0, sys.stdout, controller=ExternalController(play))


def test_run_without_device_is_refused(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text(PROFILE)
    with own_network():
        ran = shaketwin("run", "short.toml", *FOLLOWED, "--out", "run", folder=tmp_path)
    assert ran.returncode == 2
    assert "no openDAQ device answers" in ran.stderr
    assert "shaketwin table --table follow_simulated" in ran.stderr
    assert not (tmp_path / "run").exists()
