"""Numbers of the items that most of a recording consists of, as columns."""

import numpy as np

from table_io.block import Block, Float2D, Int2D
from table_io.records import Comparison

SeriesItem = Block | Comparison


def split_item(item: SeriesItem) -> tuple[Float2D, Int2D]:
    """Return the numbers of an item as columns, float64 and int64, (row, column).

    Of a block its samples, and their step, label and cycle; of a comparison one column: its sums by
    channel, measured, free and window, and the number of samples. `join_item` is the inverse.
    """
    if isinstance(item, Block):
        return item.values, np.array([item.step, item.label, item.cycle])
    sums = item.measured_ss, item.free_error_ss, item.window_error_ss
    if {*map(len, sums)} != {len(item.channels)}:
        raise ValueError("columns of unequal lengths")
    return np.array(sums).reshape(-1, 1), np.array([[item.count], [0], [0]])


def join_item(head: SeriesItem, index: int, values: Float2D, integers: Int2D) -> SeriesItem:
    """Return the item like `head` at a sample index that has these columns."""
    if isinstance(head, Block):
        return Block(head.stream, index, head.rate_hz, head.channels, values, *integers)
    sums = map(tuple, values[:, 0].reshape(3, len(head.channels)).tolist())
    return Comparison(index, int(integers[0, 0]), head.channels, *sums)
