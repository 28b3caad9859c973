"""Floquet multiplier from releases: known growth demanded back, with its uncertainty."""

import math

import numpy as np
import pytest

from table_io.adaptive.floquet_multiplier import Departure, estimate_multiplier
from table_io.block import Float1D

RATE_HZ, FREQUENCY_HZ, NOISE_M = 2000.0, 3.4, 5e-6
PERIODS = {5.9: 2.2, 3.1: 3.0, 1.65: 4.0, 1.17: 4.0, 0.6: 4.0}  # of a release, by multiplier


def make_departures(
    multiplier: float, seed: int, releases: int = 4, noise_m: float = NOISE_M
) -> list[Departure]:
    """Releases to either side in turn, from 8 um on, about an orbit 3 um off the reference."""
    noise, departures = np.random.default_rng(seed), []
    for k in range(releases):
        count = round(PERIODS[multiplier] * RATE_HZ / FREQUENCY_HZ)
        t = np.arange(count, dtype=np.float64) * (FREQUENCY_HZ / RATE_HZ)
        cycles: Float1D = t + noise.uniform()
        phase = 2 * math.pi * cycles
        shape = np.cos(phase + 1.0) + 0.3 * np.cos(2 * phase) + 0.1 * np.sin(3 * phase)
        values = 3e-6 * np.cos(phase) + (-1) ** k * 8e-6 * multiplier**t * shape
        values += noise_m * noise.standard_normal(t.size)
        departures.append(Departure(cycles, values))
    return departures


@pytest.mark.parametrize("multiplier", PERIODS)
def test_growth_is_recovered_within_its_uncertainty(multiplier: float) -> None:
    estimates = [estimate_multiplier(make_departures(multiplier, seed)) for seed in range(20)]
    errors = np.array([(e.value - multiplier) / e.sd for e in estimates])
    assert np.sqrt(np.mean(errors**2)) < 1.4  # 20 estimates of sd 1: 99.9 %
    assert np.abs(errors).max() < 4.0
    assert all(0.0 < e.sd < 0.08 * multiplier for e in estimates)


@pytest.mark.parametrize("multiplier", PERIODS)
def test_without_noise_the_multiplier_is_exact(multiplier: float) -> None:
    estimate = estimate_multiplier(make_departures(multiplier, 0, noise_m=0.0))
    # A bin holds a whole number of samples, so its mean phase is off its middle by a part of one.
    assert estimate.value == pytest.approx(multiplier, rel=1e-3)


def test_release_that_is_too_short_or_has_lost_samples_is_left_out() -> None:
    departures = make_departures(3.1, 1, releases=3)
    expected = estimate_multiplier(departures)
    short = Departure(departures[0].phase[:600], departures[0].values_m[:600])
    lost = Departure(departures[1].phase, np.where(departures[1].phase > 2.0, math.nan, 0.0))
    empty = Departure(np.empty(0), np.empty(0))
    assert estimate_multiplier([short, *departures, lost, empty]) == expected
    assert math.isfinite(expected.value)


@pytest.mark.parametrize("releases", [0, 1])
def test_too_few_releases_give_no_multiplier(releases: int) -> None:
    estimate = estimate_multiplier(make_departures(3.1, 1, releases))
    assert math.isnan(estimate.value)
    assert math.isnan(estimate.sd)
