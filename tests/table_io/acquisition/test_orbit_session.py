"""Continuation on the simulated table: unstable orbits held, lost ones found again, refusals."""

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.external_control import plan_open_loop_drive
from table_io.acquisition.session import OperatorCommand
from table_io.adaptive.continuation import OrbitMeasurement
from table_io.block import Block
from table_io.config.excitation.waveform import smoothstep
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.orbit_feedback import advance_feedback
from table_io.records import Event, OrbitPoint, RunStop
from table_io.safety.preflight import compute_demands
from table_io.sequencer import orbits, procedure, releases
from table_io.sim.plant import Plant
from tests.builders.profiles import make_history_profile
from tests.builders.rigs import RIG
from tests.builders.sessions import PlayedSession, play_session
from tests.input_errors import raises_input_error
from tests.studies.held_orbits import play, read
from tests.table_io.sim.plant_orbits import trace_orbits

PLAN = json.loads(Path(__file__).with_name("unstable_orbits.json").read_text(encoding="utf-8"))
RATE_HZ = 2000.0
MULTIPLIER_PERIODS = 64  # twice the default: two orbits, both of which are to have one
# Of the simulated plant itself with payload reaction (`plant_orbits.py`): f in Hz, |U_1| in mm,
# largest Floquet multiplier.
TRUE_ORBITS = np.array(
    [
        [2.87062, 2.2437, 6.6897], [2.89925, 2.2917, 6.6305], [2.92184, 2.3286, 6.5050],
        [2.95100, 2.3754, 6.2902], [2.98116, 2.4236, 6.0370],
    ]
)  # fmt: skip


def make_profile(
    points: slice = slice(None),
    latency_s: float = 0.046,
    planned: dict[str, Any] | None = None,
    **keys: Any,
) -> Profile:
    """Return the profile of some points of the plan, or of one `planned` orbit."""
    orbits = PLAN["points"][points] if planned is None else [planned]
    plan = PLAN | {"points": orbits, "latency_s": latency_s}
    excitation = {
        "start_hz": 2.85,
        "stop_hz": 3.0,
        "file": "orbits.json",
        "files": {"orbits.json": json.dumps(plan)},
    }
    return make_history_profile("continuation", **excitation | keys)


@pytest.fixture(scope="module")
def held_orbits() -> PlayedSession:
    return play_session(make_profile(multiplier_periods=MULTIPLIER_PERIODS))


def test_unstable_orbits_are_held_without_feedback_left(held_orbits: PlayedSession) -> None:
    points = held_orbits.select(OrbitPoint)
    assert [(point.step, point.accepted, point.reason) for point in points] == [
        (0, True, ""),
        (1, True, ""),
    ]
    for point in points:
        assert point.feedback_size_m <= 0.003 * point.command_m
        assert not point.stable
        assert point.acceleration_m_s2 == pytest.approx(0.49033, rel=0.006)
        assert point.periods <= 150 + MULTIPLIER_PERIODS
    assert held_orbits.select(RunStop)[0].verdict == "complete"


def test_orbit_is_accepted_at_the_noise_that_its_feedback_has() -> None:
    """The loop passes about twice the noise that white noise of the laser alone would explain."""
    noisy = play_session(make_profile(slice(1), multiplier_periods=0, tolerance=1e-4))
    (point,) = noisy.select(OrbitPoint)
    assert point.accepted
    assert 1e-4 * point.command_m < point.feedback_size_m <= 1.5 * point.noise_m
    true_mm = np.interp(point.frequency_hz, *TRUE_ORBITS[:, :2].T)
    assert 1e3 * math.hypot(*point.u_m[2:4]) == pytest.approx(true_mm, rel=0.002)


def test_latency_of_the_feedback_is_stated(held_orbits: PlayedSession) -> None:
    (event,) = [event for event in held_orbits.select(Event) if event.kind == "feedback"]
    measured_ms = float(event.text.split()[3])
    assert measured_ms == pytest.approx(45.0, abs=2.0)  # 30 ms to the command, 15 ms of servo


def test_true_orbits_are_those_by_shooting_on_the_plant() -> None:
    plant = Plant(550.0, 36e3, 1100.0, 510e3, 900.0, 2e-3, 2e-3, 2000.0, 20.0, 0.0, True, RATE_HZ)
    orbits = trace_orbits(plant, 0.05 * 9.80665, 2.2e-3, 2.46e-3, start_hz=3.0)
    by_shooting = [(o.frequency_hz, 1e3 * o.fundamental_m, abs(o.multiplier)) for o in orbits]
    frequencies_hz, amplitudes_mm, multipliers = np.array(by_shooting).T
    true_mm = np.interp(TRUE_ORBITS[:, 0], frequencies_hz, amplitudes_mm)
    assert true_mm == pytest.approx(TRUE_ORBITS[:, 1], rel=2e-4)
    true = np.interp(TRUE_ORBITS[:, 0], frequencies_hz, multipliers)
    assert true == pytest.approx(TRUE_ORBITS[:, 2], rel=2e-3)


def test_measured_orbits_are_those_of_the_plant(held_orbits: PlayedSession) -> None:
    for point in held_orbits.select(OrbitPoint):
        true_mm = np.interp(point.frequency_hz, *TRUE_ORBITS[:, :2].T)
        # 3e-4 with what the feedback left moves u by
        assert 1e3 * math.hypot(*point.u_m[2:4]) == pytest.approx(true_mm, rel=5e-4)
        assert point.amplitude_m > math.hypot(*point.u_m[2:4])


def test_where_the_table_stands_is_no_part_of_an_orbit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A plan whose mean of u is off by 30 um shifts table and mass alike: no fault, no change."""
    measured: list[OrbitMeasurement] = []
    find_fault = orbits._find_fault

    def record(*arguments: Any) -> str:
        measured.append(arguments[2])
        return find_fault(*arguments)

    monkeypatch.setattr(orbits, "_find_fault", record)
    planned = dict(PLAN["points"][0])
    (mean_m, _), *others = planned["u_m"]
    planned["u_m"] = [[mean_m + 3e-5, 0.0], *others]
    play_session(make_profile(planned=planned, multiplier_periods=0))
    assert [abs(each.x[0] - each.u[0]) < 3e-6 for each in measured] == [True] * len(measured)


def test_measured_multipliers_are_those_of_the_plant(held_orbits: PlayedSession) -> None:
    for point in held_orbits.select(OrbitPoint):
        true = np.interp(point.frequency_hz, *TRUE_ORBITS[:, ::2].T)
        assert point.multiplier_sd is not None
        assert point.multiplier_sd < 0.15 * true
        assert abs(point.multiplier - true) < 3.0 * point.multiplier_sd


def measure_peak_acceleration(command_m: np.ndarray) -> float:
    """Return the peak of the second difference, smoothed twice over 15 ms: DAC steps are 0.46 um.

    They give 2 m/s2 in a single second difference, and less than 0.01 m/s2 after that.
    """
    acceleration = np.diff(command_m, 2) * RATE_HZ**2
    for _ in range(2):
        acceleration = np.convolve(acceleration, np.ones(30) / 30, mode="valid")
    return float(np.abs(acceleration).max())


def find_stated_peak(held_orbits: PlayedSession) -> float:
    """Return the peak of the command in m/s2 that the check states, corrected as it was played."""
    profile = make_profile()
    drive = procedure.nominal_drive(procedure.make_test_plan(profile, RIG, 40))
    stated = max(row.acceleration_m_s2 for row in compute_demands(drive, profile, RIG))
    assert stated <= 1.15 * 0.49033
    correction = max(
        p.command_m * (math.tau * p.frequency_hz) ** 2 for p in held_orbits.select(OrbitPoint)
    )
    return stated * correction / 0.49033


def test_command_stays_below_the_peak_that_the_check_states_and_ends_at_rest(
    held_orbits: PlayedSession,
) -> None:
    assert (
        1.05 * 0.49
        < measure_peak_acceleration(held_orbits.command_m)
        < find_stated_peak(held_orbits)
    )
    assert np.abs(held_orbits.command_m[-200:]).max() < 1e-6


def test_stop_at_any_moment_of_hold_and_release_stays_below_the_stated_peak(
    held_orbits: PlayedSession,
) -> None:
    """A stop multiplies the command by a decay over two cycles at least, within releases too."""
    stated, worst = find_stated_peak(held_orbits), 0.0
    x = np.arange(3000) / 1400.0  # two cycles at 2.87 Hz
    decay = 1.0 - smoothstep(x)
    for at in range(round(20.0 * RATE_HZ), held_orbits.command_m.size - 5000, 211):
        part = held_orbits.command_m[at - 300 : at + 3000] * np.append(np.ones(300), decay)
        worst = max(worst, measure_peak_acceleration(part))
    assert 1.05 * 0.49 < worst < stated


def test_run_is_reproduced_to_the_bit(held_orbits: PlayedSession) -> None:
    again = play_session(make_profile(), stop_s=25.0)
    count = round(25.0 * RATE_HZ)
    assert again.command_m[:count].tobytes() == held_orbits.command_m[:count].tobytes()


@pytest.mark.slow  # 7 s
def test_lost_orbit_is_left_for_rest_and_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The feedback sees a deviation that is none, and pushes the motion off its orbit."""
    pushed = range(round(27.0 * RATE_HZ), round(29.0 * RATE_HZ))

    def push(state: Any, drive: Any, first: int, x_m: np.ndarray, *rest: int) -> Any:
        if first in pushed:
            x_m = x_m + 4e-3 * np.cos(math.tau * drive.phase(first, x_m.size))
        return advance_feedback(state, drive, first, x_m, *rest)

    monkeypatch.setattr(orbits, "advance_feedback", push)
    profile = make_profile(slice(1), max_feedback=0.3, multiplier_periods=0)
    lost = play_session(profile, stop_s=80.0)
    (event,) = [event for event in lost.select(Event) if event.kind == "lost"]
    assert_left_for_rest(lost, event)
    (point,) = lost.select(OrbitPoint)
    assert point.accepted
    assert math.isnan(point.multiplier)
    assert point.multiplier_sd is None


@pytest.mark.slow  # 20 s
def test_command_stays_below_its_stated_bound_where_an_orbit_is_lost(tmp_path: Path) -> None:
    """The correction of the block that loses the orbit is written to its end: no sample jumps."""
    test = play(read(tmp_path, "slow_clock", level=0.0585, gap=3.97, points=2))
    assert 1.0 < test.peak_ratio <= test.bound_ratio


def assert_left_for_rest(lost: PlayedSession, event: Event) -> None:
    """The command was at rest for a while within 2 s of the event."""
    after = lost.command_m[event.index : event.index + round(3.0 * RATE_HZ)]
    moving = np.flatnonzero(np.abs(after) > 1e-6)
    pauses = np.flatnonzero(np.diff(moving, append=after.size) > 0.5 * RATE_HZ)
    assert pauses.size
    assert moving[pauses[0]] < 2.0 * RATE_HZ


@pytest.mark.slow  # 8 s
def test_orbit_lost_in_a_release_is_recorded_and_the_next_one_found_from_rest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The departure is let grow for so long that the feedback cannot catch it."""
    monkeypatch.setattr(orbits, "find_departure_limit", lambda *_: math.inf)
    monkeypatch.setattr(releases, "MAX_FREE_PERIODS", 12.0)
    lost = play_session(make_profile(multiplier_periods=16), stop_s=100.0)
    events = [event for event in lost.select(Event) if event.kind == "lost"]
    assert [event.text.partition("; ")[2] for event in events] == [
        "the next one is approached from rest",
        "the test ends",
    ]
    assert_left_for_rest(lost, events[0])
    assert [(point.step, point.accepted) for point in lost.select(OrbitPoint)] == [
        (0, True),
        (1, True),
    ]
    assert lost.select(RunStop)[0].verdict == "complete"


@pytest.mark.slow  # 6 s
def test_operator_hold_in_a_release_lets_the_feedback_act_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without it the motion would leave the orbit within a second, for the rest of the hold."""
    released = []

    def spy(state: Any, block: Block) -> Any:
        state = releases.advance_releases(state, block)
        if state.search.releases.is_released:
            released.append(block.end)
        return state

    def hold() -> OperatorCommand | None:
        return OperatorCommand("hold", "") if len(released) == 50 else None

    monkeypatch.setattr(orbits, "advance_releases", spy)
    result = play_session(make_profile(slice(1)), stop_s=66.0, operate=hold)
    assert len(released) == 50
    before = result.mass_m[released[0] - 4000 : released[0]]
    after = result.mass_m[released[-1] + 4000 : released[-1] + 10_000]
    assert np.ptp(after) == pytest.approx(np.ptp(before), rel=0.03)


def test_operator_stops_a_held_orbit(held_orbits: PlayedSession) -> None:
    stopped = play_session(make_profile(), stop_s=24.0)
    assert stopped.select(RunStop)[0].verdict == "stopped"
    assert stopped.command_m.size < 27.0 * RATE_HZ
    assert np.abs(stopped.command_m[-200:]).max() < 1e-6


def test_plan_for_a_shorter_latency_is_refused_before_the_orbits() -> None:
    refused = play_session(make_profile(latency_s=0.031, table_lag_ms=1.0))
    assert refused.select(RunStop)[0].verdict == "aborted"
    assert "table_response.lag_ms = 1" in refused.select(RunStop)[0].reason
    assert not refused.select(OrbitPoint)
    assert np.abs(refused.command_m).max() < 2e-4  # the loop check only


def list_refusals() -> Iterator[Any]:
    without_mass = RIG.model_copy(
        update={"sensors": tuple(s for s in RIG.sensors if s.channel != "mass_disp_m")}
    )
    yield pytest.param(make_profile(latency_s=0.02), RIG, "latency_s", id="horizon")
    yield pytest.param(make_profile(), without_mass, "sensors", id="sensors")
    yield pytest.param(make_profile(file=None), RIG, "excitation.file", id="no plan")


@pytest.mark.parametrize("profile, rig, key", list(list_refusals()))
def test_refused_before_motion(profile: Profile, rig: RigConfig, key: str) -> None:
    with raises_input_error(key=key):
        procedure.make_test_plan(profile, rig, 40)


def test_external_controller_cannot_hold_orbits() -> None:
    with raises_input_error(key="excitation.kind"):
        plan_open_loop_drive(make_profile(), RIG)


def test_nominal_drive_holds_the_first_orbit() -> None:
    profile = make_profile()
    drive = procedure.nominal_drive(procedure.make_test_plan(profile, RIG, 40))
    assert {segment.step for segment in drive.sine_segments} == {-1, 0}
    assert replace(drive.steps[1]) == profile.steps[1]


def test_model_that_departs_too_far_ends_the_test_at_its_first_orbit() -> None:
    """The plan's orbit has twice the amplitude of the specimen's."""
    orbit = PLAN["points"][0]
    doubled = orbit | {"u_m": (2.0 * np.array(orbit["u_m"])).tolist()}
    far = play_session(make_profile(planned=doubled, retries=0), stop_s=60.0)
    stop = far.select(RunStop)[0]
    assert stop.verdict == "aborted"
    assert "no orbit can be held" in stop.reason
    assert "identify the model" in stop.reason
    assert not any(point.accepted for point in far.select(OrbitPoint))
    assert np.abs(far.command_m[-200:]).max() < 1e-6
