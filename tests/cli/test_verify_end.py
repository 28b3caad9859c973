"""`verify` of a test that has no end, of one that was repaired, and of parts not yet together."""

from pathlib import Path

import pytest

from table_io.errors import InputError
from table_io.records import RunStop, SampleGap
from tests.cli.test_verify import read_output, verify
from tests.recording.example_run import BLOCK_SAMPLES, START, block, run, write
from twin.exchange.export import ExportOptions, export_log
from twin.log import open_log
from twin.recording.reader import read_recording
from twin.recording.run_paths import PARTS_FOLDER, resolve_log_path
from twin.replay.verify import find_missing_end

PLANNED = START.planned_samples


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A log of which the second half is gone."""
    path = tmp_path / "run.mcap"
    sizes = write(path, run(), flush_every=10)
    path.write_bytes(path.read_bytes()[: sizes[len(sizes) // 2]])
    return path


def test_half_a_test_is_not_whole_even_if_its_file_is(cut: Path) -> None:
    code, report = verify(cut)
    end = read_recording(cut).contiguous_blocks("meas")[-1].end
    lost = {"first": end, "count": PLANNED - end, "channel": "", "reason": "no end was recorded"}
    assert 0 < end < PLANNED
    assert (code, report["gaps"].count(lost)) == (4, 1)
    new = cut.with_name("new.mcap")
    assert verify(cut, "--repair", new)[0] == 4
    code, report = verify(new)
    assert (code, report["sound"], report["damage"]) == (4, False, [])
    assert report["gaps"].count(lost) == 1
    assert read_recording(new).is_intact  # the file; the test is not
    assert not [
        gap for gap in read_recording(new).records(SampleGap) if not gap.channel
    ]  # nobody knows what was lost
    lines = read_output(new).splitlines()
    assert lines[-1] == "the file is whole, the recording has dropouts"
    assert any(f"samples {end} to {PLANNED - 1} " in line and "no end" in line for line in lines)


def test_a_repaired_log_says_of_what(cut: Path) -> None:
    new = cut.with_name("new.mcap")
    assert any("`--repair NEW`" in line for line in read_output(cut).splitlines())
    lines = read_output(cut, "--repair", new).splitlines()
    assert new.exists()
    assert "damaged" in lines
    assert not any("--repair NEW" in line for line in lines)  # it was given
    assert any(
        line.startswith("repaired: from run.mcap: the file was never")
        for line in read_output(new).splitlines()
    )
    assert verify(new)[1]["repaired"]["from_1"] == "run.mcap"
    assert verify(cut)[1]["repaired"] == {}


def test_no_end_is_a_gap_even_of_no_samples(tmp_path: Path) -> None:
    items = [item for item in run() if not isinstance(item, RunStop)]
    write(tmp_path / "run.mcap", [*items, block(PLANNED)])  # more than was planned
    assert find_missing_end(read_recording(tmp_path / "run.mcap")) == [(PLANNED + BLOCK_SAMPLES, 0)]
    code, report = verify(tmp_path)
    assert (code, report["gaps"][0]["count"]) == (4, 0)
    assert any(
        f"from sample {PLANNED + BLOCK_SAMPLES} (at " in line
        for line in read_output(tmp_path).splitlines()
    )


def test_parts_alone_are_no_log_yet(tmp_path: Path) -> None:
    """One sentence says what to do, whoever is asked; `verify` says what is in them, and that."""
    folder = tmp_path / "killed"
    (folder / PARTS_FOLDER).mkdir(parents=True)
    write(folder / PARTS_FOLDER / "part-001.mcap", run())
    words = f"{folder}: its recorder was killed: `shaketwin report {folder}` merges the parts"
    for reader in (
        resolve_log_path,
        open_log,
        lambda place: export_log(ExportOptions(place, ("csv",))),
    ):
        with pytest.raises(InputError) as caught:
            reader(folder)
        assert str(caught.value) == words
    code, report = verify(folder)
    assert (code, report["sound"], report["apart"]) == (4, False, [words])
    assert report["samples"]["acquired"] == PLANNED
    assert read_output(folder).splitlines()[-1] == words
    (folder / PARTS_FOLDER / "part-001.mcap").rename(folder / "run.mcap")
    assert "apart" in verify(folder)[1]
    assert verify(folder)[1]["apart"] == []
    assert resolve_log_path(folder) == folder / "run.mcap"
