"""Parts become run.mcap only when the whole has been read back; until then they are kept."""

import errno
import fcntl
from pathlib import Path

import pytest

from table_io.errors import InputError
from tests.input_errors import raises_input_error
from tests.reports.recordings import blocks, start_record
from twin.inspection.curves import print_curves
from twin.recording import merge
from twin.recording.mcap_log import LogWriter, iter_messages
from twin.recording.merge import LOCK_FILE, merge_run_parts, verify_log
from twin.recording.run_paths import PARTS_FOLDER, resolve_log_path
from twin.transport.codec import encode_item, topic_for

ITEMS = [start_record(), *blocks()[:60]]
RATE = start_record().rate_hz


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run whose parts are still there, none of them."""
    (tmp_path / PARTS_FOLDER).mkdir()
    (tmp_path / PARTS_FOLDER / LOCK_FILE).touch()
    return tmp_path


def part(run: Path, number: int, first: int, last: int, killed: bool) -> Path:
    """A part with some of the items; of a killed recorder it has no end."""
    path = run / PARTS_FOLDER / f"part-{number:03d}.mcap"
    writer, start = LogWriter(path, RATE), start_record()
    writer.write_run_description(start)
    for item in (start, *ITEMS[max(first, 1) : last]):
        writer.write(topic_for(item), encode_item(item, start.run), item.index)
    if killed:
        writer.flush()
    else:
        writer.close()
    return path


def list_payloads(path: Path) -> list[bytes]:
    return sorted(message.payload for message in iter_messages(path))


def list_expected() -> list[bytes]:
    return sorted(encode_item(item, start_record().run) for item in ITEMS)


def test_one_whole_part_is_the_log_as_it_is(run: Path) -> None:
    before = part(run, 1, 0, 61, killed=False).read_bytes()
    assert merge_run_parts(run).read_bytes() == before
    assert [path.name for path in run.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("killed", [(True,), (True, False), (False, True), (True, True)])
def test_parts_of_killed_recorders_become_one_whole_log(run: Path, killed: tuple[bool]) -> None:
    edges = [(0, 61)] if len(killed) == 1 else [(0, 35), (20, 61)]
    for number, (edge, killed_part) in enumerate(zip(edges, killed, strict=True), 1):
        part(run, number, *edge, killed=killed_part)
    out = merge_run_parts(run)
    assert verify_log(out)
    assert list_payloads(out) == list_expected()
    assert [path.name for path in run.iterdir()] == ["run.mcap"]


def test_merge_that_fails_verification_keeps_the_parts(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = part(run, 1, 0, 61, killed=True)
    before = kept.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(merge, "verify_log", lambda _: False)
        with raises_input_error(where=run / PARTS_FOLDER / "run.mcap", remedy="shaketwin report"):
            merge_run_parts(run)
    assert not (run / "run.mcap").exists()
    assert kept.read_bytes() == before
    assert list_payloads(merge_run_parts(run)) == list_expected()  # once that is mended


def test_a_disk_that_fails_while_merging_leaves_the_parts(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "a/run.mcap")

    kept = part(run, 1, 0, 61, killed=True)
    before = kept.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(LogWriter, "close", full)
        with raises_input_error(where="a/run.mcap", problem=PARTS_FOLDER):
            merge_run_parts(run)
    assert [path.name for path in run.iterdir()] == [PARTS_FOLDER]
    assert kept.read_bytes() == before
    assert list_payloads(merge_run_parts(run)) == list_expected()


def test_parts_of_a_run_that_goes_on_are_not_touched(run: Path) -> None:
    part(run, 1, 0, 61, killed=False)
    with (run / PARTS_FOLDER / LOCK_FILE).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        with raises_input_error(where=run):
            merge_run_parts(run)
    merge_run_parts(run)


def test_run_without_parts_is_refused(run: Path) -> None:
    with raises_input_error(where=run):
        merge_run_parts(run)


def test_a_log_that_is_there_already_is_never_replaced(run: Path) -> None:
    kept = part(run, 1, 0, 61, killed=False)
    (run / "run.mcap").write_text("somebody's")
    with raises_input_error(where=run / "run.mcap", problem=PARTS_FOLDER):
        merge_run_parts(run)
    assert (run / "run.mcap").read_text() == "somebody's"
    (run / "run.mcap").write_bytes(kept.read_bytes())  # died after the parts had become it
    merge_run_parts(run)
    assert [path.name for path in run.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("bit", [0, 6])
def test_parts_that_a_disk_has_damaged_inside_are_kept(run: Path, bit: int) -> None:
    """What stands behind the damage is in the log; what does not is not thrown away."""
    path = part(run, 1, 0, 40, killed=True)
    edge = path.stat().st_size  # a second chunk begins here, its length a byte later
    part(run, 2, 40, 61, killed=True)
    raw = bytearray(path.read_bytes() + b"\x06" + (2**40).to_bytes(8, "little") + bytes(500))
    raw[edge - 700] ^= 1 << bit
    path.write_bytes(raw)
    out = merge_run_parts(run)
    assert verify_log(out)
    behind = {encode_item(item, start_record().run) for item in ITEMS[40:]}
    assert behind <= {*list_payloads(out)}
    assert sorted(path.name for path in run.iterdir()) == ["damaged", "run.mcap"]
    assert [path.read_bytes() for path in (run / "damaged").iterdir()] == [bytes(raw)]


def test_a_length_that_was_damaged_hides_nothing_behind_it(run: Path) -> None:
    path = run / PARTS_FOLDER / "part-001.mcap"
    writer, start, edges = LogWriter(path, RATE), start_record(), []
    writer.write_run_description(start)
    for item in (start, *ITEMS[1:]):
        writer.write(topic_for(item), encode_item(item, start.run), item.index)
        writer.flush()
        edges.append(path.stat().st_size)
    raw = bytearray(path.read_bytes())
    raw[edges[9] + 3] ^= 0x40  # of the eleventh chunk's length: it reaches beyond the file
    path.write_bytes(raw)
    assert len(list_payloads(merge_run_parts(run))) == len(ITEMS) - 1
    assert (run / "damaged" / "part-001.mcap").read_bytes() == bytes(raw)


def test_a_death_between_the_log_and_its_parts_loses_nothing(run: Path) -> None:
    part(run, 1, 0, 61, killed=False).rename(run / "run.mcap")
    assert list_payloads(merge_run_parts(run)) == list_expected()
    assert [path.name for path in run.iterdir()] == ["run.mcap"]


def test_damaged_parts_are_copied_before_the_log_is_renamed(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever finds the log afterwards takes the parts away."""
    path = part(run, 1, 0, 40, killed=True)
    raw = bytearray(path.read_bytes())
    edge = len(raw)
    part(run, 2, 40, 61, killed=True)
    raw[edge - 700] ^= 1
    path.write_bytes(raw + bytes(600))

    def died(*_: object) -> None:
        raise OSError(errno.EIO, "died", "run.mcap")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", died)
        with raises_input_error(where="run.mcap", problem="died"):
            merge_run_parts(run)
    kept = run / "damaged" / "part-001.mcap"
    assert kept.read_bytes() == path.read_bytes()
    merge_run_parts(run)
    assert kept.read_bytes() == bytes(raw) + bytes(600)
    assert sorted(path.name for path in run.iterdir()) == ["damaged", "run.mcap"]


def test_a_folder_or_its_log_is_resolved_to_the_log(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    log.touch()
    assert resolve_log_path(tmp_path) == resolve_log_path(log) == log


def test_a_folder_without_a_recording_is_named_as_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError) as error:
        print_curves(Path("full"), False)
    assert error.value.where == "full"
    assert "run.mcap" in error.value.remedy
