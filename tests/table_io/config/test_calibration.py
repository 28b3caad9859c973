"""Volts and SI, both ways: volts = (value + offset) * volts_per_si; the tare takes the offset."""

from itertools import groupby

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from table_io.config.calibration import command_to_volts, compute_tare, measure_noise, volts_to_si
from table_io.config.rig import OutputConfig
from table_io.config.sensor import SensorConfig
from tests.builders.rigs import RIG, command_to_si, si_to_volts

REVERSED = SensorConfig(channel="force_l1_n", unit="kN", range=10.0, volts_per_unit=-0.5, bits=16)


def ramp(channels: int) -> np.ndarray:
    return np.linspace(-3.0, 4.0, 7 * channels).reshape(channels, 7)


def test_sign_and_the_unit_of_the_convention() -> None:
    # 2 kN of compression on a cell that shows 0.4 kN at rest and gives -0.5 V a kN.
    volts = si_to_volts(np.array([[2000.0]]), (REVERSED,), {"force_l1_n": 400.0})
    assert volts[0, 0] == pytest.approx((2.0 + 0.4) * -0.5)
    assert volts_to_si(np.array([[-1.2]]), (REVERSED,), {"force_l1_n": 400.0})[
        0, 0
    ] == pytest.approx(2e3)


@given(st.lists(st.floats(-100.0, 100.0), min_size=9, max_size=9))
def test_both_directions_undo_each_other(offsets: list[float]) -> None:
    tare = dict(zip(RIG.channels, offsets, strict=True))
    values = ramp(len(RIG.sensors))
    volts = si_to_volts(values, RIG.sensors, tare)
    np.testing.assert_allclose(volts_to_si(volts, RIG.sensors, tare), values, rtol=0, atol=1e-12)
    back = si_to_volts(volts_to_si(values, RIG.sensors, tare), RIG.sensors, tare)
    np.testing.assert_allclose(back, values, rtol=0, atol=1e-9)


def test_channel_without_tare_has_no_offset() -> None:
    sensors, values = (*RIG.sensors, REVERSED), ramp(len(RIG.sensors) + 1)
    other = {"none of these": 5.0, RIG.channels[2]: 0.5}
    slope = np.array([sensor.volts_per_si for sensor in sensors])[:, None]
    offset = np.array([0.5 if place == 2 else 0.0 for place in range(len(sensors))])[:, None]
    np.testing.assert_allclose(si_to_volts(values, sensors, other), (values + offset) * slope)
    np.testing.assert_allclose(volts_to_si(values, sensors, other), values / slope - offset)


def test_tare_removes_what_the_sensors_show_at_rest() -> None:
    shown = {name: 0.01 * (place + 1) for place, name in enumerate(RIG.channels)}
    rest = si_to_volts(np.zeros((len(RIG.channels), 100)), RIG.sensors, shown)
    tare = compute_tare(rest, RIG.sensors)
    assert "drive_disp_m" not in tare  # the command is where zero is; it is never moved
    assert tare == pytest.approx({k: v for k, v in shown.items() if k != "drive_disp_m"})
    moved = si_to_volts(np.ones((len(RIG.channels), 5)), RIG.sensors, shown)
    np.testing.assert_allclose(volts_to_si(moved, RIG.sensors, tare)[1:], 1.0, atol=1e-12)


def test_sample_lost_during_the_tare_does_not_lose_the_channel() -> None:
    rest = si_to_volts(np.zeros((len(RIG.channels), 100)), RIG.sensors, {"table_disp_m": 0.002})
    rest[1, 3] = np.nan
    rest[4, :] = np.nan
    tare = compute_tare(rest, RIG.sensors)
    assert tare["table_disp_m"] == pytest.approx(0.002)
    assert np.isnan(tare[RIG.channels[4]])  # no zero is known, so no value is made up


def test_command_fills_its_span_and_comes_back() -> None:
    output = OutputConfig(span_mm=60.0, span_v=10.0, bits=16)
    metres = np.linspace(-0.06, 0.06, 9)
    volts = command_to_volts(metres, output)
    assert (volts[0], volts[-1]) == (-10.0, 10.0)
    np.testing.assert_allclose(command_to_si(volts, output), metres, rtol=1e-15)


@pytest.mark.parametrize("seed", range(3))
def test_noise_and_tare_are_those_of_the_samples_that_arrived(seed: int) -> None:
    """Each channel with its own repeated values and losses; one loses all, one is constant."""
    draw = np.random.default_rng(seed)
    sensors = (*RIG.sensors, REVERSED)
    volts = 1e-3 * draw.integers(0, 2 + seed, (len(sensors), 200)).astype(float)
    volts[draw.random(volts.shape) < 0.1] = np.nan
    volts[3] = np.nan
    volts[4] = 0.25
    noise, tare = measure_noise(volts, sensors), compute_tare(volts, sensors)
    assert noise.keys() == {sensor.channel for sensor in sensors} - {sensors[3].channel}
    assert tare.keys() == {sensor.channel for sensor in sensors} - {"drive_disp_m"}
    rows = {sensor.channel: (row, sensor) for row, sensor in zip(volts, sensors, strict=True)}
    for channel, (row, sensor) in rows.items():
        known = row[~np.isnan(row)] / sensor.volts_per_si
        if channel == sensors[3].channel:
            assert np.isnan(tare[channel])
            continue
        rms, run = noise[channel]
        assert rms == pytest.approx(np.sqrt(np.mean((known - known.mean()) ** 2)), abs=1e-9)
        assert run == max(len(list(values)) for _, values in groupby(known.tolist()))
        if channel in tare:
            assert tare[channel] == pytest.approx(known.mean(), rel=1e-9, abs=1e-12)
    assert noise[sensors[4].channel] == (pytest.approx(0.0, abs=1e-9), 200)
