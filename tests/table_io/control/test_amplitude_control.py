"""The controller on the simulated table, whose servo rolls off and whose payload pushes back."""

from functools import cache
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.session import SessionSetup, run_session
from table_io.backends import open_backend
from table_io.block import Block, Float1D
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.amplitude_control import MAX_CORRECTION, Tuning
from table_io.control.frf import evaluate_transfer
from table_io.control.order_tracking import track_harmonics
from table_io.excitation.trajectory import SineTarget
from table_io.records import FrequencyResponse, Level, Record, RunStart, Step
from table_io.units import GRAVITY_M_S2

A = 0.05 * GRAVITY_M_S2
RIG = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")[0]
RESPONSE = FrequencyResponse(0, (1.0, 3.0, 9.0), (1.0, 0.98, 0.85), (-0.06, -0.2, -0.6))


def profile(gap_mm: float, control: dict[str, Any], **sweep: Any) -> Profile:
    grid = {"cycles": 4, "measured_cycles": 3, "directions": ["forward"]}
    return Profile.model_validate(
        {
            "title": "short",
            "specimen": {"mass_kg": 550.0, "gap_mm": gap_mm},
            "sweep": {**grid, **sweep},
            "control": control,
        }
    )


def run(test: Profile) -> list[Block | Record]:
    clock = ManualClock()

    def start(tare: dict[str, float], epoch_s: float) -> RunStart:
        return RunStart(
            0, "run", "n", "table", "", "", "", 2e3, 20, RIG.channels, (), 0, tare, {}, "", "",
            epoch_s,
        )  # fmt: skip

    backend = open_backend(RIG, test, clock)
    return list(run_session(SessionSetup(test, RIG), backend, clock, start, lambda: None))


@cache
def cancelling() -> tuple[Level, ...]:
    """Looks at 2.0 and 2.4 Hz, G4: the mass hits both bumpers once a cycle."""
    test = profile(4.0, {"harmonics": True}, start_hz=2.0, stop_hz=2.4, step_hz=0.4)
    return tuple(record for record in run(test) if isinstance(record, Level))


def of_step(items: Any, step: int) -> list[Level]:
    return [level for level in items if level.step == step]


@pytest.mark.parametrize("control", [True, False])
def test_measured_cycles_are_within_2_percent_and_without_control_they_are_not(
    control: bool,
) -> None:
    """At 7 to 10 Hz, where the servo has lost a tenth; G-10, both bumpers always touched."""
    test = profile(-10.0, {"enabled": control}, start_hz=7.0, stop_hz=10.0, step_hz=1.5, cycles=10)
    errors = []
    for step, amplitude in measure_levels(run(test)).items():
        errors.append(abs(amplitude / A - 1.0))
        assert step in (0, 1, 2)
    assert len(errors) == 3
    if control:
        assert max(errors) <= 0.02
    else:
        assert max(errors) > 0.05


def measure_levels(items: list[Block | Record]) -> dict[int, float]:
    """Fundamental of the table's acceleration over the measured cycles of each step, m/s2."""
    values: dict[int, list[Float1D]] = {}
    phases: dict[int, list[Float1D]] = {}
    frequency = {0: 7.0, 1: 8.5, 2: 10.0}
    for block in items:
        if isinstance(block, Block):
            for step in set(block.step[block.label == 3].tolist()):
                at = (block.step == step) & (block.label == 3)
                values.setdefault(step, []).append(block.channel("table_acc_m_s2")[at])
                phases.setdefault(step, []).append(block.time_s[at] * frequency[step])
    return {
        step: track_harmonics(
            np.concatenate(values[step]), np.concatenate(phases[step])
        ).fundamental
        for step in values
    }


@pytest.mark.parametrize("step", [0, 1])
def test_harmonics_fall_by_10_db_in_at_most_five_updates(step: int) -> None:
    looks = of_step(cancelling(), step)
    first, last = (np.linalg.norm(level.harmonics_m_s2) for level in (looks[0], looks[-1]))
    assert first > 0.01 * A  # there is something to cancel
    assert 20 * np.log10(last / first) <= -10.0
    assert looks[-1].update <= 5
    assert looks[-1].accepted
    assert all(abs(level.measured_m_s2 / A - 1.0) <= 0.02 for level in looks)


def test_prediction_begins_with_the_identified_response() -> None:
    aim = Tuning(RESPONSE).predict_target(Step(0, "forward", 9.0, A))
    assert aim.correction == pytest.approx(1 / abs(evaluate_transfer(RESPONSE, 9.0)))
    assert aim.correction == pytest.approx(1 / 0.85, rel=1e-6)


def test_prediction_follows_the_nearest_step_and_remembers_each_frequency() -> None:
    tuning = (
        Tuning(RESPONSE)
        .add_accepted(SineTarget(3.0, A, 1.10))
        .add_accepted(SineTarget(3.2, A, 1.20))
    )
    inverse = [1 / abs(evaluate_transfer(RESPONSE, f)) for f in (3.2, 3.4)]
    ahead = tuning.predict_target(Step(2, "forward", 3.4, A))
    assert ahead.correction == pytest.approx(1.20 * inverse[1] / inverse[0])
    assert tuning.predict_target(Step(3, "backward", 3.0, A)).correction == 1.10
    again = tuning.add_accepted(SineTarget(3.0, A, 1.15))
    assert again.predict_target(Step(3, "backward", 3.0, A)).correction == 1.15
    assert Tuning().predict_target(Step(0, "forward", 3.0, A)) == SineTarget(3.0, A)


def test_a_prediction_stays_within_its_bounds() -> None:
    weak = FrequencyResponse(0, (1.0,), (0.1,), (0.0,))
    assert Tuning(weak).predict_target(Step(0, "forward", 1.0, A)).correction == MAX_CORRECTION
