"""A live run, and a recorder beside it that comes through the gate, while the gate dies."""

import subprocess
from collections import Counter
from pathlib import Path

import pytest

from tests.builders.ports import free_endpoint
from tests.live.test_live import (
    QUICK,
    SHAKETWIN,
    assert_whole,
    finish,
    kill,
    replay_run,
    running,
    start,
)
from twin.recording.recovery import recover_log

pytestmark = pytest.mark.slow
LONG = QUICK.replace("cycles = 5", "cycles = 20", 1)


def test_dead_gateway_leaves_no_gap_in_any_recording(tmp_path: Path) -> None:
    listen = free_endpoint()
    process = start(tmp_path, "--listen", listen, profile=LONG)
    running(process)
    remote = tmp_path / "there"
    command = [SHAKETWIN, "attend", "recorder", "--connect", listen, "--out", str(remote)]
    attending = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert attending.stdout is not None
    assert attending.stdout.readline().startswith("recording")
    tell = [SHAKETWIN, "tell", "--connect", listen]
    assert subprocess.run([*tell, "hold", "--why", "a look"], check=False).returncode == 0
    kill(process, "gate")
    tries = (subprocess.run([*tell, "resume"], check=False).returncode for _ in range(10))
    assert any(code == 0 for code in tries), "the next gate never came"
    code, output, recording, _ = finish(process, tmp_path)
    assert code == 0, output
    assert "gate died (SIGKILL); restarting it, the table goes on" in output
    assert "order: hold: a look by " in output
    assert_whole(recording)
    attending.communicate()
    assert attending.returncode == 0
    here, beside = (
        Counter(
            (message.topic, message.payload)
            for message in recover_log(folder / "run.mcap").messages
        )
        for folder in (tmp_path / "out", remote)
    )
    only_here = here - beside
    assert [topic for topic, _ in only_here] == ["/run/timing"]  # the recorder's last word
    assert not beside - here
    assert replay_run(tmp_path).returncode == 0
