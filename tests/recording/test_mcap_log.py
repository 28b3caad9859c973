"""The log: what was written is read back, whatever was cut off, and parts make the whole again."""

import errno
import os
import random
import tracemalloc
from hashlib import sha256
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.writer import Writer

from table_io.block import join_blocks
from table_io.records import Event, RunStart, RunStop, SampleGap
from tests.builders.blocks import select_blocks
from tests.input_errors import raises_input_error
from tests.recording.example_run import (
    BLOCK_COUNT,
    BLOCK_SAMPLES,
    RATE_HZ,
    START,
    block,
    payloads,
    run,
    write,
)
from twin.recording.log_metadata import build_attachments
from twin.recording.mcap_log import LogWriter, write_items
from twin.recording.mcap_writer import McapWriter
from twin.recording.merge import merge, verify_log
from twin.recording.reader import Recording, read_recording
from twin.recording.recovery import recover_log
from twin.transport.codec import MESSAGE_NAMES, TOPIC_TYPES, decode_item, encode_item


@pytest.fixture
def log(tmp_path: Path) -> Path:
    write(tmp_path / "run.mcap", run(), flush_every=7)
    return tmp_path / "run.mcap"


def test_log_is_read_back_to_the_bit(log: Path) -> None:
    recording = read_recording(log)
    assert recording.is_intact
    assert (recording.run, recording.start) == (START.run, START)
    assert sorted(payloads(recording.items)) == sorted(payloads(run()))
    assert [item.index for item in recording.items] == sorted(item.index for item in run())
    assert isinstance(recording.items[0], RunStart)
    assert isinstance(recording.items[-1], RunStop)
    assert recording.stop == run()[-1]
    assert len(recording.records(SampleGap)) == 6
    whole = join_blocks([block(index * BLOCK_SAMPLES) for index in range(BLOCK_COUNT)])
    (piece,) = recording.contiguous_blocks("meas")
    assert piece.is_identical(whole)
    assert len(select_blocks(recording.items, "pred")) == BLOCK_COUNT
    assert recording.missing_samples == 0


def test_the_log_carries_texts_versions_schemas_and_times(log: Path) -> None:
    with log.open("rb") as stream:
        reader = make_reader(stream)
        texts = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        about = {metadata.name: metadata.metadata for metadata in reader.iter_metadata()}
        times: dict[str, list[tuple[int, int]]] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            assert schema.name == f"shaketwin.{MESSAGE_NAMES[TOPIC_TYPES[channel.topic]]}"
            times.setdefault(channel.topic, []).append((message.sequence, message.log_time))
    assert texts == build_attachments(START)
    assert texts["profile.toml"] == START.profile_toml.encode()
    assert decode_item("/run/start", texts["start.pb"]) == (START.run, START)
    assert about["attachments"] == {k: sha256(v).hexdigest() for k, v in texts.items()}
    assert about["run"] == {
        "id": START.run, "schema": "4", "host": "here", "started_at": START.started_at,
        "shaketwin": "0.1.0",
    }  # fmt: skip
    counted = {name: str(len(stamps)) for name, stamps in times.items()}
    hashed = {name: about["content"].pop(name) for name in ("sha256", "messages")}
    assert about["content"] == counted
    assert hashed["messages"] == str(len(run()))
    assert hashed["sha256"] == content_by_hand(log)
    # The sample index, not the wall clock, is the time of a message: 20 samples are 10 ms.
    assert times["/rig/meas"] == [(number, number * 10_000_000) for number in range(BLOCK_COUNT)]


def content_by_hand(path: Path) -> str:
    """The hash of a log's content as LOG.md describes it, by the library of others."""
    digest = sha256()
    with path.open("rb") as stream:
        for _, channel, message in NonSeekingReader(stream).iter_messages(log_time_order=False):
            digest.update(
                f"{channel.topic} {message.log_time} {len(message.data)}\n".encode() + message.data
            )
    return digest.hexdigest()


def test_a_killed_log_has_its_texts_and_no_hash(tmp_path: Path) -> None:
    write(tmp_path / "killed.mcap", run(), flush_every=7, close=False)
    content = (tmp_path / "killed.mcap").read_bytes()
    first = content.index(b"zstd")  # what stands before the first chunk
    (tmp_path / "cut.mcap").write_bytes(content[: first - 41])
    for name in ("killed.mcap", "cut.mcap"):
        recovered = recover_log(tmp_path / name)
        assert recovered.attachments == build_attachments(START)
        assert set(recovered.metadata) == {"run", "attachments"}
        assert not verify_log(tmp_path / name)


def test_a_log_is_never_overwritten(log: Path) -> None:
    before = log.read_bytes()
    with raises_input_error(where=log):
        LogWriter(log, RATE_HZ)
    with raises_input_error(where=log):
        write_items(log, run(), START)
    with raises_input_error(where=log):
        merge([log], log)
    assert log.read_bytes() == before


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "missing" / "run.mcap", tmp_path / "file" / "run.mcap"):
        with raises_input_error(where=path):
            LogWriter(path, RATE_HZ)
    if os.geteuid() != 0:  # root may write anywhere
        (tmp_path / "closed").mkdir(mode=0o500)
        with raises_input_error(
            where=tmp_path / "closed" / "run.mcap", problem=os.strerror(errno.EACCES)
        ):
            LogWriter(tmp_path / "closed" / "run.mcap", RATE_HZ)


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
        salvaged = recover_log(cut)
        messages = salvaged.messages
        assert not salvaged.is_intact
        assert [message.payload for message in messages] == expected[: len(messages)]
        assert len(messages) >= every * sum(size <= place for size in sizes)
        if messages:
            recording = read_recording(cut)
            assert not recording.is_intact
            assert recording.start == START
        elif salvaged.attachments.keys() >= {"start.pb"}:
            assert read_recording(cut).start == START
        else:
            with raises_input_error(where=cut, key="/run/start"):
                read_recording(cut)
    cut.write_bytes(whole)
    assert recover_log(cut).is_intact


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("intact") / "run.mcap"
    write(path, run(), flush_every=7)
    return path


def flip_bits(intact: Path, place: int, flipped: int) -> Path:
    """The log with the bits `flipped` of one byte turned over."""
    content = bytearray(intact.read_bytes())
    content[place] ^= flipped
    bad = intact.with_name("bad.mcap")
    bad.write_bytes(content)
    return bad


def hides_nothing(path: Path) -> bool:
    """True if a log is either known to be damaged or still the whole run."""
    recovered = recover_log(path)
    return not recovered.is_intact or [
        message.payload for message in recovered.messages
    ] == payloads(run())


@given(data=st.data())
@settings(max_examples=150)
def test_a_damaged_byte_is_noticed_or_does_no_harm(intact: Path, data: st.DataObject) -> None:
    place = data.draw(st.integers(8, intact.stat().st_size - 1))
    assert hides_nothing(flip_bits(intact, place, data.draw(st.integers(1, 255))))


def test_foreign_file_is_refused_with_the_reason(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with raises_input_error(where=path, problem=os.strerror(errno.ENOENT)):
        read_recording(path)
    with raises_input_error(where=tmp_path, problem=os.strerror(errno.EISDIR)):
        read_recording(tmp_path)
    path.write_text("time_s,table_disp_m\n0.0,0.0\n")
    with raises_input_error(where=path, remedy="run.mcap"):
        read_recording(path)
    foreign(path, "/camera/image", b"picture")
    with raises_input_error(where=path, problem="/camera/image"):
        read_recording(path)
    foreign(path, "/run/start", b"\xff\xff\xff")
    with raises_input_error(where=path, key="/run/start", problem="RunStart"):
        read_recording(path)
    foreign(path, "/run/event", encode_item(Event(0, "a", "b"), "run"))
    with raises_input_error(where=path, key="/run/start"):
        read_recording(path)


def foreign(path: Path, name: str, data: bytes) -> None:
    """Somebody else's MCAP file with one message."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(name, "json", 0)
        writer.add_message(channel, 0, data, 0)
        writer.finish()


@pytest.mark.parametrize(
    ("missing", "pieces"),
    [({4}, 2), ({0, 1}, 1), ({3, 4, 9}, 3), ({BLOCK_COUNT - 1}, 1), (set(range(BLOCK_COUNT)), 0)],
)
def test_missing_samples_are_counted(tmp_path: Path, missing: set[int], pieces: int) -> None:
    write(tmp_path / "run.mcap", run(frozenset(missing)))
    recording: Recording = read_recording(tmp_path / "run.mcap")
    assert recording.missing_samples == len(missing) * BLOCK_SAMPLES
    assert len(recording.contiguous_blocks("meas")) == pieces


def test_without_a_stop_only_holes_are_counted_as_missing(tmp_path: Path) -> None:
    write(tmp_path / "run.mcap", run(frozenset({4, BLOCK_COUNT - 1}))[:-1])
    recording = read_recording(tmp_path / "run.mcap")
    assert recording.stop is None
    assert recording.missing_samples == BLOCK_SAMPLES


def test_the_open_index_of_an_hour_takes_little_memory() -> None:
    """A live run closes some 24,000 chunks an hour; each entry was an object of 940 bytes."""
    writer, chunks = McapWriter(lambda data: None, 2**20), 2000
    channels = [writer.add_channel(f"/{name}", "x.Y", b"") for name in range(8)]
    tracemalloc.start()
    for chunk in range(chunks):
        for channel in channels:
            writer.add_messages(channel, chunk, [chunk * 10**8], 0, [b"payload"])
        writer.close_chunk()
    grown = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert grown / chunks < 100  # bytes
