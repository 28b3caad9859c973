"""The log: what was written is read back, whatever was cut off, and parts make the whole again."""

import os
import random
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from table_io.block import Block, join
from table_io.card import BadInput
from table_io.records import Comparison, Event, Gap, RunStart, RunStop, Step, Timing
from twin.stream.mcap_log import LogWriter, Recording, merge, messages, read, topics, write_items
from twin.stream.wire import TOPIC_TYPES, Item, encode, topic

RATE = 2000.0
SIZE = 20  # samples a block
BLOCKS = 30
START = RunStart(
    index=0, run="2026-run", name="log", source="table", profile_toml='title = "größe"\n',
    rig_toml="r = 1\n", model_toml="m = 1\n", rate_hz=RATE, block_samples=SIZE,
    channels=("drive_disp_m", "table_disp_m"), steps=(Step(0, "forward", 2.0, 0.49),),
    planned_samples=BLOCKS * SIZE, tare={"table_disp_m": 1e-4}, versions={"shaketwin": "0.1.0"},
    host="here", started_at="2026-11-21T04:00:00+00:00", epoch_s=12.5,
)  # fmt: skip


def block(index: int, stream: str = "meas", samples: int = SIZE) -> Block:
    """A block whose samples depend on nothing but their index; some are lost."""
    at = np.arange(index, index + samples)
    values = np.array([np.sin(at / 7.0), np.cos(at / 9.0)])
    values[1, at % 41 == 0] = np.nan
    return Block(stream, index, RATE, START.channels, values, at // 100, at % 5, at % 3)


def run(missing: frozenset[int] = frozenset()) -> list[Item]:
    """A whole run as it is published; blocks with these numbers are missing."""
    items: list[Item] = [START]
    for number in set(range(BLOCKS)) - missing:
        index = number * SIZE
        items += [block(index), block(index, "pred")]
        sums = (float(number), -0.0)
        items.append(Comparison(index, SIZE, START.channels, sums, sums, (np.nan, 0.1)))
        if number % 10 == 3:  # several items of one kind at one sample: nothing else orders them
            items += [Event(index, "jump", "up"), Event(index, "trip", "b"), Event(index, "a", "c")]
            items += [Gap(index, 1, name, "lost") for name in reversed(START.channels)]
            items.append(Timing(index, "rig", 0.1, 0.2, 0.3, 0, number, 0.5, "fifo"))
    end = BLOCKS * SIZE
    return [*items, Event(end, "end", "done"), RunStop(end, "complete", "all played", ("idle",))]


def payloads(items: tuple[Item, ...] | list[Item]) -> list[bytes]:
    return [encode(item, START.run) for item in items]


def write(path: Path, items: list[Item], flush_every: int = 0, close: bool = True) -> list[int]:
    """A log of the items; returns the size of the file after each flush."""
    writer, sizes = LogWriter(path, RATE), []
    writer.describe(START)
    for number, item in enumerate(items, 1):
        writer.write(topic(item), encode(item, START.run), item.index)
        if flush_every and number % flush_every == 0:
            writer.flush()
            sizes.append(path.stat().st_size)
    if close:
        writer.close()
    else:
        writer.flush()  # the file stays as a killed recorder leaves it
    return sizes


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write(tmp_path / "run.mcap", run(), flush_every=7)
    return tmp_path / "run.mcap"


def test_what_was_written_is_read_back_to_the_bit(log: Path) -> None:
    recording = read(log)
    assert recording.whole
    assert (recording.run, recording.start) == (START.run, START)
    assert sorted(payloads(recording.items)) == sorted(payloads(run()))
    assert [item.index for item in recording.items] == sorted(item.index for item in run())
    assert isinstance(recording.items[0], RunStart)
    assert isinstance(recording.items[-1], RunStop)
    assert recording.stop == run()[-1]
    assert len(recording.of(Gap)) == 6
    whole = join([block(index * SIZE) for index in range(BLOCKS)])
    (piece,) = recording.pieces("meas")
    assert piece.identical(whole)
    assert len(recording.blocks("pred")) == BLOCKS
    assert recording.missing_samples == 0


def test_the_log_carries_texts_versions_schemas_and_times(log: Path) -> None:
    with log.open("rb") as stream:
        reader = make_reader(stream)
        texts = {one.name: one.data.decode() for one in reader.iter_attachments()}
        (about,) = reader.iter_metadata()
        times = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            assert schema.name == f"shaketwin.{TOPIC_TYPES[channel.topic].__name__}"
            times.setdefault(channel.topic, []).append((message.sequence, message.log_time))
    assert texts == {
        "profile.toml": START.profile_toml,
        "rig.toml": START.rig_toml,
        "model.toml": START.model_toml,
    }
    assert about.metadata == {"id": START.run, "schema": "1", "host": "here", "shaketwin": "0.1.0"}
    # The sample index, not the wall clock, is the time of a message: 20 samples are 10 ms.
    assert times["/rig/meas"] == [(number, number * 10_000_000) for number in range(BLOCKS)]


def test_every_topic_can_stand_in_a_log() -> None:
    assert sorted(topics()) == sorted(TOPIC_TYPES)


def test_a_log_is_never_overwritten(log: Path) -> None:
    before = log.read_bytes()
    with pytest.raises(BadInput, match=r"run.mcap: exists already; nothing recorded is ever"):
        LogWriter(log, RATE)
    with pytest.raises(BadInput, match="exists already"):
        write_items(log, run(), START)
    with pytest.raises(BadInput, match="exists already"):
        merge([log], log)
    assert log.read_bytes() == before


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "missing" / "run.mcap", tmp_path / "file" / "run.mcap"):
        with pytest.raises(BadInput, match=r"run.mcap: cannot write here"):
            LogWriter(path, RATE)
    if os.geteuid() != 0:  # root may write anywhere
        (tmp_path / "closed").mkdir(mode=0o500)
        with pytest.raises(BadInput, match=r"run.mcap: cannot write here: Permission denied"):
            LogWriter(tmp_path / "closed" / "run.mcap", RATE)


def test_a_cut_log_still_gives_every_complete_chunk(tmp_path: Path) -> None:
    path, every = tmp_path / "run.mcap", 7
    sizes = write(path, run(), flush_every=every)
    whole, expected = path.read_bytes(), payloads(run())
    assert len(sizes) > 10
    cut = tmp_path / "cut.mcap"
    places = random.Random(3).sample(range(len(whole)), 150)
    edges = [size + step for size in sizes for step in (-1, 0, 1, 5, 9)]
    for place in sorted({*places, *edges, *range(30), len(whole) - 1, len(whole) - 8}):
        cut.write_bytes(whole[:place])
        found, complete = messages(cut)
        assert not complete
        assert [one.payload for one in found] == expected[: len(found)]
        assert len(found) >= every * sum(size <= place for size in sizes)
        if found:
            recording = read(cut)
            assert not recording.whole
            assert recording.start == START
        else:
            with pytest.raises(BadInput, match=r"cut.mcap: holds no start record"):
                read(cut)
    cut.write_bytes(whole)
    assert messages(cut)[1]


def test_what_was_flushed_survives_the_death_of_the_recorder(tmp_path: Path) -> None:
    write(tmp_path / "killed.mcap", run(), close=False)
    recording = read(tmp_path / "killed.mcap")
    assert not recording.whole
    assert len(recording.items) == len(run())


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("intact") / "run.mcap"
    write(path, run(), flush_every=7)
    return path


def damaged(intact: Path, place: int, flipped: int) -> Path:
    """The log with the bits `flipped` of one byte turned over."""
    content = bytearray(intact.read_bytes())
    content[place] ^= flipped
    bad = intact.with_name("bad.mcap")
    bad.write_bytes(content)
    return bad


def hides_nothing(path: Path) -> bool:
    """True if a log is either known to be damaged or still the whole run."""
    found, whole = messages(path)
    return not whole or [one.payload for one in found] == payloads(run())


@given(data=st.data())
@settings(max_examples=150, deadline=None)
def test_a_damaged_byte_is_noticed_or_does_no_harm(intact: Path, data: st.DataObject) -> None:
    place = data.draw(st.integers(8, intact.stat().st_size - 1))
    assert hides_nothing(damaged(intact, place, data.draw(st.integers(1, 255))))


@pytest.mark.parametrize("flipped", [0x02, 0x80])
def test_a_record_that_became_one_of_another_kind_is_noticed(intact: Path, flipped: int) -> None:
    content = intact.read_bytes()
    kinds = [
        place
        for place in range(8, len(content) - 9)
        if content[place] in (6, 7)  # a chunk, or the index of one
        and 0 < int.from_bytes(content[place + 1 : place + 9], "little") < len(content)
    ]
    assert len(kinds) > 30
    assert all(hides_nothing(damaged(intact, place, flipped)) for place in kinds)


def test_what_is_no_log_of_ours_is_refused_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with pytest.raises(BadInput, match=r"a.mcap: cannot read this log: No such file"):
        read(path)
    with pytest.raises(BadInput, match="cannot read this log"):
        read(tmp_path)
    path.write_text("time_s,table_disp_m\n0.0,0.0\n")
    with pytest.raises(BadInput, match=r"a.mcap: not an MCAP file; give the run.mcap"):
        read(path)
    foreign(path, "/camera/image", b"picture")
    with pytest.raises(BadInput, match=r"not a shaketwin log \(topics: /camera/image\)"):
        read(path)
    foreign(path, "/run/start", b"\xff\xff\xff")
    with pytest.raises(BadInput, match=r"a.mcap: damaged or foreign: /run/start: not a RunStart"):
        read(path)
    foreign(path, "/run/event", encode(Event(0, "a", "b"), "run"))
    with pytest.raises(BadInput, match="holds no start record"):
        read(path)


def foreign(path: Path, name: str, data: bytes) -> None:
    """Somebody else's MCAP file with one message."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(name, "json", 0)
        writer.add_message(channel, 0, data, 0)
        writer.finish()


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
    expected = payloads(read(tmp_path / "whole.mcap").items)
    orders = [parts, parts[::-1], *random.Random(1).sample(list(permutations(parts)), 10)]
    for number, order in enumerate(orders):
        out = tmp_path / f"out-{number}.mcap"
        assert merge(list(order), out) == len(items)
        merged = read(out)
        assert merged.whole
        assert payloads(merged.items) == expected
        assert [one.payload for one in messages(out)[0]] == expected  # in the file itself too
        assert merged.missing_samples == 0
    assert [part.read_bytes() for part in parts] == before


def test_merging_keeps_texts_and_times(tmp_path: Path, log: Path) -> None:
    merge([log, log], tmp_path / "out.mcap")
    with (tmp_path / "out.mcap").open("rb") as stream:
        names = [one.name for one in make_reader(stream).iter_attachments()]
    assert sorted(names) == ["model.toml", "profile.toml", "rig.toml"]
    was = sorted((one.log_time, one.payload) for one in messages(log)[0])
    assert sorted((one.log_time, one.payload) for one in messages(tmp_path / "out.mcap")[0]) == was


def test_parts_without_a_start_are_kept_and_not_merged(tmp_path: Path) -> None:
    write(tmp_path / "part.mcap", run()[5:])
    with pytest.raises(BadInput, match=r"part.mcap: holds no start record; the parts are kept"):
        merge([tmp_path / "part.mcap"], tmp_path / "out.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize(
    ("missing", "pieces"),
    [({4}, 2), ({0, 1}, 1), ({3, 4, 9}, 3), ({BLOCKS - 1}, 1), (set(range(BLOCKS)), 0)],
)
def test_missing_samples_are_counted(tmp_path: Path, missing: set[int], pieces: int) -> None:
    write(tmp_path / "run.mcap", run(frozenset(missing)))
    recording: Recording = read(tmp_path / "run.mcap")
    assert recording.missing_samples == len(missing) * SIZE
    assert len(recording.pieces("meas")) == pieces


def test_without_a_stop_only_holes_are_counted_as_missing(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", run(frozenset({4, BLOCKS - 1}))[:-1])
    recording = read(tmp_path / "run.mcap")
    assert recording.stop is None
    assert recording.missing_samples == SIZE
