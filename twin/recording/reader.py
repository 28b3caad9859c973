"""Log reader: all valid items of a log in order of sample index, and a list of the damage."""

import re
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import NamedTuple, TypeVar, cast

import numpy as np

from table_io.block import Block, Int1D
from table_io.errors import InputError
from table_io.records import Event, Record, RunStart, RunStop, SampleGap
from twin.recording.columns import (
    PIECE_SAMPLES,
    TOPIC_ORDER,
    ComparisonTable,
    Series,
    SeriesStore,
    StoredItems,
)
from twin.recording.log_metadata import START_COPY_NAME, read_schema_version
from twin.recording.mcap_log import iter_messages, read_leading_metadata
from twin.recording.recovery import (
    UNNAMED_TOPIC_PREFIX,
    Damage,
    LogMessage,
    RecoveredLog,
    measure_log,
    pause_collection,
    recover_log,
)
from twin.recording.validation import (
    MAX_DURATION_S,
    has_invalid_numbers,
    validate_block,
    validate_record,
    validate_start,
)
from twin.transport.codec import (
    RECORD_TOPICS,
    TOPIC_TYPES,
    Item,
    WireError,
    decode_item,
    decode_series,
    encode_item,
)
from twin.transport.endpoint import BLOCK_TOPICS, CMP_TOPIC
from twin.transport.series import SeriesItem, split_item

START_TOPIC = RECORD_TOPICS[RunStart]
CUT_EVENT_KIND = "cut"  # says of which run a recording of some steps is a part
SERIES_TOPICS = (*BLOCK_TOPICS.values(), CMP_TOPIC)
MIN_COLUMN_BYTES = 3  # of a payload for each column, besides its float64 values: three labels
DECODED_AT_ONCE = 10_000  # messages
MessageHandler = Callable[[Sequence[LogMessage]], None]
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

    def contiguous_blocks(self, stream: str) -> tuple[Block, ...]:
        """Return stream "meas" or "pred" joined into one block between each pair of gaps."""
        return self.items.contiguous_blocks(stream)

    def iter_pieces(self, stream: str) -> Iterator[Block]:
        """Yield the contiguous blocks of a stream in pieces, see `cut_block`."""
        for block in self.contiguous_blocks(stream):
            yield from self.cut_block(block, PIECE_SAMPLES)

    def cut_block(self, block: Block, samples: int) -> Iterator[Block]:
        """Yield a block of this recording in pieces of so many samples.

        The memory of a piece is given back when the next one is asked for.
        """
        for first in range(block.index, block.end, samples):
            yield block.cut(first, min(first + samples, block.end))
            self.items.release()

    @property
    def comparisons(self) -> ComparisonTable:
        """Comparisons as numbers, in order; those of the channels that most of them have."""
        return self.items.comparison_table()

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


@pause_collection()
def read_recording(
    path: Path,
    topics: Iterable[str] = TOPIC_TYPES,
    handlers: Mapping[str, MessageHandler] | None = None,
) -> Recording:
    """Read the recording in `path`, with its start record and the items of `topics`.

    Messages of the topics of `handlers` go to these as they are, some at a time. Raises InputError
    if it is not a shaketwin log. A damaged log is read as far as possible; `damage` lists the rest.
    """
    decoder, decoded = _Decoder(measure_log(path)), {START_TOPIC, *topics}
    handlers = handlers or {}

    def handle(messages: list[LogMessage]) -> None:
        for topic, handler in handlers.items():
            handler([message for message in messages if message.topic == topic])
        decoder.add([message for message in messages if message.topic in decoded])

    recovered = recover_log(path, frozenset({*decoded, *handlers}), handle)
    return _select_recording(path, recovered, decoder)[0]


@pause_collection()
def select_messages(path: Path, recovered: RecoveredLog) -> tuple[Recording, list[LogMessage]]:
    """Return (recording, message of each of its items) from a recovered log."""
    messages = recovered.messages
    decoder = _Decoder(sum(len(message.payload) for message in messages))
    recording, numbers = _select_recording(path, recovered, decoder)
    order = recording.items.order.tolist()
    return recording, [recovered.messages[numbers[source][place]] for source, place in order]


def _select_recording(
    path: Path, recovered: RecoveredLog, decoder: "_Decoder"
) -> tuple[Recording, list[Int1D]]:
    """Return (recording, numbers of the messages of its items), after the last are decoded.

    Messages are numbered as they are decoded; numbers are by source, see `StoredItems.order`.
    """
    problems = _assign_unnamed_topics(recovered)
    topics_present = {*recovered.topics, *(message.topic for message in recovered.messages)}
    if topics_present and not topics_present & TOPIC_TYPES.keys():
        foreign = sorted(topic[:80] for topic in recovered.topics)
        raise InputError(
            f"an MCAP file, but not a shaketwin log (topics: {', '.join(foreign[:5])})",
            where=path,
            remedy="give the run.mcap of a run",
        )
    for first in range(0, len(recovered.messages), DECODED_AT_ONCE):
        decoder.add(recovered.messages[first : first + DECODED_AT_ONCE])
    start = _find_start(path, decoder, recovered)
    records, own, rejected = decoder.select_records(start, recovered.is_intact)
    series, numbers = {}, [own]
    problems += rejected
    for topic in SERIES_TOPICS:
        series[topic], own, rejected = decoder.select_series(topic, start, recovered.is_intact)
        numbers.append(own)
        problems += rejected
    try:
        read_schema_version(path, recovered.metadata)
    except InputError as error:
        if recovered.is_intact:
            raise
        problems.append(str(error))  # the version may be damaged: read the rest
    damage = (
        *recovered.damage,
        *(
            Damage(0, 0, text)
            for text in (*_count_repeats(decoder.errors), *_count_repeats(problems))
        ),
    )
    items = StoredItems(records, series)
    extras = recovered.metadata, recovered.attachments
    return Recording(path, start.run, start, items, not damage, damage, *extras), numbers


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


class _Entry(NamedTuple):
    """Decoded message; `key` tells it from others of its topic and index."""

    topic: str
    sequence: int
    key: bytes  # the payload, or of a series, which are large and many, its checksum
    item: Item
    run: str
    number: int  # of the message as they were decoded; of a series, of the item in it


def _rejection_reason(entry: _Entry, before: Block | None, start: RunStart) -> str:
    """Return why an item is invalid in the run of `start` after block `before`, or ""."""
    if entry.run != start.run:
        return "of another run"
    if isinstance(entry.item, Block):
        return validate_block(entry.item, before, start)
    return validate_record(entry.item, start)


class _Decoder:
    """Decodes messages as they are read: records, and the series of a topic into columns."""

    def __init__(self, content_bytes: int) -> None:
        self.entries: list[_Entry] = []  # of records
        self.errors: list[str] = []  # of messages that do not decode
        self.count = 0
        self._stores = {
            topic: SeriesStore(lambda rows: content_bytes // (8 * rows + MIN_COLUMN_BYTES))
            for topic in SERIES_TOPICS
        }
        # Number and sequence of the message of each item of a series, and number of its run.
        self._origins = {topic: [np.empty((3, 0), np.int64)] for topic in SERIES_TOPICS}
        self._runs: dict[str, int] = {}
        self._unusual: set[str] = set()  # topics with a number out of range

    def add(self, messages: Sequence[LogMessage]) -> None:
        """Decode messages, in any order."""
        numbers: dict[str, list[int]] = {}
        for number, message in enumerate(messages):
            numbers.setdefault(message.topic, []).append(number)
        for topic in numbers.keys() & TOPIC_TYPES.keys():
            selected = [messages[number] for number in numbers[topic]]
            if topic in self._stores:
                self._add_series(topic, selected, self.count + np.array(numbers[topic]))
                continue
            for number, message in zip(numbers[topic], selected, strict=True):
                try:
                    run, item = decode_item(topic, message.payload)
                except WireError as error:
                    self.errors.append(str(error))
                    continue
                origin = message.sequence, message.payload
                self.entries.append(_Entry(topic, *origin, item, run, self.count + number))
        self.count += len(messages)

    def _add_series(self, topic: str, messages: list[LogMessage], numbers: Int1D) -> None:
        sequences = np.array([message.sequence for message in messages])
        payloads = [message.payload for message in messages]
        for series in decode_series(topic, payloads, self.errors):
            places, run, head, index, values, integers = series
            if has_invalid_numbers(head, values, integers):
                self._unusual.add(topic)
            self._stores[topic].add(head, index, values, integers)
            runs = np.full_like(places, self._runs.setdefault(run, len(self._runs)))
            self._origins[topic].append(np.array([numbers[places], sequences[places], runs]))

    def select_records(
        self, start: RunStart, is_intact: bool
    ) -> tuple[list[Record], Int1D, list[str]]:
        """Return the valid records in order, the numbers of their messages, and problems."""
        kept, problems = _select_valid(self.entries, start, is_intact)
        self.entries.clear()  # with their payloads
        numbers = np.array([entry.number for entry in kept], np.int64)
        return [cast(Record, entry.item) for entry in kept], numbers, problems

    def select_series(
        self, topic: str, start: RunStart, is_intact: bool
    ) -> tuple[Series, Int1D, list[str]]:
        """Return the valid items of a topic in order, the numbers of their messages, and problems.

        The usual series, of one run and in order, is valid as its first item is.
        """
        arrived = self._stores.pop(topic).close()
        numbers, sequences, runs = np.concatenate(self._origins.pop(topic), axis=1)
        order = np.argsort(arrived.index, kind="stable")
        series = arrived.take(order)
        problems: list[str] = []
        if not self._is_usual(topic, series, start):
            names = list(self._runs)
            entries = [
                _Entry(topic, sequence, _find_key(item), item, names[run], place)
                for place, (item, sequence, run) in enumerate(
                    zip(arrived, sequences.tolist(), runs.tolist(), strict=True)
                )
            ]
            kept, problems = _select_valid(entries, start, is_intact)
            order = np.array([entry.number for entry in kept], np.int64)
            series = arrived.take(order)
        return series, numbers[order], problems

    def _is_usual(self, topic: str, series: Series, start: RunStart) -> bool:
        """Return whether all items in this order are like the first of them, which is valid."""
        if not len(series):
            return True
        end = series.index + series.places[:, 1]
        first = _Entry(topic, 0, b"", series.read(0), start.run, 0)
        return (
            [*self._runs] == [start.run]
            and topic not in self._unusual
            and len(series.columns) == 1
            and not _rejection_reason(first, None, start)
            and bool((series.places[:, 1] > 0).all() and (series.index[1:] >= end[:-1]).all())
            and end[-1] <= start.rate_hz * MAX_DURATION_S
        )


def _find_key(item: SeriesItem) -> bytes:
    """Return the checksum of the numbers of an item."""
    return zlib.crc32(b"".join(part.tobytes() for part in split_item(item))).to_bytes(4)


def _find_start(path: Path, decoder: _Decoder, recovered: RecoveredLog) -> RunStart:
    """Return the start record or its copy; raise InputError if both are missing."""
    problems = [*decoder.errors]
    for entry in decoder.entries:
        if isinstance(entry.item, RunStart):
            if not (reason := validate_start(entry.item)):
                return entry.item
            problems.append(f"{START_TOPIC}: {reason}")
    if (copy := recovered.attachments.get(START_COPY_NAME)) is not None:
        recovered.messages.append(LogMessage(START_TOPIC, 0, copy))
        decoder.add(recovered.messages[-1:])
        item = decoder.entries[-1].item if decoder.entries else None
        if isinstance(item, RunStart):
            decoder.errors.append(f"{START_TOPIC}: lost; its copy is used")
            return item
    if problems:
        raise InputError(f"damaged or foreign: {problems[0]}", where=path, key=START_TOPIC)
    raise InputError("missing, so profile and model are unknown", where=path, key=START_TOPIC)


def _select_valid(
    entries: list[_Entry], start: RunStart, is_intact: bool
) -> tuple[list[_Entry], list[str]]:
    """Return (entries that are valid together in one run, reasons of rejection of the others).

    In order of sample index.
    """
    kept: list[_Entry] = []
    problems = []
    last_blocks: dict[str, Block] = {}
    seen_keys: set[tuple[str, int, bytes]] = set()
    for entry in sorted(
        entries, key=lambda entry: (entry.item.index, TOPIC_ORDER[entry.topic], entry.key)
    ):
        topic, item = entry.topic, entry.item
        if not is_intact:  # a repeated chunk repeats each of its messages
            key = (topic, entry.sequence, entry.key)
            if key in seen_keys:
                problems.append(f"{topic}: duplicate message")
                continue
            seen_keys.add(key)
        before = last_blocks.get(item.stream) if isinstance(item, Block) else None
        reason = _rejection_reason(entry, before, start)
        if item is not start and (reason or isinstance(item, RunStart)):
            problems.append(f"{topic}: {reason or 'duplicate message'}")
            continue
        if isinstance(item, Block):
            last_blocks[item.stream] = item
        kept.append(entry)
    return kept, problems


def _count_repeats(texts: Iterable[str]) -> list[str]:
    """Return each text once, with its count."""
    return [
        text if count == 1 else f"{text} ({count} messages)"
        for text, count in Counter(texts).most_common(20)
    ]
