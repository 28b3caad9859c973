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
from tests.table_io.safety.guarded import RIG

RATE = 2000.0
NAMES = RIG.channels
DRIVE, TABLE, ACC, MASS, MASS_ACC, R1, R2, L1, L2 = range(9)
AT = 5000  # in the held cycles of the first step, 2 Hz
CYCLE = 1000
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
    rms = {one.channel: scale * one.noise_rms * one.si_per_unit for one in RIG.sensors}
    return {name: (value, 2 if value else int(RATE)) for name, value in rms.items()}


def measured(drive: Drive, scale: float = 1.0, lag: int = 0) -> Float2D:
    """(channel, sample): table and mass move as one, `lag` samples behind the command."""
    return _measured(drive, scale, lag).copy()


@cache
def _measured(drive: Drive, scale: float, lag: int) -> Float2D:
    count = drive.rest_start + 1000
    values = np.zeros((len(NAMES), count))
    values[DRIVE] = drive.command(0, count)
    values[[TABLE, MASS]] = drive.command(-lag, count)
    values[[ACC, MASS_ACC]] = drive.acceleration(-lag, count)
    noise = np.random.default_rng(7).standard_normal(values.shape)
    rms = np.array([[one[0]] for one in noises(scale).values()])
    return values + rms * noise


def shaken(
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
    values = measured(drive, scale, lag)
    at_range = np.zeros(values.shape, dtype=np.bool_)
    if change is not None:
        change(values)
    if clipped is not None:
        clipped(at_range)
    guard = start_protection(test, RIG, noises(scale))
    if known is not None:
        guard = set_response(guard, known)
    found: list[Finding] = []
    values, at_range = values[:, :last], at_range[:, :last]
    for first in range(0, values.shape[1], cut):
        guard, some = inspect_samples(guard, seen(values, at_range, drive, first, cut))
        found += some
    return tuple(found)


@cache
def asked(drive: Drive) -> tuple[Any, ...]:
    """Labels, command, phase, level and acceleration of every sample that is measured."""
    where = 0, drive.rest_start + 1000
    return (
        drive.labels(*where),
        drive.command(*where),
        np.unwrap(drive.phase(*where), period=1.0),
        drive.level(*where),
        drive.demanded_acceleration(*where),
    )


def seen(values: Float2D, clipped: Any, drive: Drive, first: int, cut: int) -> Observation:
    window = slice(first, min(first + cut, values.shape[1]))
    labels, *rest = asked(drive)
    values = values[:, window].copy()
    block = Block("meas", first, RATE, NAMES, values, *(one[window] for one in labels))
    return Observation(block, clipped[:, window], *(one[window] for one in rest))


def steady(drive: Drive) -> tuple[Any, Any, Any]:
    """(phase in rad, level, frequency in Hz where it is held, else inf), (sample,) each."""
    labels, _, phase, level, _ = asked(drive)
    held = np.isin(labels[1], (Label.SETTLE, Label.MEASURE))
    f = np.where(held, np.abs(np.gradient(phase)) * RATE, np.inf)
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


def scaled(rows: Any, first: int, factor: float, last: int | None = None) -> Change:
    def change(values: Float2D) -> None:
        values[rows, first:last] *= factor

    return change


def kinds(found: tuple[Finding, ...], stop: bool | None = None) -> list[str]:
    return [one.kind for one in found if stop is None or one.stop == stop]


def first(found: tuple[Finding, ...], kind: str) -> Finding:
    return next(one for one in found if one.kind == kind)


# A table that does what it should


@pytest.mark.parametrize("scale", [0.0, 0.2, 1.0, 3.0])
def test_a_sound_run_has_no_findings(scale: float) -> None:
    assert shaken(scale=scale) == ()
    assert shaken(scale=scale, lag=30) == ()


@pytest.mark.parametrize("gap_mm", [-10.0, 0.0, float("inf")])
def test_nor_has_it_with_another_gap(gap_mm: float) -> None:
    assert shaken(test=profile(gap_mm=gap_mm)) == ()


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
    found = shaken(put(row, AT, sign * value))
    trip = first(found, kind)
    assert trip.stop
    assert AT < trip.index <= AT + 2
    assert np.sign(trip.value) == sign
    assert abs(trip.value) > trip.limit


@pytest.mark.parametrize("value", [0.0602, -0.2, 5.0])
def test_a_spike_of_one_sample_is_no_motion(value: float) -> None:
    found = shaken(add(TABLE, AT, value, 1))
    assert [(one.index, one.kind, one.stop) for one in found] == [(AT, "spike", False)]
    assert found[0].value == pytest.approx(abs(value), rel=1e-2)


def test_just_within_its_limits_a_table_may_move() -> None:
    def change(values: Float2D) -> None:
        values[TABLE, AT:] = 0.0598

    assert "stroke" not in kinds(shaken(change))


def test_velocity_is_that_of_the_displacement() -> None:
    ramp = np.arange(100) / RATE

    def speed(v: float) -> tuple[Finding, ...]:
        def change(values: Float2D) -> None:
            values[TABLE, AT : AT + 100] += v * ramp
            values[TABLE, AT + 100 :] += v * ramp[-1]

        return shaken(change)

    assert "velocity" not in kinds(speed(0.45))
    trip = first(speed(0.55), "velocity")
    assert trip.stop
    assert trip.index <= AT + 22  # 10 ms, and a sample for the median
    assert 0.5 < trip.value < 0.6


def test_force_counts_the_mass_only_where_it_is_measured() -> None:
    lost = shaken(put(MASS_ACC, AT, np.nan))
    assert "force" not in kinds(lost)
    table_alone = 30e3 / 2000.0 - 550.0 / 2000.0 * A
    assert "force" in kinds(shaken(put(ACC, AT, table_alone + 0.2)))

    def both(values: Float2D) -> None:
        values[MASS_ACC, AT:] = np.nan
        values[ACC, AT:] = 30e3 / 2000.0 + 0.1

    assert "force" in kinds(shaken(both))


# Sensors, sample by sample


def test_a_sensor_at_its_range_is_no_longer_believed() -> None:
    mark = put(MASS, AT, True, 3)
    (found,) = shaken(clipped=mark)
    assert (found.kind, found.channel, found.index, found.stop) == (
        "rail",
        "mass_disp_m",
        AT + 2,
        True,
    )
    (found,) = shaken(clipped=mark, test=profile("warn"))
    assert not found.stop
    assert shaken(clipped=put(MASS, AT, True, 2)) == ()


def test_a_lost_sample_is_told_and_a_lost_sensor_stops() -> None:
    (found,) = shaken(put(TABLE, AT, np.nan, 1))
    assert (found.kind, found.channel, found.index, found.stop) == (
        "lost",
        "table_disp_m",
        AT,
        False,
    )
    short, long = shaken(put(TABLE, AT, np.nan, 40)), shaken(put(TABLE, AT, np.nan, 41))
    assert kinds(short, stop=True) == []
    assert [(one.kind, one.index) for one in long if one.stop] == [("lost", AT + 40)]  # 20 ms
    assert kinds(shaken(put(MASS, AT, np.nan, 41), profile("warn")), stop=True) == []


def test_a_loose_contact_adds_up() -> None:
    every_third = shaken(_loose(3))
    stop = next(one for one in every_third if one.stop)
    assert stop.kind == "lost"
    assert stop.index - AT < 0.2 * RATE
    assert kinds(shaken(_loose(20)), stop=True) == []


def _loose(every: int) -> Change:
    def change(values: Float2D) -> None:
        values[TABLE, AT::every] = np.nan

    return change


def test_one_lost_sample_does_not_hide_the_next() -> None:
    def change(values: Float2D) -> None:
        values[TABLE, AT] = np.nan
        values[TABLE, AT + 1 :] = 0.07

    assert first(shaken(change), "stroke").index <= AT + 4


def test_a_block_that_is_lost_in_all_channels_is_told_once() -> None:
    (found,) = shaken(put(slice(None), AT, np.nan, 20))
    assert (found.kind, found.index, found.stop) == ("lost", AT, False)
    assert "all channels" in found.text


@pytest.mark.parametrize("row", [TABLE, ACC, MASS, MASS_ACC, R1])
def test_a_stuck_sensor_is_told_by_its_noise(row: int) -> None:
    found = shaken(put(row, AT, 1e-4))
    assert found[0].kind == "stuck"
    assert found[0].channel == NAMES[row]
    assert found[0].index == AT + 19  # 10 ms
    assert found[0].stop
    assert "stuck" not in kinds(shaken(put(row, AT, 1e-4, 15)))


@pytest.mark.parametrize("row", [DRIVE, TABLE, ACC])
def test_without_noise_a_sensor_is_stuck_only_where_it_must_move(row: int) -> None:
    held = measured(PLAN, 0.0)[row, AT]
    assert "stuck" in kinds(shaken(put(row, AT, held), scale=0.0))
    assert shaken(put(row, 0, 0.0, 1000), scale=0.0) == ()  # at rest
    assert shaken(put(R1, 0, 0.0), scale=0.0) == ()


@pytest.mark.parametrize("row", [TABLE, ACC, MASS, MASS_ACC, R1])
def test_a_cable_that_is_off_is_told_by_the_noise_it_lacks(row: int) -> None:
    noise = noises()[NAMES[row]][0] / 10 * np.random.default_rng(1).standard_normal(4000)
    found = first(shaken(put(row, AT, noise, 4000)), "silent")
    assert found.channel == NAMES[row]
    assert found.index - AT < 0.15 * RATE
    assert "silent" not in kinds(shaken(put(row, AT, 6.0 * noise, 4000)))


@pytest.mark.parametrize("row", [DRIVE, TABLE, ACC, MASS, MASS_ACC, R1, L2])
def test_a_spike_is_told_and_only_that(row: int) -> None:
    sensor = RIG.sensors[row]
    limit = max(10 * sensor.noise_rms, 1e-3 * sensor.range) * sensor.si_per_unit
    limit += RIG.output.lsb_m * 1e6 if row == ACC else 0.0
    (found,) = shaken(add(row, AT, 1.7 * limit, 1))
    assert (found.kind, found.channel, found.index, found.stop) == ("spike", NAMES[row], AT, False)
    assert shaken(add(row, AT, 0.4 * limit, 1)) == ()


def test_what_shows_in_two_channels_is_no_spike_of_a_sensor() -> None:
    assert shaken(add([R1, R2], AT, 100.0, 1)) == ()


@pytest.mark.parametrize("back", [7, 20, 333])
def test_old_samples_once_more_are_no_measurement(back: int) -> None:
    def again(count: int) -> Change:
        def change(values: Float2D) -> None:
            for k in range(AT, AT + count):
                values[:, k] = values[:, k - back]

        return change

    (found,) = shaken(again(15))
    assert (found.kind, found.index, found.stop) == ("repeated", AT + 4, False)
    assert found.value == pytest.approx(back / RATE)
    stop = next(one for one in shaken(again(60)) if one.stop)
    assert (stop.kind, stop.index <= AT + 50) == ("lost", True)


# Command and table


def test_a_command_that_comes_later_than_queued_stops() -> None:
    def change(values: Float2D) -> None:
        values[DRIVE, AT:] = values[DRIVE, AT - 20 : -20].copy()

    stop = next(one for one in shaken(change) if one.stop)
    assert (stop.kind, stop.channel) == ("command", "drive_disp_m")
    assert stop.index - AT < CYCLE / 4


def test_a_converter_may_be_a_sample_late_and_a_little_off() -> None:
    def change(values: Float2D) -> None:
        values[DRIVE] = 1.005 * np.roll(values[DRIVE], 1)

    assert shaken(change) == ()


def test_a_small_command_is_read_back_over_whole_cycles() -> None:
    small = profile(acceleration_g=0.002)
    drive = plan_sweep(small)
    found = shaken(scaled(DRIVE, AT, 1.05), small, drive)
    assert {one.kind for one in found if one.channel == "drive_disp_m"} == {"command"}
    assert "command" not in kinds(shaken(scaled(DRIVE, AT, 1.01), small, drive))


def test_a_table_that_stays_where_it_is_stops() -> None:
    def change(values: Float2D) -> None:
        hold = measured(PLAN, 0.0)
        values[[TABLE, MASS], AT:] += hold[[TABLE, MASS], AT, None] - hold[[TABLE, MASS], AT:]
        values[[ACC, MASS_ACC], AT:] -= hold[[ACC, MASS_ACC], AT:]

    stop = next(one for one in shaken(change) if one.stop)
    assert (stop.kind, stop.channel) == ("following", "table_disp_m")
    assert stop.index - AT < CYCLE / 4


def test_before_the_table_is_known_any_lag_within_reason_is_allowed() -> None:
    assert shaken(lag=180) == ()  # 90 ms
    assert "following" in kinds(shaken(lag=320))


# Tracked


def test_the_level_is_tracked_on_the_fundamental() -> None:
    def share(factor: float, alone: bool = False) -> list[Finding]:
        rows = [ACC] if alone else [TABLE, ACC, MASS, MASS_ACC]
        return [one for one in shaken(scaled(rows, 0, factor)) if one.kind == "level"]

    assert share(1.08) == share(0.92) == []
    for factor in (1.12, 0.88):
        alarm = share(factor)[0]
        assert not alarm.stop
        assert alarm.to_event().kind == "alarm"
        assert alarm.value == pytest.approx(factor * A, rel=1e-2)
    for factor in (2.1, 0.48):
        stop = next(one for one in share(factor) if one.stop)
        assert 2 * CYCLE <= stop.index - 3000 <= 2.2 * CYCLE  # it is held from 1.5 s on
    assert not any(one.stop for one in share(1.9))


def test_the_level_is_not_judged_while_blending() -> None:
    def change(values: Float2D) -> None:
        blend = PLAN.labels(0, values.shape[1])[1] == Label.BLEND
        values[np.ix_([TABLE, ACC, MASS, MASS_ACC], blend)] *= 1.13

    assert "level" not in kinds(shaken(change))


def test_harmonics_of_the_table_are_no_fault() -> None:
    def change(values: Float2D) -> None:
        theta, level, f = steady(PLAN)
        extra = np.where(np.isfinite(f), 0.5 * level * np.sin(3 * theta), 0.0)
        values[[ACC, MASS_ACC]] += extra
        values[[TABLE, MASS]] -= extra / (6 * np.pi * f) ** 2

    assert "level" not in kinds(shaken(change))


def response(lag_s: float) -> FrequencyResponse:
    at = (1.0, 3.0, 9.0)
    return FrequencyResponse(0, at, (1.0, 1.0, 1.0), tuple(-2 * np.pi * f * lag_s for f in at))


def test_a_table_that_lags_more_than_it_did_is_soft() -> None:
    assert shaken(lag=30, known=response(0.015)) == ()
    found = first(shaken(lag=50, known=response(0.015)), "response")
    assert found.stop
    assert found.value == pytest.approx(0.025, abs=5e-4)
    assert "25.0 ms behind its command, 15.0 ms before" in found.text


def test_without_a_loop_check_the_same_frequency_must_be_met_as_before() -> None:
    both = profile(directions=("forward", "backward"), start_hz=2.0, stop_hz=2.5)
    drive = plan_sweep(both)
    half = drive.planned_end // 2

    def change(values: Float2D) -> None:
        late = measured(drive, 1.0, 40)
        values[1:, half:] = late[1:, half:]

    assert shaken(test=both, drive=drive, lag=20) == ()
    assert "response" in kinds(shaken(change, both, drive, lag=20))


@pytest.mark.parametrize(("row", "size"), [(TABLE, 3e-4), (ACC, 0.1), (MASS_ACC, 0.15), (R1, 8.0)])
def test_what_drifts_is_told(row: int, size: float) -> None:
    found = next(one for one in shaken(add(row, AT, size)) if one.kind != "level")
    assert found.kind in ("drift", "consistency")
    assert found.channel == NAMES[row]
    assert found.index - AT < 2.6 * CYCLE
    assert shaken(add(row, AT, size / 10)) == ()


def test_a_mass_that_swings_about_another_place_is_told_after_ten_cycles() -> None:
    long = profile(cycles=40)
    drive = plan_sweep(long)
    found = first(shaken(add(MASS, AT, 2e-3), long, drive), "drift")
    assert found.channel == "mass_disp_m"
    assert found.index - AT < 16 * CYCLE


@pytest.mark.parametrize("row", [TABLE, ACC, MASS, MASS_ACC])
@pytest.mark.parametrize("factor", [0.9, 1.1, -1.0])
def test_a_sensor_that_no_longer_fits_its_partner_is_told(row: int, factor: float) -> None:
    found = [one for one in shaken(scaled(row, AT, factor)) if one.kind == "consistency"]
    assert found[0].channel == NAMES[row]
    assert found[0].index - AT < 2.6 * CYCLE
    assert shaken(scaled(row, AT, 1.03)) == ()


@pytest.mark.parametrize("row", [MASS, MASS_ACC])
def test_nor_one_that_never_did(row: int) -> None:
    assert "consistency" in kinds(shaken(scaled(row, 0, 1.15)))
    assert shaken(scaled(row, 0, 1.10)) == ()


def test_a_sensor_that_the_controller_does_not_need_warns_if_so_asked() -> None:
    warned = shaken(scaled(MASS_ACC, AT, -1.0), profile("warn"))
    assert kinds(warned, stop=True) == []
    assert first(warned, "consistency").to_event().kind == "sensor"
    assert kinds(shaken(scaled(ACC, AT, -1.0), profile("warn")), stop=True) != []


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

    return shaken(push)


@pytest.mark.parametrize("share", [0.5, 0.35, 0.6])
def test_cells_may_share_a_force_as_they_like_but_always_so(share: float) -> None:
    assert impacts(share) == ()
    for row, factor in ((R1, 1.3), (R2, 0.7), (R1, -1.0), (R2, 0.1)):
        found = first(impacts(share, scaled(row, AT, factor)), "share")
        assert found.index - AT < 3.1 * CYCLE, (row, factor)


def test_a_cell_that_never_bore_a_thing_beside_one_that_does_is_told() -> None:
    found = first(impacts(1.0), "share")
    assert found.channel == "force_r2_n"


def test_where_both_cells_bear_beyond_the_gap_the_gap_is_elsewhere() -> None:
    found = first(impacts(0.5, add(MASS, AT, -4e-3)), "drift")
    assert found.channel == "mass_disp_m"
    assert "other side of the gap" in found.text


# The loop check judges the sensors itself


def checking() -> Drive:
    """A held motion at a tenth of the level, as in a loop check."""
    course = start_trajectory(TEST).append_blend(SineTarget(2.0, 0.1 * A), -1, 1.5, Label.BLEND)
    return course.append_hold(6000, -1, Label.CHECK).to_drive(TEST.sweep.steps)


@pytest.mark.parametrize("row", [DRIVE, TABLE, ACC, MASS, MASS_ACC])
@pytest.mark.parametrize("factor", [-1.0, 0.3, 2.0])
def test_a_loop_check_comes_to_speak_of_wrong_sensors(row: int, factor: float) -> None:
    assert shaken(scaled(row, 0, factor), drive=checking()) == ()


def test_but_limits_and_broken_sensors_stop_it() -> None:
    assert "stroke" in kinds(shaken(put(TABLE, AT, 0.07), drive=checking()), stop=True)
    assert "stuck" in kinds(shaken(put(TABLE, AT, 1e-4), drive=checking()), stop=True)
    assert "following" in kinds(shaken(add(TABLE, AT, 2e-3), drive=checking()), stop=True)


# The guard as a value


def everything(values: Float2D) -> None:
    """Many faults, one after another."""
    put(R1, 3500, np.random.default_rng(2).standard_normal(6000) * 0.1, 6000)(values)
    add(TABLE, 4001, 0.02, 1)(values)
    put(slice(None), 4500, np.nan, 20)(values)
    scaled(MASS_ACC, 5100, 1.4)(values)
    for k in range(6003, 6018):
        values[:, k] = values[:, k - 20]
    put(MASS, 7007, 0.01, 300)(values)
    scaled(ACC, 8000, 0.4)(values)
    put(TABLE, 11000, 0.061)(values)


def test_the_cut_into_blocks_changes_no_finding() -> None:
    warn = profile("warn")
    whole = shaken(everything, warn, cut=20, last=11100)
    assert {one.kind for one in whole} >= {
        "silent", "spike", "lost", "consistency", "repeated", "stuck", "level", "stroke",
    }  # fmt: skip
    for cut in (1, 7, 64, 500):
        assert repr(shaken(everything, warn, cut=cut, last=11100)) == repr(whole), cut


def test_a_guard_is_a_value() -> None:
    values = measured(PLAN)
    everything(values)
    clipped = np.zeros(values.shape, dtype=np.bool_)
    guard = start_protection(TEST, RIG, noises())
    guards: list[ProtectionState] = []
    for at in range(0, 9000, 500):
        guards.append(guard)
        guard, _ = inspect_samples(guard, seen(values, clipped, PLAN, at, 500))
    for at, one in zip(range(0, 9000, 500), guards, strict=True):
        again = seen(values, clipped, PLAN, at, 500)
        assert repr(inspect_samples(one, again)[1]) == repr(inspect_samples(one, again)[1])


def test_samples_that_were_left_out_are_refused() -> None:
    values, clipped = measured(PLAN), np.zeros((9, 20000), dtype=np.bool_)
    guard, _ = inspect_samples(
        start_protection(TEST, RIG, noises()), seen(values, clipped, PLAN, 0, 20)
    )
    with pytest.raises(ValueError, match="samples from 20 on are next, not from 40"):
        inspect_samples(guard, seen(values, clipped, PLAN, 40, 20))


def test_a_finding_is_told_once_until_it_has_been_away_for_a_second() -> None:
    def twice(apart: int) -> Change:
        def change(values: Float2D) -> None:
            for at in (AT, AT + apart):
                values[MASS, at] += 0.05

        return change

    assert kinds(shaken(twice(1500))) == ["spike"]
    assert kinds(shaken(twice(2500))) == ["spike", "spike"]


def test_a_finding_becomes_a_trip_or_an_event() -> None:
    finding = Finding(12, "stroke", "table_disp_m", 0.07, 0.06, "too far", True)
    assert finding.to_trip(20) == Trip(12, 20, "stroke", "table_disp_m", 0.07, 0.06, "too far")
    assert finding.to_event() == Event(12, "sensor", "too far")
    assert replace(finding, kind="level").to_event().kind == "alarm"


def test_sentences_name_channel_sample_value_and_limit() -> None:
    text = first(shaken(put(TABLE, AT, 0.0612)), "stroke").text
    assert text.startswith("table_disp_m: 61.2 mm at sample 500")
    assert text.endswith("exceeds 60 mm")
