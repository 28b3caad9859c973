"""The records of an MCAP file as bytes, checked before they are believed.

Follows the specification (mcap.dev/spec): a record is an opcode (1 byte), the length of its content
(8) and the content; numbers are little-endian, a text has its length (4) before it. Messages stand
in packed chunks with a checksum each.
"""

import struct
import zlib
from collections.abc import Iterator

import lz4.frame
import numpy as np
import zstandard

MAGIC = b"\x89MCAP0\r\n"
LARGEST_BYTES = 64 * 2**20  # of one record, packed or unpacked; ours are some 1 MiB
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA = range(8, 13)
METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(13, 16)
LEAST_LENGTHS = {
    HEADER: 8, FOOTER: 20, SCHEMA: 14, CHANNEL: 16, MESSAGE: 22, CHUNK: 40, MESSAGE_INDEX: 6,
    CHUNK_INDEX: 64, ATTACHMENT: 36, ATTACHMENT_INDEX: 48, STATISTICS: 46, METADATA: 8,
    METADATA_INDEX: 20, SUMMARY_OFFSET: 17, DATA_END: 4,
}  # fmt: skip
FIXED = (FOOTER, SUMMARY_OFFSET, DATA_END)  # that have no other length
FRAME = struct.Struct("<BQ")  # opcode, length
STAMP = struct.Struct("<HIQQ")  # of a message: channel, sequence, log and publish time in ns
BOUNDS = struct.Struct("<QQQI")  # of a chunk: first and last log time, unpacked size, checksum
WORD, LONG = struct.Struct("<I"), struct.Struct("<Q")


class NotARecordError(ValueError):
    """Bytes that are not the record they claim to be."""


def unpacked_size(content: bytes) -> int:
    """Bytes that a chunk says it unpacks to; NotARecordError where that is too much."""
    size = int(BOUNDS.unpack_from(content)[2])
    if size > LARGEST_BYTES:
        raise NotARecordError("a chunk that unpacks to too much")
    return size


def unpacked(content: bytes) -> bytes:
    """The records in a chunk; NotARecordError where it or its checksum is damaged."""
    size, crc = unpacked_size(content), BOUNDS.unpack_from(content)[3]
    packing, at = text(content, BOUNDS.size)
    if at + 8 > len(content) or LONG.unpack_from(content, at)[0] != len(content) - at - 8:
        raise NotARecordError("a chunk of the wrong length")
    try:
        data = _unpack(packing, content[at + 8 :], size)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise NotARecordError(f"a chunk that does not unpack: {error}") from None
    if len(data) != size or crc not in (0, zlib.crc32(data)):
        raise NotARecordError("a chunk with a wrong checksum")
    return data


def records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """(opcode, first byte of its content, the byte after it) of each record in a chunk."""
    at, size = 0, len(data)
    while at < size:
        if at + FRAME.size > size:
            raise NotARecordError("a chunk with half a record")
        opcode, length = FRAME.unpack_from(data, at)
        body, at = at + FRAME.size, at + FRAME.size + length
        if at > size or length < LEAST_LENGTHS.get(opcode, 0):
            raise NotARecordError("a chunk with half a record")
        yield opcode, body, at


def beginnings(window: bytes) -> list[int]:
    """Where in these bytes a whole frame stands that may be a record's; mostly it is none."""
    there = np.frombuffer(window, np.uint8)
    count = max(len(there) - FRAME.size + 1, 0)
    maybe = (there[:count] > 0) & (there[:count] <= DATA_END)
    for place in range(5, 9):  # no record is of 4 GiB
        maybe &= there[place : place + count] == 0
    return [int(place) for place in np.flatnonzero(maybe)]


def _unpack(packing: str, packed: bytes, size: int) -> bytes:
    """`size` bytes at the most; a packer that promises more is not believed."""
    if packing == "zstd":
        if zstandard.frame_content_size(packed) not in (size, -1):
            raise NotARecordError("a chunk that unpacks to another size")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    if packing == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1))
    if packing:
        raise NotARecordError(f"a chunk packed by {packing[:20]!r}")
    return packed


def text(content: bytes, at: int) -> tuple[str, int]:
    """(text at `at`, the byte after it)."""
    if at + 4 > len(content):
        raise NotARecordError("a record with half a text")
    end = at + 4 + WORD.unpack_from(content, at)[0]
    if end > len(content):
        raise NotARecordError("a record with half a text")
    try:
        return content[at + 4 : end].decode(), end
    except UnicodeDecodeError:
        raise NotARecordError("a record with a text that is none") from None


def mapping(content: bytes, at: int) -> dict[str, str]:
    """The texts by name with which a record ends."""
    if at + 4 > len(content) or at + 4 + WORD.unpack_from(content, at)[0] != len(content):
        raise NotARecordError("a record of the wrong length")
    at, values = at + 4, {}
    while at < len(content):
        key, at = text(content, at)
        values[key], at = text(content, at)
    return values


def attachment(content: bytes) -> tuple[str, bytes]:
    """(name, data) of an attachment."""
    name, at = text(content, 16)
    at = text(content, at)[1]
    if at + 12 > len(content) or LONG.unpack_from(content, at)[0] != len(content) - at - 12:
        raise NotARecordError("an attachment of the wrong length")
    if WORD.unpack_from(content, len(content) - 4)[0] not in (0, zlib.crc32(content[:-4])):
        raise NotARecordError("an attachment with a wrong checksum")
    return name, content[at + 8 : -4]
