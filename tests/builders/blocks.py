"""Blocks cut again, to prove that no result depends on the division of samples."""

from collections.abc import Iterable

from table_io.block import Block, join_blocks


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
