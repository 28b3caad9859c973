"""A repair that fails leaves nothing behind, so that it can be tried again, and says why it did."""

import errno
import os
from pathlib import Path

import pytest

from tests.input_errors import raises_input_error
from tests.recording.test_mcap_log import run, write
from twin.replay import verify
from twin.replay.verify import Verification, examine_logs, repair_log


@pytest.fixture
def old(tmp_path: Path) -> Path:
    write(tmp_path / "old.mcap", run(), flush_every=7)
    return tmp_path / "old.mcap"


def test_a_full_disk_leaves_no_half_of_a_file(
    old: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verified, new = examine_logs([old]), tmp_path / "new.mcap"
    write_some = os.write

    def full(descriptor: int, data: bytes) -> int:
        write_some(descriptor, data[:100])
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("twin.recording.mcap_log.os.write", full)
        with pytest.raises(OSError, match="No space left"):
            repair_log(verified, new)
    assert not new.exists()
    repair_log(verified, new)
    assert examine_logs([new]).report.damage == []


def test_repair_names_what_failed_first(
    old: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not what failed then, as the file was closed."""
    verified, new = examine_logs([old]), tmp_path / "new.mcap"

    def fails(*_: object) -> None:
        raise OSError(errno.EIO, "the first")

    def fails_then(*_: object) -> None:
        raise OSError(errno.EIO, "the second")

    monkeypatch.setattr("twin.recording.mcap_log.LogWriter.write", fails)
    monkeypatch.setattr("twin.recording.mcap_log.LogWriter.close", fails_then)
    with pytest.raises(OSError, match="the first"):
        repair_log(verified, new)


def test_repaired_log_that_differs_when_read_back_is_removed(
    old: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    verified, new = examine_logs([old]), tmp_path / "new.mcap"

    def forgetful(paths: list[Path]) -> Verification:
        again = examine_logs(paths)
        return Verification(again.recording, again.messages[1:], again.report)

    monkeypatch.setattr(verify, "examine_logs", forgetful)
    with raises_input_error(where=new, remedy=str(old)):
        repair_log(verified, new)
    assert not new.exists()


def test_repair_onto_the_damaged_log_is_refused(old: Path) -> None:
    before = old.read_bytes()
    with raises_input_error(where=old):
        repair_log(examine_logs([old]), old)
    assert old.read_bytes() == before
