"""Pre-flight: demands against closed forms, each limit and warning on both of its sides."""

import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from table_io.block import Float1D, Label
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.config.sensor import CLIP_RATIO
from table_io.errors import InputError
from table_io.excitation.drive import Correction, Drive, HistorySegment, Segment
from table_io.excitation.trajectory import SineTarget, plan_excitation, plan_sweep
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
from table_io.sequencer.procedure import make_test_plan, nominal_drive, start_test
from table_io.units import GRAVITY_M_S2
from tests.builders.profiles import make_history_profile, make_profile
from tests.builders.rigs import RIG, change_rig

LEVEL_M_S2 = 0.05 * GRAVITY_M_S2
LAW = settings(max_examples=10, derandomize=True)
SMALL = StepDemand(3, "forward", 2.0, 1e-6, 1e-6, 1e-6, 1e-6, math.inf)
WINDOW = replace(SMALL, step=0, frequency_hz=math.nan)
SLOWEST = "step 0 (0.5 Hz forward)"
COARSE_OUTPUT = change_rig(output={"span_mm": 100.0, "bits": 16, "least_lsb": 1})


def make_test(start_hz: float = 0.5, stop_hz: float = 10.0, **tables: Any) -> Profile:
    """Return a test of two steps, up and down, with other tables."""
    step_hz = stop_hz - start_hz
    return make_profile(
        tables=tables, start_hz=start_hz, stop_hz=stop_hz, step_hz=step_hz, cycles=3
    )


def demand_sweep(test: Profile, rig: RigConfig = RIG) -> tuple[StepDemand, ...]:
    return compute_demands(plan_sweep(test), test, rig)


def demand_all(test: Profile, rig: RigConfig = RIG) -> tuple[StepDemand, ...]:
    """Return the demands of the drive as it is played, loop check and tuning included."""
    return compute_demands(nominal_drive(make_test_plan(test, rig)), test, rig)


def list_faults(
    demands: tuple[StepDemand, ...], rig: RigConfig = RIG, test: Profile | None = None
) -> tuple[InputError, ...]:
    """Return the faults of a refusal as a whole; none where it is allowed."""
    try:
        check_limits(demands, test or make_test(), rig, "a.toml")
    except InputError as error:
        return error.faults if error.where == "a.toml" else (error,)
    return ()


def read_number(fault: InputError) -> float:
    """Return the quantity that a fault states, in its unit."""
    return float(fault.problem.split()[0])


def set_demand(row: StepDemand, name: str, value: float) -> StepDemand:
    changes: dict[str, Any] = {name: value}
    return replace(row, **changes)


def motion_of(row: StepDemand) -> tuple[float, float, float]:
    return row.displacement_m, row.velocity_m_s, row.acceleration_m_s2


# Demands: the drive as played, differentiated


def differentiate(command_m: Float1D, rate_hz: float) -> Float1D:
    """Return displacement, velocity and acceleration by central differences, without both ends."""
    before, here, after = command_m[:-2], command_m[1:-1], command_m[2:]
    speed = 0.5 * rate_hz * (after - before)
    acceleration = rate_hz**2 * (after - 2 * here + before)
    return np.array([here, speed, acceleration])


@pytest.mark.parametrize("rate_hz", [1000.0, 4000.0])
@pytest.mark.parametrize("stop_hz", [0.7, 5.0])
def test_demands_of_a_step_are_those_of_its_command(stop_hz: float, rate_hz: float) -> None:
    """Held cycles and blends of all steps; the ramp to rest belongs to the last one."""
    test = make_test(0.5, stop_hz, acquisition={"rate_hz": rate_hz})
    drive = plan_sweep(test)
    motion = differentiate(drive.command(-1, drive.planned_end + 2), rate_hz)
    demands = compute_demands(drive, test, RIG)
    directions = [(row.step, row.direction) for row in demands]
    assert directions == [(0, "forward"), (1, "forward"), (2, "backward"), (3, "backward")]
    for row in demands:
        parts = [
            motion[:, segment.start : segment.end]
            for segment in drive.sine_segments
            if segment.step == row.step
        ]
        expected = np.abs(np.concatenate(parts, axis=1)).max(axis=1)
        assert motion_of(row) == pytest.approx(expected.tolist(), rel=3e-4)
        assert row.force_n == pytest.approx(2550.0 * row.acceleration_m_s2)
        held_m = LEVEL_M_S2 / (2 * math.pi * drive.steps[row.step].frequency_hz) ** 2
        assert row.amplitude_lsb == pytest.approx(held_m / (0.12 / 2**18))


@pytest.mark.parametrize("cycles", [4, 8])
@pytest.mark.parametrize("phase", [0.0, 0.25, 0.5])
def test_held_cycles_are_evaluated_at_their_peaks(cycles: int, phase: float) -> None:
    level = LEVEL_M_S2
    hold = Segment(0, 1000 * cycles, Label.MEASURE, 0, 1.0, 1.0, level, level, phase, cycles)
    drive = Drive(1000.0, (hold,), (Step(0, "forward", 1.0, level),))
    (row,) = compute_demands(drive, make_test(), RIG)
    w = 2 * math.pi
    assert motion_of(row) == pytest.approx((level / w**2, level / w, level), rel=1e-12)


def test_step_that_is_not_played_yet_counts_with_its_held_cycles() -> None:
    drive = plan_sweep(make_test())
    without = Drive(drive.rate_hz, (), drive.steps)
    for row, step in zip(compute_demands(without, make_test(), RIG), drive.steps, strict=True):
        w = 2 * math.pi * step.frequency_hz
        held = (LEVEL_M_S2 / w**2, LEVEL_M_S2 / w, LEVEL_M_S2)
        assert motion_of(row) == pytest.approx(held)
        assert row.amplitude_lsb == pytest.approx(held[0] / RIG.output.lsb_m)


def make_controlled(share: float) -> Any:
    """Return a test whose steps are held with feedback of a share of their command."""
    continuation = SimpleNamespace(max_feedback=share)
    return SimpleNamespace(
        acquisition=make_test().acquisition,
        specimen=make_test().specimen,
        continuation=continuation,
        swept_sine=None,
    )


def test_feedback_adds_to_every_demand_of_a_step_and_to_no_loop_check() -> None:
    test = make_test()
    drive = nominal_drive(make_test_plan(test, RIG))
    plain_rows = compute_demands(drive, test, RIG)
    for plain, row in zip(
        plain_rows, compute_demands(drive, make_controlled(0.4), RIG), strict=True
    ):
        d, v, a = motion_of(row)
        if plain.step < 0:
            assert (d, v, a) == motion_of(plain)
            continue
        level, w = LEVEL_M_S2, 2 * math.pi * plain.frequency_hz
        assert d == pytest.approx(motion_of(plain)[0] + 0.4 * level / w**2)
        assert v == pytest.approx(math.sqrt(2.0 * d * a))  # |q'|^2 <= 2 |q| |q''|
        assert 1.125 * level <= a <= 1.15 * level
        assert row.force_n == pytest.approx(2550.0 * a)
        assert row.amplitude_lsb == plain.amplitude_lsb  # of the smallest, without feedback


@pytest.mark.parametrize("seed", range(6))
def test_stop_from_anywhere_with_the_largest_feedback_stays_within_the_demand(seed: int) -> None:
    """Corrections that raise the command, within its acceleration, end in a decay."""
    rng, rate_hz, f, share = np.random.default_rng(seed), 1000.0, 2.0, 0.4
    level, w = LEVEL_M_S2, 2 * math.pi * f
    hold = Segment(0, 8000, Label.SETTLE, 0, f, f, level, level, 0.0, 16)
    t = np.arange(6000) / rate_hz
    wave = (
        np.sin(w * t + math.pi + rng.uniform(-1.0, 1.0))
        * np.sin(np.pi * np.arange(6000) / 6000) ** 3
    )
    wave *= share * level / w**2
    held = Drive(rate_hz, (hold,), ()).command(1000, 6000)
    while np.abs(np.diff(held + wave, 2)).max() * rate_hz**2 > 1.125 * level:
        wave *= 0.99
    correction = Correction(1000, wave)
    drive = Drive(rate_hz, (hold,), (Step(0, "forward", f, level),), correction=correction)
    (row,) = compute_demands(drive, make_controlled(share), RIG)
    peaks = [np.abs(differentiate(drive.decay_from(at).command(at - 500, 2000), rate_hz)[2]).max()
             for at in range(3000, 5000, 37)]  # fmt: skip
    assert 0.8 * row.acceleration_m_s2 < max(peaks) <= row.acceleration_m_s2 * (1 + 1e-6)


def test_loop_check_has_its_rows_before_the_steps() -> None:
    demands = demand_all(make_test())
    assert [row.step for row in demands] == [-1, -1, -1, 0, 1, 2, 3]
    assert demands[0].name == "loop check (1 Hz)"
    for row, f in zip(demands, (1.0, math.sqrt(10.0), 10.0), strict=False):
        assert row.frequency_hz == pytest.approx(f)
        assert row.acceleration_m_s2 == pytest.approx(0.1 * LEVEL_M_S2, rel=0.06)
        amplitude_m = 0.1 * LEVEL_M_S2 / (2 * math.pi * f) ** 2
        assert row.amplitude_lsb == pytest.approx(amplitude_m / RIG.output.lsb_m)
    # The first step has the frequency of the check, not its level.
    assert demand_all(make_test(1.0, 10.0))[0].amplitude_lsb == demands[0].amplitude_lsb
    # Its amplitudes are planned for the converter: neither refused nor warned of.
    coarse = (replace(demands[0], amplitude_lsb=5.0), *demands[1:])
    assert list_faults(coarse) == ()
    assert list_drive_warnings(coarse, RIG) == []


def make_history(seed: int, count: int) -> HistorySegment:
    """Return a smooth history of five waves from rest to rest, in three windows."""
    t = np.arange(count) / count
    sizes = 0.02 * np.random.default_rng(seed).standard_normal(5) / np.arange(1, 6) ** 1.5
    waves = np.sin(math.pi * np.outer(np.arange(1, 6), t))
    return HistorySegment(0, sizes @ waves * np.sin(math.pi * t) ** 3, 3)


@pytest.mark.parametrize("rate_hz", [500.0, 1000.0])
def test_worst_stop_of_a_history_is_that_of_a_decay_from_every_sample(rate_hz: float) -> None:
    history = make_history(2, 900)
    drive = Drive(rate_hz, (history,), ())
    *windows, stop = compute_demands(drive, make_test(), RIG)
    length = history.decay_samples(0.0, rate_hz)
    played = np.zeros(3)
    for first in range(history.count):
        motion = differentiate(drive.decay_from(first).command(first - 1, length + 3), rate_hz)
        played = np.maximum(played, np.abs(motion).max(axis=1))
    assert motion_of(stop) == pytest.approx(played.tolist(), rel=1e-5)
    # A stop demands more than the history itself, of whose windows the rows are the peaks.
    assert stop.acceleration_m_s2 > 1.01 * max(row.acceleration_m_s2 for row in windows)
    motion = differentiate(np.pad(history.history_m, 1), rate_hz)
    for k, row in enumerate(windows):
        expected = np.abs(motion[:, 300 * k : 300 * (k + 1)]).max(axis=1)
        assert motion_of(row) == pytest.approx(expected.tolist())
    for row in (*windows, stop):
        assert row.force_n == pytest.approx(2550.0 * row.acceleration_m_s2)
        assert row.amplitude_lsb == pytest.approx(row.displacement_m / RIG.output.lsb_m)
    assert [row.step for row in (*windows, stop)] == [0, 1, 2, 3]


# Refusals: the last value that is allowed, and the next one that is not


def test_all_exceeded_limits_stand_in_one_refusal() -> None:
    low = {"stroke_mm": 1.0, "velocity_mm_s": 1.0, "acceleration_g": 0.01, "force_kn": 0.1}
    test = make_test(acquisition={"rate_hz": 1500.0})
    faults = {
        fault.key: fault for fault in list_faults(demand_sweep(test), change_rig(limits=low), test)
    }
    assert faults.keys() == {
        "displacement",
        "velocity",
        "acceleration",
        "force",
        "acquisition.rate_hz",
    }
    rate = faults["acquisition.rate_hz"]
    assert (rate.value, rate.allowed) == (1500.0, "1000, 2000, 4000")


def test_loop_check_beyond_the_table_is_refused_by_name() -> None:
    test = make_test(loop_check={"frequencies_hz": (0.05, 30.0)})
    faults = {fault.key: fault for fault in list_faults(demand_all(test), RIG, test)}
    top = faults["loop_check.frequencies_hz"]
    assert (top.value, top.allowed) == (30.0, "at most 20")
    assert faults["displacement"].where == "loop check (0.05 Hz) and 1 more"
    assert read_number(faults["displacement"]) == pytest.approx(496.9, rel=0.01)
    assert "loop_check.level" in faults["displacement"].remedy


@pytest.mark.parametrize(
    ("table", "field", "name", "demand", "to_unit"),
    [
        ("limits", "stroke_mm", "displacement", "displacement_m", 1e3),
        ("output", "span_mm", "displacement", "displacement_m", 1e3),
        ("limits", "velocity_mm_s", "velocity", "velocity_m_s", 1e3),
        ("limits", "acceleration_g", "acceleration", "acceleration_m_s2", 1 / GRAVITY_M_S2),
        ("limits", "force_kn", "force", "force_n", 1e-3),
        ("limits", "peak_flow_l_min", "flow", "velocity_m_s", 60e3 * 20e-4),
    ],
)
@given(value=st.floats(1e-3, 0.05), frequency_hz=st.floats(0.1, 9.0) | st.just(math.nan))
@LAW
def test_demand_at_its_limit_is_allowed_and_beyond_it_refused(
    table: str,
    field: str,
    name: str,
    demand: str,
    to_unit: float,
    value: float,
    frequency_hz: float,
) -> None:
    row = set_demand(replace(SMALL, frequency_hz=frequency_hz), demand, value)
    area = {"piston_area_cm2": 20.0} if name == "flow" else {}

    def limit_rig(allowed: float) -> RigConfig:
        tables: dict[str, Any] = {table: {field: allowed, **area}}
        return change_rig(**tables)

    (limit,) = (item for item in list_limits(limit_rig(1.0)) if item.name == name)
    allowed = limit.demand(row)
    assert allowed == pytest.approx(to_unit * value, rel=1e-12)
    assert list_faults((row,), limit_rig(allowed)) == ()
    (fault,) = list_faults((SMALL, row, row), limit_rig(float(np.nextafter(allowed, 0.0))))
    assert (fault.key, fault.where) == (name, f"{row.name} and 1 more")
    assert read_number(fault) == pytest.approx(allowed, rel=1e-3)
    (fault,) = list_faults((row, SMALL), limit_rig(0.99 * allowed))
    assert fault.where == row.name


@pytest.mark.parametrize(
    ("channel", "demand", "si_per_unit"),
    [
        ("drive_disp_m", "displacement_m", 1e-3),
        ("table_disp_m", "displacement_m", 1e-3),
        ("table_acc_m_s2", "acceleration_m_s2", GRAVITY_M_S2),
    ],
)
@given(value=st.floats(1e-3, 0.05))
@LAW
def test_sensor_of_the_table_may_be_used_up_to_where_it_counts_as_clipped(
    channel: str, demand: str, si_per_unit: float, value: float
) -> None:
    """What the specimen does to its sensors is not known before the test."""
    row = set_demand(SMALL, demand, value)
    full = value / si_per_unit / CLIP_RATIO * (1 + 1e-12)
    mass = {"mass_disp_m": {"range": 1e-3}, "mass_acc_m_s2": {"range": 1e-3}}
    assert list_faults((SMALL, row), change_rig(sensors={channel: {"range": full}, **mass})) == ()
    rig = change_rig(sensors={channel: {"range": full * (1 - 2e-12)}})
    (fault,) = list_faults((SMALL, row, SMALL), rig)
    assert (fault.key, fault.where) == (channel, row.name)
    assert read_number(fault) == pytest.approx(value / si_per_unit, rel=1e-3)


@pytest.mark.parametrize("least_lsb", [7, 20])
def test_smallest_step_and_peak_of_a_history_need_steps_of_the_dac(least_lsb: int) -> None:
    rig = change_rig(output={"least_lsb": least_lsb})
    check = replace(SMALL, step=-1, amplitude_lsb=1.0)  # plans its own amplitudes
    refused = float(np.nextafter(least_lsb, 0.0))
    for step in (0, 3):
        smallest = replace(SMALL, step=step, amplitude_lsb=float(least_lsb))
        assert list_faults((check, SMALL, smallest, SMALL), rig) == ()
        coarse = replace(smallest, amplitude_lsb=refused)
        (fault,) = list_faults((check, SMALL, coarse, smallest), rig)
        assert (fault.key, fault.where) == ("amplitude", f"step {step} (2 Hz)")
    low = replace(WINDOW, amplitude_lsb=1.0)
    assert list_faults((low, replace(WINDOW, step=1, amplitude_lsb=float(least_lsb))), rig) == ()
    (fault,) = list_faults((low, replace(WINDOW, step=1, amplitude_lsb=refused)), rig)
    assert fault.key == "displacement"


@pytest.mark.parametrize(
    ("max_hz", "check", "keys"),
    [
        (10.0, {}, []),
        (float(np.nextafter(10.0, 0.0)), {}, [("sweep.stop_hz", 10.0)]),
        (12.0, {"frequencies_hz": (0.5, 12.0, 3.0)}, []),
        (11.99, {"frequencies_hz": (0.5, 12.0, 3.0)}, [("loop_check.frequencies_hz", 12.0)]),
        (
            9.0,
            {"frequencies_hz": (0.5, 12.0, 3.0)},
            [("sweep.stop_hz", 10.0), ("loop_check.frequencies_hz", 12.0)],
        ),
        (11.99, {"frequencies_hz": (0.5, 12.0, 3.0), "enabled": False}, []),
    ],
)
def test_highest_frequency_of_sweep_and_loop_check(
    max_hz: float, check: dict[str, Any], keys: list[tuple[str, float]]
) -> None:
    rig = change_rig(limits={"frequency_hz": max_hz})
    faults = list_faults((SMALL,), rig, make_test(loop_check=check))
    assert [(fault.key, fault.value) for fault in faults] == keys


@pytest.mark.parametrize(
    ("rate_hz", "faults"),
    [(1000.0, []), (float(np.nextafter(1000.0, 0.0)), [("acquisition.rate_hz", "at least 1000")])],
)
def test_samples_per_cycle_of_what_is_played(rate_hz: float, faults: list[tuple[str, str]]) -> None:
    """A file that is imported may have fewer: only a motion is refused."""
    test = make_test(acquisition={"rate_hz": rate_hz})
    refusals = list_faults((SMALL,), RIG.model_copy(update={"rates_hz": (rate_hz,)}), test)
    assert [(fault.key, fault.allowed) for fault in refusals] == faults


@pytest.mark.parametrize("key", ["piston_area_cm2", "peak_flow_l_min"])
def test_flow_without_its_area_is_no_limit(key: str) -> None:
    with pytest.raises(ValueError, match="go together"):
        change_rig(limits={key: 100.0})


# The level of a history that fits


def read_level(remedy: str) -> float:
    return float(
        remedy.split("by ")[1].split(",", maxsplit=1)[0]
        if "by " in remedy
        else remedy.rsplit(maxsplit=1)[-1]
    )


@pytest.mark.parametrize(
    ("kind", "keys"),
    [
        ("sine_pulse", {"frequency_hz": 1.0, "acceleration_g": 0.9}),
        ("half_sine", {"duration_s": 0.3, "acceleration_g": 0.5}),
        ("chirp", {"start_hz": 0.4, "stop_hz": 5.0, "duration_s": 20.0, "acceleration_g": 0.2}),
        ("random", {"low_hz": 0.3, "high_hz": 10.0, "duration_s": 20.0, "rms_g": 0.3}),
        ("cyclic", {"protocol": [[80.0, 1.5, 3]]}),
    ],
)
def test_history_beyond_a_limit_is_refused_with_the_level_that_fits(
    kind: str, keys: dict[str, Any]
) -> None:
    def refuse(changed: dict[str, Any]) -> dict[str, InputError]:
        test = make_history_profile(kind, **changed)
        demands = compute_demands(plan_excitation(test), test, RIG)
        return {fault.key: fault for fault in list_faults(demands, RIG, test)}

    faults = refuse(keys)
    assert {"displacement", "table_disp_m"} <= faults.keys()
    remedy = faults["displacement"].remedy
    for share, fits in ((1.0, True), (1.02, False)):
        level = read_level(remedy) * share
        if kind == "cyclic":
            changed: dict[str, Any] = {"protocol": [[80.0 * level, 1.5, 3]]}
        else:
            key = type(make_history_profile(kind, **keys).excitation).LEVEL_KEY
            assert f"{key} = " in remedy
            changed = keys | {key: level}
        assert (refuse(changed) == {}) == fits


@pytest.mark.parametrize(
    ("demand", "allowed", "ranges"),
    [
        ("displacement_m", 0.06, {}),
        ("velocity_m_s", 0.5, {}),
        ("acceleration_m_s2", GRAVITY_M_S2, {}),
        ("force_n", 30e3, {}),
        ("displacement_m", 0.04 * CLIP_RATIO, {"table_disp_m": 40.0, "mass_disp_m": 1.0}),
        (
            "acceleration_m_s2",
            0.3 * CLIP_RATIO * GRAVITY_M_S2,
            {"table_acc_m_s2": 0.3, "mass_acc_m_s2": 0.1},
        ),
    ],
)
@given(excess=st.floats(1.01, 1e3), level=st.floats(1e-3, 10.0), has_points=st.booleans())
@example(excess=10.0, level=1.0, has_points=False)  # a hair below a power of ten
@LAW
def test_level_that_fits_is_in_proportion_to_the_largest_excess(
    demand: str,
    allowed: float,
    ranges: dict[str, float],
    excess: float,
    level: float,
    has_points: bool,
) -> None:
    rig = change_rig(sensors={channel: {"range": size} for channel, size in ranges.items()})
    keys: dict[str, Any] = {"start_hz": 0.4, "stop_hz": 5.0, "duration_s": 20.0}
    points = {"level_points": [[0.4, 0.2], [5.0, 0.2]]}
    test = make_history_profile(
        "chirp", **keys, **(points if has_points else {"acceleration_g": level})
    )
    standstill = StepDemand(0, "window 0", math.nan, 0.0, 0.0, 0.0, 0.0, 0.0)
    demands = (standstill, WINDOW, set_demand(WINDOW, demand, excess * allowed), WINDOW)
    faults = list_faults(demands, rig, test)
    remedy = preflight._suggest_level(demands, test, rig)
    assert faults
    assert ranges or faults[0].remedy == remedy
    assert remedy.startswith("multiply level_points by ") == has_points
    number = read_level(remedy)
    expected = (1.0 if has_points else level) / excess
    assert 0.99 * expected < number <= expected * (1 + 1e-12)  # rounded to three digits
    # A stepped motion beyond the limit says nothing of the level of a history.
    sine = set_demand(SMALL, demand, 1e3 * excess * allowed)
    assert preflight._suggest_level((*demands, sine), test, rig) == remedy


# Warnings


def test_coarse_step_is_worth_a_warning() -> None:
    fine = replace(SMALL, amplitude_lsb=100.0)
    coarse = replace(SMALL, amplitude_lsb=float(np.nextafter(100.0, 0.0)))
    assert list_drive_warnings((fine, fine), RIG) == []
    for step in (0, 3):
        assert len(list_drive_warnings((fine, replace(coarse, step=step)), RIG)) == 1
    check, window = replace(coarse, step=-1), replace(coarse, frequency_hz=math.nan)
    assert list_drive_warnings((check, window), RIG) == []
    (warning,) = list_drive_warnings(demand_sweep(make_test(), COARSE_OUTPUT), COARSE_OUTPUT)
    # 0.124 mm of +-100 mm in 65536 steps
    assert "2 steps have an amplitude below 100 DAC steps (least: 41 at 10 Hz)" in warning


def test_stroke_without_room_for_a_correction_is_worth_a_warning() -> None:
    ample = replace(SMALL, displacement_m=0.06 / CORRECTION_HEADROOM * (1 - 1e-9))
    tight = replace(SMALL, displacement_m=0.06 / 1.2 * (1 + 1e-9))
    exact = replace(SMALL, displacement_m=0.05)  # 1.2 times it is the stroke
    assert list_drive_warnings((ample, ample, exact), RIG) == []
    assert len(list_drive_warnings((ample, tight, tight), RIG)) == 1
    assert list_drive_warnings((replace(tight, step=-1),), RIG) == []
    (warning,) = list_drive_warnings(
        demand_sweep(make_test()), change_rig(limits={"stroke_mm": 59.0})
    )
    assert warning.startswith(f"{SLOWEST}: 49.6")
    assert "leave no room to correct the command by 20 %" in warning


@pytest.mark.parametrize(
    ("specimen", "words"),
    [
        ({"mass_kg": 20.0}, ""),
        ({"mass_kg": 19.9999}, "is it in kg?"),
        ({"mass_kg": 4000.0}, ""),
        ({"mass_kg": 4000.001}, "is it in kg?"),
        ({"gap_mm": math.inf}, ""),
        ({"gap_mm": 120.0}, ""),
        ({"gap_mm": 120.0001}, "is it in mm?"),
        ({"gap_mm": -120.0}, ""),
        ({"gap_mm": -120.0001}, "is it in mm?"),
        ({"gap_right_mm": -60.0, "gap_left_mm": 60.0}, ""),
        ({"gap_right_mm": 1.0, "gap_left_mm": -60.0001}, "is it in mm?"),
        ({"gap_right_mm": 60.0, "gap_left_mm": math.inf}, ""),
        ({"gap_right_mm": 60.0001, "gap_left_mm": math.inf}, "is it in mm?"),
    ],
)
def test_specimen_that_hardly_fits_is_doubted(specimen: dict[str, float], words: str) -> None:
    """From a hundredth to twice the mass of the table, and within its stroke."""
    test = make_test(specimen={"mass_kg": 550.0, "gap_mm": 4.0} | specimen)
    warnings = list_setup_warnings(test, RIG)
    assert len(warnings) == bool(words)
    assert all(words in warning for warning in warnings)


@pytest.mark.parametrize("rate_hz", [1000.0, 2000.0, 4000.0])
@pytest.mark.parametrize("lead_s", [0.5, 2.0])
def test_fewer_than_four_queued_blocks_are_worth_a_warning(rate_hz: float, lead_s: float) -> None:
    fourth = round(lead_s * rate_hz / 4)
    rig = change_rig(output={"lead_s": lead_s})
    for samples, count in ((fourth, 0), (fourth + 1, 1)):
        test = make_test(acquisition={"rate_hz": rate_hz, "block_samples": samples})
        warnings = list_setup_warnings(test, rig)
        assert len(warnings) == count
        assert all("fewer than four blocks" in warning for warning in warnings)


@pytest.mark.parametrize("check", [{}, {"frequencies_hz": (1.0, 10.0, 3.0)}])
@pytest.mark.parametrize(("ratio", "count"), [(0.9995, 0), (0.9985, 1), (0.5, 1)])
def test_loop_check_that_ends_below_the_sweep_is_worth_a_warning(
    check: dict[str, Any], ratio: float, count: int
) -> None:
    """A tenth of the level has the least steps of the DAC at the frequency that this span gives."""
    amplitude_m = 0.1 * LEVEL_M_S2 / (2 * math.pi * ratio * 10.0) ** 2
    rig = change_rig(output={"span_mm": 1e3 * amplitude_m / 20 * 2**18 / 2})
    warnings = list_setup_warnings(make_test(loop_check=check), rig)
    assert len(warnings) == count
    ending = f"the loop check ends at {10.0 * ratio:.4g} Hz" if ratio == 0.5 and not check else ""
    assert all(warning.startswith(ending) for warning in warnings)
    assert list_setup_warnings(make_test(loop_check=check | {"enabled": False}), rig) == []


@pytest.mark.parametrize(("least_level_g", "count"), [(0.0, 0), (0.05, 0), (0.0501, 1)])
def test_level_at_which_friction_shapes_the_motion_is_worth_a_warning(
    least_level_g: float, count: int
) -> None:
    rig = change_rig(table_response={"least_level_g": least_level_g})
    warnings = list_setup_warnings(make_test(), rig)
    assert len(warnings) == count
    assert all("friction shapes what this table plays" in warning for warning in warnings)


# The command corrected for the response of the table


def make_flat(gain: float) -> FrequencyResponse:
    return FrequencyResponse(5, (1.0,), (gain,), (0.0,))


@pytest.mark.parametrize(
    ("field", "si", "order"),
    [("stroke_mm", 1e-3, 2), ("velocity_mm_s", 1e-3, 1), ("acceleration_g", GRAVITY_M_S2, 0)],
)
@given(gain=st.floats(0.55, 1.8), frequency_hz=st.floats(0.5, 9.0))
@LAW
def test_corrected_command_is_the_motion_over_the_gain(
    field: str, si: float, order: int, gain: float, frequency_hz: float
) -> None:
    (step, *_) = make_test(frequency_hz, 10.0).sweep.steps
    demand = LEVEL_M_S2 / (2 * math.pi * frequency_hz) ** order / gain / si
    wide = {"stroke_mm": 1e3, "velocity_mm_s": 1e5, "acceleration_g": 9.0}
    for share, count in ((1 + 1e-9, 0), (1 - 1e-9, 1)):
        output = {"span_mm": 1e3, "bits": 32}
        rig = change_rig(output=output, limits=wide | {field: share * demand})
        assert len(check_corrected_drive(make_test(), (step,), make_flat(gain), rig)) == count


def test_corrected_command_warning_states_steps_and_limit() -> None:
    steps = make_test().sweep.steps
    (warning,) = check_corrected_drive(make_test(), steps, make_flat(0.8), RIG)
    assert warning.startswith("corrected for the table's response")
    assert f"{SLOWEST} and 1 more: displacement: 62.1 mm" in warning
    assert "allowed: at most 60 mm" in warning
    # 0.05 g at 10 Hz asked of a table that gives 0.6 of it.
    fallen = FrequencyResponse(5, (1.0, 3.0, 10.0), (1.0, 1.0, 0.6), (0.0, 0.0, 0.0))
    rig = change_rig(limits={"acceleration_g": 0.08})
    (warning,) = check_corrected_drive(make_test(), steps, fallen, rig)
    assert "(10 Hz forward) and 1 more: acceleration: 0.08333 g" in warning


@pytest.mark.parametrize("least", [0.2, 0.5])
@pytest.mark.parametrize(("share", "count"), [(1 + 1e-9, 0), (1 - 1e-9, 1)])
def test_command_is_corrected_for_every_gain_that_the_rig_accepts_and_no_less(
    least: float, share: float, count: int
) -> None:
    (step, *_) = make_test(5.0, 10.0).sweep.steps
    rig = change_rig(table_response={"top_gain": [least, 1.25]})
    warnings = check_corrected_drive(make_test(), (step, step), make_flat(least * share), rig)
    assert len(warnings) == count
    part = f"step 0 (5 Hz forward): the table follows with a gain of {least:g}"
    assert all(warning.startswith(part) for warning in warnings)
    tuning = start_test(make_test_plan(make_test(), rig)).tuning
    target = SineTarget(5.0, LEVEL_M_S2)
    assert tuning.correct(target, 9.0).correction == pytest.approx(1.0 / least)


def test_a_level_beside_break_points_is_not_ignored_silently() -> None:
    keys: dict[str, Any] = {"start_hz": 0.4, "stop_hz": 5.0, "duration_s": 20.0}
    points = {"level_points": [[0.4, 0.02], [5.0, 0.02]]}
    for level, count in (({}, 0), ({"acceleration_g": 0.05}, 1)):
        test = make_history_profile("chirp", **keys, **points, **level)
        assert sum("level_points" in text for text in list_setup_warnings(test, RIG)) == count
