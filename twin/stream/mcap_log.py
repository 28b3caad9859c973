"""The log: MCAP files whose messages are the bytes of the wire. The only file that knows mcap.

`LOG.md` beside this file is the page of the format. Profile, machine card, model and calibration
stand in a log from the first moment, so that a killed recording explains itself.
"""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Chunk, DataEnd
from mcap.records import Message as MessageRecord
from mcap.records import Metadata as MetadataRecord
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

from table_io.clock import wall_ns
from table_io.records import RunStart
from twin.stream.content import SCHEMA_VERSION, Content, Metadata, attachments, hashes
from twin.stream.newfile import NewFile
from twin.stream.salvage import Message, salvage
from twin.stream.wire import (
    TOPIC_TYPES,
    Item,
    encode,
    schema,
)

MEDIA = {".toml": "toml", ".json": "json", ".pb": "protobuf"}
CHUNK_BYTES = 2**20  # at most that is compressed at once
LATEST_NS = 2**64 - 1  # that the format holds
DRAIN_BYTES = 2**20  # at most that a writer lets wait between two flushes


class ImpossibleTimeError(ValueError):
    """A sample that lies later than a log can hold."""


class LogWriter:
    """Writes items to a new MCAP file; refuses a file that exists.

    Whatever raises OSError (a full disk, a dying one) may be called again and loses nothing.
    """

    def __init__(self, path: Path, rate_hz: float, chunk_bytes: int = CHUNK_BYTES) -> None:
        self.path = path
        self._rate_hz = rate_hz
        self._file = NewFile(path)
        # With a checksum over everything, a record that is lost inside the file cannot go unseen.
        self._writer = Writer(self._file, chunk_bytes, enable_data_crcs=True)
        self._writer.start(profile="shaketwin", library="shaketwin")
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}
        self._content = Content()
        self._finished = False

    @property
    def size(self) -> int:
        """Bytes of the file, those that wait for the disk included."""
        return self._file.tell()

    def write(
        self, topic: str, payload: bytes, index: int, publish_time: int | None = None
    ) -> None:
        """Append the bytes of one item that holds from sample `index`; `publish_time` in ns.

        ImpossibleTimeError where that is later than a log can hold; then nothing was written.
        """
        log_time = round(index * 1e9 / self._rate_hz)
        if log_time > LATEST_NS:
            raise ImpossibleTimeError(f"sample {index}: later than a log can hold")
        if topic not in self._channels:
            name, data = schema(TOPIC_TYPES[topic])
            schema_id = self._writer.register_schema(name, "protobuf", data)
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema_id)
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self._content.add(topic, log_time, payload)
        self._writer.add_message(
            self._channels[topic],
            log_time=log_time,
            data=payload,
            publish_time=wall_ns() if publish_time is None else publish_time,
            sequence=sequence % 2**32,
        )
        if self._file.waiting > DRAIN_BYTES:
            self._file.drain()

    def describe(self, start: RunStart) -> None:
        """Put the texts and versions of the run into the file, before its first message."""
        texts = attachments(start)
        about = {"id": start.run, "schema": str(SCHEMA_VERSION), "host": start.host}
        self.note("run", {**about, "started_at": start.started_at, **start.versions})
        self.note("attachments", hashes(texts))
        for name, data in texts.items():
            media = f"application/{MEDIA[Path(name).suffix]}"
            self._writer.add_attachment(wall_ns(), 0, name, media, data)

    def note(self, name: str, values: dict[str, str]) -> None:
        """Put a metadata record into the file."""
        self._writer.add_metadata(name, values)

    def flush(self) -> None:
        """Close the chunk: what was written so far survives the death of this process."""
        self._writer.flush()
        self._file.drain()

    def sync(self) -> None:
        """Wait until what was flushed is on the disk: it survives the death of the machine."""
        self._file.sync()

    def close(self) -> None:
        """Finish the file with the hash of its content; may be called again."""
        if not self._finished:
            self._finished = True
            self._writer.flush()
            self.note("content", self._content.record())
            self._writer.finish()
        self._file.close()


def each(path: Path) -> Iterator[Message]:
    """The messages in file order, a chunk in memory at a time; all of it where it is damaged."""
    count = 0
    with path.open("rb") as stream:
        reader = NonSeekingReader(stream, validate_crcs=True)
        try:
            for _, channel, one in reader.iter_messages(log_time_order=False):
                count += 1
                yield Message(channel.topic, one.log_time, one.data, one.sequence, one.publish_time)
            return
        except OSError:
            raise
        except Exception:
            pass  # where a file is cut or damaged, the parser and its decompressor fail in any way
    yield from salvage(path).messages[count:]  # what stands after the damage is not given up


def metadata(path: Path) -> Metadata:
    """The metadata records of a whole log by name; none of one that was cut off or damaged."""
    with path.open("rb") as stream:
        try:
            return {one.name: one.metadata for one in make_reader(stream).iter_metadata()}
        except (McapError, ValueError, EOFError):
            return {}


def heading(path: Path) -> Metadata:
    """The metadata records before the first message, by name; of a log that was cut off too."""
    found: Metadata = {}
    with path.open("rb") as stream:
        try:
            for one in StreamReader(stream, emit_chunks=True).records:
                if isinstance(one, (Chunk, MessageRecord, DataEnd)):
                    break
                if isinstance(one, MetadataRecord):
                    found.setdefault(one.name, one.metadata)
        except OSError:
            raise
        except Exception:
            pass  # as in `each`; who reads on finds out, and says so
    return found


@contextlib.contextmanager
def foreign_log(file: BinaryIO) -> Iterator[Writer]:
    """A new MCAP file for messages in the schemas of others; finished at the end."""
    writer = Writer(file)
    writer.start(library="shaketwin")
    yield writer
    writer.finish()


def write_items(path: Path, items: list[Item], start: RunStart) -> None:
    """A new log with these items, for tests and conversions."""
    from twin.stream.wire import topic

    writer = LogWriter(path, start.rate_hz)
    writer.describe(start)
    for item in items:
        writer.write(topic(item), encode(item, start.run), item.index)
    writer.close()
