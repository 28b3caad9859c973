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
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from twin.recording.recovery import MAGIC, MESSAGE_HEADER, RECORD_HEADER

MESSAGE_RECORD = struct.Struct("<BQHIQQ")  # both headers of a message
INDEX_RECORD = struct.Struct("<BQHI")  # header of a message index: channel, bytes of its entries
FOOTER_RECORD = struct.Struct("<BQQQ")  # a footer without its checksum
SUMMARY_KINDS = (
    Opcode.SCHEMA, Opcode.CHANNEL, Opcode.STATISTICS, Opcode.CHUNK_INDEX, Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
)  # fmt: skip


class McapWriter:
    """One MCAP file, given to `write` in parts of whole records; complete after `finish`."""

    def __init__(self, write: Callable[[bytes], object], chunk_bytes: int) -> None:
        self._write, self._chunk_bytes = write, chunk_bytes
        self._offset = self._crc = 0  # of what is written; the checksum is that of the data section
        self._pieces: list[bytes] = []  # of the open chunk
        self._size = 0
        self._places: dict[int, list[tuple[int, int]]] = {}  # its log times and offsets, by channel
        self._counts: Counter[int] = Counter()  # messages written, by channel
        self._times: tuple[int, ...] = ()  # log times of the first and the last message
        # A live run closes several chunks a second: their index waits as compressed records.
        self._packer, self._packed_index, self._chunks = zlib.compressobj(1), bytearray(), 0
        self._summary: dict[int, list[records.McapRecord]] = {kind: [] for kind in SUMMARY_KINDS}
        self._append(MAGIC + _build(records.Header("shaketwin", "shaketwin")))

    def add_channel(self, topic: str, schema: str, definition: bytes) -> int:
        """Add a topic with the schema of its protobuf messages; return its channel."""
        number = len(self._summary[Opcode.CHANNEL]) + 1
        added = {
            Opcode.SCHEMA: records.Schema(number, definition, "protobuf", schema),
            Opcode.CHANNEL: records.Channel(number, topic, "protobuf", {}, number),
        }
        for kind, record in added.items():
            self._summary[kind].append(record)
            self._pieces.append(_build(record))
            self._size += len(self._pieces[-1])
        return number

    def add_messages(
        self,
        channel: int,
        first: int,
        log_times: Sequence[int],
        publish_time: int,
        payloads: Sequence[bytes],
    ) -> None:
        """Append messages of a channel, numbered from `first` on; times in ns."""
        pack, overhead = MESSAGE_RECORD.pack, MESSAGE_HEADER.size
        places = self._places.setdefault(channel, [])
        for number, (log_time, payload) in enumerate(zip(log_times, payloads, strict=True), first):
            length = overhead + len(payload)
            places.append((log_time, self._size))
            head = pack(Opcode.MESSAGE, length, channel, number % 2**32, log_time, publish_time)
            self._pieces += (head, payload)
            self._size += RECORD_HEADER.size + length
            if self._size > self._chunk_bytes:
                self.close_chunk()
                places = self._places.setdefault(channel, [])

    def close_chunk(self) -> None:
        """Write the messages since the last chunk, if any, as a chunk with their index."""
        self._places = {channel: places for channel, places in self._places.items() if places}
        if not self._places:
            return
        data = b"".join(self._pieces)
        places = {channel: np.array(pairs, "<u8") for channel, pairs in self._places.items()}
        first = min(int(pairs[:, 0].min()) for pairs in places.values())
        last = max(int(pairs[:, 0].max()) for pairs in places.values())
        self._times = min((first, *self._times)), max((last, *self._times))
        packed = zstandard.compress(data)
        start = self._offset
        length = self._append(
            _build(records.Chunk("zstd", packed, last, first, zlib.crc32(data), len(data)))
        )
        offsets, index_start = {}, self._offset
        for channel, pairs in places.items():
            offsets[channel], size = self._offset, pairs.nbytes
            header = INDEX_RECORD.pack(Opcode.MESSAGE_INDEX, size + 6, channel, size)
            self._append(header + pairs.tobytes())
            self._counts[channel] += len(pairs)
        index_length = self._offset - index_start
        entry = records.ChunkIndex(
            length, start, "zstd", len(packed), last, index_length, offsets, first, len(data)
        )
        self._packed_index += self._packer.compress(_build(entry))
        self._chunks += 1
        self._pieces, self._size, self._places = [], 0, {}

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment, before the messages since the last chunk."""
        start = self._offset
        length = self._append(_build(records.Attachment(time_ns, 0, name, media_type, data)))
        self._summary[Opcode.ATTACHMENT_INDEX].append(
            records.AttachmentIndex(start, length, 0, time_ns, len(data), name, media_type)
        )

    def add_metadata(self, name: str, values: dict[str, str]) -> None:
        """Write a metadata record, before the messages since the last chunk."""
        start = self._offset
        length = self._append(_build(records.Metadata(name, values)))
        self._summary[Opcode.METADATA_INDEX].append(records.MetadataIndex(start, length, name))

    def finish(self) -> None:
        """Write the last chunk, and the summary by which a reader finds the others."""
        self.close_chunk()
        self._append(_build(records.DataEnd(self._crc)))
        chunk_index = zlib.decompress(self._packed_index + self._packer.flush())
        counts = {kind: len(entries) for kind, entries in self._summary.items()}
        self._summary[Opcode.STATISTICS].append(
            records.Statistics(
                counts[Opcode.ATTACHMENT_INDEX], counts[Opcode.CHANNEL], self._counts,
                self._chunks, self._counts.total(), max(self._times, default=0),
                min(self._times, default=0), counts[Opcode.METADATA_INDEX], counts[Opcode.SCHEMA],
            )
        )  # fmt: skip
        start, groups, summary = self._offset, b"", b""
        for kind, entries in self._summary.items():
            group = chunk_index if kind == Opcode.CHUNK_INDEX else _build(*entries)
            groups += _build(records.SummaryOffset(kind, start + len(summary), len(group)))
            summary += group
        footer = FOOTER_RECORD.pack(Opcode.FOOTER, 20, start, start + len(summary))
        crc = zlib.crc32(summary + groups + footer)
        self._append(
            summary + groups + _build(records.Footer(start, start + len(summary), crc)) + MAGIC
        )

    def _append(self, data: bytes) -> int:
        """Write whole records; return the number of bytes."""
        self._crc = zlib.crc32(data, self._crc)
        self._offset += len(data)
        self._write(data)
        return len(data)


def _build(*built: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in built:
        record.write(builder)
    return bytes(builder.end())
