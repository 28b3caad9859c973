"""The unstable branch held in real time through packets to a target in C with a specimen in C."""

import json
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from table_io.backends import udp
from tests.builders.rigs import read_rig_text
from tests.live.test_live import SHAKETWIN
from tests.table_io.backends.udp_bench import SHIPPED, free_port

SOURCES = Path(udp.__file__).parent
SPECIMEN = Path(__file__).parents[1] / "table_io" / "backends" / "specimen_target.c"
PROFILE = """
title = "Two unstable orbits at G4"
rig = "rig.toml"
model = "snm"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[excitation]
kind = "continuation"
start_hz = 3.2
stop_hz = 3.6
points = 2
"""


@contextmanager
def run_target(folder: Path) -> Iterator[int]:
    """Compile and run the target at a free port; the specimen is that of the model."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler (cc) on this computer")
    program, port = folder / "target", free_port()
    sources = [str(SOURCES / "target.c"), str(SPECIMEN), "-lm"]
    command = [compiler, "-std=c99", "-O2", f"-I{SOURCES}", *sources, "-o", str(program)]
    subprocess.run(command, check=True)
    process = subprocess.Popen([program, "127.0.0.1", str(port)], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()  # it waits
        yield port
    finally:
        process.terminate()
        assert process.wait(10.0) == 0


@pytest.mark.slow  # 110 s
def test_unstable_orbits_are_held_through_a_target_in_c(tmp_path: Path) -> None:
    """No sample is lost, the amplitude is that of the model, and the replay is identical."""
    (tmp_path / "branch.toml").write_text(PROFILE)
    with run_target(tmp_path) as port:
        rig = read_rig_text("udp_simulated")
        (tmp_path / "rig.toml").write_text(rig.replace(SHIPPED, f"127.0.0.1:{port}"))
        words = [SHAKETWIN, "run", "branch.toml", "--out", "run"]
        ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert (summary["verdict"], summary["gaps"]) == ("complete", 0)
    assert len(summary["orbits"]) == 2
    for orbit in summary["orbits"]:
        assert orbit["accepted"], orbit["reason"]
        assert orbit["amplitude_m"] == pytest.approx(orbit["planned"]["amplitude_m"], rel=0.01)
    words = [SHAKETWIN, "replay", "run", "--out", "again"]
    replay = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert replay.returncode == 0
    assert "identical to the bit" in replay.stdout
