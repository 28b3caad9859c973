"""Items of a recording in memory: columns that hold the samples of many blocks once.

A block of a real-time run has a few samples: arrays and objects for every one of them would take
several times the memory of the samples.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar, cast, overload

import numpy as np

from table_io.block import Block, join_contiguous
from table_io.records import Record

Item = Block | Record
R = TypeVar("R", bound=Record)


class Columns:
    """Samples of one stream, appended block by block up to a capacity.

    Memory is taken as it is filled, so a capacity may be generous.
    """

    def __init__(self, like: Block, capacity: int) -> None:
        self.stream, self.rate_hz, self.channels = like.stream, like.rate_hz, like.channels
        self.capacity, self.size = capacity, 0
        self._values = np.empty((len(like.channels), capacity))
        self._labels = np.empty((3, capacity), dtype=np.int64)

    def holds(self, block: Block) -> bool:
        """Return whether a block belongs here and there is room for it."""
        return (
            self.size + len(block) <= self.capacity
            and (self.stream, self.rate_hz) == (block.stream, block.rate_hz)
            and self.channels == block.channels
        )

    def append(self, block: Block) -> "StoredBlock":
        """Copy a block to the end of the columns; return its place."""
        first, self.size = self.size, self.size + len(block)
        self._values[:, first : self.size] = block.values
        self._labels[:, first : self.size] = block.step, block.label, block.cycle
        return StoredBlock(self, first, block.index, len(block))

    def cut(self, first: int, index: int, count: int) -> Block:
        """Return `count` samples from column `first` on as a block that begins at `index`."""
        window = slice(first, first + count)
        values, labels = self._values[:, window], self._labels[:, window]
        return Block(self.stream, index, self.rate_hz, self.channels, values, *labels)


@dataclass(frozen=True, slots=True)
class StoredBlock:
    """Place of a block in the columns of its stream."""

    columns: Columns
    first: int
    index: int
    count: int

    def __len__(self) -> int:
        return self.count

    @property
    def stream(self) -> str:
        return self.columns.stream

    @property
    def rate_hz(self) -> float:
        return self.columns.rate_hz

    @property
    def channels(self) -> tuple[str, ...]:
        return self.columns.channels

    @property
    def end(self) -> int:
        return self.index + self.count

    def read(self) -> Block:
        return self.columns.cut(self.first, self.index, self.count)

    def is_followed_by(self, other: "StoredBlock") -> bool:
        """Return whether the samples and columns of `other` are the next ones."""
        return (
            other.columns is self.columns
            and other.index == self.end
            and other.first == self.first + self.count
        )


class BlockStore:
    """Columns of each stream, with room for the samples that `find_capacity(first block)` gives."""

    def __init__(self, find_capacity: Callable[[Block], int]) -> None:
        self._find_capacity = find_capacity
        self._columns: dict[str, Columns] = {}
        self._others: list[Columns] = []

    def add(self, block: Block) -> StoredBlock:
        """Store a block: in the columns of its stream, or where it does not fit, in its own."""
        if block.stream not in self._columns:
            capacity = max(self._find_capacity(block), len(block))
            self._columns[block.stream] = Columns(block, capacity)
        columns = self._columns[block.stream]
        if not columns.holds(block):
            self._others.append(columns := Columns(block, len(block)))
        return columns.append(block)

    def read_all(self) -> Iterator[Block]:
        """Yield the samples of each of the columns as one block, whose index has no meaning."""
        for columns in (*self._columns.values(), *self._others):
            yield columns.cut(0, 0, columns.size)


StoredItem = Record | StoredBlock


class StoredItems(Sequence[Item]):
    """Items in their order; reading a block makes it anew."""

    __slots__ = ("_by_kind", "_contiguous", "entries", "records")

    def __init__(self, entries: Iterable[StoredItem]) -> None:
        self.entries: tuple[StoredItem, ...] = tuple(entries)
        self.records: tuple[Record, ...] = tuple(
            entry for entry in self.entries if not isinstance(entry, StoredBlock)
        )
        by_kind: dict[type, list[Record]] = {}
        for record in self.records:
            by_kind.setdefault(type(record), []).append(record)
        self._by_kind = {kind: tuple(records) for kind, records in by_kind.items()}
        self._contiguous: dict[str, tuple[Block, ...]] = {}

    def __len__(self) -> int:
        return len(self.entries)

    def __iter__(self) -> Iterator[Item]:
        return map(_read_entry, self.entries)

    @overload
    def __getitem__(self, place: int) -> Item: ...
    @overload
    def __getitem__(self, place: slice) -> list[Item]: ...
    def __getitem__(self, place: int | slice) -> Item | list[Item]:
        if isinstance(place, slice):
            return [_read_entry(entry) for entry in self.entries[place]]
        return _read_entry(self.entries[place])

    def records_of(self, kind: type[R]) -> tuple[R, ...]:
        """Return the records of one type, in their order."""
        return cast(tuple[R, ...], self._by_kind.get(kind, ()))

    def stored_blocks(self, stream: str) -> Iterator[StoredBlock]:
        """Yield the places of the blocks of a stream, in order of sample index."""
        for entry in self.entries:
            if isinstance(entry, StoredBlock) and entry.stream == stream:
                yield entry

    def contiguous_blocks(self, stream: str) -> tuple[Block, ...]:
        """Return a stream joined into one block between each pair of gaps; cached."""
        if stream not in self._contiguous:
            pieces = [
                run[0].columns.cut(run[0].first, run[0].index, sum(map(len, run)))
                for run in _split_runs(self.stored_blocks(stream))
            ]
            self._contiguous[stream] = join_contiguous(pieces)
        return self._contiguous[stream]


def _read_entry(entry: StoredItem) -> Item:
    return entry.read() if isinstance(entry, StoredBlock) else entry


def _split_runs(blocks: Iterable[StoredBlock]) -> list[list[StoredBlock]]:
    """Return the blocks in runs whose samples follow each other, in time and in their columns."""
    runs: list[list[StoredBlock]] = []
    for block in blocks:
        if runs and runs[-1][-1].is_followed_by(block):
            runs[-1].append(block)
        else:
            runs.append([block])
    return runs
