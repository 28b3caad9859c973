"""Laws of the output queue: what it queues, refuses and reads, to the sample."""

from typing import Any

import numpy as np
import pytest

from table_io.acquisition.output_queue import DECISION_S, BufferUnderrun, OutputQueue
from table_io.acquisition.session import OperatorCommand, SessionSetup, run_session
from table_io.block import Label, join_blocks
from table_io.clock import ManualClock
from table_io.excitation.trajectory import plan_sweep
from table_io.records import Event, FrequencyResponse
from tests.table_io.acquisition.test_session import (
    RATE_HZ,
    RIG,
    A,
    Hasty,
    Machine,
    Stop,
    Watched,
    blocks,
    machine,
    profile,
    start_record,
    stop_record,
)
from tests.table_io.excitation.sine_segments import sine_segments

BLOCK_SAMPLES = 20


def start_queue(subject: Machine) -> OutputQueue:
    queue = OutputQueue(subject, subject.clock, RIG.output, subject.drive, BLOCK_SAMPLES)
    queue.start()
    return queue


def play(queue: OutputQueue, subject: Machine, until: int) -> None:
    """Read and feed block by block."""
    while queue.acquired < until:
        subject.read(BLOCK_SAMPLES)
        queue.acquired += BLOCK_SAMPLES
        queue.feed()


@pytest.mark.parametrize("until", [4000, 8000, 8190])
def test_bringing_to_rest_reads_until_rest_and_no_further(until: int) -> None:
    subject = machine()
    queue = start_queue(subject)
    play(queue, subject, until)
    queue.bring_to_rest()
    assert subject.next == queue.acquired == queue.drive.rest_start
    assert not queue.is_moving
    queue.bring_to_rest()
    assert subject.next == queue.drive.rest_start


def test_a_queue_that_never_started_has_nothing_to_bring_to_rest() -> None:
    subject = machine()
    queue = OutputQueue(subject, subject.clock, RIG.output, subject.drive, BLOCK_SAMPLES)
    assert queue.played_samples() == 0
    assert not queue.has_run_out
    queue.bring_to_rest()
    queue.wait_for_rest()
    assert (subject.next, subject.clock.now()) == (0, 0.0)


@pytest.mark.parametrize("late_s", [0.0, 0.4])
def test_decisions_have_the_margin_of_the_machine_and_of_the_transfer(late_s: float) -> None:
    subject = machine()
    queue = start_queue(subject)
    play(queue, subject, 4000)
    subject.clock.wait_until(subject.clock.now() + late_s)
    played = 4000 + round(late_s * RATE_HZ)
    assert queue.played_samples() == played
    assert queue.first_changeable() == played + subject.replace_after + DECISION_S * RATE_HZ


def test_a_drive_is_replaced_at_once_or_nothing_changes() -> None:
    subject = Hasty(plan_sweep(profile()), ManualClock(), after=4000)
    queue = start_queue(subject)
    play(queue, subject, 4000)
    drive, first = queue.drive, queue.first_changeable()
    subject.stopping = True
    decaying = drive.decay_from(first + 500)
    subject.refused = 1
    before = (queue.drive, queue._queued_end)
    assert queue.replace_drive(decaying, first) is False
    assert (queue.drive, queue._queued_end) == before
    assert queue.replace_drive(decaying, first) is True
    assert queue.drive is decaying
    np.testing.assert_allclose(
        subject.take_command(0, decaying.rest_start),
        decaying.command(0, decaying.rest_start),
        rtol=0, atol=1e-15,
    )  # fmt: skip


def test_nothing_is_replaced_once_the_lead_has_run_out() -> None:
    subject = machine()
    queue = start_queue(subject)
    play(queue, subject, 4000)
    drive, end = queue.drive, queue._queued_end
    spare = end - subject.replace_after - queue.played_samples()
    subject.clock.wait_until(subject.clock.now() + spare / RATE_HZ)
    assert not queue.has_run_out
    subject.clock.wait_until(subject.clock.now() + 1.0 / RATE_HZ)
    assert queue.has_run_out
    assert queue.replace_drive(drive.decay_from(end + 100), end + 100) is False
    assert queue.drive is drive
    with pytest.raises(BufferUnderrun, match=f"ended at sample {end}"):
        queue.feed()
    assert queue.drive.decay_start == end


def test_a_drive_at_rest_is_not_replaced() -> None:
    subject = machine()
    queue = start_queue(subject)
    calls = subject.calls.count("queue")
    assert queue.replace_drive(queue.drive, queue.drive.rest_start) is True
    assert subject.calls.count("queue") == calls


def test_a_tuned_test_plays_every_drive_that_was_decided_on() -> None:
    """Loop check and amplitude control change the drive on the way; each change is queued."""
    test = profile(stop_hz=2.5, directions=("forward",))
    defaults = type(test).model_fields
    test = test.model_copy(
        update={name: defaults[name].get_default(call_default_factory=True)
                for name in ("loop_check", "control")}
    )  # fmt: skip
    table = Watched(test)
    items: list[Any] = list(
        run_session(SessionSetup(test, RIG), table, table.clock, start_record, Stop())
    )
    whole = join_blocks(blocks(items))
    assert stop_record(items).verdict == "complete"
    assert sum(isinstance(item, FrequencyResponse) for item in items) == 1
    measured = whole.label == Label.MEASURE
    assert set(whole.step[measured].tolist()) == set(range(len(test.steps)))
    for step in test.steps:
        held = measured & (whole.step == step.index)
        peak = np.sqrt(2.0) * whole.channel("table_acc_m_s2")[held].std()
        assert peak == pytest.approx(A, rel=0.03)
    states = [item.text for item in items if isinstance(item, Event) and item.kind == "state"]
    assert states == ["checking", "armed", "running", "at rest"]
    running = next(item for item in items if isinstance(item, Event) and item.text == "running")
    assert 0 <= running.index - int(np.flatnonzero(whole.step >= 0)[0]) <= BLOCK_SAMPLES


@pytest.mark.parametrize("after", [100, 461])
def test_the_command_before_an_order_is_that_of_the_whole_drive(after: int) -> None:
    subject = machine()

    def order() -> OperatorCommand | None:
        due = subject.next >= after * BLOCK_SAMPLES
        return OperatorCommand("abort", "now") if due else None

    items = list(
        run_session(SessionSetup(profile(), RIG), subject, subject.clock, start_record, order)
    )
    first = after * BLOCK_SAMPLES + subject.replace_after + round(DECISION_S * RATE_HZ)
    moving = after * BLOCK_SAMPLES >= sine_segments(subject.drive)[0].start
    assert moving
    assert subject.changed_samples[0] in range(first, first + 3)  # a decay begins with a factor 1
    assert stop_record(items).verdict == "aborted"
