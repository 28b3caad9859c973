"""Writer of an MCAP file (mcap.dev/spec): messages in compressed chunks, then their index.

The writer of the library makes several calls for every field of a message; this one, of a long test
with 100 messages a second, makes a few for each message.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from twin.recording.recovery import (
    ATTACHMENT_INDEX,
    CHANNEL,
    CHUNK_INDEX,
    FOOTER,
    MAGIC,
    MESSAGE,
    MESSAGE_HEADER,
    MESSAGE_INDEX,
    METADATA_INDEX,
    RECORD_HEADER,
    SCHEMA,
    STATISTICS,
)

MESSAGE_RECORD = struct.Struct("<BQHIQQ")  # both headers of a message
INDEX_RECORD = struct.Struct("<BQHI")  # header of a message index: channel, bytes of its entries
FOOTER_RECORD = struct.Struct("<BQQQ")  # a footer without its checksum
SUMMARY_KINDS = (SCHEMA, CHANNEL, STATISTICS, CHUNK_INDEX, ATTACHMENT_INDEX, METADATA_INDEX)


class McapWriter:
    """One MCAP file, given to `write` in parts of whole records; complete after `finish`."""

    def __init__(self, write: Callable[[bytes], object], chunk_bytes: int) -> None:
        self._write, self._chunk_bytes = write, chunk_bytes
        self._offset = self._crc = 0  # of what is written; the checksum is that of the data section
        self._pieces: list[bytes] = []  # of the open chunk
        self._size = 0
        self._places: dict[int, list[tuple[int, int]]] = {}  # its log times and offsets, by channel
        self._counts: Counter[int] = Counter()  # messages written, by channel
        self._summary: dict[int, list[McapRecord]] = {kind: [] for kind in SUMMARY_KINDS}
        self._append(MAGIC + _build(Header("shaketwin", "shaketwin")))

    def add_channel(self, topic: str, schema: str, definition: bytes) -> int:
        """Add a topic with the schema of its protobuf messages; return its channel."""
        number = len(self._summary[CHANNEL]) + 1
        records = {
            SCHEMA: Schema(number, definition, "protobuf", schema),
            CHANNEL: Channel(number, topic, "protobuf", {}, number),
        }
        for kind, record in records.items():
            self._summary[kind].append(record)
            self._pieces.append(_build(record))
            self._size += len(self._pieces[-1])
        return number

    def add_message(
        self, channel: int, sequence: int, log_time: int, publish_time: int, payload: bytes
    ) -> None:
        """Append a message; times in ns."""
        length = MESSAGE_HEADER.size + len(payload)
        self._places.setdefault(channel, []).append((log_time, self._size))
        self._pieces.append(
            MESSAGE_RECORD.pack(MESSAGE, length, channel, sequence, log_time, publish_time)
        )
        self._pieces.append(payload)
        self._size += RECORD_HEADER.size + length
        if self._size > self._chunk_bytes:
            self.close_chunk()

    def close_chunk(self) -> None:
        """Write the messages since the last chunk, if any, as a chunk with their index."""
        if not self._places:
            return
        data = b"".join(self._pieces)
        places = {channel: np.array(pairs, "<u8") for channel, pairs in self._places.items()}
        first = min(int(pairs[:, 0].min()) for pairs in places.values())
        last = max(int(pairs[:, 0].max()) for pairs in places.values())
        packed = zstandard.compress(data)
        start = self._offset
        length = self._append(
            _build(Chunk("zstd", packed, last, first, zlib.crc32(data), len(data)))
        )
        offsets, index_start = {}, self._offset
        for channel, pairs in places.items():
            offsets[channel], size = self._offset, pairs.nbytes
            header = INDEX_RECORD.pack(MESSAGE_INDEX, size + 6, channel, size)
            self._append(header + pairs.tobytes())
            self._counts[channel] += len(pairs)
        index_length = self._offset - index_start
        self._summary[CHUNK_INDEX].append(
            ChunkIndex(
                length, start, "zstd", len(packed), last, index_length, offsets, first, len(data)
            )
        )
        self._pieces, self._size, self._places = [], 0, {}

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment, before the messages since the last chunk."""
        start = self._offset
        length = self._append(_build(Attachment(time_ns, 0, name, media_type, data)))
        self._summary[ATTACHMENT_INDEX].append(
            AttachmentIndex(start, length, 0, time_ns, len(data), name, media_type)
        )

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record, before the messages since the last chunk."""
        start = self._offset
        length = self._append(_build(Metadata(name, values)))
        self._summary[METADATA_INDEX].append(MetadataIndex(start, length, name))

    def finish(self) -> None:
        """Write the last chunk, and the summary by which a reader finds the others."""
        self.close_chunk()
        self._append(_build(DataEnd(self._crc)))
        counts = {kind: len(records) for kind, records in self._summary.items()}
        spans = [(each.message_start_time, each.message_end_time) for each in self._chunks]
        self._summary[STATISTICS].append(
            Statistics(
                counts[ATTACHMENT_INDEX], counts[CHANNEL], self._counts, counts[CHUNK_INDEX],
                self._counts.total(), max((last for _, last in spans), default=0),
                min((first for first, _ in spans), default=0), counts[METADATA_INDEX],
                counts[SCHEMA],
            )
        )  # fmt: skip
        start, groups, summary = self._offset, b"", b""
        for kind, records in self._summary.items():
            group = _build(*records)
            groups += _build(SummaryOffset(kind, start + len(summary), len(group)))
            summary += group
        footer = FOOTER_RECORD.pack(FOOTER, 20, start, start + len(summary))
        crc = zlib.crc32(summary + groups + footer)
        self._append(summary + groups + _build(Footer(start, start + len(summary), crc)) + MAGIC)

    @property
    def _chunks(self) -> Sequence[ChunkIndex]:
        return self._summary[CHUNK_INDEX]

    def _append(self, data: bytes) -> int:
        """Write whole records; return the number of bytes."""
        self._crc = zlib.crc32(data, self._crc)
        self._offset += len(data)
        self._write(data)
        return len(data)


def _build(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())
