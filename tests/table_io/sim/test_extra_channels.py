"""Declared channels on the simulated table: what it serves, how it is tared, how faults show."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.clock import ManualClock
from table_io.config.calibration import command_to_volts, compute_tare, volts_to_si
from table_io.config.rig import RigConfig
from table_io.safety.sample_checks import compute_thresholds
from table_io.safety.wiring_check import RestingInputs, check_resting_inputs, list_stimuli
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.profiles import make_profile
from tests.builders.rigs import EXTRA, SECOND_ACC, TEMPERATURE, UPWARD_ACC, change_rig, make_lab_rig
from tests.builders.sessions import play_guarded
from tests.builders.truths import seal_truth
from tests.table_io.safety.test_tap_test import tap

RATE_HZ = 2000.0
PROFILE = make_profile(start_hz=2.4, stop_hz=2.4, step_hz=1.0, directions=("forward",))


def acquire_sine(rig: RigConfig, samples: int = 2000) -> Block:
    """Tared samples of a sine of 1 mm at 3 Hz."""
    backend = SimulatedBackend(rig, PROFILE.specimen, RATE_HZ, ManualClock())
    backend.open()
    tare = compute_tare(backend.tare(2000), rig.sensors) | rig.stated_offsets
    command = 1e-3 * np.sin(6 * np.pi * np.arange(samples) / RATE_HZ)
    backend.queue(0, command_to_volts(command, rig.output))
    backend.start()
    values = volts_to_si(backend.read(samples), rig.sensors, tare)
    return Block("meas", 0, RATE_HZ, rig.channels, values, *[np.full(samples, -1)] * 3)


def quiet(rig: RigConfig) -> RigConfig:
    return change_rig(rig, every_sensor={"noise_rms": 0.0})


def test_declared_channel_is_the_stated_sum_and_absolute_values_are_not_tared() -> None:
    block = acquire_sine(quiet(make_lab_rig()))
    mass, table = block.channel("mass_acc_m_s2"), block.channel("table_acc_m_s2")
    assert np.ptp(mass) > 0.1
    np.testing.assert_allclose(block.channel(SECOND_ACC), -mass, atol=2e-5)
    # the constant of an accelerometer is tared away, that of a thermometer is what it measures
    np.testing.assert_allclose(block.channel(UPWARD_ACC), 0.5 * mass - 0.25 * table, atol=2e-5)
    np.testing.assert_allclose(block.channel(TEMPERATURE), 21.5, atol=0.01)


def test_noise_offset_range_and_steps_are_those_of_its_sensor() -> None:
    rig = make_lab_rig()
    backend = SimulatedBackend(rig, PROFILE.specimen, RATE_HZ, ManualClock())
    backend.open()
    volts = backend.tare(20_000)
    row = rig.channels.index(TEMPERATURE)
    assert volts[row].mean() == pytest.approx(0.05 * (21.5 + 50.0), abs=1e-4)
    assert volts[row].std() == pytest.approx(0.05 * 0.02, rel=0.05)
    step = 0.05 * rig.sensors[row].lsb
    np.testing.assert_allclose(volts[row] / step, np.rint(volts[row] / step), atol=1e-6)


def test_sealed_sensor_error_applies_to_a_declared_channel(tmp_path: Any) -> None:
    truth = f"""
[[effects]]
id = "sensor_gain"
channel = "{SECOND_ACC}"
parameters = {{ gain = 2.0 }}
"""
    block = acquire_sine(quiet(make_lab_rig(**seal_truth(tmp_path, truth))))
    np.testing.assert_allclose(
        block.channel(SECOND_ACC), -2 * block.channel("mass_acc_m_s2"), atol=4e-5
    )


@pytest.mark.parametrize(
    ("channel", "kind", "finding_kind"),
    [
        (SECOND_ACC, "rail", "rail"),
        (SECOND_ACC, "stuck", "stuck"),
        (SECOND_ACC, "nan", "lost"),
        (TEMPERATURE, "nan", "lost"),
        (TEMPERATURE, "rail", "rail"),
        (TEMPERATURE, "spike", "spike"),
    ],
)
def test_fault_of_a_declared_channel_is_found(channel: str, kind: str, finding_kind: str) -> None:
    fault = {"kind": kind, "at_s": 1.0, "channel": channel}
    fault |= {"size": 100.0} if kind == "spike" else {}
    assert play_guarded(PROFILE, make_lab_rig()).findings == []
    findings = play_guarded(PROFILE, make_lab_rig(faults=(fault,))).findings
    assert {(finding.channel, finding.kind) for finding in findings} >= {(channel, finding_kind)}
    assert {finding.channel for finding in findings} == {channel}
    assert min(finding.index for finding in findings) == pytest.approx(RATE_HZ, abs=50)


def test_every_table_accelerometer_may_show_the_steps_of_a_stiff_table() -> None:
    rig = make_lab_rig()
    channels = tuple(
        channel.model_copy(update={"body": "table"}) if channel.name == SECOND_ACC else channel
        for channel in rig.extra_channels
    )
    on_table = RigConfig.model_validate(rig.model_dump() | {"extra_channels": channels})
    row, table = rig.channels.index(SECOND_ACC), rig.channels.index("table_acc_m_s2")
    elsewhere = compute_thresholds(PROFILE, rig, {}).spike_limit
    limits = compute_thresholds(PROFILE, on_table, {}).spike_limit
    assert limits[row] > elsewhere[row]
    assert limits[row] - elsewhere[row] == pytest.approx(limits[table] - 1e-3 * 2.0 * 9.80665)


def test_wiring_check_covers_extra_channels() -> None:
    rig = make_lab_rig()
    backend = SimulatedBackend(rig, PROFILE.specimen, RATE_HZ, ManualClock())
    backend.open()
    lines = check_resting_inputs(RestingInputs(rig, RATE_HZ, backend.tare(8000)))
    assert [line for line in lines if line.verdict == "fail"] == []
    tested = {(line.name, line.channel) for line in lines}
    assert {("noise", name) for name in EXTRA} <= tested
    assert ("offset", SECOND_ACC) in tested
    assert ("offset", TEMPERATURE) not in tested  # a temperature has no value at rest


@pytest.mark.parametrize(("sign", "verdict"), [(-1.0, "pass"), (1.0, "fail")])
def test_tap_proves_the_polarity_of_a_declared_sensor(sign: float, verdict: str) -> None:
    from table_io.safety.wiring_check import TapResponse, evaluate_tap

    rig = make_lab_rig()
    mass = list_stimuli(rig)[1]
    assert mass.channels == ("mass_acc_m_s2", "mass_disp_m", SECOND_ACC)  # not the upward one
    noise = np.array([sensor.noise_rms for sensor in rig.sensors])
    swings = {"mass_acc_m_s2": tap(0.1), "mass_disp_m": tap(0.2), SECOND_ACC: sign * tap(0.12)}
    response = TapResponse(rig, RATE_HZ, np.zeros((len(rig.sensors), tap(1.0).size)), noise, 800)
    values = noise[:, None] * np.random.default_rng(1).standard_normal(response.values.shape)
    for name, swing in swings.items():
        values[rig.channels.index(name)] += swing
    lines = evaluate_tap(mass, replace(response, values=values), "")
    verdicts = {line.channel: line.verdict for line in lines if line.name == "polarity"}
    assert verdicts == {"mass_acc_m_s2": "pass", "mass_disp_m": "pass", SECOND_ACC: verdict}
    assert not [line for line in lines if line.name == "place"]
