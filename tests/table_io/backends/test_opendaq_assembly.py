"""Samples of several channels are put where their time stamps say."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.backends.opendaq.timestamps import (
    GROWTH_SAMPLES,
    Assembly,
    ClockJumpError,
    UnevenClockError,
    require_simultaneous,
    sample_indices,
)
from table_io.errors import InputError


def test_stamp_is_a_place() -> None:
    ticks = np.array([1000, 1500, 2500, 2999], dtype=np.int64)
    assert sample_indices(ticks, 1000, 500.0).tolist() == [0, 1, 3, 4]


def test_clock_that_does_not_tick_in_whole_samples() -> None:
    """3000 Hz in microseconds: 333.33 a sample, an hour later still in place."""
    index = np.array([0, 1, 2, 10_800_000], dtype=np.int64)
    ticks = np.rint(index * 1e6 / 3000.0).astype(np.int64)
    assert sample_indices(ticks, 0, 1e6 / 3000.0).tolist() == index.tolist()


@pytest.mark.parametrize("off", [200, -200, 250])
def test_stamp_between_two_samples_is_refused(off: int) -> None:
    with pytest.raises(UnevenClockError, match=r"0\.[45]"):
        sample_indices(np.array([1000, 1500 + off], dtype=np.int64), 1000, 500.0)


def test_time_that_goes_back_is_refused() -> None:
    assembly = Assembly(1)
    assembly.put(0, np.array([0, 1, 2]), np.zeros(3))
    with pytest.raises(UnevenClockError, match="goes back"):
        assembly.put(0, np.array([2, 3]), np.zeros(2))
    with pytest.raises(UnevenClockError, match="goes back"):
        assembly.put(0, np.array([5, 4]), np.zeros(2))


def test_missing_samples_are_nan_and_late_ones_dropped() -> None:
    assembly = Assembly(2)
    assembly.put(0, np.array([-2, -1, 0, 1, 4]), np.array([9.0, 9.0, 0.0, 1.0, 4.0]))
    assert (assembly.complete, assembly.end) == (0, 5)
    assembly.put(1, np.array([3]), np.array([30.0]))
    assert assembly.complete == 4
    first = assembly.take(4)
    assert np.array_equal(first[0], [0.0, 1.0, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(first[1], [np.nan, np.nan, np.nan, 30.0], equal_nan=True)
    behind = assembly.take(GROWTH_SAMPLES)
    assert behind[0, 0] == 4.0
    assert np.isnan(behind[0, 1:]).all()
    assert np.isnan(behind[1]).all()
    late = Assembly(1)
    late.put(0, np.array([5]), np.array([5.0]))
    late.take(8)
    late.put(0, np.array([7, 8]), np.array([7.0, 8.0]))
    assert late.take(1)[0, 0] == 8.0


@given(
    st.lists(st.integers(1, 700), min_size=1, max_size=20),
    st.lists(st.integers(0, 900), min_size=1, max_size=30),
    st.integers(0, 2**32 - 1),
)
def test_pieces_and_cuts_change_no_sample(pieces: list[int], cuts: list[int], seed: int) -> None:
    """Also where much more has come than was taken, and where samples are missing."""
    rng = np.random.default_rng(seed)
    size = sum(pieces)
    lost = rng.random(size) < 0.1
    values = np.where(lost, np.nan, np.arange(size, dtype=np.float64))
    assembly, at = Assembly(2), 0
    for piece in pieces:
        index = at + np.flatnonzero(~lost[at : at + piece])
        for row in (0, 1):
            assembly.put(row, index, (row + 1) * values[index])
        at += piece
    taken = np.concatenate([assembly.take(cut) for cut in cuts], axis=1)
    expected = np.full(taken.shape[1] + size, np.nan)
    expected[:size] = values
    assert np.array_equal(taken[0], expected[: taken.shape[1]], equal_nan=True)
    assert np.array_equal(taken[1], 2 * expected[: taken.shape[1]], equal_nan=True)
    assert assembly._values.shape[1] >= GROWTH_SAMPLES


def test_clock_jump_takes_no_memory() -> None:
    assembly = Assembly(2, 10_000)
    assembly.put(0, np.arange(100), np.zeros(100))
    assembly.put(1, np.arange(100), np.zeros(100))
    with pytest.raises(ClockJumpError) as jump:
        assembly.put(0, np.array([10**12]), np.zeros(1))
    assert jump.value.samples == 10**12 - 100
    with pytest.raises(ClockJumpError):
        assembly.put(1, np.array([100, 101, 10**12]), np.zeros(3))
    assert assembly._values.shape[1] <= 2 * GROWTH_SAMPLES
    assembly.put(0, np.arange(5000, 5010), np.zeros(10))  # a loss


def test_channel_that_returns_is_waited_for() -> None:
    assembly = Assembly(2, 10_000)
    assembly.put(0, np.arange(100), np.zeros(100))
    assert assembly.complete == 0
    assembly.give_up(100)
    assert assembly.complete == 100
    assembly.put(0, np.arange(100, 20_000), np.zeros(19_900))
    assert assembly.complete == 20_000
    assembly.put(1, np.array([19_990]), np.zeros(1))
    assert assembly.complete == 19_991


def test_drifting_stamps_are_placed() -> None:
    ticks = np.array([1000, 1500, 2000], dtype=np.int64) + 300
    assert sample_indices(ticks, 1000, 500.0, 300.0).tolist() == [0, 1, 2]


def test_channels_that_lie_between_each_other_are_refused() -> None:
    require_simultaneous({"drive_disp_m": 1000, "force_r1_n": 3010}, 500.0, "d")
    with pytest.raises(InputError, match=r"0\.50") as error:
        require_simultaneous({"drive_disp_m": 1000, "force_r1_n": 3250}, 500.0, "d")
    assert (error.value.where, error.value.key) == ("d", "force_r1_n")
