"""Blocks: nobody changes one, and no way of cutting the samples changes a bit."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.block import Block, join_blocks
from tests.builders.blocks import recut_blocks

RATE_HZ = 2000.0
CHANNELS = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")


def block(samples: int = 1200, index: int = 40, **changes: object) -> Block:
    """A block whose every value differs, with a NaN, an inf and a negative zero in it."""
    values = np.random.default_rng(samples).standard_normal((len(CHANNELS), samples))
    for place, odd in enumerate((np.nan, np.inf, -0.0)[: min(samples, 3)]):
        values[1, place] = odd
    count = np.arange(samples, dtype=np.int64)
    fields: dict[str, object] = {
        "stream": "meas",
        "index": index,
        "rate_hz": RATE_HZ,
        "channels": CHANNELS,
        "values": values,
        "step": count // 500,
        "label": count % 5,
        "cycle": count // 50 - 1,
    }
    return Block(**{**fields, **changes})  # type: ignore[arg-type]


def pieces(whole: Block, sizes: list[int]) -> list[Block]:
    """The block cut into pieces of these sizes, over and over."""
    cuts, at, turn = [], whole.index, 0
    while at < whole.end:
        last = min(at + sizes[turn % len(sizes)], whole.end)
        cuts.append(whole.cut(at, last))
        at, turn = last, turn + 1
    return cuts


def test_no_field_and_no_sample_can_be_changed() -> None:
    whole = block()
    with pytest.raises(AttributeError):
        whole.index = 3  # type: ignore[misc]
    for part in (whole, whole.cut(100, 200), join_blocks(pieces(whole, [500]))):
        for array in (part.values, part.step, part.label, part.cycle):
            with pytest.raises(ValueError, match="read-only"):
                array[..., 0] = 1


def test_time_comes_from_the_index() -> None:
    whole = block(index=12_345_679)
    assert whole.time_s[0] == 12_345_679 / RATE_HZ
    assert whole.cut(12_345_700, 12_345_701).time_s[0] == whole.time_s[21]
    assert np.array_equal(join_blocks(pieces(whole, [7])).time_s, whole.time_s)


def test_missing_channel_is_named_with_those_present() -> None:
    assert np.array_equal(block().channel("table_acc_m_s2"), block().values[2])
    with pytest.raises(KeyError, match=r"force_r1_n.* drive_disp_m, table_disp_m"):
        block().channel("force_r1_n")


def test_values_and_labels_of_different_length_are_refused() -> None:
    for name in ("values", "step", "label", "cycle"):
        with pytest.raises(ValueError, match="do not fit"):
            block(100, **{name: getattr(block(101), name)})


@pytest.mark.parametrize("samples", [1, 7, 64, 500, 5000])
def test_recut_and_join_give_back_every_bit(samples: int) -> None:
    whole = block()
    cut = list(recut_blocks([whole], samples))
    assert [len(piece) for piece in cut[:-1]] == [samples] * (len(cut) - 1)
    assert 0 < len(cut[-1]) <= samples
    assert join_blocks(cut).is_identical(whole)


@given(
    sizes=st.lists(st.sampled_from([1, 7, 64, 500]), min_size=1, max_size=12),
    samples=st.sampled_from([1, 3, 7, 64, 500]),
)
@settings(max_examples=40)
def test_recut_is_independent_of_the_blocks(sizes: list[int], samples: int) -> None:
    whole = block()
    straight = list(recut_blocks([whole], samples))
    again = list(recut_blocks(pieces(whole, sizes), samples))
    assert len(again) == len(straight)
    assert all(a.is_identical(b) for a, b in zip(again, straight, strict=True))


@pytest.mark.parametrize(
    "second",
    [
        block(20, index=61),
        block(20, index=59),
        block(20, index=60, stream="pred"),
        block(20, index=60, rate_hz=1000.0),
        block(20, index=60, channels=CHANNELS[::-1]),
    ],
    ids=["gap", "overlap", "stream", "rate", "channels"],
)
def test_join_refuses_a_discontinuity(second: Block) -> None:
    first = block(20, index=40)
    assert len(join_blocks([first, block(20, index=60)])) == 40
    with pytest.raises(ValueError, match="does not continue"):
        join_blocks([first, second])
    with pytest.raises(ValueError, match="does not continue"):
        list(recut_blocks([first, second], 40))


@pytest.mark.parametrize("window", [(39, 45), (45, 61), (0, 3), (50, 45)])
def test_cut_refuses_samples_that_it_does_not_have(window: tuple[int, int]) -> None:
    with pytest.raises(ValueError, match=r"\b40\b.*\b60\b"):
        block(20).cut(*window)


@pytest.mark.parametrize("name", ["stream", "index", "rate_hz", "values", "step", "label", "cycle"])
def test_identical_compares_every_field(name: str) -> None:
    whole = block(20)
    others: dict[str, Any] = {"stream": "pred", "index": 41, "rate_hz": 1000.0}
    other = others.get(name)
    if other is None:
        changed = getattr(whole, name).copy()
        changed[..., -1] += 1
        other = changed
    assert whole.is_identical(block(20))
    assert not whole.is_identical(block(20, **{name: other}))


def test_identical_distinguishes_a_negative_zero() -> None:
    zero = block(20).values.copy()
    assert np.signbit(zero[1, 2])
    zero[1, 2] = 0.0
    assert not block(20).is_identical(block(20, values=zero))
