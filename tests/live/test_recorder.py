"""The recorder on a disk that fills up, comes back or dies, as it sees its bus and its clock."""

import errno
import os
import resource
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest

from table_io.block import Block
from table_io.clock import ManualClock
from table_io.records import Event, RunStop, Timing
from tests.input_errors import raises_input_error
from tests.reports.recordings import blocks, start_record
from twin.live import recorder as module
from twin.live.process_config import LatencyHistogram, ProcessConfig
from twin.live.recorder import CompletionTracker, Recorder
from twin.recording.mcap_log import LogWriter, iter_messages
from twin.recording.merge import verify_log
from twin.recording.reader import read_recording
from twin.setup.disk import DiskForecast, DiskReserve
from twin.transport.codec import Item, encode_item, topic_for

START = start_record()
BLOCK_S = 0.05
SPEC = ProcessConfig(START.run, "short", "", "", "", "", "")


@dataclass
class Bus:
    """Link and inbox of a recorder: what comes, when, and what it says itself."""

    coming: deque[tuple[str, bytes]]
    clock: ManualClock
    each_turn: Callable[[int], None] = lambda _: None
    published: list[Any] = field(default_factory=list)
    orders: list[str] = field(default_factory=list)
    answers: deque[str | None] = field(default_factory=deque)
    turns: int = 0
    missed: int = 0
    dropped: int = 0

    def get(self, _: float) -> tuple[str, bytes] | None:
        self.turns += 1
        self.clock.time_s += BLOCK_S / 3
        self.each_turn(self.turns)
        return self.coming.popleft() if self.coming else None

    def publish(self, name: str, payload: bytes) -> None:
        self.published.append((name, payload))
        self.coming.appendleft((name, payload))

    def send_command(self, name: str, text: str, timeout_s: float) -> str | None:
        self.orders.append(f"{name} {text} {timeout_s}")
        return self.answers.popleft() if self.answers else "yes"


@pytest.fixture
def limit(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Sets how large files may become, in bytes; -1 is as large as they like."""
    monkeypatch.setattr(module, "is_orphaned", lambda: False)
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def items() -> list[Any]:
    """A whole run: start, 200 blocks with what the twin says, stop, the twin's last word."""
    some = next(block for block in blocks() if isinstance(block, Block) and block.stream == "meas")
    size = len(some)
    run: list[Any] = [START]
    for number in range(200):
        run += [replace(some, index=number * size, stream=name) for name in ("meas", "pred")]
        run.append(Event(number * size, "tick", str(number)))
    end = 200 * size
    return [*run, RunStop(end, "complete", "", ()), Timing(end, "twin", 0, 0, 0, 0, 0, 0, "")]


def at_work(folder: Path, room_s: float = 1e3) -> tuple[Recorder, Bus]:
    """A recorder that is about to record the run."""
    clock = ManualClock()
    bus = Bus(deque((topic_for(item), encode_item(item, START.run)) for item in items()), clock)
    link: Any = bus
    reserve = DiskReserve(folder / "reserve", 1000)
    writer = LogWriter(folder / "part.mcap", START.rate_hz)
    watch = LatencyHistogram("recorder", clock, BLOCK_S)
    return Recorder(
        SPEC, link, link, writer, watch, DiskForecast(room_s), reserve, START.rate_hz, clock
    ), bus


def read_event_texts(bus: Bus, kind: str) -> list[str]:
    """The texts of the events that the recorder published."""
    events = [item for item in read_items(bus) if isinstance(item, Event) and item.kind == kind]
    return [event.text for event in events]


def read_items(bus: Bus) -> list[Any]:
    from twin.transport.codec import decode_item

    return [decode_item(*message)[1] for message in bus.published]


def list_recorded(folder: Path) -> list[Any]:
    """Kind and index of everything in the part but what the recorder said itself."""
    own = ("disk", "recorder")
    return sorted(
        (type(item).__name__, item.index)
        for item in read_recording(folder / "part.mcap").items
        if not (isinstance(item, Event) and item.kind in own)
        and not (isinstance(item, Timing) and item.component == "recorder")
    )


def list_expected() -> list[Any]:
    return sorted((type(item).__name__, item.index) for item in items())


def test_a_run_is_complete_with_its_end_all_its_samples_and_the_end_of_the_twin() -> None:
    run = [item for item in blocks() if isinstance(item, Block) and item.stream == "meas"]
    end = run[-1].end
    stop = RunStop(end, "complete", "", ())
    twin = Timing(end, "twin", 0, 0, 0, 0, 0, 0, "")
    early, table = replace(twin, index=end - 1), replace(twin, component="table")
    missing: Item
    for missing in (run[-1], stop, twin):
        tracker = CompletionTracker()
        items: list[Item] = [START, *run, stop, early, table, twin]
        for item in items:
            if item is not missing:
                tracker.update(item)
        assert tracker.has_started
        assert not tracker.is_complete
        tracker.update(missing)
        # the twin's Timing counts after the end alone
        assert tracker.is_complete == (missing is not stop)
        tracker.update(twin)
        assert tracker.is_complete


def test_messages_are_in_the_file_within_a_quarter_second(
    tmp_path: Path, limit: Callable[[int], None]
) -> None:
    recorder, bus = at_work(tmp_path)
    lags = []

    def look(turn: int) -> None:
        if turn % 25 == 0 and bus.coming:
            lags.append(turn - 1 - len(list(iter_messages(tmp_path / "part.mcap"))))

    bus.each_turn = look
    recorder.run()
    recorder.finish()
    assert len(lags) > 20
    assert max(lags) * BLOCK_S / 3 <= 0.25
    assert verify_log(tmp_path / "part.mcap")
    assert list_recorded(tmp_path) == list_expected()
    timings = [item for item in read_items(bus) if isinstance(item, Timing)]
    assert len(timings) >= 200 * BLOCK_S - 2  # one a second
    assert {timing.component for timing in timings} == {"recorder"}
    assert not bus.orders
    assert not (tmp_path / "reserve").exists()


def test_a_full_disk_stops_the_table_once_and_loses_nothing_if_there_is_room_again(
    tmp_path: Path, limit: Callable[[int], None]
) -> None:
    recorder, bus = at_work(tmp_path)
    bus.answers.append(None)  # the first order is not heard

    def disk(turn: int) -> None:
        if turn in (200, 400, 450):
            limit(-1 if turn == 400 else (tmp_path / "part.mcap").stat().st_size + 100)
        if turn == 399:
            assert not (tmp_path / "reserve").exists()
        if turn == 520:
            limit(-1)

    bus.each_turn = disk
    recorder.run()
    recorder.finish()
    first, again, *_ = read_event_texts(bus, "disk")
    assert first.startswith("cannot write the recording (File too large: ")
    assert "part.mcap): the table is stopped; what was written stays readable" in first
    assert again == "the disk takes the recording again; what waited is written"
    why = f"stop {START.run}\ncannot write the recording (File too large: {tmp_path}/part.mcap)"
    assert bus.orders == [f"{why} 0.5"] * 2
    assert verify_log(tmp_path / "part.mcap")
    assert list_recorded(tmp_path) == list_expected()


def test_a_disk_that_stays_full_leaves_what_was_written_readable(
    tmp_path: Path, limit: Callable[[int], None]
) -> None:
    recorder, bus = at_work(tmp_path)
    bus.each_turn = lambda turn: limit(60_000) if turn == 5 else None
    recorder.run()
    with raises_input_error(problem=os.strerror(errno.EFBIG)):
        recorder.finish()
    assert bus.orders
    part = read_recording(tmp_path / "part.mcap")
    assert not part.is_intact
    assert part.start == START
    assert len(part.items) > 10


def test_filling_disk_is_announced_in_time(
    tmp_path: Path, limit: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "free_bytes", lambda _: 1_000_000)
    recorder, bus = at_work(tmp_path, room_s=1e6)
    recorder.run()
    recorder.finish()
    assert [
        text for text in read_event_texts(bus, "disk") if "1 MB left on the disk: room for" in text
    ]
    assert not bus.orders


def test_a_disk_that_does_not_sync_stops_the_table(
    tmp_path: Path, limit: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    def dying(_: int) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "fsync", dying)
    recorder, bus = at_work(tmp_path)
    recorder.sync_interval_s = 1.0
    recorder.run()
    recorder.finish()
    assert read_event_texts(bus, "disk")[0].startswith(
        "cannot write the recording (Input/output error: "
    )
    assert len(bus.orders) == 1
    assert verify_log(tmp_path / "part.mcap")
    assert list_recorded(tmp_path) == list_expected()


def read_own_events(folder: Path) -> list[str]:
    """Texts of the events of the recorder itself."""
    events = read_recording(folder / "part.mcap").records(Event)
    return [event.text for event in events if event.kind == "recorder"]


def test_messages_of_another_run_are_not_recorded(
    tmp_path: Path, limit: Callable[[int], None]
) -> None:
    recorder, bus = at_work(tmp_path)
    bus.coming.insert(9, ("/run/event", encode_item(Event(3, "stray", ""), "another")))
    bus.coming.insert(12, ("/rig/meas", b"\xff\xffstray"))
    bus.missed = 4
    recorder.run()
    recorder.finish()
    assert list_recorded(tmp_path) == list_expected()
    assert not [
        message for message in iter_messages(tmp_path / "part.mcap") if b"stray" in message.payload
    ]
    assert read_own_events(tmp_path) == ["recorder: 4 messages missed, 0 dropped"]


def test_impossible_sample_index_is_left_out_and_counted(
    tmp_path: Path, limit: Callable[[int], None]
) -> None:
    recorder, bus = at_work(tmp_path)
    bus.coming.insert(9, ("/run/event", encode_item(Event(2**50, "stray", ""), START.run)))
    recorder.run()
    recorder.finish()
    assert list_recorded(tmp_path) == list_expected()
    left_out = "recorder: 1 messages left out, of impossible samples"
    assert read_own_events(tmp_path) == [left_out]


def test_failed_sync_is_not_cleared_by_a_later_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk tells once what it lost; the syncs after it succeed."""
    recorder, bus = at_work(tmp_path)
    calls: list[int] = []

    def sync(writer: LogWriter) -> None:
        calls.append(1)
        if len(calls) == 1:
            raise OSError(errno.EIO, "Input/output error", "part.mcap")

    recorder.sync_interval_s = 0.2
    monkeypatch.setattr(LogWriter, "sync", sync)
    monkeypatch.setattr(module, "is_orphaned", lambda: False)
    recorder.run()
    recorder.finish()
    assert len(calls) > 3
    assert len(read_event_texts(bus, "disk")) == 1
    assert "Input/output error" in read_event_texts(bus, "disk")[0]
    assert len(bus.orders) == 1


@pytest.mark.parametrize("loss", ["deleted", "moved"])
def test_recording_that_is_taken_away_stops_the_table_and_is_written_again(
    tmp_path: Path, limit: Callable[[int], None], loss: str
) -> None:
    recorder, bus = at_work(tmp_path)
    bus.answers.append(None)  # the first order is not heard
    part = tmp_path / "part.mcap"

    def take_away(turn: int) -> None:
        if turn == 100 and loss == "deleted":
            part.unlink()
        elif turn == 100:
            part.rename(tmp_path / "elsewhere.mcap")

    bus.each_turn = take_away
    recorder.run()
    recorder.finish()
    reason = f"the recording in {tmp_path.parent} was deleted or moved"
    assert bus.orders == [f"stop {START.run}\n{reason} 0.5"] * 2
    lost, restored = read_event_texts(bus, "disk")
    assert lost.startswith(reason)
    assert "whole again" in restored
    assert list_recorded(tmp_path) == list_expected()
