"""Blocks in columns: every block is read as it was stored, and its samples are held once."""

import numpy as np
import pytest

from table_io.block import Block
from tests.builders.recordings import store_items
from twin.recording.columns import BlockStore, StoredItems


def make_block(index: int, count: int, channels: tuple[str, ...] = ("a", "b")) -> Block:
    samples = np.arange(index, index + count)
    values = np.array([samples + 0.5 * row for row in range(len(channels))], dtype=float)
    return Block("meas", index, 1000.0, channels, values, samples, 2 * samples, 3 * samples)


@pytest.mark.parametrize("capacity", [0, 7, 10, 1000])
@pytest.mark.parametrize(
    "places",
    [
        [(0, 3), (3, 4), (7, 3)],
        [(7, 3), (0, 3), (3, 4)],  # not in order
        [(0, 3), (5, 4), (9, 2)],  # with a gap
    ],
)
def test_blocks_are_read_as_they_were_stored(capacity: int, places: list[tuple[int, int]]) -> None:
    store, blocks = BlockStore(lambda _: capacity), [make_block(*place) for place in places]
    stored = [store.add(block) for block in blocks]
    for block, entry in zip(blocks, stored, strict=True):
        assert entry.read().is_identical(block)
        assert (entry.index, entry.end, len(entry)) == (block.index, block.end, len(block))
    items = StoredItems(sorted(stored, key=lambda entry: entry.index))
    joined = items.contiguous_blocks("meas")
    assert sum(map(len, joined)) == sum(map(len, blocks))
    for block in joined:
        assert block.is_identical(make_block(block.index, len(block)))
    assert sum(map(len, store.read_all())) == sum(map(len, blocks))


def test_samples_in_order_are_held_once() -> None:
    items = store_items([make_block(first, 5) for first in range(0, 50, 5)])
    (joined,) = items.contiguous_blocks("meas")
    assert all(
        np.shares_memory(item.values, joined.values) for item in items if isinstance(item, Block)
    )


def test_blocks_of_other_channels_are_kept_apart() -> None:
    blocks = [make_block(0, 5), make_block(5, 5, ("a",)), make_block(10, 5)]
    items = store_items(blocks)
    read = [item for item in items if isinstance(item, Block)]
    assert all(block.is_identical(original) for block, original in zip(read, blocks, strict=True))
    assert [block.channels for block in items.contiguous_blocks("meas")] == [
        ("a", "b"), ("a",), ("a", "b"),
    ]  # fmt: skip


def test_a_change_of_a_block_that_was_read_does_not_reach_the_store() -> None:
    stored = BlockStore(lambda _: 10).add(make_block(0, 5))
    with pytest.raises(ValueError, match="read-only"):
        stored.read().values[0, 0] = 9.0
