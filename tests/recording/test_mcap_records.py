"""Parser of MCAP records: what was packed by the specification comes back, any cut is refused."""

import random
import struct
import zlib
from collections.abc import Callable

import lz4.frame
import pytest
import zstandard

from twin.recording import recovery
from twin.recording.recovery import (
    MIN_RECORD_LENGTHS,
    InvalidRecordError,
    decompress_chunk,
    find_record_candidates,
    iter_records,
    parse_attachment,
    parse_string,
    parse_string_map,
    read_uncompressed_size,
)

TEXTS = ("", "a", "Größe", "x" * 300)
PLAIN = bytes(range(200)) * 3
COMPRESSORS: dict[str, Callable[[bytes], bytes]] = {
    "": bytes, "lz4": lz4.frame.compress, "zstd": zstandard.ZstdCompressor().compress,
}  # fmt: skip


def pack_text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def pack_chunk(compression: str, plain: bytes = PLAIN, *, size: int | None = None,
               crc: int | None = None) -> bytes:  # fmt: skip
    """Content of a chunk: times, uncompressed size, checksum, compression, length, records."""
    compressed = COMPRESSORS[compression](plain)
    head = struct.pack(
        "<QQQI", 5, 6, len(plain) if size is None else size,
        zlib.crc32(plain) if crc is None else crc,
    )  # fmt: skip
    return head + pack_text(compression) + struct.pack("<Q", len(compressed)) + compressed


def pack_attachment(name: str, content: bytes, *, checks: bool = True) -> bytes:
    head = struct.pack("<QQ", 1, 2) + pack_text(name) + pack_text("text/plain")
    body = head + struct.pack("<Q", len(content)) + content
    return body + struct.pack("<I", zlib.crc32(body) if checks else 0)


@pytest.mark.parametrize("offset", [0, 3])
@pytest.mark.parametrize("text", TEXTS)
def test_a_text_comes_back_and_half_of_it_is_refused(text: str, offset: int) -> None:
    packed = bytes(offset) + pack_text(text)
    assert parse_string(packed + b"more", offset) == (text, len(packed))
    assert parse_string(packed, offset) == (text, len(packed))
    for size in range(offset, len(packed)):
        with pytest.raises(InvalidRecordError):
            parse_string(packed[:size], offset)
    with pytest.raises(InvalidRecordError):
        parse_string(struct.pack("<I", 1) + b"\xff", 0)


@pytest.mark.parametrize("count", range(5))
def test_a_map_comes_back_and_one_of_another_length_is_refused(count: int) -> None:
    values = {text + "k": text for text in TEXTS[:count]}
    pairs = b"".join(pack_text(key) + pack_text(value) for key, value in values.items())
    packed = b"head" + struct.pack("<I", len(pairs)) + pairs
    assert parse_string_map(packed, 4) == values
    for damaged in (packed + b"x", *(packed[:size] for size in range(4, len(packed)))):
        with pytest.raises(InvalidRecordError):
            parse_string_map(damaged, 4)


@pytest.mark.parametrize("checks", [True, False])
@pytest.mark.parametrize("content", [b"", b"1", bytes(50)])
def test_an_attachment_comes_back_and_a_damaged_one_is_refused(
    content: bytes, checks: bool
) -> None:
    packed = pack_attachment("start", content, checks=checks)
    assert parse_attachment(packed) == ("start", content)
    for damaged in (packed + b"x", *(packed[:size] for size in range(16, len(packed)))):
        with pytest.raises(InvalidRecordError):
            parse_attachment(damaged)
    changed = bytes([packed[0] ^ 1]) + packed[1:]  # in its time
    if checks:
        with pytest.raises(InvalidRecordError):
            parse_attachment(changed)
    else:
        assert parse_attachment(changed) == ("start", content)


@pytest.mark.parametrize("compression", COMPRESSORS)
def test_a_chunk_comes_back_and_a_damaged_one_is_refused(compression: str) -> None:
    packed = pack_chunk(compression)
    assert decompress_chunk(packed) == PLAIN
    assert decompress_chunk(pack_chunk(compression, crc=0)) == PLAIN  # 0: not stated
    assert read_uncompressed_size(packed) == len(PLAIN)
    damaged = [packed + b"x", *(packed[:size] for size in range(28, len(packed)))]
    damaged += [pack_chunk(compression, crc=1)]
    damaged += [pack_chunk(compression, size=len(PLAIN) + more) for more in (-1, 1, -len(PLAIN))]
    for content in damaged:
        with pytest.raises(InvalidRecordError):
            decompress_chunk(content)


@pytest.mark.parametrize("plain", [b"", b"1"])
@pytest.mark.parametrize("compression", COMPRESSORS)
def test_the_smallest_chunks_come_back(compression: str, plain: bytes) -> None:
    assert decompress_chunk(pack_chunk(compression, plain)) == plain


def test_a_chunk_need_not_state_its_size_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    compressor = zstandard.ZstdCompressor(write_content_size=False)
    monkeypatch.setitem(COMPRESSORS, "zstd", compressor.compress)
    assert decompress_chunk(pack_chunk("zstd")) == PLAIN


def test_a_chunk_of_unknown_compression_is_refused() -> None:
    packed = pack_chunk("lz4").replace(b"lz4", b"lz5")
    with pytest.raises(InvalidRecordError):
        decompress_chunk(packed)


@pytest.mark.parametrize("past", [-1, 0, 1])
def test_a_chunk_has_a_largest_size(past: int) -> None:
    packed = pack_chunk("zstd", size=64 * 2**20 + past)
    if past <= 0:
        assert read_uncompressed_size(packed) == 64 * 2**20 + past
    else:
        with pytest.raises(InvalidRecordError):
            read_uncompressed_size(packed)


@pytest.mark.parametrize("opcode", [*MIN_RECORD_LENGTHS, 16, 200])
@pytest.mark.parametrize("extra", [0, 1, 30])
def test_records_are_found_at_their_bytes_and_half_of_one_is_refused(
    opcode: int, extra: int
) -> None:
    least = MIN_RECORD_LENGTHS.get(opcode, 0)
    lengths = (least + extra, least, least + 2 * extra)
    packed, expected = b"", []
    for length in lengths:
        expected.append((opcode, len(packed) + 9, len(packed) + 9 + length))
        packed += struct.pack("<BQ", opcode, length) + bytes(length)
    assert list(iter_records(packed)) == expected
    ends = {0, *(end for _, _, end in expected)}
    for size in range(len(packed)):
        if size in ends:
            assert list(iter_records(packed[:size])) == expected[: sorted(ends).index(size)]
        else:
            with pytest.raises(InvalidRecordError):
                list(iter_records(packed[:size]))
    if least:
        with pytest.raises(InvalidRecordError):
            list(iter_records(struct.pack("<BQ", opcode, least - 1) + bytes(least - 1)))


def test_the_least_lengths_are_those_of_records_without_content() -> None:
    """By the specification: fixed fields, and 4 bytes for the length of each text or map."""
    formats = {
        "HEADER": "II", "FOOTER": "QQI", "SCHEMA": "HIII", "CHANNEL": "HHIII", "MESSAGE": "HIQQ",
        "CHUNK": "QQQIIQ", "MESSAGE_INDEX": "HI", "CHUNK_INDEX": "QQQQIQIQQ",
        "ATTACHMENT": "QQIIQI", "ATTACHMENT_INDEX": "QQQQQII", "STATISTICS": "QHIIIIQQI",
        "METADATA": "II", "METADATA_INDEX": "QQI", "SUMMARY_OFFSET": "BQQ", "DATA_END": "I",
    }  # fmt: skip
    opcodes = [getattr(recovery, name) for name in formats]
    assert opcodes == list(range(1, 16))
    least = {getattr(recovery, name): struct.calcsize(f"<{text}") for name, text in
             formats.items()}  # fmt: skip
    assert least == MIN_RECORD_LENGTHS


@pytest.mark.parametrize("seed", range(5))
def test_candidates_are_all_that_may_be_a_header(seed: int) -> None:
    chance = random.Random(seed)
    size = chance.choice([0, 5, 8, 9, 10, 400])
    window = bytes(chance.choice([0, 0, 0, 0, 0, 1, 15, 16, 255]) for _ in range(size))
    expected = []
    for place in range(size - 8):
        opcode, length = struct.unpack_from("<BQ", window, place)
        expected += [place] if 1 <= opcode <= 15 and length < 2**32 else []
    assert find_record_candidates(window) == expected


def test_candidates_at_both_ends_of_a_window() -> None:
    header = struct.pack("<BQ", 15, 2**32 - 1)
    for before in (b"", b"\xff" * 9):
        assert find_record_candidates(before + header) == [len(before)]
        assert find_record_candidates(before + header[:-1]) == []
    for opcode, length in ((0, 5), (16, 5), (1, 2**32)):
        assert find_record_candidates(struct.pack("<BQ", opcode, length)) == []
