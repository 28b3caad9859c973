"""Mains hum is removed; a harmonic of the drive at the frequency of the mains is not."""

import numpy as np
import pytest

from table_io.block import Bool2D, Float1D
from twin.compare.hum import remove_hum
from twin.compare.spectra import FrequencyGrid

RATE_HZ, DURATION_S, REST_S = 1000.0, 60.0, 4.0
TIME_S: Float1D = np.arange(int(RATE_HZ * DURATION_S)) / RATE_HZ
MOVING = TIME_S >= REST_S
IN_STEP = (TIME_S >= 30.0) & (TIME_S < 38.0)
UNKNOWN_HZ = np.full(TIME_S.size, np.nan)
INSIDE = (TIME_S > 2.0) & (TIME_S < DURATION_S - 2.0)


def make_hum(frequency_hz: float, rms: float) -> Float1D:
    """Return hum whose frequency wanders by 5 mHz, as that of a public grid does."""
    turns = frequency_hz * TIME_S + 0.05 * np.sin(2 * np.pi * TIME_S / 60.0)
    hum: Float1D = rms * np.sqrt(2.0) * np.sin(2 * np.pi * turns + 0.7)
    return hum


def make_harmonic() -> Float1D:
    """Return the fifteenth harmonic of a step at 4 Hz."""
    return np.where(IN_STEP, 5.0 * np.sin(2 * np.pi * 60.0 * TIME_S), 0.0)


def clean(
    *records: Float1D, has_rest: bool = True, drive_hz: Float1D = UNKNOWN_HZ
) -> list[Float1D]:
    """Return the records, (sample,) at half the rate, without hum."""
    grid = FrequencyGrid(TIME_S.size, RATE_HZ)
    spectra = {str(k): grid.to_spectrum(values) for k, values in enumerate(records)}
    cleaned, _ = remove_hum(spectra, grid, ~MOVING & has_rest, drive_hz)
    return [grid.to_time_domain(spectrum) for spectrum in cleaned.values()]


def rms_of(values: Float1D, where: Bool2D) -> float:
    """Return the rms of values at half the rate where a mask at the full rate is True."""
    return float(np.sqrt(np.mean(values[where[::2]] ** 2)))


@pytest.fixture
def motion() -> Float1D:
    """Response to a drive at 3.1 Hz with harmonics, and noise of rms 0.1."""
    noise = 0.1 * np.random.default_rng(5).standard_normal(TIME_S.size)
    order = np.arange(1, 60)
    harmonics = np.sin(2 * np.pi * 3.1 * np.outer(TIME_S, order)) @ (10.0 / order**2)
    motion: Float1D = noise + MOVING * harmonics
    return motion


@pytest.mark.parametrize("has_rest", [True, False])
@pytest.mark.parametrize("mains", [50.04, 59.95])
def test_hum_is_removed_from_every_channel_that_has_it(
    motion: Float1D, mains: float, has_rest: bool
) -> None:
    hum = make_hum(mains, 1.0) + make_hum(3 * mains, 0.3)
    clean_motion = clean(motion, motion)[0]
    with_hum, without = clean(motion + hum, motion, has_rest=has_rest)
    assert rms_of(with_hum - clean_motion, INSIDE) < 0.05 * rms_of(hum[::2], INSIDE)
    assert rms_of(without - clean_motion, INSIDE) < 0.01 * rms_of(hum[::2], INSIDE)


def test_a_harmonic_of_the_drive_at_the_mains_frequency_stays(motion: Float1D) -> None:
    harmonic = make_harmonic()
    expected = clean(motion)[0] + clean(harmonic)[0]
    assert rms_of(clean(motion + harmonic)[0] - expected, INSIDE) < 1e-6


def test_hum_is_interpolated_over_a_step_with_a_harmonic_at_its_frequency(
    motion: Float1D,
) -> None:
    harmonic, hum = make_harmonic(), make_hum(60.0, 0.3)
    expected = clean(motion)[0] + clean(harmonic)[0]
    departure = clean(motion + harmonic + hum)[0] - expected
    assert rms_of(departure, INSIDE) < 0.3 * rms_of(hum[::2], INSIDE)
    assert rms_of(departure, IN_STEP) < 0.5 * rms_of(hum[::2], INSIDE)


def test_a_harmonic_that_is_weaker_than_the_hum_stays_too(motion: Float1D) -> None:
    """Its amplitude says nothing: that the drive has a harmonic there does."""
    harmonic, hum = 0.2 * make_harmonic(), make_hum(60.0, 1.0)
    expected = clean(motion)[0] + clean(harmonic)[0]
    drive_hz = np.where(IN_STEP, 4.0, np.nan)
    departure = clean(motion + harmonic + hum, drive_hz=drive_hz)[0] - expected
    assert rms_of(departure, IN_STEP) < 0.2 * rms_of(harmonic[::2], IN_STEP)
    assert rms_of(departure, INSIDE) < 0.15 * rms_of(hum[::2], INSIDE)


def test_noise_alone_has_no_hum() -> None:
    for seed in range(20):
        noise = np.random.default_rng(seed).standard_normal(TIME_S.size)
        grid = FrequencyGrid(TIME_S.size, RATE_HZ)
        spectra = {"0": grid.to_spectrum(noise)}
        assert remove_hum(spectra, grid, ~MOVING, UNKNOWN_HZ)[0]["0"] is spectra["0"]
        assert remove_hum(spectra, grid, MOVING & ~MOVING, UNKNOWN_HZ)[0]["0"] is spectra["0"]
