"""Parser of MCAP records with validation of untrusted bytes.

Follows the specification (mcap.dev/spec): a record is an opcode (1 byte), the length of its content
(8 bytes) and the content. Numbers are little-endian; a string is preceded by its length (4 bytes).
Messages are in compressed chunks, each with a checksum.
"""

import struct
import zlib
from collections.abc import Iterator

import lz4.frame
import numpy as np
import zstandard

MAGIC = b"\x89MCAP0\r\n"
MAX_RECORD_BYTES = 64 * 2**20  # compressed or not; records of LogWriter have about 1 MiB
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
CHUNK_INDEX, ATTACHMENT, ATTACHMENT_INDEX, STATISTICS, METADATA = range(8, 13)
METADATA_INDEX, SUMMARY_OFFSET, DATA_END = range(13, 16)
MIN_RECORD_LENGTHS = {
    HEADER: 8, FOOTER: 20, SCHEMA: 14, CHANNEL: 16, MESSAGE: 22, CHUNK: 40, MESSAGE_INDEX: 6,
    CHUNK_INDEX: 64, ATTACHMENT: 36, ATTACHMENT_INDEX: 48, STATISTICS: 46, METADATA: 8,
    METADATA_INDEX: 20, SUMMARY_OFFSET: 17, DATA_END: 4,
}  # fmt: skip
FIXED_LENGTH_OPCODES = (FOOTER, SUMMARY_OFFSET, DATA_END)  # the minimum length is their length
RECORD_HEADER = struct.Struct("<BQ")  # opcode, length
MESSAGE_HEADER = struct.Struct("<HIQQ")  # channel, sequence, log and publish time in ns
CHUNK_HEADER = struct.Struct("<QQQI")  # first and last log time, uncompressed size, checksum
UINT32, UINT64 = struct.Struct("<I"), struct.Struct("<Q")


class InvalidRecordError(ValueError):
    """Bytes that are not a valid MCAP record."""


def read_uncompressed_size(content: bytes) -> int:
    """Return the declared uncompressed size of a chunk in bytes; raise if it is too large."""
    size = int(CHUNK_HEADER.unpack_from(content)[2])
    if size > MAX_RECORD_BYTES:
        raise InvalidRecordError("a chunk that decompresses to too many bytes")
    return size


def decompress_chunk(content: bytes) -> bytes:
    """Return the decompressed records of a chunk; raise InvalidRecordError if it is damaged."""
    size, crc = read_uncompressed_size(content), CHUNK_HEADER.unpack_from(content)[3]
    compression, offset = parse_string(content, CHUNK_HEADER.size)
    if (
        offset + 8 > len(content)
        or UINT64.unpack_from(content, offset)[0] != len(content) - offset - 8
    ):
        raise InvalidRecordError("a chunk of the wrong length")
    try:
        data = _decompress(compression, content[offset + 8 :], size)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise InvalidRecordError(f"a chunk that does not decompress: {error}") from None
    if len(data) != size or crc not in (0, zlib.crc32(data)):
        raise InvalidRecordError("a chunk with a wrong checksum")
    return data


def iter_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, first byte of the content, end of the content) of each record in a chunk."""
    offset, size = 0, len(data)
    while offset < size:
        if offset + RECORD_HEADER.size > size:
            raise InvalidRecordError("a chunk with half a record")
        opcode, length = RECORD_HEADER.unpack_from(data, offset)
        begin, offset = offset + RECORD_HEADER.size, offset + RECORD_HEADER.size + length
        if offset > size or length < MIN_RECORD_LENGTHS.get(opcode, 0):
            raise InvalidRecordError("a chunk with half a record")
        yield opcode, begin, offset


def find_record_candidates(window: bytes) -> list[int]:
    """Return the offsets in `window` that may be record headers; most are false positives."""
    window_bytes = np.frombuffer(window, np.uint8)
    count = max(len(window_bytes) - RECORD_HEADER.size + 1, 0)
    is_candidate = (window_bytes[:count] > 0) & (window_bytes[:count] <= DATA_END)
    for byte in range(5, 9):  # upper length bytes: no record has 4 GiB
        is_candidate &= window_bytes[byte : byte + count] == 0
    return [int(place) for place in np.flatnonzero(is_candidate)]


def _decompress(compression: str, compressed: bytes, size: int) -> bytes:
    """Decompress at most about `size` bytes, whatever size the compressed data declare."""
    if compression == "zstd":
        if zstandard.frame_content_size(compressed) not in (size, -1):
            raise InvalidRecordError("a chunk that decompresses to another size")
        return zstandard.ZstdDecompressor().decompress(compressed, max_output_size=size)
    if compression == "lz4":
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(compressed, max_length=size + 1))
    if compression:
        raise InvalidRecordError(f"a chunk with unknown compression {compression[:20]!r}")
    return compressed


def parse_string(content: bytes, offset: int) -> tuple[str, int]:
    """Parse the string at `offset`; return (text, offset after it)."""
    if offset + 4 > len(content):
        raise InvalidRecordError("a record with half a text")
    end = offset + 4 + UINT32.unpack_from(content, offset)[0]
    if end > len(content):
        raise InvalidRecordError("a record with half a text")
    try:
        return content[offset + 4 : end].decode(), end
    except UnicodeDecodeError:
        raise InvalidRecordError("a record with a text that is not UTF-8") from None


def parse_string_map(content: bytes, offset: int) -> dict[str, str]:
    """Parse the map of strings at the end of a record."""
    if offset + 4 > len(content) or offset + 4 + UINT32.unpack_from(content, offset)[0] != len(
        content
    ):
        raise InvalidRecordError("a record of the wrong length")
    offset, values = offset + 4, {}
    while offset < len(content):
        key, offset = parse_string(content, offset)
        values[key], offset = parse_string(content, offset)
    return values


def parse_attachment(content: bytes) -> tuple[str, bytes]:
    """Parse an attachment; return (name, data)."""
    name, offset = parse_string(content, 16)
    offset = parse_string(content, offset)[1]
    if (
        offset + 12 > len(content)
        or UINT64.unpack_from(content, offset)[0] != len(content) - offset - 12
    ):
        raise InvalidRecordError("an attachment of the wrong length")
    if UINT32.unpack_from(content, len(content) - 4)[0] not in (0, zlib.crc32(content[:-4])):
        raise InvalidRecordError("an attachment with a wrong checksum")
    return name, content[offset + 8 : -4]
