"""The loop check on the simulated table: clean it passes, and each planted fault fails its line."""

import cmath
import math
from collections.abc import Callable, Mapping
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
from table_io.config.calibration import command_to_volts, compute_tare, measure_noise, volts_to_si
from table_io.config.excitation.drive_file import ExpectedResponse
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.config.tare import TareRecord
from table_io.control.table_response import evaluate_transfer
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import Trajectory, start_trajectory
from table_io.records import Check
from table_io.safety.loop_check import (
    MIN_TONE_SNR,
    REMEDIES,
    SETTLE_CYCLES,
    count_hold_cycles,
    evaluate,
    find_notice,
    find_remedy,
    list_known_faults,
    plan_targets,
    unwrap_phase,
)
from table_io.safety.loop_check_data import LoopCheckData
from table_io.units import GRAVITY_M_S2
from tests.builders.drives import sine_segments
from tests.builders.profiles import list_shipped_sweeps, read_shipped_profile
from tests.builders.rigs import CHANNEL_ROWS, RIG, change_rig

CELLS = RIGHT_CELLS + LEFT_CELLS
TABLE_TWICE = "second derivative against table_acc_m_s2"
MASS_TWICE = "second derivative against mass_acc_m_s2"
AGAINST = "polarity against the command"
LAG = "polarity, lag behind the table"
ALIVE = "alive, tone over noise"
LEVEL_M_S2 = 0.05 * GRAVITY_M_S2

CheckRun = tuple[Profile, Block, Drive, dict[str, float]]
Change = Callable[[Float1D], Float1D]
Line = tuple[str, str]  # name, channel


def run_loop_check(profile: Profile, rig: RigConfig = RIG) -> CheckRun:
    """Return what the loop check of a profile records on the simulated table."""
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
    """Return the clean check of a shipped test, recorded once."""
    return run_loop_check(read_shipped_profile(name, acquisition={"rate_hz": rate_hz}))


def evaluate_checks(
    check_run: CheckRun | str, changes: Mapping[str, Change] | None = None
) -> tuple[Check, ...]:
    """Return the lines of a recorded check (by the name of its test), with changed channels."""
    recorded = record_loop_check(check_run) if isinstance(check_run, str) else check_run
    profile, block, drive, noise = recorded
    values = block.values.copy()
    for name, change in (changes or {}).items():
        values[CHANNEL_ROWS[name]] = change(block.values[CHANNEL_ROWS[name]].copy())
    return evaluate(replace(block, values=values), drive, profile, RIG, noise)[0]


def list_failures(
    check_run: CheckRun | str, changes: Mapping[str, Change] | None = None
) -> set[Line]:
    """Return the lines that fail."""
    checks = evaluate_checks(check_run, changes)
    return {(check.name, check.channel) for check in checks if not check.passed}


def make_white(rms: float) -> Change:
    return lambda values: values + rms * np.random.default_rng(5).standard_normal(values.size)


# Targets


def aim_hz(*frequencies_hz: float) -> Any:
    return pytest.approx(list(frequencies_hz))


@pytest.mark.parametrize(
    ("name", "tables", "expected_hz", "level"),
    [
        ("g4_ss3", {}, aim_hz(1.0, math.sqrt(5.0), 5.0), 0.1),
        ("gm10", {}, aim_hz(1.0, math.sqrt(10.0), 10.0), 0.1),
        ("g4_ss1", {}, aim_hz(0.5, math.sqrt(0.4), 0.8), 0.1),
        ("quickstart", {}, aim_hz(2.4, math.sqrt(2.4 * 4.4), 4.4), 0.1),
        ("g4_ss3", {"loop_check": {"frequencies_hz": (4.0, 0.7), "level": 0.05}}, [0.7, 4.0], 0.05),
        ("g4_ss3", {"excitation": {"start_hz": 3.0, "stop_hz": 3.0}}, [3.0], 0.1),
    ],
)
def test_plan_targets_frequencies_and_level(
    name: str, tables: dict[str, Any], expected_hz: Any, level: float
) -> None:
    targets = plan_targets(read_shipped_profile(name, **tables), RIG)
    assert [aim.frequency_hz for aim in targets] == expected_hz
    assert targets[0].level_m_s2 == pytest.approx(level * LEVEL_M_S2)


def test_plan_targets_reaches_harmonics_as_far_as_the_machine_allows() -> None:
    rig = change_rig(output={"bits": 24})
    for stop_hz, top_hz in ((2.5, 12.5), (10.0, 20.0)):  # five times, and the rig's 20 Hz
        sweep = {"start_hz": 0.5, "stop_hz": stop_hz}
        control = {"harmonics": True}
        plain = plan_targets(read_shipped_profile("gm10", excitation=sweep), rig)
        more = plan_targets(read_shipped_profile("gm10", excitation=sweep, control=control), rig)
        assert more[:3] == plain
        assert more[-1].frequency_hz == pytest.approx(top_hz)
        assert len(more) == 5


@pytest.mark.parametrize("bits", [12, 14, 16, 18])
@pytest.mark.parametrize("level", [0.02, 0.1])
def test_plan_targets_raises_amplitudes_below_the_converter(bits: int, level: float) -> None:
    """Never beyond a tenth of the level: then the frequency gives way."""
    rig = change_rig(output={"bits": bits})
    targets = plan_targets(read_shipped_profile("gm10", loop_check={"level": level}), rig)
    least_m = rig.output.least_lsb * rig.output.lsb_m
    for aim in targets:
        amplitude_m = aim.level_m_s2 / (2 * math.pi * aim.frequency_hz) ** 2
        assert amplitude_m >= least_m * (1 - 1e-9)
        assert aim.level_m_s2 <= 0.1 * LEVEL_M_S2 * (1 + 1e-9)
    top_hz = math.sqrt(0.1 * LEVEL_M_S2 / (20 * 0.12 / 2**bits)) / (2 * math.pi)
    assert targets[-1].frequency_hz == pytest.approx(min(10.0, top_hz), rel=1e-4)
    if bits == 18 and level == 0.02:
        assert targets[0].level_m_s2 == pytest.approx(0.02 * LEVEL_M_S2)
        assert targets[-1].level_m_s2 > 3 * targets[0].level_m_s2


def test_plan_targets_reaches_the_top_at_the_level_that_friction_asks_for() -> None:
    ends_hz = []
    for least_level_g in (0.0, 0.05):
        rig = change_rig(output={"bits": 15}, table_response={"least_level_g": least_level_g})
        ends_hz.append(plan_targets(read_shipped_profile("gm10"), rig)[-1].frequency_hz)
    assert ends_hz[0] < 9.0
    assert ends_hz[1] == pytest.approx(10.0)


def test_count_hold_cycles_for_two_seconds_at_least() -> None:
    profile = read_shipped_profile("gm10", loop_check={"cycles": 7})
    held = [count_hold_cycles(aim, profile) - SETTLE_CYCLES for aim in plan_targets(profile, RIG)]
    assert held == [7, 7, 20]


# Clean tables


@pytest.mark.parametrize(
    ("name", "rate_hz"),
    [(name, 2000.0) for name in list_shipped_sweeps()]
    + [(name, rate) for rate in (1000.0, 4000.0) for name in ("ginf", "g4_ss2", "g0", "gm10")],
)
def test_clean_table_passes_every_line(name: str, rate_hz: float) -> None:
    checks = evaluate_checks(record_loop_check(name, rate_hz))
    assert not [check for check in checks if not check.passed]
    names = {check.name for check in checks}
    assert {AGAINST, LAG, ALIVE, TABLE_TWICE, MASS_TWICE, "gain", "delay", "offset"} <= names
    assert {check.channel for check in checks} >= set(RIG.channels)
    lines = {(check.name, check.channel) for check in checks}
    profile, block, *_ = record_loop_check(name, rate_hz)
    is_touched = block.channel("force_r1_n").max() > 5 * profile.comparison.contact_n
    if name == "g4_ss2":
        assert is_touched
        assert ("polarity in contact", "force_l2_n") in lines


@pytest.mark.parametrize("name", ["ginf", "g4_ss3", "gm10"])
def test_response_is_that_of_the_servo(name: str) -> None:
    """Acceleration over command of the rig's servo with a linear specimen on it.

    y'' = p^2 (s - y) - 2 p y' - M x''/m with x''/y'' = (K + i w C) / (K - M w^2 + i w C).
    """
    contact = 2.0 if name == "gm10" else 0.0  # bumpers that never leave the mass

    def find_truth(f: float) -> complex:
        w, p = 2 * math.pi * f, 2 * math.pi * 20.0 / math.sqrt(math.sqrt(2.0) - 1.0)
        spring = 36e3 + contact * 510e3 + 1j * w * (1.1e3 + contact * 900.0)
        reaction = 550.0 / 2000.0 * spring / (spring - 550.0 * w**2)
        delay = cmath.exp(-1j * w * 5e-3)
        return p**2 * delay / (p**2 + 2j * p * w - w**2 * (1 + reaction))

    profile, block, drive, noise = record_loop_check(name)
    response = evaluate(block, drive, profile, RIG, noise)[1]
    assert response is not None
    for place, f in enumerate(response.frequencies_hz):
        true = find_truth(f)
        assert response.gain[place] == pytest.approx(abs(true), rel=5e-3)
        assert response.phase_rad[place] == pytest.approx(cmath.phase(true), abs=math.radians(1))
    for f in (0.5, 1.7, 3.3, profile.sweep.stop_hz):
        transfer = evaluate_transfer(response, f)
        assert abs(transfer) == pytest.approx(abs(find_truth(f)), rel=1e-2)
        assert cmath.phase(transfer / find_truth(f)) == pytest.approx(0.0, abs=math.radians(2))


# Planted faults


def flip_sign(values: Float1D) -> Float1D:
    return -values


def freeze(values: Float1D) -> Float1D:
    return np.full_like(values, values[0])


def multiply(factor: float) -> Change:
    return lambda values: factor * values


def add_tone(amplitude: float, hz: float, count: int) -> Change:
    """Add a tone to the last samples, after the check."""

    def change(values: Float1D) -> Float1D:
        values[-count:] += amplitude * np.sin(2 * math.pi * hz * np.arange(count) / 2000)
        return values

    return change


def lose_samples(share: float) -> Change:
    def change(values: Float1D) -> Float1D:
        values[np.random.default_rng(2).random(values.size) < share] = np.nan
        return values

    return change


# fmt: off
FAULTS: dict[str, tuple[dict[str, Change], set[Line]]] = {
    "table laser reversed": ({"table_disp_m": flip_sign},
                             {(AGAINST, "table_disp_m"), (TABLE_TWICE, "table_disp_m")}),
    "table accelerometer reversed": ({"table_acc_m_s2": flip_sign},
                                     {(AGAINST, "table_acc_m_s2"), (TABLE_TWICE, "table_disp_m")}),
    "mass laser on the other side": ({"mass_disp_m": flip_sign},
                                     {(LAG, "mass_disp_m"), (MASS_TWICE, "mass_disp_m")}),
    "mass accelerometer reversed": ({"mass_acc_m_s2": flip_sign},
                                    {(LAG, "mass_acc_m_s2"), (MASS_TWICE, "mass_disp_m")}),
    "both of the mass reversed": ({"mass_acc_m_s2": flip_sign, "mass_disp_m": flip_sign},
                                  {(LAG, "mass_acc_m_s2"), (LAG, "mass_disp_m")}),
    "table laser 25 % too much": ({"table_disp_m": multiply(1.25)},
                                  {("gain", "table_disp_m"), (TABLE_TWICE, "table_disp_m")}),
    "table accelerometer 25 % too little": (
        {"table_acc_m_s2": multiply(0.75)},
        {("gain", "table_acc_m_s2"), (TABLE_TWICE, "table_disp_m")}),
    "mass laser 25 % too much": ({"mass_disp_m": multiply(1.25)}, {(MASS_TWICE, "mass_disp_m")}),
    "mass accelerometer in g": ({"mass_acc_m_s2": multiply(1 / 9.80665)},
                                {(MASS_TWICE, "mass_disp_m")}),
    "mass laser noisy": ({"mass_disp_m": make_white(100e-6)},
                         {("noise under the level", "mass_disp_m")}),
    "table accelerometer noisy": ({"table_acc_m_s2": make_white(0.1)},
                                  {("noise under the level", "table_acc_m_s2")}),
    "load cell noisy": ({"force_l1_n": make_white(5.0)}, {("noise", "force_l1_n")}),
    "table laser dead": ({"table_disp_m": freeze}, {(ALIVE, "table_disp_m")}),
    "table accelerometer dead": ({"table_acc_m_s2": freeze}, {(ALIVE, "table_acc_m_s2")}),
    "mass laser dead": ({"mass_disp_m": freeze}, {(ALIVE, "mass_disp_m")}),
    "mass accelerometer only noise": (
        {"mass_acc_m_s2": lambda values: make_white(0.005)(0 * values)},
        {(ALIVE, "mass_acc_m_s2")}),
    "mass laser lost": ({"mass_disp_m": multiply(math.nan)}, {("lost samples", "mass_disp_m")}),
    "2 % lost": ({"mass_acc_m_s2": lose_samples(0.02)}, {("lost samples", "mass_acc_m_s2")}),
    "0.4 % lost": ({"mass_acc_m_s2": lose_samples(0.004)}, set()),
    "table laser 20 ms late": ({"table_disp_m": lambda values: np.roll(values, 40)},
                               {(TABLE_TWICE, "table_disp_m")}),
    "command not wired back": ({"drive_disp_m": multiply(0.0)},
                               {("command read back", "drive_disp_m")}),
    "command 2 % off": ({"drive_disp_m": multiply(1.02)}, {("command read back", "drive_disp_m")}),
    "table laser off by 0.3 mm": ({"table_disp_m": partial(np.add, 0.3e-3)},
                                  {("offset", "table_disp_m")}),
    "load cell off by 20 N": ({"force_r2_n": partial(np.add, -20.0)}, {("offset", "force_r2_n")}),
    "table hunts after the check": ({"table_acc_m_s2": add_tone(0.05, 30.0, 4000)},
                                    {("motion left after the check", "table_acc_m_s2")}),
    "mass rings after the check": ({"mass_acc_m_s2": add_tone(0.2, 1.3, 2000)}, set()),
}
# fmt: on


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_fails_its_lines(fault: str) -> None:
    changes, lines = FAULTS[fault]
    assert list_failures("g4_ss3", changes) == lines


@pytest.mark.parametrize("every", [2, 10])
@pytest.mark.parametrize("channel", ["mass_disp_m", "table_acc_m_s2", "force_l1_n"])
def test_channel_of_a_lower_rate_is_named(channel: str, every: int) -> None:
    hold: Change = lambda values: np.repeat(values[::every], every)[: values.size]  # noqa: E731
    assert ("new samples", channel) in list_failures("g4_ss3", {channel: hold})


@pytest.mark.parametrize("channel", ["mass_disp_m", "force_l1_n"])
def test_converter_of_fewer_bits_than_stated_is_no_lower_rate(channel: str) -> None:
    """Noise of two thirds of a step repeats more than half of the values."""
    step = 1.5 * RIG.sensor(channel).noise_si
    coarse: Change = lambda values: step * np.round(values / step)  # noqa: E731
    assert ("new samples", channel) not in list_failures("g4_ss3", {channel: coarse})


def test_cell_of_few_bits_that_rests_between_impacts_is_no_lower_rate() -> None:
    """More than half of the values repeat, but few during the impacts, a fifth of the time."""
    step = 8.0 * RIG.sensor("force_l1_n").noise_si

    def strike(values: np.ndarray) -> np.ndarray:
        impact = np.maximum(np.sin(np.arange(values.size) / 8.0) - 0.8, 0.0)
        return step * np.round((values + 200.0 * step * impact) / step)

    assert ("new samples", "force_l1_n") not in list_failures("g4_ss3", {"force_l1_n": strike})


@pytest.mark.parametrize("bits", [12, 24])
def test_known_noise_is_refused_with_that_of_its_converter_and_of_a_short_rest(bits: int) -> None:
    profile = record_loop_check("g4_ss3")[0]
    sensor = RIG.sensor("mass_acc_m_s2").model_copy(update={"bits": bits})
    limit = profile.plan.level_m_s2 / math.sqrt(2.0) / 10.0  # 20 dB below the level
    rest_samples = profile.acquisition.rest_s * profile.acquisition.rate_hz
    limit /= 1.0 + 4.0 / math.sqrt(2.0 * rest_samples)
    noise = math.sqrt(limit**2 - sensor.lsb_si**2 / 12.0) / sensor.si_per_unit
    for factor, count in ((0.999, 0), (1.001, 1)):
        noisy = sensor.model_copy(update={"noise_rms": factor * noise})
        sensors = tuple(noisy if s.channel == noisy.channel else s for s in RIG.sensors)
        rig = RIG.model_copy(update={"sensors": sensors})
        faults = list_known_faults(profile, rig)
        assert len(faults) == count
        assert all(" dB below the level " in fault for fault in faults)


@pytest.mark.parametrize(("factor", "count"), [(0.99, 0), (1.01, 1)])
def test_noise_of_the_newest_tare_is_known_before(factor: float, count: int) -> None:
    profile, sensor = record_loop_check("g4_ss3")[0], RIG.sensor("mass_acc_m_s2")
    limit_v = abs(sensor.volts_per_si) * profile.plan.level_m_s2 / math.sqrt(2.0) / 10.0
    rest_samples = profile.acquisition.rest_s * profile.acquisition.rate_hz
    limit_v /= 1.0 + 4.0 / math.sqrt(2.0 * rest_samples)
    tare = TareRecord(
        rig=RIG.name, at="2026-01-01T00:00:00+00:00", by="x", seconds=1.0,
        channels=(sensor.channel,), volts=(0.0,), noise_v=(factor * limit_v,),
    )  # fmt: skip
    assert len(list_known_faults(profile, RIG.model_copy(update={"tare": tare}))) == count


@pytest.mark.parametrize("name", ["g4_ss3", "ginf", "gm1"])
def test_mass_laser_on_the_table_is_told_from_a_reversed_one(name: str) -> None:
    """One line names it; those that would blame its sign or its gain are left out."""
    table = record_loop_check(name)[1].channel("table_disp_m")
    lines = {("motion against the floor", "mass_disp_m")}
    assert list_failures(name, {"mass_disp_m": lambda values: values - table}) == lines
    assert "rel_disp_m" in REMEDIES["motion against"]


@pytest.mark.parametrize(("gain", "is_noticed"), [(1.0, False), (1.002, False), (1.02, True)])
def test_sensors_of_a_body_that_differ_beyond_noise_are_noticed(
    gain: float, is_noticed: bool
) -> None:
    """Far below the limit, so the test runs; in contact no less."""
    for name in ("g4_ss3", "gm1"):
        checks = evaluate_checks(name, {"mass_disp_m": multiply(gain)})
        notices = [text for check in checks if (text := find_notice(check))]
        assert all(check.passed for check in checks)
        assert len(notices) == is_noticed
        assert all("mass_disp_m differs from mass_acc_m_s2" in text for text in notices)


@pytest.mark.parametrize("cell", CELLS)
def test_load_cell_shows_its_sign_and_its_death_in_contact_only(cell: str) -> None:
    only_noise: Change = lambda values: make_white(1.0)(0 * values)  # noqa: E731
    for change, line in (
        (flip_sign, "polarity in contact"),
        (only_noise, "force ratio to its neighbour"),
    ):
        assert list_failures("gm1", {cell: change}) == {(line, cell)}
        # Nothing touches here, so a cell without force and a reversed one look like a sound one.
        assert list_failures("ginf", {cell: change}) == set()


def test_load_cell_without_noise_is_dead_without_contact() -> None:
    profile, block, drive, _ = record_loop_check("ginf")
    values = block.values.copy()
    values[CHANNEL_ROWS["force_r1_n"]] = 0.0
    checks, _ = evaluate(replace(block, values=values), drive, profile, RIG)
    failed = {(check.name, check.channel) for check in checks if not check.passed}
    assert failed == {("alive, noise at rest", "force_r1_n")}


def test_motion_of_the_table_on_a_load_cell_is_cross_talk() -> None:
    """Judged at the test's level, ten times that of the check: 0.49 m/s2, allowed half of 10 N."""
    table = record_loop_check("g4_ss3")[1].channel("table_acc_m_s2")
    for factor, lines in ((15.0, {("cross-talk from the motion", "force_r1_n")}), (5.0, set())):
        change = partial(np.add, factor * table)
        assert list_failures("g4_ss3", {"force_r1_n": change}) == lines


def test_unit_of_the_table_laser_a_thousand_times_wrong_fails_its_gain() -> None:
    checks = evaluate_checks("g4_ss3", {"table_disp_m": multiply(1e3)})
    assert {check.channel for check in checks if not check.passed} == {"table_disp_m"}
    gain = find_line(checks, "gain", "table_disp_m")
    assert gain.value == pytest.approx(1000.0, rel=0.01)
    assert not gain.passed


def test_swapped_laser_and_accelerometer_fail_polarity_and_gain_of_both() -> None:
    block = record_loop_check("g4_ss3")[1]
    disp, acc = (block.channel(name) for name in ("table_disp_m", "table_acc_m_s2"))
    swap: dict[str, Change] = {"table_disp_m": lambda _: acc, "table_acc_m_s2": lambda _: disp}
    lines = list_failures("g4_ss3", swap)
    for channel in swap:
        assert {(AGAINST, channel), ("gain", channel)} <= lines
    assert {channel for _, channel in lines} == set(swap)


@pytest.mark.parametrize(
    ("name", "simulated", "line"),
    [
        ("g4_ss3", {"servo_delay_ms": 120.0}, "delay"),
        ("gm10", {"servo_bandwidth_hz": 5.0}, "gain at the highest frequency"),
    ],
)
def test_table_that_is_too_slow_fails(name: str, simulated: dict[str, float], line: str) -> None:
    check_run = run_loop_check(read_shipped_profile(name), change_rig(simulated=simulated))
    assert list_failures(check_run) == {(line, "table_disp_m"), (line, "table_acc_m_s2")}


@pytest.mark.parametrize(("lag_ms", "passes"), [(1.0, False), (15.0, True)])
def test_gain_at_the_lowest_frequency_rolls_off_with_the_lag(lag_ms: float, passes: bool) -> None:
    profile, block, drive, noise = record_loop_check("gm10")
    rig = change_rig(table_response={"gain": [1.0, 1.2], "lag_ms": lag_ms})
    checks = evaluate(block, drive, profile, rig, noise)[0]
    assert find_line(checks, "gain", "table_disp_m").value < 1.0
    failed = {check.name for check in checks if not check.passed}
    assert failed == (set() if passes else {"gain"})


def test_below_the_least_level_a_gain_that_is_too_large_is_no_friction() -> None:
    """Friction holds a table back: twice the motion is a wrong span of output or sensors."""
    profile, block, drive, noise = record_loop_check("gm10")
    rig = change_rig(table_response={"least_level_g": 0.1})
    doubled = block.values.copy()
    for name in ("table_disp_m", "table_acc_m_s2"):
        doubled[block.channels.index(name)] *= 2.0
    checks = evaluate(replace(block, values=doubled), drive, profile, rig, noise)[0]
    failed = {check.name for check in checks if not check.passed}
    assert {"gain", "gain at the highest frequency"} <= failed


@pytest.mark.parametrize(("least_level_g", "passes"), [(0.05, False), (0.0501, True)])
def test_gain_of_a_table_below_its_least_level_is_reported_only(
    least_level_g: float, passes: bool
) -> None:
    slow = run_loop_check(
        read_shipped_profile("gm10"), change_rig(simulated={"servo_bandwidth_hz": 5.0})
    )
    profile, block, drive, noise = slow
    rig = change_rig(table_response={"least_level_g": least_level_g})
    checks = evaluate(block, drive, profile, rig, noise)[0]
    line = find_line(checks, "gain at the highest frequency", "table_disp_m")
    assert line.value < rig.table_response.top_gain[0]
    assert line.passed == passes


def test_delays_that_the_noise_at_rest_sets_apart_are_no_fault_of_the_table() -> None:
    rms = 0.1 * LEVEL_M_S2
    spreads = []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        noisy = {"table_acc_m_s2": lambda v, rng=rng: v + rms * rng.standard_normal(v.size)}
        checks = evaluate_checks("g4_ss1", noisy)
        lines = [
            check
            for check in checks
            if check.channel == "table_acc_m_s2" and check.name.startswith(("gain", "delay"))
        ]
        assert [check.name for check in lines if not check.passed] == []
        spreads.append(find_line(checks, "delay over the frequencies", "table_acc_m_s2").value)
    assert max(spreads) > 2 * RIG.table_response.delay_spread_ms


def test_mass_pressed_aside_by_uneven_bumpers_is_not_off() -> None:
    gaps = {"gap_mm": -2.0, "gap_right_mm": -3.0, "gap_left_mm": 1.0}
    check_run = run_loop_check(read_shipped_profile("quickstart", specimen=gaps))
    assert check_run[1].channel("mass_disp_m")[:1000].mean() < -1e-3
    assert list_failures(check_run) == set()


def test_sensor_that_errs_at_one_frequency_leaves_the_smooth_curve() -> None:
    drive = record_loop_check("gm10")[2]
    held = [segment for segment in sine_segments(drive) if segment.label == Label.CHECK][1]
    middle = slice(held.start, held.end)

    def amplify(values: Float1D) -> Float1D:
        values[middle] *= 1.3
        return values

    def delay(values: Float1D) -> Float1D:
        values[middle] = np.roll(values[middle], 60)
        return values

    for change, line in (
        (amplify, "gain off a smooth curve"),
        (delay, "delay over the frequencies"),
    ):
        lines = list_failures("gm10", {"table_acc_m_s2": change})
        assert lines == {(line, "table_acc_m_s2"), (TABLE_TWICE, "table_disp_m")}


def rely_on_measured_response(
    name: str, gain_ratio: float = 1.0, extra_ms: float = 0.0
) -> CheckRun:
    """Return a check whose drive relies on the measured response but for an error at 2nd motion."""
    profile, block, drive, noise = record_loop_check(name)
    data = LoopCheckData(block, drive, profile, RIG, noise)
    hz, tones = data.frequencies_hz, data.tones("table_acc_m_s2")
    error = np.where(np.arange(hz.size) == 1, 1.0, 0.0)
    response = ExpectedResponse(
        frequencies_hz=tuple(hz),
        levels_m_s2=tuple(data.levels_m_s2),
        gain=tuple(np.abs(tones) * gain_ratio**error),
        phase_rad=tuple(np.angle(tones) - 2e-3 * math.pi * hz * extra_ms * error),
    )
    relying = profile.model_copy()
    relying.__dict__["plan"] = replace(profile.plan, response=response)
    return relying, block, drive, noise


def test_resonance_that_the_drive_relies_on_is_no_fault() -> None:
    """Both sensors of the table see it; without a drive the response is interpolated there."""
    recorded = record_loop_check("gm10")
    held = [part for part in sine_segments(recorded[2]) if part.label == Label.CHECK][1]

    def amplify(values: Float1D) -> Float1D:
        values[held.start : held.end] *= 1.3
        return values

    resonance = {"table_acc_m_s2": amplify, "table_disp_m": amplify}
    assert {name for name, _ in list_failures("gm10", resonance)} == {"gain off a smooth curve"}
    relying = rely_on_measured_response("gm10", gain_ratio=1.3)
    assert list_failures(relying, resonance) == set()
    assert {name for name, _ in list_failures(relying)} == {"gain off that of the drive"}


def test_table_that_lags_more_than_its_drive_relies_on_fails() -> None:
    late = "delay off that of the drive, over the frequencies"
    failures = list_failures(rely_on_measured_response("gm10", extra_ms=-30.0))
    assert failures == {(late, "table_acc_m_s2"), (late, "table_disp_m")}


def test_drive_of_another_loop_check_leaves_the_smooth_curve() -> None:
    profile, block, drive, noise = rely_on_measured_response("gm10", gain_ratio=2.0)
    response = profile.plan.response
    assert response is not None
    levels = tuple(2.0 * level for level in response.levels_m_s2)
    other = profile.model_copy()
    other.__dict__["plan"] = replace(
        profile.plan, response=response.model_copy(update={"levels_m_s2": levels})
    )
    assert list_failures((other, block, drive, noise)) == set()


def test_noise_at_the_tare_counts_too() -> None:
    profile, block, drive, noise = record_loop_check("g4_ss3")
    noisy = (profile, block, drive, noise | {"mass_acc_m_s2": 0.05})
    assert list_failures(noisy) == {("noise under the level", "mass_acc_m_s2")}


# Channels that are measured


def test_evaluate_judges_only_measured_channels() -> None:
    profile, block, drive, noise = record_loop_check("g4_ss3")
    names = ("drive_disp_m", "table_disp_m", "table_acc_m_s2")
    least = replace(block, channels=names, values=block.values[:3])
    checks, response = evaluate(least, drive, profile, RIG, noise)
    assert all(check.passed for check in checks)
    assert {check.channel for check in checks} == set(names)
    assert response == evaluate(block, drive, profile, RIG, noise)[1]
    at_rest = start_trajectory(profile).to_drive(())
    assert evaluate(block, at_rest, profile, RIG, noise) == ((), None)


@pytest.mark.parametrize(("sign", "lines"), [(1.0, set()), (-1.0, {(MASS_TWICE, "rel_disp_m")})])
def test_relative_displacement_is_compared_with_the_accelerometer(
    sign: float, lines: set[Line]
) -> None:
    profile, block, drive, noise = record_loop_check("g4_ss3")
    rig = change_rig(sensors={"mass_disp_m": {"channel": "rel_disp_m"}})
    values = block.values.copy()
    relative = block.channel("mass_disp_m") - block.channel("table_disp_m")
    values[CHANNEL_ROWS["mass_disp_m"]] = sign * relative
    measured = replace(block, channels=rig.channels, values=values)
    checks, _ = evaluate(measured, drive, profile, rig, noise)
    assert ("lost samples", "rel_disp_m") in {(check.name, check.channel) for check in checks}
    assert {(check.name, check.channel) for check in checks if not check.passed} == lines


def test_every_line_that_can_fail_has_a_remedy() -> None:
    checks = {check for name in ("g4_ss2", "gm1") for check in evaluate_checks(name)}
    profile, block, drive, noise = record_loop_check("gm1")
    preload_n = ((0.0, 500.0), (0.0, 500.0))
    checks |= set(evaluate(block, drive, profile, RIG, noise, preload_n)[0])
    checks |= set(evaluate_checks(rely_on_measured_response("gm10")))
    for check in checks:
        limited = math.isfinite(check.low) or math.isfinite(check.high)
        assert bool(find_remedy(check)) == limited, check.name
    for start in REMEDIES:
        assert any(check.name.startswith(start) for check in checks)


# Limits to the number


def find_line(checks: tuple[Check, ...], name: str, channel: str) -> Check:
    (line,) = (check for check in checks if (check.name, check.channel) == (name, channel))
    return line


@given(
    frequencies=st.lists(st.floats(0.1, 20.0), min_size=2, max_size=6, unique=True),
    delay_s=st.floats(-0.05, 0.05),
    start=st.floats(-1.0, 1.0),
)
@settings(derandomize=True)
def test_unwrap_phase_along_a_delay(frequencies: list[float], delay_s: float, start: float) -> None:
    frequencies_hz = np.sort(frequencies)
    frequencies_hz *= 0.1 / frequencies_hz[0]  # the lowest phase is within half a turn
    phase = -2.0 * math.pi * frequencies_hz * delay_s * (1.0 + start / 1e3)
    unwrapped = unwrap_phase(np.exp(1j * phase), frequencies_hz)
    np.testing.assert_allclose(unwrapped, phase, rtol=0, atol=1e-9)


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("share", [0.4, -0.4, 0.6, -0.6])
def test_cell_may_be_off_by_half_the_contact_threshold(cell: str, share: float) -> None:
    contact_n = record_loop_check("g10")[0].comparison.contact_n
    checks = evaluate_checks("g10", {cell: partial(np.add, share * contact_n)})
    line = find_line(checks, "offset", cell)
    assert (line.low, line.high) == (-0.5 * contact_n, 0.5 * contact_n)
    assert line.passed == (abs(share) < 0.5)


@pytest.mark.parametrize(("test", "is_pressed"), [("g10", False), ("g0", False), ("gm2", True)])
def test_preload_is_compared_where_bumpers_press(test: str, is_pressed: bool) -> None:
    """The position of the mass only where they do not."""
    lines = {(check.name, check.channel) for check in evaluate_checks(test)}
    assert (("preload, right over left", "force") in lines) == is_pressed
    is_open = min(record_loop_check(test)[0].specimen.gaps_m) > 0
    assert (("offset", "mass_disp_m") in lines) == is_open
    assert ("offset", "table_disp_m") in lines
    for cell in CELLS:
        assert (("offset", cell) in lines) == is_open
        assert (("preload", cell) in lines) != is_open


def test_isolated_mass_may_move_less_than_the_table() -> None:
    weak = {"table_disp_m": make_white(1e-2), "table_acc_m_s2": make_white(10.0)}
    for kind in ("disp_m", "acc_m_s2"):
        for changes in ({}, weak):
            checks = evaluate_checks("g10", changes)
            table, mass = (find_line(checks, ALIVE, f"{body}_{kind}") for body in ("table", "mass"))
            assert table.low == MIN_TONE_SNR
            assert mass.low == min(MIN_TONE_SNR, 0.02 * table.value)
            assert (mass.low < MIN_TONE_SNR) == bool(changes)
