"""The session: whatever ends it, the table comes to rest, and every sample is accounted for."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.session import LatenessLog, OperatorCommand, SessionSetup, run_session
from table_io.block import Block, Float1D, Float2D, Label, join_blocks
from table_io.clock import ManualClock
from table_io.config.profile import Profile
from table_io.errors import InputError
from table_io.excitation.drive import Drive
from table_io.excitation.trajectory import plan_sweep
from table_io.records import Event, Record, RunStart, RunStop, SampleGap, Trip
from table_io.sim.simulated_table import SimulatedBackend
from table_io.units import GRAVITY_M_S2
from tests.builders.drives import sine_segment_at, sine_segments
from tests.builders.profiles import make_profile
from tests.builders.rigs import RIG, command_to_si, make_faulty_rig, si_to_volts
from tests.builders.sessions import make_start, play_session
from tests.input_errors import raises_input_error

RATE_HZ = 2000.0
A = 0.05 * GRAVITY_M_S2
TAIL_PEAK = 1.06 * A  # a decay multiplies a motion that may itself be at 1.05
ALLOWED_DECISION = 0.05  # s from the decision to the first changed sample
ROUNDING_M = 1e-15  # of volts and back; a decay differs from the drive by more from its start on
LEAD = round(RIG.output.lead_s * RATE_HZ)


def profile(block_samples: int = 20, **sweep: Any) -> Profile:
    """A short test: 2, 2.5, 3 Hz up and down, three cycles each; about 11 s.

    No loop check and nothing tuned: the whole drive is known before it is played.
    """
    off = {"enabled": False}
    acquisition: dict[str, Any] = {"block_samples": block_samples}
    tables = {"acquisition": acquisition, "loop_check": off, "control": off}
    return make_profile(tables=tables, **{"cycles": 3, "measured_cycles": 1, **sweep})


def setup(**changes: Any) -> SessionSetup:
    return SessionSetup(profile(**changes), RIG)


@dataclass
class Machine:
    """A table that follows its command exactly and checks at every call what is queued in it.

    Law of the tail, at every queue(): what would play if the session died now is smooth and ends
    at rest. Law of the lead, at every read(): the next half second of the true drive is queued.
    """

    drive: Drive
    clock: ManualClock
    replace_after: int = 40
    channels: tuple[str, ...] = RIG.channels
    rate_hz: float = RATE_HZ
    faults: dict[tuple[str, int], float] = field(default_factory=dict)  # SI, at (channel, sample)
    fails_at: int | None = None  # read() raises from this sample on
    deaf: bool = False  # queue() raises too once it has failed
    command: Float1D = field(default_factory=lambda: np.zeros(0))
    next: int = 0
    calls: list[str] = field(default_factory=list)
    failed: bool = False
    stopping: bool = False

    def open(self) -> None:
        self.calls.append("open")

    def tare(self, samples: int) -> Float2D:
        self.calls.append("tare")
        return si_to_volts(np.zeros((len(self.channels), samples)), RIG.sensors, {})

    def queue(self, index: int, volts: Float1D) -> None:
        self.calls.append("queue")
        if self.failed and self.deaf:
            raise OSError("the machine is gone")
        assert index <= self.command.size, "a hole in the command"
        if "start" in self.calls:
            assert index >= self.next - 1 + self.replace_after, "it is in the device already"
        metres = command_to_si(volts, RIG.output)
        # A feed brings a whole lead of the true drive; what brings less is a stop.
        soon = np.pad(metres[:LEAD], (0, max(LEAD - metres.size, 0)), "edge")
        self.stopping |= not np.allclose(soon, self.drive.command(index, LEAD), 0, ROUNDING_M)
        self.command = np.concatenate([self.command[:index], metres])
        assert self.command[-1] == 0.0
        assert self.command[-2] == pytest.approx(0.0, abs=1e-9)
        assert self.peak_acceleration(max(index - 10, 0)) <= TAIL_PEAK

    def peak_acceleration(self, first: int = 0) -> float:
        """Largest acceleration in m/s2 of what is queued, rest before and after it included."""
        padded = np.concatenate([np.zeros(2 if first == 0 else 0), self.command[first:], [0.0] * 2])
        return float(np.abs(np.diff(padded, 2)).max() * RATE_HZ**2)

    def start(self) -> None:
        self.calls.append("start")

    def read(self, samples: int) -> Float2D:
        if self.fails_at is not None and self.next + samples > self.fails_at:
            self.failed = True
            raise OSError("the machine does not answer")
        self.clock.wait_until(self.scheduled_time_s(self.next + samples - 1))
        first, self.next = self.next, self.next + samples
        if not self.stopping:
            ahead = min(self.next + LEAD, self.drive.planned_end) - self.next
            queued = self.command[self.next : self.next + max(ahead, 0)]
            assert queued.size == max(ahead, 0), "less than the lead is queued"
            true = self.drive.command(self.next, max(ahead, 0))
            np.testing.assert_allclose(queued, true, rtol=0, atol=ROUNDING_M)
        values = np.zeros((len(self.channels), samples))
        values[:] = self.simulate_sensors(first, self.next)
        for (channel, sample), value in self.faults.items():
            if first <= sample < self.next:
                values[self.channels.index(channel), sample - first] = value
        return si_to_volts(values, RIG.sensors, {})

    def take_command(self, first: int, last: int) -> Float1D:
        """Command in m of samples first .. last - 1; the last value is held."""
        inside = self.command[first:last]
        return np.concatenate([inside, np.full(last - first - inside.size, self.command[-1])])

    def simulate_sensors(self, first: int, last: int) -> Float2D:
        """What ideal sensors read, SI: the mass moves with the table, the load cells are silent."""
        metres = self.take_command(max(first - 2, 0), last)
        metres = np.concatenate([np.zeros(last - first + 2 - metres.size), metres])
        acceleration = np.diff(metres, 2) * RATE_HZ**2
        rows = {"force": np.zeros(last - first), "acc": acceleration, "disp": metres[2:]}
        return np.array([rows[next(k for k in rows if k in name)] for name in self.channels])

    def scheduled_time_s(self, index: int) -> float:
        return 10.0 + index / RATE_HZ

    def close(self) -> None:
        self.calls.append("close")

    @property
    def changed_samples(self) -> list[int]:
        """Samples at which the command is not that of the whole drive."""
        apart = self.command - self.drive.command(0, self.command.size)
        return list(np.flatnonzero(np.abs(apart) > ROUNDING_M))

    @property
    def moved_until(self) -> int:
        """Index after the last sample that is not at rest, in all that was and will be played."""
        return int(np.flatnonzero(self.command)[-1]) + 1 if self.command.any() else 0


@dataclass
class Stop:
    """Operator: asks to stop once `after` blocks have come; counts how often it was asked."""

    after: int | None = None
    asked: int = 0

    def __call__(self) -> OperatorCommand | None:
        self.asked += 1
        stop = self.after is not None and self.asked >= self.after
        return OperatorCommand("stop", "asked to stop") if stop else None


def session(
    machine: Any, commands: Callable[[], OperatorCommand | None], **changes: Any
) -> Iterator[Block | Record]:
    return run_session(setup(**changes), machine, machine.clock, make_start, commands)


def machine(**options: Any) -> Machine:
    return Machine(plan_sweep(profile()), ManualClock(), **options)


def blocks(items: list[Block | Record]) -> list[Block]:
    return [item for item in items if isinstance(item, Block)]


def stop_record(items: list[Block | Record]) -> RunStop:
    last = items[-1]
    assert isinstance(last, RunStop)
    return last


class Watched(SimulatedBackend):
    """The simulated table, with its clock in sight and all that it was read."""

    def __init__(self, test: Profile) -> None:
        self.clock = ManualClock()
        super().__init__(RIG, test.specimen, RATE_HZ, self.clock)
        self.seen: list[Float2D] = []
        self.closed = False

    def read(self, samples: int) -> Float2D:
        self.seen.append(super().read(samples))
        return self.seen[-1]

    def close(self) -> None:
        super().close()
        self.closed = True

    def table_mm(self) -> Float1D:
        """Displacement of the table in mm over all samples read, with its sensor's offset."""
        line = np.concatenate(self.seen, axis=1)[RIG.channels.index("table_disp_m")]
        result: Float1D = line / RIG.sensors[1].volts_per_unit - RIG.sensors[1].offset
        return result


@pytest.mark.parametrize("block_samples", [7, 20, 500])
def test_complete_run_hands_out_every_sample_once_and_in_order(block_samples: int) -> None:
    subject = machine()
    items = list(session(subject, Stop(), block_samples=block_samples))
    assert isinstance(items[0], RunStart)
    whole = join_blocks(blocks(items))  # refuses holes and overlaps
    rest = round(profile().acquisition.rest_s * RATE_HZ)
    assert (whole.index, whole.end) == (0, subject.drive.planned_end + rest)
    assert {len(block) for block in blocks(items)[:-1]} == {block_samples}
    assert np.array_equal(whole.label, subject.drive.labels(0, len(whole))[1])
    np.testing.assert_allclose(
        whole.channel("drive_disp_m"), subject.drive.command(0, len(whole)), rtol=0, atol=ROUNDING_M
    )
    assert not [item for item in items if isinstance(item, (SampleGap, Trip))]
    event_texts = [item.text for item in items if isinstance(item, Event)]
    assert event_texts == ["checking", "armed", "running", "at rest"]  # its states and nothing else
    states = ("idle", "checking", "armed", "running", "at rest")
    assert stop_record(items) == RunStop(
        whole.end, "complete", "the whole drive was played", states
    )


@pytest.mark.parametrize(
    "fault",
    [
        {},
        {"kind": "dropped", "at_s": 4.013, "for_s": 0.02},
        {"kind": "spike", "at_s": 4.013, "channel": "table_acc_m_s2", "size": 3.0},
        {"kind": "cable_off", "at_s": 4.013, "channel": "table_disp_m"},
        {"kind": "late", "at_s": 4.013, "size": 0.15},
        {"kind": "stall", "at_s": 4.013},
    ],
    ids=lambda fault: fault.get("kind", "none"),
)
def test_joined_blocks_change_no_sample_and_no_record(fault: dict[str, Any]) -> None:
    tested = make_profile(start_hz=3.0, stop_hz=3.0, cycles=6)
    rig = make_faulty_rig([fault] if fault else [])
    each, joined = (play_session(tested, rig=rig, joins_blocks=joins) for joins in (False, True))
    assert each.block.is_identical(joined.block)
    records = [
        [item for item in played.items if not isinstance(item, (Block, RunStart))]
        for played in (each, joined)
    ]
    assert records[0] == records[1]
    assert len(joined.select(Block)) < len(each.select(Block)) / 2


def test_machine_is_used_in_the_order_of_its_contract() -> None:
    subject = machine()
    list(session(subject, Stop()))
    assert subject.calls[:4] == ["open", "tare", "queue", "start"]
    assert subject.calls[-1] == "close"
    assert subject.calls.count("close") == subject.calls.count("start") == 1


def test_tare_is_subtracted_and_recorded() -> None:
    items = list(session(Watched(profile()), Stop()))
    start = items[0]
    assert isinstance(start, RunStart)
    offsets = {
        sensor.channel: sensor.offset * sensor.si_per_unit
        for sensor in RIG.sensors
        if sensor.channel != "drive_disp_m"
    }
    for name, offset in offsets.items():
        assert start.tare[name] == pytest.approx(offset, rel=0.05)
    at_rest = blocks(items)[0]
    assert abs(at_rest.channel("table_disp_m").mean()) < 5e-6


def test_lateness_is_counted_once_a_block() -> None:
    subject, punctual = machine(), LatenessLog()
    source = run_session(setup(), subject, subject.clock, make_start, Stop(), punctual)
    count = len(blocks(list(source)))
    assert punctual.late_s == [0.0] * count


@pytest.mark.parametrize("after", [1, 30, 60, 100, 155, 300, 461, 700, 1000])
def test_stop_changes_the_command_within_50_ms_and_ends_at_rest(after: int) -> None:
    subject = machine()
    items = list(session(subject, Stop(after)))
    decided = after * 20 - 1  # the newest sample when the stop was asked for
    changed_samples = subject.changed_samples
    frequency = min(sine_segment_at(subject.drive, decided + at).f0 for at in (0, 100))
    frequency = min(frequency, sine_segment_at(subject.drive, decided + 100).f1)
    if changed_samples:  # a stop while the table still rests has nothing to change
        assert changed_samples[0] - decided <= ALLOWED_DECISION * RATE_HZ
        assert subject.moved_until <= changed_samples[0] + math.ceil(
            max(2 / frequency, 0.5) * RATE_HZ
        )
    else:
        assert sine_segments(subject.drive)[0].start > decided + 100
    assert subject.peak_acceleration() <= TAIL_PEAK
    stop = stop_record(items)
    assert (stop.verdict, stop.reason) == ("stopped", "asked to stop")
    moved = ("running",) if decided >= sine_segments(subject.drive)[0].start else ()
    assert stop.states == ("idle", "checking", "armed", *moved, "stopping", "at rest")
    assert stop.index == join_blocks(blocks(items)).end
    (event,) = (item for item in items if isinstance(item, Event) and item.kind == "stop")
    assert event.index == decided + 1
    # The recording goes on to show the rest.
    assert stop.index - subject.moved_until >= 0.2 * RATE_HZ


def test_stroke_trip_states_sample_and_value() -> None:
    subject = machine(faults=dict.fromkeys([("table_disp_m", 5007 + k) for k in range(5)], 0.0655))
    items = list(session(subject, Stop()))
    stop = stop_record(items)
    assert stop.verdict == "aborted"
    assert stop.states[-2:] == ("stopping", "at rest")
    trip = next(item for item in items if isinstance(item, Trip))
    assert (trip.kind, trip.channel, trip.value) == ("stroke", "table_disp_m", 0.0655)
    assert 5007 <= trip.index <= 5009
    assert trip.text == stop.reason
    assert "65.5 mm" in trip.text
    known = trip.decided - 1
    assert known - trip.index < 20  # decided at the end of the block
    assert subject.changed_samples[0] - known <= ALLOWED_DECISION * RATE_HZ


def test_trip_wins_over_a_stop_asked_for_in_the_same_block() -> None:
    faults = dict.fromkeys([("table_disp_m", 2000 + k) for k in range(5)], 0.07)
    assert stop_record(list(session(machine(faults=faults), Stop(101)))).verdict == "aborted"


@pytest.mark.parametrize("items_taken", [1, 2, 40, 80, 300, 500, 900, 1110])
def test_consumer_that_dies_leaves_a_table_at_rest(items_taken: int) -> None:
    subject = machine()
    source = session(subject, Stop())
    for _ in range(items_taken):
        next(source)
    source.close()  # type: ignore[attr-defined]
    assert subject.calls[-1] == "close"
    assert subject.next >= subject.moved_until  # released only after it has come to rest
    assert subject.peak_acceleration() <= TAIL_PEAK
    if items_taken > 2:
        asked = (items_taken - 1) * 20
        assert subject.moved_until <= asked + ALLOWED_DECISION * RATE_HZ + 1.2 * RATE_HZ


@pytest.mark.parametrize("fails_at", [0, 500, 2100, 5990, 20_000])
@pytest.mark.parametrize("deaf", [False, True])
def test_machine_that_stops_answering_plays_its_tail_and_is_released(
    fails_at: int, deaf: bool
) -> None:
    subject = machine(fails_at=fails_at, deaf=deaf)
    with pytest.raises(OSError, match="machine"):
        list(session(subject, Stop()))
    assert subject.calls[-1] == "close"
    assert subject.command[-1] == 0.0
    assert subject.peak_acceleration() <= TAIL_PEAK
    # Nothing can be read any more, so the session waits until the tail must have been played.
    assert subject.clock.now() >= subject.scheduled_time_s(subject.moved_until - 1)


@dataclass
class Hasty(Machine):
    """A machine whose clock runs on while a command is on its way: `refused` queues come late."""

    refused: int = 0
    after: int = 6000

    def queue(self, index: int, volts: Float1D) -> None:
        if self.next >= self.after and self.refused > 0:
            self.refused -= 1
            self.stopping = True  # from here on less than the lead may be queued
            raise ValueError("already in the device")
        super().queue(index, volts)


def test_stop_that_comes_too_late_for_its_sample_is_given_again() -> None:
    # After block 310 nothing is fed until the stop, so that the stop's own queue is refused.
    subject = Hasty(plan_sweep(profile()), ManualClock(), refused=3, after=6180)
    items = list(session(subject, Stop(310)))
    assert subject.refused == 0
    assert stop_record(items).verdict == "stopped"
    assert subject.changed_samples[0] - (310 * 20 - 1) <= ALLOWED_DECISION * RATE_HZ
    assert subject.command[-1] == 0.0


@pytest.mark.parametrize("after", [2000, 6000, 9000])
def test_feed_that_comes_too_late_lets_the_queued_decay_play(after: int) -> None:
    subject = Hasty(plan_sweep(profile()), ManualClock(), refused=1, after=after)
    items = []
    refused_after = 0
    for item in session(subject, Stop()):
        items.append(item)
        if isinstance(item, Block) and subject.refused == 1:
            refused_after = item.end
    stop = stop_record(items)
    assert stop.verdict == "aborted"
    assert stop.states[-2:] == ("stopping", "at rest")
    assert subject.command[-1] == 0.0
    assert subject.peak_acceleration() <= TAIL_PEAK
    whole = join_blocks(blocks(items))
    # What is said to have been played is what was played.
    np.testing.assert_allclose(
        whole.channel("drive_disp_m"), subject.take_command(0, len(whole)), rtol=0, atol=ROUNDING_M
    )
    (trip,) = (item for item in items if isinstance(item, Trip))
    decay_start = int(np.flatnonzero(whole.label == Label.STOP)[0])
    assert trip == Trip(decay_start, refused_after, "late", "", 0.0, 0.0, stop.reason)
    assert stop.index >= subject.moved_until


def test_failing_operator_link_ends_in_rest_too() -> None:
    subject = machine()

    def commands() -> OperatorCommand | None:
        if subject.next > 6000:
            raise ConnectionError("the link is gone")
        return None

    with pytest.raises(ConnectionError):
        list(session(subject, commands))
    assert subject.next >= subject.moved_until
    assert subject.calls[-1] == "close"


@pytest.mark.parametrize("call", ["open", "tare", "queue", "start"])
def test_machine_that_fails_before_it_moves_is_released_and_never_moves(call: str) -> None:
    subject = machine()

    def fail(*_: object) -> None:
        raise InputError("open", key="interlock", remedy="close it")

    setattr(subject, call, fail)
    with raises_input_error(key="interlock"):
        list(session(subject, Stop()))
    assert subject.calls[-1] == "close"
    assert subject.next == 0
    assert "start" not in subject.calls
