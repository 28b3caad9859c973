"""Blocks cut again, to prove that no result depends on the division of samples."""

from collections.abc import Iterable, Iterator

from table_io.block import Block, join_blocks
from table_io.records import Record

Item = Block | Record


def select_blocks(items: Iterable[Item], stream: str) -> tuple[Block, ...]:
    """Return the blocks of a stream as they were recorded, in their order."""
    return tuple(item for item in items if isinstance(item, Block) and item.stream == stream)


def recut_blocks(blocks: Iterable[Block], samples: int) -> Iterable[Block]:
    """Yield the same samples in blocks of length `samples` (the last one may be shorter)."""
    pending: list[Block] = []
    pending_samples = 0
    for block in blocks:
        pending.append(block)
        pending_samples += len(block)
        while pending_samples >= samples:
            joined = join_blocks(pending)
            yield joined.cut(joined.index, joined.index + samples)
            pending_samples -= samples
            pending = [joined.cut(joined.index + samples, joined.end)] if pending_samples else []
    if pending_samples:
        yield join_blocks(pending)


def drop_measured(items: Iterable[Item], first: int, end: int) -> Iterator[Item]:
    """Yield items without the measured samples `first` up to `end`, which is not among them."""
    for item in items:
        if isinstance(item, Block) and item.stream == "meas":
            spans = (item.index, min(first, item.end)), (max(end, item.index), item.end)
            yield from (item.cut(*span) for span in spans if span[0] < span[1])
        else:
            yield item
