"""One log from the parts of a recording; memory stays bounded however long it was."""

import contextlib
import heapq
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

from table_io.card import BadInput
from table_io.records import RunStart
from twin.stream.content import START_COPY, Content, schema_version
from twin.stream.mcap_log import LogWriter, each, heading, metadata
from twin.stream.recording import ORDER, START
from twin.stream.salvage import Message, salvage
from twin.stream.wire import WireError, decode

RUN_BYTES = 32 * 2**20  # sorted at once
CHUNK_BYTES = 2**16  # held of each piece while they are joined
MESSAGE_BYTES = 250  # of memory beside its payload


def merge(parts: list[Path], out: Path, run_bytes: int = RUN_BYTES) -> int:
    """Write the messages of all parts to `out` by sample index, duplicates dropped.

    Returns the number of messages. The parts stay as they are. What does not fit into `run_bytes`
    is sorted in pieces, which stand beside `out` meanwhile; BadInput where `out` exists, or a part
    is of a newer schema version, whose bytes `out` would call those of this one.
    """
    for part in parts:
        schema_version(part, heading(part))
    start = _start(parts)
    writer = LogWriter(out, start.rate_hz)
    try:
        writer.describe(start)
        with TemporaryDirectory(prefix=".merging-", dir=out.parent) as folder:
            runs = list(_runs(parts, Path(folder), start.rate_hz, run_bytes))
            count = _write(writer, _unique(heapq.merge(*runs, key=_place)), start.rate_hz)
        writer.close()
    except BaseException:
        out.unlink()  # this call made it
        raise
    return count


def verified(path: Path) -> bool:
    """True where a log ends as it should and its messages have the hash that it states."""
    content = Content()
    try:
        for one in each(path):
            content.add(one.topic, one.log_time, one.payload)
        return metadata(path).get("content") == content.record()
    except BadInput:
        return False  # it is no log at all


def _start(parts: list[Path]) -> RunStart:
    for one in chain.from_iterable(map(_starts, parts)):
        with contextlib.suppress(WireError):
            start = decode(START, one)[1]
            assert isinstance(start, RunStart)
            return start
    raise BadInput(
        f"{parts[0]}: holds no start record; the parts are kept as they are, see "
        f"`shaketwin verify {parts[0].parent.parent}`"
    )


def _starts(part: Path) -> Iterator[bytes]:
    """The start record of a part, and its copy where the chunk with it was lost."""
    yield from (one.payload for one in each(part) if one.topic == START)
    yield from filter(None, [salvage(part, frozenset({START})).attachments.get(START_COPY)])


def _place(one: Message) -> tuple[int, int, bytes]:
    return one.log_time, ORDER[one.topic], one.payload


def _runs(
    parts: list[Path], folder: Path, rate_hz: float, run_bytes: int
) -> Iterator[Iterable[Message]]:
    """Everything in all parts as sorted runs: the last one in memory, the others in files."""
    held: list[Message] = []
    size = 0
    for one in chain.from_iterable(map(each, parts)):
        if one.topic not in ORDER:
            continue
        held.append(one)
        size += len(one.payload) + MESSAGE_BYTES
        if size > run_bytes:
            path = folder / f"{len(list(folder.iterdir())):06d}.mcap"
            writer = LogWriter(path, rate_hz, CHUNK_BYTES)
            _write(writer, sorted(held, key=_place), rate_hz)
            writer.close()
            yield each(path)
            held, size = [], 0
    yield sorted(held, key=_place)


def _unique(messages: Iterable[Message]) -> Iterator[Message]:
    """Each message once, of sorted ones; what two recorders wrote differs in publish_time."""
    last = None
    for one in messages:
        if last is None or _place(one) != _place(last):
            yield one
        last = one


def _write(writer: LogWriter, messages: Iterable[Message], rate_hz: float) -> int:
    count = 0
    for one in messages:
        index = round(one.log_time * rate_hz / 1e9)
        writer.write(one.topic, one.payload, index, one.publish_time)
        count += 1
    return count
