"""Items of a recording whose samples are held once: blocks are cut from them when read."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, overload

from table_io.block import Block, join_contiguous
from table_io.records import Record
from twin.transport.codec import Item


class _Cut(NamedTuple):
    piece: Block
    first: int
    end: int

    def make_block(self) -> Block:
        return self.piece.cut(self.first, self.end)


class SharedItems(Sequence[Item]):
    """Sequence of items; `contiguous` are the blocks of each stream, joined between its gaps.

    A block of a real-time run has a few samples: kept for every one of them, arrays and objects
    would take several times the memory of the samples.
    """

    __slots__ = ("_entries", "contiguous", "records")

    def __init__(
        self, items: Iterable[Item], joined: Mapping[str, tuple[Block, ...]] | None = None
    ) -> None:
        """`joined` are contiguous blocks of streams that are joined already."""
        items = list(items)
        streams: dict[str, list[Block]] = {}
        for item in items:
            if isinstance(item, Block):
                streams.setdefault(item.stream, []).append(item)
        self.contiguous = {
            stream: (joined or {}).get(stream) or join_contiguous(blocks)
            for stream, blocks in streams.items()
        }
        cuts = {stream: _iter_cuts(streams[stream], self.contiguous[stream]) for stream in streams}
        self._entries: list[Record | _Cut] = [
            next(cuts[item.stream]) if isinstance(item, Block) else item for item in items
        ]
        self.records: tuple[Record, ...] = tuple(
            item for item in items if not isinstance(item, Block)
        )

    def __len__(self) -> int:
        return len(self._entries)

    def __iter__(self) -> Iterator[Item]:
        return map(_read_entry, self._entries)

    @overload
    def __getitem__(self, place: int) -> Item: ...
    @overload
    def __getitem__(self, place: slice) -> list[Item]: ...
    def __getitem__(self, place: int | slice) -> Item | list[Item]:
        if isinstance(place, slice):
            return [_read_entry(entry) for entry in self._entries[place]]
        return _read_entry(self._entries[place])

    def iter_blocks(self, stream: str) -> Iterator[Block]:
        """Yield the blocks of a stream, in order of sample index."""
        for entry in self._entries:
            if isinstance(entry, _Cut) and entry.piece.stream == stream:
                yield entry.make_block()


def _read_entry(entry: Record | _Cut) -> Item:
    return entry.make_block() if isinstance(entry, _Cut) else entry


def _iter_cuts(blocks: Sequence[Block], contiguous: Sequence[Block]) -> Iterator[_Cut]:
    """Yield the place of each block in the contiguous block that holds it."""
    pieces = iter(contiguous)
    piece = next(pieces)
    for block in blocks:
        while block.index >= piece.end:
            piece = next(pieces)
        yield _Cut(piece, block.index, block.end)
