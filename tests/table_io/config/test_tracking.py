"""[tracking]: band, damping and the required response spectrum of a displacement history."""

from pathlib import Path

import numpy as np
import pytest

from table_io.config.base import parse_toml
from table_io.config.profile import MAX_SPECTRUM_BYTES, Profile, load_profile
from table_io.config.tracking import TrackingConfig, parse_required_spectrum
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import RECORD_TOML
from tests.input_errors import raises_input_error

SWEEP = """title = "A sweep"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 1.0
stop_hz = 2.0
step_hz = 0.5
cycles = 10
"""
SPECTRUM = "# as in a standard\nfrequency_hz,sa_g\n1.0,0.1\n4.0,0.4\n16,0.4\n"
TRACKING = '[tracking]\nrequired_spectrum = "rrs.csv"\n'


def write(folder: Path, more: str, spectrum: str | None = SPECTRUM) -> Path:
    rows = "".join(f"{k / 100},{np.sin(k / 10):.6f}\n" for k in range(100))
    (folder / "motion.csv").write_text("time_s,disp_mm\n" + rows)
    if spectrum is not None:
        (folder / "rrs.csv").write_text(spectrum)
    path = folder / "test.toml"
    path.write_text(RECORD_TOML + more)
    return path


def test_spectrum_travels_with_the_profile(tmp_path: Path) -> None:
    profile, text = load_profile(write(tmp_path, TRACKING))
    spectrum = profile.tracking.spectrum
    assert spectrum is not None
    assert spectrum.frequencies_hz.tolist() == [1.0, 4.0, 16.0]
    assert spectrum.sa_m_s2 == pytest.approx(np.array([0.1, 0.4, 0.4]) * GRAVITY_M_S2)
    again = parse_toml(text, Profile, "recorded")  # without any file
    assert again.tracking == profile.tracking
    assert again.plan.history_m.tobytes() == profile.plan.history_m.tobytes()


def test_between_its_points_it_is_straight_over_logarithms() -> None:
    spectrum = parse_required_spectrum(SPECTRUM, "rrs.csv")
    values = spectrum.interpolate(np.array([0.9, 1.0, 2.0, 8.0, 16.0, 17.0])) / GRAVITY_M_S2
    assert values == pytest.approx([np.nan, 0.1, 0.2, 0.4, 0.4, np.nan], nan_ok=True)


def test_nothing_is_required_without_a_table(tmp_path: Path) -> None:
    profile, text = load_profile(write(tmp_path, ""))
    assert profile.tracking == TrackingConfig()
    assert profile.tracking.spectrum is None
    assert "tracking" not in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "missing"),
        ("hz,sa_g\n1,1\n2,1\n", "hz,sa_g"),
        ("frequency_hz,sa_g\n1,1\n", "1 points"),
        ("frequency_hz,sa_g\n1,1\n1,1\n", "line 3"),
        ("frequency_hz,sa_g\n1,1\n# more\n2;1\n", "line 4"),
        ("frequency_hz,sa_g\n1,1\n2,0\n", "line 3"),
        ("frequency_hz,sa_g\n1,1\n2,nan\n", "line 3"),
    ],
)
def test_fault_of_the_spectrum_is_named(text: str, message: str, tmp_path: Path) -> None:
    with raises_input_error(key="tracking.required_spectrum", problem=message):
        load_profile(write(tmp_path, TRACKING, text))


def test_spectrum_that_is_too_large_is_refused(tmp_path: Path) -> None:
    with raises_input_error(problem="MB", allowed="0.25"):
        load_profile(write(tmp_path, TRACKING, SPECTRUM + "#" * MAX_SPECTRUM_BYTES))


def test_stepped_sine_has_no_history_to_be_tracked() -> None:
    assert parse_toml(SWEEP, Profile, "x").tracking == TrackingConfig()
    with raises_input_error(key="tracking", remedy="remove"):
        parse_toml(SWEEP + "[tracking]\ndamping = 0.02\n", Profile, "x")
