"""Correction of a drive: added to the command, kept where it was played, gone after a decay."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from table_io.block import Label
from table_io.excitation.drive import NO_CORRECTION, Correction, Drive
from table_io.excitation.trajectory import SineTarget, Trajectory


def make_drive() -> Drive:
    at_rest = Trajectory(1000.0, 500, SineTarget(4.0, 0.0))
    moving = at_rest.append_blend(SineTarget(4.0, 0.5), 0, 2.0, Label.BLEND)
    return moving.append_hold(3000, 0, Label.SETTLE).to_drive(())


def test_correction_is_added_to_the_command_only() -> None:
    nominal = make_drive()
    corrected = replace(nominal, correction=Correction(2000, np.full(100, 1e-4)))
    added = corrected.command(1990, 120) - nominal.command(1990, 120)
    expected = np.zeros(120)
    expected[10:110] = 1e-4
    np.testing.assert_allclose(added, expected, atol=1e-16)
    assert_array_equal(corrected.acceleration(1990, 120), nominal.acceleration(1990, 120))
    assert corrected.rest_start == nominal.rest_start


def test_decay_ends_the_correction_too() -> None:
    corrected = replace(make_drive(), correction=Correction(0, np.full(20_000, 1e-4)))
    stopped = corrected.decay_from(2000)
    assert not stopped.command(stopped.rest_start, 500).any()


def test_replacing_keeps_what_was_played_and_forgets_the_oldest() -> None:
    correction = NO_CORRECTION.replace_from(100, np.arange(1.0, 6.0), 0)
    correction = correction.replace_from(103, np.array([9.0, 8.0]), 101)
    assert (correction.start, correction.end) == (101, 105)
    assert_array_equal(correction.displacement(100, 6), [0.0, 2.0, 3.0, 9.0, 8.0, 0.0])


def test_replacing_after_a_gap_leaves_zeros() -> None:
    correction = Correction(10, np.ones(2)).replace_from(15, np.ones(1), 0)
    assert_array_equal(correction.displacement(10, 6), [1.0, 1.0, 0.0, 0.0, 0.0, 1.0])


@pytest.mark.parametrize("count", [0, 1, 6])
@pytest.mark.parametrize("keep_from", [0, 5, 11, 14, 40])
@pytest.mark.parametrize("first", [3, 9, 10, 13, 16, 20])
def test_replacing_is_that_of_single_samples(first: int, keep_from: int, count: int) -> None:
    old = {10 + k: 1.0 + k for k in range(6)}
    new = {first + k: -1.0 - k for k in range(count)}
    before = {index: value for index, value in old.items() if keep_from <= index < first}
    correction = Correction(10, np.array(list(old.values())))
    replaced = correction.replace_from(first, np.array(list(new.values())), keep_from)
    for at, length in ((0, 60), (12, 1), (11, 4), (2, 8), (16, 9), (30, 5)):
        for subject, values in ((correction, old), (replaced, before | new)):
            expected = [values.get(index, 0.0) for index in range(at, at + length)]
            assert_array_equal(subject.displacement(at, length), expected)
    assert replaced.end == first + count
    assert replaced.start == min(max(10, keep_from), first)
