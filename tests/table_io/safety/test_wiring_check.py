"""What is wrong with the wiring is found at rest, by its own line; what is right passes."""

from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Float2D
from table_io.config.rig import RigConfig
from table_io.safety.wiring_check import (
    CheckLine,
    RestingInputs,
    check_resting_inputs,
    check_zero_command,
    fit_mains_hum,
)
from tests.builders.rigs import RIG, change_rig

RATE, SAMPLES = 2000.0, 8000
ACC = RIG.channels.index("table_acc_m_s2")
LASER = RIG.channels.index("table_disp_m")
CELL = RIG.channels.index("force_l2_n")
TIME = np.arange(SAMPLES) / RATE


def column(values: list[float]) -> Float2D:
    return np.array(values)[:, None]


GAIN = column([sensor.volts_per_unit for sensor in RIG.sensors])


def still(rate: float = RATE, seed: int = 3) -> Float2D:
    """What the inputs of the shipped card show at rest, in the unit of each sensor."""
    noise = np.random.default_rng(seed).standard_normal((len(RIG.sensors), SAMPLES))
    values = column([s.offset for s in RIG.sensors]) + noise * column(
        [s.noise_rms for s in RIG.sensors]
    )
    lsb = column([s.lsb for s in RIG.sensors])
    rounded: Float2D = np.rint(values / lsb) * lsb
    return rounded


def lines(values: Float2D, rate: float = RATE, rig: RigConfig = RIG) -> tuple[CheckLine, ...]:
    return check_resting_inputs(RestingInputs(rig, rate, values * GAIN))


def list_failures(values: Float2D, rate: float = RATE) -> set[tuple[str, str]]:
    return {(line.name, line.channel) for line in lines(values, rate) if line.verdict == "fail"}


@pytest.mark.parametrize("seed", range(8))
def test_sound_wiring_passes(seed: int) -> None:
    assert list_failures(still(seed=seed)) == set()


def test_every_channel_has_every_line() -> None:
    results = lines(still())
    for sensor in RIG.sensors[1:]:
        names = [line.name for line in results if line.channel == sensor.channel]
        assert names == [
            "lost samples", "at the rail", "stuck", "noise", "bits used", "spikes", "mains hum",
            "offset", "steady", "same noise as another",
        ]  # fmt: skip
    assert all(bool(line.do) == (line.verdict != "pass") for line in results)
    # A command that stands still, without noise, cannot be told from one that is stuck.
    assert [line.channel for line in results if line.verdict == "not tested"] == ["drive_disp_m"]


def spoilt(row: int, values: np.ndarray | float) -> Float2D:
    """The inputs at rest with another row."""
    out = still()
    out[row] = values
    return out


def test_lost_channel_has_no_other_failure() -> None:
    values = spoilt(ACC, np.nan)
    assert list_failures(values) == {("lost samples", "table_acc_m_s2")}
    assert [line.value for line in lines(values) if line.channel == "table_acc_m_s2"] == [100.0]
    values = still()
    values[CELL, 100] = np.nan
    assert list_failures(values) == {("lost samples", "force_l2_n")}


def test_stuck_channel_from_the_first_sample_or_later() -> None:
    assert ("stuck", "table_acc_m_s2") in list_failures(spoilt(ACC, 0.001))
    values = still()
    values[ACC, 5000:] = values[ACC, 4999]
    assert ("stuck", "table_acc_m_s2") in list_failures(values)
    values = still()
    values[ACC, 5000:5400] = values[ACC, 4999]  # 0.2 s: a converter may repeat itself so long
    assert ("stuck", "table_acc_m_s2") not in list_failures(values)


def test_noise_below_half_a_step_is_not_taken_for_a_stuck_channel() -> None:
    coarse = {"bits": 12, "noise_rms": 0.005}
    lasers = [sensor.channel for sensor in RIG.sensors if sensor.unit == "mm"]
    rig = change_rig(sensors=dict.fromkeys(lasers, coarse))
    values = spoilt(LASER, 0.1)
    (line,) = (
        line
        for line in lines(values, rig=rig)
        if line.channel == "table_disp_m" and line.name == "stuck"
    )
    assert line.verdict == "not tested"


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_channel_at_its_rail(sign: float) -> None:
    assert ("at the rail", "table_disp_m") in list_failures(spoilt(LASER, sign * 75.0))
    values = still()
    values[LASER, 7] = sign * 75.0
    assert ("at the rail", "table_disp_m") in list_failures(values)


def test_cable_that_is_off_is_too_quiet_and_a_bad_earth_too_loud() -> None:
    quiet = 2e-5 * np.random.default_rng(5).standard_normal(SAMPLES)  # 100 dB under 2 g
    results = {line.channel: line for line in lines(spoilt(ACC, quiet)) if line.name == "noise"}
    assert results["table_acc_m_s2"].verdict == "fail"
    assert results["table_acc_m_s2"].value < results["table_acc_m_s2"].low
    loud = still()
    loud[ACC] += 0.002 * np.random.default_rng(5).standard_normal(SAMPLES)
    assert list_failures(loud) == {("noise", "table_acc_m_s2")}


def test_unknown_noise_is_not_tested_and_measured() -> None:
    rig = change_rig(every_sensor={"noise_rms": 0.0})
    results = [line for line in lines(still(), rig=rig) if line.name == "noise"]
    assert {line.verdict for line in results} == {"not tested"}
    (laser,) = (line.do for line in results if line.channel == "table_disp_m")
    assert "noise_rms" in laser
    assert float(laser.split(" mm")[0].split()[-1]) == pytest.approx(0.005, rel=0.05)
    assert {line.verdict for line in lines(still(), rig=rig)} == {"pass", "not tested"}


@pytest.mark.parametrize(
    ("mains", "rate"),
    [(49.9, 1000.0), (50.0, 2000.0), (50.13, 4000.0), (60.0, 1000.0), (59.95, 2000.0)],
)
def test_hum_has_frequency_and_size(mains: float, rate: float) -> None:
    t = np.arange(SAMPLES) / rate
    values = still()
    values[CELL] += 0.004 * np.sqrt(2) * np.sin(2 * np.pi * mains * t + 0.3)
    values[CELL] += 0.001 * np.sqrt(2) * np.sin(2 * np.pi * 3 * mains * t)
    results = {line.channel: line for line in lines(values, rate) if line.name == "mains hum"}
    assert results["force_l2_n"].verdict == "fail"
    assert results["force_l2_n"].value == pytest.approx(np.hypot(0.004, 0.001), rel=0.03)
    hum_hz = float(results["force_l2_n"].do.split(" Hz")[0].split()[-1])
    assert hum_hz == pytest.approx(mains, abs=0.051)
    resting = RestingInputs(RIG, rate, values * GAIN)
    assert resting.hum.frequency_hz == pytest.approx(mains, abs=0.02 * rate / SAMPLES)
    # What every other channel makes of white noise is no hum.
    assert [line.channel for line in results.values() if line.verdict == "fail"] == ["force_l2_n"]


def test_hum_in_two_channels_is_hum_and_not_one_signal_twice() -> None:
    values = still()
    for row in (CELL, ACC):
        values[row] += 20 * RIG.sensors[row].noise_rms * np.sin(2 * np.pi * 50.02 * TIME)
    failures = list_failures(values)
    assert {channel for name, channel in failures if name == "mains hum"} == {
        "force_l2_n",
        "table_acc_m_s2",
    }
    assert not any(name == "same noise as another" for name, _ in failures)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_signal_at_two_inputs(sign: float) -> None:
    values = still()
    other = RIG.channels.index("mass_acc_m_s2")
    values[other] = sign * values[ACC]
    named = {line.channel: line for line in lines(values) if line.name == "same noise as another"}
    assert [line.channel for line in named.values() if line.verdict == "fail"] == [
        "table_acc_m_s2",
        "mass_acc_m_s2",
    ]
    assert "mass_acc_m_s2" in named["table_acc_m_s2"].do
    assert named["table_acc_m_s2"].value == pytest.approx(sign, abs=0.01)


def test_offset_drift_and_spike() -> None:
    assert list_failures(still() + np.eye(len(RIG.sensors))[[CELL]].T * 3.0) == {
        ("offset", "force_l2_n")
    }
    values = still()
    values[LASER] += 0.1 * TIME
    assert ("steady", "table_disp_m") in list_failures(values)
    values = still()
    values[ACC, 1234] += 0.01
    assert list_failures(values) == {("spikes", "table_acc_m_s2")}


def test_offset_of_the_card_is_where_the_range_begins() -> None:
    """A laser that stands 40 mm off is right where its card says so."""
    rig = change_rig(sensors={"table_disp_m": {"offset": 40.0}})
    values = still()
    assert [line.channel for line in lines(values, rig=rig) if line.verdict == "fail"] == [
        "table_disp_m"
    ]
    values[LASER] += 40.0
    assert not [line for line in lines(values, rig=rig) if line.verdict == "fail"]


def test_effective_bits_under_noise() -> None:
    resting = RestingInputs(RIG, RATE, still() * GAIN)
    assert resting.effective_bits(LASER) == pytest.approx(
        np.log2(150.0 / (np.sqrt(12) * 0.005)), abs=0.05
    )
    assert resting.effective_bits(0) == RIG.sensors[0].bits  # nothing but the converter's own steps
    rig = change_rig(sensors={"table_disp_m": {"noise_rms": 1.0}})
    values = spoilt(LASER, np.random.default_rng(5).standard_normal(SAMPLES))
    failed = [line for line in lines(values, rig=rig) if line.verdict == "fail"]
    assert [(line.name, line.channel) for line in failed] == [("bits used", "table_disp_m")]


@pytest.mark.parametrize(
    ("shown_mm", "passed"), [(0.0, True), (0.05, True), (0.07, False), (-6.0, False)]
)
def test_command_that_is_not_at_0_volts(shown_mm: float, passed: bool) -> None:
    values = spoilt(0, shown_mm)
    (line,) = check_zero_command(RestingInputs(RIG, RATE, values * GAIN))
    assert (line.verdict == "pass") is passed
    assert line.value == pytest.approx(shown_mm)
    turned = replace(RestingInputs(RIG, RATE, values * GAIN), volts=np.full_like(values, np.nan))
    assert (
        next(check_zero_command(turned)).verdict == "fail"
    )  # a command that is not seen may be anywhere


@pytest.mark.parametrize("hz", [0.5, 1.0, 10.0])
def test_command_that_swings_about_0_volts_is_not_at_0_volts(hz: float) -> None:
    """+-8 V, whose mean over a tare of one second is nothing."""
    values = spoilt(0, 48.0 * np.sin(2 * np.pi * hz * TIME + 0.1))[:, :2000]
    values[0, 700] = np.nan  # one that was lost hides nothing
    (line,) = check_zero_command(RestingInputs(RIG, RATE, values * GAIN))
    assert line.verdict == "fail"
    assert abs(line.value) == pytest.approx(48.0, rel=0.01)


@pytest.mark.parametrize("share", [0.02, 0.1, 1.0])
def test_size_of_hum_is_free_of_the_noise_that_its_tones_catch(share: float) -> None:
    rate_hz, count, trials = 2000.0, 1000, 40
    t = np.arange(count) / rate_hz
    noise = np.random.default_rng(2).standard_normal((trials, count))
    hum = share * np.sqrt(2.0) * np.sin(2.0 * np.pi * 50.0 * t)
    rms = fit_mains_hum(noise + hum, rate_hz).rms
    # Ten tones catch 1 % of the power of white noise in a record of 1000 samples.
    assert np.sqrt(np.mean(rms**2)) == pytest.approx(share, abs=0.03 if share > 0.05 else 0.07)
    power = np.mean(fit_mains_hum(hum + np.sqrt(10.0) * noise, rate_hz).rms ** 2)
    assert power == pytest.approx(share**2, abs=0.08)
