"""The controller on the simulated table, whose servo rolls off and whose payload pushes back."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from table_io.block import Label
from table_io.config.profile import ControlConfig
from table_io.config.rig import TableResponse
from table_io.control.amplitude_control import Tuning, is_within_tolerance, update_target
from table_io.control.table_response import evaluate_transfer
from table_io.excitation.trajectory import SineTarget
from table_io.harmonics import HarmonicFit, track_harmonics
from table_io.records import FrequencyResponse, Level, Step
from table_io.sequencer.procedure import make_test_plan, start_test
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import make_profile
from tests.builders.rigs import change_rig
from tests.builders.sessions import play_session

A = 0.05 * GRAVITY_M_S2
RESPONSE = FrequencyResponse(0, (1.0, 3.0, 9.0), (1.0, 0.98, 0.85), (-0.06, -0.2, -0.6))


@cache
def list_levels_of_cancelling() -> tuple[Level, ...]:
    """Return the evaluations at 2.0 and 2.4 Hz, G4: the mass hits both bumpers once a cycle."""
    test = make_profile(
        tables={"control": {"harmonics": True}},
        stop_hz=2.4,
        step_hz=0.4,
        measured_cycles=3,
        directions=["forward"],
    )
    return tuple(play_session(test).select(Level))


@pytest.mark.parametrize("control", [True, False])
def test_controlled_level_is_within_2_percent(control: bool) -> None:
    """At 7 to 10 Hz, where the servo has lost a tenth; G-10, both bumpers always touched."""
    test = make_profile(
        -10.0,
        {"control": {"enabled": control}},
        start_hz=7.0,
        stop_hz=10.0,
        step_hz=1.5,
        cycles=10,
        measured_cycles=3,
        directions=["forward"],
    )
    block = play_session(test).block
    errors = []
    for step in test.steps:
        at = (block.step == step.index) & (block.label == Label.MEASURE)
        phase = block.time_s[at] * step.frequency_hz
        fit = track_harmonics(block.channel("table_acc_m_s2")[at], phase)
        errors.append(abs(fit.fundamental / A - 1.0))
    assert len(errors) == 3
    assert max(errors) <= 0.02 if control else max(errors) > 0.05


@pytest.mark.parametrize("step", [0, 1])
def test_harmonics_fall_by_10_db_in_at_most_five_updates(step: int) -> None:
    levels = [level for level in list_levels_of_cancelling() if level.step == step]
    first, last = (np.linalg.norm(level.harmonics_m_s2) for level in (levels[0], levels[-1]))
    assert first > 0.01 * A  # there is something to cancel
    assert 20 * np.log10(last / first) <= -10.0
    assert levels[-1].update <= 5
    assert levels[-1].accepted
    assert all(abs(level.measured_m_s2 / A - 1.0) <= 0.02 for level in levels)


def test_prediction_follows_the_nearest_step_and_remembers_each_frequency() -> None:
    tuning = (
        Tuning(RESPONSE)
        .add_accepted(SineTarget(2.8, A, 0.80))
        .add_accepted(SineTarget(3.0, A, 1.10))
        .add_accepted(SineTarget(3.2, A, 1.20))
    )
    inverse = [1 / abs(evaluate_transfer(RESPONSE, f)) for f in (3.2, 3.4)]
    ahead = tuning.predict_target(Step(2, "forward", 3.4, A))
    assert ahead.correction == pytest.approx(1.20 * inverse[1] / inverse[0])
    assert tuning.predict_target(Step(3, "backward", 3.0, A)).correction == 1.10
    again = tuning.add_accepted(SineTarget(3.0, A, 1.15))
    assert again.predict_target(Step(3, "backward", 3.0, A)).correction == 1.15
    assert Tuning().predict_target(Step(0, "forward", 3.0, A)) == SineTarget(3.0, A)


def make_fit(
    fundamental: float, overtones: tuple[complex, ...] = (), residual_rms: float = 0.0
) -> HarmonicFit:
    amplitudes = np.zeros(10, dtype=complex)
    amplitudes[: 1 + len(overtones)] = (fundamental, *overtones)
    return HarmonicFit(0.0, amplitudes, residual_rms)


@pytest.mark.parametrize("correction", [0.51, 0.9, 1.0, 1.3, 1.97])
@pytest.mark.parametrize("gain", [0.3, 0.8, 1.0])
@pytest.mark.parametrize("clamp_db", [0.5, 2.0, 6.0])
def test_correction_changes_by_the_error_to_the_gain_within_its_bounds(
    correction: float, gain: float, clamp_db: float
) -> None:
    config = ControlConfig(gain=gain, clamp_db=clamp_db)
    for ratio in (0.3, 0.7, 0.95, 0.985, 0.995, 1.005, 1.015, 1.05, 1.4, 3.0):
        target = SineTarget(3.0, A, correction)
        measured = make_fit(ratio * A, (0.1j * A,) * 4)
        changed = update_target(target, measured, measured, Tuning(RESPONSE), config)
        if abs(ratio - 1.0) <= 0.01:  # half of the tolerance
            assert changed is target
            continue
        change_db = min(max(-20.0 * gain * np.log10(ratio), -clamp_db), clamp_db)
        expected = min(max(correction * 10 ** (change_db / 20.0), 0.5), 2.0)
        assert changed == replace(target, correction=changed.correction)
        assert changed.correction == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_tolerance_includes_its_bound_and_half_of_it_is_accepted(sign: float) -> None:
    config = ControlConfig(tolerance=1.0 / 32.0)  # exact in binary, like its half
    for sixtyfourths in (0.0, 0.99, 1.0, 1.01, 1.99, 2.0, 2.01):
        target = SineTarget(3.0, 2.0)
        measured = make_fit(2.0 * (1.0 + sign * sixtyfourths / 64.0))
        assert is_within_tolerance(target, measured, config) == (sixtyfourths <= 2.0)
        changed = update_target(target, measured, measured, Tuning(), config)
        assert (changed == target) == (sixtyfourths <= 1.0)


def simulate_overtones(
    target: SineTarget, tuning: Tuning, disturbance: tuple[complex, ...]
) -> tuple[complex, ...]:
    """Harmonics 2 to 5 of the acceleration of a linear table plus a disturbance, m/s2.

    A displacement of relative order k has k^2 times the acceleration.
    """
    shape = (*target.shape, 0j, 0j, 0j, 0j)
    return tuple(
        disturbance[order - 2]
        + tuning.transfer(order * target.frequency_hz)
        * order**2
        * target.level_m_s2
        * target.correction
        * shape[order - 2]
        for order in (2, 3, 4, 5)
    )


DISTURBANCE = (0.03 + 0.01j, -0.05j, 0.02 - 0.02j, 0.01 + 0j)


@pytest.mark.parametrize("response", [None, RESPONSE])
@pytest.mark.parametrize("shape", [(), (0.002j, -0.001 + 0j), (0.001 + 0j, 0.002j, 0j, 0.003j)])
def test_each_update_leaves_a_fifth_of_every_overtone(
    shape: tuple[complex, ...], response: FrequencyResponse | None
) -> None:
    tuning, config = Tuning(response), ControlConfig(harmonics=True)
    target = SineTarget(1.7, A, 1.2, shape)
    before = simulate_overtones(target, tuning, DISTURBANCE)
    measured = make_fit(A, before)
    changed = update_target(target, measured, measured, tuning, config)
    after = simulate_overtones(changed, tuning, DISTURBANCE)
    np.testing.assert_allclose(after, 0.2 * np.array(before), rtol=0, atol=1e-12)
    assert changed == replace(target, shape=changed.shape)
    off = ControlConfig(harmonics=False)
    assert update_target(target, measured, measured, tuning, off) is target


@pytest.mark.parametrize("order", [2, 3, 4, 5])
@pytest.mark.parametrize("goal", ["15 dB", "noise"])
def test_overtone_at_its_goal_keeps_its_shape(goal: str, order: int) -> None:
    """The goal: 15 dB below the first evaluation, at least 3 sd of an amplitude in noise."""
    rms = 0.02
    first = make_fit(A, tuple(0.05 * k * np.exp(1j * k) for k in (2, 3, 4, 5)))
    limit = abs(first.amplitudes[order - 1]) * 10 ** (-15 / 20)
    if goal == "noise":
        limit, first = 3.0 * rms * np.sqrt(2.0 / 1000.0), make_fit(A)
    shape = (0.01j, 0.02 + 0j, -0.01j, 0j)
    for ratio, changes in ((0.9999, False), (1.0001, True)):
        overtones = [0j] * 4
        overtones[order - 2] = ratio * limit * np.exp(2j)
        measured = make_fit(A, tuple(overtones), rms if goal == "noise" else 0.0)
        target = SineTarget(2.0, A, 1.1, shape)
        tuned = update_target(
            target, measured, first, Tuning(RESPONSE), ControlConfig(harmonics=True)
        )
        assert (tuned.shape[order - 2] != shape[order - 2]) == changes
        kept = [k for k in range(4) if k != order - 2]
        assert [tuned.shape[k] for k in kept] == [shape[k] for k in kept]


@pytest.mark.parametrize("gain", [0.1, 0.5, 0.8, 1.0, 1.6, 2.0, 9.0])
def test_prediction_inverts_the_gain_within_its_bounds(gain: float) -> None:
    tuning = Tuning(FrequencyResponse(0, (2.0,), (gain,), (0.0,)))
    expected = min(max(1.0 / gain, 0.5), 2.0)
    for frequency_hz in (1.0, 2.0, 7.0):
        predicted = tuning.predict_target(Step(0, "forward", frequency_hz, A))
        assert predicted == SineTarget(frequency_hz, A, predicted.correction)
        assert predicted.correction == pytest.approx(expected, rel=1e-12)


def test_remembered_target_takes_the_level_of_the_step() -> None:
    accepted = SineTarget(3.0, A, 1.1, (0.01j,))
    tuning = Tuning(RESPONSE).add_accepted(accepted).add_accepted(SineTarget(3.4, A, 1.3))
    assert tuning.predict_target(Step(5, "backward", 3.0, 2.0 * A)) == replace(
        accepted, level_m_s2=2.0 * A
    )
    again = tuning.add_accepted(SineTarget(3.0, A, 1.2))
    assert [target.correction for target in again.accepted] == [1.3, 1.2]


@pytest.mark.parametrize("gain", [(0.8, 1.2), (0.95, 1.2), (1.01, 1.3)])
@pytest.mark.parametrize("top_gain", [(0.2, 1.25), (0.95, 1.25), (1.01, 2.5)])
def test_every_gain_that_a_rig_accepts_can_be_corrected(
    gain: tuple[float, float], top_gain: tuple[float, float]
) -> None:
    response = TableResponse(gain=gain, top_gain=top_gain)
    tuning = Tuning(max_correction=response.max_correction)
    for accepted in (*gain, *top_gain, 0.5, 2.0):
        corrected = tuning.correct(SineTarget(3.0, A), 1.0 / accepted)
        assert corrected.correction == pytest.approx(1.0 / accepted)


@pytest.mark.parametrize(
    ("frequency_hz", "limits", "room"),
    [
        (0.5, {}, 60e-3 / (A / np.pi**2)),
        (2.0, {"velocity_mm_s": 50.0}, 50e-3 / (A / (4 * np.pi))),
        (5.0, {"acceleration_g": 0.06}, 1.2),
        (5.0, {"acceleration_g": 0.04}, 1.0),  # refused before motion, not lowered
        (5.0, {}, 5.0),  # by the gains that the rig accepts
    ],
)
def test_level_control_keeps_a_command_within_the_limits_of_the_rig(
    frequency_hz: float, limits: dict[str, float], room: float
) -> None:
    """The limits are checked at the gain of the loop check; at its level a table may have less."""
    rig = change_rig(table_response={"top_gain": [0.2, 1.25]}, limits=limits)
    tuning = start_test(make_test_plan(make_profile(), rig)).tuning
    target, config = SineTarget(frequency_hz, A), ControlConfig()
    for _ in range(9):
        weak = make_fit(0.1 * A)
        target = update_target(target, weak, weak, tuning, config)
    assert target.correction == pytest.approx(room)
