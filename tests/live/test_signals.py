"""Signals to a running test: the table comes to rest smoothly, and the recording is whole."""

import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from tests.command_line import call_main
from tests.live.test_live import (
    assert_at_rest,
    assert_whole,
    find_component,
    finish_at_rest,
    pids,
    running,
    start,
)
from twin.recording.reader import read_recording
from twin.system.terminal import STOP_SIGNALS, catch_interrupts

PAUSE_S = 7.0  # longer than the supervisor waits for a silent rig


@pytest.mark.parametrize("name", STOP_SIGNALS)
def test_every_stop_signal_is_a_reason_to_stop(name: str) -> None:
    number = getattr(signal, name)
    before = signal.getsignal(number)
    try:
        signal.signal(number, signal.SIG_DFL)
        with catch_interrupts() as poll_interrupt:
            assert poll_interrupt() is None
            os.kill(os.getpid(), number)
            assert poll_interrupt() == f"interrupted ({name})"
        assert signal.getsignal(number) == signal.SIG_DFL
    finally:
        signal.signal(number, before)


def test_an_ignored_hangup_stays_ignored() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with catch_interrupts() as poll_interrupt:
            os.kill(os.getpid(), signal.SIGHUP)
            assert poll_interrupt() is None
        assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def wait_for_end(folder: Path) -> None:
    """Wait until no process of the run is left."""
    until = time.monotonic() + 30
    while time.monotonic() < until and pids(folder):
        time.sleep(0.2)
    assert not pids(folder), "processes outlive their run"


@pytest.mark.slow  # 15 s each
@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGQUIT])
def test_a_closed_terminal_stops_the_table_in_order(number: signal.Signals, tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    process.send_signal(number)
    _, _, summary = finish_at_rest(process, tmp_path, 130, "stopped")
    assert f"interrupted ({number.name})" in summary["reason"]
    wait_for_end(tmp_path)


@pytest.mark.slow  # 25 s each
@pytest.mark.parametrize("component", ["supervisor", "rig", "twin", "recorder"])
def test_a_signal_that_nobody_handles_leaves_the_table_at_rest(
    component: str, tmp_path: Path
) -> None:
    with start(tmp_path) as process:
        running(process)
        is_supervisor = component == "supervisor"
        number = process.pid if is_supervisor else find_component(process, component)
        os.kill(number, signal.SIGUSR1)
        process.communicate()
    wait_for_end(tmp_path)
    if component == "supervisor":
        assert call_main("report", tmp_path / "out").returncode == 0
    recording = read_recording(tmp_path / "out" / "run.mcap")
    assert_whole(recording)
    if component != "rig":  # what it played last is not acquired; the queue ends at rest
        assert_at_rest(recording)


@pytest.mark.slow  # 25 s
def test_a_paused_terminal_pauses_no_test(tmp_path: Path) -> None:
    process = start(tmp_path)
    running(process)
    process.send_signal(signal.SIGTSTP)
    time.sleep(PAUSE_S)
    state = subprocess.run(
        ["ps", "-o", "state=", "-p", str(process.pid)], capture_output=True, check=True, text=True
    )
    assert state.stdout.strip() == "T", "it was not paused"
    process.send_signal(signal.SIGCONT)
    finish_at_rest(process, tmp_path, 0, "complete")
