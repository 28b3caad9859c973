"""A live run whose recorder meets a full disk, stalls or hangs: pytest -m slow."""

import os
import resource
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from table_io.records import Event, RunStop
from tests.live.test_live import (
    QUICK,
    assert_whole,
    finish,
    finish_at_rest,
    replay_run,
    running,
    start,
)

pytestmark = pytest.mark.slow


def recorder(process: subprocess.Popen[str]) -> int:
    """Process id of the run's recorder."""
    ours = ["pgrep", "-P", str(process.pid), "-f", "processes recorder"]
    completed = subprocess.run(ours, capture_output=True, text=True, check=True)
    return int(completed.stdout.split()[0])


def limit_recording(process: subprocess.Popen[str], folder: Path, more: int) -> None:
    """Let the recording grow by so many bytes and no further; -1 lifts it."""
    part = folder / "out" / ".parts" / "part-001.mcap"
    size = part.stat().st_size + more if more >= 0 else resource.RLIM_INFINITY
    limit = (size, resource.RLIM_INFINITY)
    resource.prlimit(recorder(process), resource.RLIMIT_FSIZE, limit)


def test_a_full_disk_brings_the_table_to_rest_and_leaves_what_was_written(tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    limit_recording(process, tmp_path, 300_000)
    code, output, recording, summary = finish(process, tmp_path)
    assert code == 3, output
    assert "cannot write the recording (File too large: " in output
    assert "stop: cannot write the recording" in output  # the rig heard it and decayed to rest
    assert "the recorder failed: the end of the recording could not be written" in output
    assert "Traceback" not in output
    assert summary["verdict"] == "halted"
    assert len(summary["steps"]) == 1
    assert [block.index for block in recording.contiguous_blocks("meas")] == [0]


def test_a_disk_that_has_room_again_loses_nothing_but_the_table_rests(tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    limit_recording(process, tmp_path, 50_000)
    time.sleep(1.5)
    limit_recording(process, tmp_path, -1)
    _, recording, _ = finish_at_rest(process, tmp_path, 3, "stopped")
    assert [event.kind for event in recording.records(Event)].count("disk") == 2
    assert "identical to the bit" in replay_run(tmp_path).stdout


@pytest.mark.parametrize("loss", ["deleted", "moved"])
def test_a_folder_that_is_taken_away_loses_nothing_but_the_table_rests(
    tmp_path: Path, loss: str
) -> None:
    process = start(tmp_path)
    running(process)
    if loss == "deleted":
        shutil.rmtree(tmp_path / "out")
    else:
        (tmp_path / "out").rename(tmp_path / "elsewhere")
    output, recording, _ = finish_at_rest(process, tmp_path, 3, "stopped")
    assert "Traceback" not in output
    stop = recording.records(RunStop)[0].index / recording.start.rate_hz
    lost, _restored = (event.index for event in recording.records(Event) if event.kind == "disk")
    assert lost / recording.start.rate_hz < stop
    assert "identical to the bit" in replay_run(tmp_path).stdout


def test_a_recorder_that_stalls_and_one_that_hangs_leave_no_gap(tmp_path: Path) -> None:
    process = start(tmp_path, profile=QUICK.replace("cycles = 5", "cycles = 25", 1))
    assert process.stdout is not None
    for line in process.stdout:
        if "state: running" in line:
            break
    stalled = recorder(process)
    os.kill(stalled, signal.SIGSTOP)
    time.sleep(3.0)
    os.kill(stalled, signal.SIGCONT)
    time.sleep(3.0)
    assert recorder(process) == stalled, "three seconds are no reason to end it"
    os.kill(stalled, signal.SIGSTOP)
    code, output, recording, _ = finish(process, tmp_path)
    assert code == 0, output
    assert "the recorder has been silent for 10 s; ending it" in output
    assert "recorder died (SIGKILL); restarting it, the table goes on" in output
    assert_whole(recording)
    assert replay_run(tmp_path).returncode == 0
