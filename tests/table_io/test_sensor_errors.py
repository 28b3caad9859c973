"""Gain, low cut and delay of an accelerometer, from a motion without a period."""

import math

import numpy as np
import pytest
from scipy import signal

from table_io.block import Float1D
from table_io.safety.consistency import WeakFormPair, compare_motion, make_window
from table_io.safety.cycle_checks import MIN_BASELINE_CHECKS
from table_io.sensor_errors import (
    MAX_LOW_CUT_RAD_S,
    PairErrorEstimate,
    filter_first_order,
    highpass,
)

RATE_HZ, CYCLE_HZ = 1000.0, 0.8


def record_motion(gain: float, low_cut_hz: float, delay_s: float) -> tuple[Float1D, Float1D]:
    """Return 20 s of (displacement, measured acceleration) of two incommensurate sines."""
    t = np.arange(20000) / RATE_HZ
    x, a = np.zeros_like(t), np.zeros_like(t)
    for amplitude, hz in ((0.02, CYCLE_HZ), (0.008, 0.8 * math.sqrt(3.0)), (0.004, 0.37)):
        omega = 2 * math.pi * hz
        response = gain * 1j * omega / (1j * omega + 2 * math.pi * low_cut_hz)
        response *= -(omega**2) * np.exp(-1j * omega * delay_s)
        x += amplitude * np.sin(omega * t)
        a += amplitude * np.imag(response * np.exp(1j * omega * t))
    return x, a


def compare_cycles(x: Float1D, a: Float1D) -> tuple[PairErrorEstimate, WeakFormPair]:
    """Return the estimate over the last twelve cycles, and the last comparison."""
    samples = round(RATE_HZ / CYCLE_HZ)
    estimate = PairErrorEstimate()
    for start in range(x.size - 12 * samples, x.size - samples + 1, samples):
        low_cut = estimate.errors.low_cut
        filtered = highpass(x, low_cut, RATE_HZ)
        span = slice(start, start + samples)
        window = make_window(samples, 1.0, 0.5, RATE_HZ)
        pair = compare_motion(window, x[span], a[span], (0.0, 0.0), (filtered[span], low_cut))
        estimate = estimate.update(pair.normal_equations(), 2 * math.pi * CYCLE_HZ)
    return estimate, pair


@pytest.mark.parametrize(
    ("gain", "low_cut_hz", "delay_s"),
    [(1.0, 0.0, 0.0), (1.0, 0.16, 0.0), (0.9, 0.16, 0.0), (1.0, 0.5, 0.0), (1.0, 0.16, 0.002)],
)
def test_errors_of_sound_sensors_are_measured(
    gain: float, low_cut_hz: float, delay_s: float
) -> None:
    estimate, pair = compare_cycles(*record_motion(gain, low_cut_hz, delay_s))
    errors = estimate.errors
    assert errors.gain == pytest.approx(gain, abs=0.01)
    assert errors.low_cut / (2 * math.pi) == pytest.approx(low_cut_hz, abs=0.02)
    assert errors.delay_s == pytest.approx(delay_s, abs=2.5e-3)
    clean = pair.remove_errors(errors)
    assert clean.mismatch < 0.015 * clean.size


def test_low_cut_of_half_the_frequency_is_known_once_its_estimate_has_settled() -> None:
    """Equations made with the first, wrong low cuts do not linger in the estimate."""
    hz, low_cut_hz = 0.5, 0.25
    t = np.arange(round(40 * RATE_HZ)) / RATE_HZ
    omega, low_cut = 2 * math.pi * hz, 2 * math.pi * low_cut_hz
    response = -(omega**2) * 1j * omega / (1j * omega + low_cut)
    x, a = 0.03 * np.sin(omega * t), 0.03 * np.imag(response * np.exp(1j * omega * t))
    estimate, samples, checks = PairErrorEstimate(), round(RATE_HZ / hz), 0
    window = make_window(samples, 1.0, 0.5, RATE_HZ)
    while estimate.check_count < MIN_BASELINE_CHECKS:
        checks += 1
        span = slice(checks * samples, (checks + 1) * samples)
        filtered = highpass(x[: span.stop], estimate.errors.low_cut, RATE_HZ)[span.start :]
        known = (filtered, estimate.errors.low_cut)
        pair = compare_motion(window, x[span], a[span], (0.0, 0.0), known)
        estimate = estimate.update(pair.normal_equations(), omega)
    assert checks <= 3 * MIN_BASELINE_CHECKS
    assert estimate.errors.gain == pytest.approx(1.0, abs=0.02)
    assert estimate.errors.low_cut == pytest.approx(low_cut, rel=0.03)


@pytest.mark.parametrize("gain", [-1.0, 0.8, 1.25])
def test_no_low_cut_or_delay_explains_a_wrong_gain(gain: float) -> None:
    _, pair = compare_cycles(*record_motion(gain, 0.0, 0.0))
    left = pair.remove_errors(pair.fit_phase_errors())
    assert left.mismatch > 0.15 * left.size


def test_low_cut_beyond_that_of_sound_sensors_is_left() -> None:
    _, pair = compare_cycles(*record_motion(1.0, 4.0, 0.0))
    errors = pair.fit_phase_errors()
    assert errors.low_cut <= MAX_LOW_CUT_RAD_S
    left = pair.remove_errors(errors)
    assert left.mismatch > 0.3 * left.size


def test_division_into_calls_changes_no_bit() -> None:
    x, _ = record_motion(1.0, 0.0, 0.0)
    x[700:703] = np.nan
    whole = highpass(x, 1.0, RATE_HZ)
    first = highpass(x[:1234], 1.0, RATE_HZ)
    second = highpass(x[1234:], 1.0, RATE_HZ, (float(x[1233]), float(first[-1])))
    assert np.isfinite(whole).all()
    assert np.array_equal(whole, np.concatenate([first, second]))


@pytest.mark.parametrize("b1", [0.0, 0.3])
def test_filter_is_that_of_scipy_to_the_bit(b1: float) -> None:
    x = np.random.default_rng(1).standard_normal(500)
    y, state = filter_first_order(x, (0.3, b1), 0.98, 0.7)
    expected, expected_state = signal.lfilter([0.3, b1], [1.0, -0.98], x, zi=[0.7])
    np.testing.assert_array_equal(y, expected)
    assert state == expected_state[0]
