"""Which of the twin's blocks are recorded: all, or every n-th, since a replay recomputes them."""

from table_io.block import Block
from table_io.records import RunStart

RECORDED_EVERY = 10  # blocks, where not all are recorded


def select_recorded(block: Block, start: RunStart) -> list[Block]:
    """Return the parts of a block that are recorded, of the twin's output every n-th block.

    Blocks are counted by sample index, so that the selection does not depend on their boundaries.
    A block that is recorded whole is returned itself.
    """
    every, size = start.predictions_every, start.block_samples
    if block.stream != "pred" or start.has_all_predictions:
        return [block]
    period = every * size
    begins = range(block.index - block.index % period, block.end, period)
    inside = ((max(begin, block.index), min(begin + size, block.end)) for begin in begins)
    parts = [(first, end) for first, end in inside if first < end]
    if parts == [(block.index, block.end)]:
        return [block]
    return [block.cut(first, end) for first, end in parts]
