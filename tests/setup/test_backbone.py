"""Backbone: phase resonances of the model, refusals, and a backbone measured on the rig."""

import math
from pathlib import Path

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR
from table_io.config.profile import Profile
from table_io.records import Event, OrbitPoint, RunStop
from table_io.units import GRAVITY_M_S2
from tests.builders.sessions import PlayedSession, play_session
from tests.input_errors import raises_input_error
from tests.model.reference import snm
from twin.dynamics.event_driven_map import make_period_map
from twin.model.model import Model
from twin.setup.feedback_gains import FeedbackTiming
from twin.setup.orbit_plan import (
    find_phase_resonance,
    find_resonance_approach,
    make_backbone_plan,
    measure_orbit_phase,
)
from twin.setup.run_config import read_run_config

RATE_HZ = 2000.0
RANGE_HZ = (1.3, 4.5)
TIMING = FeedbackTiming(latency_s=0.045, jitter_s=0.005, block_s=0.01)
# By shooting on the simulated plant itself, payload reaction included: g, f in Hz, |U_1| in mm.
TRUE_BACKBONE = np.array([
    [0.0117, 2.54852, 2.86152], [0.0120, 2.57682, 2.89136], [0.0123, 2.60444, 2.92116],
    [0.0151, 2.83405, 3.19665], [0.0155, 2.86326, 3.23624], [0.01993, 3.1388, 3.6619],
    [0.0200, 3.14311, 3.66899], [0.0205, 3.16954, 3.71613],
])  # fmt: skip


@pytest.fixture(scope="module")
def period_map():
    """The map of the paper's model at any level."""
    return lambda level: make_period_map(Model(snm()), 1.0, level)


def test_without_contact_phase_resonance_is_that_of_the_linear_oscillator(period_map) -> None:
    """K u + C u' = -M (u'' + a sin wt): at w = sqrt(K / M), u = M a / (C w) cos wt."""
    level = 0.02  # m/s2: below the gap
    orbit = find_phase_resonance(period_map(level), (1.0, 2.0))
    w = math.sqrt(36000.0 / 550.0)
    assert orbit.frequency_hz == pytest.approx(w / (2 * math.pi), rel=1e-5)
    assert orbit.u_max == pytest.approx(550.0 * level / (1100.0 * w), rel=1e-3)
    assert len(find_resonance_approach(period_map(level), (1.0, 2.0))) == 1  # no fold, no leads


def test_with_contact_u_leads_by_90_degrees_and_orbits_lead_up_from_below_the_folds(
    period_map,
) -> None:
    level = 0.02 * GRAVITY_M_S2
    *leads, orbit = find_resonance_approach(period_map(level), RANGE_HZ)
    assert measure_orbit_phase(orbit) == pytest.approx(90.0, abs=2e-3)
    assert orbit.stable
    frequencies = [lead.frequency_hz for lead in leads]
    assert frequencies == sorted(frequencies)
    assert frequencies[0] < 2.0  # the lower fold is at 2.0 Hz, so rest leads to this orbit
    assert all(lead.stable for lead in leads)
    assert max(np.diff([*frequencies, orbit.frequency_hz]) / frequencies) < 0.12


@pytest.mark.parametrize("range_hz", [(1.0, 2.0), (5.0, 6.0)])
def test_range_without_phase_resonance_is_refused_with_where_it_is(period_map, range_hz) -> None:
    with raises_input_error(key="excitation.start_hz", value=range_hz[0]) as caught:
        find_phase_resonance(period_map(0.05 * GRAVITY_M_S2), range_hz)
    assert "0.05 g" in str(caught.value)
    assert "degrees" in str(caught.value)


def test_range_far_above_the_lower_fold_has_its_phase_resonance(period_map) -> None:
    orbit = find_phase_resonance(period_map(0.05 * GRAVITY_M_S2), (3.9, 4.1))
    assert orbit.frequency_hz == pytest.approx(4.001, abs=1e-3)


def test_table_under_external_control_is_refused() -> None:
    with raises_input_error(key="backend", value="follow"):
        read_run_config(PROFILES_DIR / "tests" / "g4_backbone.toml", "follow_simulated")


@pytest.mark.slow  # 7 s
def test_levels_of_the_plan_rise_and_a_latency_that_is_too_large_leaves_no_gain() -> None:
    """The orbits are stable, so without feedback they are measured all the same."""
    levels = np.array([0.3, 0.49])
    late = FeedbackTiming(latency_s=0.4, jitter_s=0.005, block_s=0.01)
    plan, late_plan = (
        make_backbone_plan(Model(snm()), RANGE_HZ, levels, t) for t in (TIMING, late)
    )
    assert [point.acceleration_m_s2 for point in plan.points] == levels.tolist()
    assert plan.condition == "phase"
    assert min(point.gain for point in plan.points) > 0.5
    assert max(abs(point.gain) for point in late_plan.points) < 0.3


@pytest.fixture(scope="module")
def measured_backbone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Profile, PlayedSession]:
    """Three levels of the shipped backbone, from 0.012 to 0.02 g, on the simulated rig."""
    path: Path = tmp_path_factory.mktemp("backbone") / "short.toml"
    text = (PROFILES_DIR / "tests" / "g4_backbone.toml").read_text(encoding="utf-8")
    for before, after in (
        ("min_acceleration_g = 0.007", "min_acceleration_g = 0.012"),
        ("acceleration_g = 0.05", "acceleration_g = 0.02"),
        ("points = 16", "points = 3"),
    ):
        assert before in text
        text = text.replace(before, after)
    path.write_text(text, encoding="utf-8")
    profile = read_run_config(path).profile
    return profile, play_session(profile)


@pytest.mark.slow  # 14 s with those of the same session
def test_backbone_is_that_of_the_plant(measured_backbone) -> None:
    points = measured_backbone[1].select(OrbitPoint)
    assert [(point.step, point.accepted, point.reason) for point in points] == [
        (0, True, ""), (1, True, ""), (2, True, ""),
    ]  # fmt: skip
    for point in points:
        true_hz, true_mm = (
            np.interp(point.acceleration_m_s2 / GRAVITY_M_S2, TRUE_BACKBONE[:, 0], column)
            for column in TRUE_BACKBONE[:, 1:].T
        )
        assert point.frequency_hz == pytest.approx(true_hz, rel=2e-3)
        assert 1e3 * math.hypot(*point.u_m[2:4]) == pytest.approx(true_mm, rel=4e-3)


@pytest.mark.slow  # 14 s with those of the same session
def test_feedback_vanished_in_phase_within_100_periods(measured_backbone) -> None:
    for point in measured_backbone[1].select(OrbitPoint):
        assert point.feedback_size_m <= 0.003 * point.command_m
        assert math.degrees(math.atan2(point.u_m[3], point.u_m[2])) == pytest.approx(0.0, abs=1.0)
        assert point.periods <= 100


@pytest.mark.slow  # 14 s with those of the same session
def test_nothing_is_lost_and_the_command_ends_at_rest(measured_backbone) -> None:
    result = measured_backbone[1]
    assert not [event for event in result.select(Event) if event.kind == "lost"]
    assert result.select(RunStop)[0].verdict == "complete"
    assert np.abs(result.command_m[-200:]).max() < 1e-6
    acceleration = np.convolve(np.diff(result.command_m, 2), np.ones(40) / 40, "valid")
    assert np.abs(acceleration).max() * RATE_HZ**2 < 1.6 * 0.02 * GRAVITY_M_S2
