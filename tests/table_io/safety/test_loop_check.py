"""The loop check on the simulated table: clean it passes, and each planted fault fails its line."""

import cmath
import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.backends import open_backend
from table_io.block import Block, Float1D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.calibration import command_to_volts, compute_tare, measure_noise, volts_to_si
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.profile import Profile, load_profile
from table_io.config.rig import RigConfig
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import Trajectory, start_trajectory
from table_io.records import Check
from table_io.safety.loop_check import (
    REMEDIES,
    SETTLE_CYCLES,
    count_hold_cycles,
    evaluate,
    evaluate_transfer,
    find_remedy,
    plan_targets,
)
from table_io.safety.loop_check.checks import MIN_TONE_SNR, unwrap_phase
from table_io.safety.protection.consistency import WeakFormPair, compare_motion, make_window
from tests.builders.drives import sine_segments

RIG = load_config(PROFILES_DIR / "rigs" / "simulated.toml", RigConfig, "machine card")[0]
SHIPPED = sorted(
    path.stem
    for path in (PROFILES_DIR / "tests").glob("*.toml")
    if isinstance(load_profile(path)[0].excitation, Sweep)
)
CELLS = RIGHT_CELLS + LEFT_CELLS
TABLE_TWICE = "second derivative against table_acc_m_s2"
MASS_TWICE = "second derivative against mass_acc_m_s2"
AGAINST = "polarity against the command"
LAG = "polarity, lag behind the table"
ALIVE = "alive, tone over noise"

CheckRun = tuple[Profile, Block, Drive, dict[str, float]]
Change = Callable[[Float1D], Float1D]


def load_shipped(name: str, **tables: dict[str, Any]) -> Profile:
    """A shipped test, with other values in some of its tables."""
    raw = load_profile(PROFILES_DIR / "tests" / f"{name}.toml")[0].model_dump()
    for table, values in tables.items():
        raw[table].update(values)
    return Profile.model_validate(raw)


def card(**tables: dict[str, Any]) -> RigConfig:
    """The machine card, with other values in some of its tables."""
    raw = RIG.model_dump()
    for table, values in tables.items():
        raw[table].update(values)
    return RigConfig.model_validate(raw)


def run_loop_check(profile: Profile, rig: RigConfig = RIG) -> CheckRun:
    """The loop check of a profile as it is played, and what it recorded."""
    course: Trajectory = start_trajectory(profile)
    for aim in plan_targets(profile, rig):
        course = course.append_blend(aim, -1, profile.sweep.blend_cycles, Label.BLEND)
        cycles = count_hold_cycles(aim, profile)
        count = math.ceil(cycles * course.rate_hz / aim.frequency_hz)
        course = course.append_hold(count, -1, Label.CHECK)
    rest = replace(course.target, level_m_s2=0.0)
    course = course.append_blend(rest, -1, profile.sweep.blend_cycles, Label.BLEND)
    end = course.end + math.ceil(profile.loop_check.rest_s * course.rate_hz)
    drive = course.to_drive(())
    backend = open_backend(rig, profile, ManualClock())
    backend.open()
    volts = backend.tare(int(drive.rate_hz))
    tare = compute_tare(volts, rig.sensors)
    noise = {name: rms for name, (rms, _) in measure_noise(volts, rig.sensors).items()}
    backend.queue(0, command_to_volts(drive.command(0, end), rig.output))
    backend.start()
    values = volts_to_si(backend.read(end), rig.sensors, tare)
    backend.close()
    block = Block("meas", 0, drive.rate_hz, rig.channels, values, *drive.labels(0, end))
    return profile, block, drive, noise


@cache
def record_loop_check(name: str, rate_hz: float = 2000.0) -> CheckRun:
    """The clean check of a shipped test, once a run of the tests."""
    return run_loop_check(load_shipped(name, acquisition={"rate_hz": rate_hz}))


def alter_channels(block: Block, changes: dict[str, Change]) -> Block:
    """The recording with some channels changed."""
    values = block.values.copy()
    for name, change in changes.items():
        row = block.channels.index(name)
        values[row] = change(block.values[row].copy())
    return replace(block, values=values)


def evaluate_checks(
    check_run: CheckRun, changes: dict[str, Change] | None = None
) -> tuple[Check, ...]:
    profile, block, drive, noise = check_run
    return evaluate(alter_channels(block, changes or {}), drive, profile, RIG, noise)[0]


def list_failures(checks: tuple[Check, ...]) -> set[tuple[str, str]]:
    return {(check.name, check.channel) for check in checks if not check.passed}


def white(rms: float) -> Change:
    return lambda values: values + rms * np.random.default_rng(5).standard_normal(values.size)


# ---- what is driven


@pytest.mark.parametrize(
    ("name", "frequencies_hz"),
    [
        ("g4_ss3", (1.0, math.sqrt(5.0), 5.0)),
        ("gm10", (1.0, math.sqrt(10.0), 10.0)),
        ("g4_ss1", (0.5, math.sqrt(0.4), 0.8)),
        ("quickstart", (2.4, math.sqrt(2.4 * 4.4), 4.4)),
    ],
)
def test_three_frequencies_between_the_ends_of_the_sweep(
    name: str, frequencies_hz: tuple[float, ...]
) -> None:
    targets = plan_targets(load_shipped(name), RIG)
    assert [aim.frequency_hz for aim in targets] == pytest.approx(list(frequencies_hz))
    assert [aim.level_m_s2 for aim in targets] == pytest.approx([0.1 * 0.05 * 9.80665] * 3)


def test_given_frequencies_are_taken_upwards_and_a_single_step_needs_one() -> None:
    given = load_shipped("g4_ss3", loop_check={"frequencies_hz": (4.0, 0.7), "level": 0.05})
    assert [aim.frequency_hz for aim in plan_targets(given, RIG)] == [0.7, 4.0]
    assert plan_targets(given, RIG)[0].level_m_s2 == pytest.approx(0.05 * 0.05 * 9.80665)
    single = load_shipped("g4_ss3", excitation={"start_hz": 3.0, "stop_hz": 3.0})
    assert [aim.frequency_hz for aim in plan_targets(single, RIG)] == [3.0]


def test_harmonics_to_cancel_are_looked_at_as_far_as_the_machine_allows() -> None:
    fine = {"output": {"bits": 24}}
    for stop_hz, top_hz in ((2.5, 12.5), (10.0, 20.0)):  # five times, and the card's 20 Hz
        sweep = {"start_hz": 0.5, "stop_hz": stop_hz}
        plain = plan_targets(load_shipped("gm10", excitation=sweep), card(**fine))
        more = plan_targets(
            load_shipped("gm10", excitation=sweep, control={"harmonics": True}), card(**fine)
        )
        assert more[:3] == plain
        assert more[-1].frequency_hz == pytest.approx(top_hz)
        assert len(more) == 5


@pytest.mark.parametrize("bits", [12, 14, 16, 18])
@pytest.mark.parametrize("level", [0.02, 0.1])
def test_an_amplitude_below_the_converter_gives_way_never_the_tenth_of_the_level(
    bits: int, level: float
) -> None:
    profile = load_shipped("gm10", loop_check={"level": level})
    rig = card(output={"bits": bits})
    targets = plan_targets(profile, rig)
    for aim in targets:
        amplitude = aim.level_m_s2 / (2 * math.pi * aim.frequency_hz) ** 2
        assert amplitude >= rig.output.least_lsb * rig.output.lsb_m * (1 - 1e-9)
        assert aim.level_m_s2 <= 0.1 * 0.05 * 9.80665 * (1 + 1e-9)
    # 12 bits of 60 mm are 29 um: 20 of them at a tenth of the level need 1.46 Hz or less.
    assert targets[-1].frequency_hz == pytest.approx(1.4560 if bits == 12 else min(10.0, math.sqrt(
        0.1 * 0.05 * 9.80665 / (20 * 0.12 / 2**bits)) / (2 * math.pi)), rel=1e-4)  # fmt: skip
    if bits == 18 and level == 0.02:
        assert targets[0].level_m_s2 == pytest.approx(0.02 * 0.05 * 9.80665)
        assert targets[-1].level_m_s2 > 3 * targets[0].level_m_s2  # raised, for its DAC steps


def test_a_motion_is_held_for_the_cycles_of_the_card_and_two_seconds() -> None:
    profile = load_shipped("gm10", loop_check={"cycles": 7})
    held = [count_hold_cycles(aim, profile) - SETTLE_CYCLES for aim in plan_targets(profile, RIG)]
    assert held == [7, 7, 20]


# ---- a clean table


@pytest.mark.parametrize(
    ("name", "rate_hz"),
    [(name, 2000.0) for name in SHIPPED]
    + [(name, rate) for rate in (1000.0, 4000.0) for name in ("ginf", "g4_ss2", "g0", "gm10")],
)
def test_a_clean_table_passes_every_line(name: str, rate_hz: float) -> None:
    checks = evaluate_checks(record_loop_check(name, rate_hz))
    assert list_failures(checks) == set()
    names = {check.name for check in checks}
    assert {AGAINST, LAG, ALIVE, TABLE_TWICE, MASS_TWICE, "gain", "delay", "offset"} <= names
    assert {check.channel for check in checks} >= set(RIG.channels)


def test_bumpers_that_are_touched_at_low_level_fail_nothing() -> None:
    profile, block, *_ = record_loop_check("g4_ss2")
    assert block.channel("force_r1_n").max() > 5 * profile.comparison.contact_n
    checks = evaluate_checks(record_loop_check("g4_ss2"))
    assert ("polarity in contact", "force_l2_n") in {
        (check.name, check.channel) for check in checks
    }


def truth(f: float, stiffness_n_m: float, damping_n_s_m: float, delay_s: float) -> complex:
    """Acceleration over command of the card's servo with a linear specimen on it.

    y'' = p^2 (s - y) - 2 p y' - M x''/m with x''/y'' = (K + i w C) / (K - M w^2 + i w C).
    """
    w, p = 2 * math.pi * f, 2 * math.pi * 20.0 / math.sqrt(math.sqrt(2.0) - 1.0)
    spring = stiffness_n_m + 1j * w * damping_n_s_m
    reaction = 550.0 / 2000.0 * spring / (spring - 550.0 * w**2)
    return p**2 * cmath.exp(-1j * w * delay_s) / (p**2 + 2j * p * w - w**2 * (1 + reaction))


@pytest.mark.parametrize(
    ("name", "stiffness_n_m", "damping_n_s_m"),
    [("ginf", 36e3, 1.1e3), ("g4_ss3", 36e3, 1.1e3), ("gm10", 36e3 + 2 * 510e3, 1.1e3 + 2 * 900.0)],
)
def test_the_response_is_that_of_the_servo(
    name: str, stiffness_n_m: float, damping_n_s_m: float
) -> None:
    profile, block, drive, noise = record_loop_check(name)
    response = evaluate(block, drive, profile, RIG, noise)[1]
    assert response is not None
    for place, f in enumerate(response.frequencies_hz):
        true = truth(f, stiffness_n_m, damping_n_s_m, 5e-3)
        assert response.gain[place] == pytest.approx(abs(true), rel=5e-3)
        assert response.phase_rad[place] == pytest.approx(cmath.phase(true), abs=math.radians(1))
    for f in (0.5, 1.7, 3.3, profile.sweep.stop_hz):
        true = truth(f, stiffness_n_m, damping_n_s_m, 5e-3)
        transfer = evaluate_transfer(response, f)
        assert abs(transfer) == pytest.approx(abs(true), rel=1e-2)
        assert cmath.phase(transfer / true) == pytest.approx(0.0, abs=math.radians(2))


# ---- planted faults


def flip_sign(values: Float1D) -> Float1D:
    return -values


def dead(values: Float1D) -> Float1D:
    return np.full_like(values, values[0])


FAULTS: dict[str, tuple[dict[str, Change], set[tuple[str, str]]]] = {
    "table laser reversed": (
        {"table_disp_m": flip_sign},
        {(AGAINST, "table_disp_m"), (TABLE_TWICE, "table_disp_m")},
    ),
    "table accelerometer reversed": (
        {"table_acc_m_s2": flip_sign},
        {(AGAINST, "table_acc_m_s2"), (TABLE_TWICE, "table_disp_m")},
    ),
    "mass laser looks from the other side": (
        {"mass_disp_m": flip_sign},
        {(LAG, "mass_disp_m"), (MASS_TWICE, "mass_disp_m")},
    ),
    "mass accelerometer reversed": (
        {"mass_acc_m_s2": flip_sign},
        {(LAG, "mass_acc_m_s2"), (MASS_TWICE, "mass_disp_m")},
    ),
    "both sensors of the mass reversed": (
        {"mass_acc_m_s2": flip_sign, "mass_disp_m": flip_sign},
        {(LAG, "mass_acc_m_s2"), (LAG, "mass_disp_m")},
    ),
    "table laser 25 % too much": (
        {"table_disp_m": lambda values: 1.25 * values},
        {("gain", "table_disp_m"), (TABLE_TWICE, "table_disp_m")},
    ),
    "table accelerometer 25 % too little": (
        {"table_acc_m_s2": lambda values: 0.75 * values},
        {("gain", "table_acc_m_s2"), (TABLE_TWICE, "table_disp_m")},
    ),
    "mass laser 25 % too much": (
        {"mass_disp_m": lambda values: 1.25 * values},
        {(MASS_TWICE, "mass_disp_m")},
    ),
    "mass accelerometer in g": (
        {"mass_acc_m_s2": lambda values: values / 9.80665},
        {(MASS_TWICE, "mass_disp_m")},
    ),
    "mass laser noisy": (
        {"mass_disp_m": white(100e-6)},
        {("noise under the level", "mass_disp_m")},
    ),
    "table accelerometer noisy": (
        {"table_acc_m_s2": white(0.1)},
        {("noise under the level", "table_acc_m_s2")},
    ),
    "load cell noisy": ({"force_l1_n": white(5.0)}, {("noise", "force_l1_n")}),
    "table laser dead": ({"table_disp_m": dead}, {(ALIVE, "table_disp_m")}),
    "table accelerometer dead": ({"table_acc_m_s2": dead}, {(ALIVE, "table_acc_m_s2")}),
    "mass laser dead": ({"mass_disp_m": dead}, {(ALIVE, "mass_disp_m")}),
    "mass accelerometer feels only noise": (
        {"mass_acc_m_s2": lambda values: white(0.005)(0 * values)},
        {(ALIVE, "mass_acc_m_s2")},
    ),
    "mass laser lost": (
        {"mass_disp_m": lambda values: values + math.nan},
        {("lost samples", "mass_disp_m")},
    ),
    "table laser 20 ms late": (
        {"table_disp_m": lambda values: np.roll(values, 40)},
        {(TABLE_TWICE, "table_disp_m")},
    ),
    "command not wired back": (
        {"drive_disp_m": lambda values: 0 * values},
        {("command read back", "drive_disp_m")},
    ),
    "command 2 % off": (
        {"drive_disp_m": lambda values: 1.02 * values},
        {("command read back", "drive_disp_m")},
    ),
    "table laser off by 0.3 mm": (
        {"table_disp_m": lambda values: values + 0.3e-3},
        {("offset", "table_disp_m")},
    ),
    "load cell off by 20 N": (
        {"force_r2_n": lambda values: values - 20.0},
        {("offset", "force_r2_n")},
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_planted_fault_fails_its_own_lines(fault: str) -> None:
    changes, lines = FAULTS[fault]
    assert list_failures(evaluate_checks(record_loop_check("g4_ss3"), changes)) == lines


@pytest.mark.parametrize("cell", CELLS)
def test_a_load_cell_shows_its_sign_and_its_death_in_contact_only(cell: str) -> None:
    for change, name in ((flip_sign, "polarity in contact"), (white(1.0), "")):
        changes = {cell: change if name else lambda values, noise=change: noise(0 * values)}
        line = name or "force ratio to its neighbour"
        assert list_failures(evaluate_checks(record_loop_check("gm1"), changes)) == {(line, cell)}
        # Nothing touches here, so a cell without force and a reversed one look like a sound one.
        assert list_failures(evaluate_checks(record_loop_check("ginf"), changes)) == set()


def test_a_load_cell_that_does_not_even_flicker_is_dead_without_contact() -> None:
    profile, block, drive, _ = record_loop_check("ginf")
    changes: dict[str, Change] = {"force_r1_n": dead}
    checks, _ = evaluate(alter_channels(block, changes), drive, profile, RIG)
    assert list_failures(checks) == {("alive, noise at rest", "force_r1_n")}


def test_the_motion_of_the_table_on_a_load_cell_is_cross_talk() -> None:
    check_run = record_loop_check("g4_ss3")
    table = check_run[1].channel("table_acc_m_s2")
    line = ("cross-talk from the motion", "force_r1_n")
    # Judged at the test's level, ten times that of the check: 0.49 m/s2, allowed half of 10 N.
    assert list_failures(
        evaluate_checks(check_run, {"force_r1_n": lambda values: values + 15 * table})
    ) == {line}
    assert (
        list_failures(evaluate_checks(check_run, {"force_r1_n": lambda values: values + 5 * table}))
        == set()
    )


def test_a_unit_of_the_table_laser_a_thousand_times_wrong_fails_its_gain() -> None:
    changes: dict[str, Change] = {"table_disp_m": lambda values: 1e3 * values}
    checks = evaluate_checks(record_loop_check("g4_ss3"), changes)
    assert {channel for _, channel in list_failures(checks)} == {"table_disp_m"}
    (gain,) = (check for check in checks if (check.name, check.channel) == ("gain", "table_disp_m"))
    assert gain.value == pytest.approx(1000.0, rel=0.01)
    assert not gain.passed


def test_laser_and_accelerometer_of_the_table_swapped() -> None:
    check_run = record_loop_check("g4_ss3")
    disp, acc = (check_run[1].channel(name) for name in ("table_disp_m", "table_acc_m_s2"))
    lines = list_failures(
        evaluate_checks(
            check_run, {"table_disp_m": lambda _: acc, "table_acc_m_s2": lambda _: disp}
        )
    )
    for channel in ("table_disp_m", "table_acc_m_s2"):
        assert {(AGAINST, channel), ("gain", channel)} <= lines
    assert {channel for _, channel in lines} == {"table_disp_m", "table_acc_m_s2"}


def test_a_table_that_answers_too_late_fails_the_delay() -> None:
    check_run = run_loop_check(load_shipped("g4_ss3"), card(simulated={"servo_delay_ms": 120.0}))
    assert list_failures(evaluate_checks(check_run)) == {
        ("delay", "table_disp_m"),
        ("delay", "table_acc_m_s2"),
    }


def test_a_servo_too_slow_for_the_sweep_fails_at_its_highest_frequency() -> None:
    check_run = run_loop_check(load_shipped("gm10"), card(simulated={"servo_bandwidth_hz": 5.0}))
    line = "gain at the highest frequency"
    assert list_failures(evaluate_checks(check_run)) == {
        (line, "table_disp_m"),
        (line, "table_acc_m_s2"),
    }


def test_a_table_that_hunts_after_the_check_is_not_quiet() -> None:
    def hunts(values: Float1D) -> Float1D:
        values[-4000:] += 0.05 * np.sin(2 * math.pi * 30 * np.arange(4000) / 2000)
        return values

    lines = list_failures(evaluate_checks(record_loop_check("g4_ss3"), {"table_acc_m_s2": hunts}))
    assert lines == {("motion left after the check", "table_acc_m_s2")}


def test_how_long_the_mass_rings_is_its_own_affair() -> None:
    def rings(values: Float1D) -> Float1D:
        values[-2000:] += 0.2 * np.sin(2 * math.pi * 1.3 * np.arange(2000) / 2000)
        return values

    assert (
        list_failures(evaluate_checks(record_loop_check("g4_ss3"), {"mass_acc_m_s2": rings}))
        == set()
    )


def test_a_mass_that_uneven_bumpers_press_aside_is_not_off() -> None:
    gaps = {"gap_mm": -2.0, "gap_right_mm": -3.0, "gap_left_mm": 1.0}
    check_run = run_loop_check(load_shipped("quickstart", specimen=gaps))
    assert check_run[1].channel("mass_disp_m")[:1000].mean() < -1e-3
    assert list_failures(evaluate_checks(check_run)) == set()


def test_a_sensor_that_errs_at_one_frequency_only_leaves_the_smooth_curve() -> None:
    check_run = record_loop_check("gm10")
    held = [segment for segment in sine_segments(check_run[2]) if segment.label == Label.CHECK][1]
    middle = slice(held.start, held.end)

    def louder(values: Float1D) -> Float1D:
        values[middle] *= 1.3
        return values

    def later(values: Float1D) -> Float1D:
        values[middle] = np.roll(values[middle], 60)
        return values

    loud = list_failures(evaluate_checks(check_run, {"table_acc_m_s2": louder}))
    assert loud == {("gain off a smooth curve", "table_acc_m_s2"), (TABLE_TWICE, "table_disp_m")}
    late = list_failures(evaluate_checks(check_run, {"table_acc_m_s2": later}))
    assert late == {("delay over the frequencies", "table_acc_m_s2"), (TABLE_TWICE, "table_disp_m")}


def test_the_weak_form_needs_neither_a_steady_motion_nor_a_tare() -> None:
    rate, f = 2000.0, 1.0
    t = np.arange(10000) / rate

    def evaluate_motion(order: int) -> Float1D:
        """Order-th derivative of a growing motion at 1 Hz, one at 1.3 Hz, and an offset."""
        growing = np.exp((0.3 + 2j * math.pi * f) * t) * (0.3 + 2j * math.pi * f) ** order
        other = np.exp(2j * math.pi * 1.3 * t) * (2j * math.pi * 1.3) ** order
        offset = 5.0 if order == 0 else 0.0
        return 1e-3 * np.imag(growing + 2 * other) + offset

    def compare(gain: float, noise: float) -> tuple[complex, WeakFormPair]:
        window = make_window(t.size, t.size * f / rate, f * float(t[-1]) / 2, rate)
        filtered = np.zeros_like(t), 0.0
        pair = compare_motion(
            window, gain * evaluate_motion(0), evaluate_motion(2), (0.0, noise), filtered
        )
        return complex(pair.displacement[1] / pair.acceleration[1]), pair

    ratio, pair = compare(1.0, 1e-3)
    assert abs(ratio - 1.0) < 4e-4
    assert 0 < pair.sigma[1] < 0.01 * pair.size
    assert abs(compare(1.1, 0.0)[0]) == pytest.approx(1.1, abs=1e-3)


@pytest.mark.parametrize(("share", "lines"), [(0.004, 0), (0.02, 1)])
def test_a_few_lost_samples_are_borne(share: float, lines: int) -> None:
    def holes(values: Float1D) -> Float1D:
        values[np.random.default_rng(2).random(values.size) < share] = np.nan
        return values

    failures = list_failures(evaluate_checks(record_loop_check("g4_ss3"), {"mass_acc_m_s2": holes}))
    assert failures == {("lost samples", "mass_acc_m_s2")} if lines else failures == set()


def test_the_noise_at_the_tare_counts_too() -> None:
    profile, block, drive, noise = record_loop_check("g4_ss3")
    checks, _ = evaluate(block, drive, profile, RIG, noise | {"mass_acc_m_s2": 0.05})
    assert list_failures(checks) == {("noise under the level", "mass_acc_m_s2")}


# ---- only the channels at hand


def with_channels(block: Block, names: tuple[str, ...]) -> Block:
    rows = [block.channels.index(name) for name in names]
    return replace(block, channels=names, values=block.values[rows])


def test_what_was_not_measured_is_not_judged() -> None:
    profile, block, drive, noise = record_loop_check("g4_ss3")
    least = with_channels(block, ("drive_disp_m", "table_disp_m", "table_acc_m_s2"))
    checks, response = evaluate(least, drive, profile, RIG, noise)
    assert list_failures(checks) == set()
    assert {check.channel for check in checks} == set(least.channels)
    assert response == evaluate(block, drive, profile, RIG, noise)[1]


def test_a_sensor_of_the_relative_displacement_is_held_against_the_accelerometer() -> None:
    profile, block, drive, noise = record_loop_check("g4_ss3")
    u = block.channel("mass_disp_m") - block.channel("table_disp_m")
    kept = tuple(name for name in block.channels if name != "mass_disp_m")
    sensors = [
        sensor.model_copy(update={"channel": "rel_disp_m"})
        if sensor.channel == "mass_disp_m"
        else sensor
        for sensor in RIG.sensors
    ]
    rig = RIG.model_copy(update={"sensors": tuple(sensors)})
    for sign, lines in ((1.0, set()), (-1.0, {(MASS_TWICE, "rel_disp_m")})):
        values = np.vstack([with_channels(block, kept).values, sign * u])
        measured = replace(block, channels=(*kept, "rel_disp_m"), values=values)
        checks, _ = evaluate(measured, drive, profile, rig, noise)
        assert ("lost samples", "rel_disp_m") in {(check.name, check.channel) for check in checks}
        assert list_failures(checks) == lines


def test_no_check_no_lines() -> None:
    profile, block, _, noise = record_loop_check("g4_ss3")
    drive = start_trajectory(profile).to_drive(())
    assert evaluate(block, drive, profile, RIG, noise) == ((), None)


def test_every_line_that_can_fail_says_what_to_do() -> None:
    checks = {
        check for name in ("g4_ss2", "gm1") for check in evaluate_checks(record_loop_check(name))
    }
    for check in checks:
        limited = math.isfinite(check.low) or math.isfinite(check.high)
        assert bool(find_remedy(check)) == limited, check.name
    for start in REMEDIES:
        assert any(check.name.startswith(start) for check in checks)


# ---- limits to the number


def find_line(checks: tuple[Check, ...], name: str, channel: str) -> Check:
    (line,) = (check for check in checks if (check.name, check.channel) == (name, channel))
    return line


@given(
    frequencies=st.lists(st.floats(0.1, 20.0), min_size=2, max_size=6, unique=True),
    delay_s=st.floats(-0.05, 0.05), start=st.floats(-1.0, 1.0),
)  # fmt: skip
@settings(derandomize=True)
def test_phases_are_unwrapped_along_a_delay(
    frequencies: list[float], delay_s: float, start: float
) -> None:
    frequencies_hz = np.sort(frequencies)
    frequencies_hz *= 0.1 / frequencies_hz[0]  # the lowest phase is within half a turn
    phase = -2.0 * math.pi * frequencies_hz * delay_s * (1.0 + start / 1e3)
    np.testing.assert_allclose(
        unwrap_phase(np.exp(1j * phase), frequencies_hz), phase, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_cell_may_be_off_by_half_the_contact_threshold(cell: str, sign: float) -> None:
    check_run = record_loop_check("g10")
    contact_n = check_run[0].comparison.contact_n
    for share, passes in ((0.4, True), (0.6, False)):
        offset = sign * share * contact_n
        checks = evaluate_checks(check_run, {cell: partial(np.add, offset)})
        line = find_line(checks, "offset", cell)
        assert (line.low, line.high) == (-0.5 * contact_n, 0.5 * contact_n)
        assert line.passed == passes


@pytest.mark.parametrize(("test", "is_pressed"), [("g10", False), ("g0", False), ("gm2", True)])
def test_preload_is_compared_and_the_position_of_the_mass_is_not_where_bumpers_press(
    test: str, is_pressed: bool
) -> None:
    check_run = record_loop_check(test)
    lines = {(check.name, check.channel) for check in evaluate_checks(check_run)}
    assert (("preload, right over left", "force") in lines) == is_pressed
    is_open = min(check_run[0].specimen.gaps_m) > 0
    assert (("offset", "mass_disp_m") in lines) == is_open
    assert ("offset", "table_disp_m") in lines
    for cell in CELLS:
        assert (("offset", cell) in lines) == is_open
        assert (("preload", cell) in lines) != is_open


def test_an_isolated_mass_may_move_less_than_the_table() -> None:
    profile, block, drive, noise = record_loop_check("g10")
    checks = evaluate(block, drive, profile, RIG, noise)[0]
    for kind in ("disp_m", "acc_m_s2"):
        table, mass = (find_line(checks, ALIVE, f"{body}_{kind}") for body in ("table", "mass"))
        assert table.low == MIN_TONE_SNR
        assert mass.low == min(MIN_TONE_SNR, 0.02 * table.value)
    weak = {"table_disp_m": white(1e-2), "table_acc_m_s2": white(10.0)}
    for kind in ("disp_m", "acc_m_s2"):
        checks = evaluate_checks((profile, block, drive, noise), weak)
        table, mass = (find_line(checks, ALIVE, f"{body}_{kind}") for body in ("table", "mass"))
        assert mass.low == pytest.approx(0.02 * table.value)
        assert mass.low < MIN_TONE_SNR
