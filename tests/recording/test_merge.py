"""Parts of a recording become one log: nothing lost, nothing twice, in bounded memory."""

import random
import tracemalloc
from itertools import permutations
from pathlib import Path

import pytest
from mcap.reader import make_reader

from table_io.records import Event
from tests.input_errors import raises_input_error
from tests.recording.example_run import RATE_HZ, START, payloads, run, write
from twin.recording.log_metadata import build_attachments
from twin.recording.mcap_log import LogWriter, iter_messages
from twin.recording.merge import merge, verify_log
from twin.recording.reader import read_recording
from twin.recording.recovery import recover_log
from twin.transport.codec import encode_item


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write(tmp_path / "run.mcap", run(), flush_every=7)
    return tmp_path / "run.mcap"


def test_parts_in_any_order_make_the_original_to_the_bit(tmp_path: Path) -> None:
    items = run()
    third = len(items) // 3
    write(tmp_path / "whole.mcap", items)
    # The second recorder hears the start again; the third was cut off; the last wrote nothing.
    write(tmp_path / "a.mcap", items[: third + 15])
    write(tmp_path / "b.mcap", [items[0], *items[third - 9 : 2 * third + 9]])
    sizes = write(tmp_path / "c.mcap", [items[0], *items[2 * third :]], flush_every=5)
    assert sizes
    killed = (tmp_path / "b.mcap").read_bytes()
    (tmp_path / "d.mcap").write_bytes(killed[: len(killed) // 2])
    (tmp_path / "e.mcap").write_bytes(killed[:5])
    (tmp_path / "f.mcap").write_bytes(b"")
    parts = [tmp_path / f"{name}.mcap" for name in "abcdef"]
    before = [part.read_bytes() for part in parts]
    expected = payloads(read_recording(tmp_path / "whole.mcap").items)
    orders = [parts, parts[::-1], *random.Random(1).sample(list(permutations(parts)), 10)]
    for number, order in enumerate(orders):
        out = tmp_path / f"out-{number}.mcap"
        assert merge(list(order), out) == len(items)
        merged = read_recording(out)
        assert merged.is_intact
        assert payloads(merged.items) == expected
        assert [
            message.payload for message in recover_log(out).messages
        ] == expected  # in the file itself too
        assert merged.missing_samples == 0
    assert [part.read_bytes() for part in parts] == before


def test_merging_keeps_texts_and_times(tmp_path: Path, log: Path) -> None:
    merge([log, log], tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as stream:
        names = [attachment.name for attachment in make_reader(stream).iter_attachments()]
    assert sorted(names) == sorted(build_attachments(START))
    # the wall clock of the recorder too, of whoever heard a message
    was = sorted(
        (message.log_time, message.topic, message.payload, message.publish_time)
        for message in iter_messages(log)
    )
    merged = iter_messages(tmp_path / "out.mcap")
    assert was == sorted(
        (message.log_time, message.topic, message.payload, message.publish_time)
        for message in merged
    )


def test_a_start_that_was_lost_is_taken_from_its_copy(tmp_path: Path) -> None:
    write(tmp_path / "part.mcap", run()[5:])
    merge([tmp_path / "part.mcap"], tmp_path / "out.mcap")
    assert read_recording(tmp_path / "out.mcap").start == START


def test_parts_without_a_start_are_kept_and_not_merged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(LogWriter, "write_run_description", lambda *_: None)
    write(tmp_path / "part.mcap", run()[5:])
    with raises_input_error(where=tmp_path / "part.mcap", remedy="shaketwin verify"):
        merge([tmp_path / "part.mcap"], tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("run_bytes", [1, 500, 20_000])
def test_merge_in_sorted_runs_equals_merge_in_memory(
    tmp_path: Path, log: Path, run_bytes: int
) -> None:
    items = run()
    shuffled = random.Random(2).sample(items[1:], len(items) - 1)
    write(tmp_path / "a.mcap", [items[0], *shuffled[:60]])
    write(tmp_path / "b.mcap", [items[0], *shuffled[40:]])
    parts = [tmp_path / "a.mcap", tmp_path / "b.mcap"]
    assert merge(parts, tmp_path / "out.mcap", run_bytes) == len(items)
    assert [message.payload for message in iter_messages(tmp_path / "out.mcap")] == payloads(
        read_recording(log).items
    )
    assert verify_log(tmp_path / "out.mcap")
    assert not list(tmp_path.glob(".merging*")), "pieces are left behind"


def test_memory_is_bounded_however_long_the_parts_are(tmp_path: Path) -> None:
    text = random.Random(1).randbytes(15_000).hex()
    writer = LogWriter(tmp_path / "a.mcap", RATE_HZ)
    writer.write_run_description(START)
    writer.write("/run/start", encode_item(START, START.run), 0)
    for index in range(400):
        event = Event(index, "long", f"{index}{text}")
        writer.write("/run/event", encode_item(event, START.run), index)
    writer.close()
    tracemalloc.start()
    assert merge([tmp_path / "a.mcap"] * 2, tmp_path / "out.mcap", 2**20) == 401
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 10e6  # of 24 MB that no compression makes small
    assert verify_log(tmp_path / "out.mcap")


def test_a_merge_that_fails_leaves_no_half_log(
    tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    before = log.read_bytes()
    monkeypatch.setattr(LogWriter, "close", full)
    with pytest.raises(OSError, match="No space"):
        merge([log], tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()
    assert log.read_bytes() == before


def test_a_log_is_verified_by_its_hash(tmp_path: Path, log: Path) -> None:
    assert verify_log(log)
    content = log.read_bytes()
    cut = tmp_path / "cut.mcap"
    for size in (0, 100, len(content) // 2, len(content) - 1):
        cut.write_bytes(content[:size])
        assert not verify_log(cut)
    # of whole files with sound checksums: a hash that is another's, and none (version 1)
    digest = next(name for name in (b"sha256",) if name in content)
    at = content.rindex(digest) + len(digest) + 4
    cut.write_bytes(content[:at] + b"0" * 64 + content[at + 64 :])
    assert not verify_log(cut)
