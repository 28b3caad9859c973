"""Parts become run.mcap only when the whole has been read back; until then they are kept."""

import errno
import fcntl
from pathlib import Path

import pytest

from table_io.card import BadInput
from twin.service import parts
from twin.service.parts import LOCK, gather
from twin.stream.folder import PARTS
from twin.stream.mcap_log import LogWriter, each
from twin.stream.merging import verified
from twin.stream.wire import encode, topic

from .recordings import blocks, start_record

ITEMS = [start_record(), *blocks()[:60]]
RATE = start_record().rate_hz


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run whose parts are still there, none of them."""
    (tmp_path / PARTS).mkdir()
    (tmp_path / PARTS / LOCK).touch()
    return tmp_path


def part(run: Path, number: int, first: int, last: int, killed: bool) -> Path:
    """A part with some of the items; of a killed recorder it has no end."""
    path = run / PARTS / f"part-{number:03d}.mcap"
    writer, start = LogWriter(path, RATE), start_record()
    writer.describe(start)
    for item in (start, *ITEMS[max(first, 1) : last]):
        writer.write(topic(item), encode(item, start.run), item.index)
    if killed:
        writer.flush()
    else:
        writer.close()
    return path


def found(path: Path) -> list[bytes]:
    return sorted(one.payload for one in each(path))


def expected() -> list[bytes]:
    return sorted(encode(item, ITEMS[0].run) for item in ITEMS)


def test_one_whole_part_is_the_log_as_it_is(run: Path) -> None:
    before = part(run, 1, 0, 61, killed=False).read_bytes()
    assert gather(run).read_bytes() == before
    assert [one.name for one in run.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("killed", [(True,), (True, False), (False, True), (True, True)])
def test_parts_of_killed_recorders_become_one_whole_log(run: Path, killed: tuple[bool]) -> None:
    edges = [(0, 61)] if len(killed) == 1 else [(0, 35), (20, 61)]
    for number, (edge, one) in enumerate(zip(edges, killed, strict=True), 1):
        part(run, number, *edge, killed=one)
    out = gather(run)
    assert verified(out)
    assert found(out) == expected()
    assert [one.name for one in run.iterdir()] == ["run.mcap"]


def test_a_whole_that_is_not_what_was_written_leaves_the_parts(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = part(run, 1, 0, 61, killed=True)
    before = kept.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(parts, "verified", lambda _: False)
        with pytest.raises(BadInput, match="not what was written; the parts are kept beside it"):
            gather(run)
    assert not (run / "run.mcap").exists()
    assert kept.read_bytes() == before
    assert found(gather(run)) == expected()  # once that is mended


def test_a_disk_that_fails_while_merging_leaves_the_parts(
    run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "a/run.mcap")

    kept = part(run, 1, 0, 61, killed=True)
    before = kept.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(LogWriter, "close", full)
        with pytest.raises(BadInput, match=r"a/run.mcap: No space left .* kept in .*\.parts"):
            gather(run)
    assert [one.name for one in run.iterdir()] == [PARTS]
    assert kept.read_bytes() == before
    assert found(gather(run)) == expected()


def test_parts_of_a_run_that_goes_on_are_not_touched(run: Path) -> None:
    part(run, 1, 0, 61, killed=False)
    with (run / PARTS / LOCK).open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_SH)
        with pytest.raises(BadInput, match="a run is still going on in this folder; wait"):
            gather(run)
    gather(run)


def test_a_run_without_a_recording_says_so(run: Path) -> None:
    with pytest.raises(BadInput, match="the recorder wrote nothing"):
        gather(run)


def test_a_log_that_is_there_already_is_never_replaced(run: Path) -> None:
    kept = part(run, 1, 0, 61, killed=False)
    (run / "run.mcap").write_text("somebody's")
    with pytest.raises(BadInput, match="not a whole log; move it away, the parts are in"):
        gather(run)
    assert (run / "run.mcap").read_text() == "somebody's"
    (run / "run.mcap").write_bytes(kept.read_bytes())  # died after the parts had become it
    gather(run)
    assert [one.name for one in run.iterdir()] == ["run.mcap"]


@pytest.mark.parametrize("bit", [0, 6])
def test_parts_that_a_disk_has_damaged_inside_are_kept(run: Path, bit: int) -> None:
    """What stands behind the damage is in the log; what does not is not thrown away."""
    path = part(run, 1, 0, 40, killed=True)
    edge = path.stat().st_size  # a second chunk begins here, its length a byte later
    part(run, 2, 40, 61, killed=True)
    raw = bytearray(path.read_bytes() + b"\x06" + (2**40).to_bytes(8, "little") + bytes(500))
    raw[edge - 700] ^= 1 << bit
    path.write_bytes(raw)
    out = gather(run)
    assert verified(out)
    behind = {encode(item, ITEMS[0].run) for item in ITEMS[40:]}
    assert behind <= {*found(out)}
    assert sorted(one.name for one in run.iterdir()) == ["damaged", "run.mcap"]
    assert [one.read_bytes() for one in (run / "damaged").iterdir()] == [bytes(raw)]


def test_a_length_that_was_damaged_hides_nothing_behind_it(run: Path) -> None:
    path = run / PARTS / "part-001.mcap"
    writer, start, edges = LogWriter(path, RATE), start_record(), []
    writer.describe(start)
    for item in (start, *ITEMS[1:]):
        writer.write(topic(item), encode(item, start.run), item.index)
        writer.flush()
        edges.append(path.stat().st_size)
    raw = bytearray(path.read_bytes())
    raw[edges[9] + 3] ^= 0x40  # of the eleventh chunk's length: it reaches beyond the file
    path.write_bytes(raw)
    assert len(found(gather(run))) == len(ITEMS) - 1
    assert (run / "damaged" / "part-001.mcap").read_bytes() == bytes(raw)


def test_a_death_between_the_log_and_its_parts_loses_nothing(run: Path) -> None:
    part(run, 1, 0, 61, killed=False).rename(run / "run.mcap")
    assert found(gather(run)) == expected()
    assert [one.name for one in run.iterdir()] == ["run.mcap"]


def test_what_is_damaged_is_safe_before_the_log_has_its_name(
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
        with pytest.raises(BadInput, match="died"):
            gather(run)
    kept = run / "damaged" / "part-001.mcap"
    assert kept.read_bytes() == path.read_bytes()
    gather(run)
    assert kept.read_bytes() == bytes(raw) + bytes(600)
    assert sorted(one.name for one in run.iterdir()) == ["damaged", "run.mcap"]
