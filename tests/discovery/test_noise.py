"""Noise density of a channel, with its colour, beneath a motion that is much larger."""

import numpy as np
import pytest
from scipy.signal import butter, lfilter

from table_io.block import Bool2D, Float1D
from twin.discovery.noise import (
    compare_with_white,
    estimate_noise_density,
    find_shown_roll_off,
    measure_rest_noise,
)

SAMPLES, REST_SAMPLES = 60_000, 2_000
WHITE_RMS = 0.02
FREQUENCY = np.array([0.001, 0.05, 0.15, 0.2, 0.4])  # cycles per sample


def _rest() -> Bool2D:
    return np.arange(SAMPLES) < REST_SAMPLES


def _motion() -> Float1D:
    """Return a swept sine of rms about 1 below 0.01 cycles per sample, still at first."""
    n = np.arange(SAMPLES - REST_SAMPLES)
    sweep = np.sin(2.0 * np.pi * (0.002 * n + 0.004 * n**2 / n.size))
    return np.concatenate([np.zeros(REST_SAMPLES), np.sqrt(2.0) * sweep])


def _white(seed: int = 1) -> Float1D:
    return WHITE_RMS * np.random.default_rng(seed).standard_normal(SAMPLES)


def _pink(corner: float) -> Float1D:
    """Return noise with the power density of the white one times corner / frequency."""
    frequency = np.fft.rfftfreq(SAMPLES)
    gain = np.sqrt(corner / np.maximum(frequency, frequency[1]))
    return np.fft.irfft(np.fft.rfft(_white(2)) * gain, SAMPLES)


def test_white_noise_is_white_beneath_the_motion() -> None:
    density = estimate_noise_density(_motion() + _white(), _rest(), FREQUENCY)
    assert density == pytest.approx(np.full(FREQUENCY.size, WHITE_RMS), rel=0.1)


def test_noise_ends_where_an_anti_alias_filter_does() -> None:
    filtered = lfilter(*butter(4, 2 * 0.2), _white())
    density = estimate_noise_density(_motion() + filtered, _rest(), FREQUENCY)
    assert density[:3] == pytest.approx(np.full(3, WHITE_RMS), rel=0.15)
    assert density[3] == pytest.approx(WHITE_RMS * np.sqrt(0.5), rel=0.3)
    assert density[4] < 0.1 * WHITE_RMS


def test_noise_at_rest_shows_its_colour() -> None:
    values = _motion() + _white() + _pink(corner=0.01)
    density = estimate_noise_density(values, _rest(), FREQUENCY)
    assert density[0] == pytest.approx(WHITE_RMS * np.sqrt(1.0 + 0.01 / 0.001), rel=0.4)
    assert density[2:] == pytest.approx(np.full(3, WHITE_RMS), rel=0.1)


def test_a_coarse_converter_has_the_noise_of_its_step() -> None:
    step = 0.1
    values = step * np.rint(_motion() / step)
    density = estimate_noise_density(values, _rest(), FREQUENCY)
    assert density.min() > 0.99 * step / np.sqrt(12.0)


def test_only_a_louder_series_differs_from_white_noise() -> None:
    white = _white() / WHITE_RMS
    assert compare_with_white(white, np.ones(1000)) == pytest.approx(np.ones(1000), abs=0.25)
    ratio = compare_with_white(white + _pink(corner=0.01) / WHITE_RMS, np.ones(1000))
    assert ratio[2] == pytest.approx(1.0 + 0.01 / 0.001, rel=0.5)  # at 0.001 cycles per sample
    assert ratio[500] == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("corner_hz", [0.0, 60.0])
def test_the_rest_shows_level_hum_and_slow_noise(corner_hz: float) -> None:
    hum = 6.0 * WHITE_RMS * np.sqrt(2.0) * np.sin(2 * np.pi * 0.05003 * np.arange(SAMPLES))
    noise = measure_rest_noise(
        _motion() + _white() + _pink(corner_hz / 1e3) + hum, _rest(), rate_hz=1e3
    )
    assert noise is not None
    assert noise.rms == pytest.approx(WHITE_RMS, rel=0.4)  # slow noise is loud up to the corner
    assert noise.hum_rms == pytest.approx(6.0 * WHITE_RMS, rel=0.1)
    assert corner_hz / 4.0 <= noise.corner_hz <= 2.0 * corner_hz  # few lines tell, within 2 s
    assert np.isinf(noise.filter_hz)


@pytest.mark.parametrize("corner", [0.09, 0.2])
def test_the_rest_shows_an_anti_alias_filter(corner: float) -> None:
    b, a = butter(4, 2.0 * corner)
    noise = measure_rest_noise(lfilter(b, a, _motion() + _white()), _rest(), rate_hz=1e3)
    assert noise is not None
    assert noise.filter_hz == pytest.approx(1e3 * corner, rel=0.1)
    assert noise.corner_hz == 0.0


@pytest.mark.parametrize("noise", [1e-5, 1e-4, 1e-2])
def test_the_end_of_a_motion_is_no_anti_alias_filter(noise: float) -> None:
    rng, rate_hz, size = np.random.default_rng(0), 200.0, 12_000
    hz = np.fft.rfftfreq(size, 1.0 / rate_hz)
    parts = rng.standard_normal((2, hz.size))
    spectrum = np.where((hz > 0.3) & (hz < 18.0), parts[0] + 1j * parts[1], 0.0)
    acc = np.fft.irfft(spectrum, size)
    disp = np.fft.irfft(spectrum / np.maximum(hz, hz[1]) ** 2, size)
    for motion in (acc, disp):
        read = motion + noise * motion.std() * rng.standard_normal(size)
        assert np.isinf(find_shown_roll_off(read, rate_hz))
