"""The twin of the table: against closed forms, and identified from a table of another code."""

import math
from dataclasses import replace

import numpy as np
import pytest

from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from tests.builders.rigs import compute_oil_column_hz
from tests.earthquakes.hydraulic_rig import (
    RATE_HZ,
    SPECIMEN_KG,
    STALL_N,
    TABLE,
    build_rig,
    identify,
    make_random_motion,
    play,
)
from twin.earthquakes.drive_computation import compute_command, compute_correction, measure_error
from twin.earthquakes.table_identification import TableIdentification, TableRehearsal
from twin.earthquakes.table_model import TableModel, TableParameters

MASS_KG = TABLE.moving_mass_kg
BAND_HZ = 0.3, 18.0
LINEAR = TableParameters(pressure_feedback_s=0.003, viscous_n_s_m=2e3, frame_ratio=0.05)


def rehearse(friction_n: float, noise: bool = True) -> TableRehearsal:
    """Return 20 s of random motion of 0.02 g rms, with the noise of the rig's sensors."""
    command = make_random_motion(20.0, (0.3, 35.0), 0.02 * GRAVITY_M_S2, seed=4)
    signals = play(build_rig(friction_n), command)
    rng = np.random.default_rng(5)
    y = signals[0] + noise * 5e-6 * rng.standard_normal(command.size)
    acceleration = signals[1] + noise * 5e-3 * rng.standard_normal(command.size)
    return TableRehearsal(RATE_HZ, command, y, acceleration, -SPECIMEN_KG * signals[3])


@pytest.fixture(scope="module", params=[500.0, pytest.param(1500.0, marks=pytest.mark.slow)])
def identification(request: pytest.FixtureRequest) -> tuple[float, TableIdentification]:
    return request.param, identify(rehearse(request.param))


@pytest.mark.parametrize("hz", [0.5, 3.0, 9.0, 14.0, 20.0, 28.0, 35.0])
def test_the_small_motion_is_that_of_the_frequency_response(hz: float) -> None:
    model = TableModel(MASS_KG, LINEAR)
    times = np.arange(10_000) / RATE_HZ
    command = 1e-5 * np.clip(times, 0.0, 1.0) ** 2 * np.sin(math.tau * hz * times)
    turn = np.exp(-1j * math.tau * hz * times[-4000:])
    y = model.simulate(command, RATE_HZ)[0][-4000:]
    measured = (y * turn).sum() / (command[-4000:] * turn).sum()
    expected = model.frequency_response(np.array([hz]))[0]
    assert abs(measured / expected - 1.0) < 0.01


def test_acceleration_is_that_of_the_displacement() -> None:
    parameters = LINEAR._replace(friction_n=400.0, static_excess_n=100.0, stall_force_n=STALL_N)
    command = make_random_motion(20.0, (0.3, 5.0), 0.5, seed=1)
    y, acceleration = TableModel(MASS_KG, parameters).simulate(command, RATE_HZ)
    by_difference = np.diff(y, 2) * RATE_HZ**2
    assert np.abs(by_difference - acceleration[1:-1]).max() < 0.05 * np.abs(acceleration).max()


def test_friction_and_oil_column_are_those_of_the_rig(
    identification: tuple[float, TableIdentification],
) -> None:
    friction_n, result = identification
    p = result.model.parameters
    assert TABLE.hydraulic is not None
    assert p.friction_n == pytest.approx(friction_n, rel=0.15)
    assert p.oil_hz == pytest.approx(compute_oil_column_hz(TABLE.hydraulic, MASS_KG), rel=0.05)
    assert p.gain_1_s == pytest.approx(TABLE.hydraulic.gain_1_s, rel=0.05)
    assert p.frame_hz == pytest.approx(TABLE.hydraulic.frame_frequency_hz, rel=0.03)


def test_the_first_run_of_its_drive_is_right_and_the_next_ones_are_better(
    identification: tuple[float, TableIdentification],
) -> None:
    """At ten times the level of the rehearsal; truth is the plant without noise."""
    friction_n, result = identification
    target = make_random_motion(20.0, (0.4, 12.0), 0.05 * GRAVITY_M_S2, seed=9)
    rig = build_rig(friction_n)
    open_loop = measure_error(play(rig, target)[0], target, RATE_HZ, BAND_HZ)
    linear = compute_correction(target, result.model, RATE_HZ, BAND_HZ)
    by_linear = measure_error(play(rig, linear)[0], target, RATE_HZ, BAND_HZ)
    reaction = -SPECIMEN_KG * play(replace(rig, payload_reaction=False), target)[3]
    command = compute_command(result.model, target, RATE_HZ, BAND_HZ, reaction).command_m
    errors = []
    for _ in range(3):
        achieved = play(rig, command)[0]
        errors.append(measure_error(achieved, target, RATE_HZ, BAND_HZ))
        command += compute_correction(target - achieved, result.model, RATE_HZ, BAND_HZ)
    assert open_loop > 0.25
    assert errors[0] < min(0.05, by_linear)
    assert errors[2] < 0.02


def test_a_drive_rests_at_its_ends(identification: tuple[float, TableIdentification]) -> None:
    target = np.pad(make_random_motion(12.0, (0.5, 10.0), 0.5, seed=2), 1000)
    command = compute_command(identification[1].model, target, RATE_HZ, BAND_HZ).command_m
    assert command[0] == command[-1] == 0.0
    assert np.abs(np.diff(command)[[0, -1]]).max() < 1e-7


@pytest.mark.parametrize("seconds", [5.0, 20.0])
def test_what_is_no_rehearsal_is_refused(seconds: float) -> None:
    """Too short, or at rest."""
    zeros = np.zeros(round(seconds * RATE_HZ))
    command = zeros if seconds > 10.0 else np.sin(np.arange(zeros.size) / 100.0)
    with pytest.raises(InputError):
        identify(TableRehearsal(RATE_HZ, command, zeros, zeros, zeros))
