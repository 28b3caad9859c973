"""A recorder on another machine: what it takes through the gate, and how it ends."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Block
from table_io.config.base import PROFILES_DIR
from table_io.records import Event, RunStop, Timing
from tests.builders.ports import free_endpoint
from tests.input_errors import raises_input_error
from twin.live import join
from twin.live.join import join_as_recorder
from twin.recording.recovery import recover_log
from twin.security.access_control import build_open_access
from twin.setup.run_config import read_run_config
from twin.system.exit_codes import EXIT_GAPS, EXIT_INTERRUPTED
from twin.transport.codec import TOPIC_TYPES, Item, encode_item, topic_for
from twin.transport.endpoint import PUBLIC_HUB_SETTINGS, merge_settings
from twin.transport.reliable_subscriber import ReliableSubscriber
from twin.transport.zenoh_link import open_hub

RUN = "20260101-120000-quickstart"
BUNDLE = read_run_config(PROFILES_DIR / "tests" / "quickstart.toml")
RIG, SIZE, BLOCKS = BUNDLE.rig.name, BUNDLE.profile.acquisition.block_samples, 300
END = BLOCKS * SIZE


def block(number: int) -> Block:
    steps = np.zeros(SIZE, dtype=np.int64)
    values = np.full((1, SIZE), float(number))
    return Block("meas", number * SIZE, 2000.0, ("mass_disp_m",), values, steps, steps, steps)


def last_words() -> list[Item]:
    timing = Timing(END, "twin", 0.0, 0.0, 0.0, 0, 0, 0.0, "normal")
    return [RunStop(END, "complete", "", ()), timing]


@pytest.fixture
def gate() -> Iterator[Callable[..., str]]:
    """Starts what stands for a gate that sends these items; its endpoint."""
    over = threading.Event()
    threads = []

    def begin(*items: Item, run: str = RUN) -> str:
        where, ready = free_endpoint(), threading.Event()

        def serve() -> None:
            link = open_hub(RIG, where, merge_settings(PUBLIC_HUB_SETTINGS, build_open_access(RIG)))
            link.declare(tuple(TOPIC_TYPES))
            link.declare_alive(f"{run}.rig")
            ready.set()
            for item in items:
                link.publish(topic_for(item), encode_item(item, RUN))
                time.sleep(0.001)
            while not over.is_set():
                link.serve()
                time.sleep(0.002)
            link.close()

        threads.append(threading.Thread(target=serve))
        threads[-1].start()
        assert ready.wait(20.0)
        return where

    yield begin
    over.set()
    for thread in threads:
        thread.join()


def test_joined_recorder_keeps_messages_before_the_start(
    gate: Callable[..., str], tmp_path: Path
) -> None:
    start = BUNDLE.make_start_factory(RUN, "table")({}, 0.0)
    items = [Event(0, "state", "armed"), start, *map(block, range(BLOCKS)), *last_words()]
    where = gate(*items)
    assert join_as_recorder(where, RIG, tmp_path / "copy", None) == 0
    log = tmp_path / "copy" / "run.mcap"
    sent = sorted((topic_for(item), encode_item(item, RUN)) for item in items)
    assert sorted((message.topic, message.payload) for message in recover_log(log).messages) == sent


class Played:
    """An inbox that hands out these items in this order, and then nothing."""

    missed = 0

    def __init__(self, *items: Item) -> None:
        self.left = [(topic_for(item), encode_item(item, RUN)) for item in items]

    def get(self, _: float) -> tuple[str, bytes] | None:
        return self.left.pop(0) if self.left else None


def test_early_messages_are_written_after_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(join, "MAX_SILENCE_S", 0.0)
    start = BUNDLE.make_start_factory(RUN, "table")({}, 0.0)
    inbox = Played(Event(0, "state", "armed"), block(0), start, block(1))
    join.record_run(RUN, inbox, tmp_path, lambda: None)  # type: ignore[arg-type]
    part = recover_log(tmp_path / ".parts" / "part-001.mcap")
    assert sorted(message.topic for message in part.messages) == [
        "/rig/meas", "/rig/meas", "/run/event", "/run/start",
    ]  # fmt: skip


def test_silent_test_ends_the_recording_with_gaps(
    gate: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(join, "MAX_SILENCE_S", 0.5)
    start = BUNDLE.make_start_factory(RUN, "table")({}, 0.0)
    where = gate(start, *map(block, range(10)))
    assert join_as_recorder(where, RIG, tmp_path / "copy", None) == EXIT_GAPS
    assert len(recover_log(tmp_path / "copy" / "run.mcap").messages) == 11


def test_ctrl_c_ends_the_recording(
    gate: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = BUNDLE.make_start_factory(RUN, "table")({}, 0.0)
    where = gate(start, *map(block, range(10)))
    record = join.record_run

    def interrupt_record(
        run: str, inbox: ReliableSubscriber, folder: Path, asked: Callable[[], str | None]
    ) -> bool:
        """As it is, but Ctrl-C comes as soon as the test's beginning has."""

        def asked_then() -> str | None:
            if list(folder.rglob("*.mcap")) and asked() is None:
                signal.raise_signal(signal.SIGINT)
            return asked()

        return record(run, inbox, folder, asked_then)

    monkeypatch.setattr(join, "record_run", interrupt_record)
    code = join_as_recorder(where, RIG, tmp_path / "copy", None)
    assert code == EXIT_INTERRUPTED
    assert (tmp_path / "copy" / "run.mcap").exists()


@pytest.mark.parametrize("run", ["..", "", "a" * 102, "observer.anna.0"])
def test_invalid_run_id_of_a_peer_names_no_folder(
    gate: Callable[..., str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: str
) -> None:
    monkeypatch.chdir(tmp_path)
    where = gate(run=run)
    with raises_input_error(key="endpoint", value=where, problem=RIG, remedy="--table"):
        join_as_recorder(where, RIG, None, None)
    assert not list(tmp_path.iterdir())
