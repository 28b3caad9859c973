"""Blocks in columns: every block is read as it was stored, and its samples are held once."""

import errno
from tempfile import TemporaryFile
from typing import cast

import numpy as np
import pytest

from table_io.block import Block
from table_io.errors import InputError
from table_io.records import Comparison
from tests.builders.recordings import store_items
from twin.recording import columns
from twin.recording.columns import Series, SeriesStore, StoredItems
from twin.transport.endpoint import CMP_TOPIC, MEAS_TOPIC
from twin.transport.series import split_item


def make_block(index: int, count: int, channels: tuple[str, ...] = ("a", "b")) -> Block:
    samples = np.arange(index, index + count)
    values = np.array([samples + 0.5 * row for row in range(len(channels))], dtype=float)
    return Block("meas", index, 1000.0, channels, values, samples, 2 * samples, 3 * samples)


def store_blocks(blocks: list[Block], capacity: int = 100) -> Series:
    store = SeriesStore(lambda _: capacity)
    for block in blocks:
        store.add(block, np.array([block.index]), *split_item(block))
    return store.close()


@pytest.mark.parametrize("max_bytes", [0, columns.MAX_MEMORY_BYTES])
@pytest.mark.parametrize("capacity", [0, 7, 10, 1000])
@pytest.mark.parametrize(
    "places",
    [
        [(0, 3), (3, 4), (7, 3)],
        [(7, 3), (0, 3), (3, 4)],  # not in order
        [(0, 3), (5, 4), (9, 2)],  # with a gap
    ],
)
def test_blocks_are_read_as_they_were_stored(
    max_bytes: int,
    capacity: int,
    places: list[tuple[int, int]],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In memory and in a file, also after the memory of the file was given back."""
    monkeypatch.setattr(columns, "MAX_MEMORY_BYTES", max_bytes)
    blocks = [make_block(*place) for place in places]
    series = store_blocks(blocks, capacity)
    items = StoredItems([], {MEAS_TOPIC: series.take(np.argsort(series.index))})
    for _ in range(2):
        for place, block in enumerate(blocks):
            assert block.is_identical(cast(Block, series.read(place)))
        joined = items.contiguous_blocks("meas")
        assert sum(map(len, joined)) == sum(map(len, blocks))
        for block in joined:
            assert block.is_identical(make_block(block.index, len(block)))
        items.release()


def test_a_full_disk_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "MAX_MEMORY_BYTES", 0)

    class FullFile:
        def __init__(self, **_: object) -> None:
            self.file = TemporaryFile()  # noqa: SIM115 (as long as the columns)
            self.truncate, self.fileno = self.file.truncate, self.file.fileno
            self.seek, self.close = self.file.seek, self.file.close

        def write(self, data: bytes) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(columns, "TemporaryFile", FullFile)
    with pytest.raises(InputError, match="No space left on device") as error:
        store_blocks([make_block(0, 5)])
    assert "TMPDIR" in str(error.value)


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
    block = store_blocks([make_block(0, 5)]).read(0)
    assert isinstance(block, Block)
    with pytest.raises(ValueError, match="read-only"):
        block.values[0, 0] = 9.0


def test_comparisons_as_numbers_are_those_of_the_records() -> None:
    """In order of sample index, without those of other channels than most have."""
    rng = np.random.default_rng(3)
    compared = [
        Comparison(index, 20 + index, ("u", "a"), *map(tuple, rng.random((3, 2)).tolist()))
        for index in (40, 0, 20, 60)
    ]
    odd = Comparison(30, 20, ("u",), (1.0,), (2.0,), (3.0,))
    for parts in ([compared, [odd]], [compared[:2], [odd], compared[2:]]):
        store = SeriesStore(lambda _: 0)
        for item in (item for part in parts for item in part):
            store.add(item, np.array([item.index]), *split_item(item))
        series = store.close()
        items = StoredItems([], {CMP_TOPIC: series.take(np.argsort(series.index))})
        assert len(items.records_of(Comparison)) == len(items) == 5
        table, kept = items.comparison_table(), sorted(compared, key=lambda item: item.index)
        assert table.channels == ("u", "a")
        assert table.index.tolist() == [item.index for item in kept]
        assert table.count.tolist() == [item.count for item in kept]
        for name in ("measured_ss", "free_error_ss", "window_error_ss"):
            assert getattr(table, name).tolist() == [list(getattr(item, name)) for item in kept]
    assert len(StoredItems([], {}).comparison_table()) == 0
