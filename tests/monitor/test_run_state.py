"""The state of a run as received, whatever the order and however often."""

import random
from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Block, Label
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.excitation.drive import Drive
from table_io.records import (
    Agreement,
    Estimate,
    Event,
    JumpForecast,
    Level,
    PrcPoint,
    RunStart,
    RunStop,
    SampleGap,
    StepAdded,
    Timing,
    Trip,
)
from table_io.sequencer.procedure import make_test_plan, nominal_drive
from tests.builders.profiles import AT_1_KHZ, format_test
from tests.builders.rigs import RIG_TEXT
from tests.monitor.monitored import (
    LEVEL,
    PROFILE,
    RATE,
    RUN,
    SENSORS,
    STEPS,
    block,
    make_comparison,
    point,
    receive,
    records,
    start,
    stream,
)
from twin.monitor.recent import RecentSamples, compute_live_margins
from twin.monitor.run_state import MAX_COMPONENTS, MAX_EVENTS, LiveRunState, update_run_state
from twin.transport.codec import Item


def list_content(state: LiveRunState) -> tuple[object, ...]:
    """Return what a state holds, without its last seconds."""
    names = ("run", "start", "index", "rig_state", "added_steps", "points", "latest", "timings",
             "gaps", "stop")  # fmt: skip
    news = sorted((event.index, event.level, event.text) for event in state.events.values())
    return *(getattr(state, name) for name in names), news


def test_state_does_not_depend_on_order_and_repetition() -> None:
    items = records()
    once = list_content(receive(*items))
    assert receive(*items).rig_state == "running"
    shuffled = random.Random(1)
    for _ in range(20):
        several = [*items, *items]
        shuffled.shuffle(several)
        assert list_content(receive(*several)) == once


def test_newest_record_of_a_kind_stays() -> None:
    ahead = JumpForecast(100, 1, "forward", 2.5, "down", 3.9, 3.8, 4.0)
    later = replace(ahead, index=200, jump_hz=3.7)
    assert receive(start(), later, ahead).get_latest(JumpForecast) == later
    assert receive(start(), ahead, later).get_latest(JumpForecast) == later
    assert receive(start()).get_latest(JumpForecast) is None


def test_new_run_replaces_the_state_and_the_old_one_is_ignored() -> None:
    state = receive(*records(), *stream(), RunStop(8000, "complete", "all driven"))
    following = "20260102-120000-next"
    state = receive(Event(0, "state", "checking"), start(following), state=state, run=following)
    assert (state.run, state.rig_state, state.points, state.stop) == (
        following,
        "checking",
        {},
        None,
    )
    late = receive(start(), point(4), state=state, run=RUN)
    assert late is state
    assert not late.points


def test_items_of_another_run_wait_for_its_start() -> None:
    before = update_run_state(LiveRunState(), "of another run", point(4))
    state = receive(point(1), point(2), start(), state=before)
    assert sorted(state.points) == [1, 2]
    assert receive(point(3), block(0), state=state, run="of another run") is state
    assert sorted(state.points) == [1, 2]


def test_replay_that_begins_again_clears_the_state() -> None:
    state = receive(*records(), *stream(), RunStop(8000, "complete", "all driven"))
    again = receive(block(0, step=0, label=Label.REST), state=state)
    assert (again.points, again.stop, again.index) == ({}, None, 20)
    assert again.start == state.start
    assert receive(block(7000), state=state).points == state.points  # an old block alone is none


def test_state_is_bounded() -> None:
    flood: list[Item] = [Event(k, "warning", f"number {k}") for k in range(5 * MAX_EVENTS)]
    flood += [Timing(k, f"c{k}", 1.0, 1.0, 1.0, 0, 1, 0.0, "") for k in range(5 * MAX_COMPONENTS)]
    flood += [SampleGap(k, 1, f"c{k}", "lost") for k in range(5 * MAX_COMPONENTS)]
    state = receive(start(), *flood)
    assert (len(state.events), len(state.timings), len(state.gaps)) == (
        MAX_EVENTS,
        MAX_COMPONENTS,
        MAX_COMPONENTS,
    )
    assert min(event.index for event in state.events.values()) >= MAX_COMPONENTS
    for k in range(0, 100_000, 20):
        state = update_run_state(state, RUN, block(k))
        state = update_run_state(state, RUN, make_comparison(k))
    assert sum(len(block) for block in state.recent.blocks) <= RATE + 40
    assert sum(comparison.count for comparison in state.recent.comparisons) <= RATE + 40


def test_gaps_of_a_channel_are_one_event_with_their_sum() -> None:
    gaps = [SampleGap(at, 20, "mass_acc_m_s2", "clipped") for at in range(100, 200, 20)]
    state = receive(start(), *gaps, *gaps)
    assert state.gaps == {("mass_acc_m_s2", "clipped"): (200, 100)}
    assert [event.text for event in state.events.values()] == [
        "dropout: 100 samples of mass_acc_m_s2 clipped"
    ]


def test_events_have_a_level_and_data_are_none() -> None:
    trip = Trip(500, 520, "stroke", "table_disp_m", 0.07, 0.06, "the table moved too far")
    level = Level(510, 0, LEVEL, LEVEL, 1.0, 0, True, ())
    state = receive(start(), trip, level)
    assert [(event.level, event.text) for event in state.events.values()] == [
        ("ERROR", "protection (stroke): the table moved too far")
    ]


def test_added_step_is_known() -> None:
    state = receive(start(), StepAdded(10, 12, "forward", 3.21, LEVEL, "refined"),
                   replace_step(block(20), 12))  # fmt: skip
    assert state.step is not None
    assert state.step.frequency_hz == 3.21
    assert state.step_count == 13


def replace_step(block: Block, number: int) -> Block:
    return replace(block, step=np.full(len(block), number))


def test_start_with_unreadable_files_is_still_a_start() -> None:
    state = receive(replace(start(), rig_toml="[", profile_toml="what = 1"))
    assert (state.rig, state.profile) == (None, None)
    assert state.step_count == len(STEPS)


def test_invalid_items_are_ignored() -> None:
    whole = receive(start())
    first = block(0)
    (agreement,) = (record for record in records() if isinstance(record, Agreement))
    (estimate,) = (record for record in records() if isinstance(record, Estimate))
    for bad in (
        replace(agreement, band=(1.0,)),
        replace(estimate, sd=()),
        replace(point(0), frequency_hz=0.0),
        replace(make_comparison(0), measured_ss=(1.0,)),
        replace(first, label=first.label + 77),
        replace(first, rate_hz=17.0),
        replace(start(), rate_hz=0.0),
    ):
        assert list_content(receive(bad, state=receive(start()))) == list_content(whole)
        assert receive(bad, state=receive(start())).position == whole.position
    assert receive(replace(start(), rate_hz=0.0)).start is None


def recent(blocks: list[Block], cycle_s: float = 0.3) -> RecentSamples:
    samples = RecentSamples()
    for measured in blocks:
        samples.add(measured, cycle_s)
    return samples


def test_the_level_is_the_fundamental_of_the_last_whole_cycles() -> None:
    f = STEPS[3].frequency_hz
    blocks = [block(at) for at in range(0, 2000, 20)]
    for measured in blocks:
        measured.values.setflags(write=True)
        at = (measured.index + np.arange(20)) / RATE
        measured.values[2] += 0.3 * LEVEL * np.sin(3 * 2 * np.pi * f * at) + 0.1  # an offset too
    level = recent(blocks).table_level(f)
    assert level is not None
    peak = max(np.abs(block.values[2]).max() for block in blocks[-50:])
    assert level == pytest.approx((LEVEL, peak), rel=0.01)
    assert peak > 1.1 * LEVEL


def test_no_level_before_a_cycle_is_held_or_where_samples_are_missing() -> None:
    f = STEPS[3].frequency_hz
    assert recent([block(at) for at in range(0, 260, 20)]).table_level(f) is None
    blending = [block(at, label=Label.BLEND) for at in range(0, 1000, 20)]
    held = [block(at) for at in range(1000, 1200, 20)]
    assert recent([*blending, *held]).table_level(f) is None
    lost = [block(at) for at in range(0, 1000, 20) if at != 900]
    assert recent(lost).table_level(f) is None
    nan = block(1000)
    nan.values.setflags(write=True)
    nan.values[2] = np.nan
    assert recent([*(block(at) for at in range(0, 1000, 20)), nan]).table_level(f) is None
    assert RecentSamples().table_level(f) is None


def test_errors_are_rms_of_the_last_second() -> None:
    errors = receive(
        start(), *(make_comparison(at) for at in range(0, 3000, 20))
    ).recent.twin_errors()
    assert errors["rel_disp_m"] == pytest.approx((1e-3, 1e-4, 2e-4))
    assert RecentSamples().twin_errors() == {}


def shares(values: np.ndarray, tare: dict[str, float]) -> dict[str, tuple[float, float, str]]:
    """(peak, limit, whose) of every quantity for a second of samples."""
    n = values.shape[1]
    zeros = np.zeros(n, dtype=np.int64)
    measured = Block("meas", 0, RATE, SENSORS, values, zeros, zeros, zeros)
    rig, profile = parse_toml(RIG_TEXT, RigConfig, "rig"), parse_toml(PROFILE, Profile, "profile")
    rows = compute_live_margins(rig, profile, tare, recent([measured]))
    return {row.name: (row.peak, row.limit, row.limit_source) for row in rows}


def test_margins_are_peaks_against_range_or_machine() -> None:
    values = np.zeros((len(SENSORS), 1000))
    values[1] = 0.03 * np.arange(1000) / 1000  # 30 mm/s to 30 mm
    values[2, 500], values[3, 400], values[4] = 4.903325, -0.05, 10.0
    values[5, 100], values[6] = -4000.0, np.nan
    margins = shares(values, {"mass_disp_m": -0.02})
    assert margins["table_disp_m"] == (pytest.approx(29.97), 60.0, "stroke")
    assert margins["table_acc_m_s2"] == (pytest.approx(0.5), 1.0, "table")
    assert margins["mass_disp_m"] == (pytest.approx(70.0), 100.0, "range")  # what the sensor sees
    assert margins["force_r1_n"] == (pytest.approx(4.0), 10.0, "range")
    assert np.isnan(margins["force_r2_n"][0])
    assert margins["velocity"] == (pytest.approx(30.0), 500.0, "table")
    assert margins["force"] == (pytest.approx((2000 * 4.903325 + 550 * 10) / 1e3), 30.0, "table")


def test_margins_know_only_the_last_second() -> None:
    old, new = block(0, 1000), block(1000, 1000)
    old.values.setflags(write=True)
    old.values[4] = 40.0
    rig, profile = parse_toml(RIG_TEXT, RigConfig, "rig"), parse_toml(PROFILE, Profile, "profile")
    noise = {
        row.name: row.peak
        for row in compute_live_margins(rig, profile, {}, recent([old, new], 5.0))
    }
    assert noise["mass_acc_m_s2"] < 0.01


def test_points_are_kept_by_step() -> None:
    state = receive(start(), point(1), point(0), point(1))
    assert sorted(state.points) == [0, 1]
    assert all(isinstance(point, PrcPoint) for point in state.points.values())


SHORT_SWEEP = format_test(2.0, 2.5, 0.5, directions=["forward"], tables=AT_1_KHZ)


def start_sweep() -> tuple[RunStart, Drive]:
    """Return the start record of a short sweep, and its nominal drive."""
    profile = parse_toml(SHORT_SWEEP, Profile, "profile")
    drive = nominal_drive(make_test_plan(profile, parse_toml(RIG_TEXT, RigConfig, "rig")))
    planned = {"steps": drive.steps, "planned_samples": drive.planned_end}
    return replace(start(), profile_toml=SHORT_SWEEP, **planned), drive  # type: ignore[arg-type]


def drive_blocks(drive: Drive, shift: int, first: int, end: int) -> list[Block]:
    """Return blocks with the labels of a drive that runs `shift` samples late."""
    labels = [drive.labels(index - shift, 20) for index in range(first, end, 20)]
    return [
        replace(block(index), step=step, label=label, cycle=cycle)
        for index, (step, label, cycle) in zip(range(first, end, 20), labels, strict=True)
    ]


def test_time_left_is_the_planned_one_as_long_as_nothing_happens() -> None:
    begin, drive = start_sweep()
    for end in (2000, drive.planned_end // 2, drive.planned_end - 100):
        state = receive(begin, *drive_blocks(drive, 0, 0, end))
        assert state.index + 1000 * state.remaining_s == pytest.approx(drive.planned_end, abs=40)


def settle(step: int, first: int, end: int) -> list[Block]:
    """Return blocks at a step that is being tuned or held, without held cycles."""
    return [
        replace(block(index, step=step, label=Label.SETTLE), cycle=np.full(20, -1))
        for index in range(first, end, 20)
    ]


def test_time_left_stays_while_a_step_is_tuned_again_or_held() -> None:
    begin, drive = start_sweep()
    held = {segment.step: segment.start for segment in drive.sine_segments if segment.cycles}
    first = held[0] // 20 * 20 - 20
    state = receive(begin, *drive_blocks(drive, 0, 0, first), *settle(0, first, first + 2000))
    assert state.remaining_s == pytest.approx((drive.planned_end - held[0]) / RATE, abs=0.03)
    receive(*drive_blocks(drive, 2000, first + 2000, held[1] + 2100), state=state)
    assert state.index + RATE * state.remaining_s == pytest.approx(drive.planned_end + 2000, abs=40)
    hold, begin_of_hold = Event(state.index, "state", "holding"), state.index
    receive(hold, *settle(1, begin_of_hold, begin_of_hold + 3000), state=state)
    # The step is measured again from its first held cycle.
    assert state.remaining_s == pytest.approx((drive.planned_end - held[1]) / RATE, abs=0.03)


def test_time_left_grows_with_an_added_step() -> None:
    begin, drive = start_sweep()
    planned = receive(begin, *drive_blocks(drive, 0, 0, drive.planned_end))
    added = StepAdded(drive.planned_end, 2, "forward", 2.25, LEVEL, "refined")
    state = receive(added, added, state=planned)
    assert state.remaining_s > 4 / 2.25
    assert state.remaining_s < 4 / 2.25 + 4.0  # blend and tuning
