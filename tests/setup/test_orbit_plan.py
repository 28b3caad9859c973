"""Orbit plan: points along the unstable branch of G4, their gains, and refusals."""

import math
import re

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR, parse_toml
from table_io.config.profile import Profile
from tests.input_errors import raises_input_error
from tests.model.reference import AG, snm
from twin.dynamics.event_driven_map import make_period_map
from twin.model.model import Model
from twin.setup.feedback_gains import FeedbackTiming, OpenLoop, closed_loop_multipliers
from twin.setup.orbit_plan import find_unstable_stretch, make_orbit_plan
from twin.setup.run_config import RunConfig, read_run_config

RANGE_HZ = (2.75, 4.1)
FEEDBACK_TIMING = FeedbackTiming(latency_s=0.046, jitter_s=0.005, block_s=0.01)
UNSTABLE_POINTS = 24


@pytest.fixture(scope="module")
def plan():
    return make_orbit_plan(Model(snm()), RANGE_HZ, AG, UNSTABLE_POINTS, FEEDBACK_TIMING)


@pytest.fixture(scope="module")
def planned_config() -> RunConfig:
    """The shipped profile of the unstable branch, for whose rig a plan is made as it is read."""
    return read_run_config(PROFILES_DIR / "tests" / "g4_unstable.toml")


@pytest.fixture(scope="module")
def stretch():
    return find_unstable_stretch(make_period_map(Model(snm()), RANGE_HZ[1], AG), RANGE_HZ)


def test_plan_goes_through_both_folds(plan):
    stable = [point.stable for point in plan.points]
    unstable = [point for point in plan.points if not point.stable]
    assert stable == sorted(stable[: len(stable) // 2], reverse=True) + sorted(
        stable[len(stable) // 2 :]
    )
    assert stable[0]
    assert stable[-1]
    assert abs(len(unstable) - UNSTABLE_POINTS) <= 1
    frequencies = [point.frequency_hz for point in unstable]
    assert frequencies == sorted(frequencies)
    assert frequencies[0] < 2.81
    assert 4.02 < frequencies[-1] < 4.0274


@pytest.mark.parametrize("start_hz", [2.85, 3.4, 3.9])
def test_range_that_begins_between_the_folds_is_reached_through_the_lower_one(start_hz):
    plan = make_orbit_plan(Model(snm()), (start_hz, 4.1), AG, 8, FEEDBACK_TIMING)
    stable = [point.stable for point in plan.points]
    assert stable[0]
    assert stable.index(False) == 3
    unstable_hz = [point.frequency_hz for point in plan.points if not point.stable]
    assert unstable_hz == sorted(unstable_hz)
    assert unstable_hz[0] < 2.83
    assert sum(f >= start_hz for f in unstable_hz) >= 7


@pytest.mark.parametrize("range_hz", [(2.75, 2.9), RANGE_HZ])
def test_stable_orbits_lead_to_the_first_one_from_above_both_folds(range_hz):
    """Between the folds rest may lead to the large motion; above both there is none."""
    plan = make_orbit_plan(Model(snm()), range_hz, AG, 8, FEEDBACK_TIMING)
    way = [*plan.leads, plan.points[0]]
    assert all(orbit.stable for orbit in way)
    assert way[0].frequency_hz > 4.0273
    assert max(orbit.frequency_hz for orbit in way[1:]) < way[0].frequency_hz
    steps = np.diff([math.log(orbit.frequency_hz) for orbit in way])
    assert ((steps > -0.1) & (steps < 0.0)).all()
    assert (np.diff([orbit.amplitude_m for orbit in way]) > 0.0).all()


def test_a_range_far_below_the_upper_fold_is_planned() -> None:
    """From rest 1.2 times above it, the model settles below its resonance: no fold lies there."""
    plan = make_orbit_plan(Model(snm()), (2.75, 2.9), AG, 8, FEEDBACK_TIMING)
    unstable_hz = [point.frequency_hz for point in plan.points if not point.stable]
    assert [point.stable for point in plan.points[:4]] == [True, True, True, False]
    assert unstable_hz == sorted(unstable_hz)
    assert 2.787 < unstable_hz[0] < 2.8
    assert 2.88 < unstable_hz[-1] < 2.9


def test_a_range_below_the_folds_is_refused_with_the_whole_of_both_unstable_parts() -> None:
    with raises_input_error(key="excitation.start_hz") as error:
        make_orbit_plan(Model(snm()), (2.6, 2.7), AG, 8, FEEDBACK_TIMING)
    _, lower_end, *upper = (float(word) for word in re.findall(r"[0-9.]+", error.value.allowed))
    assert 1.73 < lower_end < 1.7366
    assert upper == pytest.approx([2.787, 4.027], rel=1e-3)


def test_a_coarse_plan_has_no_orbit_far_from_the_next() -> None:
    """A limited feedback cannot reach from one of three orbits to the next; it can of 25."""
    unstable = [p for p in make_orbit_plan(Model(snm()), RANGE_HZ, AG, 3, FEEDBACK_TIMING).points
                if not p.stable]  # fmt: skip
    assert len(unstable) in (25, 26)
    assert max(np.diff([point.amplitude_m for point in unstable])) < 0.35e-3


def test_orbits_of_the_plan_are_those_of_the_model(plan):
    unstable = [point for point in plan.points if not point.stable]
    frequencies = [point.frequency_hz for point in unstable]
    multipliers = np.interp([3.0, 3.4, 3.8], frequencies, [p.multiplier_size for p in unstable])
    assert multipliers == pytest.approx([5.9259, 3.115, 1.7204], rel=0.02)
    amplitudes = [abs(complex(*point.u_m[1])) for point in unstable]
    assert np.interp(3.4, frequencies, amplitudes) == pytest.approx(3.1923e-3, rel=3e-3)


def test_gains_hold_every_orbit_with_a_wrong_model(plan):
    """Every planned gain pair holds the orbit of a model of 3 % more mass at a longer latency."""
    heavy = make_period_map(Model(snm()), RANGE_HZ[1], AG).with_parameter("mass", 550.0 * 1.03)
    varied = find_unstable_stretch(heavy, RANGE_HZ)
    for point, position in zip(
        plan.points[3::6], np.arange(UNSTABLE_POINTS)[::6] / UNSTABLE_POINTS, strict=False
    ):
        loop = OpenLoop.from_orbit(
            varied.orbit_at(position + 0.5 / UNSTABLE_POINTS), FEEDBACK_TIMING.block_s
        )
        gains = np.array([[point.gain, point.rate_gain_s]])
        assert closed_loop_multipliers(loop, 0.051, gains)[0] < 0.5


def test_without_gains_the_multiplier_is_that_of_the_orbit(stretch):
    orbit = stretch.orbit_at(0.5)
    loop = OpenLoop.from_orbit(orbit, FEEDBACK_TIMING.block_s)
    gains = np.array([[0.0, 0.0], [0.2, 0.0], [0.8, 0.0]])
    multipliers = closed_loop_multipliers(loop, 0.046, gains)
    assert multipliers[0] == pytest.approx(abs(orbit.multipliers[0]), rel=1e-3)
    assert multipliers[1] > 1 > multipliers[2]


def test_a_range_without_unstable_orbits_is_refused_with_those_there_are():
    with raises_input_error(key="excitation.start_hz", allowed="2.7") as error:
        make_orbit_plan(Model(snm()), (4.1, 4.4), AG, UNSTABLE_POINTS, FEEDBACK_TIMING)
    assert "4.027" in error.value.allowed


def test_a_model_without_folds_is_refused():
    with raises_input_error(key="excitation.start_hz"):
        make_orbit_plan(Model(snm(np.inf)), RANGE_HZ, AG, UNSTABLE_POINTS, FEEDBACK_TIMING)


@pytest.mark.slow  # 4 s
def test_too_large_a_latency_is_refused_with_the_largest_allowed():
    with raises_input_error(key="latency") as error:
        make_orbit_plan(
            Model(snm()),
            RANGE_HZ,
            AG,
            UNSTABLE_POINTS,
            FeedbackTiming(0.2, 0.005, FEEDBACK_TIMING.block_s),
        )
    allowed_ms = float(error.value.allowed.split()[2])
    assert 100 < allowed_ms < 160


def test_a_profile_without_a_plan_gets_one_for_its_rig(planned_config):
    config = planned_config
    continuation = parse_toml(config.profile_toml, Profile, "").continuation
    assert continuation is not None
    plan = continuation.orbit_plan
    assert len(plan.points) == len(config.steps)
    assert sum(not point.stable for point in plan.points) >= 60
    assert plan.latency_s == pytest.approx(0.045)  # 20 ms fixed, 10 ms to decide, 15 ms of servo
    assert max(point.multiplier_size for point in plan.points) > 6.5


def test_limits_and_duration_count_the_feedback_and_its_updates(planned_config):
    config = planned_config
    continuation = config.profile.continuation
    assert continuation is not None
    for demand, orbit in zip(config.margins[-len(config.steps) :], config.steps, strict=True):
        steady_m = orbit.acceleration_m_s2 / (2 * math.pi * orbit.frequency_hz) ** 2
        least_m = (1 + continuation.max_feedback) * steady_m
        assert least_m * 0.999 < demand.displacement_m < 1.2 * least_m
    cycles = 2 * (10 + 10 + 4) + 32
    planned_s = config.drive.planned_end / config.drive.rate_hz
    assert config.expected_s - planned_s == pytest.approx(
        sum(cycles / orbit.frequency_hz for orbit in config.steps)
    )


def test_a_table_under_external_control_is_refused():
    with raises_input_error(key="backend", value="follow"):
        read_run_config(PROFILES_DIR / "tests" / "g4_unstable.toml", "follow_simulated")


def test_a_plan_for_a_faster_rig_is_refused_with_both_latencies(tmp_path, planned_config):
    path = tmp_path / "planned.toml"
    path.write_text(planned_config.profile_toml)
    assert read_run_config(path).steps == planned_config.steps
    with raises_input_error(key="latency_s", allowed="50.0 ms") as error:
        read_run_config(path, "udp_simulated")
    assert "55.0 ms" in str(error.value)
    with raises_input_error(key="backend", value="follow"):
        read_run_config(path, "follow_simulated")


def test_a_profile_that_is_no_table_cannot_take_a_plan(tmp_path, monkeypatch):
    """Refused at once: to make a plan takes seconds."""

    def make_no_plan(*_) -> None:
        raise AssertionError("a plan was made")

    monkeypatch.setattr("twin.setup.orbit_plan.make_orbit_plan", make_no_plan)
    path = tmp_path / "inline.toml"
    path.write_text(
        'title = "Inline"\n'
        'excitation = { kind = "continuation", start_hz = 2.75, stop_hz = 4.1, points = 5 }\n'
        "[specimen]\nmass_kg = 550.0\ngap_mm = 4.0\n"
    )
    with raises_input_error(key="excitation", where=path):
        read_run_config(path)
