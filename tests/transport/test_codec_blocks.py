"""Blocks to bytes and back, to the bit; logs of schema 1 and 2 hold lists of numbers."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.block import Block
from table_io.records import SampleGap
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


def test_block_with_strided_rows_comes_back() -> None:
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


@pytest.mark.parametrize("past", [-1, 0, 1])
@pytest.mark.parametrize("count", [0, 1, 5])
def test_samples_are_counted_as_far_as_numbers_are_exact(count: int, past: int) -> None:
    labels = np.zeros(count, np.int64)
    index = 2**53 - count + past
    block = Block("meas", index, 2e3, ("a",), np.zeros((1, count)), labels, labels, labels)
    gap = SampleGap(2**53 + past, 2, "a", "lost")
    for item in (block, gap):
        payload = encode_item(item, "r")
        if past > 0:
            with pytest.raises(WireError):
                decode_item(topic_for(item), payload)
        else:
            assert decode_item(topic_for(item), payload)[1].index == item.index


@pytest.mark.parametrize("row", [0, 1, 2])
@pytest.mark.parametrize("label", [2**31 - 1, -(2**31) + 1, 2**31, -(2**31)])
def test_labels_within_31_bits_come_back_from_every_row(label: int, row: int) -> None:
    labels = np.zeros((3, 4), np.int64)
    labels[row, 2] = label
    block = Block("pred", 0, 1.0, (), np.empty((0, 4)), *labels)
    if abs(label) > 2**31 - 1:
        with pytest.raises(ValueError, match="2147483647"):
            encode_item(block, "")
    else:
        decoded = decode_item(topic_for(block), encode_item(block, ""))[1]
        assert isinstance(decoded, Block)
        assert decoded.is_identical(block)


@pytest.mark.parametrize("rate_hz", [0.0, -1.0, float("inf"), float("nan"), 5e-324, 1e300])
def test_a_rate_is_positive_and_finite(rate_hz: float) -> None:
    message = pb.Block(stream="meas", rate_hz=rate_hz)
    if 0.0 < rate_hz < float("inf"):
        assert decode_item("/rig/meas", message.SerializeToString())[1].rate_hz == rate_hz  # type: ignore[union-attr]
    else:
        with pytest.raises(WireError):
            decode_item("/rig/meas", message.SerializeToString())


def test_items_of_one_recording_share_their_names() -> None:
    labels = np.zeros(1, np.int64)
    names = tuple(f"channel {number}" for number in range(3))
    block = Block("meas", 0, 2e3, names, np.zeros((3, 1)), labels, labels, labels)
    first, second = (decode_item("/rig/meas", encode_item(block, run))[1] for run in ("a", "b"))
    assert isinstance(first, Block)
    assert isinstance(second, Block)
    assert first.channels == names
    assert first.channels is second.channels
