"""Recovery of all readable messages from a damaged MCAP file, with bounded memory.

Invalid records are skipped. Reading resumes after a damaged chunk at the next valid chunk, at the
latest at the end that it declares, and after other damage at the next valid record. Work and memory
are limited from the start.

The parser follows the specification (mcap.dev/spec): a record is an opcode (1 byte), the length of
its content (8 bytes) and the content. Numbers are little-endian; a string is preceded by its length
(4 bytes). Messages are in compressed chunks, each with a checksum.
"""

import gc
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

import lz4.frame
import numpy as np
import zstandard

from table_io.errors import InputError

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
UNFINISHED_REASON = "the file was never finished: its recorder was killed, or still writes"
# Searched at once for the next record: little at first, since it may be near after each of many
# damaged places, then twice as much each time.
MIN_SEARCH_WINDOW_BYTES, MAX_SEARCH_WINDOW_BYTES = 2**10, 2**20
UNNAMED_TOPIC_PREFIX = "?"  # placeholder topic of messages whose channel record is lost
# Limits for untrusted files (decompression bombs). Work is in bytes read again or decompressed and
# proportional to the file size, so that long recordings are accepted: a valid recording of constant
# channels decompresses to about 60 times its size. A file beyond the memory limit is refused, not
# reported as damaged.
WORK_PER_BYTE, MIN_WORK_BYTES = 250, 256 * 2**20
WORK_PER_RECORD = 512  # minimum cost of a record
ENTRY_OVERHEAD_BYTES = 400  # memory of a message or damage entry in addition to its payload
DEFAULT_MEMORY_BYTES = 4 * 2**30
UINT32, UINT64 = struct.Struct("<I"), struct.Struct("<Q")


def ends_whole(path: Path) -> bool:
    """Return whether a recording has the end that is written when it is closed."""
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - len(MAGIC), 0))
        return file.read() == MAGIC


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


class LogMessage(NamedTuple):
    """Encoded message of a log; times in ns, `sequence` counts within the topic."""

    topic: str
    log_time: int
    payload: bytes
    sequence: int = 0
    publish_time: int = 0


@dataclass(frozen=True, slots=True)
class Damage:
    """Unreadable range of a file: `size` bytes from byte `offset`, and the reason."""

    offset: int
    size: int
    reason: str


@dataclass(slots=True)
class RecoveredLog:
    """Readable content of a file; `is_intact` if it is finished and every checksum matches."""

    messages: list[LogMessage] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    damage: list[Damage] = field(default_factory=list)
    topics: frozenset[str] = frozenset()  # of all messages, wanted or not
    is_intact: bool = False


@contextmanager
def pause_collection() -> Iterator[None]:
    """Pause the collection of reference cycles, which would visit all that was made many times."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def measure_log(path: Path) -> int:
    """Return the size of the content of a log in bytes, decompressed, up to the first damage."""
    with suppress(OSError), path.open("rb") as file:
        return _Scanner(file, file.seek(0, 2), None).measure()
    return 0


@pause_collection()
def recover_log(
    path: Path,
    topics: frozenset[str] | None = None,
    handle: Callable[[list[LogMessage]], None] | None = None,
) -> RecoveredLog:
    """Recover the readable content of `path`, only of `topics` if given.

    Messages go to `handle`, some at a time, as they are read: in the result are only those whose
    topic was unknown then. Raises InputError if it is not an MCAP file, or does not fit into
    memory.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            scanner = _Scanner(file, size, topics, handle)
            if not scanner.is_mcap():
                raise InputError(
                    "not an MCAP file", where=path, remedy="give the run.mcap of a run"
                )
            return scanner.run()
    except OSError as error:
        raise InputError(
            f"cannot read this log: {error.strerror}",
            where=path,
            remedy="give a run.mcap or the folder of a run",
        ) from None
    except MemoryError:
        raise InputError(
            "needs more memory than is available",
            where=path,
            remedy="read it on a computer with more memory",
        ) from None


@dataclass(slots=True)
class _Scanner:
    """Scanner state of one pass through a file."""

    file: BinaryIO
    size: int
    wanted_topics: frozenset[str] | None
    handle: Callable[[list[LogMessage]], None] | None = None
    recovered: RecoveredLog = field(default_factory=RecoveredLog)
    topic_by_channel: dict[int, str] = field(default_factory=dict)
    skipped_channels: set[int] = field(default_factory=set)  # of unwanted topics
    unnamed_channels: set[int] = field(default_factory=set)  # of messages before their channel
    crc: int = 0  # since the start, or since the end of the data section
    remaining_work: int = 0
    remaining_memory: int = 0  # bytes

    def is_mcap(self) -> bool:
        """Detect an MCAP file by its leading or trailing magic, or by its header record."""
        start = self._read_at(0, len(MAGIC) + RECORD_HEADER.size)
        end = self._read_at(self.size - len(MAGIC))
        if MAGIC.startswith(start[: len(MAGIC)]) or end == MAGIC:
            return True
        return len(start) == 17 and start[8] == HEADER and UINT64.unpack_from(start, 9)[0] < 1000

    def measure(self) -> int:
        """Return the size of the records up to the first damage in bytes, of chunks decompressed.

        No more than may be read.
        """
        offset, size = len(MAGIC), 0
        with suppress(InvalidRecordError):
            while True:
                opcode, length = self._read_header(offset)
                offset += RECORD_HEADER.size
                size += (
                    read_uncompressed_size(self._read_at(offset, CHUNK_HEADER.size))
                    if opcode == CHUNK
                    else length
                )
                offset += length
        return min(size, work_limit(self.size))

    def run(self) -> RecoveredLog:
        """Read the file to its end, skipping damage."""
        self.remaining_work, self.remaining_memory = work_limit(self.size), memory_limit_bytes()
        self.crc, after_footer = zlib.crc32(MAGIC), False
        offset = len(MAGIC)
        if self._read_at(0, offset) != MAGIC:
            self._note_damage(0, min(offset, self.size), "not the beginning of an MCAP file")
        while offset < self.size:
            if after_footer and self._read_at(offset) == MAGIC:
                self.recovered.is_intact = (
                    not self.recovered.damage and offset + len(MAGIC) == self.size
                )
                offset += len(MAGIC)
                continue
            try:
                opcode, content = self._read_record(offset)
                self._process_record(opcode, content, offset)
                after_footer = opcode == FOOTER
                offset += RECORD_HEADER.size + len(content)
            except InvalidRecordError as error:
                after_footer, end = False, self._find_next_record(offset)
                self._note_damage(offset, end - offset, str(error))
                offset = end
            if self.remaining_work < 0:
                self._note_damage(
                    offset, self.size - offset, "decompresses to more than any recording"
                )
                break
        if not self.recovered.is_intact and not self.recovered.damage:
            self._note_damage(self.size, 0, UNFINISHED_REASON)
        self._assign_topics()
        return self.recovered

    def _read_at(self, offset: int, count: int = len(MAGIC)) -> bytes:
        """Read bytes of the file; zeros, which are no record, where the disk fails."""
        try:
            self.file.seek(max(offset, 0))
            return self.file.read(count)
        except OSError:
            return bytes(min(count, self.size - offset))

    def _reserve_memory(self, size: int, entries: int = 1) -> None:
        self.remaining_memory -= ENTRY_OVERHEAD_BYTES * entries + size
        if self.remaining_memory < 0:
            raise MemoryError

    def _note_damage(self, offset: int, size: int, reason: str) -> None:
        self._reserve_memory(0)
        self.recovered.damage.append(Damage(offset, size, reason))

    def _read_header(self, offset: int) -> tuple[int, int]:
        """Read (opcode, content length) at byte `offset`; raise InvalidRecordError if invalid."""
        header = self._read_at(offset, RECORD_HEADER.size)
        if len(header) < RECORD_HEADER.size:
            raise InvalidRecordError("cut off within a record")
        opcode, length = RECORD_HEADER.unpack(header)
        if opcode not in MIN_RECORD_LENGTHS:
            raise InvalidRecordError("not a record")
        if length > self.size - offset - RECORD_HEADER.size:
            raise InvalidRecordError("a record that ends beyond the file")
        min_length = MIN_RECORD_LENGTHS[opcode]
        if (
            length > MAX_RECORD_BYTES
            or length < min_length
            or (opcode in FIXED_LENGTH_OPCODES and length != min_length)
        ):
            raise InvalidRecordError("a record of impossible length")
        return opcode, length

    def _read_record(self, offset: int) -> tuple[int, bytes]:
        """Read (opcode, content) of the record at byte `offset`."""
        opcode, length = self._read_header(offset)
        self.remaining_work -= max(WORK_PER_RECORD, length // 16)
        content = self._read_at(offset + RECORD_HEADER.size, length)
        if len(content) < length:
            raise InvalidRecordError("the file shrinks while it is read")
        return opcode, content

    def _process_record(self, opcode: int, content: bytes, offset: int) -> None:
        """Parse a record and keep its content; raise InvalidRecordError if it is damaged."""
        previous_crc = self.crc
        self.crc = zlib.crc32(
            content, zlib.crc32(RECORD_HEADER.pack(opcode, len(content)), previous_crc)
        )
        if opcode == CHUNK:
            self._add(self._parse_messages(self._decompress(content)))
        elif opcode == DATA_END:
            self._check_crc(
                content, previous_crc, offset, "the data differ from those that were written"
            )
            self.crc = 0
        elif opcode == FOOTER:
            summary = RECORD_HEADER.pack(opcode, len(content)) + content[:-4]
            crc = zlib.crc32(summary, previous_crc)
            self._check_crc(content, crc, offset, "the summary differs from that written")
        elif opcode == ATTACHMENT:
            name, data = parse_attachment(content)
            self._reserve_memory(len(content))
            self.recovered.attachments.setdefault(name, data)
        elif opcode == METADATA:
            name, end = parse_string(content, 0)
            self._reserve_memory(16 * len(content))  # pairs of short strings
            self.recovered.metadata.setdefault(name, parse_string_map(content, end))
        else:
            self._add(self._parse_messages(RECORD_HEADER.pack(opcode, len(content)) + content))

    def _add(self, messages: list[LogMessage]) -> None:
        """Hand messages over, or keep them; those whose channel record is yet to come are kept."""
        if self.handle is not None and messages:
            unnamed = {f"{UNNAMED_TOPIC_PREFIX}{number}" for number in self.unnamed_channels}
            self.handle([message for message in messages if message.topic not in unnamed])
            messages = [message for message in messages if message.topic in unnamed]
        self.recovered.messages += messages

    def _check_crc(self, content: bytes, crc: int, offset: int, reason: str) -> None:
        """Record damage if the CRC at the end of `content` differs in an otherwise sound file."""
        if UINT32.unpack(content[-4:])[0] not in (0, crc) and not self.recovered.damage:
            self._note_damage(offset, 0, reason)

    def _parse_messages(self, data: bytes) -> list[LogMessage]:
        """Return the messages in a chunk and register its channels."""
        messages: list[LogMessage] = []
        max_records = self.remaining_work // WORK_PER_RECORD
        topics, skipped, size = self.topic_by_channel, self.skipped_channels, MESSAGE_HEADER.size
        count = kept_bytes = 0
        for count, (opcode, begin, end) in enumerate(iter_records(data), 1):
            if count > max_records:
                break
            if opcode == MESSAGE:
                channel, sequence, time, published = MESSAGE_HEADER.unpack_from(data, begin)
                if channel in skipped:
                    continue
                if (topic := topics.get(channel)) is None:
                    topic = f"{UNNAMED_TOPIC_PREFIX}{channel}"
                    self.unnamed_channels.add(channel)
                payload = data[begin + size : end]
                messages.append(LogMessage(topic, time, payload, sequence, published))
                kept_bytes += end - begin
            elif opcode == CHANNEL:
                channel = int.from_bytes(data[begin : begin + 2], "little")
                if channel not in topics:
                    topics[channel] = parse_string(data[begin:end], 4)[0]
                    self._reserve_memory(end - begin)
                if self.wanted_topics is not None and topics[channel] not in self.wanted_topics:
                    skipped.add(channel)
        self.remaining_work -= WORK_PER_RECORD * count
        self._reserve_memory(kept_bytes, len(messages))
        return messages

    def _decompress(self, content: bytes) -> bytes:
        self.remaining_work -= read_uncompressed_size(content)
        return decompress_chunk(content)

    def _find_next_record(self, offset: int) -> int:
        """Return the offset at which reading resumes after damage at `offset`, or the file size.

        The messages in a damaged chunk may look like records of the file, but chunks never nest: a
        valid one within the declared range follows the damaged one, of which bytes were lost.
        """
        try:
            opcode, length = self._read_header(offset)
            end = offset + RECORD_HEADER.size + length
            if opcode == CHUNK and (end == self.size or self._read_header(end)[0]):
                return self._search_record(offset + 1, end, frozenset((CHUNK,)))
        except InvalidRecordError:
            pass
        return self._search_record(offset + 1, self.size, frozenset(MIN_RECORD_LENGTHS))

    def _search_record(self, offset: int, end: int, opcodes: frozenset[int]) -> int:
        """Return the offset of the first valid record in `offset` to `end`, or `end`."""
        window_bytes = MIN_SEARCH_WINDOW_BYTES
        while offset < end and self.remaining_work >= 0:
            count = min(window_bytes, end - offset)
            window = self._read_at(offset, count + RECORD_HEADER.size - 1)
            for candidate in find_record_candidates(window):
                if window[candidate] in opcodes and self._is_valid_record(offset + candidate):
                    return offset + candidate
            offset += count
            window_bytes = min(2 * window_bytes, MAX_SEARCH_WINDOW_BYTES)
        return end

    def _is_valid_record(self, offset: int) -> bool:
        """Check for a valid record at `offset`, followed by another one or the end of the file."""
        self.remaining_work -= WORK_PER_RECORD
        try:
            opcode, length = self._read_header(offset)
            next_offset = offset + RECORD_HEADER.size + length
            if opcode != FOOTER and next_offset != self.size:
                self._read_header(next_offset)
            self.remaining_work -= length
            content = self._read_record(offset)[1]
            if opcode == CHUNK:
                self._decompress(content)
            elif opcode == ATTACHMENT:
                parse_attachment(content)
            elif opcode == METADATA:
                parse_string_map(content, parse_string(content, 0)[1])
            elif opcode == MESSAGE_INDEX:
                return UINT32.unpack_from(content, 2)[0] == length - 6 and length % 16 == 6
        except InvalidRecordError:
            return False
        return self.remaining_work >= 0

    def _assign_topics(self) -> None:
        """Set the topic of each message; its channel record may be anywhere in the file."""
        topics = self.topic_by_channel
        if unnamed := {f"{UNNAMED_TOPIC_PREFIX}{n}": n for n in self.unnamed_channels}:
            self.recovered.is_intact &= self.unnamed_channels <= topics.keys()
            for name, channel in unnamed.items():
                topics.setdefault(channel, name)
            self.recovered.messages = [
                message._replace(topic=topics.get(unnamed.get(message.topic, -1), message.topic))
                for message in self.recovered.messages
                if unnamed.get(message.topic) not in self.skipped_channels
            ]
        self.recovered.topics = frozenset(topics.values())


def work_limit(size: int) -> int:
    """Return the work allowed for reading a file of `size` bytes, in bytes."""
    return max(MIN_WORK_BYTES, WORK_PER_BYTE * size)


def memory_limit_bytes() -> int:
    """Return the memory allowed for the content of a file, in bytes: half of the physical memory.

    The other half is for evaluating it. Total memory counts, not free memory: the system releases
    its file cache on demand.
    """
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") // 2
    except (AttributeError, ValueError, OSError):  # unknown on this system
        return DEFAULT_MEMORY_BYTES
