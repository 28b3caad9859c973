"""The monitor's board: what is known of a run, whatever the order and however often it is told."""

import random
from dataclasses import replace

import numpy as np
import pytest

from table_io.block import Block, Label
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.records import (
    Agreement,
    Estimate,
    Event,
    JumpForecast,
    Level,
    PrcPoint,
    RunStop,
    SampleGap,
    StepAdded,
    Timing,
    Trip,
)
from tests.monitor.monitored import (
    LEVEL,
    PROFILE,
    RATE,
    RIG,
    RUN,
    SENSORS,
    STEPS,
    block,
    make_comparison,
    point,
    records,
    start,
    stream,
)
from twin.monitor.margins import compute_live_margins
from twin.monitor.recent import RecentSamples
from twin.monitor.run_state import MAX_COMPONENTS, MAX_EVENTS, LiveRunState, update_run_state
from twin.transport.codec import Item


def board(items: list[Item], of: LiveRunState | None = None, run: str = RUN) -> LiveRunState:
    """The board after the items."""
    state = of or LiveRunState()
    for item in items:
        state = update_run_state(state, run, item)
    return state


def list_content(state: LiveRunState) -> tuple[object, ...]:
    """What a board says, apart from its last second."""
    names = ("run", "start", "index", "rig_state", "added_steps", "points", "latest", "timings",
             "gaps", "stop")  # fmt: skip
    news = sorted((event.index, event.level, event.text) for event in state.events.values())
    return *(getattr(state, name) for name in names), news


def test_order_and_repetition_change_nothing() -> None:
    items = records()
    once = list_content(board(items))
    assert board(items).rig_state == "running"
    shuffled = random.Random(1)
    for _ in range(20):
        several = [*items, *items]
        shuffled.shuffle(several)
        assert list_content(board(several)) == once


def test_the_newest_record_of_a_kind_stays() -> None:
    ahead = JumpForecast(100, 1, "forward", 2.5, "down", 3.9, 3.8, 4.0)
    later = replace(ahead, index=200, jump_hz=3.7)
    assert board([start(), later, ahead]).get_latest(JumpForecast) == later
    assert board([start(), ahead, later]).get_latest(JumpForecast) == later
    assert board([start()]).get_latest(JumpForecast) is None


def test_a_new_run_begins_with_an_empty_board_and_the_old_one_stays_away() -> None:
    state = board([*records(), *stream(), RunStop(8000, "complete", "all driven")])
    following = "20260102-120000-next"
    state = board([Event(0, "state", "checking"), start(following)], state, following)
    assert (state.run, state.rig_state, state.points, state.stop) == (
        following,
        "checking",
        {},
        None,
    )
    late = board([start(), point(4)], state, RUN)
    assert late is state
    assert not late.points


def test_only_a_start_makes_way_for_another_run() -> None:
    before = update_run_state(LiveRunState(), "of another run", point(4))
    state = board([point(1), point(2), start()], before)
    assert sorted(state.points) == [1, 2]
    assert board([point(3), block(0)], state, "of another run") is state
    assert sorted(state.points) == [1, 2]


def test_a_replay_that_begins_again_is_shown_from_its_beginning() -> None:
    state = board([*records(), *stream(), RunStop(8000, "complete", "all driven")])
    again = board([block(0, step=0, label=Label.REST)], state)
    assert (again.points, again.stop, again.index) == ({}, None, 20)
    assert again.start == state.start
    assert board([block(7000)], state).points == state.points  # an old block alone is none


def test_it_stays_small() -> None:
    flood: list[Item] = [Event(k, "warning", f"number {k}") for k in range(5 * MAX_EVENTS)]
    flood += [Timing(k, f"c{k}", 1.0, 1.0, 1.0, 0, 1, 0.0, "") for k in range(5 * MAX_COMPONENTS)]
    flood += [SampleGap(k, 1, f"c{k}", "lost") for k in range(5 * MAX_COMPONENTS)]
    state = board([start(), *flood])
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


def test_gaps_of_a_channel_are_one_sentence_with_their_sum() -> None:
    gaps = [SampleGap(at, 20, "mass_acc_m_s2", "clipped") for at in range(100, 200, 20)]
    state = board([start(), *gaps, *gaps])
    assert state.gaps == {("mass_acc_m_s2", "clipped"): (200, 100)}
    assert [event.text for event in state.events.values()] == [
        "dropout: 100 samples of mass_acc_m_s2 clipped"
    ]


def test_news_are_sentences_and_their_level_and_data_is_none() -> None:
    trip = Trip(500, 520, "stroke", "table_disp_m", 0.07, 0.06, "the table moved too far")
    level = Level(510, 0, LEVEL, LEVEL, 1.0, 0, True, ())
    state = board([start(), trip, level])
    assert [(event.level, event.text) for event in state.events.values()] == [
        ("ERROR", "protection (stroke): the table moved too far")
    ]


def test_a_step_that_was_decided_on_is_known() -> None:
    state = board([start(), StepAdded(10, 12, "forward", 3.21, LEVEL, "refined"),
                   replace_step(block(20), 12)])  # fmt: skip
    assert state.step is not None
    assert state.step.frequency_hz == 3.21
    assert state.step_count == 13


def replace_step(block: Block, number: int) -> Block:
    return replace(block, step=np.full(len(block), number))


def test_a_start_whose_cards_cannot_be_read_is_still_a_start() -> None:
    state = board([replace(start(), rig_toml="[", profile_toml="what = 1")])
    assert (state.rig, state.profile) == (None, None)
    assert state.step_count == len(STEPS)


def test_what_cannot_be_in_a_run_is_left_out() -> None:
    whole = board([start()])
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
        assert list_content(board([bad], board([start()]))) == list_content(whole)
        assert board([bad], board([start()])).position == whole.position
    assert board([replace(start(), rate_hz=0.0)]).start is None


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
    assert recent(blocks).table_level(f) == pytest.approx(LEVEL, rel=0.01)


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
    errors = board(
        [start(), *(make_comparison(at) for at in range(0, 3000, 20))]
    ).recent.twin_errors()
    assert errors["rel_disp_m"] == pytest.approx((1e-3, 1e-4, 2e-4))
    assert RecentSamples().twin_errors() == {}


def shares(values: np.ndarray, tare: dict[str, float]) -> dict[str, tuple[float, float, str]]:
    """(peak, limit, whose) of every quantity for a second of samples."""
    n = values.shape[1]
    zeros = np.zeros(n, dtype=np.int64)
    measured = Block("meas", 0, RATE, SENSORS, values, zeros, zeros, zeros)
    rig, profile = parse_toml(RIG, RigConfig, "rig"), parse_toml(PROFILE, Profile, "profile")
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
    rig, profile = parse_toml(RIG, RigConfig, "rig"), parse_toml(PROFILE, Profile, "profile")
    noise = {
        row.name: row.peak
        for row in compute_live_margins(rig, profile, {}, recent([old, new], 5.0))
    }
    assert noise["mass_acc_m_s2"] < 0.01


def test_points_are_kept_by_step() -> None:
    state = board([start(), point(1), point(0), point(1)])
    assert sorted(state.points) == [0, 1]
    assert all(isinstance(point, PrcPoint) for point in state.points.values())
