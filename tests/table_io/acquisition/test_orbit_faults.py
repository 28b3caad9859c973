"""Faults while the feedback holds an orbit: trip, underrun, late or lost samples, a dead rig."""

import math
from itertools import takewhile
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.session import SessionSetup, run_session
from table_io.backends import open_backend
from table_io.block import Block, Float1D
from table_io.clock import ManualClock
from table_io.config.rig import RigConfig
from table_io.records import Event, RunStop, Trip
from table_io.safety import loop_check
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.rigs import RIG, make_faulty_rig
from tests.builders.sessions import PlayedSession, make_start, play_session
from tests.table_io.acquisition.test_orbit_session import RATE_HZ, make_profile

CAPTURE_S, HELD_S = 10.5, 25.0  # of the first orbit; its feedback is large, then small
MAX_REST_S = 2.0  # from a fault to rest
LEVEL_M_S2 = 0.4903
# Of the level: itself, the feedback at its limit of half the command, and a change of it.
MAX_ACCELERATION = 1.0 + 0.5 + 1.0
NO_COMMAND_M = 1e-6
TIMES = pytest.mark.parametrize(
    "fault_s", [CAPTURE_S, pytest.param(HELD_S, marks=pytest.mark.slow)]
)


def plant_fault(kind: str, at_s: float, **keys: float | str) -> RigConfig:
    return make_faulty_rig([{"kind": kind, "at_s": at_s, **keys}])


def assert_rests_smoothly(command_m: Float1D, fault_s: float) -> None:
    """The command is at rest MAX_REST_S after a fault, and nowhere jumps on the way."""
    first = round(fault_s * RATE_HZ)
    assert np.abs(command_m[:first]).max() > 1e-4  # it did move
    moving = np.flatnonzero(np.abs(command_m) > NO_COMMAND_M)
    assert moving[-1] < first + MAX_REST_S * RATE_HZ
    assert moving[-1] < command_m.size - 50
    # Over 40 samples, as the converter has steps of 0.46 um: 2 m/s2 in a second difference.
    acceleration = np.convolve(np.diff(command_m, 2), np.ones(40) / 40, "valid") * RATE_HZ**2
    assert np.abs(acceleration[first - 100 :]).max() < MAX_ACCELERATION * LEVEL_M_S2


def assert_recorded(result: PlayedSession) -> None:
    """Every sample up to the end was delivered."""
    assert result.select(RunStop)[0].index == result.command_m.size


@TIMES
@pytest.mark.parametrize(
    ("kind", "channel", "trip"),
    [
        ("cable_off", "table_disp_m", "following"),
        ("nan", "mass_disp_m", "lost"),
        ("stuck", "mass_disp_m", "stuck"),
        ("rail", "mass_disp_m", "rail"),
    ],
)
def test_protection_stops_a_held_orbit(kind: str, channel: str, trip: str, fault_s: float) -> None:
    """Among others where the feedback's own sensor fails, before the feedback can do harm."""
    result = play_session(
        make_profile(), fault_s + 20.0, plant_fault(kind, fault_s, channel=channel)
    )
    assert [(t.kind, t.channel) for t in result.select(Trip)] == [(trip, channel)]
    assert result.select(RunStop)[0].verdict == "aborted"
    assert_rests_smoothly(result.command_m, fault_s)
    assert_recorded(result)


@TIMES
def test_rig_that_stalls_runs_out_of_queue_and_rests(fault_s: float) -> None:
    clock = ManualClock()
    stalls = iter([3.0])

    def stall() -> None:
        if clock.now() > fault_s:
            clock.wait_until(clock.now() + next(stalls, 0.0))

    result = play_session(make_profile(), fault_s + 20.0, operate=stall, clock=clock)
    assert [trip.kind for trip in result.select(Trip)] == ["late"]
    assert result.select(RunStop)[0].verdict == "aborted"
    assert_rests_smoothly(result.command_m, fault_s)
    assert_recorded(result)


@pytest.mark.slow  # 10 s
@TIMES
def test_samples_that_come_late_do_not_lose_the_orbit(fault_s: float) -> None:
    """The feedback answers later; during the capture it fades for a while."""
    result = play_session(
        make_profile(slice(1)), fault_s + 8.0, plant_fault("late", fault_s, size=0.15)
    )
    assert any(event.kind == "late" for event in result.select(Event))
    assert not any(event.kind == "lost" for event in result.select(Event))
    assert result.select(RunStop)[0].verdict == "stopped"
    assert_rests_smoothly(result.command_m, fault_s + 8.1)
    steady = slice(round((fault_s + 4.0) * RATE_HZ), round((fault_s + 7.0) * RATE_HZ))
    undisturbed = play_session(make_profile(slice(1)), fault_s + 8.0).mass_m
    assert np.ptp(result.mass_m[steady]) == pytest.approx(np.ptp(undisturbed[steady]), rel=0.05)


def test_silent_machine_halts_the_test() -> None:
    result = play_session(make_profile(), HELD_S + 20.0, plant_fault("stall", HELD_S))
    (stop,) = result.select(RunStop)
    assert stop.verdict == "halted"
    assert_recorded(result)
    assert result.command_m.size >= HELD_S * RATE_HZ


@pytest.mark.slow  # 5 s
def test_queue_of_a_dead_rig_ends_at_rest() -> None:
    """At every tenth block, from the capture to the end of the releases at the first orbit."""
    profile, clock = make_profile(slice(1)), ManualClock()
    backend = open_backend(RIG, profile, clock)
    assert isinstance(backend, SimulatedBackend)

    session = run_session(SessionSetup(profile, RIG), backend, clock, make_start, lambda: None)
    blocks = (item for item in session if isinstance(item, Block))
    played: list[Float1D] = []
    checked = 0
    for block in takewhile(lambda b: b.end < CAPTURE_S * RATE_HZ or b.step[-1] == 0, blocks):
        played.append(block.channel("drive_disp_m"))
        if len(played) % 10 == 0 and block.end > CAPTURE_S * RATE_HZ:
            left = backend._command_between(block.end, block.end + round(3.0 * RATE_HZ))
            recent = np.concatenate([*played[-50:], left])
            assert_rests_smoothly(recent, (recent.size - left.size) / RATE_HZ)
            checked += 1
    assert checked > 300
    session.close()
    assert math.isclose(float(backend._command[-1]), 0.0, abs_tol=NO_COMMAND_M)


def test_slow_decision_is_made_once_and_the_feedback_answers_after_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The loop check takes 0.2 s to evaluate, twenty blocks; the orbit is captured all the same."""
    clock, evaluate = ManualClock(), loop_check.evaluate

    def evaluate_slowly(*arguments: Any) -> Any:
        clock.wait_until(clock.now() + 0.2)
        return evaluate(*arguments)

    monkeypatch.setattr(loop_check, "evaluate", evaluate_slowly)
    result = play_session(make_profile(slice(1)), CAPTURE_S + 2.0, clock=clock)
    assert result.select(RunStop)[0].verdict == "stopped"
    assert np.abs(result.command_m[round(CAPTURE_S * RATE_HZ) :]).max() > 1e-3
