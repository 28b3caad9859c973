"""Whole cycles of a motion: exponents and contact onsets."""

import numpy as np
import pytest

from tests.model.reference import AG, snm
from twin.model.periodic_orbit import contact_onset_times, lyapunov_exponent
from twin.model.stepped_sine import simulate_stepped_sine


def sweep_slowly(p, start: float, stop: float, step: float = 0.02, cycles: int = 40) -> np.ndarray:
    """The state after slow passage from one frequency to another."""
    count = max(2, round(abs(stop - start) / step) + 1)
    return simulate_stepped_sine(p, np.linspace(start, stop, count), AG, cycles).states[-1]


@pytest.mark.parametrize("frequency, want", [(0.53, 0.62), (0.71, 0.74), (1.1, 0.63), (1.4, 0.33)])
def test_largest_exponents_in_chaos(frequency, want):
    state = simulate_stepped_sine(snm(), [frequency], AG, 300).states[0]
    assert lyapunov_exponent(snm(), frequency, AG, state, 6000)[0] == pytest.approx(want, abs=0.03)


def test_exponent_of_a_periodic_motion_is_its_multiplier():
    """exp(-C T / 2M) in flight."""
    state = simulate_stepped_sine(snm(), [4.5], AG, 400).states[-1]
    exponent, _ = lyapunov_exponent(snm(), 4.5, AG, state, 4000)
    assert exponent == pytest.approx(-1 / 4.5, abs=2e-3)


def test_onsets_are_those_of_the_stepped_driver():
    p, state = snm(), sweep_slowly(snm(), 0.5, 0.71)
    right, left, after = contact_onset_times(p, 0.71, AG, state, 2)
    sweep = simulate_stepped_sine(p, [0.71], AG, 2, state=state)
    for times, name in ((right, "onsets_r"), (left, "onsets_l")):
        counts = np.histogram(times, [0, 1, 2])[0]
        assert counts.tolist() == sweep.column(name)[0].tolist()
        assert (np.diff(times) > 0).all()
    assert after[:2] == pytest.approx(sweep.states[-1, :2], abs=1e-12)
