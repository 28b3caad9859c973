"""What cannot be in a run enters nothing, whoever reads: as a whole, rows, batches or channels."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import Event, Record
from tests.recording.example_run import RATE_HZ, START, block, run
from twin.exchange.export import ExportOptions, export_log
from twin.log import open_log
from twin.recording.mcap_log import LogWriter, write_items
from twin.recording.reader import Recording, read_recording
from twin.recording.recovery import recover_log
from twin.recording.tabular import read_log_table
from twin.transport.codec import Item, encode_item, topic_for


def foreign(path: Path) -> Path:
    """A log in order, and in it a block and an event that another run has at the same samples."""
    other = replace(block(200), values=block(200).values + 1.0)
    strange: list[Item] = [other, Event(200, "jump", "of another run")]
    writer = LogWriter(path, RATE_HZ)
    writer.write_run_description(START)
    for item in run():
        if item.index == 200 and strange:  # before the true samples
            for odd in strange:
                writer.write(topic_for(odd), encode_item(odd, "another"), odd.index)
            strange = []
        writer.write(topic_for(item), encode_item(item, START.run), item.index)
    writer.close()
    return path


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return foreign(tmp_path_factory.mktemp("foreign") / "run.mcap")


@pytest.fixture(scope="module")
def true() -> Block:
    """The samples that the run has."""
    return block(0, samples=600)


def test_a_recording_leaves_out_what_is_of_another_run(log: Path, true: Block) -> None:
    recording = read_recording(log)
    (meas,) = recording.contiguous_blocks("meas")
    assert meas.values.tobytes() == true.values.tobytes()
    assert not recording.is_intact
    assert [damage.reason for damage in recording.damage] == [
        "/run/event: of another run", "/rig/meas: of another run",
    ]  # fmt: skip


def test_rows_leave_it_out_and_are_not_whole(log: Path, true: Block) -> None:
    rows = read_log_table(log)
    for number, name in enumerate(START.channels):
        assert (
            rows.read_columns(slice(0, 600), name)[name].tobytes() == true.values[number].tobytes()
        )
    assert not rows.is_intact
    assert not any(
        isinstance(record, Event) and "another" in record.text for record in rows.records
    )


def test_export_reports_items_of_another_run(log: Path, tmp_path: Path) -> None:
    assert not export_log(ExportOptions(log, ("csv",), tmp_path / "a.csv")).is_intact


def test_open_log_is_whole_only_if_every_topic_is(log: Path, true: Block, tmp_path: Path) -> None:
    """Also where the records alone are in order."""
    door = open_log(log)
    assert door["drive_disp_m"].tobytes() == true.values[0].tobytes()
    assert door.whole is read_recording(log).is_intact is False
    writer = LogWriter(tmp_path / "run.mcap", RATE_HZ)
    writer.write_run_description(START)
    for item in run():
        writer.write(topic_for(item), encode_item(item, START.run), item.index)
    strange = block(200)
    writer.write(topic_for(strange), encode_item(strange, "another"), 200)
    writer.close()
    assert open_log(tmp_path).whole is read_recording(tmp_path / "run.mcap").is_intact is False


@pytest.mark.parametrize(
    "odd",
    [
        replace(block(20), rate_hz=1000.0),
        replace(block(20), channels=("drive_disp_m", "force_r1_n")),
        replace(block(20), label=np.full(20, 99)),
        START,
        Event(round(START.rate_hz * 1e7) + 1, "late", "after any run"),
    ],
    ids=["rate", "channels", "label", "start", "late"],
)
def test_a_recording_leaves_out_what_is_invalid(odd: Block | Record, tmp_path: Path) -> None:
    """Also among the items of a series, the rest of which is in order."""
    path = tmp_path / "run.mcap"
    write_items(path, [*run(), odd], START)
    recording = read_recording(path)
    assert [damage.reason.split(":")[0] for damage in recording.damage] == [topic_for(odd)]
    assert [encode_item(item, "") for item in recording.items] == [
        encode_item(item, "") for item in sound(tmp_path / "sound.mcap").items
    ]


def sound(path: Path) -> Recording:
    write_items(path, run(), START)
    return read_recording(path)


def test_foreign_messages_are_in_the_file(log: Path) -> None:
    """The foreign messages are in the file, so the tests above leave out something."""
    assert len(recover_log(log).messages) == len(read_recording(log).items) + 2
