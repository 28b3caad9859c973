"""Pre-flight margins against closed forms, and refusals that name step and limit."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.block import Float1D, Label
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.excitation.drive import Drive, HistorySegment, Segment
from table_io.excitation.trajectory import plan_excitation, plan_sweep
from table_io.records import FrequencyResponse, Step
from table_io.safety import preflight
from table_io.safety.preflight import (
    CORRECTION_HEADROOM,
    StepDemand,
    check_corrected_drive,
    check_limits,
    compute_demands,
    list_drive_warnings,
    list_limits,
    list_setup_warnings,
)
from table_io.sequencer import make_test_plan, nominal_drive
from table_io.units import GRAVITY_M_S2

RIG = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")[0]
A = 0.05 * GRAVITY_M_S2
LAW = settings(max_examples=10, derandomize=True)


def rig(table: str = "limits", **changes: float) -> RigConfig:
    """The machine card with other values in one of its tables."""
    raw = RIG.model_dump()
    raw[table].update(changes)
    return RigConfig.model_validate(raw)


def profile(start_hz: float = 0.5, stop_hz: float = 10.0, **tables: Any) -> Profile:
    """A test of two steps, up and down, with other tables."""
    sweep = {"start_hz": start_hz, "stop_hz": stop_hz, "step_hz": stop_hz - start_hz, "cycles": 3}
    specimen = {"mass_kg": 550.0, "gap_mm": 4.0}
    return Profile.model_validate(
        {"title": "limits", "specimen": specimen, "sweep": sweep} | tables
    )


def rows(test: Profile, card: RigConfig = RIG) -> tuple[StepDemand, ...]:
    return compute_demands(plan_sweep(test), test, card)


SLOWEST = "step 0 (0.5 Hz forward)"


def list_faults(test: Profile, card: RigConfig) -> tuple[InputError, ...]:
    """The faults of a test that is refused as a whole."""
    with pytest.raises(InputError) as caught:
        check_limits(rows(test, card), test, card, "a.toml")
    assert caught.value.where == "a.toml"
    return caught.value.faults


def stated_number(fault: InputError) -> float:
    """The quantity that a fault states, in its unit."""
    return float(fault.problem.split()[0])


def test_margins_agree_with_closed_forms() -> None:
    first, second, third, fourth = rows(profile(1.0, 5.0))
    assert [row.step for row in (first, second, third, fourth)] == [0, 1, 2, 3]
    assert [row.direction for row in (first, fourth)] == ["forward", "backward"]
    w = 2 * math.pi * 1.0
    for row in (first, fourth):  # the largest of held cycles and blends: never less than held
        assert row.displacement_m == pytest.approx(A / w**2, rel=2e-3)
        assert A / w * 0.9999 <= row.velocity_m_s <= 1.05 * A / w
        assert A * 0.9999 <= row.acceleration_m_s2 <= 1.05 * A
        assert row.force_n == pytest.approx((2000.0 + 550.0) * row.acceleration_m_s2)
        assert row.amplitude_lsb == pytest.approx(A / w**2 / (0.12 / 2**18))
    # The turn repeats 5 Hz without a blend, so its margins are those of held cycles alone.
    w = 2 * math.pi * 5.0
    assert third.displacement_m == pytest.approx(A / w**2, rel=1e-3)
    assert third.velocity_m_s == pytest.approx(A / w, rel=1e-3)
    assert third.acceleration_m_s2 == pytest.approx(A, rel=1e-3)


def test_a_16_bit_output_of_100_mm_has_41_steps_left_at_10_hz() -> None:
    card = rig("output", span_mm=100.0, bits=16, least_lsb=1)
    row = rows(profile(), card)[1]
    held_mm = 1e3 * A / (2 * math.pi * 10.0) ** 2
    assert held_mm == pytest.approx(0.124, abs=5e-4)
    assert card.output.lsb_m == pytest.approx(200e-3 / 65536)
    assert row.amplitude_lsb == pytest.approx(held_mm * 1e-3 / (200e-3 / 65536))
    assert round(row.amplitude_lsb) == 41
    (warning,) = list_drive_warnings(rows(profile(), card), card)
    assert "2 steps have an amplitude below 100 DAC steps (least: 41 at 10 Hz)" in warning
    assert list_drive_warnings(rows(profile()), RIG) == []


@pytest.mark.parametrize(
    ("table", "changes", "where", "key", "number", "allowed"),
    [
        ("limits", {"stroke_mm": 40.0}, SLOWEST, "displacement", 49.67, "at most 40 mm"),
        ("output", {"span_mm": 45.0}, SLOWEST, "displacement", 49.67, "at most 45 mm"),
        ("limits", {"velocity_mm_s": 100.0}, SLOWEST, "velocity", 156.1, "at most 100 mm/s"),
        ("limits", {"acceleration_g": 0.04}, SLOWEST, "acceleration", 0.05, "at most 0.04 g"),
        ("limits", {"force_kn": 1.0}, SLOWEST, "force", 1.27, "at most 1 kN"),
        ("output", {"bits": 12}, "step 1 (10 Hz)", "amplitude", 4.2, "at least 20"),
    ],
    ids=["stroke", "span", "velocity", "acceleration", "force", "resolution"],
)
def test_a_refusal_names_the_step_and_the_limit(
    table: str, changes: dict[str, float], where: str, key: str, number: float, allowed: str
) -> None:
    (fault,) = list_faults(profile(), rig(table, **changes))
    assert (fault.where.split(" and ")[0], fault.key, fault.allowed) == (where, key, allowed)
    assert stated_number(fault) == pytest.approx(number, rel=0.05)


def test_a_frequency_beyond_the_limit_is_refused() -> None:
    (fault,) = list_faults(profile(), rig(frequency_hz=9.0))
    assert (fault.key, fault.value, fault.allowed) == ("sweep.stop_hz", 10.0, "at most 9")


def test_a_rate_that_the_card_does_not_have_is_refused() -> None:
    (fault,) = list_faults(profile(acquisition={"rate_hz": 1500.0}), RIG)
    assert (fault.key, fault.value) == ("acquisition.rate_hz", 1500.0)
    assert fault.allowed == "1000, 2000, 4000"


def test_all_limits_that_are_exceeded_stand_in_one_refusal() -> None:
    card = rig(stroke_mm=1.0, velocity_mm_s=1.0, acceleration_g=0.01, force_kn=0.1)
    faults = list_faults(profile(acquisition={"rate_hz": 1500.0}), card)
    assert len(faults) == 5


def test_what_is_just_allowed_is_not_refused() -> None:
    asked = rows(profile())
    card = rig(
        stroke_mm=max(row.displacement_m for row in asked) * 1e3 * (1 + 1e-9),
        force_kn=max(row.force_n for row in asked) * 1e-3 * (1 + 1e-9),
    )
    check_limits(rows(profile(), card), profile(), card, "a.toml")


def with_check(test: Profile, card: RigConfig = RIG) -> tuple[StepDemand, ...]:
    """Margins of the drive as it is played, loop check and tuning included."""
    return compute_demands(nominal_drive(make_test_plan(test, card)), test, card)


def test_the_loop_check_has_rows_of_its_own_before_the_steps() -> None:
    demands = with_check(profile())
    assert [row.step for row in demands] == [-1, -1, -1, 0, 1, 2, 3]
    assert [row.name for row in demands[:1]] == ["loop check (1 Hz)"]
    for row, f in zip(demands, (1.0, math.sqrt(10.0), 10.0), strict=False):
        assert row.frequency_hz == pytest.approx(f)
        assert row.acceleration_m_s2 == pytest.approx(0.1 * A, rel=0.06)
        assert row.amplitude_lsb == pytest.approx(
            0.1 * A / (2 * math.pi * f) ** 2 / RIG.output.lsb_m
        )
    # The first step has the frequency of the check, not its level.
    (same, *_) = with_check(profile(1.0, 10.0))
    assert same.amplitude_lsb == pytest.approx(demands[0].amplitude_lsb)
    # The smallest amplitude of the check has 27 DAC steps: neither refused nor warned of.
    assert demands[2].amplitude_lsb < RIG.output.warn_lsb
    check_limits(demands, profile(), RIG, "a.toml")
    check_limits((replace(demands[0], amplitude_lsb=5.0), *demands[1:]), profile(), RIG, "a.toml")
    assert list_drive_warnings(demands, RIG) == []


def test_a_loop_check_that_the_table_cannot_do_is_refused_by_name() -> None:
    test = profile(loop_check={"frequencies_hz": (0.05, 30.0)})
    with pytest.raises(InputError) as caught:
        check_limits(with_check(test), test, RIG, "a.toml")
    faults = {fault.key: fault for fault in caught.value.faults}
    top = faults["loop_check.frequencies_hz"]
    assert (top.value, top.allowed) == (30.0, "at most 20")
    assert faults["displacement"].where == "loop check (0.05 Hz) and 1 more"
    assert stated_number(faults["displacement"]) == pytest.approx(496.9, rel=0.01)
    assert "loop_check.level" in faults["displacement"].remedy


@pytest.mark.parametrize(
    ("channel", "full", "where", "number"),
    [
        ("table_disp_m", 40.0, "step 0 (0.5 Hz forward)", 49.67),
        ("drive_disp_m", 40.0, "step 0 (0.5 Hz forward)", 49.67),
        ("table_acc_m_s2", 0.05, "step 1 (10 Hz forward)", 0.05),
    ],
)
def test_a_sensor_of_the_table_that_would_clip_is_refused(
    channel: str, full: float, where: str, number: float
) -> None:
    sensors = [
        {**sensor.model_dump(), "range": full if sensor.channel == channel else sensor.range}
        for sensor in RIG.sensors
    ]
    card = RigConfig.model_validate(RIG.model_dump() | {"sensors": sensors})
    (fault,) = list_faults(profile(), card)
    assert (fault.where, fault.key) == (where, channel)
    assert stated_number(fault) == pytest.approx(number, rel=0.05)
    assert f"{full:g}" in fault.allowed.split()
    # What the specimen does to its sensors is not known before the test.
    mass = [
        {**sensor.model_dump(), "range": 0.1 if "mass" in sensor.channel else sensor.range}
        for sensor in RIG.sensors
    ]
    card = RigConfig.model_validate(RIG.model_dump() | {"sensors": mass})
    check_limits(rows(profile(), card), profile(), card, "a.toml")


def test_a_command_without_room_for_a_correction_is_worth_a_warning() -> None:
    asked = rows(profile())
    assert list_drive_warnings(asked, RIG) == []  # 49.7 mm of 60 mm: 20 % more are 59.6 mm
    (warning,) = list_drive_warnings(asked, rig(stroke_mm=59.0))
    assert warning.startswith("step 0 (0.5 Hz forward): 49.6")
    assert "leave no room to correct the command by 20 %" in warning


@pytest.mark.parametrize(
    ("tables", "words"),
    [
        ({"specimen": {"mass_kg": 5.5, "gap_mm": 4.0}}, "is it in kg?"),
        ({"specimen": {"mass_kg": 550e3, "gap_mm": 4.0}}, "is it in kg?"),
        ({"specimen": {"mass_kg": 550.0, "gap_mm": 4000.0}}, "is it in mm?"),
        ({"acquisition": {"block_samples": 500}}, "fewer than four blocks"),
    ],
)
def test_what_hardly_fits_the_machine_is_doubted(tables: dict[str, Any], words: str) -> None:
    (warning,) = list_setup_warnings(profile(**tables), RIG)
    assert words in warning


def test_a_plain_test_is_not_doubted() -> None:
    for gap_mm in (math.inf, 30.0, 0.0, -10.0):
        specimen = {"mass_kg": 550.0, "gap_mm": gap_mm}
        assert list_setup_warnings(profile(specimen=specimen), RIG) == []


def test_a_loop_check_that_ends_below_the_sweep_is_said() -> None:
    (warning,) = list_setup_warnings(profile(), rig("output", span_mm=100.0, bits=16))
    assert warning.startswith(
        "the loop check ends at 4.51 Hz: at 10 Hz a tenth of the level has fewer"
    )
    off = profile(loop_check={"enabled": False})
    assert list_setup_warnings(off, rig("output", span_mm=100.0, bits=16)) == []


def response(gain: float) -> FrequencyResponse:
    """A flat response up to 1 Hz that has fallen to `gain` at 10 Hz."""
    return FrequencyResponse(5, (1.0, 3.0, 10.0), (1.0, 1.0, gain), (0.0, 0.0, 0.0))


def test_the_corrected_command_is_held_against_the_card() -> None:
    steps = profile().sweep.steps
    assert check_corrected_drive(steps, response(0.9), RIG) == []
    flat = FrequencyResponse(5, (1.0,), (0.8,), (0.0,))
    (warning,) = check_corrected_drive(steps, flat, RIG)
    assert "step 0 (0.5 Hz forward) and 1 more: displacement: 62.1 mm" in warning
    assert "allowed: at most 60 mm" in warning
    assert warning.startswith("corrected for the table's response")
    # 0.05 g at 10 Hz asked of a table that gives 0.6 of it.
    (warning,) = check_corrected_drive(steps, response(0.6), rig(acceleration_g=0.08))
    assert "(10 Hz forward) and 1 more: acceleration: 0.08333 g" in warning


def test_a_correction_beyond_what_control_may_do_is_said_before_the_sweep() -> None:
    (warning,) = check_corrected_drive(profile().sweep.steps, response(0.4), RIG)
    assert warning.startswith("step 1 (10 Hz forward): the table follows with a gain of 0.4")
    assert "2.5 times as large; allowed: at most 2" in warning


HISTORIES: dict[str, dict[str, Any]] = {
    "sine_pulse": {"frequency_hz": 1.0, "acceleration_g": 0.9},
    "half_sine": {"duration_s": 0.3, "acceleration_g": 0.5},
    "chirp": {"start_hz": 0.4, "stop_hz": 5.0, "duration_s": 20.0, "acceleration_g": 0.2},
    "random": {"low_hz": 0.3, "high_hz": 10.0, "duration_s": 20.0, "rms_g": 0.3},
    "cyclic": {"protocol": [[80.0, 1.5, 3]]},
}


def history_profile(kind: str, keys: dict[str, Any]) -> Profile:
    raw = {"title": kind, "specimen": {"mass_kg": 550.0, "gap_mm": 4.0}}
    return Profile.model_validate(raw | {"excitation": {"kind": kind, **keys}})


@pytest.mark.parametrize("kind", HISTORIES)
def test_a_history_beyond_a_limit_is_refused_with_the_level_that_fits(kind: str) -> None:
    test = history_profile(kind, HISTORIES[kind])
    with pytest.raises(InputError) as caught:
        check_limits(compute_demands(plan_excitation(test), test, RIG), test, RIG, "a.toml")
    limits = {fault.key: fault for fault in caught.value.faults}
    assert {"displacement", "table_disp_m"} <= limits.keys()
    remedy = limits["displacement"].remedy
    value = float(remedy.split("by ")[1].split(",")[0] if "by " in remedy else remedy.split()[-1])
    for share, fits in ((1.0, True), (1.02, False)):
        if kind == "cyclic":
            keys = {"protocol": [[80.0 * value * share, 1.5, 3]]}
        else:
            key = type(test.excitation).LEVEL_KEY
            assert f"{key} = " in remedy
            keys = HISTORIES[kind] | {key: value * share}
        lower = history_profile(kind, keys)
        demands = compute_demands(plan_excitation(lower), lower, RIG)
        if fits:
            check_limits(demands, lower, RIG, "a.toml")
        else:
            with pytest.raises(InputError):
                check_limits(demands, lower, RIG, "a.toml")


def test_break_points_beyond_a_limit_are_to_be_multiplied() -> None:
    keys = {"start_hz": 0.4, "stop_hz": 5.0, "duration_s": 20.0}
    test = history_profile("chirp", keys | {"level_points": [[0.4, 0.2], [5.0, 0.2]]})
    with pytest.raises(InputError) as caught:
        check_limits(compute_demands(plan_excitation(test), test, RIG), test, RIG, "a.toml")
    assert caught.value.faults[0].remedy.startswith("multiply level_points by 0.")


def test_a_flow_beyond_that_of_the_valve_is_refused() -> None:
    """Q = A v: 100 cm2 at 156 mm/s are 93.7 l/min."""
    card = rig(piston_area_cm2=100.0, peak_flow_l_min=90.0)
    (fault,) = list_faults(profile(), card)
    assert (fault.where.split(" and ")[0], fault.key) == (SLOWEST, "flow")
    assert fault.allowed == "at most 90 l/min"
    assert stated_number(fault) == pytest.approx(93.7, rel=0.05)
    check_limits(
        rows(profile(), card), profile(), rig(piston_area_cm2=100.0, peak_flow_l_min=110.0), "a"
    )


@pytest.mark.parametrize("key", ["piston_area_cm2", "peak_flow_l_min"])
def test_a_flow_without_its_area_is_no_limit(key: str) -> None:
    with pytest.raises(ValueError, match="go together"):
        rig("limits", **{key: 100.0})


# Laws of the demands: what is played, differentiated


def differentiate(command_m: Float1D, rate_hz: float) -> Float1D:
    """Displacement, velocity and acceleration by central differences, without both ends."""
    before, here, after = command_m[:-2], command_m[1:-1], command_m[2:]
    speed, acceleration = 0.5 * rate_hz * (after - before), rate_hz**2 * (after - 2 * here + before)
    return np.array([here, speed, acceleration])


@pytest.mark.parametrize("rate_hz", [1000.0, 4000.0])
@pytest.mark.parametrize("stop_hz", [0.7, 5.0])
def test_the_demands_of_a_step_are_those_of_its_command_as_played(
    stop_hz: float, rate_hz: float
) -> None:
    """Held cycles and blends of all steps; the ramp to rest belongs to the last one."""
    test = profile(0.5, stop_hz, acquisition={"rate_hz": rate_hz})
    drive = plan_sweep(test)
    motion = differentiate(drive.command(-1, drive.planned_end + 2), rate_hz)
    demands = compute_demands(drive, test, RIG)
    assert len(demands) == 4
    for row in demands:
        parts = [
            motion[:, segment.start : segment.end]
            for segment in drive.sine_segments
            if segment.step == row.step
        ]
        expected = np.abs(np.concatenate(parts, axis=1)).max(axis=1)
        demanded = row.displacement_m, row.velocity_m_s, row.acceleration_m_s2
        assert demanded == pytest.approx(expected.tolist(), rel=3e-4)
        assert row.force_n == pytest.approx(2550.0 * row.acceleration_m_s2)


@pytest.mark.parametrize("cycles", [4, 8])
@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5])
def test_held_cycles_are_evaluated_at_their_very_peaks(cycles: int, phase: float) -> None:
    hold = Segment(0, 1000 * cycles, Label.MEASURE, 0, 1.0, 1.0, A, A, phase, cycles)
    (row,) = compute_demands(Drive(1000.0, (hold,), (Step(0, "forward", 1.0, A),)), profile(), RIG)
    w = 2 * math.pi
    demanded = row.displacement_m, row.velocity_m_s, row.acceleration_m_s2
    assert demanded == pytest.approx((A / w**2, A / w, A), rel=1e-12)


def test_a_step_that_is_not_played_yet_counts_with_its_held_cycles() -> None:
    drive = plan_sweep(profile())
    without = Drive(drive.rate_hz, (), drive.steps)
    for row, step in zip(compute_demands(without, profile(), RIG), drive.steps, strict=True):
        w = 2 * math.pi * step.frequency_hz
        assert row.velocity_m_s == pytest.approx(A / w)
        assert row.displacement_m == pytest.approx(A / w**2)
        assert row.acceleration_m_s2 == pytest.approx(A)
        assert row.amplitude_lsb == pytest.approx(A / w**2 / RIG.output.lsb_m)


def test_feedback_adds_to_every_demand_of_a_step_and_to_no_loop_check() -> None:
    test = profile()
    controlled: Any = SimpleNamespace(
        specimen=test.specimen, continuation=SimpleNamespace(max_feedback=0.4)
    )
    drive = nominal_drive(make_test_plan(test, RIG))
    for plain, row in zip(
        compute_demands(drive, test, RIG), compute_demands(drive, controlled, RIG), strict=True
    ):
        factor = 1.4 if plain.step >= 0 else 1.0
        for name in ("displacement_m", "velocity_m_s", "acceleration_m_s2", "force_n"):
            assert getattr(row, name) == pytest.approx(factor * getattr(plain, name)), name
        assert row.amplitude_lsb == plain.amplitude_lsb  # of the smallest, without feedback


def make_history(seed: int, count: int) -> HistorySegment:
    """A smooth history of five waves from rest to rest, in three windows."""
    t = np.arange(count) / count
    sizes = 0.02 * np.random.default_rng(seed).standard_normal(5) / np.arange(1, 6) ** 1.5
    waves = np.sin(math.pi * np.outer(np.arange(1, 6), t))
    return HistorySegment(0, sizes @ waves * np.sin(math.pi * t) ** 3, 3)


@pytest.mark.parametrize("rate_hz", [500.0, 1000.0])
@pytest.mark.parametrize("seed", [2, 3])
def test_the_worst_stop_of_a_history_is_that_of_a_decay_played_from_every_sample(
    seed: int, rate_hz: float
) -> None:
    history = make_history(seed, 900)
    drive = Drive(rate_hz, (history,), ())
    *windows, stop = compute_demands(drive, profile(), RIG)
    length = history.decay_samples(0.0, rate_hz)
    played = np.zeros(3)
    for first in range(history.count):
        motion = differentiate(drive.decay_from(first).command(first - 1, length + 3), rate_hz)
        played = np.maximum(played, np.abs(motion).max(axis=1))
    demanded = stop.displacement_m, stop.velocity_m_s, stop.acceleration_m_s2
    assert demanded == pytest.approx(played.tolist(), rel=1e-5)
    assert stop.force_n == pytest.approx(2550.0 * stop.acceleration_m_s2)
    assert stop.amplitude_lsb == pytest.approx(stop.displacement_m / RIG.output.lsb_m)
    # A stop demands more than the history itself, of whose windows the rows are the peaks.
    assert stop.acceleration_m_s2 > 1.01 * max(row.acceleration_m_s2 for row in windows)
    motion = differentiate(np.pad(history.history_m, 1), rate_hz)
    for k, row in enumerate(windows):
        expected = np.abs(motion[:, 300 * k : 300 * (k + 1)]).max(axis=1)
        demanded = row.displacement_m, row.velocity_m_s, row.acceleration_m_s2
        assert demanded == pytest.approx(expected.tolist())
        assert row.force_n == pytest.approx(2550.0 * row.acceleration_m_s2)
        assert row.amplitude_lsb == pytest.approx(row.displacement_m / RIG.output.lsb_m)
    assert [row.step for row in (*windows, stop)] == [0, 1, 2, 3]


# Laws of the limits: what is allowed, and the next number that is not


def with_ranges(ranges: dict[str, float]) -> RigConfig:
    """The rig with other ranges of some sensors, in their unit."""
    sensors = [
        {**sensor.model_dump(), "range": ranges.get(sensor.channel, sensor.range)}
        for sensor in RIG.sensors
    ]
    return RigConfig.model_validate(RIG.model_dump() | {"sensors": sensors})


SMALL = StepDemand(3, "forward", 2.0, 1e-6, 1e-6, 1e-6, 1e-6, math.inf)


def change_demand(row: StepDemand, name: str, value: float) -> StepDemand:
    changes: dict[str, Any] = {name: value}
    return replace(row, **changes)


LIMITS: list[tuple[str, str, str, str, float]] = [
    ("limits", "stroke_mm", "displacement", "displacement_m", 1e3),
    ("output", "span_mm", "displacement", "displacement_m", 1e3),
    ("limits", "velocity_mm_s", "velocity", "velocity_m_s", 1e3),
    ("limits", "acceleration_g", "acceleration", "acceleration_m_s2", 1 / 9.80665),
    ("limits", "force_kn", "force", "force_n", 1e-3),
    ("limits", "peak_flow_l_min", "flow", "velocity_m_s", 60e3 * 20e-4),
]


@pytest.mark.parametrize(("table", "field", "name", "demand", "to_unit"), LIMITS)
@given(value=st.floats(1e-3, 0.05), frequency_hz=st.floats(0.1, 9.0) | st.just(math.nan))
@LAW
def test_a_demand_at_its_limit_is_allowed_and_beyond_it_refused(
    table: str,
    field: str,
    name: str,
    demand: str,
    to_unit: float,
    value: float,
    frequency_hz: float,
) -> None:
    row = change_demand(replace(SMALL, frequency_hz=frequency_hz), demand, value)
    area = {"piston_area_cm2": 20.0} if name == "flow" else {}

    def make_limited(allowed: float) -> RigConfig:
        return rig(table, **{field: allowed}, **area)

    (limit,) = (item for item in list_limits(make_limited(1.0)) if item.name == name)
    allowed = limit.demand(row)
    assert allowed == pytest.approx(to_unit * value, rel=1e-12)
    check_limits((row,), profile(), make_limited(allowed), "a.toml")
    just_below = make_limited(float(np.nextafter(allowed, 0.0)))
    with pytest.raises(InputError) as caught:
        check_limits((SMALL, row, row), profile(), just_below, "a.toml")
    (fault,) = caught.value.faults
    assert (fault.key, fault.where) == (name, f"{row.name} and 1 more")
    assert stated_number(fault) == pytest.approx(allowed, rel=1e-3)
    with pytest.raises(InputError) as caught:
        check_limits((row, SMALL), profile(), make_limited(0.99 * allowed), "a.toml")
    assert [fault.where for fault in caught.value.faults] == [row.name]


@pytest.mark.parametrize(
    ("channel", "demand", "si_per_unit"),
    [
        ("drive_disp_m", "displacement_m", 1e-3),
        ("table_disp_m", "displacement_m", 1e-3),
        ("table_acc_m_s2", "acceleration_m_s2", 9.80665),
    ],
)
@given(value=st.floats(1e-3, 0.05))
@LAW
def test_a_sensor_may_be_used_up_to_its_range(
    channel: str, demand: str, si_per_unit: float, value: float
) -> None:
    row = change_demand(SMALL, demand, value)
    full = value / si_per_unit
    check_limits((SMALL, row), profile(), with_ranges({channel: full}), "a.toml")
    with pytest.raises(InputError) as caught:
        check_limits(
            (SMALL, row, SMALL), profile(), with_ranges({channel: full * (1 - 1e-12)}), "a.toml"
        )
    (fault,) = caught.value.faults
    assert (fault.key, fault.where) == (channel, row.name)
    assert stated_number(fault) == pytest.approx(full, rel=1e-3)


@pytest.mark.parametrize("least_lsb", [7, 20])
def test_the_smallest_step_and_the_peak_of_a_history_need_enough_steps_of_the_dac(
    least_lsb: int,
) -> None:
    card = rig("output", least_lsb=least_lsb)
    check = replace(SMALL, step=-1, amplitude_lsb=1.0)  # plans its own amplitudes
    window = replace(SMALL, step=0, frequency_hz=math.nan, amplitude_lsb=1.0)
    allowed, refused = float(least_lsb), float(np.nextafter(least_lsb, 0.0))

    def list_keys(*demands: StepDemand) -> list[tuple[str, str]]:
        try:
            check_limits(demands, profile(), card, "a.toml")
        except InputError as error:
            return [(fault.key, fault.where) for fault in error.faults]
        return []

    for step in (0, 3):
        smallest = replace(SMALL, step=step, amplitude_lsb=allowed)
        assert list_keys(check, SMALL, smallest, SMALL) == []
        coarse = replace(smallest, amplitude_lsb=refused)
        assert list_keys(check, SMALL, coarse, smallest) == [("amplitude", f"step {step} (2 Hz)")]
    peak = replace(window, step=1, amplitude_lsb=allowed)
    assert list_keys(window, peak) == []
    ((key, _),) = list_keys(window, replace(peak, amplitude_lsb=refused))
    assert key == "displacement"


def test_the_highest_frequency_of_sweep_and_loop_check_is_allowed_and_the_next_is_not() -> None:
    def list_keys(max_hz: float, **check: Any) -> list[tuple[str, Any]]:
        test = profile(loop_check=check)
        try:
            check_limits((SMALL,), test, rig(frequency_hz=max_hz), "a.toml")
        except InputError as error:
            return [(fault.key, fault.value) for fault in error.faults]
        return []

    below = float(np.nextafter(12.0, 0.0))
    sweep, check = ("sweep.stop_hz", 10.0), ("loop_check.frequencies_hz", 12.0)
    assert list_keys(10.0) == []
    assert list_keys(float(np.nextafter(10.0, 0.0))) == [sweep]
    assert list_keys(12.0, frequencies_hz=(0.5, 12.0, 3.0)) == []
    assert list_keys(below, frequencies_hz=(0.5, 12.0, 3.0)) == [check]
    assert list_keys(9.0, frequencies_hz=(0.5, 12.0, 3.0)) == [sweep, check]
    assert list_keys(below, frequencies_hz=(0.5, 12.0, 3.0), enabled=False) == []


@pytest.mark.parametrize(
    ("demand", "allowed", "ranges"),
    [
        ("displacement_m", 0.06, {}),
        ("velocity_m_s", 0.5, {}),
        ("acceleration_m_s2", GRAVITY_M_S2, {}),
        ("force_n", 30e3, {}),
        ("displacement_m", 0.04, {"table_disp_m": 40.0, "mass_disp_m": 1.0}),
        ("acceleration_m_s2", 0.3 * GRAVITY_M_S2, {"table_acc_m_s2": 0.3, "mass_acc_m_s2": 0.1}),
    ],
)
@given(excess=st.floats(1.01, 1e3), level=st.floats(1e-3, 10.0), has_points=st.booleans())
@LAW
def test_the_level_that_fits_is_in_proportion_to_the_largest_excess_of_a_history(
    demand: str,
    allowed: float,
    ranges: dict[str, float],
    excess: float,
    level: float,
    has_points: bool,
) -> None:
    card = with_ranges(ranges)
    keys: dict[str, Any] = {"start_hz": 0.4, "stop_hz": 5.0, "duration_s": 20.0}
    keys |= {"level_points": [[0.4, 0.2], [5.0, 0.2]]} if has_points else {"acceleration_g": level}
    test = history_profile("chirp", keys)
    window = replace(SMALL, frequency_hz=math.nan)
    standstill = StepDemand(0, "window 0", math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    demands = (standstill, window, change_demand(window, demand, excess * allowed), window)
    with pytest.raises(InputError) as caught:
        check_limits(demands, test, card, "a.toml")
    assert caught.value.faults
    remedy = preflight._suggest_level(demands, test, card)
    if not ranges:
        assert caught.value.faults[0].remedy == remedy
    number = float(remedy.split("by ")[1].split(",")[0] if has_points else remedy.split()[-1])
    expected = (1.0 if has_points else level) / excess
    assert number <= expected * (1 + 1e-12)
    assert number > 0.99 * expected  # rounded to three digits
    # A stepped motion beyond the limit says nothing of the level of a history.
    sine = change_demand(SMALL, demand, 1e3 * excess * allowed)
    assert preflight._suggest_level((*demands, sine), test, card) == remedy


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@given(value=st.floats(1e-9, 1e9))
@settings(max_examples=100, derandomize=True)
def test_three_significant_digits_are_kept_and_the_rest_is_cut_off(
    sign: float, value: float
) -> None:
    rounded = sign * preflight._round_towards_zero(sign * value)
    assert rounded == pytest.approx(float(f"{rounded:.3g}"), rel=1e-12)
    assert rounded <= value * (1 + 1e-12)
    assert value - rounded < 0.0100001 * 10.0 ** math.floor(math.log10(value))


# Laws of the warnings, each on both sides of its threshold


def test_a_step_is_coarse_below_the_steps_of_the_dac_to_warn_of() -> None:
    fine = replace(SMALL, amplitude_lsb=100.0)
    coarse = replace(SMALL, amplitude_lsb=float(np.nextafter(100.0, 0.0)))
    assert list_drive_warnings((fine, fine), RIG) == []
    for step in (0, 3):
        assert len(list_drive_warnings((fine, replace(coarse, step=step)), RIG)) == 1
    check, window = replace(coarse, step=-1), replace(coarse, frequency_hz=math.nan)
    assert list_drive_warnings((check, window), RIG) == []


def test_stroke_is_tight_where_a_correction_of_a_fifth_exceeds_it() -> None:
    ample = replace(SMALL, displacement_m=0.06 / CORRECTION_HEADROOM * (1 - 1e-9))
    tight = replace(SMALL, displacement_m=0.06 / 1.2 * (1 + 1e-9))
    assert list_drive_warnings((ample, ample), RIG) == []
    assert len(list_drive_warnings((ample, tight, tight), RIG)) == 1
    assert list_drive_warnings((replace(tight, step=-1),), RIG) == []
    # At exactly the stroke there is still room.
    exact = replace(SMALL, displacement_m=0.05)
    assert 1.2 * (0.05 * 1e3) == 60.0
    assert list_drive_warnings((exact,), RIG) == []


@pytest.mark.parametrize(
    ("allowed", "doubted"),
    [
        ({"mass_kg": 20.0}, {"mass_kg": 19.9999}),
        ({"mass_kg": 4000.0}, {"mass_kg": 4000.001}),
        ({"gap_mm": 120.0}, {"gap_mm": 120.0001}),
        ({"gap_mm": -120.0}, {"gap_mm": -120.0001}),
        (
            {"gap_right_mm": -60.0, "gap_left_mm": 60.0},
            {"gap_right_mm": 1.0, "gap_left_mm": -60.0001},
        ),
        (
            {"gap_right_mm": 60.0, "gap_left_mm": math.inf},
            {"gap_right_mm": 60.0001, "gap_left_mm": math.inf},
        ),
    ],
)
def test_a_specimen_is_plausible_from_a_hundredth_to_twice_the_table_and_within_the_stroke(
    allowed: dict[str, float], doubted: dict[str, float]
) -> None:
    plain = {"mass_kg": 550.0, "gap_mm": 4.0}
    assert list_setup_warnings(profile(specimen=plain | allowed), RIG) == []
    assert len(list_setup_warnings(profile(specimen=plain | doubted), RIG)) == 1


def test_four_blocks_are_queued_or_it_is_worth_a_warning() -> None:
    for rate_hz in (1000.0, 2000.0, 4000.0):
        for lead_s in (0.5, 2.0):
            fourth = round(lead_s * rate_hz / 4)
            for samples, count in ((fourth, 0), (fourth + 1, 1)):
                test = profile(acquisition={"rate_hz": rate_hz, "block_samples": samples})
                card = rig("output", lead_s=lead_s)
                assert len(list_setup_warnings(test, card)) == count, (rate_hz, samples)


@pytest.mark.parametrize("check", [{}, {"frequencies_hz": (1.0, 10.0, 3.0)}])
def test_a_loop_check_may_end_a_thousandth_below_the_highest_frequency(
    check: dict[str, Any],
) -> None:
    """A tenth of the level has the least steps of the DAC at the frequency that this span gives."""
    for ratio, count in ((0.9995, 0), (0.9985, 1), (0.5, 1)):
        amplitude_m = 0.1 * A / (2 * math.pi * ratio * 10.0) ** 2
        card = rig("output", span_mm=1e3 * amplitude_m / 20 * 2**18 / 2)
        assert len(list_setup_warnings(profile(loop_check=check), card)) == count, ratio
        off = profile(loop_check=check | {"enabled": False})
        assert list_setup_warnings(off, card) == []


@pytest.mark.parametrize(
    ("field", "si", "order"),
    [("stroke_mm", 1e-3, 2), ("velocity_mm_s", 1e-3, 1), ("acceleration_g", GRAVITY_M_S2, 0)],
)
@given(gain=st.floats(0.55, 1.8), frequency_hz=st.floats(0.5, 9.0))
@LAW
def test_the_corrected_command_is_the_motion_over_the_gain(
    field: str, si: float, order: int, gain: float, frequency_hz: float
) -> None:
    (step, *_) = profile(frequency_hz, 10.0).sweep.steps
    flat = FrequencyResponse(5, (1.0,), (gain,), (0.0,))
    demand = A / (2 * math.pi * frequency_hz) ** order / gain / si
    wide = {"stroke_mm": 1e3, "velocity_mm_s": 1e5, "acceleration_g": 9.0}
    roomy = rig("output", span_mm=1e3, bits=32)
    for share, count in ((1 + 1e-9, 0), (1 - 1e-9, 1)):
        limits = roomy.limits.model_dump() | wide | {field: share * demand}
        card = RigConfig.model_validate(roomy.model_dump() | {"limits": limits})
        assert len(check_corrected_drive((step,), flat, card)) == count


def test_a_command_may_be_doubled_and_no_more() -> None:
    (step, *_) = profile(5.0, 10.0).sweep.steps
    for gain, count in ((0.5 * (1 + 1e-9), 0), (0.5 * (1 - 1e-9), 1)):
        flat = FrequencyResponse(5, (1.0,), (gain,), (0.0,))
        assert len(check_corrected_drive((step, step), flat, RIG)) == count
