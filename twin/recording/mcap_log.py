"""Writer and reader of the log: an MCAP file with the protobuf payloads of the bus.

`LOG.md` in this folder specifies the format. Profile, rig, model and calibration are written before
the first message, so that an interrupted recording is self-contained.
"""

import contextlib
import os
import sys
from collections.abc import Container, Iterator, Sequence
from itertools import chain, count
from pathlib import Path
from typing import BinaryIO

from mcap.writer import Writer

from table_io.block import Block
from table_io.clock import wall_clock_ns
from table_io.errors import InputError
from table_io.records import RunStart
from twin.recording import recovery
from twin.recording.log_metadata import (
    SCHEMA_VERSION,
    ContentHash,
    Metadata,
    build_attachments,
    hash_attachments,
    select_recorded,
)
from twin.recording.mcap_writer import McapWriter
from twin.recording.recovery import LogMessage, recover_log
from twin.transport.codec import (
    TOPIC_TYPES,
    Item,
    encode_item,
    message_schema,
    topic_for,
)

MEDIA_TYPES = {".toml": "toml", ".json": "json", ".pb": "protobuf"}
CHUNK_BYTES = 2**20  # uncompressed size at which a chunk is closed
MAX_LOG_TIME_NS = 2**64 - 1  # uint64 in MCAP
MAX_PENDING_BYTES = 2**20  # unwritten bytes between two flushes
WRITE_CHUNK_BYTES = 2**20  # to the disk at once


class AppendOnlyFile:
    """New file with a write buffer in memory, written by `drain`; refuses to overwrite a file.

    If the disk is full or fails, `drain` raises OSError with the path and keeps the unwritten
    bytes. Called again, it continues at the same byte, so no data are repeated or lost.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._size = 0
        self._pending = bytearray()
        self._copy: BinaryIO | None = None  # of a lost file, while it is written again
        try:
            self._descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            raise InputError(
                "exists already", where=path, remedy="nothing recorded is ever overwritten"
            ) from None
        except OSError as error:
            raise InputError(f"cannot write here: {error.strerror}", where=path) from None

    @property
    def pending_bytes(self) -> int:
        """Number of buffered bytes that are not in the file yet."""
        return len(self._pending)

    def write(self, data: bytes) -> None:
        """Append to the buffer."""
        self._pending += data
        self._size += len(data)

    def tell(self) -> int:
        """Return the number of bytes written so far, including the buffer."""
        return self._size

    def drain(self) -> None:
        """Write the buffer to the operating system."""
        try:
            while self._pending:
                written = os.write(self._descriptor, self._pending[:WRITE_CHUNK_BYTES])
                del self._pending[:written]
        except OSError as error:
            raise self._with_path(error) from None

    @property
    def is_lost(self) -> bool:
        """Whether the file, or its folder, was deleted or moved, and is not whole again."""
        is_deleted = os.fstat(self._descriptor).st_nlink == 0
        return is_deleted or self._copy is not None or not self.path.exists()

    def restore(self, max_bytes: int = sys.maxsize) -> bool:
        """Write a lost file again, at most so many bytes in one call; return True once it is whole.

        The open file still holds all data. A file that was moved gets its name back as a link. If
        another file has taken the place, `path` is a free name next to it. OSError if nothing can
        be written: a later call tries again.
        """
        try:
            if self._copy is None:
                self.path.parent.mkdir(parents=True, exist_ok=True)
                self.path = find_free_path(self.path)
                if self._link_again():
                    return True
                self._copy = self.path.open("xb")
            return self._continue_copy(max_bytes)
        except OSError as error:
            self._abandon_copy()
            raise self._with_path(error) from None

    def _link_again(self) -> bool:
        try:
            os.link(f"/proc/self/fd/{self._descriptor}", self.path, follow_symlinks=True)
        except OSError:  # deleted, or on another disk
            return False
        return True

    def _continue_copy(self, max_bytes: int) -> bool:
        """Copy on; once all is copied, the descriptor becomes that of the new file."""
        assert self._copy is not None
        with Path(f"/proc/self/fd/{self._descriptor}").open("rb") as lost:
            lost.seek(self._copy.tell())
            while max_bytes > 0 and (data := lost.read(min(max_bytes, WRITE_CHUNK_BYTES))):
                self._copy.write(data)
                max_bytes -= len(data)
        self._copy.flush()
        if max_bytes <= 0:
            return False
        os.dup2(self._copy.fileno(), self._descriptor, inheritable=False)
        self._copy.close()
        self._copy = None
        return True

    def _abandon_copy(self) -> None:
        if self._copy is not None:
            copy, self._copy = self._copy, None
            with contextlib.suppress(OSError):
                self.path.unlink()
            with contextlib.suppress(OSError):  # its buffer may not fit either
                copy.close()

    def sync(self) -> None:
        """Wait until drained data are on the disk (fsync)."""
        try:
            os.fsync(self._descriptor)
        except OSError as error:
            raise self._with_path(error) from None

    def close(self) -> None:
        """Drain and close; may be called again, also after an OSError.

        A lost file is written again.
        """
        self.drain()
        if self._descriptor >= 0:
            if self.is_lost:
                self.restore()
            os.close(self._descriptor)
            self._descriptor = -1

    def _with_path(self, error: OSError) -> OSError:
        return OSError(error.errno, error.strerror, str(self.path))


def find_free_path(path: Path) -> Path:
    """Return `path`, or the first of <stem>-2, <stem>-3, ... that does not exist."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in count(2))
    return next(candidate for candidate in chain([path], numbered) if not candidate.exists())


class LogTimeError(ValueError):
    """Sample index whose log time exceeds the range of the format."""


class LogWriter:
    """Writer of items to a new MCAP file; refuses to overwrite a file.

    A method that raises OSError (disk full or failing) may be called again; no data are lost.
    """

    def __init__(self, path: Path, rate_hz: float, chunk_bytes: int = CHUNK_BYTES) -> None:
        self._rate_hz = rate_hz
        self._file = AppendOnlyFile(path)
        self._writer = McapWriter(self._file.write, chunk_bytes)
        self._channels: dict[str, int] = {}
        self._content = ContentHash()
        self._start: RunStart | None = None
        self._finished = False

    @property
    def path(self) -> Path:
        """Path of the file; another one than asked for if it was lost and its place taken."""
        return self._file.path

    @property
    def size(self) -> int:
        """Size in bytes, including data not yet written to the disk."""
        return self._file.tell()

    def select_recorded(self, item: Item) -> Sequence[Item]:
        """Return what is recorded of an item: itself, of a predicted block perhaps only parts."""
        if isinstance(item, Block) and self._start is not None:
            return select_recorded(item, self._start)
        return (item,)

    def write_item(self, topic: str, item: Item, run: str, payload: bytes = b"") -> None:
        """Write what is recorded of an item; `payload` is its encoding, where there is one."""
        for part in self.select_recorded(item):
            data = payload if payload and part is item else encode_item(part, run)
            self.write(topic, data, part.index)

    def write(
        self, topic: str, payload: bytes, index: int, publish_time: int | None = None
    ) -> None:
        """Append the payload of an item at sample `index`; `publish_time` is wall-clock time in ns.

        Raises LogTimeError, and writes nothing, if the log time exceeds the range of the format.
        """
        self.write_all(topic, [payload], [index], publish_time)

    def write_all(
        self,
        topic: str,
        payloads: Sequence[bytes],
        indices: Sequence[int],
        publish_time: int | None = None,
    ) -> None:
        """Append the payloads of items of one topic, as `write` does one."""
        times = [round(index * 1e9 / self._rate_hz) for index in indices]
        if times and max(times) > MAX_LOG_TIME_NS:
            raise LogTimeError(f"sample {max(indices)}: its time exceeds the range of a log")
        if topic not in self._channels:
            schema = message_schema(TOPIC_TYPES[topic])
            self._channels[topic] = self._writer.add_channel(topic, *schema)
        first = self._content.add_all(topic, times, payloads)
        time_ns = wall_clock_ns() if publish_time is None else publish_time
        self._writer.add_messages(self._channels[topic], first, times, time_ns, payloads)
        if self._file.pending_bytes > MAX_PENDING_BYTES:
            self._file.drain()

    def write_run_description(self, start: RunStart) -> None:
        """Write metadata and attachments of the run; call it before the first message."""
        self._start = start
        texts = build_attachments(start)
        run_metadata = {"id": start.run, "schema": str(SCHEMA_VERSION), "host": start.host}
        self.write_metadata(
            "run", {**run_metadata, "started_at": start.started_at, **start.versions}
        )
        self.write_metadata("attachments", hash_attachments(texts))
        for name, data in texts.items():
            media = f"application/{MEDIA_TYPES[Path(name).suffix]}"
            self._writer.add_attachment(wall_clock_ns(), name, media, data)

    def write_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record."""
        self._writer.add_metadata(name, values)

    def flush(self) -> None:
        """Close the chunk and write it, so that its data survive a crash of this process."""
        self._writer.close_chunk()
        self._file.drain()

    @property
    def is_lost(self) -> bool:
        """Whether the file was deleted or moved, and is not whole again."""
        return self._file.is_lost

    def restore(self, max_bytes: int) -> bool:
        """Write a lost file again, at most so many bytes at once; return True once it is whole."""
        return self._file.restore(max_bytes)

    def sync(self) -> None:
        """Wait until flushed data are on the disk, so that they survive a power failure."""
        self._file.sync()

    def close(self) -> None:
        """Finish the file with its content hash and close it; may be called again."""
        if not self._finished:
            self._finished = True
            self._writer.close_chunk()
            self.write_metadata("content", self._content.to_metadata())
            self._writer.finish()
        self._file.close()


def iter_messages(path: Path) -> Iterator[LogMessage]:
    """Yield the messages in file order, one chunk in memory; a damaged file is read as a whole."""
    count, topics = 0, dict[int, str]()
    try:
        for opcode, content in _iter_file_records(path):
            if opcode == recovery.CHUNK:
                data = recovery.decompress_chunk(content)
            else:
                data = recovery.RECORD_HEADER.pack(opcode, len(content)) + content
            for kind, begin, end in recovery.iter_records(data):
                if kind == recovery.MESSAGE:
                    channel, sequence, *times = recovery.MESSAGE_HEADER.unpack_from(data, begin)
                    payload = data[begin + recovery.MESSAGE_HEADER.size : end]
                    yield LogMessage(topics[channel], times[0], payload, sequence, times[1])
                    count += 1
                elif kind == recovery.CHANNEL:
                    number = int.from_bytes(data[begin : begin + 2], "little")
                    topics.setdefault(number, recovery.parse_string(data[begin:end], 4)[0])
    except (recovery.InvalidRecordError, KeyError):  # damaged, or its channel is lost
        yield from recover_log(path).messages[count:]  # also messages after the damage


def _iter_file_records(path: Path) -> Iterator[tuple[int, bytes]]:
    """Yield (opcode, content) to the end of the data; raise InvalidRecordError at damage."""
    with path.open("rb") as file:
        if file.read(len(recovery.MAGIC)) != recovery.MAGIC:
            raise recovery.InvalidRecordError("not the beginning of an MCAP file")
        size = path.stat().st_size
        while len(header := file.read(recovery.RECORD_HEADER.size)) == recovery.RECORD_HEADER.size:
            opcode, length = recovery.RECORD_HEADER.unpack(header)
            if opcode == recovery.DATA_END:
                break
            content = file.read(min(length, size))
            if len(content) < max(length, recovery.MIN_RECORD_LENGTHS.get(opcode, 0)):
                raise recovery.InvalidRecordError("cut off within a record")
            yield opcode, content


def read_metadata(path: Path, ends: Container[int] = ()) -> Metadata:
    """Return the metadata records by name, up to damage or a record of the kinds `ends`."""
    metadata: Metadata = {}
    with contextlib.suppress(
        recovery.InvalidRecordError
    ):  # reading the messages reports the damage
        for opcode, content in _iter_file_records(path):
            if opcode in ends:
                break
            if opcode == recovery.METADATA:
                name, end = recovery.parse_string(content, 0)
                metadata.setdefault(name, recovery.parse_string_map(content, end))
    return metadata


def read_leading_metadata(path: Path) -> Metadata:
    """Return the metadata records before the first message by name, also of an unfinished log."""
    return read_metadata(path, (recovery.CHUNK, recovery.MESSAGE))


@contextlib.contextmanager
def open_foreign_log(file: BinaryIO) -> Iterator[Writer]:
    """Yield an MCAP writer for foreign schemas; the file is finished on exit."""
    writer = Writer(file)
    writer.start(library="shaketwin")
    yield writer
    writer.finish()


def write_items(path: Path, items: list[Item], start: RunStart) -> None:
    """Write a new log with these items, for tests and conversions."""
    writer = LogWriter(path, start.rate_hz)
    writer.write_run_description(start)
    for item in items:
        writer.write_item(topic_for(item), item, start.run)
    writer.close()
