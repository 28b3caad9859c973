"""The stroboscopic map of the model: its motion, and its derivatives in every regime."""

import math

import numpy as np
import pytest

from tests.dynamics.maps import model_map, settle
from tests.input_errors import raises_input_error
from tests.model.reference import AG, snm
from twin.dynamics.period_map import ClosedFormPeriodMap, change_parameter
from twin.model.model import Model
from twin.model.stepped_sine import simulate_stepped_sine


def sweep_slowly(p, start: float, stop: float) -> np.ndarray:
    """The state after slow passage from one frequency to another."""
    count = max(2, round(abs(stop - start) / 0.02) + 1)
    return simulate_stepped_sine(p, np.linspace(start, stop, count), AG, 40).states[-1]


REGIMES = [
    (snm(), 3.4, 2.6),  # impacting
    (snm(), 3.4, 5.0),  # flight
    (snm(), 0.53, 0.5),  # three impacts a side
    (snm(0.0), 5.0, 4.0),
    (snm(-0.001), 5.5, 6.5),  # leaves each bumper, starts in contact with one or two
    (snm(-0.010), 6.9, 6.0),  # never leaves
    (snm(0.004, bumper_damping_r=6e4, bumper_damping_l=2e4), 2.0, 1.5),  # slow bumpers remember
    (snm(0.004, bumper_damping_r=0.0, bumper_damping_l=0.0), 2.4, 2.0),  # no memory
    (snm(0.004, bumper_damping_r=0.0, gap_l=math.inf), 2.4, 2.0),  # one bumper
    (snm(0.004, gap_r=0.003, gap_l=-0.0005), 3.4, 2.6),  # one preloaded
]


@pytest.mark.parametrize("p, frequency, start", REGIMES)
@pytest.mark.parametrize("periods", [1, 2])
def test_derivatives_agree_with_central_differences(p, frequency, start, periods):
    period_map = ClosedFormPeriodMap(Model(p))
    x = period_map.from_state(sweep_slowly(p, start, frequency))
    result = period_map.evaluate(x, frequency, AG, periods)

    def compare(column, ends, step):
        want = (ends[0].end - ends[1].end) / (2 * step)
        assert np.abs(column - want).max() < 4e-6 * max(1, np.abs(want).max())

    state = period_map.to_state(x)
    faces = {row: 2 + index for index, row in enumerate(period_map._faces)}
    for column in range(period_map.size):
        h, step = 1e-7 if column == 1 else 1e-8, np.zeros(period_map.size)
        step[column] = h
        for side in (0, 1):  # in contact the face goes with the mass
            if state[4 + side] and 2 + side in faces:
                if column == 0:
                    step[faces[2 + side]] = h
                elif column == faces[2 + side]:
                    step[column] = 0.0
        if step.any() or column < 2:
            ends = [period_map.evaluate(x + s * step, frequency, AG, periods) for s in (1, -1)]
            moved = result.jacobian @ (step / h)
            compare(moved, ends, h)
    h = 1e-7
    for index in (0, 1):
        ends = [
            period_map.evaluate(
                x, frequency + s * h * (index == 0), AG + s * h * (index == 1), periods
            )
            for s in (1, -1)
        ]
        compare(result.d_parameters[:, index], ends, h)
    for side, name in enumerate(("gap_r", "gap_l")):
        gap, h = getattr(p, name), 1e-9
        if not math.isfinite(gap):
            continue
        shift = np.zeros(period_map.size)
        if state[4 + side] and 2 + side in faces:
            shift[faces[2 + side]] = (2 * side - 1) * h
        ends = [
            period_map.with_parameter(name, gap + s * h).evaluate(
                x + s * shift, frequency, AG, periods
            )
            for s in (1, -1)
        ]
        by_gap = result.d_parameters[:, 2 + side] + result.jacobian @ (shift / h)
        compare(by_gap, ends, h)


def test_the_map_is_the_stepped_driver():
    p = snm()
    period_map = ClosedFormPeriodMap(Model(p))
    state = sweep_slowly(p, 0.5, 0.53)
    for _ in range(3):
        result = period_map.evaluate(period_map.from_state(state), 0.53, AG)
        state = simulate_stepped_sine(p, [0.53], AG, 1, state=state).states[0]
        assert result.end == pytest.approx(state[:4], abs=1e-12)
        assert period_map.to_state(result.end)[4:6] == pytest.approx(state[4:6])


def test_the_map_is_smooth_where_an_onset_passes_the_start():
    """A face inside the mass passes through the onset, so that Newton's method can cross it."""
    p = snm(0.004, bumper_damping_r=2e4)
    period_map = ClosedFormPeriodMap(Model(p))
    x = np.array([0.002 + 1e-6, 0.1, 1e-6, 0.0])
    ends = [  # with the face behind and before the mass
        period_map.evaluate(x + np.array([0, 0, lead, 0]), 2.0, AG).end for lead in (-1e-8, 1e-8)
    ]
    rate = period_map.evaluate(x, 2.0, AG).jacobian[:, 2]
    assert (ends[1] - ends[0]) / 2e-8 == pytest.approx(rate, rel=1e-4, abs=1e-6)
    assert abs(rate[1]) > 1


def test_flight_multipliers_are_the_oscillators():
    """exp(lambda T), lambda = -a +- i wd: size exp(-C T / 2M)."""
    orbit = settle(model_map(math.inf), 2.0)
    assert orbit.x.size == 2
    assert np.abs(orbit.multipliers) == pytest.approx(math.exp(-1 / 2.0), rel=1e-12)
    w = 4 * math.pi
    assert orbit.u_max == pytest.approx(AG / abs(36e3 / 550 - w * w + 2j * w), rel=1e-12)


def test_parameters_by_name():
    model = Model(snm(0.004, gap_r=0.003, gap_l=0.001)).with_effect("gap_offset", offset=1e-4)
    wider = change_parameter(model, "gap", 0.006)
    assert (wider.base.gap_r, wider.base.gap_l) == (pytest.approx(0.004), pytest.approx(0.002))
    assert change_parameter(model, "mass", 600.0).base.mass == 600.0
    moved = change_parameter(model, "gap_offset.offset", 2e-4)
    assert moved.parameters.gap_r == pytest.approx(0.0032)
    with raises_input_error(key="stifness", remedy="stiffness"):
        change_parameter(model, "stifness", 1.0)
    with raises_input_error(key="gap", allowed="gap_r or gap_l"):
        change_parameter(Model(snm(0.004, gap_l=math.inf)), "gap", 0.006)
