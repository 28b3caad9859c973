"""Sequence of the items of a recording, in which blocks are cut from the columns that hold them."""

from collections.abc import Iterable, Iterator, Sequence
from typing import overload

from table_io.block import Block, join_contiguous
from table_io.records import Record
from twin.recording.columns import BlockStore, StoredBlock
from twin.transport.codec import RECORD_TOPICS, Item
from twin.transport.endpoint import BLOCK_TOPICS

StoredItem = Record | StoredBlock


def find_topic(entry: StoredItem) -> str:
    """Return the topic on which an item is logged, as `topic_for` does."""
    if isinstance(entry, StoredBlock):
        return BLOCK_TOPICS[entry.stream]
    return RECORD_TOPICS[type(entry)]


class StoredItems(Sequence[Item]):
    """Items in their order; reading a block makes it anew."""

    __slots__ = ("_contiguous", "entries", "records")

    def __init__(self, entries: Iterable[StoredItem]) -> None:
        self.entries: tuple[StoredItem, ...] = tuple(entries)
        self.records: tuple[Record, ...] = tuple(
            entry for entry in self.entries if not isinstance(entry, StoredBlock)
        )
        self._contiguous: dict[str, tuple[Block, ...]] = {}

    @classmethod
    def from_items(cls, items: Iterable[Item]) -> "StoredItems":
        """Store items in columns of their own."""
        items = list(items)
        count = sum(len(item) for item in items if isinstance(item, Block))
        store = BlockStore(lambda _: count)
        return cls(store.add(item) if isinstance(item, Block) else item for item in items)

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
