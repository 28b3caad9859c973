"""The stepped-sinusoid driver: published numbers, folds, true extremes."""

import math

import numpy as np
import pytest

from table_io.errors import InputError
from tests.input_errors import raises_input_error
from tests.model.motion import restart
from tests.model.reference import AG, reference, snm
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.event_driven_map import make_period_map
from twin.model import closed_form
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.model.stepped_sine import EXTREME_NAMES, MIN_STEPS_PER_CYCLE, simulate_stepped_sine

EVENT_S = 1e-12


def grid(start: float, stop: float, step: float) -> np.ndarray:
    return np.round(start + step * np.arange(round((stop - start) / step) + 1), 9)


def there_and_back(start: float, stop: float, step: float) -> np.ndarray:
    up = grid(start, stop, step)
    return np.concatenate([up, up[::-1]])


@pytest.mark.parametrize("steps", [8, 13, 64, 1000, 4000])
def test_sweep_at_g4_ends_where_it_must_on_any_grid(steps):
    sweep = simulate_stepped_sine(snm(), there_and_back(1.8, 5.0, 0.1), AG, 10, steps)
    assert sweep.column("onsets_r").sum() == 352 == sweep.column("onsets_l").sum()
    assert sweep.states[-1, 0] == pytest.approx(4.96608480e-4, rel=1e-8)
    assert sweep.states[-1, 1] == pytest.approx(-2.12754917e-2, rel=1e-8)


@pytest.mark.parametrize("frequency", [2.0, 3.4])
def test_agrees_with_dop853_over_ten_cycles(frequency):
    """State and event times; the reference moves by far less when its steps are halved."""
    p, w = snm(), 2 * math.pi * frequency
    start = restart(p, 0.0, 0.1)
    knots = np.array([0.0, 10 / frequency])
    (want, contacts), (finer, again) = (
        reference(p, start[:4], (False, False), lambda t: AG * math.sin(w * t), knots, dt=dt)
        for dt in (1e-3, 5e-4)
    )
    assert np.abs(want - finer).max() < 1e-14
    assert np.abs(contacts[:, 0] - again[:, 0]).max() < EVENT_S / 10
    sweep = simulate_stepped_sine(p, [frequency], AG, 10, state=start)
    assert np.abs(sweep.states[0, :4] - want[:, -1])[[0, 2, 3]].max() < 1e-13
    period_map = make_period_map(Model(p), frequency, AG)
    assert isinstance(period_map, ClosedFormMap)
    impacts, end = period_map.find_contacts(start[:4], 10)
    state = period_map.to_state(end)
    assert impacts[:, 1:].tolist() == contacts[:, 1:].tolist()
    assert np.abs(impacts[:, 0] / frequency - contacts[:, 0]).max() < EVENT_S
    assert np.abs(state[:4] - sweep.states[0, :4]).max() < 1e-14
    for side, name in enumerate(("onsets_r", "onsets_l")):
        onsets = impacts[(impacts[:, 1] == side) & (impacts[:, 2] == 1), 0]
        counts = np.histogram(onsets, np.arange(11))[0]
        assert counts.tolist() == sweep.column(name)[0].tolist()
    assert (start == restart(p, 0.0, 0.1)).all()


DOWN_JUMPS = [(0.030, 1.948), (0.016, 2.634), (0.010, 3.158), (0.004, 4.027)]
UP_JUMPS = [(0.010, 2.01), (0.004, 2.787)]


@pytest.mark.parametrize("gap, fold", DOWN_JUMPS)
def test_down_jump_of_the_right_hysteresis(gap, fold):
    """Slow passage from below falls off at the fold."""
    start = simulate_stepped_sine(snm(gap), grid(1.5, fold - 0.05, 0.02), AG, 20)
    assert start.column("onsets_r")[-1, -1] > 0
    slow = grid(fold - 0.02, fold + 0.03, 0.001)
    sweep = simulate_stepped_sine(snm(gap), slow, AG, 200, state=start.states[-1])
    flying = slow[sweep.column("onsets_r")[:, -1] == 0]
    assert flying[0] == pytest.approx(fold, abs=0.003)


@pytest.mark.parametrize("gap, fold", UP_JUMPS)
def test_up_jump_of_the_right_hysteresis(gap, fold):
    """Slow passage from above: flight, a graze, then the jump to large amplitudes."""
    flying = simulate_stepped_sine(snm(gap), grid(fold + 0.1, 5.0, 0.02)[::-1], AG, 20)
    assert flying.column("onsets_r")[-1, -1] == 0
    slow = grid(fold - 0.03, fold + 0.1, 0.001)[::-1]
    sweep = simulate_stepped_sine(snm(gap), slow, AG, 200, state=flying.states[-1])
    top = sweep.column("u_max")[:, -1]
    jump = int(np.argmax(np.diff(top)))
    assert np.diff(top)[jump] > 0.1 * gap
    assert slow[jump + 1] == pytest.approx(fold, abs=0.008)


@pytest.mark.parametrize("gap, detaches", [(-0.00425, True), (-0.00428, False)])
def test_permanent_contact_begins_at_minus_4265_um(gap, detaches):
    sweep = simulate_stepped_sine(snm(gap), grid(6.0, 8.0, 0.01), AG, 20)
    assert (sweep.column("onsets_r").sum() > 0) == detaches
    assert (sweep.column("onsets_l").sum() > 0) == detaches


def test_extremes_are_those_of_dense_samples():
    """3.4 Hz impacting: what 200 000 samples a cycle see, both sides of the jump included."""
    p, rate, period = snm(), 680000.0, 1 / 3.4
    settled = simulate_stepped_sine(p, grid(3.0, 3.4, 0.02), AG, 40).states[-1]
    base = AG * np.sin(2 * math.pi * 3.4 * np.arange(1, round(rate * period) + 1) / rate)
    out = np.empty((7, base.size))
    closed_form.advance_state(settled.copy(), closed_form.discretized_params(p, rate), base, out)
    u, _, a, f_r, f_l, _, _ = out
    want = [u.max(), u.min(), a.max(), a.min(), f_r.max(), f_l.min(), 1, 1]
    got = simulate_stepped_sine(p, [3.4], AG, 1, 8, settled).extremes[0, 0]
    assert got == pytest.approx(np.array(want), rel=1e-6)
    assert got[0] >= u.max() > 0 > u.min() >= got[1]
    assert len(EXTREME_NAMES) == got.size


def test_the_jump_at_onset_counts_where_it_is_the_extreme():
    """A bumper that is nearly all dashpot: the force is largest at touch, C times closing speed."""
    p = snm(0.004, bumper_stiffness_r=1e4, bumper_damping_r=9e3, gap_l=math.inf)
    start = restart(p, 0.0, 0.2)
    cycle = simulate_stepped_sine(p, [1.0], 0.0, 1, 32, start).extremes[0, 0]
    rate = 100000.0
    out, events = np.empty((7, 100000)), np.zeros((9, 5))
    closed_form.advance_state(
        start.copy(), closed_form.discretized_params(p, rate), np.zeros(100000), out, events
    )
    assert cycle[4] == pytest.approx(p.bumper_damping_r * events[0, 3], rel=1e-9)
    assert cycle[3] <= out[2].min()


def test_resonance_is_the_free_flight_maximum():
    from twin.model.parameters import free_flight_resonance

    u, a, frequency = free_flight_resonance(snm(math.inf), AG)
    sweep = simulate_stepped_sine(snm(math.inf), [frequency] * 2, AG, 60)
    assert sweep.column("u_max")[-1, -1] == pytest.approx(u, rel=1e-9)
    assert sweep.column("a_max")[-1, -1] == pytest.approx(a, rel=1e-4)
    assert sweep.column("a_max")[-1, -1] < a


def test_too_few_steps_are_refused():
    with raises_input_error(key="steps_per_cycle", value=4, allowed=MIN_STEPS_PER_CYCLE):
        simulate_stepped_sine(snm(), [2.0], AG, 1, 4)


@pytest.mark.parametrize(
    "frequencies, peak, cycles, key",
    [
        ([2.0, math.nan], AG, 1, "frequencies_hz[1]"),
        ([0.0], AG, 1, "frequencies_hz[0]"),
        ([-1.0], AG, 1, "frequencies_hz[0]"),
        ([math.inf], AG, 1, "frequencies_hz[0]"),
        ([2.0], math.nan, 1, "acceleration"),
        ([2.0], AG, 0, "cycles"),
    ],
)
def test_a_drive_that_is_none_is_refused(frequencies, peak, cycles, key):
    """By the closed form, the sampled way and the map of a cycle."""
    with pytest.raises(InputError) as error:
        simulate_stepped_sine(snm(), frequencies, peak, cycles)
    assert error.value.key == key
    assert error.value.allowed
    with pytest.raises(InputError) as error:
        simulate_sweep(
            Model(snm()).with_effect("cubic_stiffness", k3=1e6), frequencies, peak, cycles
        )
    assert error.value.key == key
    if key != "cycles":
        with pytest.raises(InputError) as error:
            make_period_map(Model(snm()), frequencies[-1], peak)
        assert error.value.key == key.replace("[1", "[0")
