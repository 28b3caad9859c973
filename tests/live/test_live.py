"""A live run with its processes, as its user starts it; and what happens when one of them dies."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from table_io.records import Fault
from twin.recording.reader import Recording, read_recording
from twin.run.diagnostics import LEVEL_VARIABLE

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
PROFILE = """
title = "Short"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 3.6
stop_hz = 4.0
step_hz = 0.2
cycles = 5
measured_cycles = 2
directions = ["forward"]
"""
QUICK = f"{PROFILE}[loop_check]\nenabled = false\n"  # the processes are the same, 15 s sooner


def endpoint() -> str:
    """A loopback endpoint that nobody uses now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def start(folder: Path, *options: str, profile: str = QUICK) -> subprocess.Popen[str]:
    """A live run of the short test that writes to folder/out."""
    path = folder / "short.toml"
    path.write_text(profile)
    command = [SHAKETWIN, "run", str(path), "--out", str(folder / "out"), "--listen", endpoint()]
    return subprocess.Popen(
        [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def running(process: subprocess.Popen[str]) -> None:
    """Return once the first step has been played."""
    assert process.stdout is not None
    for line in process.stdout:
        if re.match(r"\s*1/\d+ ", line):
            return
    raise AssertionError("the run ended before its first step")


def kill(process: subprocess.Popen[str], component: str) -> None:
    """kill -9 of one process of the run."""
    ours = subprocess.run(
        ["pgrep", "-P", str(process.pid), "-f", f"processes {component}"],
        capture_output=True,
        text=True,
        check=True,
    )
    os.kill(int(ours.stdout.split()[0]), signal.SIGKILL)


def finish(process: subprocess.Popen[str], folder: Path) -> tuple[int, str, Recording, dict]:
    """(exit code, what was said, recording, summary) of a run."""
    said, _ = process.communicate()
    out = folder / "out"
    summary = json.loads((out / "summary.json").read_text())
    return process.returncode, said, read_recording(out / "run.mcap"), summary


def assert_whole(recording: Recording) -> None:
    """Every measured sample from 0 to the end is there, once."""
    assert recording.is_intact
    assert recording.missing_samples == 0
    assert [block.index for block in recording.contiguous_blocks("meas")] == [0]


def replayed(folder: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [SHAKETWIN, "replay", str(folder / "out"), "--out", str(folder / "again")],
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_live_run_is_whole_and_its_replay_identical(tmp_path: Path) -> None:
    process = start(tmp_path, profile=PROFILE)
    code, said, recording, summary = finish(process, tmp_path)
    assert code == 0, said
    assert_whole(recording)
    assert summary["verdict"] == "complete"
    assert all(line["passed"] for line in summary["checks"])
    assert summary["gaps"] == 0
    assert [step["frequency_hz"] for step in summary["steps"]] == [3.6, 3.8, 4.0]
    for step in summary["steps"]:
        assert step["twin"]["eta_d"] == pytest.approx(step["measured"]["eta_d"], rel=0.02)
    assert summary["timing"]["latency_ms"]["p50"] > 0
    assert (tmp_path / "out" / "report.html").stat().st_size > 100_000
    again = replayed(tmp_path)
    assert again.returncode == 0, again.stdout + again.stderr
    replay = json.loads((tmp_path / "again" / "summary.json").read_text())["replay"]
    assert replay["identical"]
    assert replay["comparisons"] == replay["compared"] > 300


def test_a_dead_twin_is_a_fault_that_replay_respects(tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    kill(process, "twin")
    code, said, recording, summary = finish(process, tmp_path)
    assert code == 0, said
    assert "twin died (SIGKILL); restarting it" in said
    assert_whole(recording)
    (fault,) = recording.records(Fault)
    assert fault.component == "twin"
    assert 0 < fault.from_index < fault.to_index <= summary["run"]["samples"]
    compared = [one.index for one in recording.blocks("pred")]
    assert not [index for index in compared if fault.from_index <= index < fault.to_index]
    assert fault.to_index in compared
    # what was measured while the twin was dead is in the summary all the same
    assert len(summary["steps"]) == 3
    again = replayed(tmp_path)
    assert again.returncode == 0, again.stdout + again.stderr
    assert "identical to the bit" in again.stdout


def test_a_dead_recorder_leaves_no_gap(tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    kill(process, "recorder")
    code, said, recording, summary = finish(process, tmp_path)
    assert code == 0, said
    assert "recorder died (SIGKILL); restarting it" in said
    assert_whole(recording)
    assert len(summary["steps"]) == 3
    assert replayed(tmp_path).returncode == 0


def test_a_dead_viewer_changes_nothing(tmp_path: Path) -> None:
    process = start(tmp_path, "--view")
    running(process)
    kill(process, "viewer")
    code, said, recording, _ = finish(process, tmp_path)
    assert code == 0, said
    assert "viewer died (SIGKILL); restarting it" in said
    assert_whole(recording)
    assert (tmp_path / "out" / "view.rrd").stat().st_size > 10_000


def test_a_dead_twin_stops_the_table_where_so_configured(tmp_path: Path) -> None:
    process = start(tmp_path, profile=QUICK + '[on_death]\ntwin = "stop"\n')
    running(process)
    kill(process, "twin")
    code, said, recording, summary = finish(process, tmp_path)
    assert summary["verdict"] == "stopped", said
    assert_whole(recording)
    assert code == 3
    assert summary["reason"].startswith("twin died")
    assert_at_rest(recording)


def assert_at_rest(recording: Recording) -> None:
    """The command ends at zero, and nowhere on the way does it ask for more than a blend may."""
    whole = recording.contiguous_blocks("meas")[-1]
    command = whole.channel("drive_disp_m")
    assert abs(command[-100:]).max() < 1e-6
    # smooth over 20 samples: the DAC's steps are not the drive's
    assert abs(command[20:] - command[:-20]).max() < 20 / whole.rate_hz * 0.05


def test_ctrl_c_decays_to_rest_and_closes_the_recording(tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    process.send_signal(signal.SIGINT)
    code, said, recording, summary = finish(process, tmp_path)
    assert code == 130, said
    assert summary["verdict"] == "stopped"
    assert_whole(recording)
    assert_at_rest(recording)
    assert recording.contiguous_blocks("meas")[-1].end < recording.start.planned_samples


def test_a_dead_supervisor_leaves_a_table_at_rest_and_a_readable_recording(
    tmp_path: Path,
) -> None:
    with start(tmp_path) as process:
        running(process)
        process.kill()
    parts = tmp_path / "out" / ".parts"
    until = time.monotonic() + 30
    while time.monotonic() < until and pids(tmp_path):
        time.sleep(0.2)
    assert not pids(tmp_path), "processes outlive their run"
    assert list(parts.glob("part-*.mcap"))
    done = subprocess.run(
        [SHAKETWIN, "report", str(tmp_path / "out")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    recording = read_recording(tmp_path / "out" / "run.mcap")
    assert_whole(recording)
    assert_at_rest(recording)


def pids(folder: Path) -> list[str]:
    """Processes of the run in this folder."""
    found = subprocess.run(
        ["pgrep", "-f", str(folder / "out")], capture_output=True, text=True, check=False
    )
    return found.stdout.split()


def test_a_port_in_use_is_bad_input_and_nothing_is_started(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        listen = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        process = start(tmp_path, "--listen", listen)
        said, _ = process.communicate()
    assert process.returncode == 2
    assert "in use" in said
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()


def test_a_second_run_at_the_same_endpoint_is_refused_and_harms_nothing(tmp_path: Path) -> None:
    listen = endpoint()
    long = QUICK.replace("cycles = 5", "cycles = 12", 1)  # outlives the start of the second
    first = start(tmp_path, "--listen", listen, profile=long)
    running(first)
    (tmp_path / "second").mkdir()
    second = start(tmp_path / "second", "--listen", listen)
    said, _ = second.communicate()
    assert second.returncode == 2, said
    assert "in use" in said
    assert not (tmp_path / "second" / "out").exists()
    # nor does a report written too early take the recording away from under the run
    early = subprocess.run(
        [SHAKETWIN, "report", str(tmp_path / "out")], capture_output=True, text=True, check=False
    )
    assert early.returncode == 2
    assert str(tmp_path / "out") in early.stderr
    code, said, recording, summary = finish(first, tmp_path)
    assert code == 0, said
    assert_whole(recording)
    assert len(summary["steps"]) == 3
    assert replayed(tmp_path).returncode == 0


def test_the_log_tells_the_starts_and_ends_of_the_processes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(LEVEL_VARIABLE, "info")
    code, said, *_ = finish(start(tmp_path), tmp_path)
    assert code == 0, said
    lines = re.findall(r"^\d{4}-\S+ \S+ (shaketwin run|\w+) INFO (.*)$", said, re.M)
    processes = ("rig", "gate", "twin", "recorder")
    starts = re.compile(r"(\w+) started, process \d+")
    found = [starts.fullmatch(text) for process, text in lines if process == "shaketwin run"]
    assert [match[1] for match in found if match] == list(processes)
    ended = {process for process, text in lines if re.fullmatch(r"process \d+ ends", text)}
    assert ended == set(processes)
    assert ("rig", "command start, accepted") in lines


def test_an_interrupt_before_the_start_moves_nothing(tmp_path: Path) -> None:
    process = start(tmp_path)
    assert process.stdout is not None
    process.stdout.readline()  # what will be run; its processes are being started now
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    said, _ = process.communicate()
    assert process.returncode == 130, said
    assert "nothing moved" in said
    assert not (tmp_path / "out").exists()


def test_a_twin_dead_at_the_very_end_is_a_fault_too(tmp_path: Path) -> None:
    process = start(tmp_path)
    assert process.stdout is not None
    for line in process.stdout:
        if re.match(r"\s*3/3 ", line):
            break
    kill(process, "twin")
    code, said, recording, summary = finish(process, tmp_path)
    assert code == 0, said
    (fault,) = recording.records(Fault)
    assert fault.to_index <= summary["run"]["samples"]
    again = replayed(tmp_path)
    assert again.returncode == 0, again.stdout + again.stderr


def test_a_dead_rig_halts_the_run_and_keeps_what_was_recorded(tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    kill(process, "rig")
    code, said, recording, summary = finish(process, tmp_path)
    assert code == 3, said
    assert "the rig process died (SIGKILL)" in said
    assert "Traceback" not in said
    assert summary["verdict"] == "halted"
    assert len(summary["steps"]) >= 1
    pieces = recording.contiguous_blocks("meas")
    assert len(pieces) == 1
    assert pieces[0].index == 0


def test_the_bus_never_listens_to_the_network(tmp_path: Path) -> None:
    process = start(tmp_path, "--listen", "tcp/0.0.0.0:7447")
    said, _ = process.communicate()
    assert process.returncode == 2
    assert "would go over the network" in said
