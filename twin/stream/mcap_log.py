"""The log: MCAP files whose messages are the bytes of the wire. The only file that knows mcap.

Layout: one topic a kind (see `wire.TOPIC_TYPES`), protobuf schemas inside, log_time from the sample
index, publish_time the wall clock. Profile, machine card and model stand in it as attachments from
the first moment, so that a killed recording explains itself.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from mcap.reader import NonSeekingReader
from mcap.writer import Writer

from table_io.block import Block, join
from table_io.card import BadInput
from table_io.clock import wall_ns
from table_io.records import Record, RunStart, RunStop
from twin.stream.wire import (
    BLOCK_TOPICS,
    RECORD_TOPICS,
    TOPIC_TYPES,
    Item,
    WireError,
    decode,
    encode,
    schema,
)

SCHEMA_VERSION = "1"
MAGIC = b"\x89MCAP0\r\n"
# Which of the items of one sample index comes first: the start, then as the table of topics has
# it, the stop last; so a recording reads the same in whatever order its parts were written.
ORDER = {topic: place for place, topic in enumerate(TOPIC_TYPES)}
ORDER |= {RECORD_TOPICS[RunStart]: -1, RECORD_TOPICS[RunStop]: len(TOPIC_TYPES)}
R = TypeVar("R", bound=Record)


class LogWriter:
    """Writes items to a new MCAP file; refuses a file that exists."""

    def __init__(self, path: Path, rate_hz: float) -> None:
        self.path = path
        self._rate_hz = rate_hz
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise BadInput(
                f"{path}: exists already; nothing recorded is ever overwritten"
            ) from None
        except OSError as error:
            raise BadInput(f"{path}: cannot write here: {error.strerror}") from None
        # With a checksum over everything, a record that is lost inside the file cannot go unseen.
        self._writer = Writer(self._file, enable_data_crcs=True)
        self._writer.start(profile="shaketwin", library="shaketwin")
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}

    def write(self, topic: str, payload: bytes, index: int) -> None:
        """Append the bytes of one item that holds from sample `index`."""
        if topic not in self._channels:
            name, data = schema(TOPIC_TYPES[topic])
            schema_id = self._writer.register_schema(name, "protobuf", data)
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema_id)
        sequence = self._sequence.get(topic, 0)
        self._sequence[topic] = sequence + 1
        self._writer.add_message(
            self._channels[topic],
            log_time=round(index * 1e9 / self._rate_hz),
            data=payload,
            publish_time=wall_ns(),
            sequence=sequence % 2**32,
        )

    def describe(self, start: RunStart) -> None:
        """Put the texts and versions of the run into the file, before its first message."""
        for name, text in (
            ("profile.toml", start.profile_toml),
            ("rig.toml", start.rig_toml),
            ("model.toml", start.model_toml),
        ):
            self._writer.add_attachment(wall_ns(), 0, name, "application/toml", text.encode())
        self._writer.add_metadata(
            "run", {"id": start.run, "schema": SCHEMA_VERSION, "host": start.host, **start.versions}
        )

    def flush(self) -> None:
        """Close the chunk: what was written so far survives the death of this process."""
        self._writer.flush()
        self._file.flush()

    def fileno(self) -> int:
        """Descriptor of the file, for a sync to disk."""
        return self._file.fileno()

    def close(self) -> None:
        """Finish the file."""
        if not self._file.closed:
            self._writer.finish()
            self._file.close()


@dataclass(frozen=True, slots=True)
class Message:
    """One message of a log, still as bytes."""

    topic: str
    log_time: int
    payload: bytes


def messages(path: Path) -> tuple[list[Message], bool]:
    """(every complete message in file order, True if the file ends as it should).

    A file that was cut off before its first message has none; BadInput where it is no MCAP file.
    """
    found: list[Message] = []
    try:
        with path.open("rb") as stream:
            if not MAGIC.startswith(stream.read(len(MAGIC))):
                raise BadInput(f"{path}: not an MCAP file; give the run.mcap of a run")
            stream.seek(0)
            reader = NonSeekingReader(stream, validate_crcs=True)
            try:
                for _, channel, message in reader.iter_messages(log_time_order=False):
                    found.append(Message(channel.topic, message.log_time, message.data))
            except Exception:
                # Where a file is cut or damaged, the parser and its decompressor fail in any way.
                return found, False
    except OSError as error:
        raise BadInput(f"{path}: cannot read this log: {error.strerror}") from None
    return found, True


@dataclass(frozen=True, slots=True)
class Recording:
    """A whole log in memory. `whole` is False where the file was cut off."""

    path: Path
    run: str
    start: RunStart
    items: tuple[Item, ...]
    whole: bool

    def of(self, kind: type[R]) -> tuple[R, ...]:
        """All records of one kind, in order of sample index."""
        return tuple(item for item in self.items if isinstance(item, kind))

    def blocks(self, stream: str) -> tuple[Block, ...]:
        """All blocks of stream "meas" or "pred", in order of sample index."""
        return tuple(
            item for item in self.items if isinstance(item, Block) and item.stream == stream
        )

    def pieces(self, stream: str) -> tuple[Block, ...]:
        """The stream joined into as few blocks as its gaps allow."""
        runs: list[list[Block]] = []
        for block in self.blocks(stream):
            if runs and runs[-1][-1].end == block.index:
                runs[-1].append(block)
            else:
                runs.append([block])
        return tuple(join(run) for run in runs)

    @property
    def stop(self) -> RunStop | None:
        stops = self.of(RunStop)
        return stops[-1] if stops else None

    @property
    def missing_samples(self) -> int:
        """Measured samples between the first and the last index that are not in the file."""
        pieces = self.pieces("meas")
        end = self.stop.index if self.stop else (pieces[-1].end if pieces else 0)
        return end - sum(len(piece) for piece in pieces)


def read(path: Path) -> Recording:
    """The recording in `path`; BadInput where it is no log of ours."""
    raw, whole = messages(path)
    foreign = sorted({message.topic for message in raw} - set(TOPIC_TYPES))
    if foreign and not {message.topic for message in raw} & set(TOPIC_TYPES):
        raise BadInput(
            f"{path}: an MCAP file, but not a shaketwin log (topics: {', '.join(foreign[:5])}); "
            "give the run.mcap of a run"
        )
    try:
        decoded = [
            (*decode(one.topic, one.payload), (ORDER[one.topic], one.payload))
            for one in raw
            if one.topic in TOPIC_TYPES
        ]
    except WireError as error:
        raise BadInput(f"{path}: damaged or foreign: {error}") from None
    starts = [(run, item) for run, item, _ in decoded if isinstance(item, RunStart)]
    if not starts:
        raise BadInput(f"{path}: holds no start record, so profile and model are unknown")
    run, start = starts[0]
    assert isinstance(start, RunStart)
    decoded.sort(key=lambda entry: (entry[1].index, entry[2]))
    return Recording(path, run, start, tuple(item for _, item, _ in decoded), whole)


def merge(parts: list[Path], out: Path) -> int:
    """Write the messages of all parts to `out` by sample index, duplicates dropped.

    Returns the number of messages. The parts stay as they are.
    """
    seen: set[tuple[str, bytes]] = set()
    unique: list[Message] = []
    for part in parts:
        for message in messages(part)[0]:
            key = (message.topic, message.payload)
            if key not in seen:
                seen.add(key)
                unique.append(message)
    starts = [decode(one.topic, one.payload)[1] for one in unique if one.topic == "/run/start"]
    if not starts or not isinstance(starts[0], RunStart):
        raise BadInput(f"{parts[0]}: holds no start record; the parts are kept as they are")
    start = starts[0]
    writer = LogWriter(out, start.rate_hz)
    writer.describe(start)
    for message in sorted(unique, key=lambda one: (one.log_time, ORDER[one.topic], one.payload)):
        writer.write(message.topic, message.payload, round(message.log_time * start.rate_hz / 1e9))
    writer.close()
    return len(unique)


def topics() -> Iterator[str]:
    """Every topic that a log can hold."""
    yield from (*BLOCK_TOPICS.values(), *RECORD_TOPICS.values())


def write_items(path: Path, items: list[Item], start: RunStart) -> None:
    """A new log with these items, for tests and conversions."""
    from twin.stream.wire import topic

    writer = LogWriter(path, start.rate_hz)
    writer.describe(start)
    for item in items:
        writer.write(topic(item), encode(item, start.run), item.index)
    writer.close()
