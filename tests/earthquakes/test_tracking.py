"""Tracking error: what is put into a motion is found again, and nothing lost is invented."""

import math

import numpy as np
import pytest

from table_io.block import Float1D
from twin.results.contracts import TrackingError
from twin.results.spectra import compute_response_spectrum, list_octave_frequencies
from twin.results.tracking import (
    compare_spectra,
    delay_record,
    find_band,
    find_lag,
    judge_tracking,
    keep_band,
)

RATE_HZ = 1000.0
BAND_HZ = (0.5, 16.0)


def make_target(seconds: float = 20.0, low_hz: float = 1.0, high_hz: float = 8.0) -> Float1D:
    """Noise of one band under an envelope with 2 s of rest before and after, m/s2."""
    noise = np.random.default_rng(5).standard_normal(round((seconds - 4) * RATE_HZ))
    noise = keep_band(noise, RATE_HZ, (low_hz, high_hz))
    noise *= np.sin(np.linspace(0.0, np.pi, noise.size)) ** 2 / np.abs(noise).max()
    rest = np.zeros(round(2 * RATE_HZ))
    return np.concatenate([rest, 3.0 * noise, rest])


TARGET = make_target()


def test_a_perfect_table_has_no_error() -> None:
    result = judge_tracking(TARGET, TARGET.copy(), RATE_HZ, BAND_HZ)
    assert result.lag_s == pytest.approx(0.0, abs=1e-9)
    assert result.acc_rms_error_band == pytest.approx(0.0, abs=1e-6)
    assert result.acc_rms_error_full == pytest.approx(0.0, abs=1e-6)
    assert result.pga_ratio_band == pytest.approx(1.0)
    assert result.pga_ratio_full == pytest.approx(1.0)
    assert (result.sa_share, result.sa_count, result.sa_worst_ratio) == (1.0, 31, 1.0)
    assert (result.arias_ratio, result.cav_ratio, result.lost_samples) == (1.0, 1.0, 0)
    assert math.isnan(result.disp_rms_error_full)


@pytest.mark.parametrize("lag_s", [0.02134, -0.0047, 0.0, 0.2501])
def test_a_lag_is_found_and_costs_nothing(lag_s: float) -> None:
    result = judge_tracking(TARGET, delay_record(TARGET, lag_s, RATE_HZ), RATE_HZ, BAND_HZ)
    assert result.lag_s == pytest.approx(lag_s, abs=1e-7)
    assert result.acc_rms_error_full < 1e-5
    assert result.sa_share == 1.0


def test_a_delayed_record_is_late_by_whole_and_by_parts_of_samples() -> None:
    assert delay_record(TARGET, 0.007, RATE_HZ)[7:] == pytest.approx(TARGET[:-7], abs=1e-9)
    sine = TARGET * 0.0
    t = np.arange(sine.size) / RATE_HZ
    pulse = np.exp(-(((t - 8.0) / 0.1) ** 2))
    later = np.exp(-(((t - 8.0004) / 0.1) ** 2))
    assert delay_record(pulse, 4e-4, RATE_HZ) == pytest.approx(later, abs=1e-9)


def test_a_lag_is_found_under_noise_and_a_wrong_gain() -> None:
    noise = np.random.default_rng(2).standard_normal(TARGET.size)
    achieved = 0.8 * delay_record(TARGET, 0.0312, RATE_HZ) + 0.1 * noise
    assert find_lag(TARGET, achieved, RATE_HZ, BAND_HZ) == pytest.approx(0.0312, abs=2e-4)


@pytest.mark.parametrize(("gain", "share"), [(1.08, 1.0), (0.92, 1.0), (1.15, 0.0), (0.85, 0.0)])
def test_a_gain_is_the_error_and_every_ratio(gain: float, share: float) -> None:
    displacement = np.cumsum(np.cumsum(TARGET - TARGET.mean()))
    result = judge_tracking(
        TARGET, gain * TARGET, RATE_HZ, BAND_HZ,
        target_disp=displacement, achieved_disp=gain * displacement,
    )  # fmt: skip
    for error in (
        result.acc_rms_error_band, result.acc_rms_error_full,
        result.disp_rms_error_band, result.disp_rms_error_full,
    ):  # fmt: skip
        assert error == pytest.approx(abs(gain - 1.0), abs=1e-6)
    for ratio in (result.pga_ratio_band, result.pga_ratio_full, result.sa_worst_ratio):
        assert ratio == pytest.approx(gain)
    assert result.cav_ratio == pytest.approx(gain)
    assert result.arias_ratio == pytest.approx(gain**2)
    assert result.sa_share == share


def test_ringing_outside_the_band_is_in_full_alone() -> None:
    """What friction does to the oil column is not hidden by the band."""
    t = np.arange(TARGET.size) / RATE_HZ
    envelope = np.abs(TARGET).max() * np.sin(np.linspace(0, np.pi, t.size)) ** 2
    ringing = 0.3 * envelope * np.sin(2 * np.pi * 27.0 * t)
    result = judge_tracking(TARGET, TARGET + ringing, RATE_HZ, BAND_HZ)
    rms = np.sqrt(np.mean(ringing**2) / np.mean(TARGET**2))
    assert result.acc_rms_error_full == pytest.approx(rms, rel=1e-3)
    assert result.acc_rms_error_band < 1e-3 * rms
    assert result.pga_ratio_band == pytest.approx(1.0, abs=1e-3)
    assert result.pga_ratio_full > 1.1


def test_an_error_of_one_frequency_is_the_worst_ordinate() -> None:
    """A notch at 4 Hz of the table: the spectrum shows where."""
    notch = TARGET - 0.5 * keep_band(TARGET, RATE_HZ, (3.6, 4.4))
    result = judge_tracking(TARGET, notch, RATE_HZ, BAND_HZ)
    assert 3.5 < result.sa_worst_hz < 4.6
    assert result.sa_worst_ratio < 0.85
    hz, ratios = compare_spectra(TARGET, notch, RATE_HZ, BAND_HZ)
    assert result.sa_share == pytest.approx(np.mean(np.abs(ratios - 1) <= 0.1))
    assert 0.0 < result.sa_share < 1.0
    assert hz.size == result.sa_count
    spectra = [compute_response_spectrum(record, RATE_HZ, hz) for record in (TARGET, notch)]
    assert ratios == pytest.approx(spectra[1] / spectra[0])
    assert hz == pytest.approx(list_octave_frequencies(*BAND_HZ, 6))


def test_rest_before_and_after_changes_nothing() -> None:
    achieved = 0.9 * delay_record(TARGET, 0.0123, RATE_HZ)
    rest = np.zeros(2345)
    padded = [np.concatenate([rest, record, rest]) for record in (TARGET, achieved)]
    first = judge_tracking(TARGET, achieved, RATE_HZ, BAND_HZ)
    second = judge_tracking(padded[0], padded[1], RATE_HZ, BAND_HZ)
    for name, value in dict(first).items():
        if isinstance(value, float) and math.isfinite(value):
            assert getattr(second, name) == pytest.approx(value, rel=1e-3, abs=1e-6), name


def test_lost_samples_are_left_out_and_what_needs_them_is_not_given() -> None:
    achieved = 0.9 * delay_record(TARGET, 0.0123, RATE_HZ)
    achieved[9000:9040] = np.nan
    result = judge_tracking(TARGET, achieved, RATE_HZ, BAND_HZ)
    assert result.lost_samples == 40
    assert result.lag_s == pytest.approx(0.0123, abs=1e-5)
    assert result.acc_rms_error_full == pytest.approx(0.1, rel=1e-3)
    assert result.pga_ratio_full == pytest.approx(0.9, rel=1e-3)
    missing = (
        "acc_rms_error_band", "pga_ratio_band", "sa_share", "sa_worst_ratio", "arias_ratio",
        "cav_ratio",
    )  # fmt: skip
    assert all(math.isnan(getattr(result, name)) for name in missing)
    assert result.sa_count == 0


def test_a_target_at_rest_where_it_was_measured_has_no_ratio() -> None:
    achieved = np.where(np.arange(TARGET.size) < 1500, 1e-3, np.nan)
    result = judge_tracking(TARGET, achieved, RATE_HZ, BAND_HZ)
    assert result.lost_samples == TARGET.size - 1500
    assert not result.acc_rms_error_full <= 1.0


def test_the_band_of_a_target_is_an_octave_wider_than_its_energy() -> None:
    low_hz, high_hz = find_band(TARGET, RATE_HZ)
    energy = np.cumsum(np.abs(np.fft.rfft(TARGET)) ** 2)
    hz = np.arange(energy.size) * RATE_HZ / TARGET.size
    inside = np.interp([2 * low_hz, high_hz / 2], hz, energy / energy[-1])
    assert inside == pytest.approx([0.05, 0.95], abs=0.01)
    assert judge_tracking(TARGET, TARGET, RATE_HZ).band_hz == (low_hz, high_hz)
    assert find_band(make_target(20, 100, 400), RATE_HZ)[1] == 0.1 * RATE_HZ


@pytest.mark.parametrize(
    ("target", "achieved", "band_hz", "message"),
    [
        (TARGET, TARGET[:-1], BAND_HZ, "no pair"),
        (TARGET * math.nan, TARGET, BAND_HZ, "target are missing"),
        (0 * TARGET, TARGET, BAND_HZ, "at rest"),
        (TARGET, TARGET * math.nan, BAND_HZ, "nothing was measured"),
        (TARGET, TARGET, (2.0, 1.0), "a band of 2 to 1 Hz"),
        (TARGET, TARGET, (1.0, 501.0), "500 Hz"),
    ],
)
def test_what_cannot_be_judged_is_refused(
    target: Float1D, achieved: Float1D, band_hz: tuple[float, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        judge_tracking(target, achieved, RATE_HZ, band_hz)


def test_every_number_is_there() -> None:
    result = judge_tracking(
        TARGET, TARGET, RATE_HZ, BAND_HZ, target_disp=TARGET, achieved_disp=TARGET
    )
    assert isinstance(result, TrackingError)
    assert all(np.isfinite(value).all() for value in dict(result).values())
