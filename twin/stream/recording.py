"""A log, read: everything in it that can be had, in order of sample index, and what could not."""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from table_io.block import Block, join
from table_io.card import BadInput
from table_io.records import Record, RunStart, RunStop
from twin.stream.blocks import decode_blocks
from twin.stream.content import START_COPY, schema_version
from twin.stream.mcap_log import each, heading
from twin.stream.salvage import NAMELESS, Damage, Message, Salvaged, salvage
from twin.stream.soundness import misfit, mislabelled, unsound, unsound_start
from twin.stream.wire import (
    BLOCK_TOPICS,
    RECORD_TOPICS,
    TOPIC_TYPES,
    Item,
    WireError,
    decode,
    encode,
)

START = RECORD_TOPICS[RunStart]
# Which of the items of one sample index comes first: the start, then as the table of topics has
# it, the stop last; so a recording reads the same in whatever order its parts were written.
ORDER = {topic: place for place, topic in enumerate(TOPIC_TYPES)}
ORDER |= {START: -1, RECORD_TOPICS[RunStop]: len(TOPIC_TYPES)}
R = TypeVar("R", bound=Record)


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole log in memory.

    `whole` is of the file: True where it is undamaged, and every message of the topics that were
    read can be of its run. Whether the test is whole is told by `stop` and `missing_samples`.
    """

    path: Path
    run: str
    start: RunStart
    items: tuple[Item, ...]
    whole: bool
    damage: tuple[Damage, ...] = ()
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    _pieces: dict[str, tuple[Block, ...]] = field(default_factory=dict, repr=False, compare=False)

    def of(self, kind: type[R]) -> tuple[R, ...]:
        """All records of one kind, in order of sample index."""
        return tuple(item for item in self.items if isinstance(item, kind))

    def blocks(self, stream: str) -> tuple[Block, ...]:
        """All blocks of stream "meas" or "pred", in order of sample index."""
        return tuple(
            item for item in self.items if isinstance(item, Block) and item.stream == stream
        )

    def pieces(self, stream: str) -> tuple[Block, ...]:
        """The stream joined into as few blocks as its gaps allow; joined once."""
        if stream not in self._pieces:
            runs: list[list[Block]] = []
            for block in self.blocks(stream):
                if runs and runs[-1][-1].end == block.index:
                    runs[-1].append(block)
                else:
                    runs.append([block])
            self._pieces[stream] = tuple(join(run) for run in runs)
        return self._pieces[stream]

    @property
    def stop(self) -> RunStop | None:
        stops = self.of(RunStop)
        return stops[-1] if stops else None

    @property
    def missing_samples(self) -> int:
        """Measured samples between the first and the last index that are not in the file."""
        pieces = self.pieces("meas")
        end = self.stop.index if self.stop else (pieces[-1].end if pieces else 0)
        return end - self.start.index - sum(len(piece) for piece in pieces)


def read(path: Path, topics: Iterable[str] = TOPIC_TYPES) -> Recording:
    """The recording in `path`, of `topics` only and its start; BadInput where it is none of ours.

    A damaged one gives what is left of it, and says in `damage` what is not.
    """
    return understood(path, salvage(path, frozenset((START, *topics))))[0]


def understood(path: Path, found: Salvaged) -> tuple[Recording, list[Message]]:
    """(the recording that a file holds, the message of each of its items)."""
    odd = _recognised(found)
    there = {*found.topics, *(one.topic for one in found.messages)}
    if there and not there & TOPIC_TYPES.keys():
        foreign = sorted(one[:80] for one in found.topics)
        raise BadInput(
            f"{path}: an MCAP file, but not a shaketwin log (topics: {', '.join(foreign[:5])}); "
            "give the run.mcap of a run"
        )
    entries, faults = _decoded([one for one in found.messages if one.topic in TOPIC_TYPES])
    start = _start(path, entries, faults, found.attachments.get(START_COPY))
    odd += _unlabelled(entries)
    entries.sort(key=lambda entry: (entry[1].index, ORDER[entry[0].topic], entry[0].payload))
    kept, misfits = _fitting(entries, start, found.whole)
    odd += misfits
    try:
        schema_version(path, found.metadata)
    except BadInput as error:
        if found.whole:
            raise
        odd.append(str(error))  # a damaged text, perhaps: what can be read is read
    damage = (*found.damage, *(Damage(0, 0, text) for text in (*_counted(faults), *_counted(odd))))
    items = tuple(item for _, item in kept)
    about = found.metadata, found.attachments
    recording = Recording(path, start.run, start, items, not damage, damage, *about)
    return recording, [message for message, _ in kept]


def _recognised(found: Salvaged) -> list[str]:
    """Give nameless messages the topic of which they are to the byte, if there is one of the run.

    So a recorder that was killed, and whose first chunk was lost, has not written for nothing.
    """
    if not any(topic.startswith(NAMELESS) for topic in found.topics):
        return []
    run = found.metadata.get("run", {}).get("id", "")
    names: dict[str, str] = {}
    for one in found.messages:
        if one.topic.startswith(NAMELESS) and one.topic not in names:
            alike = (topic for topic in TOPIC_TYPES if _is_of(topic, one.payload, run))
            names[one.topic] = next(alike, one.topic)
    found.messages = [one._replace(topic=names.get(one.topic, one.topic)) for one in found.messages]
    return [f"topic unknown: {one.topic}" for one in found.messages if one.topic in names]


def _is_of(topic: str, payload: bytes, run: str) -> bool:
    try:
        of, item = decode(topic, payload)
    except WireError:
        return False
    return of == run != "" and encode(item, run) == payload


def start_of(path: Path) -> RunStart:
    """The start record of a log, without reading on; where it is not sound, as `read` finds it.

    BadInput where there is none, or where the log is of a newer schema version.
    """
    try:
        schema_version(path, heading(path))
        first = next((one for one in each(path) if one.topic == START), None)
        start = decode(START, first.payload)[1] if first else None
    except (BadInput, OSError, WireError):
        start = None
    sound = isinstance(start, RunStart) and not unsound_start(start)
    return start if isinstance(start, RunStart) and sound else read(path, ()).start


def fitting(
    topic: str, payloads: Iterable[bytes], start: RunStart, odd: list[str]
) -> Iterator[Item]:
    """The items of a topic that can be in the run of `start`, and not the start itself.

    By the rules of `read`, for who reads message by message; `odd` gets why others cannot. In
    whatever order they come: which of two that hold the same samples is taken is the caller's.
    """
    entries, faults = _decoded([Message(topic, 0, one) for one in payloads])
    odd += faults
    odd += _unlabelled(entries)
    for _, item, run in entries:
        if why := _foreign(item, run, None, start):
            odd.append(f"{topic}: {why}")
        elif not isinstance(item, RunStart):
            yield item


def _foreign(item: Item, run: str, before: Block | None, start: RunStart) -> str:
    """Why an item cannot be in the run of `start`, after `before` of its stream."""
    if run != start.run:
        return "of another run"
    return misfit(item, before, start) if isinstance(item, Block) else unsound(item, start)


Entry = tuple[Message, Item, str]  # as it stands in the file, what it is, of which run


def _decoded(raw: list[Message]) -> tuple[list[Entry], list[str]]:
    """(every message that is what its topic promises, why the others are not)."""
    entries: list[Entry] = []
    faults = []
    by_topic: dict[str, list[Message]] = {}
    for one in raw:
        by_topic.setdefault(one.topic, []).append(one)
    for name, some in by_topic.items():
        payloads = [one.payload for one in some]
        blocks = name in BLOCK_TOPICS.values()
        results = decode_blocks(name, payloads) if blocks else _records(name, payloads)
        for one, result in zip(some, results, strict=True):
            if isinstance(result, WireError):
                faults.append(str(result))
            else:
                entries.append((one, result[1], result[0]))
    return entries, faults


def _records(name: str, payloads: list[bytes]) -> Iterable[tuple[str, Item] | WireError]:
    for payload in payloads:
        try:
            yield decode(name, payload)
        except WireError as error:
            yield error


def _start(path: Path, entries: list[Entry], faults: list[str], copy: bytes | None) -> RunStart:
    """The start record, or its copy; BadInput where there is neither."""
    odd = [*faults]
    for _, item, _ in entries:
        if isinstance(item, RunStart):
            if not (why := unsound_start(item)):
                return item
            odd.append(f"{START}: {why}")
    for result in _records(START, [copy] if copy is not None else []):
        if not isinstance(result, WireError) and isinstance(result[1], RunStart):
            entries.append((Message(START, 0, copy or b""), result[1], result[0]))
            faults.append(f"{START}: lost; its copy is taken")
            return result[1]
    if odd:
        raise BadInput(f"{path}: damaged or foreign: {odd[0]}")
    raise BadInput(f"{path}: holds no start record, so profile and model are unknown")


def _unlabelled(entries: list[Entry]) -> list[str]:
    """Take out the blocks with impossible labels, of which there is hardly ever one."""
    blocks = [item for _, item, _ in entries if isinstance(item, Block)]
    if not blocks or not mislabelled(blocks):
        return []
    count = len(entries)
    entries[:] = [
        one for one in entries if not (isinstance(one[1], Block) and mislabelled([one[1]]))
    ]
    return ["samples with labels that no drive has"] * (count - len(entries))


def _fitting(
    entries: list[Entry], start: RunStart, whole: bool
) -> tuple[list[tuple[Message, Item]], list[str]]:
    """(the items that can stand beside each other in one run, why others cannot)."""
    kept: list[tuple[Message, Item]] = []
    odd = []
    heads: dict[str, Block] = {}
    seen: set[tuple[str, int, bytes]] = set()
    for message, item, run in entries:
        if not whole:  # where a chunk stands twice, each of its messages does
            key = (message.topic, message.sequence, message.payload)
            if key in seen:
                odd.append(f"{message.topic}: there twice")
                continue
            seen.add(key)
        before = heads.get(item.stream) if isinstance(item, Block) else None
        why = _foreign(item, run, before, start)
        if item is not start and (why or isinstance(item, RunStart)):
            odd.append(f"{message.topic}: {why or 'there twice'}")
            continue
        if isinstance(item, Block):
            heads[item.stream] = item
        kept.append((message, item))
    return kept, odd


def _counted(texts: Iterable[str]) -> list[str]:
    """Each text once, with how often it was there."""
    return [
        text if count == 1 else f"{text} ({count} messages)"
        for text, count in Counter(texts).most_common(20)
    ]
