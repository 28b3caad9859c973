"""A replay on the bus: whoever listens gets the bytes of the log, all of them, slow or not."""

import errno
import os
import threading
import time
from collections import Counter
from pathlib import Path

import pytest

from table_io.errors import InputError
from table_io.records import RunStart, RunStop
from tests.builders.ports import free_endpoint
from tests.command_line import call_main
from twin.live import replay_publishing
from twin.recording.recovery import recover_log
from twin.replay.command import ReplayRequest, replay_logs
from twin.transport import history_cache
from twin.transport.codec import TOPIC_TYPES, decode_item
from twin.transport.zenoh_link import open_hub, open_spoke

PATIENCE_S = 60.0


@pytest.fixture
def endpoint(monkeypatch: pytest.MonkeyPatch) -> str:
    """A free one; and no report is drawn."""
    monkeypatch.setattr("twin.report.finalize.write_report", lambda *_: None)
    return free_endpoint()


class Listener(threading.Thread):
    """Subscribes to everything as a viewer does; stops listening for a while in the middle."""

    def __init__(self, endpoint: str, stall_s: float) -> None:
        super().__init__(daemon=True)
        self.endpoint, self.stall_s = endpoint, stall_s
        self.received: list[tuple[str, bytes]] = []
        self.missed = 0
        self.alive: set[str] = set()

    def run(self) -> None:
        until = time.monotonic() + PATIENCE_S
        while time.monotonic() < until:
            try:
                link = open_spoke("simulated", self.endpoint, 0.2)
                break
            except InputError:
                continue
        inbox = link.subscribe(tuple(TOPIC_TYPES), history=True, capacity=50)
        quiet = 0
        while quiet < 5 and time.monotonic() < until:
            arrived = inbox.get(0.1)
            if arrived is None:
                ended = any(topic == "/run/stop" for topic, _ in self.received)
                quiet += ended
                continue
            quiet = 0
            self.received.append(arrived)
            if len(self.received) == 200:
                self.alive = link.list_components()
                time.sleep(self.stall_s)
        self.missed = inbox.missed + inbox.dropped
        link.close()


def publish_replay(
    log_file: Path, endpoint: str, out: Path, stall_s: float, speed: str = "max"
) -> Listener:
    listener = Listener(endpoint, stall_s)
    listener.start()
    replay_logs(ReplayRequest([log_file], [], out, speed, publish=endpoint))
    listener.join(PATIENCE_S)
    assert not listener.is_alive()
    return listener


@pytest.mark.parametrize("speed", ["max", pytest.param("4", marks=pytest.mark.slow)])
def test_subscriber_of_a_replay_receives_the_recording(
    log_file: Path, endpoint: str, tmp_path: Path, speed: str
) -> None:
    """Both streams, byte for byte, in the order of the test; rig and twin are alive."""
    listener = publish_replay(log_file, endpoint, tmp_path / "out", 0.0, speed)
    made = recover_log(tmp_path / "out" / "run.mcap").messages
    assert listener.missed == 0
    assert Counter(listener.received) == Counter((item.topic, item.payload) for item in made)
    for topic in ("/rig/meas", "/twin/pred", "/twin/cmp"):
        indices = [
            decode_item(*message)[1].index for message in listener.received if message[0] == topic
        ]
        assert len(indices) > 300
        assert indices == sorted(indices)
    items = [decode_item(*message)[1] for message in listener.received]
    start = next(item for item in items if isinstance(item, RunStart))
    assert any(isinstance(item, RunStop) for item in items)
    assert listener.alive == {f"{start.run}.rig", f"{start.run}.twin"}


@pytest.mark.slow  # 5 s each
@pytest.mark.parametrize("waits", [True, False])
def test_replay_waits_for_a_slow_subscriber(
    log_file: Path, endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, waits: bool
) -> None:
    """A publisher that holds little loses nothing for one who does not listen for a second;
    one that does not wait would."""
    monkeypatch.setattr(history_cache, "MAX_CACHED_FRAGMENTS", 100)
    monkeypatch.setattr(replay_publishing, "MAX_LEAD_FRAGMENTS", 80 if waits else 10**9)
    listener = publish_replay(log_file, endpoint, tmp_path / "out", 1.0)
    if not waits:
        assert listener.missed > 0
        return
    made = recover_log(tmp_path / "out" / "run.mcap").messages
    assert listener.missed == 0
    assert Counter(listener.received) == Counter((item.topic, item.payload) for item in made)


def test_replay_at_a_used_endpoint_is_refused(
    log_file: Path, endpoint: str, tmp_path: Path
) -> None:
    hub = open_hub("simulated", endpoint)
    try:
        words = ("--publish", "--listen", endpoint, "--out", tmp_path / "out")
        result = call_main("replay", log_file, *words)
    finally:
        hub.close()
    assert result.returncode == 2
    assert endpoint in result.stderr
    assert os.strerror(errno.EADDRINUSE) in result.stderr
    assert not (tmp_path / "out").exists()
