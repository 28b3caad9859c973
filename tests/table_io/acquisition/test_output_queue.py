"""Laws of the output queue: what it queues, refuses and reads, to the sample."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.output_queue import BufferUnderrun, OutputQueue
from table_io.block import Float1D, Float2D, Label
from table_io.clock import ManualClock
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import SineTarget, Trajectory
from tests.builders.rigs import command_to_si
from tests.table_io.acquisition.test_session import RATE_HZ, RIG, Machine, machine

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


def test_queue_that_never_started_has_nothing_to_bring_to_rest() -> None:
    subject = machine()
    queue = OutputQueue(subject, subject.clock, RIG.output, subject.drive, BLOCK_SAMPLES)
    assert queue.played_samples() == 0
    assert not queue.has_run_out
    queue.bring_to_rest()
    queue.wait_for_rest()
    assert (subject.next, subject.clock.now()) == (0, 0.0)


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


@dataclass
class Device:
    """A machine of any rate: keeps what is queued, refuses the next `refusals` of it."""

    rate_hz: float = RATE_HZ
    replace_after: int = 40
    refusals: int = 0
    is_lost: bool = False
    tries: int = 0
    queued: list[tuple[int, Float1D]] = field(default_factory=list)  # (index, command in m)
    reads: list[int] = field(default_factory=list)
    clock: ManualClock = field(default_factory=ManualClock)

    def queue(self, index: int, volts: Float1D) -> None:
        self.tries += 1
        if self.refusals > 0:
            self.refusals -= 1
            raise ValueError("already in the device")
        self.queued.append((index, command_to_si(volts, RIG.output)))

    def start(self) -> None:
        self.clock.wait_until(self.scheduled_time_s(-1))

    def read(self, samples: int) -> Float2D:
        if self.is_lost:
            raise OSError("the machine is gone")
        self.reads.append(samples)
        return np.zeros((1, samples))

    def scheduled_time_s(self, index: int) -> float:
        return 10.0 + index / self.rate_hz


def make_queue(device: Any, block: int = BLOCK_SAMPLES, held_s: float = 4.0) -> OutputQueue:
    rest = Trajectory(device.rate_hz, 200, SineTarget(3.0, 0.0))
    moving = rest.append_blend(SineTarget(3.0, 0.5), 0, 2.0, Label.BLEND)
    drive = moving.append_hold(round(held_s * device.rate_hz), 0, Label.SETTLE).to_drive(())
    return OutputQueue(device, device.clock, RIG.output, drive, block)


def advance(queue: OutputQueue, device: Device, until: int, *, feeds: bool = True) -> None:
    """Let the machine play, and the rig read, up to sample `until`."""
    for acquired in range(queue.acquired, until, 10):
        queue.acquired = acquired
        device.clock.wait_until(device.scheduled_time_s(acquired - 1))
        if feeds:
            queue.feed()
    queue.acquired = until
    device.clock.wait_until(device.scheduled_time_s(until - 1))


def assert_queued(device: Device, first: int, drive: Drive) -> None:
    """The last transfer is the drive from sample `first` to its first sample at rest."""
    index, displacement_m = device.queued[-1]
    assert index == first
    assert displacement_m.size == max(drive.rest_start + 1 - first, 1)
    expected = drive.command(first, displacement_m.size)
    np.testing.assert_allclose(displacement_m, expected, rtol=0, atol=1e-15)


@pytest.mark.parametrize("replace_after", [0, 40])
@pytest.mark.parametrize(("rate_hz", "block"), [(800.0, 40), (1100.0, 7)])
def test_queue_is_filled_to_twice_the_lead_whenever_less_than_the_lead_is_left(
    rate_hz: float, block: int, replace_after: int
) -> None:
    device = Device(rate_hz, replace_after)
    queue = make_queue(device, block)
    drive = queue.drive
    lead = replace_after + round(RIG.output.lead_s * rate_hz) + block
    end = 0
    for acquired in range(0, drive.rest_start + block, block):
        tries = device.tries
        if acquired == 0:
            queue.start()
        else:
            queue.acquired = acquired
            device.clock.wait_until(device.scheduled_time_s(acquired - 1))
            queue.feed()
        if end < drive.rest_start and end - acquired < lead:
            first, end = end, min(acquired + 2 * lead, drive.rest_start)
            assert_queued(device, first, drive.decay_from(end) if end < drive.rest_start else drive)
            tries += 1
        assert device.tries == tries
        assert queue.is_moving == (acquired < drive.rest_start)
        assert not queue.has_run_out
    assert not queue.is_decaying


@pytest.mark.parametrize("rate_hz", [500.0, 900.0, 1100.0, 2000.0])
@pytest.mark.parametrize("replace_after", [0, 33])
def test_sample_is_played_at_its_time_and_decisions_take_five_milliseconds(
    rate_hz: float, replace_after: int
) -> None:
    device = Device(rate_hz, replace_after)
    queue = make_queue(device)
    queue.start()
    assert queue.played_samples() == 0
    decision = min(count for count in range(100) if count / rate_hz >= 0.005 - 1e-12)
    for index in range(0, 400, 7):
        for share in (0.0, 0.4, 0.99):
            device.clock.wait_until(device.scheduled_time_s(index) + share / rate_hz)
            assert queue.played_samples() == index + 1
            assert queue.first_changeable() == index + 1 + replace_after + decision
    queue.acquired = 1000  # read already, whatever the clock shows
    assert queue.played_samples() == 1000


@pytest.mark.parametrize("refusals", range(8))
def test_decay_is_tried_five_times_then_that_behind_the_lead_plays(refusals: int) -> None:
    device = Device()
    queue = make_queue(device)
    queue.start()
    advance(queue, device, 3000)
    whole = queue.drive
    first = queue.first_changeable()
    end = queue._queued_end
    tries = device.tries
    device.refusals = refusals
    queue.decay()
    assert device.tries - tries == min(refusals + 1, 5)
    assert queue.drive == whole.decay_from(first if refusals < 5 else end)
    assert queue.is_decaying
    if refusals < 5:
        assert_queued(device, first, queue.drive)
    queue.feed()  # nothing is left to queue
    assert device.tries - tries == min(refusals + 1, 5)


@pytest.mark.parametrize("past", [-2, -1, 0, 1, 300])
def test_decay_after_the_last_changeable_sample_changes_nothing(past: int) -> None:
    device = Device()
    queue = make_queue(device)
    rest_start = queue.drive.rest_start
    queue.start()
    margin = queue.first_changeable() - queue.played_samples()
    advance(queue, device, rest_start + past - margin)
    tries = device.tries
    queue.decay()
    assert device.tries - tries == (past < 0)
    assert queue.drive.decay_start == min(rest_start + past, rest_start)
    assert queue.drive.rest_start == rest_start


@pytest.mark.parametrize("left", [0, 1, 199, 200, 201, 1000])
@pytest.mark.parametrize("is_lost", [False, True])
def test_rest_is_awaited_in_pieces_of_200_samples(left: int, is_lost: bool) -> None:
    device = Device()
    queue = make_queue(device)
    queue.start()
    advance(queue, device, 3000)
    queue.decay()
    rest_start = queue.drive.rest_start
    queue.acquired, device.is_lost = rest_start - left, is_lost
    if is_lost and left:
        with pytest.raises(OSError, match="gone"):
            queue.bring_to_rest()
        assert device.clock.now() == device.scheduled_time_s(rest_start)
        assert queue.acquired == rest_start - left
    else:
        queue.bring_to_rest()
        assert device.reads == [200] * (left // 200) + [left % 200] * (left % 200 > 0)
        assert queue.acquired == rest_start
    assert not queue.is_moving


@pytest.mark.parametrize("until", [3000, 5000])
def test_bring_to_rest_decays_at_once(until: int) -> None:
    device = Device()
    queue = make_queue(device)
    queue.start()
    advance(queue, device, until)
    decaying = queue.drive.decay_from(queue.first_changeable())
    queue.bring_to_rest()
    assert queue.drive == decaying
    assert sum(device.reads) == decaying.rest_start - until


@pytest.mark.parametrize("first", [2000, 3999, 4000, 4001, 9000])
@pytest.mark.parametrize("is_whole", [False, True])
def test_changed_drive_is_queued_from_its_first_change(first: int, is_whole: bool) -> None:
    """Behind the whole drive the machine rests, so that even a later change needs no filling."""
    device = Device()
    queue = make_queue(device)
    rest_start = queue.drive.rest_start
    queue._queued_end = rest_start if is_whole else 4000
    changed = make_queue(device, held_s=9.0).drive
    queue.change_drive(changed, first)
    assert queue.drive is changed
    assert queue._queued_end == (first if is_whole else min(first, 4000))


@pytest.mark.parametrize("past", [-1, 0, 1])
@pytest.mark.parametrize("held_s", [3.9, 4.0, 9.0])
def test_change_behind_the_motion_is_not_transferred(past: int, held_s: float) -> None:
    device = Device()
    queue = make_queue(device)
    rest_start = queue.drive.rest_start
    queue.start()
    advance(queue, device, rest_start - 600)
    changed = make_queue(device, held_s=held_s).drive
    tries = device.tries
    assert queue.replace_drive(changed, rest_start + past)
    is_transferred = held_s != 4.0 or past < 0
    assert device.tries - tries == is_transferred
    assert (queue.drive is changed) == is_transferred
    if is_transferred:
        lead = device.replace_after + round(RIG.output.lead_s * RATE_HZ) + BLOCK_SAMPLES
        end = min(rest_start - 600 + 2 * lead, changed.rest_start)
        last = changed.decay_from(end) if end < changed.rest_start else changed
        assert_queued(device, rest_start + past, last)


def test_drive_that_is_queued_whole_never_runs_out() -> None:
    device = Device()
    queue = make_queue(device)
    queue.start()
    advance(queue, device, queue.drive.rest_start)
    device.clock.wait_until(device.clock.now() + 5.0)
    assert not queue.has_run_out
    queue.feed()
    assert not queue.is_decaying


def test_refusal_before_the_start_is_a_fault() -> None:
    device = Device(refusals=3)
    queue = make_queue(device)
    with pytest.raises(ValueError, match="already"):
        queue.start()
    with pytest.raises(ValueError, match="already"):
        queue.replace_drive(make_queue(device, held_s=9.0).drive, 0)
    assert not queue.is_moving


@pytest.mark.parametrize("lag_s", [0.0, 0.25])
def test_refused_feed_plays_the_decay_behind_the_lead(lag_s: float) -> None:
    device = Device()
    queue = make_queue(device)
    queue.start()
    advance(queue, device, 1500)
    end = queue._queued_end
    advance(queue, device, end - 500, feeds=False)
    queue.acquired -= round(lag_s * RATE_HZ)
    device.refusals = 1
    with pytest.raises(BufferUnderrun) as underrun:
        queue.feed()
    assert f"{lag_s:.2f}" in str(underrun.value).split()
    assert queue.drive.decay_start == end
    assert queue._queued_end == queue.drive.rest_start
