"""A running test as a view: who comes late has all but old samples; it ends as the run does."""

import socket
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import Event, PrcPoint, RunStart, RunStop
from tests.input_errors import raises_input_error
from twin.transport.codec import TOPIC_TYPES, Item, encode_item, topic_for
from twin.transport.endpoint import MEAS_TOPIC
from twin.transport.zenoh_link import BusLink, open_hub, open_spoke
from twin.viewer import command as view
from twin.viewer import live_view
from twin.viewer.live_view import LiveView

CHANNELS = ("table_disp_m",)
START = RunStart(
    index=0, run="r1", name="n", source="table", profile_toml="", rig_toml="", model_toml="",
    rate_hz=2000.0, block_samples=20, channels=CHANNELS, steps=(), planned_samples=4000, tare={},
    versions={}, host="here", started_at="", epoch_s=0.0,
)  # fmt: skip
STOP = RunStop(400, "complete", "played")
MAX_TURNS = 200


class Seen:
    """Stands for the view: keeps what it is fed."""

    def __init__(self, start: RunStart, *, serve: str) -> None:
        self.start, self.serve = start, serve
        self.items: list[Item] = []
        self.closed = False

    def feed(self, items: Sequence[Item]) -> None:
        self.items += items

    def close(self) -> None:
        self.closed = True

    def of(self, kind: type) -> list[Any]:
        return [item for item in self.items if isinstance(item, kind)]


def block(index: int) -> Block:
    labels = tuple(np.zeros(20, dtype=np.int64) for _ in range(3))
    return Block("meas", index, 2000.0, CHANNELS, np.full((1, 20), 1.0 * index), *labels)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[BusLink, BusLink]]:
    """Hub of a rig that is alive, and a spoke; the view is a `Seen`."""
    monkeypatch.setattr(live_view, "RerunView", Seen)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    hub = open_hub("rig", endpoint)
    hub.declare(tuple(TOPIC_TYPES))
    hub.declare_alive("r1.rig")
    spoke = open_spoke("rig", endpoint, 5.0)
    yield hub, spoke
    spoke.close()
    hub.close()


def put(hub: BusLink, *items: Item, run: str = "r1") -> None:
    for item in items:
        hub.publish(topic_for(item), encode_item(item, run))


def shown_view(live: LiveView) -> Seen:
    assert isinstance(live.view, Seen)
    return live.view


def until(hub: BusLink, live: LiveView, done: Any) -> None:
    """Let both turn until it is so."""
    for _ in range(MAX_TURNS):
        if done():
            return
        live.listen(0.01)
        for _ in range(10):
            hub.serve()
    raise AssertionError("it never came")


def test_late_live_view_has_start_events_and_prc(ends: tuple[BusLink, BusLink]) -> None:
    hub, spoke = ends
    points = [PrcPoint(20 * k, k, "forward", 1.0 + k, None, None, 1.0, 1.0, 0.0) for k in range(90)]
    put(hub, START, Event(0, "state", "checking"), *points)
    put(hub, *(block(20 * k) for k in range(100)))
    live = LiveView(spoke, "127.0.0.1:1")
    until(hub, live, lambda: live.view is not None and len(shown_view(live).of(PrcPoint)) == 90)
    assert (shown_view(live).start, shown_view(live).serve) == (START, "127.0.0.1:1")
    assert shown_view(live).of(PrcPoint) == points
    assert [event.text for event in shown_view(live).of(Event)] == ["checking"]
    put(hub, block(2000), block(2020))
    until(hub, live, lambda: len(shown_view(live).of(Block)) >= 2)
    assert [block.index for block in shown_view(live).of(Block)] == [2000, 2020]  # none of the past
    put(hub, block(2040), STOP)
    until(hub, live, lambda: live.is_over)
    assert [block.index for block in shown_view(live).of(Block)] == [2000, 2020, 2040]
    assert live.end_reason.endswith("complete, played")


def test_live_view_waits_for_the_last_blocks(
    ends: tuple[BusLink, BusLink], monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow:
        """Hands a block to one who waits for it."""

        def __init__(self) -> None:
            self.left = [(MEAS_TOPIC, encode_item(block(20), "r1"))]

        def get(self, seconds: float) -> tuple[str, bytes] | None:
            return self.left.pop() if self.left and seconds >= live_view.DRAIN_S else None

    hub, spoke = ends
    live = LiveView(spoke, "127.0.0.1:1")
    monkeypatch.setattr(live, "_blocks", Slow())
    put(hub, START, STOP)
    until(hub, live, lambda: live.is_over)
    assert [block.index for block in shown_view(live).of(Block)] == [20]


def test_live_view_ignores_garbage_and_other_runs(ends: tuple[BusLink, BusLink]) -> None:
    hub, spoke = ends
    live = LiveView(spoke, "127.0.0.1:1")
    until(hub, live, lambda: hub.subscriber_progress.positions)
    put(hub, block(0), run="r0")
    hub.publish(MEAS_TOPIC, b"\xff" * 300)
    hub.publish("/run/event", b"\x08")
    put(hub, block(20))
    until(hub, live, lambda: live.ignored == 2)
    put(hub, START, block(0), STOP, run="r0")
    put(hub, block(40), STOP)
    until(hub, live, lambda: live.is_over)
    assert [block.index for block in shown_view(live).of(Block)] == [20, 40]
    assert len(shown_view(live).of(RunStop)) == 1
    assert live.ignored == 5


def test_live_view_ends_when_the_rig_is_gone(ends: tuple[BusLink, BusLink]) -> None:
    hub, spoke = ends
    live = LiveView(spoke, "127.0.0.1:1", max_silence_s=0.0)
    put(hub, START, block(0))
    until(hub, live, lambda: live.view is not None)
    live.listen(0.01)
    assert not live.is_over  # silent, but its process is there
    hub.undeclare_alive("r1.rig")
    until(hub, live, lambda: live.is_over)
    assert "rig" in live.end_reason


def test_view_command_prints_address_and_end(
    ends: tuple[BusLink, BusLink],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    hub, spoke = ends
    opened: list[str] = []
    monkeypatch.setattr(view, "open_spoke", lambda *_: spoke)

    def open_viewer(url: str) -> str:
        opened.append(url)
        return "opened"

    monkeypatch.setattr(view, "open_viewer", open_viewer)
    over = threading.Event()

    def rig() -> None:
        put(hub, START)
        while not over.is_set():
            if any(name.startswith("observer.") for name in hub.list_components()) and opened:
                put(hub, STOP)

    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = f"127.0.0.1:{other.getsockname()[1]}"
        monkeypatch.setattr(view, "VIEW_ADDRESS", taken)
        thread = threading.Thread(target=rig)
        thread.start()
        view.view_live("tcp/127.0.0.1:1", "rig")
        over.set()
        thread.join()
    output = capsys.readouterr().out
    assert "live view: rerun rerun+http://127.0.0.1:" in output
    assert opened
    assert taken not in opened[0]
    assert "complete, played" in output


def test_options_of_a_recording_are_refused_for_a_live_view(tmp_path: Path) -> None:
    with raises_input_error(where=f"--save {tmp_path / 'v.rrd'}", remedy="LOG"):
        view.show_view(None, tmp_path / "v.rrd", None, "tcp/127.0.0.1:1", "rig")
    with raises_input_error(where=tmp_path / "no" / "v.png"):
        view.show_view(None, None, tmp_path / "no" / "v.png", "tcp/127.0.0.1:1", "rig")
