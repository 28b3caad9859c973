"""`check` of records: what the loop check will refuse is refused before, and nothing else."""

import math
from pathlib import Path

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from tests.builders.sessions import play_session
from twin.api import check_test

RIG = (PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8")


def write_record(folder: Path, period_s: float, peak_g: float, noise_mm: float) -> Path:
    """Write a record of one long period, with a little of 5 Hz, and its rig."""
    t = np.arange(0.0, 10 * period_s, 0.01)
    wave = np.sin(2 * np.pi * t / period_s) * np.sin(np.pi * t / t[-1]) ** 2
    wave += 0.4 * np.sin(10 * np.pi * t) * np.sin(np.pi * t / t[-1]) ** 2
    wave *= peak_g / np.abs(wave).max()
    rows = "\n".join(f"{x:.2f},{a:.8f}" for x, a in zip(t, wave, strict=True))
    (folder / "long.csv").write_text(f"time_s,acc_g\n{rows}\n", encoding="utf-8")
    rig = RIG.replace("noise_rms = 0.005", f"noise_rms = {noise_mm}")
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    path = folder / "test.toml"
    path.write_text(
        'title = "long"\nrig = "rig.toml"\nmodel = "snm"\n[specimen]\nmass_kg = 550.0\n'
        'gap_mm = inf\n[excitation]\nkind = "record"\nfile = "long.csv"\n',
        encoding="utf-8",
    )
    return path


def test_record_of_a_long_period_is_judged_by_its_own_displacement(tmp_path: Path) -> None:
    """Its level over the square of the highest frequency is 50 um, its displacement 20 mm."""
    path = write_record(tmp_path, 2.5, 0.02, 0.03)
    checked = check_test(path)
    played = play_session(checked.config.profile, rig=checked.config.rig, stop_s=30.0)
    assert "loop check" not in played.stop.reason


@pytest.mark.parametrize("period_s", [1.0, 2.5])
def test_noise_that_the_loop_check_would_refuse_is_refused_before_motion(
    tmp_path: Path, period_s: float
) -> None:
    peak_mm = 3.0 * 9.80665 / (2 * math.pi / period_s) ** 2
    path = write_record(tmp_path, period_s, 0.003, 0.2 * peak_mm)
    with pytest.raises(InputError, match="noise of table_disp_m is") as caught:
        check_test(path)
    assert "noise_rms" in str(caught.value)
