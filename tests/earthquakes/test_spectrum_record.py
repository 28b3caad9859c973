"""Records of a required spectrum: judged by an oscillator of this file, and by the rig."""

import math
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.config.profile import load_profile
from table_io.errors import InputError
from tests.command_line import call_main
from twin.earthquakes.spectrum_record import (
    RecordShape,
    SpectrumRecordOptions,
    compute_spectrum_records,
)

GRAVITY_M_S2 = 9.80665
SPECTRA = {
    "plateau": [(1.0, 0.1), (2.0, 0.3), (8.0, 0.3), (16.0, 0.15)],
    "low": [(1.0, 0.2), (3.0, 0.3), (6.0, 0.2), (16.0, 0.1)],
    "high": [(1.3, 0.06), (4.0, 0.2), (10.0, 0.35), (25.0, 0.25)],
}


def write_spectrum(folder: Path, points: list[tuple[float, float]]) -> Path:
    path = folder / "rrs.csv"
    rows = [f"{hz},{sa_g}" for hz, sa_g in points]
    path.write_text("\n".join(["frequency_hz,sa_g", *rows]) + "\n", encoding="utf-8")
    return path


def find_peak_response(acceleration: Float1D, rate_hz: float, hz: float, damping: float) -> float:
    """Return the peak absolute acceleration of an oscillator, by convolution with its impulse."""
    w = math.tau * hz
    wd = w * math.sqrt(1.0 - damping**2)
    t = np.arange(round(8.0 / (damping * w) * rate_hz)) / rate_hz
    impulse = np.exp(-damping * w * t) * np.sin(wd * t) / wd
    u = -np.convolve(acceleration, impulse)[: acceleration.size] / rate_hz
    v = np.gradient(u) * rate_hz
    return float(np.abs(2.0 * damping * w * v + w**2 * u).max())


@pytest.mark.parametrize("name", SPECTRA)
def test_target_of_the_test_meets_the_spectrum(name: str, tmp_path: Path) -> None:
    path = write_spectrum(tmp_path, SPECTRA[name])
    shape = RecordShape(duration_s=25.0, strong_s=15.0, seed=5)
    result = compute_spectrum_records(SpectrumRecordOptions(path, Path("el_centro"), shape))
    (profile_path,) = result.save(tmp_path)
    profile, _ = load_profile(profile_path)
    rate_hz = 2000.0
    target = np.diff(profile.plan.target_m, 2) * rate_hz**2
    known_hz, known_g = np.array(SPECTRA[name]).T
    for hz in (1.5, 2.3, 4.1, 6.7, 11.0, 15.0):
        required = GRAVITY_M_S2 * math.exp(
            np.interp(math.log(hz), np.log(known_hz), np.log(known_g))
        )
        ratio = find_peak_response(target, rate_hz, hz, 0.05) / required
        assert 0.95 < ratio < 1.25
    energy = np.cumsum(target**2)
    first, last = np.searchsorted(energy, [0.05 * energy[-1], 0.95 * energy[-1]]) / rate_hz
    assert 0.6 * 15.0 < last - first < 1.3 * 15.0


def test_several_records_are_not_correlated(tmp_path: Path) -> None:
    path = write_spectrum(tmp_path, SPECTRA["plateau"])
    shape = RecordShape(count=3)
    result = compute_spectrum_records(SpectrumRecordOptions(path, Path("el_centro"), shape))
    motions = [record.acceleration_m_s2 for record in result.records]
    corr = np.asarray(np.corrcoef(motions))[np.triu_indices(3, 1)]
    assert np.abs(corr).max() == pytest.approx(result.largest_correlation)
    assert result.largest_correlation < 0.15


def test_record_beyond_the_rig_states_the_largest_scale(tmp_path: Path) -> None:
    path = write_spectrum(tmp_path, [(hz, 6.0 * sa_g) for hz, sa_g in SPECTRA["plateau"]])
    out = tmp_path / "out"
    ended = call_main("record", path, "--like", "rehearsal", "--out", out)
    assert ended.returncode == 2
    assert "the largest that fits: scale = 0.9" in ended.stderr
    assert (out / "record_1.csv").is_file()


def test_record_ends_where_the_rig_does(tmp_path: Path) -> None:
    """A spectrum up to 45 Hz, whose record would reach half an octave further, for 50 Hz."""
    path = write_spectrum(tmp_path, [(5.0, 0.1), (12.0, 0.3), (25.0, 0.3), (45.0, 0.2)])
    out = tmp_path / "out"
    ended = call_main("record", path, "--like", "rehearsal", "--out", out)
    assert ended.returncode == 0, ended.stderr
    path.write_text(path.read_text().replace("45.0", "70.0"))
    ended = call_main("record", path, "--like", "rehearsal", "--out", tmp_path / "beyond")
    assert ended.returncode == 2
    assert "at most 50" in ended.stderr


@pytest.mark.parametrize(
    ("high_hz", "duration_s", "message"), [(201.0, 30.0, "rate_hz"), (200.0, 46.0, "45 s")]
)
def test_record_that_its_test_cannot_play_is_refused(
    high_hz: float, duration_s: float, message: str, tmp_path: Path
) -> None:
    path = write_spectrum(tmp_path, [(1.0, 0.1), (2.0, 0.3), (high_hz, 0.12)])
    shape = RecordShape(duration_s=duration_s)
    with pytest.raises(InputError, match=message) as refused:
        compute_spectrum_records(SpectrumRecordOptions(path, Path("el_centro"), shape))
    assert refused.value.where == str(path)


def test_record_that_no_motion_has_is_refused(tmp_path: Path) -> None:
    path = write_spectrum(tmp_path, [(1.0, 0.02), (2.0, 0.4), (4.0, 0.02), (16.0, 0.02)])
    out = tmp_path / "out"
    ended = call_main("record", path, "--like", "el_centro", "--out", out)
    assert ended.returncode == 2
    assert "no record found" in ended.stderr


def test_parts_longer_than_the_record_are_refused(tmp_path: Path) -> None:
    path = write_spectrum(tmp_path, SPECTRA["low"])
    with pytest.raises(InputError, match="do not fit"):
        compute_spectrum_records(
            SpectrumRecordOptions(path, Path("el_centro"), RecordShape(duration_s=20.0))
        )
