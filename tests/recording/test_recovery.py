"""Damaged logs: one accident costs what it hit and no more, and no file costs more than it may."""

import gc
import random
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from table_io.block import Block
from table_io.records import Comparison, Fault, FrequencyResponse, RunStop, Step, StepAdded
from tests.input_errors import raises_input_error
from tests.recording.example_run import RATE_HZ, START, payloads, run, write
from tests.recording.mutants import BOMBS, bomb, spans, write_messages
from twin.recording.mcap_log import LogWriter
from twin.recording.merge import merge
from twin.recording.reader import read_recording
from twin.recording.recovery import (
    CHUNK,
    MAGIC,
    MAX_RECORD_BYTES,
    MESSAGE_INDEX,
    RECORD_HEADER,
    find_record_candidates,
    pause_collection,
    recover_log,
    work_limit,
)
from twin.transport.codec import Item, encode_item, topic_for

CHUNK_MESSAGES = 7  # messages in a chunk
COST = 2**24  # that a small file may cost here


@pytest.fixture(scope="module")
def content(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A whole log of many chunks."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    write(path, run(), flush_every=CHUNK_MESSAGES)
    return path.read_bytes()


def chunks(content: bytes) -> list[tuple[int, int]]:
    return [(first, end) for opcode, first, end in spans(content) if opcode == CHUNK]


def recover_payloads(path: Path, content: bytes) -> list[bytes]:
    """Payloads of what is found in a file, in file order."""
    path.write_bytes(content)
    return [message.payload for message in recover_log(path).messages]


def without(number: int) -> list[bytes]:
    """The payloads of the whole log but for those of one chunk."""
    all_of_them = payloads(run())
    return all_of_them[: number * CHUNK_MESSAGES] + all_of_them[(number + 1) * CHUNK_MESSAGES :]


def flip_bit(content: bytes, first: int, end: int) -> bytes:
    at = (first + end) // 2 + 20
    return content[:at] + bytes([content[at] ^ 16]) + content[at + 1 :]


def zero_out(content: bytes, first: int, end: int) -> bytes:
    return content[: first + 60] + bytes(end - first - 60) + content[end:]


def cut_out(content: bytes, first: int, end: int) -> bytes:
    return content[: first + 70] + content[end - 30 :]


def stuff_garbage(content: bytes, first: int, end: int) -> bytes:
    return content[: first + 70] + b"\x06garbage\x00\x00" * 50 + content[first + 70 :]


def stretch_length(content: bytes, first: int, end: int) -> bytes:
    return content[: first + 1] + struct.pack("<Q", end - first + 40) + content[first + 9 :]


def endless(content: bytes, first: int, end: int) -> bytes:
    return content[: first + 1] + struct.pack("<Q", 2**63) + content[first + 9 :]


def change_opcode(content: bytes, first: int, end: int) -> bytes:
    return content[:first] + b"\x07" + content[first + 1 :]


def missing(content: bytes, first: int, end: int) -> bytes:
    return content[:first] + content[end:]


Accident = Callable[[bytes, int, int], bytes]


@pytest.mark.parametrize(
    "accident",
    [flip_bit, zero_out, cut_out, stuff_garbage, stretch_length, endless, change_opcode, missing],
)
def test_damage_costs_one_chunk(accident: Accident, content: bytes, tmp_path: Path) -> None:
    places = chunks(content)
    assert len(places) > 10
    for number in (0, len(places) // 2, len(places) - 1):
        bad = accident(content, *places[number])
        assert recover_payloads(tmp_path / "bad.mcap", bad) == without(number)
        recording = read_recording(tmp_path / "bad.mcap")
        assert not recording.is_intact
        assert recording.damage
        assert recording.start == START  # of the first chunk too: it stands there twice
        lost = payloads(run())[number * CHUNK_MESSAGES : (number + 1) * CHUNK_MESSAGES]
        assert not set(payloads(recording.items)) & (set(lost) - {payloads([START])[0]})


@pytest.mark.parametrize("further_records", [0, 1])
def test_chunk_after_damage_is_kept_for_any_length_lost(
    further_records: int, tmp_path: Path
) -> None:
    """What is lost of a chunk is as long as what follows: its declared end is a record's again."""
    items, path = run(), tmp_path / "bad.mcap"
    long_chunk = 9 * CHUNK_MESSAGES
    writer = LogWriter(path, RATE_HZ)
    writer.write_run_description(START)
    for number, item in enumerate(items, 1):
        writer.write(topic_for(item), encode_item(item, START.run), item.index)
        if number in (long_chunk, long_chunk + CHUNK_MESSAGES):
            writer.flush()
    writer.close()
    whole = path.read_bytes()
    records = spans(whole)
    (first, end), following = chunks(whole)[:2]
    boundary = records[records.index((CHUNK, *following)) + further_records][2]
    cut = boundary - end
    assert 0 < cut < end - first - 100
    bad = whole[: first + 70] + whole[first + 70 + cut :]
    assert recover_payloads(path, bad) == payloads(items)[long_chunk:]
    (damage,) = recover_log(path).damage
    assert (damage.offset, damage.size) == (first, following[0] - cut - first)


def test_messages_in_a_damaged_chunk_are_not_those_of_the_file(tmp_path: Path) -> None:
    """Without compression they look like records; the chunk after them is found all the same."""
    stream = BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE)
    writer.start()
    channel = writer.register_channel("/run/start", "protobuf", 0)
    for sequence in range(6):
        writer.add_message(channel, 0, encode_item(START, START.run), 0, sequence)
        if sequence in (2, 4):
            writer.flush()
    writer.finish()
    whole = stream.getvalue()
    first, end = chunks(whole)[0]
    path = tmp_path / "bad.mcap"
    path.write_bytes(whole[: end - 1] + bytes([whole[end - 1] ^ 1]) + whole[end:])
    assert [message.sequence for message in recover_log(path).messages] == [3, 4, 5]
    assert [(damage.offset, damage.size) for damage in recover_log(path).damage] == [
        (first, end - first)
    ]


def test_many_damaged_places_cost_no_more_than_the_file_is_long(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is searched for the next record grows with its distance, not with the rest of it."""
    searched: list[int] = []

    def count(window: bytes) -> list[int]:
        searched.append(len(window))
        return find_record_candidates(window)

    monkeypatch.setattr("twin.recording.recovery.find_record_candidates", count)
    index = RECORD_HEADER.pack(MESSAGE_INDEX, 6) + struct.pack("<HI", 1, 0)
    damaged = 3000
    path = tmp_path / "bad.mcap"
    path.write_bytes(MAGIC + RECORD_HEADER.pack(1, 8) + bytes(8) + (bytes(9) + 2 * index) * damaged)
    assert len(recover_log(path).damage) == damaged
    assert sum(searched) < 2048 * damaged


def test_several_accidents_cost_several_chunks(content: bytes, tmp_path: Path) -> None:
    places = chunks(content)
    bad = endless(flip_bit(content, *places[2]), *places[6])
    expected = [
        payload for payload in payloads(run()) if payload in without(2) and payload in without(6)
    ]
    assert recover_payloads(tmp_path / "bad.mcap", bad) == expected


def test_unfinished_log_without_its_first_chunk_is_read(content: bytes, tmp_path: Path) -> None:
    places = chunks(content)
    path = tmp_path / "bad.mcap"
    path.write_bytes(flip_bit(content, *places[0])[: places[-1][1]])
    recording = read_recording(path)
    assert sorted(payloads(recording.items)) == sorted([*without(0), encode_item(START, START.run)])


def test_a_bad_sector_costs_the_chunk_on_it(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, end = chunks(content)[4]

    class Dying(BytesIO):
        def read(self, size: int | None = -1) -> bytes:
            at = self.tell()
            if at < end - 20 and at + (size or 0) > first + 50:
                raise OSError(5, "Input/output error")
            return super().read(size)

    (tmp_path / "a.mcap").write_bytes(content)
    monkeypatch.setattr(Path, "open", lambda *_: Dying(content))
    recovered = recover_log(tmp_path / "a.mcap")
    assert [message.payload for message in recovered.messages] == without(4)
    assert [(damage.offset, damage.size) for damage in recovered.damage] == [(first, end - first)]


def test_merging_gives_up_nothing_that_stands_after_damage(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "part.mcap").write_bytes(flip_bit(content, *chunks(content)[3]))
    merge([tmp_path / "part.mcap"], tmp_path / "out.mcap")
    assert sorted(payloads(read_recording(tmp_path / "out.mcap").items)) == sorted(without(3))


@pytest.mark.parametrize("seed", range(5))
def test_order_and_copies_of_chunks_change_nothing_but_are_seen(
    seed: int, content: bytes, tmp_path: Path
) -> None:
    chance, records = random.Random(seed), spans(content)
    body = [content[first:end] for opcode, first, end in records if opcode == CHUNK]
    rest = [content[first:end] for opcode, first, end in records if opcode not in (CHUNK, 7)]
    mixed = [*body, *chance.sample(body, 3)]
    chance.shuffle(mixed)
    path = tmp_path / "mixed.mcap"
    path.write_bytes(MAGIC + rest[0] + b"".join(mixed) + b"".join(rest[1:]) + MAGIC)
    recording = read_recording(path)
    assert sorted(payloads(recording.items)) == sorted(payloads(run()))
    assert [item.index for item in recording.items] == sorted(item.index for item in run())
    assert not recording.is_intact
    assert recording.missing_samples == 0


def test_a_lost_beginning_costs_what_stood_there(content: bytes, tmp_path: Path) -> None:
    (_, _), (first, _) = chunks(content)[:2]
    for lost in (MAGIC[1:5], content[:20], content[: first + 30]):
        recovered = recover_payloads(tmp_path / "bad.mcap", bytes(len(lost)) + content[len(lost) :])
        expected = payloads(run())
        assert recovered in (expected, expected[2 * CHUNK_MESSAGES :], expected[CHUNK_MESSAGES:])


@pytest.mark.parametrize("packing", list(CompressionType))
def test_every_packing_of_the_format_is_read(packing: CompressionType, tmp_path: Path) -> None:
    stream = BytesIO()
    writer = Writer(stream, compression=packing)
    writer.start()
    channel = writer.register_channel("/run/start", "protobuf", 0)
    writer.add_message(channel, 0, encode_item(START, START.run), 7, 3)
    writer.finish()
    (tmp_path / "a.mcap").write_bytes(stream.getvalue())
    (message,) = recover_log(tmp_path / "a.mcap").messages
    assert (message.topic, message.sequence, message.publish_time) == ("/run/start", 3, 7)
    assert read_recording(tmp_path / "a.mcap").start == START


@pytest.mark.parametrize("kind", range(len(BOMBS)))
def test_decompression_bombs_are_bounded(
    kind: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("twin.recording.recovery.MIN_WORK_BYTES", COST)
    path = tmp_path / "bomb.mcap"
    path.write_bytes(bomb(kind))
    tracemalloc.start()
    try:
        recovered = recover_log(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert recovered.damage
    assert not recovered.is_intact
    assert peak < 3 * MAX_RECORD_BYTES + 2 * COST
    with raises_input_error(where=path):
        read_recording(path)


def test_a_sound_file_is_read_whole_however_long_it_is(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Work is limited by the size of the file alone, and a sound one needs a small part of it."""
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    monkeypatch.setattr("twin.recording.recovery.MIN_WORK_BYTES", 0)
    assert recover_log(path).is_intact
    monkeypatch.setattr("twin.recording.recovery.WORK_PER_BYTE", 100)
    assert recover_log(path).is_intact
    assert work_limit(2**50) == 2**50 * 100


def test_log_beyond_memory_is_refused_not_damaged(
    content: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Charged is what is kept: of other topics nothing, of empty messages what they cost."""
    path, small = tmp_path / "a.mcap", 50_000
    path.write_bytes(content)
    monkeypatch.setattr("twin.recording.recovery.memory_limit_bytes", lambda: small)
    assert recover_log(path, frozenset(("/rig/gap",))).is_intact
    with raises_input_error(where=path, remedy="memory"):
        recover_log(path)
    path.write_bytes(bomb(2))  # of messages without a payload
    tracemalloc.start()
    try:
        with raises_input_error(where=path, remedy="memory"):
            recover_log(path)
        held = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert held < 3 * MAX_RECORD_BYTES + small


def blocks_of(items: list[Item]) -> list[Block]:
    return [item for item in items if isinstance(item, Block) and item.stream == "meas"]


RUN = run()
ONE = blocks_of(RUN)[9]
SUMS = (1.0, 2.0)
LIES: dict[str, Item] = {
    "sampling rate": replace(ONE, rate_hz=1000.0),
    "channels are not those of the run": replace(ONE, channels=("drive_disp_m", "force_r1_n")),
    "duplicate samples": replace(ONE, index=ONE.index - 5),
    "invalid labels": replace(ONE, label=np.full(len(ONE), 77)),
    "unequal lengths": Comparison(180, 20, START.channels, SUMS, SUMS, (*SUMS, 3.0)),
    "negative sum": Comparison(180, 20, START.channels, SUMS, SUMS, (-1.0, 1.0)),
    "/rig/response: columns of unequal": FrequencyResponse(180, (1.0, 2.0), (1.0,), (0.0, 0.0)),
    "direction = 'sideways'": StepAdded(180, 3, "sideways", 2.0, 1.0, "x"),
    "frequency_hz = nan": StepAdded(180, 3, "forward", float("nan"), 1.0, "x"),
    "before the beginning": Fault(180, "twin", 100, 50, "x"),
}  # fmt: skip


@pytest.mark.parametrize("words", LIES)
def test_invalid_records_are_left_out_and_listed_as_damage(words: str, tmp_path: Path) -> None:
    lie = LIES[words]
    items = [item for item in RUN if item is not ONE or not isinstance(lie, Block)]
    messages = [
        (topic_for(item), encode_item(item, START.run), item.index) for item in [*items, lie]
    ]
    recording = read_recording(write_messages(tmp_path / "lie.mcap", messages, START))
    left = [
        item
        for item in items
        if not (
            isinstance(lie, Block) and encode_item(item, START.run) == encode_item(ONE, START.run)
        )
    ]
    assert sorted(payloads(recording.items)) == sorted(payloads(left))
    assert not recording.is_intact
    assert any(words in damage.reason for damage in recording.damage), recording.damage


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"rate_hz": float("nan")}, "rate_hz = nan"),
        ({"rate_hz": -2000.0}, "rate_hz = -2000"),
        ({"channels": ("a", "a")}, "duplicate channels"),
        ({"block_samples": 0}, "block_samples = 0"),
        ({"planned_samples": 2**52}, "planned_samples"),
        ({"steps": (Step(0, "up", 2.0, 0.5),)}, "invalid steps"),
        ({"steps": (Step(0, "forward", float("inf"), 0.5),)}, "invalid steps"),
        ({"steps": (Step(1, "forward", 2.0, 0.5), Step(0, "forward", 3.0, 0.5))}, "out of order"),
    ],
)
def test_invalid_start_record_is_refused(
    changed: dict[str, Any], words: str, tmp_path: Path
) -> None:
    start = replace(START, **changed)
    path = tmp_path / "run.mcap"
    write_messages(
        path, [("/run/start", encode_item(start, start.run), 0)], replace(start, rate_hz=2000.0)
    )
    stripped = [span for span in spans(path.read_bytes()) if span[0] != 9]  # without its copy
    raw = path.read_bytes()
    path.write_bytes(MAGIC + b"".join(raw[first:end] for _, first, end in stripped) + MAGIC)
    with raises_input_error(where=path, problem=words):
        read_recording(path)


def test_messages_of_another_run_are_left_out(tmp_path: Path) -> None:
    stop = RunStop(600, "complete", "x", ())
    messages = [(topic_for(item), encode_item(item, START.run), item.index) for item in run()]
    path = write_messages(
        tmp_path / "a.mcap", [*messages, ("/run/stop", encode_item(stop, "other"), 600)], START
    )
    recording = read_recording(path)
    assert payloads([recording.stop] if recording.stop else []) == payloads(run()[-1:])
    assert [damage.reason for damage in recording.damage] == ["/run/stop: of another run"]


def test_only_the_topics_asked_for_are_read(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    recording = read_recording(tmp_path / "a.mcap", ["/rig/gap"])
    wanted = [item for item in run() if topic_for(item) in ("/rig/gap", "/run/start")]
    assert sorted(payloads(recording.items)) == sorted(payloads(wanted))
    assert recording.is_intact


def test_wrong_checksum_of_the_data_is_damage(content: bytes, tmp_path: Path) -> None:
    first, end = next((first, end) for opcode, first, end in spans(content) if opcode == 15)
    assert end - first == RECORD_HEADER.size + 4
    wrong = struct.pack("<I", zlib.crc32(b"another"))
    assert recover_payloads(
        tmp_path / "a.mcap", content[: end - 4] + wrong + content[end:]
    ) == payloads(run())
    (damage,) = recover_log(tmp_path / "a.mcap").damage
    assert "the data differ" in damage.reason


def test_collection_resumes_after_the_outermost_pause() -> None:
    assert gc.isenabled()
    with pause_collection():
        with pause_collection():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled()


def test_an_error_ends_the_pause_of_collection() -> None:
    with pytest.raises(ValueError, match="inside"), pause_collection():
        raise ValueError("inside")
    assert gc.isenabled()
