"""Every message that a file in MCAP still holds, however it was damaged; memory stays bounded.

Where a record is not what it says, it is left out, and reading goes on at the next that is: after a
chunk that was hit, at the end it declares; after bytes that are no record, wherever one begins
again. What that may cost, and what may be held, is limited before it begins.
"""

import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, NamedTuple

from table_io.card import BadInput
from twin.stream.budget import COST_OF_RECORD, HELD_BESIDE, memory, work
from twin.stream.framing import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    DATA_END,
    FIXED,
    FOOTER,
    FRAME,
    HEADER,
    LARGEST_BYTES,
    LEAST_LENGTHS,
    LONG,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    STAMP,
    WORD,
    NotARecordError,
    attachment,
    beginnings,
    mapping,
    records,
    text,
    unpacked,
    unpacked_size,
)

UNFINISHED = "the file was never finished: its recorder was killed, or still writes"
WINDOW = 2**20  # bytes looked through at once for the next record
NAMELESS = "?"  # begins the topic of messages of which no channel says what they are


class Message(NamedTuple):
    """One message of a log, still as bytes; times in ns, `sequence` counts within the topic."""

    topic: str
    log_time: int
    payload: bytes
    sequence: int = 0
    publish_time: int = 0


Raw = tuple[int, int, int, int, bytes]  # channel, sequence, log and publish time, payload


@dataclass(frozen=True, slots=True)
class Damage:
    """`size` bytes from byte `at` of a file could not be read, and why."""

    at: int
    size: int
    reason: str


@dataclass(slots=True)
class Salvaged:
    """What a file holds. `whole`: it ends as it should and every checksum fits."""

    messages: list[Message] = field(default_factory=list)
    attachments: dict[str, bytes] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    damage: list[Damage] = field(default_factory=list)
    topics: frozenset[str] = frozenset()  # of which there are messages, wanted or not
    whole: bool = False


def salvage(path: Path, topics: frozenset[str] | None = None) -> Salvaged:
    """All that `path` still holds, of `topics` if given; BadInput where it is no MCAP file.

    A file that was cut off before its first message has none.
    """
    try:
        with path.open("rb") as file:
            size = file.seek(0, 2)
            scanner = _Scanner(file, size, topics)
            if not scanner.is_mcap():
                raise BadInput(f"{path}: not an MCAP file; give the run.mcap of a run")
            return scanner.run()
    except OSError as error:
        raise BadInput(f"{path}: cannot read this log: {error.strerror}") from None
    except MemoryError:
        raise BadInput(f"{path}: needs more memory than there is; read it elsewhere") from None


@dataclass(slots=True)
class _Scanner:
    """One pass through a file; what was found so far."""

    file: BinaryIO
    size: int
    wanted: frozenset[str] | None
    found: Salvaged = field(default_factory=Salvaged)
    topics: dict[int, str] = field(default_factory=dict)  # by the id of their channel
    raw: list[Raw] = field(default_factory=list)
    skipped: set[int] = field(default_factory=set)  # channels of topics that are not wanted
    crc: int = 0  # of all since the start, or since the end of the data
    left: int = 0  # of the work
    room: int = 0  # of the memory

    def is_mcap(self) -> bool:
        """By its beginning, its end, or the record that stands first."""
        head, tail = self._at(0, len(MAGIC) + FRAME.size), self._at(self.size - len(MAGIC))
        if MAGIC.startswith(head[: len(MAGIC)]) or tail == MAGIC:
            return True
        return len(head) == 17 and head[8] == HEADER and LONG.unpack_from(head, 9)[0] < 1000

    def run(self) -> Salvaged:
        """Read to the end, over whatever is damaged."""
        self.left, self.room = work(self.size), memory()
        self.crc, closed = zlib.crc32(MAGIC), False
        at = len(MAGIC)
        if self._at(0, at) != MAGIC:
            self._note(0, min(at, self.size), "no beginning of an MCAP file")
        while at < self.size:
            if closed and self._at(at) == MAGIC:
                self.found.whole = not self.found.damage and at + len(MAGIC) == self.size
                at += len(MAGIC)
                continue
            try:
                opcode, content = self._record(at)
                self._take(opcode, content, at)
                closed = opcode == FOOTER
                at += FRAME.size + len(content)
            except NotARecordError as error:
                closed, after = False, self._resume(at)
                self._note(at, after - at, str(error))
                at = after
            if self.left < 0:
                self._note(at, self.size - at, "unpacks to more than any recording")
                break
        if not self.found.whole and not self.found.damage:
            self._note(self.size, 0, UNFINISHED)
        self._name()
        return self.found

    def _at(self, at: int, count: int = len(MAGIC)) -> bytes:
        """Bytes of the file; zeros where the disk does not give them, which are no record."""
        try:
            self.file.seek(max(at, 0))
            return self.file.read(count)
        except OSError:
            return bytes(min(count, self.size - at))

    def _hold(self, size: int) -> None:
        self.room -= HELD_BESIDE + size
        if self.room < 0:
            raise MemoryError

    def _note(self, at: int, size: int, reason: str) -> None:
        self._hold(0)
        self.found.damage.append(Damage(at, size, reason))

    def _length(self, at: int) -> tuple[int, int]:
        """(opcode, length) of what claims to be a record at byte `at`."""
        frame = self._at(at, FRAME.size)
        if len(frame) < FRAME.size:
            raise NotARecordError("cut off within a record")
        opcode, length = FRAME.unpack(frame)
        if opcode not in LEAST_LENGTHS:
            raise NotARecordError("no record")
        if length > self.size - at - FRAME.size:
            raise NotARecordError("a record that ends beyond the file")
        least = LEAST_LENGTHS[opcode]
        if length > LARGEST_BYTES or length < least or (opcode in FIXED and length != least):
            raise NotARecordError("a record of impossible length")
        return opcode, length

    def _record(self, at: int) -> tuple[int, bytes]:
        """(opcode, content) of the record at byte `at`."""
        opcode, length = self._length(at)
        self.left -= max(COST_OF_RECORD, length // 16)
        content = self._at(at + FRAME.size, length)
        if len(content) < length:
            raise NotARecordError("a file that shrinks while it is read")
        return opcode, content

    def _take(self, opcode: int, content: bytes, at: int) -> None:
        """Keep what a record says; nothing of one that is damaged."""
        before = self.crc
        self.crc = zlib.crc32(content, zlib.crc32(FRAME.pack(opcode, len(content)), before))
        if opcode == CHUNK:
            self.raw += self._messages(self._unpacked(content))
        elif opcode == DATA_END:
            self._check(content, before, at, "the data are not those that were written")
            self.crc = 0
        elif opcode == FOOTER:
            frame = FRAME.pack(opcode, len(content)) + content[:-4]
            crc = zlib.crc32(frame, before)
            self._check(content, crc, at, "the summary is not that which was written")
        elif opcode == ATTACHMENT:
            name, data = attachment(content)
            self._hold(len(content))
            self.found.attachments.setdefault(name, data)
        elif opcode == METADATA:
            name, end = text(content, 0)
            self._hold(16 * len(content))  # pairs of short texts
            self.found.metadata.setdefault(name, mapping(content, end))
        else:
            self.raw += self._messages(FRAME.pack(opcode, len(content)) + content)

    def _check(self, content: bytes, crc: int, at: int, reason: str) -> None:
        """Note where a checksum, the last of `content`, differs and no damage explains it."""
        if WORD.unpack(content[-4:])[0] not in (0, crc) and not self.found.damage:
            self._note(at, 0, reason)

    def _messages(self, data: bytes) -> list[Raw]:
        """The messages in a chunk; notes what channels there are."""
        messages: list[Raw] = []
        most = self.left // COST_OF_RECORD
        count = 0
        for count, (opcode, body, end) in enumerate(records(data), 1):
            if count > most:
                break
            if opcode == MESSAGE:
                stamp = STAMP.unpack_from(data, body)
                if stamp[0] not in self.skipped:
                    self._hold(end - body)
                    messages.append((*stamp, data[body + STAMP.size : end]))
            elif opcode == CHANNEL:
                channel = int.from_bytes(data[body : body + 2], "little")
                if channel not in self.topics:
                    self.topics[channel] = text(data[body:end], 4)[0]
                    self._hold(end - body)
                topic = self.topics[channel]
                if self.wanted is not None and topic not in self.wanted:
                    self.skipped.add(channel)
        self.left -= COST_OF_RECORD * count
        return messages

    def _unpacked(self, content: bytes) -> bytes:
        self.left -= unpacked_size(content)
        return unpacked(content)

    def _resume(self, at: int) -> int:
        """The byte after `at` where a record begins again, or the size of the file."""
        try:
            opcode, length = self._length(at)
            after = at + FRAME.size + length
            if opcode == CHUNK and (after == self.size or self._length(after)[0]):
                return after
        except NotARecordError:
            pass
        at += 1
        while at < self.size and self.left >= 0:
            for candidate in beginnings(self._at(at, WINDOW + FRAME.size)):
                if self._begins(at + candidate):
                    return at + candidate
            at += WINDOW + 1
        return self.size

    def _begins(self, at: int) -> bool:
        """True if a sound record stands at `at`, and after it another one or the end."""
        self.left -= COST_OF_RECORD
        try:
            opcode, length = self._length(at)
            after = at + FRAME.size + length
            if opcode != FOOTER and after != self.size:
                self._length(after)
            self.left -= length
            content = self._record(at)[1]
            if opcode == CHUNK:
                self._unpacked(content)
            elif opcode == ATTACHMENT:
                attachment(content)
            elif opcode == METADATA:
                mapping(content, text(content, 0)[1])
            elif opcode == MESSAGE_INDEX:
                return WORD.unpack_from(content, 2)[0] == length - 6 and length % 16 == 6
        except NotARecordError:
            return False
        return self.left >= 0

    def _name(self) -> None:
        """The messages with their topics, which a channel states anywhere in the file."""
        for channel in {raw[0] for raw in self.raw} - self.topics.keys():
            self.topics[channel] = f"{NAMELESS}{channel}"
            self.found.whole = False
        self.found.topics = frozenset(self.topics.values())
        self.found.messages = [
            Message(self.topics[channel], log_time, payload, sequence, publish_time)
            for channel, sequence, log_time, publish_time, payload in self.raw
            if channel not in self.skipped
        ]
