"""Laws of a session's ends and orders: whatever was ordered when, its record tells the truth."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from table_io.acquisition.output_queue import DECISION_S, OutputQueue
from table_io.acquisition.session import (
    ACCEPTED,
    COMMAND_DELAY_S,
    MAX_LATENESS_S,
    OperatorCommand,
    SessionSetup,
    find_gaps,
    run_session,
)
from table_io.backends import MachineLost
from table_io.block import Block, Float2D, Label, join_blocks
from table_io.clock import ManualClock, local_datetime
from table_io.config.calibration import find_overdue_calibrations
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import plan_sweep
from table_io.records import Event, Record, RunStop, SampleGap, Trip
from table_io.sequencer import procedure
from tests.builders.drives import sine_segments
from tests.builders.rigs import change_rig
from tests.builders.sessions import make_start
from tests.table_io.acquisition.test_session import (
    RATE_HZ,
    RIG,
    Hasty,
    Machine,
    Stop,
    blocks,
    machine,
    profile,
    session,
    stop_record,
)

BLOCK_SAMPLES = 20
REST_SAMPLES = round(profile().acquisition.rest_s * RATE_HZ)
BLOCK_COUNT = plan_sweep(profile()).planned_end // BLOCK_SAMPLES
FIRST_MOVING = sine_segments(plan_sweep(profile()))[0].start // BLOCK_SAMPLES + 1
LAW = settings(
    max_examples=6, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
VERDICTS = {"stop": "stopped", "abort": "aborted"}


@dataclass
class Orders:
    """Operator: gives each command after the block of its number."""

    orders: dict[int, str]
    asked: int = 0
    answers: list[str] = field(default_factory=list)

    def __call__(self) -> OperatorCommand | None:
        self.asked += 1
        name = self.orders.get(self.asked)
        reason = f"ordered {name} after {self.asked}"
        return OperatorCommand(name, reason, self.answers.append) if name else None


@dataclass
class Changes:
    """Every change of the drive: (first sample, samples played when it was decided)."""

    made: list[tuple[int, int]] = field(default_factory=list)


@pytest.fixture
def changes(monkeypatch: pytest.MonkeyPatch) -> Changes:
    """Record the changes of the drive of every queue."""
    record, change = Changes(), OutputQueue.change_drive

    def spy(queue: OutputQueue, drive: Drive, first: int) -> None:
        record.made.append((first, queue.played_samples()))
        change(queue, drive, first)

    monkeypatch.setattr(OutputQueue, "change_drive", spy)
    return record


def give(orders: dict[int, str] | Orders, subject: Machine | None = None) -> list[Block | Record]:
    """Return the items of a session with these orders."""
    subject = subject or machine()
    given_orders = orders if isinstance(orders, Orders) else Orders(orders)
    names = {*given_orders.orders.values()}
    subject.stopping |= bool({"hold", "resume"} & names)  # the drive changes
    return list(session(subject, given_orders))


def events(items: Iterable[Block | Record], kind: str) -> list[Event]:
    return [item for item in items if isinstance(item, Event) and item.kind == kind]


def assert_ends_after_rest(items: list[Block | Record], subject: Machine) -> None:
    """The stop record is the last one, after all of the motion, its rest and all its samples."""
    whole, stop = join_blocks(blocks(items)), stop_record(items)
    assert sum(isinstance(item, RunStop) for item in items) == 1
    assert stop.index == whole.end == subject.next
    moving = np.flatnonzero(whole.label != Label.REST)
    rest_start = int(moving[-1]) + 1 if moving.size else 0
    assert subject.moved_until <= rest_start + 1
    assert stop.index - rest_start in (REST_SAMPLES, REST_SAMPLES + 1)


@given(name=st.sampled_from(sorted(VERDICTS)), after=st.integers(1, BLOCK_COUNT))
@LAW
def test_stop_and_abort_are_recorded(name: str, after: int) -> None:
    items = give({after: name})
    stop = stop_record(items)
    assert (stop.verdict, stop.reason) == (VERDICTS[name], f"ordered {name} after {after}")
    (event,) = events(items, "stop")
    assert event.index == after * BLOCK_SAMPLES
    assert event.text == f"{stop.reason}; decaying to rest"
    assert stop.states[-2:] == ("stopping", "at rest")


@given(
    first=st.sampled_from(sorted(VERDICTS)),
    others=st.lists(st.sampled_from(["stop", "abort", "hold", "resume"]), min_size=1, max_size=4),
    after=st.integers(FIRST_MOVING, BLOCK_COUNT - 1),
)
@LAW
def test_first_end_that_was_ordered_counts(first: str, others: list[str], after: int) -> None:
    items = give({after: first} | {after + 1 + k: name for k, name in enumerate(others)})
    assert stop_record(items).verdict == VERDICTS[first]
    assert len(events(items, "stop")) == 1
    assert not events(items, "refused")


@pytest.mark.parametrize("ending", ["complete", "stop", "abort", "trip", "underrun", "hold"])
@pytest.mark.parametrize("after", [FIRST_MOVING, 611])
def test_no_session_ends_before_its_queue_has_run_out(
    ending: str, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(procedure, "MAX_HOLD_S", 1.0)
    subject = machine()
    if ending == "trip":
        lost = range(after * BLOCK_SAMPLES, after * BLOCK_SAMPLES + 60)
        subject.faults = {("table_disp_m", sample): np.nan for sample in lost}
    elif ending == "underrun":
        subject = Hasty(
            plan_sweep(profile()), ManualClock(), refused=1, after=after * BLOCK_SAMPLES
        )
    items = give({after: ending} if ending in ("stop", "abort", "hold") else {}, subject)
    assert_ends_after_rest(items, subject)
    verdict = {"complete": "complete", "stop": "stopped", "hold": "stopped"}.get(ending, "aborted")
    assert stop_record(items).verdict == verdict
    if ending == "hold":
        assert "hold timed out" in stop_record(items).reason


@given(after=st.integers(FIRST_MOVING + 10, 900), wait=st.integers(50, 80))
@LAW
def test_order_takes_effect_with_its_lead(after: int, wait: int, changes: Changes) -> None:
    changes.made.clear()
    subject = machine()
    items = give({after: "hold", after + wait: "resume"}, subject)
    lead = subject.replace_after + round((DECISION_S + COMMAND_DELAY_S) * RATE_HZ)
    assert lead == 250  # 40 samples of the device, 5 ms to decide and 0.1 s of patience
    (hold, hold_played), (resume, resume_played), *_ = changes.made
    assert hold_played == after * BLOCK_SAMPLES
    assert hold >= hold_played + lead
    assert (resume_played, resume) == (
        (after + wait) * BLOCK_SAMPLES,
        max((after + wait) * BLOCK_SAMPLES + lead, hold),
    )
    ordered = [event for event in events(items, "state") if event.text in ("holding", "running")]
    assert [(event.index, event.text) for event in ordered[-2:]] == [
        (hold_played, "holding"),
        (resume_played, "running"),
    ]
    assert_ends_after_rest(items, subject)
    assert stop_record(items).verdict == "complete"


@pytest.mark.parametrize(
    ("orders", "refused"),
    [
        ({1: "hold"}, ["hold in 'armed'"]),
        ({300: "resume"}, ["resume in 'running'"]),
        ({300: "hold", 350: "hold", 400: "resume"}, ["hold in 'holding'"]),
        ({300: "hold", 350: "resume", 351: "resume"}, ["resume in 'running'"]),
    ],
)
def test_order_out_of_place_is_refused_and_changes_nothing(
    orders: dict[int, str], refused: list[str], changes: Changes
) -> None:
    operator = Orders(orders)
    items = give(operator)
    texts = [event.text for event in events(items, "refused")]
    assert [text.replace(" is not possible in state", " in") for text in texts] == refused
    # Every order is answered by what became of it.
    refusals = [answer for answer in operator.answers if answer != ACCEPTED]
    assert refusals == [f"refused: {text}" for text in texts]
    assert len(operator.answers) == len(orders)
    assert len(changes.made) == len(orders) - len(refused)
    assert stop_record(items).verdict == "complete"


def test_order_during_the_decay_is_answered() -> None:
    operator = Orders({300: "stop", 305: "hold", 306: "stop"})
    give(operator)
    assert operator.answers == [
        ACCEPTED, "refused: hold is not possible while the table comes to rest", ACCEPTED,
    ]  # fmt: skip


def test_trip_during_a_decay_is_no_second_stop() -> None:
    faults = dict.fromkeys([("table_disp_m", 6020 + k) for k in range(5)], 0.07)
    items = give({300: "stop"}, machine(faults=faults))
    assert stop_record(items).verdict == "stopped"
    assert not [item for item in items if isinstance(item, Trip)]


@dataclass
class Mute(Machine):
    """A machine whose connection is lost at a sample."""

    lost_at: int = 5000

    def read(self, samples: int) -> Float2D:
        if self.next + samples > self.lost_at:
            raise MachineLost("no answer for 2 s")
        return super().read(samples)


@pytest.mark.parametrize("lost_at", [0, 3000, 5007])
def test_lost_machine_halts_the_test_when_its_queue_has_run_out(lost_at: int) -> None:
    subject = Mute(plan_sweep(profile()), ManualClock(), lost_at=lost_at)
    items: list[Block | Record] = []
    for item in session(subject, Stop()):
        if isinstance(item, RunStop):
            assert subject.clock.now() >= subject.scheduled_time_s(subject.moved_until - 1)
        items.append(item)
    index = lost_at // BLOCK_SAMPLES * BLOCK_SAMPLES
    stop = stop_record(items)
    assert (stop.index, stop.verdict, stop.reason) == (index, "halted", "no answer for 2 s")
    assert stop.states[-1] == "fault"
    (trip,) = (item for item in items if isinstance(item, Trip))
    assert trip == Trip(index, index, "machine", "", 0.0, 0.0, "no answer for 2 s")
    assert subject.calls[-1] == "close"


@dataclass
class Late(Machine):
    """A machine whose blocks come late from one sample to another."""

    late_from: int = 5000
    late_to: int = 5100
    late_s: float = 1.2 * MAX_LATENESS_S

    def read(self, samples: int) -> Float2D:
        values = super().read(samples)
        if self.late_from < self.next <= self.late_to:
            self.clock.wait_until(self.scheduled_time_s(self.next - 1) + self.late_s)
        return values


@pytest.mark.parametrize(
    ("late_s", "late_from", "expected"),
    [(0.12, 5000, [5020, 5520]), (0.12, 0, [20, 5520]), (0.08, 5000, [])],
)
def test_late_blocks_are_reported_once_a_series(
    late_s: float, late_from: int, expected: list[int]
) -> None:
    subject = Late(plan_sweep(profile()), ManualClock(), late_s=late_s, late_from=late_from)
    items = []
    for item in session(subject, Stop()):
        items.append(item)
        if isinstance(item, Block) and item.end == 5400:
            subject.late_from, subject.late_to = 5500, 5600
    late = events(items, "late")
    assert [event.index for event in late] == expected
    assert all(f"{event.index} came {late_s:.3f} s late" in event.text for event in late)
    assert stop_record(items).verdict == "complete"


def test_feedback_that_comes_too_late_every_time_ends_the_test(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each try answers from a later sample on, by one block; the last one is the last."""
    answer, earliest_samples = procedure.answer_block, []

    def answer_with_feedback(state: Any, block: Block, earliest: int) -> Any:
        state, records = answer(state, block, earliest)
        if block.index < 100 * BLOCK_SAMPLES:
            return state, records
        earliest_samples.append(earliest)
        return replace(state, search=object()), records

    monkeypatch.setattr(procedure, "answer_block", answer_with_feedback)
    monkeypatch.setattr(OutputQueue, "replace_drive", lambda *_: False)
    subject = machine()
    items = list(session(subject, Stop()))
    stop = stop_record(items)
    assert stop.verdict == "aborted"
    assert stop.reason == "the feedback came too late 5 times in a row"
    first = 101 * BLOCK_SAMPLES + subject.replace_after + round(DECISION_S * RATE_HZ)
    assert earliest_samples == [first + BLOCK_SAMPLES * attempt for attempt in range(5)]
    assert_ends_after_rest(items, subject)


@dataclass
class Taring(Machine):
    """A machine whose sensor `reversed_channel` is mounted the other way round."""

    reversed_channel: str = ""
    tared: list[int] = field(default_factory=list)
    shown: dict[int, float] = field(default_factory=dict)  # shares of the range, at samples

    def tare(self, samples: int) -> Float2D:
        self.tared.append(samples)
        return super().tare(samples)

    def read(self, samples: int) -> Float2D:
        first, volts = self.next, super().read(samples)
        row = self.channels.index("force_l2_n")
        full_scale = abs(RIG.sensors[row].range_si * RIG.sensors[row].volts_per_si)
        for sample, share in self.shown.items():
            if first <= sample < self.next:
                volts[row, sample - first] = share * full_scale
        if self.reversed_channel:
            volts[self.channels.index(self.reversed_channel)] *= -1.0
        return volts


@pytest.mark.parametrize("is_reversed", [False, True])
def test_samples_from_999_thousandths_of_the_range_on_are_clipped(is_reversed: bool) -> None:
    shown = {101: 0.998, 105: 0.999, 110: 1.0, 115: -0.998, 120: -0.999, 125: -1.2}
    channel = "force_l2_n" if is_reversed else ""
    subject = Taring(plan_sweep(profile()), ManualClock(), reversed_channel=channel, shown=shown)
    slope = RIG.sensors[RIG.channels.index("force_l2_n")].volts_per_unit
    setup = SessionSetup(profile(), change_rig(sensors={channel: {"volts_per_unit": -slope}}))
    items = list(run_session(setup, subject, subject.clock, make_start, Stop(10)))
    gaps = [item for item in items if isinstance(item, SampleGap)]
    assert gaps == [
        SampleGap(at, 1, "force_l2_n", "clipped")
        for at, share in shown.items()
        if abs(share) >= 0.999
    ]
    whole = join_blocks(blocks(items)).channel("force_l2_n")
    range_n = RIG.sensors[RIG.channels.index("force_l2_n")].range_si
    assert whole[list(shown)] == pytest.approx([range_n * share for share in shown.values()])


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("density", [0.0, 0.02, 0.5, 1.0])
def test_gaps_are_the_runs_of_every_channel(density: float, seed: int) -> None:
    draw = np.random.default_rng(seed)
    lost, clipped = (
        draw.random((2, 3, 30)) < np.array([density, density * (seed % 2)])[:, None, None]
    )
    values = np.where(lost, np.nan, 1.0)
    none = np.zeros(30, dtype=np.int64)
    block = Block("meas", 400, RATE_HZ, ("a", "b", "c"), values, none, none, none)
    expected = []
    for channel, *masks in zip("abc", lost, clipped, strict=True):
        for mask, reason in zip(masks, ("lost", "clipped"), strict=True):
            place = 400
            for is_gap, samples in itertools.groupby(mask.tolist()):
                count = len(list(samples))
                expected += [SampleGap(place, count, channel, reason)] if is_gap else []
                place += count
    assert list(find_gaps(block, clipped)) == expected


def test_feedback_that_is_too_late_because_the_lead_ran_out_is_an_underrun(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    answer = procedure.answer_block

    def answer_with_feedback(state: Any, block: Block, earliest: int) -> Any:
        state, records = answer(state, block, earliest)
        is_due = block.end > 100 * BLOCK_SAMPLES
        return (replace(state, search=object()) if is_due else state), records

    monkeypatch.setattr(procedure, "answer_block", answer_with_feedback)
    monkeypatch.setattr(OutputQueue, "replace_drive", lambda *_: False)
    monkeypatch.setattr(
        OutputQueue, "has_run_out", property(lambda queue: queue.acquired > 100 * BLOCK_SAMPLES)
    )
    items = list(session(machine(stopping=True), Stop()))  # less than the lead plays
    (trip,) = (item for item in items if isinstance(item, Trip))
    assert (trip.kind, trip.decided) == ("late", 101 * BLOCK_SAMPLES)
    assert events(items, "stop") == []
    assert stop_record(items).verdict == "aborted"


@pytest.mark.parametrize("due", ["2020-01-01", "9999-01-01"])
def test_overdue_calibrations_are_events_before_the_first_block(due: str) -> None:
    rig = change_rig(every_sensor={"due": due})
    subject = machine()
    items = list(
        run_session(SessionSetup(profile(), rig), subject, subject.clock, make_start, Stop(2))
    )
    warnings = find_overdue_calibrations(rig, local_datetime().date())
    assert len(warnings) == (len(RIG.sensors) - 1) * (due < "2026")
    assert [event.text for event in events(items, "calibration")] == warnings
    assert {event.index for event in events(items, "calibration")} <= {0}
    first_block = next(place for place, item in enumerate(items) if isinstance(item, Block))
    assert len(events(items[:first_block], "calibration")) == len(warnings)
