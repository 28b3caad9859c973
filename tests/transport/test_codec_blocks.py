"""Blocks written as arrays: the same bytes as protobuf's own encoder, whatever is in them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.block import Block
from twin.transport import shaketwin_pb2 as pb
from twin.transport.codec import decode_item, encode_block, encode_item

NAMES = ("mass_disp_m", "force_r1_n", "x", "ü" * 70)
LABELS = st.sampled_from((-1, 0, 1, 5, 63, 64, 300, 2**40))


def protobuf(block: Block, run: str) -> bytes:
    """The bytes by protobuf alone, value by value."""
    message = pb.Block(
        run=run,
        stream=block.stream,
        index=block.index,
        rate_hz=block.rate_hz,
        channels=[
            pb.Channel(name=name, values=values)
            for name, values in zip(block.channels, block.values.tolist(), strict=True)
        ],
        step=block.step.tolist(),
        label=block.label.tolist(),
        cycle=block.cycle.tolist(),
    )
    return message.SerializeToString(deterministic=True)


@st.composite
def any_blocks(draw: st.DrawFn) -> Block:
    names = NAMES[: draw(st.integers(0, len(NAMES)))]
    samples = draw(st.sampled_from((0, 1, 20, 60)))
    numbers = st.floats(allow_nan=True, allow_infinity=True, allow_subnormal=True)
    values = [draw(st.lists(numbers, min_size=samples, max_size=samples)) for _ in names]
    labels = [draw(st.lists(LABELS, min_size=samples, max_size=samples)) for _ in range(3)]
    index = draw(st.sampled_from((0, 1, 127, 128, 2**21, 2**49)))
    return Block(
        draw(st.sampled_from(("meas", "pred"))),
        index,
        draw(st.sampled_from((2000.0, 0.5))),
        names,
        np.array(values).reshape(len(names), samples),
        *(np.array(one, dtype=np.int64) for one in labels),
    )


@given(any_blocks(), st.sampled_from(("", "20250101-000000-g10", "r" * 200)))
def test_the_bytes_are_those_of_protobuf(block: Block, run: str) -> None:
    assert encode_block(block, run) == protobuf(block, run) == encode_item(block, run)


@pytest.mark.parametrize("samples", [2000, 20_000])
def test_long_blocks_too(samples: int) -> None:
    """Whose lengths take more bytes to write."""
    values = np.random.default_rng(1).normal(size=(3, samples))
    labels = np.arange(samples) % 300
    block = Block("meas", 7, 2000.0, NAMES[:3], values, labels, labels, labels - 1)
    payload = encode_block(block, "run")
    assert payload == protobuf(block, "run")
    back = decode_item("/rig/meas", payload)[1]
    assert isinstance(back, Block)
    assert back.is_identical(block)


@pytest.mark.parametrize("most", [63, 64, 127, 128, 300])
def test_labels_of_one_byte_and_of_more(most: int) -> None:
    """A zigzag number has one byte up to 63; a long block is written another way up to there."""
    labels = np.full(200, most)
    block = Block("meas", 0, 1.0, (), np.empty((0, 200)), labels, -labels, labels - 1)
    assert encode_block(block, "") == protobuf(block, "")


def test_rows_that_are_no_neighbours_in_memory() -> None:
    """A cut of a longer block, and rows that stand in a matrix of columns."""
    values = np.arange(40.0).reshape(10, 4).T
    labels = np.zeros(10, np.int64)
    block = Block("meas", 0, 1.0, ("a", "b", "c", "d"), values, labels, labels, labels).cut(3, 9)
    assert encode_block(block, "") == protobuf(block, "")
