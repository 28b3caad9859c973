"""Notch of a swept sine by the twin before the run: its limit kept, and the run close to it."""

import math
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.excitation.swept_sine import PredictedSweep, SweptSine
from table_io.config.profile import Profile
from table_io.records import SweepLevel
from table_io.sequencer.swept_sine import foresee_ratio
from tests.builders.rigs import LAB_TEXT, SECOND_ACC, TEMPERATURE
from tests.builders.sessions import play_session
from twin.setup.run_config import RunConfig, read_run_config
from twin.setup.swept_prediction import reduce_before_excess

GRAVITY_M_S2 = 9.80665
LIMIT_G = 0.09
PROFILE = """
title = "notched"
rig = "simulated"
model = "snm"
specimen = { mass_kg = 550.0, gap_mm = inf }
acquisition = { rate_hz = 1000.0 }
limits = [{ channel = "mass_acc_m_s2", limit = 0.09, unit = "g", action = "notch" }]

[excitation]
kind = "swept_sine"
start_hz = 0.8
stop_hz = 2.5
octaves_per_min = 0.5
acceleration_g = 0.05
directions = ["forward"]
"""


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> RunConfig:
    path = tmp_path_factory.mktemp("notched") / "notched.toml"
    path.write_text(PROFILE, encoding="utf-8")
    return read_run_config(path)


def find_gain(model_hz: float) -> float:
    """Return the absolute acceleration of the mass over that of the table, linear specimen."""
    w, k, c, m = math.tau * model_hz, 36e3, 1.1e3, 550.0
    return abs((k + 1j * w * c) / (k - m * w**2 + 1j * w * c))


def test_prediction_is_the_level_that_keeps_the_limit(config: RunConfig) -> None:
    swept = config.profile.swept_sine
    assert swept is not None
    assert swept.predicted_sweep is not None
    for hz in (0.9, 1.15, 1.29, 1.5, 2.3):
        steady = min(0.05, LIMIT_G / find_gain(hz)) * GRAVITY_M_S2
        assert swept.predicted_sweep.level_m_s2(0, hz) == pytest.approx(steady, rel=0.1)
    table = swept.predicted_sweep.table
    mass = table[:, 3 + swept.predicted_sweep.channels.index("mass_acc_m_s2")]
    assert mass.max() < 1.02 * LIMIT_G * GRAVITY_M_S2


def test_run_plays_the_predicted_notch(config: RunConfig) -> None:
    swept = config.profile.swept_sine
    assert swept is not None
    assert swept.predicted_sweep is not None
    played = play_session(config.profile, joins_blocks=True)
    ratios, mass = [], []
    for level in played.select(SweepLevel):
        predicted = swept.predicted_sweep.level_m_s2(0, level.frequency_hz)
        if math.isfinite(predicted):
            ratios.append(level.measured_m_s2 / predicted)
        mass.append(level.amplitudes[level.channels.index("mass_acc_m_s2")])
    assert np.abs(np.array(ratios) - 1.0).max() < 0.05
    assert max(mass) < 1.03 * LIMIT_G * GRAVITY_M_S2


def test_limits_of_own_channels_are_predicted_where_the_twin_knows_them(
    config: RunConfig, tmp_path: Path
) -> None:
    """The second accelerometer is mounted the other way round; no twin knows the temperature."""
    own = PROFILE.replace('"mass_acc_m_s2"', f'"{SECOND_ACC}"').replace(
        "limits = [", f'limits = [{{ channel = "{TEMPERATURE}", limit = 80.0, action = "notch" }}, '
    )
    (tmp_path / "lab.toml").write_text(LAB_TEXT, encoding="utf-8")
    path = tmp_path / "own.toml"
    path.write_text(own.replace('"simulated"', f'"{tmp_path / "lab.toml"}"'), encoding="utf-8")
    swept, canonical = read_run_config(path).profile.swept_sine, config.profile.swept_sine
    assert swept is not None
    assert canonical is not None
    assert swept.predicted_sweep is not None
    assert canonical.predicted_sweep is not None
    assert SECOND_ACC in swept.predicted_sweep.channels
    assert TEMPERATURE not in swept.predicted_sweep.channels
    np.testing.assert_allclose(
        swept.predicted_sweep.table[:, 2], canonical.predicted_sweep.table[:, 2]
    )


def test_level_before_a_jump_leaves_room_for_what_the_jump_does_to_the_table() -> None:
    """The mass comes to 0.97 of its limit at 2 Hz: no excess, unless it jumps there."""
    limit = LIMIT_G * GRAVITY_M_S2
    rows = np.array([(0.0, 0.01 * k, 1.0, 0.97 * limit) for k in range(150, 250)])
    profile = parse_toml(PROFILE, Profile, "notched.toml")
    assert reduce_before_excess(PredictedSweep(("mass_acc_m_s2",), rows), profile) is None
    rows[:50, 3] *= 0.5
    reduced = reduce_before_excess(PredictedSweep(("mass_acc_m_s2",), rows), profile)
    assert reduced is not None
    level = 0.96 / (1.1 * 0.97)
    assert reduced.level_m_s2(0, 1.9) == pytest.approx(level)
    assert reduced.level_m_s2(0, 2.0) == pytest.approx(level)
    assert reduced.level_m_s2(0, 1.8) == pytest.approx(1.0)
    assert reduced.level_m_s2(0, 2.1) == pytest.approx(1.0)


def test_a_steep_resonance_or_another_pass_is_no_jump() -> None:
    """Two passes upwards, at 10 octaves a minute, to a flank of slope 10 over ln f."""
    limit, ln_f = LIMIT_G * GRAVITY_M_S2, np.arange(0.0, 1.6, 0.1)
    response = 0.97 * limit * np.exp(10.0 * np.minimum(ln_f - 1.2, 0.0))
    rows = np.array(
        [(sweep, *row) for sweep in (0.0, 1.0)
         for row in zip(np.exp(ln_f), np.ones(ln_f.size), response, strict=True)]
    )  # fmt: skip
    profile = parse_toml(PROFILE, Profile, "notched.toml")
    assert reduce_before_excess(PredictedSweep(("mass_acc_m_s2",), rows), profile) is None
    rows[:16, 3], rows[16:, 3] = 0.5 * limit, 0.97 * limit
    assert reduce_before_excess(PredictedSweep(("mass_acc_m_s2",), rows), profile) is None


def test_prediction_travels_with_the_profile_and_is_not_computed_again(config: RunConfig) -> None:
    assert "prediction.csv" in config.profile_toml
    path = Path(PROFILES_DIR) / "tests" / "g10.toml"
    assert read_run_config(path).profile.swept_sine is None


def test_points_before_a_jump_say_nothing_about_the_branch_behind_it() -> None:
    """The twin jumps at 2 Hz from a ratio of 1 to 4; the specimen is 10 % above it behind."""
    rows = [(0.0, 0.02 * k, 1.0, 1.0 if k < 100 else 4.0) for k in range(90, 121)]
    predicted = PredictedSweep(("mass_acc_m_s2",), np.array(rows))
    config = SweptSine(
        start_hz=1.0, stop_hz=3.0, prediction="p.csv", files={"p.csv": predicted.to_csv()}
    )
    foresee = partial(foresee_ratio, config, 0, "mass_acc_m_s2")
    before = [(math.log(hz), 0.0) for hz in (1.90, 1.92, 1.94, 1.96)]
    behind = (math.log(2.02), math.log(4.4))
    assert foresee([*before, behind], math.log(2.06)) == pytest.approx(math.log(4.4))
    assert math.isnan(foresee(before, math.log(2.06)))
    assert foresee(before, math.log(1.97)) == pytest.approx(0.0)


def test_a_flank_of_the_twin_is_foreseen_whatever_the_noise() -> None:
    """Specimen as its twin: slope 1.5 over ln f, 7 from 0.05 on; noise of 0.1 %."""
    ln_f = np.linspace(-0.1, 0.2, 301)
    ratio = np.where(ln_f < 0.05, 1.5 * ln_f, 0.075 + 7.0 * (ln_f - 0.05))
    rows = np.array([(0.0, math.exp(at), 1.0, math.exp(y))
                     for at, y in zip(ln_f.tolist(), ratio.tolist(), strict=True)])  # fmt: skip
    predicted = PredictedSweep(("mass_acc_m_s2",), rows)
    config = SweptSine(
        start_hz=0.5, stop_hz=2.0, prediction="p.csv", files={"p.csv": predicted.to_csv()}
    )
    rng = np.random.default_rng(1)
    for _ in range(200):
        noise = 0.001 * rng.standard_normal(5)
        at = np.linspace(0.0, 0.048, 5)
        points = list(zip(at.tolist(), (1.5 * at + noise).tolist(), strict=True))
        foreseen = foresee_ratio(config, 0, "mass_acc_m_s2", points, 0.088)
        assert foreseen == pytest.approx(0.075 + 7.0 * 0.038, abs=0.02)
