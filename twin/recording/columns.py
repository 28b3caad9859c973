"""Columns that hold the samples of many blocks once, and the places of the blocks in them.

A block of a real-time run has a few samples: arrays and objects for every one of them would take
several times the memory of the samples.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from table_io.block import Block


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
