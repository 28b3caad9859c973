"""Trajectory builder: the shortest allowed blends, continuous phase, cuts, and the soft stop."""

import math
from dataclasses import replace
from itertools import count

import numpy as np
import pytest

from table_io.block import Label
from table_io.excitation.drive import Drive, HistorySegment, Segment, peak_acceleration_ratio
from table_io.excitation.trajectory import (
    UNCHANGED,
    SineTarget,
    Trajectory,
    plan_sweep,
    start_trajectory,
)
from table_io.records import Step
from tests.builders.profiles import make_profile
from tests.table_io.excitation.test_kinds import profile as make_example

RATE_HZ = 1000.0
AT_REST = Trajectory(RATE_HZ, 300, SineTarget(2.0, 0.0))
SLOW, FAST = SineTarget(2.0, 0.5, 1.2, (0.01j,)), SineTarget(9.0, 0.4, 0.9)
ENDS = [
    (SineTarget(2.0, 0.0), SLOW),
    (SineTarget(2.0, 0.0), FAST),
    (SLOW, SineTarget(9.0, 0.0)),
    (SLOW, FAST),
    (FAST, SLOW),
    (SLOW, replace(SLOW, correction=1.25)),
    (SLOW, replace(SLOW, frequency_hz=2.1)),
    (SLOW, replace(SLOW, level_m_s2=5.0)),
]


def make_trajectory(target: SineTarget, phase: float = 0.0) -> Trajectory:
    return Trajectory(RATE_HZ, 300, target, phase)


@pytest.mark.parametrize("min_cycles", [0.5, 1.5, 3.0])
@pytest.mark.parametrize(("start", "target"), ENDS)
def test_blend_is_the_shortest_that_keeps_its_peak(
    start: SineTarget, target: SineTarget, min_cycles: float
) -> None:
    """Of the lengths that grow by a quarter cycle of the mean frequency."""
    blended = make_trajectory(start, 0.3).append_blend(target, 7, min_cycles, Label.BLEND)
    (segment,) = blended.segments
    assert isinstance(segment, Segment)
    # At rest there is no frequency: a blend from or to rest has that of its motion.
    first = start if start.level_m_s2 else replace(target, level_m_s2=0.0)
    last = target if target.level_m_s2 else replace(start, level_m_s2=0.0)
    fields = (segment.start, segment.label, segment.step, segment.phase0)
    assert fields == (300, Label.BLEND, 7, 0.3)
    assert first == SineTarget(segment.f0, segment.level0, segment.correction0, segment.shape0)
    assert last == SineTarget(segment.f1, segment.level1, segment.correction1, segment.shape1)
    mean_hz = (first.frequency_hz + last.frequency_hz) / 2.0
    shortest_s = min_cycles / mean_hz
    if not first.level_m_s2 or not last.level_m_s2:
        shortest_s = max(2.0 / mean_hz, 0.5)
    for quarters in count():
        samples = (shortest_s + quarters / 4.0 / mean_hz) * RATE_HZ
        if peak_acceleration_ratio(replace(segment, count=math.ceil(samples)), RATE_HZ) <= 1.05:
            break
    assert -1e-6 <= segment.count - samples < 1.0 + 1e-6  # sums of quarters may round up
    assert (segment.cycles, segment.settle) == (0, 0)
    assert (blended.end, blended.target) == (segment.end, last)
    turns = (first.frequency_hz + last.frequency_hz) / 2.0 * segment.count / RATE_HZ
    assert blended.phase == pytest.approx((0.3 + turns) % 1.0, abs=1e-12)


def test_blend_to_the_same_motion_is_none() -> None:
    assert make_trajectory(SLOW).append_blend(replace(SLOW), 0, 2.0, Label.BLEND).segments == ()


def test_hold_keeps_its_target_and_advances_the_phase() -> None:
    held = make_trajectory(SLOW, 0.9).append_hold(430, 3, Label.MEASURE, 4, 1)
    assert held.segments == (
        Segment(
            300, 430, Label.MEASURE, 3, 2.0, 2.0, 0.5, 0.5, 0.9, 4, 1, 1.2, 1.2, (0.01j,), (0.01j,)
        ),
    )
    assert (held.end, held.target) == (730, SLOW)
    assert held.phase == pytest.approx((0.9 + 0.86) % 1.0)
    again = held.append_hold(10, 3, Label.SETTLE)
    assert again.segments[0] == held.segments[0]
    assert again.segments[1].start == 730


def test_rest_and_histories_need_a_table_at_rest() -> None:
    assert AT_REST.append_rest(50) == replace(AT_REST, end=350, changed_from=300)
    history_m = np.linspace(0.0, 1e-3, 40)
    played = AT_REST.append_history(history_m, 3)
    (segment,) = played.segments
    assert isinstance(segment, HistorySegment)
    assert (segment.start, segment.windows, played.end) == (300, 3, 340)
    assert segment.history_m is history_m
    assert len(played.append_history(history_m, 3).segments) == 2
    assert played.to_drive(()).segments == played.segments
    for append in (
        lambda: make_trajectory(SLOW).append_rest(1),
        lambda: make_trajectory(SLOW).append_history(history_m, 1),
    ):
        with pytest.raises(ValueError, match="300"):
            append()


def test_cut_keeps_the_motion_before_it_and_ends_where_it_may() -> None:
    """A steady motion is cut at the sample, a blend at its end, rest at the sample."""
    trajectory = (
        AT_REST.append_blend(SLOW, 0, 2.0, Label.BLEND)
        .append_hold(900, 0, Label.MEASURE)
        .append_blend(FAST, 1, 2.0, Label.BLEND)
        .append_hold(400, 1, Label.SETTLE)
    )
    rise, hold, blend, last = trajectory.segments
    whole = Drive(RATE_HZ, trajectory.segments, ())
    for index in range(250, trajectory.end + 40, 3):
        cut = trajectory.cut(index)
        if index <= rise.start:
            assert (cut.end, cut.segments, cut.phase) == (index, (), 0.0)
            assert cut.target.level_m_s2 == 0
            continue
        ends = [rise.end, hold.end, blend.end, last.end]
        starts = [rise.start, hold.start, blend.start, last.start]
        kept = sum(start < index for start in starts)
        end = ends[kept - 1] if kept % 2 else min(index, ends[kept - 1])
        assert (cut.end, cut.segments) == (end, trajectory.segments[:kept])
        assert cut.target == (SLOW if kept <= 2 else FAST)
        assert 0.0 <= cut.phase < 1.0
        if end < last.end:
            turns = whole.phase(end, 1)[0]
            assert (cut.phase - turns + 0.5) % 1.0 - 0.5 == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    "target",
    [
        replace(SLOW, frequency_hz=2.2),
        replace(SLOW, level_m_s2=0.4),
        replace(SLOW, correction=1.1),
        replace(SLOW, shape=(0.02j,)),
    ],
)
def test_cut_keeps_a_blend(target: SineTarget) -> None:
    blended = make_trajectory(SLOW).append_blend(target, 0, 2.0, Label.BLEND)
    assert blended.cut(350) == blended


def test_history_is_not_cut() -> None:
    played = AT_REST.append_history(np.zeros(40), 1)
    assert played.cut(300).segments == ()
    with pytest.raises(ValueError, match="301"):
        played.cut(301)


def test_drive_ends_with_a_soft_stop_of_its_last_step() -> None:
    held = make_trajectory(FAST).append_hold(500, 6, Label.MEASURE)
    steps = (Step(6, "forward", 9.0, 0.4),)
    drive = held.to_drive(steps)
    stop = drive.segments[-1]
    assert isinstance(stop, Segment)
    assert (stop.start, stop.label, stop.step) == (held.end, Label.BLEND, 6)
    assert (stop.f0, stop.f1, stop.level0, stop.level1) == (9.0, 9.0, 0.4, 0.0)
    assert stop.count == 500  # half a second, longer than two cycles
    assert (drive.rate_hz, drive.steps) == (RATE_HZ, steps)
    assert held.to_drive(()).segments[:-1] == held.segments
    assert AT_REST.to_drive(()).segments == ()


def test_second_decay_does_not_postpone_the_first() -> None:
    drive = plan_sweep(make_profile())
    stopped = drive.decay_from(7000)
    assert stopped.decay_from(7500) == stopped
    assert stopped.decay_from(6000) == drive.decay_from(6000)


@pytest.mark.parametrize("rest_s", [1.0, 1.5003])
@pytest.mark.parametrize("rate_hz", [1000.0, 2000.0])
def test_trajectory_starts_after_its_rest(rate_hz: float, rest_s: float) -> None:
    acquisition = {"rate_hz": rate_hz, "rest_s": rest_s}
    start = start_trajectory(make_profile(tables={"acquisition": acquisition}))
    assert -1e-9 <= start.end - rest_s * rate_hz < 1.0
    assert (start.rate_hz, start.target, start.segments) == (rate_hz, SineTarget(2.0, 0.0), ())


def test_every_orbit_of_a_continuation_is_settled_and_measured() -> None:
    profile = make_example("continuation")
    assert profile.continuation is not None
    settle = profile.continuation.settle_cycles
    cycles = settle + profile.continuation.measured_cycles
    held = [segment for segment in plan_sweep(profile).sine_segments if segment.cycles]
    assert len(held) == len(profile.plan.steps)
    for segment in held:
        assert (segment.cycles, segment.settle) == (cycles, settle)
        assert -1e-9 <= segment.count - cycles / segment.f0 * profile.acquisition.rate_hz < 1.0


def test_first_changed_sample_is_the_earliest_of_all_changes() -> None:
    held = make_trajectory(SLOW).append_hold(400, 0, Label.MEASURE)
    queued = replace(held, changed_from=UNCHANGED)
    assert queued.append_hold(9, 0, Label.SETTLE).changed_from == 700
    assert queued.cut(800).changed_from == 700
    assert queued.cut(500).append_hold(40, 0, Label.SETTLE).cut(520).changed_from == 500
    assert queued.cut(200).changed_from == 200
