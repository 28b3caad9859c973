"""Baseline, band and integration of a recorded acceleration against closed forms and scipy."""

from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from table_io.block import Float1D
from table_io.config.base import PROFILES_DIR
from table_io.config.excitation.record import RecordedHistory
from table_io.config.excitation.waveform import correct_baseline, cut_rest, limit_band
from table_io.config.profile import Profile, load_profile
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import RECORD_TOML
from tests.input_errors import raises_input_error

RATE_HZ = 200.0
DURATION_S = 20.0
TIME_S = np.arange(round(DURATION_S * RATE_HZ)) / RATE_HZ
W = 2 * np.pi * 1.5


def displacement(t: Float1D) -> Float1D:
    """8 mm at 1.5 Hz in a sin^4 envelope of 20 s."""
    inside = (t > 0) & (t < DURATION_S)
    return np.where(inside, 8e-3 * np.sin(np.pi * t / DURATION_S) ** 4 * np.sin(W * t), 0.0)


def acceleration(t: Float1D) -> Float1D:
    """Its second derivative in closed form."""
    p = np.pi / DURATION_S
    s, c = np.sin(p * t), np.cos(p * t)
    envelope, slope = s**4, 4 * p * s**3 * c
    curvature = 12 * p**2 * s**2 * c**2 - 4 * p**2 * s**4
    return 8e-3 * (
        curvature * np.sin(W * t) + 2 * slope * W * np.cos(W * t) - envelope * W**2 * np.sin(W * t)
    )


def test_displacement_of_a_known_acceleration_comes_back() -> None:
    drift = 0.3 + 0.05 * TIME_S  # m/s2, which would drift by 100 m
    corrected = correct_baseline(acceleration(TIME_S) + drift, "linear")
    motion = limit_band(corrected, RATE_HZ, (0.1, 50.0), integrate=True)
    pad = round(6.0 / 0.1 * RATE_HZ)
    assert motion.size == TIME_S.size + 2 * pad
    played = motion[pad : pad + TIME_S.size]
    assert np.abs(played - displacement(TIME_S)).max() < 1e-3 * 8e-3
    assert np.abs(motion[:20]).max() < 1e-5 * 8e-3


def test_filter_is_a_butterworth_of_order_4_forward_and_backward() -> None:
    values = np.random.default_rng(3).standard_normal(8000)
    values *= np.sin(np.pi * np.arange(8000) / 8000) ** 2
    pad = round(6.0 / 0.5 * RATE_HZ)
    played = limit_band(values, RATE_HZ, (0.5, 15.0), integrate=False)[pad:-pad]
    padded = np.concatenate([np.zeros(4000), values, np.zeros(4000)])
    high = signal.butter(4, 0.5, "highpass", fs=RATE_HZ, output="sos")
    low = signal.butter(4, 15.0, "lowpass", fs=RATE_HZ, output="sos")
    expected = signal.sosfiltfilt(low, signal.sosfiltfilt(high, padded))[4000:-4000]
    # The bilinear transform of scipy shifts its upper corner by a hundredth.
    assert np.abs(played - expected).max() < 0.02 * np.abs(expected).max()


@pytest.mark.parametrize(("f_hz", "gain"), [(0.5, 0.5), (2.0, 1.0), (10.0, 0.5), (20.0, 1 / 257)])
def test_gain_is_half_at_the_corners(f_hz: float, gain: float) -> None:
    t = np.arange(round(200 * RATE_HZ)) / RATE_HZ
    pad = round(6.0 / 0.5 * RATE_HZ)
    played = limit_band(np.sin(2 * np.pi * f_hz * t), RATE_HZ, (0.5, 10.0), integrate=False)
    middle = slice(round(80 * RATE_HZ), round(120 * RATE_HZ))
    expected = gain * np.sin(2 * np.pi * f_hz * t)
    assert np.abs(played[pad:-pad][middle] - expected[middle]).max() < 1e-3


@pytest.mark.parametrize("baseline", ["none", "mean", "linear"])
def test_baseline_is_removed_as_far_as_asked(baseline: str) -> None:
    line = 2.0 + 0.1 * TIME_S
    corrected = correct_baseline(line, baseline)  # type: ignore[arg-type]
    expected = {"none": line, "mean": line - line.mean(), "linear": 0.0 * line}[baseline]
    assert np.abs(corrected - expected).max() < 1e-12


def test_rest_is_cut_and_ramped() -> None:
    motion = np.concatenate([np.full(500, 1e-4), np.ones(100), np.full(300, -1e-4)])
    kept = cut_rest(motion, 50)
    assert kept.size == 200
    assert kept[0] == kept[-1] == 0.0
    assert kept[25] == pytest.approx(0.5e-4)
    assert (kept[50:150] == 1.0).all()


def load(folder: Path, more: str = "") -> tuple[Profile, RecordedHistory]:
    rows = zip(TIME_S.tolist(), acceleration(TIME_S).tolist(), strict=True)
    text = "time_s,acc_m_s2\n" + "".join(f"{t:.3f},{a:.9f}\n" for t, a in rows)
    (folder / "motion.csv").write_text(text)
    (folder / "test.toml").write_text(RECORD_TOML + more)
    profile, _ = load_profile(folder / "test.toml")
    assert isinstance(profile.excitation, RecordedHistory)
    return profile, profile.excitation


@pytest.mark.parametrize(
    ("keys", "displacement_ratio", "time_ratio"),
    [
        ("", 1.0, 1.0),
        ("scale = -0.5", -0.5, 1.0),
        ("length_ratio = 0.25", 0.25, 0.5),
        ("length_ratio = 0.25\nacceleration_ratio = 0.25", 0.25, 1.0),
        ("length_ratio = 0.5\nacceleration_ratio = 2.0\nscale = 0.5", 0.25, 0.5),
    ],
)
def test_table_moves_by_the_laws_of_similitude(
    keys: str, displacement_ratio: float, time_ratio: float, tmp_path: Path
) -> None:
    profile, _ = load(tmp_path, keys)
    played = profile.plan.history_m
    expected = displacement_ratio * displacement(np.arange(played.size) / 2000.0 / time_ratio)
    spectrum = np.fft.rfft(played) * np.conj(np.fft.rfft(expected))
    lag = int(np.argmax(np.fft.irfft(spectrum, played.size)))  # of the ramp before it
    error = np.abs(played - np.roll(expected, lag)).max()
    assert error < 6e-3 * np.abs(expected).max()
    assert np.abs(played).max() == pytest.approx(8e-3 * abs(displacement_ratio), rel=2e-3)
    peak = np.abs(np.diff(played, 2)).max() * 2000.0**2
    ratio = abs(displacement_ratio) / time_ratio**2
    assert peak == pytest.approx(ratio * np.abs(acceleration(TIME_S)).max(), rel=5e-3)
    assert played[0] == played[-1] == 0.0


def test_displacement_is_filtered_if_a_band_is_set(tmp_path: Path) -> None:
    rows = "".join(
        f"{t:.3f},{5 * np.sin(np.pi * t / 20) ** 2 * (np.sin(W * t) + np.sin(4 * np.pi * t * 6))}\n"
        for t in TIME_S.tolist()
    )
    (tmp_path / "motion.csv").write_text("time_s,disp_mm\n" + rows)
    (tmp_path / "test.toml").write_text(RECORD_TOML + "band_hz = [0.2, 5.0]\n")
    plan = load_profile(tmp_path / "test.toml")[0].plan
    assert np.abs(plan.history_m).max() == pytest.approx(5e-3, rel=0.02)  # 1.5 Hz alone


def test_el_centro_as_shipped_is_played_as_its_source_states() -> None:
    profile, _ = load_profile(PROFILES_DIR / "tests" / "el_centro.toml")
    record = profile.excitation
    assert isinstance(record, RecordedHistory)
    assert (record.scale, record.applied_band_hz) == (0.4, (0.2, 18.0))
    ground = record.series.values
    assert (ground.size, record.series.rate_hz) == (6000, pytest.approx(200.0))
    assert (np.abs(ground).max(), int(np.argmax(np.abs(ground)))) == (pytest.approx(3.07), 430)
    assert (
        "e5ebedced27b2498195dd564d85255a894e2c76cdf310cec087167abfd34d4bd"
        in record.files[record.file]
    )
    played = profile.plan.history_m
    acceleration = np.diff(played, 2)[::10] * 2000.0**2
    x = np.linspace(-1.0, 1.0, 6000)
    padded = np.pad(0.4 * (ground - np.polyval(np.polyfit(x, ground, 1), x)), 12000)
    for kind, corner_hz in (("highpass", 0.2), ("lowpass", 18.0)):
        filter_sections = signal.butter(4, corner_hz, kind, fs=RATE_HZ, output="sos")
        padded = signal.sosfiltfilt(filter_sections, padded)
    lag = int(np.argmax(np.correlate(padded, acceleration[1000:9000], "valid"))) - 1000
    expected = padded[lag : lag + acceleration.size]
    error = np.sqrt(np.mean((acceleration - expected) ** 2) / np.mean(expected**2))
    assert error < 0.03
    peaks = (
        np.abs(acceleration).max() / GRAVITY_M_S2,
        np.abs(np.diff(played)).max() * 2000.0,
        np.abs(played).max(),
    )
    assert peaks == pytest.approx((0.1233, 0.1223, 0.0292), rel=0.02)


@pytest.mark.parametrize(
    ("keys", "key", "fields"),
    [
        ("band_hz = [0.1, 90.0]", "excitation.file", {"allowed": "up to 80 Hz"}),
        ("band_hz = [0.01, 20.0]", "excitation.file", {"allowed": "from 0.05 Hz"}),
        ("band_hz = [5.0, 2.0]", "excitation.band_hz", {"allowed": "[lower, upper]"}),
        ("length_ratio = 0.0", "excitation.length_ratio", {}),
        ("length_ratio = 100.0\nband_hz = [0.1, 20.0]", "excitation.file", {"allowed": "8 Hz"}),
        ('quantity = "displacement"', "excitation.file", {"problem": "acceleration"}),
        ('baseline = "cubic"', "excitation.baseline", {"problem": "'linear'"}),
    ],
)
def test_processing_that_cannot_be_is_refused(
    keys: str, key: str, fields: dict[str, str], tmp_path: Path
) -> None:
    with raises_input_error(key=key, **fields):
        load(tmp_path, keys)


def test_short_record_is_filtered_from_one_cycle_in_its_duration(tmp_path: Path) -> None:
    _, record = load(tmp_path)
    assert record.applied_band_hz == (0.1, 25.0)
    _, record = load(tmp_path, "length_ratio = 0.0625")  # 5 s on the table
    assert record.applied_band_hz == (pytest.approx(0.2), 25.0)


def test_baseline_of_a_displacement_is_refused(tmp_path: Path) -> None:
    rows = "".join(f"{t:.3f},{np.sin(t)}\n" for t in TIME_S.tolist())
    (tmp_path / "motion.csv").write_text("time_s,disp_mm\n" + rows)
    (tmp_path / "test.toml").write_text(RECORD_TOML + 'baseline = "mean"\n')
    with raises_input_error(key="excitation.file", remedy="remove baseline"):
        load_profile(tmp_path / "test.toml")
