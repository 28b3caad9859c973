"""Log reader: all valid items of a log in order of sample index, and a list of the damage."""

import re
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, TypeVar

from table_io.block import Block
from table_io.errors import InputError
from table_io.records import Event, Record, RunStart, RunStop, SampleGap
from twin.recording.columns import BlockStore, StoredBlock, StoredItem, StoredItems
from twin.recording.log_metadata import START_COPY_NAME, read_schema_version
from twin.recording.mcap_log import iter_messages, read_leading_metadata
from twin.recording.recovery import (
    UNNAMED_TOPIC_PREFIX,
    Damage,
    LogMessage,
    RecoveredLog,
    pause_collection,
    recover_log,
)
from twin.recording.validation import (
    has_invalid_labels,
    validate_block,
    validate_record,
    validate_start,
)
from twin.transport.codec import (
    RECORD_TOPICS,
    TOPIC_TYPES,
    Item,
    WireError,
    decode_comparisons,
    decode_item,
    encode_item,
)
from twin.transport.endpoint import BLOCK_TOPICS, CMP_TOPIC

START_TOPIC = RECORD_TOPICS[RunStart]
# Order of items with the same sample index: start first, then by table of topics, stop last. So a
# recording reads the same in whatever order its parts were written.
TOPIC_ORDER = {topic: place for place, topic in enumerate(TOPIC_TYPES)}
TOPIC_ORDER |= {START_TOPIC: -1, RECORD_TOPICS[RunStop]: len(TOPIC_TYPES)}
CUT_EVENT_KIND = "cut"  # says of which run a recording of some steps is a part
DECODED_AT_ONCE = 10_000  # comparisons
MIN_LABEL_BYTES = 3  # of the three labels of a sample, in any encoding
R = TypeVar("R", bound=Record)


@dataclass(frozen=True, slots=True)
class Recording:
    """Recording: a whole log in memory.

    `is_intact` is True if the file is undamaged and every message read is valid in its run. Whether
    the test itself is complete follows from `stop` and `missing_samples`.
    """

    path: Path
    run: str
    start: RunStart
    items: StoredItems
    is_intact: bool
    damage: tuple[Damage, ...] = ()
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)

    def records(self, kind: type[R]) -> tuple[R, ...]:
        """Return all records of one type, in order of sample index."""
        return self.items.records_of(kind)

    def blocks(self, stream: str) -> tuple[Block, ...]:
        """Return all blocks of stream "meas" or "pred", in order of sample index."""
        return tuple(block.read() for block in self.items.stored_blocks(stream))

    def contiguous_blocks(self, stream: str) -> tuple[Block, ...]:
        """Return the stream joined into one block between each pair of gaps."""
        return self.items.contiguous_blocks(stream)

    @property
    def stop(self) -> RunStop | None:
        stops = self.records(RunStop)
        return stops[-1] if stops else None

    @property
    def clipped_gaps(self) -> tuple[SampleGap, ...]:
        """Stretches of samples at the end of the range of their sensor."""
        return tuple(gap for gap in self.records(SampleGap) if gap.reason == "clipped")

    @property
    def earlier_run(self) -> str:
        """Run with the samples before a recording of some steps, "" for a full recording.

        The twin of such a log started earlier, so a replay of the log alone has another state.
        """
        for event in self.records(Event):
            match = re.fullmatch(r"from (.*) at sample \d+", event.text)
            if event.kind == CUT_EVENT_KIND and event.index == self.start.index and match:
                return match[1]
        return ""

    @property
    def missing_samples(self) -> int:
        """Number of measured samples between start and stop that are not in the file."""
        pieces = self.contiguous_blocks("meas")
        end = self.stop.index if self.stop else (pieces[-1].end if pieces else 0)
        return end - self.start.index - sum(len(piece) for piece in pieces)


def read_recording(path: Path, topics: Iterable[str] = TOPIC_TYPES) -> Recording:
    """Read the recording in `path`, with its start record and the items of `topics`.

    Raises InputError if it is not a shaketwin log. A damaged log is read as far as possible;
    `damage` lists the rest.
    """
    return build_recording(path, recover_log(path, frozenset((START_TOPIC, *topics))))


def find_topic(entry: StoredItem) -> str:
    """Return the topic on which an item is logged, as `topic_for` does."""
    if isinstance(entry, StoredBlock):
        return BLOCK_TOPICS[entry.stream]
    return RECORD_TOPICS[type(entry)]


def build_recording(path: Path, recovered: RecoveredLog) -> Recording:
    """Return the recording in a recovered log, whose messages are removed as they are decoded."""
    return _select_recording(path, recovered, keeps_messages=False)[0]


def select_messages(path: Path, recovered: RecoveredLog) -> tuple[Recording, list[LogMessage]]:
    """Return (recording, message of each of its items) from a recovered log."""
    return _select_recording(path, recovered, keeps_messages=True)


@pause_collection()
def _select_recording(
    path: Path, recovered: RecoveredLog, keeps_messages: bool
) -> tuple[Recording, list[LogMessage]]:
    """Return (recording, message of each of its items if they are kept)."""
    problems = _assign_unnamed_topics(recovered)
    topics_present = {*recovered.topics, *(message.topic for message in recovered.messages)}
    if topics_present and not topics_present & TOPIC_TYPES.keys():
        foreign = sorted(topic[:80] for topic in recovered.topics)
        raise InputError(
            f"an MCAP file, but not a shaketwin log (topics: {', '.join(foreign[:5])})",
            where=path,
            remedy="give the run.mcap of a run",
        )
    store = _make_store(recovered.messages)
    messages = iter(recovered.messages) if keeps_messages else _take_messages(recovered)
    known = (message for message in messages if message.topic in TOPIC_TYPES)
    entries, errors = _decode_messages(known, store, keeps_messages)
    start = _find_start(path, entries, errors, recovered.attachments.get(START_COPY_NAME))
    problems += _remove_mislabelled(entries, store)
    entries.sort(key=lambda entry: (entry.item.index, TOPIC_ORDER[entry.topic], entry.key))
    kept, rejected = _select_valid(entries, start, recovered.is_intact)
    problems += rejected
    try:
        read_schema_version(path, recovered.metadata)
    except InputError as error:
        if recovered.is_intact:
            raise
        problems.append(str(error))  # the version may be damaged: read the rest
    damage = (
        *recovered.damage,
        *(Damage(0, 0, text) for text in (*_count_repeats(errors), *_count_repeats(problems))),
    )
    items = StoredItems(entry.item for entry in kept)
    extras = recovered.metadata, recovered.attachments
    recording = Recording(path, start.run, start, items, not damage, damage, *extras)
    return recording, [entry.message for entry in kept if entry.message is not None]


def _take_messages(recovered: RecoveredLog) -> Iterator[LogMessage]:
    """Yield the messages in their order, each of which is removed."""
    recovered.messages.reverse()
    while recovered.messages:
        yield recovered.messages.pop()


def _assign_unnamed_topics(recovered: RecoveredLog) -> list[str]:
    """Infer topics lost with the first chunk: the topic whose encoding equals the payload.

    Returns a problem for each such message.
    """
    if not any(topic.startswith(UNNAMED_TOPIC_PREFIX) for topic in recovered.topics):
        return []
    run = recovered.metadata.get("run", {}).get("id", "")
    topic_by_placeholder: dict[str, str] = {}
    for message in recovered.messages:
        if (
            message.topic.startswith(UNNAMED_TOPIC_PREFIX)
            and message.topic not in topic_by_placeholder
        ):
            matching_topics = (
                topic for topic in TOPIC_TYPES if _matches_topic(topic, message.payload, run)
            )
            topic_by_placeholder[message.topic] = next(matching_topics, message.topic)
    recovered.messages = [
        message._replace(topic=topic_by_placeholder.get(message.topic, message.topic))
        for message in recovered.messages
    ]
    return [
        f"topic unknown: {message.topic}"
        for message in recovered.messages
        if message.topic in topic_by_placeholder
    ]


def _matches_topic(topic: str, payload: bytes, run: str) -> bool:
    try:
        item_run, item = decode_item(topic, payload)
    except WireError:
        return False
    return item_run == run != "" and encode_item(item, run) == payload


def find_start_ns(start: RunStart) -> int:
    """Return the start of a run in ns since 1970, 0 without one; local time without a zone."""
    try:
        return max(0, round(datetime.fromisoformat(start.started_at).timestamp() * 1e9))
    except (ValueError, OverflowError):
        return 0


def read_start(path: Path) -> RunStart:
    """Read the start record of a log without the rest; if damaged, as `read_recording` does.

    Raises InputError if there is none, or if the log has a newer schema version.
    """
    try:
        read_schema_version(path, read_leading_metadata(path))
        first = next(
            (message for message in iter_messages(path) if message.topic == START_TOPIC), None
        )
        start = decode_item(START_TOPIC, first.payload)[1] if first else None
    except (InputError, OSError, WireError):
        start = None
    is_valid = isinstance(start, RunStart) and not validate_start(start)
    return start if isinstance(start, RunStart) and is_valid else read_recording(path, ()).start


def iter_valid_items(
    topic: str, payloads: Iterable[bytes], start: RunStart, problems: list[str]
) -> Iterator[Item]:
    """Yield the items of a topic that are valid in the run of `start`, without start records.

    These are the rules of `read_recording` for streaming; reasons of rejection are appended to
    `problems`. Repeated samples are not detected: the caller selects among them.
    """
    messages = [LogMessage(topic, 0, payload) for payload in payloads]
    store = _make_store(messages)
    entries, errors = _decode_messages(messages, store)
    problems += errors
    problems += _remove_mislabelled(entries, store)
    for entry in entries:
        if reason := _rejection_reason(entry, None, start):
            problems.append(f"{topic}: {reason}")
        elif not isinstance(entry.item, RunStart):
            yield entry.item.read() if isinstance(entry.item, StoredBlock) else entry.item


class _Entry(NamedTuple):
    """Decoded message; `key` tells it from others of its topic and index."""

    topic: str
    sequence: int
    key: bytes  # the payload, or the checksum of that of a block, which is large
    item: StoredItem
    run: str
    message: LogMessage | None = None  # where it is kept


def _rejection_reason(entry: _Entry, before: StoredBlock | None, start: RunStart) -> str:
    """Return why an item is invalid in the run of `start` after block `before`, or ""."""
    if entry.run != start.run:
        return "of another run"
    if isinstance(entry.item, StoredBlock):
        return validate_block(entry.item, before, start)
    return validate_record(entry.item, start)


def _make_store(messages: Sequence[LogMessage]) -> BlockStore:
    """Return a store with room for all blocks that these messages may hold."""
    size = sum(len(message.payload) for message in messages)
    return BlockStore(lambda block: size // (8 * len(block.channels) + MIN_LABEL_BYTES))


def _decode_messages(
    messages: Iterable[LogMessage], store: BlockStore, keeps_messages: bool = False
) -> tuple[list[_Entry], list[str]]:
    """Return (decoded messages, errors of those that do not decode); blocks go into `store`."""
    entries: list[_Entry] = []
    errors = []
    for message, decoded in _iter_decoded(messages):
        topic, payload = message.topic, message.payload
        try:
            run, item = decoded or decode_item(topic, payload)
        except WireError as error:
            errors.append(str(error))
            continue
        kept = message if keeps_messages else None
        if isinstance(item, Block):
            key = zlib.crc32(payload).to_bytes(4)
            entries.append(_Entry(topic, message.sequence, key, store.add(item), run, kept))
        else:
            entries.append(_Entry(topic, message.sequence, payload, item, run, kept))
    return entries, errors


def _iter_decoded(
    messages: Iterable[LogMessage],
) -> Iterator[tuple[LogMessage, tuple[str, Item] | None]]:
    """Yield each message, in any order, with its content where many were decoded at once."""
    compared: list[LogMessage] = []
    for message in messages:
        if message.topic != CMP_TOPIC:
            yield message, None
            continue
        compared.append(message)
        if len(compared) == DECODED_AT_ONCE:
            yield from zip(
                compared, decode_comparisons([each.payload for each in compared]), strict=True
            )
            compared = []
    yield from zip(compared, decode_comparisons([each.payload for each in compared]), strict=True)


def _find_start(
    path: Path, entries: list[_Entry], errors: list[str], copy: bytes | None
) -> RunStart:
    """Return the start record or its copy; raise InputError if both are missing."""
    problems = [*errors]
    for entry in entries:
        if isinstance(entry.item, RunStart):
            if not (reason := validate_start(entry.item)):
                return entry.item
            problems.append(f"{START_TOPIC}: {reason}")
    copies = [] if copy is None else [LogMessage(START_TOPIC, 0, copy)]
    for entry in _decode_messages(copies, _make_store(copies), keeps_messages=True)[0]:
        if isinstance(entry.item, RunStart):
            entries.append(entry)
            errors.append(f"{START_TOPIC}: lost; its copy is used")
            return entry.item
    if problems:
        raise InputError(f"damaged or foreign: {problems[0]}", where=path, key=START_TOPIC)
    raise InputError("missing, so profile and model are unknown", where=path, key=START_TOPIC)


def _remove_mislabelled(entries: list[_Entry], store: BlockStore) -> list[str]:
    """Remove blocks with impossible labels; return a problem for each."""
    if not any(has_invalid_labels(block) for block in store.read_all()):
        return []
    count = len(entries)
    entries[:] = [
        entry
        for entry in entries
        if not (isinstance(entry.item, StoredBlock) and has_invalid_labels(entry.item.read()))
    ]
    return ["samples with invalid labels"] * (count - len(entries))


def _select_valid(
    entries: list[_Entry], start: RunStart, is_intact: bool
) -> tuple[list[_Entry], list[str]]:
    """Return (entries that are valid together in one run, reasons of rejection of the others)."""
    kept: list[_Entry] = []
    problems = []
    last_blocks: dict[str, StoredBlock] = {}
    seen_keys: set[tuple[str, int, bytes]] = set()
    for entry in entries:
        topic, item = entry.topic, entry.item
        if not is_intact:  # a repeated chunk repeats each of its messages
            key = (topic, entry.sequence, entry.key)
            if key in seen_keys:
                problems.append(f"{topic}: duplicate message")
                continue
            seen_keys.add(key)
        before = last_blocks.get(item.stream) if isinstance(item, StoredBlock) else None
        reason = _rejection_reason(entry, before, start)
        if item is not start and (reason or isinstance(item, RunStart)):
            problems.append(f"{topic}: {reason or 'duplicate message'}")
            continue
        if isinstance(item, StoredBlock):
            last_blocks[item.stream] = item
        kept.append(entry)
    return kept, problems


def _count_repeats(texts: Iterable[str]) -> list[str]:
    """Return each text once, with its count."""
    return [
        text if count == 1 else f"{text} ({count} messages)"
        for text, count in Counter(texts).most_common(20)
    ]
