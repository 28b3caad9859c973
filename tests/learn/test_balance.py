"""Parameters from measured forces along the measured motion: what the simulated table hides."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from table_io.backends import open_backend
from table_io.block import Block, Float1D
from table_io.card import PROFILES, load
from table_io.clock import ManualClock
from table_io.profile import Profile
from table_io.records import RunStart
from table_io.rig import Rig
from table_io.session import Setup, play
from twin.learn.balance import Sheet, base_free, by_block, counts, fit
from twin.learn.motion import motion_of
from twin.model.forced import along
from twin.model.model import Model
from twin.model.parameters import Parameters

RIG = load(PROFILES / "rigs" / "simulated.toml", Rig, "machine card")[0]
TRUE = Parameters(550.0, 36e3, 1.1e3, 510e3, 900.0, 510e3, 900.0, 0.002, 0.002)
TEST = Profile.model_validate(
    {
        "title": "two steps",
        "specimen": {"mass_kg": 550.0, "gap_mm": 4.0},
        "sweep": {
            "start_hz": 2.0, "stop_hz": 2.6, "step_hz": 0.6, "cycles": 4, "directions": ["forward"],
        },
        "loop_check": {"enabled": False},
        "control": {"enabled": False},
    }
)  # fmt: skip


@cache
def sheet() -> Sheet:
    """A short run on the simulated table, which touches both bumpers, made ready for a fit."""
    clock = ManualClock()

    def start(tare: dict[str, float], epoch_s: float) -> RunStart:
        return RunStart(
            0, "r", "n", "table", "", "", "", 2e3, 20, RIG.channels, (), 0, tare, {}, "", "",
            epoch_s,
        )  # fmt: skip

    source = play(Setup(TEST, RIG), open_backend(RIG, TEST, clock), clock, start, lambda: None)
    blocks = tuple(item for item in source if isinstance(item, Block))
    return Sheet(motion_of(blocks, "short", 550.0, (0.002, 0.002)), 10.0)


def every(one: Sheet) -> list[np.ndarray]:
    return [np.ones(int(one.blocks[-1]) + 1, dtype=bool)]


def test_a_fit_from_far_finds_the_parameters_that_the_table_hides() -> None:
    one = sheet()
    far = Model(
        replace(
            TRUE, stiffness=25e3, damping=2500.0, bumper_stiffness_r=300e3, gap_r=0.0035,
            bumper_stiffness_l=300e3, bumper_damping_r=200.0, bumper_damping_l=200.0, gap_l=0.0035,
        )
    )  # fmt: skip
    found = fit([one], far, base_free(far, True), every(one))
    assert found.converged
    assert found.at_bound == ()
    wanted = {
        "stiffness": 36e3, "damping": 1.1e3, "bumper_stiffness": 510e3, "bumper_damping": 900.0,
        "gap": -0.0015,
    }  # fmt: skip
    for name, value in wanted.items():
        assert found.values[name] == pytest.approx(value, rel=0.01), name
        assert 0 < found.spread[name] < 0.01 * abs(value), name


def test_the_true_model_leaves_the_noise_and_another_leaves_more() -> None:
    one = sheet()

    def left(model: Model) -> Float1D:
        return np.asarray(by_block(one, model).sum(axis=1) / counts(one).sum(axis=1))

    assert left(Model(TRUE)) == pytest.approx([1.0, 1.2, 1.2], abs=0.35)
    stiffer = left(Model(replace(TRUE, bumper_stiffness_r=540e3)))
    assert stiffer[1] > 10.0
    assert stiffer[2] == pytest.approx(left(Model(TRUE))[2])


def test_velocity_is_that_of_the_displacement() -> None:
    motion = sheet().motion
    inside = motion.moving & (np.arange(motion.u.size) > 500)
    slope = np.gradient(motion.u, 1.0 / motion.rate_hz)
    error = (slope - motion.v)[inside]
    assert np.sqrt(np.mean(error**2)) < 0.02 * np.sqrt(np.mean(motion.v[inside] ** 2))


def test_along_a_motion_the_forces_are_those_of_the_law() -> None:
    time = np.arange(500) / 500.0
    u, v = 0.004 * np.sin(6.0 * time), 0.024 * np.cos(6.0 * time)
    touched = np.array([u > 0.002, u < -0.002]).astype(np.int8)
    model = Model(TRUE).with_effect("cubic_stiffness", k3=1e8)
    damper, right, left = along(model, u, v, time, touched)
    np.testing.assert_allclose(damper, 36e3 * u + 1.1e3 * v + 1e8 * u**3, rtol=1e-12, atol=1e-9)
    push = 510e3 * (u - 0.002) + 900.0 * v
    np.testing.assert_allclose(right, np.where(u > 0.002, push, 0.0), rtol=1e-12, atol=1e-9)
    pull = 510e3 * (u + 0.002) + 900.0 * v
    np.testing.assert_allclose(left, np.where(u < -0.002, pull, 0.0), rtol=1e-12, atol=1e-9)
