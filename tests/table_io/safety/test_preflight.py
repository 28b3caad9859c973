"""Pre-flight margins against closed forms, and refusals that name step and limit."""

import math
from dataclasses import replace
from typing import Any

import pytest

from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.excitation.trajectory import plan_excitation, plan_sweep
from table_io.records import FrequencyResponse
from table_io.safety.preflight import (
    StepDemand,
    check_corrected_drive,
    check_limits,
    compute_demands,
    list_drive_warnings,
    list_setup_warnings,
)
from table_io.sequencer import make_test_plan, nominal_drive
from table_io.units import GRAVITY_M_S2

RIG = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")[0]
A = 0.05 * GRAVITY_M_S2


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
