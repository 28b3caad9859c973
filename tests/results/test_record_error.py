"""Error of a table against its record before the filter, and the peaks that are listed."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from twin.results.excitation_verdict import describe_peaks
from twin.results.tracking import align_record, find_record_error

RATE_HZ, BAND_HZ = 1000.0, (0.5, 20.0)


def make_record(seed: int) -> np.ndarray:
    t = np.arange(12_000) / RATE_HZ
    rng = np.random.default_rng(seed)
    waves = sum(
        rng.normal() * np.sin(2 * np.pi * f * t + rng.uniform(0, 7))
        for f in rng.uniform(0.6, 18.0, 30)
    )
    return np.asarray(waves * np.sin(np.pi * t / t[-1]) ** 2)


def remove_band(values: np.ndarray, low_hz: float, high_hz: float) -> np.ndarray:
    spectrum = np.fft.rfft(values)
    hz = np.fft.rfftfreq(values.size, 1 / RATE_HZ)
    return np.fft.irfft(np.where((hz > low_hz) & (hz < high_hz), 0.0, spectrum), values.size)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("before, after", [(1500, 700), (200, 0)])
def test_error_against_the_record_is_what_its_filter_has_taken(
    seed: int, before: int, after: int
) -> None:
    record = make_record(seed)
    filtered = remove_band(record, 12.0, 20.0)
    target = np.pad(filtered, (before, after))
    np.testing.assert_array_equal(align_record(record, target)[before : before + 12_000], record)
    taken = np.sqrt(np.mean((record - filtered) ** 2) / np.mean(record**2))
    error = find_record_error(record, target, target, RATE_HZ, BAND_HZ)
    assert error == pytest.approx(taken, rel=0.03)
    assert find_record_error(record, target, np.pad(record, (before, after)), RATE_HZ, BAND_HZ) == (
        pytest.approx(0.0, abs=1e-9)
    )


def test_lag_of_the_table_is_taken_out_of_the_error() -> None:
    record = make_record(7)
    target = np.pad(record, 1000)
    late = np.roll(target, 15)
    assert find_record_error(record, target, late, RATE_HZ, BAND_HZ) > 0.2
    error = find_record_error(record, target, late, RATE_HZ, BAND_HZ, 15 / RATE_HZ)
    assert error == pytest.approx(0.0, abs=1e-6)


def make_step(frequency_hz: float, excess: float, thd: float) -> Any:
    return SimpleNamespace(
        frequency_hz=frequency_hz,
        direction="forward",
        table_acc_fundamental_m_s2=0.49,
        table_acc_peak_m_s2=0.49 * (1.0 + excess),
        thd=thd,
    )


def test_peak_that_harmonics_raise_is_stated_with_the_worst_step_and_what_cancels_them() -> None:
    steps = [make_step(3.9, 0.12, 0.07), make_step(4.0, 0.15, 0.08), make_step(5.0, 0.02, 0.04)]
    (sentence,) = describe_peaks(steps)
    assert "at 2 of 3" in sentence
    assert "+15 % at 4 Hz" in sentence
    assert "control.harmonics" in sentence


@pytest.mark.parametrize("excess, thd", [(0.04, 0.08), (0.2, 0.01)])
def test_small_peaks_and_those_of_noise_are_not(excess: float, thd: float) -> None:
    assert describe_peaks([make_step(4.0, excess, thd)]) == []
