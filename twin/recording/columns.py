"""Items of a recording: numbers in columns, and an object only for what is no series of numbers.

A block of a real-time run has a few samples: arrays and objects for every one of them, and for
every comparison, would take several times the memory of the numbers. Long columns lie in a
temporary file that is mapped into memory, so that what was read of them can be released.
"""

import mmap
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import compress, pairwise
from tempfile import TemporaryFile
from typing import TypeVar, cast, overload

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Bool1D, Float1D, Float2D, Int1D, Int2D, join_contiguous
from table_io.errors import InputError
from table_io.records import Comparison, Record, RunStart, RunStop
from twin.transport.codec import RECORD_TOPICS, TOPIC_TYPES, Item
from twin.transport.endpoint import BLOCK_TOPICS, CMP_TOPIC
from twin.transport.series import SeriesItem, join_item

# Order of items with the same sample index: start first, then by table of topics, stop last. So a
# recording reads the same in whatever order its parts were written.
TOPIC_ORDER = {topic: place for place, topic in enumerate(TOPIC_TYPES)}
TOPIC_ORDER |= {RECORD_TOPICS[RunStart]: -1, RECORD_TOPICS[RunStop]: len(TOPIC_TYPES)}
MAX_MEMORY_BYTES = 32 * 2**20  # of columns in memory; longer ones lie in a file
PIECE_SAMPLES = 2**16  # of a stream that is read piece by piece, at the most
R = TypeVar("R", bound=Record)


class Columns:
    """Numbers of items like `head`, which differ in these alone: appended up to a capacity.

    Rows of float64, and three rows of int64, as `codec.split_item` returns them. Memory is taken as
    it is filled, so a capacity may be generous.
    """

    def __init__(self, head: SeriesItem, rows: int, capacity: int) -> None:
        self.head, self.capacity, self.size = head, capacity, 0
        shape = rows + 3, capacity
        size = 8 * shape[0] * shape[1]
        self._map: mmap.mmap | None = None
        if size <= MAX_MEMORY_BYTES:
            self._rows = np.empty(shape)
            return
        self._file = TemporaryFile(buffering=0)  # noqa: SIM115 (as long as the columns)
        self._file.truncate(size)
        self._map = mmap.mmap(self._file.fileno(), size, access=mmap.ACCESS_READ)
        self._rows = np.frombuffer(self._map).reshape(shape)

    def append(self, values: Float2D, integers: Int2D) -> int:
        """Append columns, (row, column) each; return the place of the first."""
        first, self.size = self.size, self.size + values.shape[1]
        for row, numbers in enumerate((*values, *integers.view(np.float64))):
            if self._map is None:
                self._rows[row, first : self.size] = numbers
            else:
                self._write(8 * (row * self.capacity + first), numbers.tobytes())
        return first

    def _write(self, offset: int, data: bytes) -> None:
        """Write to the file and not to its map: a full disk is an error then, and no signal."""
        try:
            self._file.seek(offset)
            while data:
                data = data[self._file.write(data) :]
        except OSError as error:
            self.close()
            raise InputError(
                f"no room for a long recording: {error.strerror}",
                where="the folder of temporary files",
                remedy="free some space there, or set TMPDIR to a folder with more",
            ) from None

    def close(self) -> None:
        """Close the file: nothing more is appended. What was written stays until it is not used."""
        if self._map is not None:
            self._file.close()

    def read(self, first: int, end: int) -> tuple[Float2D, Int2D]:
        """Return the numbers (float64, int64) of columns first .. end - 1 as views."""
        part = self._rows[:, first:end]
        return part[:-3], part[-3:].view(np.int64)

    def release(self) -> None:
        """Give back the memory of what was read; it is read again when it is needed."""
        if self._map is not None and hasattr(mmap, "MADV_DONTNEED"):
            self._map.madvise(mmap.MADV_DONTNEED)


@dataclass(frozen=True, slots=True, eq=False)
class Series:
    """Items of one topic; `places` are (item, 4): sample index, length, columns, first column."""

    columns: tuple[Columns, ...]
    places: Int2D

    def __len__(self) -> int:
        return len(self.places)

    def __iter__(self) -> Iterator[SeriesItem]:
        return map(self.read, range(len(self)))

    @property
    def index(self) -> Int1D:
        """Sample index of each item, (item,)."""
        return self.places[:, 0]

    def read(self, place: int) -> SeriesItem:
        """Return an item, made anew; its numbers are views."""
        index, size, number, first = self.places[place].tolist()
        columns = self.columns[number]
        return join_item(columns.head, index, *columns.read(first, first + size))

    def take(self, places: Int1D) -> "Series":
        """Return the items at these places, in this order."""
        return Series(self.columns, self.places[places])

    def pick(self, channel: str, samples: Int1D) -> Float1D:
        """Return a channel of blocks at these samples, NaN where it was not recorded, (sample,)."""
        picked = np.full(samples.size, np.nan)
        for columns, is_inside, places in self._locate(samples):
            if channel in columns.head.channels:
                values, _ = columns.read(0, columns.size)
                picked[is_inside] = values[columns.head.channels.index(channel), places]
        return picked

    def pick_labels(self, samples: Int1D) -> Int2D:
        """Return step, label and cycle of blocks at these samples, -1 of others, (3, sample)."""
        picked = np.full((3, samples.size), -1)
        for columns, is_inside, places in self._locate(samples):
            picked[:, is_inside] = columns.read(0, columns.size)[1][:, places]
        return picked

    def _locate(self, samples: Int1D) -> Iterator[tuple[Columns, Bool1D, Int1D]]:
        """Yield columns with those of the samples that they have, and the places of these."""
        if not len(self):
            return
        nearest = np.maximum(np.searchsorted(self.index, samples, "right") - 1, 0)
        index, size, number, first = self.places[nearest].T
        is_known = (samples >= index) & (samples < index + size)
        for k, columns in enumerate(self.columns):
            is_inside = is_known & (number == k)
            yield columns, is_inside, (first + samples - index)[is_inside]

    def join(self) -> Iterator[SeriesItem]:
        """Yield one item for each run of those that follow each other, also in their columns."""
        index, size, number, first = self.places.T
        is_next = (index[1:] == (index + size)[:-1]) & (first[1:] == (first + size)[:-1])
        edges = [0, *np.flatnonzero(~(is_next & (np.diff(number) == 0))) + 1, len(self)]
        for begin, end in pairwise(edges):
            if begin < end:
                columns = self.columns[number[begin]]
                part = columns.read(first[begin], first[end - 1] + size[end - 1])
                yield join_item(columns.head, int(index[begin]), *part)


class SeriesStore:
    """Items of one topic as they come, in columns with room for `find_capacity(rows)`."""

    def __init__(self, find_capacity: Callable[[int], int]) -> None:
        self._find_capacity = find_capacity
        self._columns: list[Columns] = []
        self._places: list[Int2D] = [np.empty((0, 4), np.int64)]

    def add(self, head: SeriesItem, index: Int1D, values: Float2D, integers: Int2D) -> None:
        """Append items like `head` at these sample indices, with equally many columns each."""
        rows, count = values.shape
        number = next(
            (
                number
                for number, columns in enumerate(self._columns)
                if columns.size + count <= columns.capacity and is_alike(columns.head, head)
            ),
            len(self._columns),
        )
        if number == len(self._columns):
            room = PIECE_SAMPLES if self._columns else self._find_capacity(rows)
            self._columns.append(Columns(head, rows, max(room, count)))
        size = count // index.size
        firsts = self._columns[number].append(values, integers) + size * np.arange(index.size)
        sizes, numbers = np.full_like(index, size), np.full_like(index, number)
        self._places.append(np.array([index, sizes, numbers, firsts]).T)

    def close(self) -> Series:
        """Return the items in order of arrival; nothing more can be added."""
        for columns in self._columns:
            columns.close()
        return Series(tuple(self._columns), np.concatenate(self._places))


def is_alike(left: SeriesItem, right: SeriesItem) -> bool:
    """Return whether two items differ in their numbers alone."""
    if isinstance(left, Block) and isinstance(right, Block):
        alike = (left.stream, left.rate_hz) == (right.stream, right.rate_hz)
        return alike and left.channels == right.channels
    return type(left) is type(right) and left.channels == right.channels


@dataclass(frozen=True, slots=True, eq=False)
class ComparisonTable:
    """Comparisons with the same channels, in order: (comparison,), sums (comparison, channel)."""

    channels: tuple[str, ...]
    index: Int1D
    count: Int1D
    measured_ss: Float2D
    free_error_ss: Float2D
    window_error_ss: Float2D
    release: Callable[[], None]  # gives back the memory of what was read of the sums

    def __len__(self) -> int:
        return self.index.size

    def select(self, kept: npt.ArrayLike) -> "ComparisonTable":
        """Return some of the comparisons; `kept` is bool, (comparison,)."""
        names = "index", "count", "measured_ss", "free_error_ss", "window_error_ss"
        return replace(self, **{name: getattr(self, name)[kept] for name in names})


class StoredItems(Sequence[Item]):
    """Items in their order: `records`, and series by topic, of which an item is made when read."""

    def __init__(self, records: Sequence[Record], series: Mapping[str, Series]) -> None:
        self.records, self.series = tuple(records), dict(series)
        self._by_kind: dict[type, list[Record]] = defaultdict(list)
        for record in records:
            self._by_kind[type(record)].append(record)
        self._contiguous: dict[str, tuple[Block, ...]] = {}

    @cached_property
    def order(self) -> Int2D:
        """Source of each item, 0: the records, 1 ..: the series, and its place there, (item, 2)."""
        topics = [RECORD_TOPICS[type(record)] for record in self.records]
        indices = [np.array([record.index for record in self.records], np.int64)]
        indices += [series.index for series in self.series.values()]
        ranks = [np.array([TOPIC_ORDER[topic] for topic in topics], np.int64)]
        ranks += [np.full(len(series), TOPIC_ORDER[name]) for name, series in self.series.items()]
        places = [
            np.array([np.full(part.size, source), np.arange(part.size)]).T
            for source, part in enumerate(indices)
        ]
        in_order = np.lexsort((np.concatenate(ranks), np.concatenate(indices)))
        return np.concatenate(places)[in_order]

    def __len__(self) -> int:
        return len(self.records) + sum(map(len, self.series.values()))

    def __iter__(self) -> Iterator[Item]:
        return self._read(self.order)

    @overload
    def __getitem__(self, place: int) -> Item: ...
    @overload
    def __getitem__(self, place: slice) -> list[Item]: ...
    def __getitem__(self, place: int | slice) -> Item | list[Item]:
        if isinstance(place, slice):
            return list(self._read(self.order[place]))
        return next(self._read(self.order[place][None]))

    def _read(self, order: Int2D) -> Iterator[Item]:
        readers = self.records.__getitem__, *(series.read for series in self.series.values())
        return (readers[source](place) for source, place in order.tolist())

    def records_of(self, kind: type[R]) -> tuple[R, ...]:
        """Return the records of one type, in their order."""
        records = self._find_series(CMP_TOPIC) if kind is Comparison else self._by_kind[kind]
        return cast(tuple[R, ...], tuple(records))

    def contiguous_blocks(self, stream: str) -> tuple[Block, ...]:
        """Return a stream joined into one block between each pair of gaps; cached."""
        if stream not in self._contiguous:
            runs = cast(Iterator[Block], self._find_series(BLOCK_TOPICS[stream]).join())
            self._contiguous[stream] = join_contiguous(runs)
        return self._contiguous[stream]

    def _find_series(self, topic: str) -> Series:
        return self.series.get(topic, Series((), np.empty((0, 4), np.int64)))

    def release(self) -> None:
        """Give back the memory of the numbers that were read; they are read again when needed."""
        for series in self.series.values():
            for columns in series.columns:
                columns.release()

    def comparison_table(self) -> ComparisonTable:
        """Return the comparisons as numbers: those of the channels that most of them have."""
        series = self._find_series(CMP_TOPIC)
        channels: tuple[str, ...] = ()
        if len(series):
            channels = series.columns[int(np.bincount(series.places[:, 2]).argmax())].head.channels
        alike = [columns.head.channels == channels for columns in series.columns]
        places = series.places[np.array(alike, bool)[series.places[:, 2]]]
        parts = [columns.read(0, columns.size) for columns in compress(series.columns, alike)]
        if len(parts) != 1:
            empty = np.empty((3 * len(channels), 0)), np.empty((3, 0), np.int64)
            values, integers = map(np.hstack, zip(empty, *parts, strict=True))
        else:
            values, integers = parts[0]
        sizes = np.array([columns.size for columns in series.columns], np.int64) * alike
        order = (np.cumsum(sizes) - sizes)[places[:, 2]] + places[:, 3]
        if not np.array_equal(order, np.arange(values.shape[1])):
            values, integers = values[:, order], integers[:, order]
        measured, free, window = values.reshape(3, len(channels), values.shape[1]).transpose(
            0, 2, 1
        )
        return ComparisonTable(
            channels, places[:, 0], integers[0], measured, free, window, self.release
        )
