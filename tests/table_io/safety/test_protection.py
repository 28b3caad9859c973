"""Protection on a table that follows its command exactly, with one thing wrong at a time.

The specimen is a rigid block without contact, so every channel is known in closed form; what the
simulated table adds (servo, impacts, chaos) is in test_protection_simulated.py.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from table_io.block import Block, Float2D, Label
from table_io.config.profile import Profile
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import SineTarget, plan_sweep, start_trajectory
from table_io.records import Event, FrequencyResponse, Trip
from table_io.safety.protection import (
    Finding,
    Observation,
    ProtectionState,
    inspect_samples,
    set_response,
    start_protection,
)
from table_io.units import GRAVITY_M_S2
from tests.builders.rigs import RIG

RATE_HZ = 2000.0
NAMES = RIG.channels
DRIVE, TABLE, ACC, MASS, MASS_ACC, R1, R2, L1, L2 = range(9)
FAULT_SAMPLE = 5000  # in the held cycles of the first step, 2 Hz
CYCLE_SAMPLES = 1000
A = 0.05 * GRAVITY_M_S2
AMPLITUDE = A / (4 * np.pi) ** 2
Change = Callable[[Any], None]  # of values, or of what is at its range, (channel, sample)


def profile(sensor: str = "stop", gap_mm: float = 4.0, **sweep: Any) -> Profile:
    """2 and 2.5 Hz, nine cycles each; the first step is held from 1.5 s to 6 s."""
    grid = {"start_hz": 2.0, "stop_hz": 2.5, "step_hz": 0.5, "cycles": 9, "measured_cycles": 8}
    return Profile.model_validate(
        {
            "title": "short",
            "specimen": {"mass_kg": 550.0, "gap_mm": gap_mm},
            "sweep": {"directions": ("forward",), **grid, **sweep},
            "protection": {"sensor": sensor},
        }
    )


TEST = profile()
PLAN = plan_sweep(TEST)


def noises(scale: float = 1.0) -> dict[str, tuple[float, int]]:
    """What the tare says of each channel."""
    rms = {sensor.channel: scale * sensor.noise_rms * sensor.si_per_unit for sensor in RIG.sensors}
    return {name: (value, 2 if value else int(RATE_HZ)) for name, value in rms.items()}


def simulate_channels(drive: Drive, scale: float = 1.0, lag: int = 0) -> Float2D:
    """(channel, sample): table and mass move as one, `lag` samples behind the command."""
    return _simulate_channels_once(drive, scale, lag).copy()


@cache
def _simulate_channels_once(drive: Drive, scale: float, lag: int) -> Float2D:
    count = drive.rest_start + 1000
    values = np.zeros((len(NAMES), count))
    values[DRIVE] = drive.command(0, count)
    values[[TABLE, MASS]] = drive.command(-lag, count)
    values[[ACC, MASS_ACC]] = drive.acceleration(-lag, count)
    noise = np.random.default_rng(7).standard_normal(values.shape)
    rms = np.array([[noise_rms] for noise_rms, _ in noises(scale).values()])
    return values + rms * noise


def list_findings(
    change: Change | None = None,
    test: Profile = TEST,
    drive: Drive = PLAN,
    clipped: Change | None = None,
    cut: int = 100,
    scale: float = 1.0,
    lag: int = 0,
    known: FrequencyResponse | None = None,
    last: int | None = None,
) -> tuple[Finding, ...]:
    """All findings of a run in which `change` has been made to what was measured."""
    values = simulate_channels(drive, scale, lag)
    at_range = np.zeros(values.shape, dtype=np.bool_)
    if change is not None:
        change(values)
    if clipped is not None:
        clipped(at_range)
    guard = start_protection(test, RIG, noises(scale))
    if known is not None:
        guard = set_response(guard, known)
    findings: list[Finding] = []
    values, at_range = values[:, :last], at_range[:, :last]
    for first in range(0, values.shape[1], cut):
        guard, some = inspect_samples(guard, make_observation(values, at_range, drive, first, cut))
        findings += some
    return tuple(findings)


@cache
def evaluate_drive(drive: Drive) -> tuple[Any, ...]:
    """Labels, command, phase, level and acceleration of every sample that is measured."""
    where = 0, drive.rest_start + 1000
    return (
        drive.labels(*where),
        drive.command(*where),
        np.unwrap(drive.phase(*where), period=1.0),
        drive.level(*where),
        drive.demanded_acceleration(*where),
    )


def make_observation(
    values: Float2D, clipped: Any, drive: Drive, first: int, cut: int
) -> Observation:
    window = slice(first, min(first + cut, values.shape[1]))
    labels, *rest = evaluate_drive(drive)
    values = values[:, window].copy()
    block = Block("meas", first, RATE_HZ, NAMES, values, *(label[window] for label in labels))
    return Observation(block, clipped[:, window], *(demand[window] for demand in rest))


def steady(drive: Drive) -> tuple[Any, Any, Any]:
    """(phase in rad, level, frequency in Hz where it is held, else inf), (sample,) each."""
    labels, _, phase, level, _ = evaluate_drive(drive)
    held = np.isin(labels[1], (Label.SETTLE, Label.MEASURE))
    f = np.where(held, np.abs(np.gradient(phase)) * RATE_HZ, np.inf)
    return 2 * np.pi * phase, level, f


def put(rows: Any, first: int, value: Any, count: int | None = None) -> Change:
    """Sets samples of a channel."""

    def change(values: Float2D) -> None:
        values[rows, first : None if count is None else first + count] = value

    return change


def add(rows: Any, first: int, value: Any, count: int | None = None) -> Change:
    def change(values: Float2D) -> None:
        values[rows, first : None if count is None else first + count] += value

    return change


def scale_rows(rows: Any, first: int, factor: float, last: int | None = None) -> Change:
    def change(values: Float2D) -> None:
        values[rows, first:last] *= factor

    return change


def kinds(findings: tuple[Finding, ...], stop: bool | None = None) -> list[str]:
    return [finding.kind for finding in findings if stop is None or finding.stop == stop]


def first(findings: tuple[Finding, ...], kind: str) -> Finding:
    return next(finding for finding in findings if finding.kind == kind)


# A table that does what it should


@pytest.mark.parametrize("scale", [0.0, 0.2, 1.0, 3.0])
def test_a_sound_run_has_no_findings(scale: float) -> None:
    assert list_findings(scale=scale) == ()
    assert list_findings(scale=scale, lag=30) == ()


@pytest.mark.parametrize("gap_mm", [-10.0, 0.0, float("inf")])
def test_nor_has_it_with_another_gap(gap_mm: float) -> None:
    assert list_findings(test=profile(gap_mm=gap_mm)) == ()


# Limits


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("row", "value", "kind"),
    [
        (TABLE, 0.0602, "stroke"),
        (ACC, 1.02 * GRAVITY_M_S2, "acceleration"),
        (MASS_ACC, (30e3 + 2000.0 * 2 * A) / 550.0, "force"),
    ],
)
def test_an_excess_stops_within_three_samples(
    row: int, value: float, kind: str, sign: float
) -> None:
    findings = list_findings(put(row, FAULT_SAMPLE, sign * value))
    trip = first(findings, kind)
    assert trip.stop
    assert FAULT_SAMPLE < trip.index <= FAULT_SAMPLE + 2
    assert np.sign(trip.value) == sign
    assert abs(trip.value) > trip.limit


@pytest.mark.parametrize("value", [0.0602, -0.2, 5.0])
def test_a_spike_of_one_sample_is_no_motion(value: float) -> None:
    findings = list_findings(add(TABLE, FAULT_SAMPLE, value, 1))
    assert [(finding.index, finding.kind, finding.stop) for finding in findings] == [
        (FAULT_SAMPLE, "spike", False)
    ]
    assert findings[0].value == pytest.approx(abs(value), rel=1e-2)


def test_just_within_its_limits_a_table_may_move() -> None:
    def change(values: Float2D) -> None:
        values[TABLE, FAULT_SAMPLE:] = 0.0598

    assert "stroke" not in kinds(list_findings(change))


def test_velocity_is_that_of_the_displacement() -> None:
    ramp = np.arange(100) / RATE_HZ

    def speed(v: float) -> tuple[Finding, ...]:
        def change(values: Float2D) -> None:
            values[TABLE, FAULT_SAMPLE : FAULT_SAMPLE + 100] += v * ramp
            values[TABLE, FAULT_SAMPLE + 100 :] += v * ramp[-1]

        return list_findings(change)

    assert "velocity" not in kinds(speed(0.45))
    trip = first(speed(0.55), "velocity")
    assert trip.stop
    assert trip.index <= FAULT_SAMPLE + 22  # 10 ms, and a sample for the median
    assert 0.5 < trip.value < 0.6


def test_force_counts_the_mass_only_where_it_is_measured() -> None:
    lost = list_findings(put(MASS_ACC, FAULT_SAMPLE, np.nan))
    assert "force" not in kinds(lost)
    table_alone = 30e3 / 2000.0 - 550.0 / 2000.0 * A
    assert "force" in kinds(list_findings(put(ACC, FAULT_SAMPLE, table_alone + 0.2)))

    def both(values: Float2D) -> None:
        values[MASS_ACC, FAULT_SAMPLE:] = np.nan
        values[ACC, FAULT_SAMPLE:] = 30e3 / 2000.0 + 0.1

    assert "force" in kinds(list_findings(both))


# Sensors, sample by sample


def test_a_sensor_at_its_range_is_no_longer_believed() -> None:
    mark = put(MASS, FAULT_SAMPLE, True, 3)
    (finding,) = list_findings(clipped=mark)
    assert (finding.kind, finding.channel, finding.index, finding.stop) == (
        "rail",
        "mass_disp_m",
        FAULT_SAMPLE + 2,
        True,
    )
    (finding,) = list_findings(clipped=mark, test=profile("warn"))
    assert not finding.stop
    assert list_findings(clipped=put(MASS, FAULT_SAMPLE, True, 2)) == ()


def test_a_lost_sample_is_told_and_a_lost_sensor_stops() -> None:
    (finding,) = list_findings(put(TABLE, FAULT_SAMPLE, np.nan, 1))
    assert (finding.kind, finding.channel, finding.index, finding.stop) == (
        "lost",
        "table_disp_m",
        FAULT_SAMPLE,
        False,
    )
    short, long = (
        list_findings(put(TABLE, FAULT_SAMPLE, np.nan, 40)),
        list_findings(put(TABLE, FAULT_SAMPLE, np.nan, 41)),
    )
    assert kinds(short, stop=True) == []
    assert [(finding.kind, finding.index) for finding in long if finding.stop] == [
        ("lost", FAULT_SAMPLE + 40)
    ]  # 20 ms
    assert (
        kinds(list_findings(put(MASS, FAULT_SAMPLE, np.nan, 41), profile("warn")), stop=True) == []
    )


def test_a_loose_contact_adds_up() -> None:
    every_third = list_findings(_loose(3))
    stop = next(finding for finding in every_third if finding.stop)
    assert stop.kind == "lost"
    assert stop.index - FAULT_SAMPLE < 0.2 * RATE_HZ
    assert kinds(list_findings(_loose(20)), stop=True) == []


def _loose(every: int) -> Change:
    def change(values: Float2D) -> None:
        values[TABLE, FAULT_SAMPLE::every] = np.nan

    return change


def test_one_lost_sample_does_not_hide_the_next() -> None:
    def change(values: Float2D) -> None:
        values[TABLE, FAULT_SAMPLE] = np.nan
        values[TABLE, FAULT_SAMPLE + 1 :] = 0.07

    assert first(list_findings(change), "stroke").index <= FAULT_SAMPLE + 4


def test_a_block_that_is_lost_in_all_channels_is_told_once() -> None:
    (finding,) = list_findings(put(slice(None), FAULT_SAMPLE, np.nan, 20))
    assert (finding.kind, finding.index, finding.stop) == ("lost", FAULT_SAMPLE, False)
    assert "all channels" in finding.text


@pytest.mark.parametrize("row", [TABLE, ACC, MASS, MASS_ACC, R1])
def test_a_stuck_sensor_is_told_by_its_noise(row: int) -> None:
    findings = list_findings(put(row, FAULT_SAMPLE, 1e-4))
    assert findings[0].kind == "stuck"
    assert findings[0].channel == NAMES[row]
    assert findings[0].index == FAULT_SAMPLE + 19  # 10 ms
    assert findings[0].stop
    assert "stuck" not in kinds(list_findings(put(row, FAULT_SAMPLE, 1e-4, 15)))


@pytest.mark.parametrize("row", [DRIVE, TABLE, ACC])
def test_without_noise_a_sensor_is_stuck_only_where_it_must_move(row: int) -> None:
    held = simulate_channels(PLAN, 0.0)[row, FAULT_SAMPLE]
    assert "stuck" in kinds(list_findings(put(row, FAULT_SAMPLE, held), scale=0.0))
    assert list_findings(put(row, 0, 0.0, 1000), scale=0.0) == ()  # at rest
    assert list_findings(put(R1, 0, 0.0), scale=0.0) == ()


@pytest.mark.parametrize("row", [TABLE, ACC, MASS, MASS_ACC, R1])
def test_a_cable_that_is_off_is_told_by_the_noise_it_lacks(row: int) -> None:
    noise = noises()[NAMES[row]][0] / 10 * np.random.default_rng(1).standard_normal(4000)
    finding = first(list_findings(put(row, FAULT_SAMPLE, noise, 4000)), "silent")
    assert finding.channel == NAMES[row]
    assert finding.index - FAULT_SAMPLE < 0.15 * RATE_HZ
    assert "silent" not in kinds(list_findings(put(row, FAULT_SAMPLE, 6.0 * noise, 4000)))


@pytest.mark.parametrize("row", [DRIVE, TABLE, ACC, MASS, MASS_ACC, R1, L2])
def test_a_spike_is_told_and_only_that(row: int) -> None:
    sensor = RIG.sensors[row]
    limit = max(10 * sensor.noise_rms, 1e-3 * sensor.range) * sensor.si_per_unit
    limit += RIG.output.lsb_m * 1e6 if row == ACC else 0.0
    (finding,) = list_findings(add(row, FAULT_SAMPLE, 1.7 * limit, 1))
    assert (finding.kind, finding.channel, finding.index, finding.stop) == (
        "spike",
        NAMES[row],
        FAULT_SAMPLE,
        False,
    )
    assert list_findings(add(row, FAULT_SAMPLE, 0.4 * limit, 1)) == ()


def test_what_shows_in_two_channels_is_no_spike_of_a_sensor() -> None:
    assert list_findings(add([R1, R2], FAULT_SAMPLE, 100.0, 1)) == ()


@pytest.mark.parametrize("back", [7, 20, 333])
def test_old_samples_once_more_are_no_measurement(back: int) -> None:
    def again(count: int) -> Change:
        def change(values: Float2D) -> None:
            for k in range(FAULT_SAMPLE, FAULT_SAMPLE + count):
                values[:, k] = values[:, k - back]

        return change

    (finding,) = list_findings(again(15))
    assert (finding.kind, finding.index, finding.stop) == ("repeated", FAULT_SAMPLE + 4, False)
    assert finding.value == pytest.approx(back / RATE_HZ)
    stop = next(finding for finding in list_findings(again(60)) if finding.stop)
    assert (stop.kind, stop.index <= FAULT_SAMPLE + 50) == ("lost", True)


# Command and table


def test_a_command_that_comes_later_than_queued_stops() -> None:
    def change(values: Float2D) -> None:
        values[DRIVE, FAULT_SAMPLE:] = values[DRIVE, FAULT_SAMPLE - 20 : -20].copy()

    stop = next(finding for finding in list_findings(change) if finding.stop)
    assert (stop.kind, stop.channel) == ("command", "drive_disp_m")
    assert stop.index - FAULT_SAMPLE < CYCLE_SAMPLES / 4


def test_a_converter_may_be_a_sample_late_and_a_little_off() -> None:
    def change(values: Float2D) -> None:
        values[DRIVE] = 1.005 * np.roll(values[DRIVE], 1)

    assert list_findings(change) == ()


def test_a_small_command_is_read_back_over_whole_cycles() -> None:
    small = profile(acceleration_g=0.002)
    drive = plan_sweep(small)
    findings = list_findings(scale_rows(DRIVE, FAULT_SAMPLE, 1.05), small, drive)
    assert {finding.kind for finding in findings if finding.channel == "drive_disp_m"} == {
        "command"
    }
    assert "command" not in kinds(
        list_findings(scale_rows(DRIVE, FAULT_SAMPLE, 1.01), small, drive)
    )


def test_a_table_that_stays_where_it_is_stops() -> None:
    def change(values: Float2D) -> None:
        hold = simulate_channels(PLAN, 0.0)
        values[[TABLE, MASS], FAULT_SAMPLE:] += (
            hold[[TABLE, MASS], FAULT_SAMPLE, None] - hold[[TABLE, MASS], FAULT_SAMPLE:]
        )
        values[[ACC, MASS_ACC], FAULT_SAMPLE:] -= hold[[ACC, MASS_ACC], FAULT_SAMPLE:]

    stop = next(finding for finding in list_findings(change) if finding.stop)
    assert (stop.kind, stop.channel) == ("following", "table_disp_m")
    assert stop.index - FAULT_SAMPLE < CYCLE_SAMPLES / 4


def test_before_the_table_is_known_any_lag_within_reason_is_allowed() -> None:
    assert list_findings(lag=180) == ()  # 90 ms
    assert "following" in kinds(list_findings(lag=320))


# Tracked


def test_the_level_is_tracked_on_the_fundamental() -> None:
    def share(factor: float, alone: bool = False) -> list[Finding]:
        rows = [ACC] if alone else [TABLE, ACC, MASS, MASS_ACC]
        return [
            finding
            for finding in list_findings(scale_rows(rows, 0, factor))
            if finding.kind == "level"
        ]

    assert share(1.08) == share(0.92) == []
    for factor in (1.12, 0.88):
        alarm = share(factor)[0]
        assert not alarm.stop
        assert alarm.to_event().kind == "alarm"
        assert alarm.value == pytest.approx(factor * A, rel=1e-2)
    for factor in (2.1, 0.48):
        stop = next(finding for finding in share(factor) if finding.stop)
        assert (
            2 * CYCLE_SAMPLES <= stop.index - 3000 <= 2.2 * CYCLE_SAMPLES
        )  # it is held from 1.5 s on
    assert not any(finding.stop for finding in share(1.9))


def test_the_level_is_not_judged_while_blending() -> None:
    def change(values: Float2D) -> None:
        blend = PLAN.labels(0, values.shape[1])[1] == Label.BLEND
        values[np.ix_([TABLE, ACC, MASS, MASS_ACC], blend)] *= 1.13

    assert "level" not in kinds(list_findings(change))


def test_harmonics_of_the_table_are_no_fault() -> None:
    def change(values: Float2D) -> None:
        theta, level, f = steady(PLAN)
        extra = np.where(np.isfinite(f), 0.5 * level * np.sin(3 * theta), 0.0)
        values[[ACC, MASS_ACC]] += extra
        values[[TABLE, MASS]] -= extra / (6 * np.pi * f) ** 2

    assert "level" not in kinds(list_findings(change))


def response(lag_s: float) -> FrequencyResponse:
    at = (1.0, 3.0, 9.0)
    return FrequencyResponse(0, at, (1.0, 1.0, 1.0), tuple(-2 * np.pi * f * lag_s for f in at))


def test_a_table_that_lags_more_than_it_did_is_soft() -> None:
    assert list_findings(lag=30, known=response(0.015)) == ()
    finding = first(list_findings(lag=50, known=response(0.015)), "response")
    assert finding.stop
    assert finding.value == pytest.approx(0.025, abs=5e-4)
    assert "25.0 ms behind its command, 15.0 ms before" in finding.text


def test_without_a_loop_check_the_same_frequency_must_be_met_as_before() -> None:
    both = profile(directions=("forward", "backward"), start_hz=2.0, stop_hz=2.5)
    drive = plan_sweep(both)
    half = drive.planned_end // 2

    def change(values: Float2D) -> None:
        late = simulate_channels(drive, 1.0, 40)
        values[1:, half:] = late[1:, half:]

    assert list_findings(test=both, drive=drive, lag=20) == ()
    assert "response" in kinds(list_findings(change, both, drive, lag=20))


@pytest.mark.parametrize(("row", "size"), [(TABLE, 3e-4), (ACC, 0.1), (MASS_ACC, 0.15), (R1, 8.0)])
def test_what_drifts_is_told(row: int, size: float) -> None:
    finding = next(
        finding
        for finding in list_findings(add(row, FAULT_SAMPLE, size))
        if finding.kind != "level"
    )
    assert finding.kind in ("drift", "consistency")
    assert finding.channel == NAMES[row]
    assert finding.index - FAULT_SAMPLE < 2.6 * CYCLE_SAMPLES
    assert list_findings(add(row, FAULT_SAMPLE, size / 10)) == ()


def test_a_mass_that_swings_about_another_place_is_told_after_ten_cycles() -> None:
    long = profile(cycles=40)
    drive = plan_sweep(long)
    finding = first(list_findings(add(MASS, FAULT_SAMPLE, 2e-3), long, drive), "drift")
    assert finding.channel == "mass_disp_m"
    # The mean is one of twenty checks, two a cycle, each of the last cycle: ten and a half cycles
    # from the start of the step, and as many checks as a finding takes to be confirmed.
    cycles = (finding.index - drive.sine_segments[1].start) / CYCLE_SAMPLES
    assert 10.5 <= cycles <= 12.0


@pytest.mark.parametrize("row", [TABLE, ACC, MASS, MASS_ACC])
@pytest.mark.parametrize("factor", [0.9, 1.1, -1.0])
def test_a_sensor_that_no_longer_fits_its_partner_is_told(row: int, factor: float) -> None:
    findings = [
        finding
        for finding in list_findings(scale_rows(row, FAULT_SAMPLE, factor))
        if finding.kind == "consistency"
    ]
    assert findings[0].channel == NAMES[row]
    assert findings[0].index - FAULT_SAMPLE < 2.6 * CYCLE_SAMPLES
    assert list_findings(scale_rows(row, FAULT_SAMPLE, 1.03)) == ()


@pytest.mark.parametrize("row", [MASS, MASS_ACC])
def test_nor_one_that_never_did(row: int) -> None:
    assert "consistency" in kinds(list_findings(scale_rows(row, 0, 1.15)))
    assert list_findings(scale_rows(row, 0, 1.10)) == ()


def test_a_sensor_that_the_controller_does_not_need_warns_if_so_asked() -> None:
    warned = list_findings(scale_rows(MASS_ACC, FAULT_SAMPLE, -1.0), profile("warn"))
    assert kinds(warned, stop=True) == []
    assert first(warned, "consistency").to_event().kind == "sensor"
    assert (
        kinds(list_findings(scale_rows(ACC, FAULT_SAMPLE, -1.0), profile("warn")), stop=True) != []
    )


# Load cells


def impacts(share: float, change: Change | None = None) -> tuple[Finding, ...]:
    """The cells of the right side bear the mass part of each cycle, the first `share` of it."""

    def push(values: Float2D) -> None:
        theta, level, f = steady(PLAN)
        u = np.where(np.isfinite(f), 3e-3 * level / A * np.sin(theta), 0.0)
        force = np.maximum(u - 2e-3, 0.0) * 500e3
        values[R1] += share * force
        values[R2] += (1 - share) * force
        values[MASS] += u
        values[MASS_ACC] -= (2 * np.pi * np.where(np.isfinite(f), f, 0.0)) ** 2 * u
        if change is not None:
            change(values)

    return list_findings(push)


@pytest.mark.parametrize("share", [0.5, 0.35, 0.6])
def test_cells_may_share_a_force_as_they_like_but_always_so(share: float) -> None:
    assert impacts(share) == ()
    for row, factor in ((R1, 1.3), (R2, 0.7), (R1, -1.0), (R2, 0.1)):
        finding = first(impacts(share, scale_rows(row, FAULT_SAMPLE, factor)), "share")
        assert finding.index - FAULT_SAMPLE < 3.1 * CYCLE_SAMPLES, (row, factor)


def test_a_cell_that_never_bore_a_thing_beside_one_that_does_is_told() -> None:
    finding = first(impacts(1.0), "share")
    assert finding.channel == "force_r2_n"


def test_where_both_cells_bear_beyond_the_gap_the_gap_is_elsewhere() -> None:
    finding = first(impacts(0.5, add(MASS, FAULT_SAMPLE, -4e-3)), "drift")
    assert finding.channel == "mass_disp_m"
    assert "other side of the gap" in finding.text


# The loop check judges the sensors itself


def checking() -> Drive:
    """A held motion at a tenth of the level, as in a loop check."""
    course = start_trajectory(TEST).append_blend(SineTarget(2.0, 0.1 * A), -1, 1.5, Label.BLEND)
    return course.append_hold(6000, -1, Label.CHECK).to_drive(TEST.sweep.steps)


@pytest.mark.parametrize("row", [DRIVE, TABLE, ACC, MASS, MASS_ACC])
@pytest.mark.parametrize("factor", [-1.0, 0.3, 2.0])
def test_a_loop_check_comes_to_speak_of_wrong_sensors(row: int, factor: float) -> None:
    assert list_findings(scale_rows(row, 0, factor), drive=checking()) == ()


def test_but_limits_and_broken_sensors_stop_it() -> None:
    assert "stroke" in kinds(
        list_findings(put(TABLE, FAULT_SAMPLE, 0.07), drive=checking()), stop=True
    )
    assert "stuck" in kinds(
        list_findings(put(TABLE, FAULT_SAMPLE, 1e-4), drive=checking()), stop=True
    )
    assert "following" in kinds(
        list_findings(add(TABLE, FAULT_SAMPLE, 2e-3), drive=checking()), stop=True
    )


# The guard as a value


def everything(values: Float2D) -> None:
    """Many faults, one after another."""
    put(R1, 3500, np.random.default_rng(2).standard_normal(6000) * 0.1, 6000)(values)
    add(TABLE, 4001, 0.02, 1)(values)
    put(slice(None), 4500, np.nan, 20)(values)
    scale_rows(MASS_ACC, 5100, 1.4)(values)
    for k in range(6003, 6018):
        values[:, k] = values[:, k - 20]
    put(MASS, 7007, 0.01, 300)(values)
    scale_rows(ACC, 8000, 0.4)(values)
    put(TABLE, 11000, 0.061)(values)


def test_the_cut_into_blocks_changes_no_finding() -> None:
    warn = profile("warn")
    whole = list_findings(everything, warn, cut=20, last=11100)
    assert {finding.kind for finding in whole} >= {
        "silent", "spike", "lost", "consistency", "repeated", "stuck", "level", "stroke",
    }  # fmt: skip
    for cut in (1, 7, 64, 500):
        assert repr(list_findings(everything, warn, cut=cut, last=11100)) == repr(whole), cut


def test_a_guard_is_a_value() -> None:
    values = simulate_channels(PLAN)
    everything(values)
    clipped = np.zeros(values.shape, dtype=np.bool_)
    guard = start_protection(TEST, RIG, noises())
    guards: list[ProtectionState] = []
    for at in range(0, 9000, 500):
        guards.append(guard)
        guard, _ = inspect_samples(guard, make_observation(values, clipped, PLAN, at, 500))
    for at, earlier in zip(range(0, 9000, 500), guards, strict=True):
        again = make_observation(values, clipped, PLAN, at, 500)
        assert repr(inspect_samples(earlier, again)[1]) == repr(inspect_samples(earlier, again)[1])


def test_samples_that_were_left_out_are_refused() -> None:
    values, clipped = simulate_channels(PLAN), np.zeros((9, 20000), dtype=np.bool_)
    guard, _ = inspect_samples(
        start_protection(TEST, RIG, noises()), make_observation(values, clipped, PLAN, 0, 20)
    )
    with pytest.raises(ValueError, match=r"\b20\b.*\b40\b"):
        inspect_samples(guard, make_observation(values, clipped, PLAN, 40, 20))


def test_a_finding_is_told_once_until_it_has_been_away_for_a_second() -> None:
    def twice(apart: int) -> Change:
        def change(values: Float2D) -> None:
            for at in (FAULT_SAMPLE, FAULT_SAMPLE + apart):
                values[MASS, at] += 0.05

        return change

    assert kinds(list_findings(twice(1500))) == ["spike"]
    assert kinds(list_findings(twice(2500))) == ["spike", "spike"]


def test_a_finding_becomes_a_trip_or_an_event() -> None:
    finding = Finding(12, "stroke", "table_disp_m", 0.07, 0.06, "too far", True)
    assert finding.to_trip(20) == Trip(12, 20, "stroke", "table_disp_m", 0.07, 0.06, "too far")
    assert finding.to_event() == Event(12, "sensor", "too far")
    assert replace(finding, kind="level").to_event().kind == "alarm"


def test_sentences_name_channel_sample_value_and_limit() -> None:
    text = first(list_findings(put(TABLE, FAULT_SAMPLE, 0.0612)), "stroke").text
    assert text.startswith("table_disp_m: 61.2 mm at sample 500")
    assert text.endswith("exceeds 60 mm")
