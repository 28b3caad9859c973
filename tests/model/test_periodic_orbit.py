"""The one-period map: its Jacobian, its periodic motions, exponents, onsets; branches and folds."""

import math

import numpy as np
import pytest

from tests.model.reference import AG, snm
from twin.model import closed_form
from twin.model.continuation import continue_branch, find_unstable_orbit, settle_to_orbit
from twin.model.periodic_orbit import (
    contact_onset_times,
    find_periodic_orbit,
    lyapunov_exponent,
    period_map,
)
from twin.model.stepped_sine import simulate_stepped_sine

RIGHT, LEFT = 4, 5


def arrived(p, start: float, stop: float, step: float = 0.02, cycles: int = 40) -> np.ndarray:
    """The state after slow passage from one frequency to another."""
    count = max(2, round(abs(stop - start) / step) + 1)
    return simulate_stepped_sine(p, np.linspace(start, stop, count), AG, cycles).states[-1]


REGIMES = [
    (snm(), 3.4, 2.6),  # impacting
    (snm(), 3.4, 5.0),  # flight
    (snm(), 0.53, 0.5),  # three impacts a side
    (snm(0.0), 5.0, 4.0),
    (snm(-0.001), 5.5, 6.5),  # leaves each bumper, starts in contact with one or two
    (snm(-0.010), 6.9, 6.0),  # never leaves
    (snm(0.004, bumper_damping_r=6e4, bumper_damping_l=2e4), 2.0, 1.5),  # slow bumpers remember
]


@pytest.mark.parametrize("p, frequency, start", REGIMES)
def test_jacobian_agrees_with_central_differences(p, frequency, start):
    state = arrived(p, start, frequency)
    _, jacobian = period_map(p, frequency, AG, state)
    free = [2 + side for side in range(2) if state[RIGHT + side] == 0 and state[2 + side] != 0]
    for column in [0, 1, *free]:
        h = 1e-7 if column == 1 else 1e-8
        shifted = []
        for sign in (1, -1):
            moved = state.copy()
            moved[column] += sign * h
            for side in range(2):
                if state[RIGHT + side] > 0 and column == 0:  # in contact u_j goes with u
                    moved[2 + side] += sign * h
            shifted.append(period_map(p, frequency, AG, moved)[0][:4])
        want = (shifted[0] - shifted[1]) / (2 * h)
        assert np.abs(jacobian[:, column] - want).max() < 2e-6 * max(1, np.abs(want).max())


def test_period_map_is_the_stepped_driver():
    p, state = snm(), arrived(snm(), 0.5, 0.53)
    for _ in range(3):
        moved, _ = period_map(p, 0.53, AG, state)
        want = simulate_stepped_sine(p, [0.53], AG, 1, state=state).states[0]
        assert moved[:4] == pytest.approx(want[:4], abs=1e-12)
        assert (moved[RIGHT], moved[LEFT]) == (want[RIGHT], want[LEFT])
        state = moved


def test_flight_multipliers_are_the_oscillators():
    """exp(lambda T), lambda = -a +- i wd: size exp(-C T / 2M)."""
    p = snm(math.inf)
    orbit = find_periodic_orbit(p, 2.0, AG, closed_form.rest_state(p))
    assert orbit is not None
    assert np.abs(orbit.multipliers[:2]) == pytest.approx(math.exp(-1100 / 1100 / 2.0), rel=1e-12)
    w = 4 * math.pi
    size = AG / abs(36e3 / 550 - w * w + 2j * w)
    assert orbit.u_max == pytest.approx(size, rel=1e-12)


def test_the_three_solutions_at_g4():
    """5.123 mm impacting, 1.247 mm flight, unstable 3.297 mm with multipliers 3.115 and 0.138."""
    p = snm()
    up, down = (
        settle_to_orbit(p, 3.4, AG, arrived(p, 2.6, 3.4)),
        settle_to_orbit(p, 3.4, AG, arrived(p, 5, 3.4)),
    )
    assert up is not None
    assert down is not None
    assert up.u_max == pytest.approx(5.123e-3, abs=5e-7)
    assert down.u_max == pytest.approx(1.247e-3, abs=5e-7)
    unstable = find_unstable_orbit(p, AG, up, down)
    assert unstable is not None
    assert not unstable.stable
    assert unstable.u_max == pytest.approx(3.297e-3, abs=5e-7)
    assert np.abs(unstable.multipliers[:2]) == pytest.approx([3.115, 0.138], abs=5e-4)


FOLDS = [
    (0.030, 1.3, 1.7, 3.0, 1.948, 1.526), (0.016, 1.6, 2.0, 3.5, 2.634, 1.762),
    (0.010, 2.0, 2.4, 4.0, 3.158, 2.014), (0.004, 2.6, 3.4, 5.0, 4.0274, 2.7873),
    (-0.001, 4.0, 5.0, 6.5, 5.2632, 5.2325), (-0.002, 4.5, 5.5, 7.5, 6.1501, 5.8086),
]  # fmt: skip


@pytest.mark.parametrize("gap, start, low, high, forward, backward", FOLDS)
def test_folds_by_continuation(gap, start, low, high, forward, backward):
    """The forward branch ends above, the backward one below, each with a multiplier near +1."""
    p = snm(gap)
    lower = settle_to_orbit(p, low, AG, arrived(p, start, low))
    upper = settle_to_orbit(p, high, AG, arrived(p, high + 1, high, 0.1))
    assert lower is not None
    assert upper is not None
    up = continue_branch(p, AG, lower, high, 0.02)
    down = continue_branch(p, AG, upper, start, 0.02)
    assert (up.end_hz, down.end_hz) == pytest.approx((forward, backward), abs=6e-4)
    for branch in (up, down):
        assert 0.8 < branch.orbits[-1].multipliers[0].real < 1


def test_a_branch_without_a_fold_reaches_its_goal():
    p = snm(-0.010)
    orbit = settle_to_orbit(p, 6.0, AG)
    assert orbit is not None
    branch = continue_branch(p, AG, orbit, 8.0, 0.05)
    assert branch.end_hz is None
    assert branch.orbits[-1].frequency_hz == 8.0


@pytest.mark.parametrize("frequency, want", [(0.53, 0.62), (0.71, 0.74), (1.1, 0.63), (1.4, 0.33)])
def test_largest_exponents_in_chaos(frequency, want):
    state = simulate_stepped_sine(snm(), [frequency], AG, 300).states[0]
    assert lyapunov_exponent(snm(), frequency, AG, state, 6000)[0] == pytest.approx(want, abs=0.03)


def test_exponent_of_a_periodic_motion_is_its_multiplier():
    p = snm()
    orbit = settle_to_orbit(p, 2.4, AG, arrived(p, 2.0, 2.4))
    assert orbit is not None
    found, _ = lyapunov_exponent(p, 2.4, AG, orbit.state, 4000)
    assert found == pytest.approx(math.log(abs(orbit.multipliers[0])), abs=2e-3)


def test_onsets_are_those_of_the_stepped_driver():
    p, state = snm(), arrived(snm(), 0.5, 0.71)
    right, left, after = contact_onset_times(p, 0.71, AG, state, 2)
    sweep = simulate_stepped_sine(p, [0.71], AG, 2, state=state)
    for times, name in ((right, "onsets_r"), (left, "onsets_l")):
        counts = np.histogram(times, [0, 1, 2])[0]
        assert counts.tolist() == sweep.column(name)[0].tolist()
        assert (np.diff(times) > 0).all()
    assert after[:2] == pytest.approx(sweep.states[-1, :2], abs=1e-12)
