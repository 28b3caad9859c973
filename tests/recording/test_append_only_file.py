"""A recording on a disk that fills up and comes back: always a clean prefix, nothing lost."""

import contextlib
import errno
import os
import random
import resource
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.recording.example_run import RATE_HZ, START, payloads, run, write
from twin.recording.mcap_log import AppendOnlyFile, LogWriter, iter_messages
from twin.recording.merge import verify_log
from twin.recording.reader import read_recording
from twin.recording.recovery import recover_log
from twin.transport.codec import encode_item, topic_for

Limit = Callable[[int], None]


@pytest.fixture
def limit() -> Iterator[Limit]:
    """Sets how large files of this process may become, in bytes; -1 is as large as they like."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))


def test_unwritten_bytes_wait_for_room_and_are_written_once(tmp_path: Path, limit: Limit) -> None:
    file, expected = AppendOnlyFile(tmp_path / "a"), b""
    chance = random.Random(1)
    for number in range(200):
        piece = chance.randbytes(chance.randrange(2000))
        limit((number * 17 % 200) * 900 + 10)  # the room comes and goes
        file.write(piece)
        expected += piece
        with contextlib.suppress(OSError):
            file.drain()
        content = (tmp_path / "a").read_bytes()
        assert expected.startswith(content)
        assert (file.tell(), file.pending_bytes) == (len(expected), len(expected) - len(content))
    file.write(b"more")
    limit(0)
    with pytest.raises(OSError, match=r"File too large: '.*/a'"):
        file.drain()
    limit(-1)
    file.close()
    file.close()
    expected += b"more"
    assert (tmp_path / "a").read_bytes() == expected


@pytest.mark.parametrize("loss", ["file deleted", "folder deleted", "folder moved"])
def test_deleted_or_moved_file_is_written_again(tmp_path: Path, loss: str) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    path = folder / "a"
    file = AppendOnlyFile(path)
    file.write(b"before ")
    file.drain()
    assert not file.is_lost
    if loss == "folder moved":
        folder.rename(tmp_path / "elsewhere")
    else:
        path.unlink()
    if loss == "folder deleted":
        folder.rmdir()
    assert file.is_lost
    assert file.restore()
    file.write(b"after")
    file.drain()
    assert path.read_bytes() == b"before after"
    assert not file.is_lost
    path.unlink()
    file.close()
    assert path.read_bytes() == b"before after"


def test_a_lost_file_grows_while_it_is_written_again(tmp_path: Path) -> None:
    path = tmp_path / "a"
    file = AppendOnlyFile(path)
    expected = random.Random(1).randbytes(10_000)
    file.write(expected)
    file.drain()
    path.unlink()
    calls = 0
    while not file.restore(max_bytes=3000):
        calls += 1
        file.write(b"more")
        file.drain()
        expected += b"more"
        assert file.is_lost
    assert calls == 3
    assert path.read_bytes() == expected
    assert not file.is_lost


def test_a_lost_file_waits_for_room(tmp_path: Path, limit: Limit) -> None:
    path, expected = tmp_path / "a", random.Random(1).randbytes(3_000_000)
    file = AppendOnlyFile(path)
    file.write(expected)
    file.drain()
    path.unlink()
    limit(2_000_000)
    for _ in range(2):
        with pytest.raises(OSError, match="File too large"):
            file.close()
        assert not path.exists()
    limit(-1)
    file.close()
    assert path.read_bytes() == expected


def test_another_file_in_its_place_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "part-001.mcap"
    file = AppendOnlyFile(path)
    file.write(b"recorded")
    file.drain()
    path.unlink()
    path.write_bytes(b"of another")
    assert file.is_lost
    file.close()
    assert path.read_bytes() == b"of another"
    assert file.path == tmp_path / "part-001-2.mcap"
    assert file.path.read_bytes() == b"recorded"


@pytest.mark.parametrize("room", [0, 500, 2_000, 9_000, 13_777, 20_000])
def test_a_log_goes_on_where_the_disk_was_full(tmp_path: Path, limit: Limit, room: int) -> None:
    write(tmp_path / "whole.mcap", run(), flush_every=3)
    assert room < (tmp_path / "whole.mcap").stat().st_size
    writer, failed = LogWriter(tmp_path / "a.mcap", RATE_HZ), 0
    writer.write_run_description(START)
    limit(room)
    for number, item in enumerate(run(), 1):
        writer.write(topic_for(item), encode_item(item, START.run), item.index)
        if number % 3 == 0:
            try:
                writer.flush()
            except OSError:
                failed += 1
    assert failed
    with pytest.raises(OSError, match="File too large"):
        writer.close()
    # meanwhile: every chunk that fitted can be read, in order
    recovered = [message.payload for message in iter_messages(tmp_path / "a.mcap")]
    assert recovered == payloads(run())[: len(recovered)]
    assert bool(recovered) is (room > 5000)
    limit(-1)
    writer.close()
    assert verify_log(tmp_path / "a.mcap")
    assert recover_log(tmp_path / "a.mcap").is_intact  # ended once
    assert payloads(read_recording(tmp_path / "a.mcap").items) == payloads(
        read_recording(tmp_path / "whole.mcap").items
    )


@pytest.mark.parametrize("call", ["write", "fsync"])
def test_a_dying_disk_is_named_by_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    def dead(*_: object) -> int:
        raise OSError(errno.EIO, "Input/output error")

    writer = LogWriter(tmp_path / "a.mcap", RATE_HZ)
    writer.write_run_description(START)
    with monkeypatch.context() as patch:
        patch.setattr(os, call, dead)
        with pytest.raises(OSError, match=r"Input/output error: '.*a.mcap'"):
            writer.flush() if call == "write" else writer.sync()
    writer.close()
    assert verify_log(tmp_path / "a.mcap")
