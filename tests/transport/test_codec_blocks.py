"""Blocks to bytes and back, to the bit; logs of schema 1 and 2 hold lists of numbers."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.block import Block
from twin.transport import shaketwin_pb2 as pb
from twin.transport.codec import WireError, decode_item, encode_item, topic_for

NAMES = ("mass_disp_m", "force_r1_n", "x", "ü" * 70)
LABELS = st.sampled_from((-1, 0, 1, 5, 63, 64, 300, 2**31 - 1))


def encode_as_lists(block: Block, run: str) -> bytes:
    """Return a block as written in schema 1 and 2."""
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
        *(np.array(numbers, dtype=np.int64) for numbers in labels),
    )


@given(any_blocks(), st.sampled_from(("", "20250101-000000-g10", "r" * 200)))
def test_a_block_comes_back_to_the_bit_in_every_schema(block: Block, run: str) -> None:
    for payload in (encode_item(block, run), encode_as_lists(block, run)):
        decoded_run, decoded = decode_item(topic_for(block), payload)
        assert decoded_run == run
        assert isinstance(decoded, Block)
        assert decoded.is_identical(block)


def test_any_protobuf_reader_finds_the_numbers() -> None:
    labels = np.array([2, -1])
    block = Block("meas", 7, 2e3, ("a", "b"), np.array([[1.5, 2.0], [np.nan, -0.0]]),
                  labels, labels + 1, labels + 2)  # fmt: skip
    message: Any = pb.Block.FromString(encode_item(block, "r"))
    assert list(message.names) == ["a", "b"]
    assert message.values == np.array([1.5, 2.0, np.nan, -0.0], "<f8").tobytes()
    assert message.labels == np.array([2, -1, 3, 0, 4, 1], "<i4").tobytes()


def test_rows_that_are_no_neighbours_in_memory() -> None:
    """A cut of a longer block, and rows that stand in a matrix of columns."""
    values = np.arange(40.0).reshape(10, 4).T
    labels = np.zeros(10, np.int64)
    block = Block("meas", 0, 1.0, ("a", "b", "c", "d"), values, labels, labels, labels).cut(3, 9)
    decoded = decode_item("/rig/meas", encode_item(block, ""))[1]
    assert isinstance(decoded, Block)
    assert decoded.is_identical(block)


@pytest.mark.parametrize("label", [2**31, -(2**31) - 5])
def test_a_label_that_does_not_fit_is_not_written(label: int) -> None:
    labels = np.zeros(2, np.int64)
    with pytest.raises(ValueError, match="2147483647"):
        encode_item(Block("meas", 0, 1.0, (), np.empty((0, 2)), labels + label, labels, labels), "")


@pytest.mark.parametrize("field", ["values", "labels"])
@pytest.mark.parametrize("lost", [1, 8, 16])
def test_a_block_with_bytes_missing_is_refused(field: str, lost: int) -> None:
    labels = np.zeros(4, np.int64)
    block = Block("meas", 0, 2e3, ("a", "b"), np.zeros((2, 4)), labels, labels, labels)
    message: Any = pb.Block.FromString(encode_item(block, "r"))
    setattr(message, field, getattr(message, field)[:-lost])
    with pytest.raises(WireError, match="not a Block"):
        decode_item("/rig/meas", message.SerializeToString())
