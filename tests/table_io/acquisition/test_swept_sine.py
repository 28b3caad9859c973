"""Swept sine on the simulated table: level, sweep rate, notch, limits, faults, always to rest.

The level is checked from the raw samples by the lines of this file alone.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from scipy.signal import hilbert

from table_io.acquisition.session import OperatorCommand
from table_io.block import Float1D, Label
from table_io.clock import ManualClock
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.errors import InputError
from table_io.records import Event, SweepLevel, Trip
from table_io.safety.preflight import check_limits, compute_demands
from tests.builders.profiles import make_history_profile
from tests.builders.rigs import SECOND_ACC, TEMPERATURE, make_faulty_rig, make_lab_rig, read_rig
from tests.builders.sessions import PlayedSession, play_session

GRAVITY_M_S2 = 9.80665
SPECIMEN = {"mass_kg": 550.0, "gap_mm": math.inf}
SWEEP = {
    "kind": "swept_sine",
    "start_hz": 1.5,
    "stop_hz": 4.0,
    "octaves_per_min": 6.0,
    "acceleration_g": 0.05,
    "directions": ["forward"],
}


def make_swept_profile(
    tables: dict[str, Any] | None = None, rate_hz: float = 1000.0, **sweep: Any
) -> Profile:
    raw = {
        "title": "swept",
        "specimen": SPECIMEN,
        "acquisition": {"rate_hz": rate_hz},
        "excitation": SWEEP | sweep,
    }
    return Profile.model_validate(raw | (tables or {}))


def find_cycles(played: PlayedSession) -> list[tuple[int, int]]:
    """Return the samples (first, end) of each cycle of the sweep, by zeros of the command."""
    command, moving = played.command_m, played.block.label == Label.MEASURE
    rises = np.flatnonzero((command[:-1] < 0) & (command[1:] >= 0) & moving[1:] & moving[:-1]) + 1
    return [(int(a), int(b)) for a, b in pairwise(rises) if b - a < played.block.rate_hz]


def measure_cycles(played: PlayedSession, channel: str) -> tuple[Float1D, Float1D, Float1D]:
    """Return (frequency in Hz, amplitude, middle in s) of each cycle, from the samples alone."""
    values, rate_hz = played.block.channel(channel), played.block.rate_hz
    rows = []
    for first, end in find_cycles(played):
        turn = np.exp(-2j * math.pi * np.arange(end - first) / (end - first))
        rows.append(
            (
                rate_hz / (end - first),
                2.0 * abs(np.mean(values[first:end] * turn)),
                0.5 * (first + end) / rate_hz,
            )
        )
    return tuple(np.array(rows).T)


def assert_smooth_rest(played: PlayedSession, planned_m_s2: float = 0.0) -> None:
    """The command ends at rest, and no stop accelerates more than 1.3 of what was planned."""
    rate_hz, command = played.block.rate_hz, played.command_m
    trips = played.select(Trip)
    (stop,) = (event.index for event in played.select_events("stop"))
    smooth = np.convolve(command, np.ones(9) / 9.0, "valid")  # over the steps of the converter
    acceleration = np.abs(np.diff(smooth[::4], 2)) * (rate_hz / 4.0) ** 2
    before = max(acceleration[: stop // 4].max(), planned_m_s2)
    assert acceleration[stop // 4 :].max() < 1.3 * before
    assert np.abs(command[-50:]).max() < 2e-6
    assert played.stop.verdict == "aborted"
    assert trips
    assert played.select_events("state")[-1].text == "at rest"


@pytest.fixture(scope="module")
def swept() -> PlayedSession:
    return play_session(make_swept_profile(directions=["forward", "backward"]), joins_blocks=True)


def test_level_of_raw_samples_within_tolerance(swept: PlayedSession) -> None:
    hz, level, _ = measure_cycles(swept, "table_acc_m_s2")
    inside = (hz > 1.55) & (hz < 3.95)
    assert inside.sum() > 50
    assert np.abs(level[inside] / (0.05 * GRAVITY_M_S2) - 1.0).max() < 0.05


def test_sweep_levels_are_those_of_the_samples(swept: PlayedSession) -> None:
    hz, level, middle_s = measure_cycles(swept, "table_acc_m_s2")
    for entry in swept.select(SweepLevel)[9:-2:7]:
        at_s = (entry.index - entry.index % 1) / 1000.0 - 1.0 / entry.frequency_hz
        near = np.abs(middle_s - at_s) < 1.0 / entry.frequency_hz
        assert entry.measured_m_s2 == pytest.approx(level[near].mean(), rel=0.02)
        assert entry.frequency_hz == pytest.approx(hz[near].mean(), rel=0.02)


def test_frequency_moves_by_octaves_a_minute(swept: PlayedSession) -> None:
    hz, _, middle_s = measure_cycles(swept, "table_acc_m_s2")
    top = int(np.argmax(hz))
    for part, sign in ((slice(None, top), 1.0), (slice(top, None), -1.0)):
        inside = (hz[part] > 1.7) & (hz[part] < 3.6)
        slope = np.polyfit(middle_s[part][inside], np.log2(hz[part][inside]), 1)[0]
        assert 60.0 * slope == pytest.approx(sign * 6.0, rel=0.02)


def test_blocks_change_no_sample_of_a_sweep(swept: PlayedSession) -> None:
    other = play_session(
        make_swept_profile(
            {"acquisition": {"rate_hz": 1000.0, "block_samples": 7}},
            directions=["forward", "backward"],
        )
    )
    count = min(swept.command_m.size, other.command_m.size)
    assert swept.command_m[:count].tobytes() == other.command_m[:count].tobytes()
    assert swept.select(SweepLevel) == other.select(SweepLevel)


def test_sound_sweep_raises_no_alarm(swept: PlayedSession) -> None:
    assert swept.stop.verdict == "complete"
    kinds = {event.kind for event in swept.select(Event)}
    assert not kinds & {"alarm", "sensor", "late", "level"}
    assert not swept.select(Trip)


def test_displacement_below_the_crossover() -> None:
    profile = make_swept_profile(acceleration_g=0.1, displacement_mm=3.0)
    played = play_session(profile, joins_blocks=True)
    hz, mm, _ = measure_cycles(played, "table_disp_m")
    crossover = math.sqrt(0.1 * GRAVITY_M_S2 / 3e-3) / math.tau
    low = (hz > 1.55) & (hz < 0.95 * crossover)
    assert 1e3 * mm[low] == pytest.approx(3.0, rel=0.05)
    high = (hz > 1.05 * crossover) & (hz < 3.95)
    level = mm[high] * (math.tau * hz[high]) ** 2
    assert level == pytest.approx(0.1 * GRAVITY_M_S2, rel=0.06)
    assert profile.swept_sine is not None
    assert profile.swept_sine.crossover_hz == pytest.approx(crossover)


def test_maximum_of_two_control_channels_is_held() -> None:
    names = ("table_acc_m_s2", "mass_acc_m_s2")
    played = play_session(
        make_swept_profile(
            strategy="maximum",
            control_channels=names,
            start_hz=1.6,
            stop_hz=2.2,
            octaves_per_min=1.0,
        ),
        joins_blocks=True,
    )
    hz, table, _ = measure_cycles(played, names[0])
    _, mass, _ = measure_cycles(played, names[1])
    inside = (hz > 1.62) & (hz < 2.18)
    largest = np.maximum(table, mass)[inside] / (0.05 * GRAVITY_M_S2)
    assert np.abs(largest - 1.0).max() < 0.1
    assert (mass > table)[inside].any()


def test_notch_keeps_the_limited_channel() -> None:
    limit = {"channel": "mass_acc_m_s2", "limit": 0.09, "unit": "g", "action": "notch"}
    played = play_session(
        make_swept_profile({"limits": [limit]}, start_hz=0.8, stop_hz=2.5, octaves_per_min=2.0),
        joins_blocks=True,
    )
    assert played.stop.verdict == "complete"
    hz, mass, _ = measure_cycles(played, "mass_acc_m_s2")
    _, table, _ = measure_cycles(played, "table_acc_m_s2")
    assert (mass[hz > 0.85] / (0.09 * GRAVITY_M_S2)).max() < 1.03
    assert (table / (0.05 * GRAVITY_M_S2))[(hz > 1.2) & (hz < 1.4)].max() < 0.75  # it is notched
    assert (table / (0.05 * GRAVITY_M_S2))[hz > 2.2] == pytest.approx(
        1.0, abs=0.05
    )  # and opens again
    limited = [entry.limited_by for entry in played.select(SweepLevel)]
    assert {*limited} == {"", "mass_acc_m_s2"}


@pytest.mark.parametrize("rate_hz", [1000.0, 2000.0, 4000.0])
@pytest.mark.parametrize("kind", ["swept_sine", "stepped_sine", "record"])
def test_limit_stops_within_two_blocks(kind: str, rate_hz: float) -> None:
    tables: dict[str, Any] = {
        "acquisition": {"rate_hz": rate_hz},
        "limits": ({"channel": "mass_acc_m_s2", "limit": 0.3},),
        "loop_check": {"enabled": False},
    }
    if kind == "swept_sine":
        profile = make_swept_profile(tables)
    elif kind == "stepped_sine":
        sweep = {"start_hz": 1.5, "stop_hz": 2.0, "step_hz": 0.5, "cycles": 4}
        profile = Profile.model_validate(
            {"title": "s", "specimen": SPECIMEN, "sweep": sweep, **tables}
        )
    else:
        profile = make_history_profile(
            "random", low_hz=1.0, high_hz=4.0, rms_g=0.05, duration_s=20.0
        )
        profile = Profile.model_validate({**profile.model_dump(), **tables})
    played = play_session(profile)
    (trip,) = played.select(Trip)
    assert (trip.kind, trip.channel) == ("limit", "mass_acc_m_s2")
    mass = np.abs(played.block.channel("mass_acc_m_s2"))
    medians = np.median(np.lib.stride_tricks.sliding_window_view(mass, 3), axis=1)
    first = int(np.flatnonzero(medians > 0.3)[0]) + 2
    assert trip.index == first
    assert trip.decided - first <= 2 * profile.acquisition.block_samples
    assert_smooth_rest(played, profile.plan.level_m_s2)


def test_limit_warns_once_an_episode_and_goes_on() -> None:
    limit = {"channel": "mass_acc_m_s2", "limit": 0.3, "action": "warn"}
    played = play_session(make_swept_profile({"limits": [limit]}, stop_hz=2.5), joins_blocks=True)
    alarms = [event for event in played.select(Event) if event.kind == "alarm"]
    assert len(alarms) == 1
    assert "exceeds the limit of the test" in alarms[0].text
    assert played.stop.verdict == "complete"


def test_limit_of_a_channel_of_the_laboratory_stops_and_notches() -> None:
    rig = make_lab_rig()
    warm = {"channel": TEMPERATURE, "limit": 20.0}
    played = play_session(make_swept_profile({"limits": [warm]}), rig=rig)
    assert played.stop.verdict == "aborted"
    assert TEMPERATURE in played.stop.reason
    assert np.abs(played.command_m).max() < 2e-6  # it is too warm before anything moves
    notch = {"channel": SECOND_ACC, "limit": 0.09, "unit": "g", "action": "notch"}
    profile = make_swept_profile({"limits": [notch]}, stop_hz=2.5, octaves_per_min=2.0)
    played = play_session(profile, rig=rig, joins_blocks=True)
    hz, second, _ = measure_cycles(played, SECOND_ACC)
    assert (second[hz > 1.55] / (0.09 * GRAVITY_M_S2)).max() < 1.03
    assert SECOND_ACC in {entry.limited_by for entry in played.select(SweepLevel)}


FAULTS = {
    "reversed": {"kind": "polarity", "channel": "table_acc_m_s2", "at_s": 0.0},
    "dead": {"kind": "cable_off", "channel": "table_acc_m_s2", "at_s": 28.0},
    "saturates": {"kind": "rail", "channel": "table_acc_m_s2", "at_s": 28.0, "for_s": 0.1},
    "grows": {"kind": "gain", "channel": "table_acc_m_s2", "at_s": 28.0, "size": 1.6},
    "fades": {"kind": "gain", "channel": "table_acc_m_s2", "at_s": 28.0, "size": -0.7},
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_control_channel_aborts_smoothly(fault: str) -> None:
    played = play_session(make_swept_profile(), rig=make_faulty_rig([FAULTS[fault]]))
    assert played.stop.verdict == "aborted"
    level = 0.05 * GRAVITY_M_S2
    moving = played.block.step >= 0
    if fault == "reversed":
        assert "polarity" in played.stop.reason
        assert not moving.any()
        return
    assert moving.any()
    assert_smooth_rest(played)
    # What the table did, by its displacement, is never beyond the abort line.
    hz, disp, _ = measure_cycles(played, "table_disp_m")
    assert (disp * (math.tau * hz) ** 2).max() < 2.0 * level


def test_dead_channel_that_is_not_the_table_aborts() -> None:
    fault = {"kind": "stuck", "channel": "mass_acc_m_s2", "at_s": 28.0}
    profile = make_swept_profile(
        {"protection": {"sensor": "warn"}}, control_channels=["table_acc_m_s2", "mass_acc_m_s2"]
    )
    played = play_session(profile, rig=make_faulty_rig([fault]))
    assert_smooth_rest(played)


def test_resonance_faster_than_the_compressor_stops_at_the_abort_line() -> None:
    profile = make_swept_profile(
        control_channels=["mass_acc_m_s2"], start_hz=0.8, octaves_per_min=6.0, compression=0.02
    )
    played = play_session(profile)
    (trip,) = played.select(Trip)
    assert (trip.kind, trip.channel) == ("level", "mass_acc_m_s2")
    assert_smooth_rest(played)
    _, mass, _ = measure_cycles(played, "mass_acc_m_s2")
    assert 1.9 < mass.max() / (0.05 * GRAVITY_M_S2) < 2.6  # within three checks of half a cycle


def test_dwell_at_the_resonance_found() -> None:
    played = play_session(
        make_swept_profile(
            start_hz=0.8,
            stop_hz=2.5,
            dwell_s=6.0,
            octaves_per_min=2.0,
            directions=["forward", "backward"],
        ),
        joins_blocks=True,
    )
    natural_hz = math.sqrt(36e3 / 550.0) / math.tau
    dwell = played.block.step == played.block.step.max()
    cycles = [entry for entry in played.select(SweepLevel) if entry.step == played.block.step.max()]
    assert cycles[-1].frequency_hz == pytest.approx(natural_hz, rel=0.04)
    assert dwell.sum() / 1000.0 == pytest.approx(6.0 + 2.0 * 2.0 / natural_hz, abs=1.6)
    assert cycles[-1].measured_m_s2 == pytest.approx(0.05 * GRAVITY_M_S2, rel=0.03)
    assert played.stop.verdict == "complete"


def play_held(hold_s: float, resume_s: float, **sweep: Any) -> PlayedSession:
    """Play a sweep that the operator holds and resumes at these times in s."""
    clock = ManualClock()
    orders = [(hold_s, "hold"), (resume_s, "resume")]

    def operate() -> OperatorCommand | None:
        if orders and clock.now() > orders[0][0]:
            return OperatorCommand(orders.pop(0)[1], "operator")
        return None

    return play_session(make_swept_profile(**sweep), operate=operate, clock=clock)


@pytest.mark.parametrize(("order", "hold_s"), [("forward", 27.5), ("backward", 24.0)])
def test_held_sweep_stands_and_goes_on_at_its_rate(order: str, hold_s: float) -> None:
    """The frequency moves for 10 s, from 25 or 22 s on."""
    played = play_held(hold_s, hold_s + 8.0, directions=[order], octaves_per_min=9.0)
    states = [event.text for event in played.select_events("state")]
    assert states[-4:] == ["running", "holding", "running", "at rest"]
    assert played.stop.verdict == "complete"
    assert not played.select(Trip)
    first, end = find_hold(played)
    assert (end - first) / 1000.0 == pytest.approx(8.0, abs=1.5)
    phase = np.unwrap(np.angle(hilbert(played.command_m[first:end])))[500:-500]
    speed = np.diff(phase) / math.tau * 1000.0
    assert np.abs(speed / np.median(speed) - 1.0).max() < 0.03
    acceleration = np.diff(played.command_m[::4], 2) * 250.0**2
    assert np.abs(acceleration).max() < 1.15 * 0.05 * GRAVITY_M_S2
    hz, level, middle_s = measure_cycles(played, "table_acc_m_s2")
    inside = (hz > 1.55) & (hz < 3.95)
    assert np.abs(level[inside] / (0.05 * GRAVITY_M_S2) - 1.0).max() < 0.06
    later = inside & (middle_s > end / 1000.0 + 1.5)
    slope = np.polyfit(middle_s[later], np.log2(hz[later]), 1)[0]
    assert 60.0 * abs(slope) == pytest.approx(9.0, rel=0.1)


def test_held_dwell_gets_its_time_after_the_hold() -> None:
    """The dwell begins at 43 s; what is measured in it lasts for its 5 s."""
    dwelling = {"start_hz": 1.1, "stop_hz": 1.6, "dwell_s": 5.0, "octaves_per_min": 6.0}
    played = play_held(44.0, 52.0, **dwelling)
    dwell = played.block.step == played.block.step.max()
    first, end = find_hold(played)
    assert (end - first) / 1000.0 == pytest.approx(8.0, abs=1.5)
    assert dwell[first]
    assert (dwell & (played.block.label == Label.MEASURE)).sum() == pytest.approx(5000, abs=700)
    assert played.stop.verdict == "complete"


def find_hold(played: PlayedSession) -> tuple[int, int]:
    """Return the samples (first, end) of the hold, behind the event that states it."""
    (order,) = [e.index for e in played.select_events("state") if e.text == "holding"]
    held = np.flatnonzero(played.block.label == Label.SETTLE)
    held = held[held > order]
    return int(held[0]), int(held[-1]) + 1


def test_refusals_of_a_swept_sine_name_the_key() -> None:
    from table_io.sequencer.procedure import make_test_plan, nominal_drive

    notch = {"channel": "table_acc_m_s2", "limit": 1.0, "action": "notch"}
    with pytest.raises(ValueError, match="notch"):
        Profile.model_validate(
            make_history_profile("random", low_hz=1.0, high_hz=4.0, duration_s=20.0).model_dump()
            | {"limits": [notch]}
        )
    rig = read_rig("simulated")
    with pytest.raises(InputError, match=r"limits\.channel"):
        make_test_plan(
            make_swept_profile({"limits": [{"channel": "oil_degc", "limit": 60.0}]}), rig
        )
    with pytest.raises(InputError, match="control_channels"):
        make_test_plan(make_swept_profile(control_channels=["specimen_acc_top_m_s2"]), rig)
    with pytest.raises(InputError, match="response_channel"):
        make_test_plan(make_swept_profile(response_channel="mass_acc_m_s"), rig)
    fast = make_swept_profile(stop_hz=100.0)
    demands = compute_demands(nominal_drive(make_test_plan(fast, rig)), fast, rig)
    with pytest.raises(InputError, match="fewer than 20 samples per cycle"):
        check_limits(demands, fast, rig, "test")
    with pytest.raises(ValueError, match=r"the passes take .* h"):
        make_swept_profile(octaves_per_min=1e-6)
    with pytest.raises(InputError, match=r"write \[\[limits\]\]"):
        parse_toml('[limits]\nchannel = "table_acc_m_s2"\nlimit = 1.0', Profile, "test")
