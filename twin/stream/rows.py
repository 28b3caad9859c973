"""A log as rows: one a measured sample, with all columns of it side by side, for other formats.

The samples lie in scratch files, so that memory does not grow with the recording, and in whatever
order and however often they were recorded, each has one row, in the order of its index. A gap has
no rows; where the twin said nothing its columns are NaN. What cannot be in the run is left out, by
the rules of `recording.read`.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from table_io.block import Block, Float1D, Float2D, Int1D
from table_io.card import BadInput
from table_io.channels import BY_NAME
from table_io.records import Decided, Event, Point, Record, RunStart, RunStop, Step
from twin.stream.blocks import BATCH
from twin.stream.mcap_log import each
from twin.stream.recording import START, fitting, start_of
from twin.stream.wire import (
    BLOCK_TOPICS,
    MEAS_TOPIC,
    PRED_TOPIC,
    TOPIC_TYPES,
    Item,
)

# What is said of every sample beside its channels, and its unit.
LABELS = {
    "step": "", "label": "", "cycle": "", "direction": "", "frequency_hz": "Hz",
    "level_m_s2": "m/s2",
}  # fmt: skip
WAYS = {"forward": 1, "backward": -1}
TIME = "time_s"
TWIN = "twin_"
MARKS = ("index", "step", "label", "cycle")  # of every sample, before its channels
KEPT = (RunStop, Event, Point, Decided)
SLACK_S = 1.0
WINDOW = 2**14  # rows at once
Columns = dict[str, Any]  # arrays (row,), float64 or int64


@dataclass(eq=False)
class _Scratch:
    """The blocks of one stream as they came: (sample, MARKS and channels) of float64."""

    names: tuple[str, ...] = ()
    size: int = 0  # samples
    file: Any = field(default_factory=TemporaryFile)

    def add(self, block: Block, path: Path) -> None:
        """Append the samples of a block."""
        if not self.size:
            self.names = block.channels
        if block.channels != self.names:
            raise BadInput(
                f"{path}: sample {block.index} has other channels than those before it; "
                "it cannot be one table"
            )
        index = np.arange(block.index, block.end)
        rows = np.vstack([index, block.step, block.label, block.cycle, block.values]).T
        self.file.write(np.ascontiguousarray(rows, np.float64).tobytes())
        self.size += len(block)

    def sorted(self) -> tuple[Float2D, Int1D, Int1D]:
        """(the scratch file, its places by rising index, those indices), each index once."""
        width = len(MARKS) + len(self.names)
        if not self.size:
            return np.empty((0, width)), np.empty(0, np.int64), np.empty(0, np.int64)
        self.file.flush()
        scratch = np.memmap(self.file, np.float64, "r", shape=(self.size, width))
        index = scratch[:, 0].astype(np.int64)
        if (np.diff(index) > 0).all():
            return scratch, np.arange(self.size), index
        index, places = np.unique(index, return_index=True)
        return scratch, places, index


@dataclass(frozen=True, eq=False)
class Rows:
    """The rows of a log; `units` are those of its columns, in their order."""

    start: RunStart
    units: dict[str, str]
    steps: dict[int, Step]
    records: tuple[Record, ...]  # events and points
    whole: bool  # it has its end, and nothing had to be left out
    measured: Float2D  # scratch (sample, MARKS and channels)
    predicted: Float2D
    places: Int1D  # (2, row): in `measured`, and in `predicted` or -1
    channels: tuple[tuple[str, ...], tuple[str, ...]]  # column names of both

    @property
    def size(self) -> int:
        return int(self.places.shape[1])

    @property
    def texts(self) -> dict[str, str]:
        """The TOML texts that make the run repeatable."""
        names = ("profile_toml", "rig_toml", "model_toml")
        return {name: getattr(self.start, name) for name in names}

    def windows(self) -> Iterator[Columns]:
        """All columns, a window of rows after the other."""
        for first in range(0, self.size, WINDOW):
            yield self.window(slice(first, first + WINDOW))

    def window(self, rows: slice, *only: str) -> Columns:
        """The columns of some rows, or `only` those."""
        own, twins = self.places[:, rows]
        spoken = twins >= 0
        step, label, cycle = (self.measured[own, k].astype(np.int64) for k in range(1, len(MARKS)))
        found: Columns = {TIME: self.index(rows) / self.start.rate_hz}
        found |= _labels(step, label, cycle, self.steps)
        for k, name in enumerate(self.channels[0], start=len(MARKS)):
            if name in (only or self.units):
                found[name] = self.measured[own, k]
        for k, name in enumerate(self.channels[1], start=len(MARKS)):
            if name in (only or self.units):
                found[name] = np.full(own.size, np.nan)
                found[name][spoken] = self.predicted[twins[spoken], k]
        return {name: found[name] for name in only or self.units}

    def index(self, rows: slice) -> Int1D:
        """Sample index of some rows, (row,)."""
        return self.measured[self.places[0, rows], 0].astype(np.int64)

    def chosen(self, channels: tuple[str, ...], steps: tuple[int, int] | None) -> "Rows":
        """Only these channels and the samples of steps first to last; all where nothing is said."""
        unknown = sorted(set(channels) - self.units.keys())
        if unknown:
            raise BadInput(f"no column {', '.join(unknown)}; there: {', '.join(self.units)}")
        kept = {TIME, *LABELS, *channels} if channels else self.units.keys()
        units = {name: unit for name, unit in self.units.items() if name in kept}
        if steps is None:
            return replace(self, units=units)
        step = self.measured[self.places[0], MARKS.index("step")]
        inside = (step >= steps[0]) & (step <= steps[1])
        if not inside.any():
            raise BadInput(f"no sample in steps {steps[0]} to {steps[1]}")
        return replace(self, units=units, places=self.places[:, inside])


def gather(path: Path) -> Rows:
    """The rows of a log; BadInput where it is none, or its start is missing."""
    start = start_of(path)
    streams = {topic: _Scratch() for topic in BLOCK_TOPICS.values()}
    waiting: dict[str, list[bytes]] = {topic: [] for topic in streams}
    records: dict[bytes, Record] = {}
    odd: list[str] = []

    def take(topic: str, payloads: list[bytes]) -> None:
        for block in fitting(topic, payloads, start, odd):
            assert isinstance(block, Block)
            streams[topic].add(block, path)
        payloads.clear()

    for message in each(path):
        payloads = waiting.get(message.topic)
        if payloads is not None:
            payloads.append(message.payload)
            if len(payloads) == BATCH:
                take(message.topic, payloads)
        elif issubclass(TOPIC_TYPES.get(message.topic, object), KEPT):
            for one in fitting(message.topic, [message.payload], start, odd):
                records[message.payload] = one  # type: ignore[assignment]
    for topic, payloads in waiting.items():
        take(topic, payloads)
    told = sorted(records.values(), key=lambda one: one.index)
    found = _joined(start, told, streams[MEAS_TOPIC], streams[PRED_TOPIC])
    return replace(found, whole=found.whole and not odd)


def batches(path: Path, count: int) -> Iterator[list[Item]] | None:
    """The items of a log, about `count` at a time; None where they do not stand in their order.

    The order is that of a recording: the start first, the rest no later than SLACK_S by its index.
    """
    start = start_of(path)
    latest = 0
    for place, message in enumerate(each(path)):
        if (message.topic == START) != (place == 0) or message.log_time < latest - 1e9 * SLACK_S:
            return None
        latest = max(latest, message.log_time)
    return _batches(path, count, start)


def _batches(path: Path, count: int, start: RunStart) -> Iterator[list[Item]]:
    yield [start]
    messages = (one for one in each(path) if one.topic in TOPIC_TYPES)
    while batch := list(islice(messages, count)):
        found: list[Item] = []
        for topic in dict.fromkeys(one.topic for one in batch):
            payloads = [one.payload for one in batch if one.topic == topic]
            found += fitting(topic, payloads, start, [])
        yield sorted(found, key=lambda item: item.index)


def _joined(start: RunStart, records: list[Record], meas: _Scratch, pred: _Scratch) -> Rows:
    measured, places, index = meas.sorted()
    predicted, twin_places, told = pred.sorted()
    beside = np.full(places.size, -1)
    if told.size:
        at = np.minimum(np.searchsorted(told, index), told.size - 1)
        beside = np.where(told[at] == index, twin_places[at], -1)
    twins = tuple(TWIN + name.replace("/", "_") for name in pred.names)
    units = {TIME: "s", **dict(zip(meas.names, map(unit, meas.names), strict=True)), **LABELS}
    units |= dict(zip(twins, map(unit, pred.names), strict=True))
    return Rows(
        start,
        units,
        all_steps(start, records),
        tuple(one for one in records if isinstance(one, (Event, Point))),
        any(isinstance(one, RunStop) for one in records),
        measured,
        predicted,
        np.array([places, beside]),
        (meas.names, twins),
    )


def all_steps(start: RunStart, items: Iterable[Item]) -> dict[int, Step]:
    """By index, the planned steps, then those that `items` say were decided on during the test."""
    steps = {one.index: one for one in start.steps}
    for one in items:
        if isinstance(one, Decided):
            steps[one.step] = Step(one.step, one.direction, one.frequency_hz, one.acceleration_m_s2)
    return steps


def unit(name: str) -> str:
    """SI unit of a channel, of the twin's too; "" of one that nobody knows."""
    plain = name.rpartition("/")[2]
    return BY_NAME[plain].unit if plain in BY_NAME else {"rel_vel_m_s": "m/s"}.get(plain, "")


def _labels(step: Int1D, label: Int1D, cycle: Int1D, steps: dict[int, Step]) -> Columns:
    """The columns of LABELS, (row,) each; 0 and NaN outside the steps."""
    numbers, place = np.unique(step, return_inverse=True)
    known = [steps.get(number) for number in numbers.tolist()]
    nan = float("nan")
    ways = np.array([WAYS.get(one.direction, 0) if one else 0 for one in known], dtype=np.int64)
    hertz: Float1D = np.array([one.frequency_hz if one else nan for one in known])
    levels: Float1D = np.array([one.acceleration_m_s2 if one else nan for one in known])
    columns = (step, label, cycle, ways[place], hertz[place], levels[place])
    return dict(zip(LABELS, columns, strict=True))
