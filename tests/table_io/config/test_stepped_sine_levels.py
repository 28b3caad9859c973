"""Stepped sine whose level varies with frequency or by a schedule of whole sweeps."""

from typing import Any

import numpy as np
import pytest

from table_io.config.base import parse_toml
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.profile import Profile
from table_io.excitation.trajectory import plan_excitation
from table_io.safety.preflight import check_limits, compute_demands
from table_io.units import GRAVITY_M_S2
from tests.builders.rigs import RIG
from tests.input_errors import raises_input_error

GRID = {"start_hz": 1.0, "stop_hz": 4.0, "step_hz": 1.0, "cycles": 3}


def make(more: str = "", **keys: Any) -> Profile:
    lines = "\n".join(f"{name} = {value!r}" for name, value in (GRID | keys).items())
    text = 'title = "x"\nspecimen = {mass_kg = 550.0, gap_mm = 4.0}\n'
    return parse_toml(f"{text}[sweep]\n{lines}\n{more}", Profile, "x.toml")


def levels_g(profile: Profile) -> list[float]:
    return [step.acceleration_m_s2 / GRAVITY_M_S2 for step in profile.steps]


def test_constant_level_is_what_it_was_to_the_last_bit() -> None:
    profile = make(acceleration_g=0.07)
    assert {step.acceleration_m_s2 for step in profile.steps} == {0.07 * GRAVITY_M_S2}
    assert profile.plan.level_m_s2 == 0.07 * GRAVITY_M_S2
    assert (profile.sweep.has_one_level, profile.sweep.one_level_g) == (True, 0.07)


def test_level_follows_break_points_in_logarithms() -> None:
    profile = make(level_points=[[1.0, 0.01], [4.0, 0.04]])
    expected = [0.01, 0.02, 0.03, 0.04]
    assert levels_g(profile) == pytest.approx([*expected, *expected[::-1]])
    assert profile.plan.level_m_s2 == pytest.approx(0.04 * GRAVITY_M_S2)
    rows = compute_demands(plan_excitation(profile), profile, RIG)
    held = [level * GRAVITY_M_S2 for level in levels_g(profile)]
    # A blend before a step may reach the level of the step before it.
    assert all(row.acceleration_m_s2 >= 0.999 * a for row, a in zip(rows, held, strict=True))
    assert rows[0].displacement_m == pytest.approx(0.01 * GRAVITY_M_S2 / (2 * np.pi) ** 2, rel=0.05)


def test_schedule_repeats_the_sweep_at_each_level() -> None:
    profile = make(acceleration_g=0.04, schedule_db=[-12, -6.0, 0.0])
    levels = np.reshape(levels_g(profile), (3, 8))
    for row, db in zip(levels, (-12, -6, 0), strict=True):
        assert row == pytest.approx(np.full(8, 0.04 * 10 ** (db / 20)))
    assert [step.index for step in profile.steps] == list(range(24))
    once = make(acceleration_g=0.04).steps
    places = [(step.direction, step.frequency_hz) for step in profile.steps]
    assert places == 3 * [(step.direction, step.frequency_hz) for step in once]
    assert profile.steps[16:] == tuple(
        type(step)(step.index + 16, step.direction, step.frequency_hz, step.acceleration_m_s2)
        for step in once
    )
    assert profile.plan.level_m_s2 == pytest.approx(0.04 * GRAVITY_M_S2)


def test_schedule_of_one_level_is_one_level() -> None:
    sweep = make(acceleration_g=0.04, schedule_db=[-6.0]).sweep
    assert isinstance(sweep, Sweep)
    assert sweep.one_level_g == pytest.approx(0.04 * 10**-0.3)


def test_drive_passes_all_levels_without_a_jump() -> None:
    profile = make(level_points=[[1.0, 0.01], [4.0, 0.04]], schedule_db=[-12.0, 0.0])
    drive = plan_excitation(profile)
    command = drive.command(0, drive.planned_end + 10)
    rate_hz = profile.acquisition.rate_hz
    acceleration = np.abs(np.diff(command, 2)) * rate_hz**2
    assert acceleration.max() == pytest.approx(0.04 * GRAVITY_M_S2, rel=0.06)
    assert command[-1] == 0.0


def test_level_beyond_a_limit_is_refused_at_its_break_points() -> None:
    profile = make(level_points=[[1.0, 0.5], [4.0, 0.01]])
    rows = compute_demands(plan_excitation(profile), profile, RIG)
    with raises_input_error(key="displacement", remedy="sweep.level_points"):
        check_limits(rows, profile, RIG, "x.toml")


def test_level_of_a_schedule_is_refused() -> None:
    profile = make(schedule_db=[-6.0, 0.0])
    with raises_input_error(key="excitation.schedule_db", remedy="acceleration_g"):
        _ = profile.sweep.one_level_g
