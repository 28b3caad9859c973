"""Session: generator that runs a test on a backend and yields Blocks and records.

States: idle, checking, armed, running, holding, stopping, at rest, fault. Every session ends with a
decay of the command to rest. The queued command always ends at rest, even if this process dies.
"""

import contextlib
import math
from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np

from table_io.acquisition.output_queue import BufferUnderrun, OutputQueue
from table_io.backends import Backend, MachineLost
from table_io.block import Block, Bool2D, find_stretches
from table_io.clock import Clock, ManualClock, local_datetime
from table_io.config.calibration import (
    find_overdue_calibrations,
    measure_noise,
    resolve_tare,
    volts_to_si,
)
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.records import Event, FrequencyResponse, Record, RunStart, RunStop, SampleGap, Trip
from table_io.safety import protection
from table_io.safety.findings import Finding
from table_io.safety.loop_check_data import PreloadLimits
from table_io.sequencer import procedure
from table_io.sequencer.state import SequencerState

MAX_LATENESS_S = 0.1  # a block later than this after its schedule is reported


class EventLog:
    """States so far and records pending since the last drain; `at()` gives the sample index."""

    def __init__(self, at: Callable[[], int]) -> None:
        self.states = ["idle"]
        self.pending: list[Record] = []
        self._sample_index = at
        self._was_late = False

    def drain(self) -> Iterator[Record]:
        """Yield the records that are pending since the last call."""
        records, self.pending = self.pending, []
        yield from records

    def add_event(self, kind: str, text: str) -> None:
        """Add an Event at the current sample."""
        self.pending.append(Event(self._sample_index(), kind, text))

    def enter_state(self, state: str) -> None:
        """Enter a state and add an Event if it is a new one."""
        if state != self.states[-1]:
            self.states.append(state)
            self.add_event("state", state)

    def report_lateness(self, late_s: float, end: int) -> None:
        """Add an Event for the first late block of a series; the block ends at sample `end`."""
        if late_s > MAX_LATENESS_S and not self._was_late:
            self.add_event("late", f"the block that ends at sample {end} came {late_s:.3f} s late")
        self._was_late = late_s > MAX_LATENESS_S


TARE_S = 1.0
MAX_FEEDBACK_TRIES = 5
MAX_QUIET_S = 2.0  # of blocks that are acquired at once
COMMAND_DELAY_S = 0.1  # extra margin for hold and resume, which are not urgent


@dataclass(frozen=True, slots=True)
class SessionSetup:
    """Profile and rig config of a session.

    `preload_n`: allowed force (low, high) on the bumpers (right, left) at rest; None: not known.
    """

    profile: Profile
    rig: RigConfig
    preload_n: PreloadLimits | None = None


ACCEPTED = "yes"


@dataclass(frozen=True, slots=True)
class OperatorCommand:
    """Command of the operator, or of a process on the operator's behalf, to a session."""

    name: str  # hold, resume, stop, abort
    reason: str
    # Takes `ACCEPTED`, or why the command is refused, once the session has decided.
    answer: Callable[[str], None] = field(default=lambda _: None, compare=False)


@dataclass(slots=True)
class LatenessLog:
    """Lateness of each block in s, from the schedule of its last sample to its delivery."""

    late_s: list[float] = field(default_factory=list)


RunDescriber = Callable[[dict[str, float], float], RunStart]  # (tare, epoch_s) -> start record
CommandSource = Callable[[], OperatorCommand | None]  # must not block
SessionOutput = Generator[Block | Record, None, None]
TakeBack = Callable[[], Callable[[], None]]  # keeps a state; what it returns restores it
Acquired = tuple[Block, Bool2D, tuple[Finding, ...]]  # with the mask of clipped samples
COMMAND_NAMES = ("hold", "resume", "stop", "abort")


def find_take_back(backend: Backend, clock: ManualClock) -> TakeBack | None:
    """Return what keeps the state of a simulated machine and its clock; None for another one."""
    keep: TakeBack | None = getattr(backend, "take_back", None)
    if keep is None:
        return None

    def take_back() -> Callable[[], None]:
        restore, time_s = keep(), clock.time_s

        def restore_all() -> None:
            restore()
            clock.time_s = time_s

        return restore_all

    return take_back


def run_session(
    setup: SessionSetup,
    backend: Backend,
    clock: Clock,
    describe: RunDescriber,
    commands: CommandSource,
    punctuality: LatenessLog | None = None,
    take_back: TakeBack | None = None,
) -> SessionOutput:
    """Yield RunStart, then every Block followed by its records, then RunStop.

    Closing the generator early also brings the table to rest before the machine is released. With
    `take_back`, of a simulation that can go back in time, blocks in which nothing happens are
    joined up to the next decision; every record stays the same.
    """
    run = _Session(setup, backend, clock)
    try:
        tare = run.begin()
        yield describe(tare, backend.scheduled_time_s(0))
        yield from run.event_log.drain()
        while not run.is_finished:
            acquired = run.acquire_quiet_blocks(tare, take_back) if take_back else None
            block, clipped, findings = acquired or run.acquire(tare)
            late_s = clock.now() - backend.scheduled_time_s(block.end - 1)
            if punctuality is not None:
                punctuality.late_s.append(late_s)
            yield block
            yield from find_gaps(block, clipped)
            run.event_log.report_lateness(late_s, block.end)
            run.protect(block, findings)
            run.advance_test(block)
            run.execute(commands())
            run.feed()
            yield from run.event_log.drain()
        yield from run.finish()
    except MachineLost as error:
        yield from run.report_machine_loss(str(error))
    finally:
        try:
            run.output_queue.bring_to_rest()
        finally:
            backend.close()


class _Session:
    """Mutable state of a session: output queue, sequencer state, protection and event log."""

    def __init__(self, setup: SessionSetup, backend: Backend, clock: Clock) -> None:
        profile = setup.profile
        self.setup = setup
        self.rate_hz = profile.acquisition.rate_hz
        plan = procedure.make_test_plan(profile, setup.rig, backend.replace_after)
        self._state = procedure.start_test(plan)
        block = profile.acquisition.block_samples
        self.output_queue = OutputQueue(backend, clock, setup.rig.output, self._state.drive, block)
        self.verdict, self.reason = "complete", "the whole drive was played"
        self._rest_samples = round(profile.acquisition.rest_s * self.rate_hz)
        self._clipping_v = np.array([sensor.clipping_level_v for sensor in setup.rig.sensors])
        self.event_log = EventLog(lambda: self.output_queue.acquired)
        self._answered_end = 0  # up to here blocks are answered one by one

    @property
    def end(self) -> int | None:
        """Sample at which the recording ends, with the servo at rest; None while unknown."""
        known = (
            self._state.is_finished
            or self._state.stage.kind == "open"
            or self.output_queue.is_decaying
        )
        return self.output_queue.drive.rest_start + self._rest_samples if known else None

    @property
    def is_finished(self) -> bool:
        return self.end is not None and self.output_queue.acquired >= self.end

    def begin(self) -> dict[str, float]:
        """Open and start the machine; return the tare per channel in SI."""
        self.event_log.enter_state("checking")
        for sentence in find_overdue_calibrations(self.setup.rig, local_datetime().date()):
            self.event_log.add_event("calibration", sentence)
        backend, sensors = self.output_queue.backend, self.setup.rig.sensors
        backend.open()
        volts = backend.tare(int(TARE_S * self.rate_hz))
        noise = measure_noise(volts, sensors)
        self._protection = protection.start_protection(self.setup.profile, self.setup.rig, noise)
        self._state = replace(
            self._state,
            noise={name: rms for name, (rms, _) in noise.items()},
            preload_n=self.setup.preload_n,
        )
        if self._state.stage.kind != "check":
            self.event_log.enter_state("armed")
        self.output_queue.start()
        tare = resolve_tare(volts, self.setup.rig, self.setup.profile.specimen.gaps_m)
        if tare.note:
            self.event_log.add_event("tare", tare.note)
        return tare.offsets

    def acquire(self, tare: dict[str, float], blocks: int = 1) -> Acquired:
        """Read and inspect the next blocks in SI: (block, clipped (channel, sample), findings)."""
        rig, first = self.setup.rig, self.output_queue.acquired
        count = blocks * self.setup.profile.acquisition.block_samples
        if self.end is not None:
            count = min(count, self.end - first)
        volts = self.output_queue.backend.read(count)
        labels = self.output_queue.drive.labels(first, count)
        values = volts_to_si(volts, rig.sensors, tare)
        self.output_queue.acquired += count
        block = Block("meas", first, self.rate_hz, rig.channels, values, *labels)
        clipped = np.abs(volts) >= self._clipping_v[:, None]
        observation = protection.Observation.from_drive(block, clipped, self.output_queue.drive)
        self._protection, findings = protection.inspect_samples(self._protection, observation)
        return block, clipped, findings

    def acquire_quiet_blocks(self, tare: dict[str, float], take_back: TakeBack) -> Acquired | None:
        """Acquire all blocks up to the next decision at once; None if one of them needs an answer.

        Then the machine and the protection are as before, and the blocks follow one by one.
        """
        first, state = self.output_queue.acquired, self._protection
        blocks = self._count_quiet_blocks() if first >= self._answered_end else 1
        if blocks == 1:
            return None
        restore = take_back()
        with contextlib.suppress(MachineLost):
            block, clipped, findings = acquired = self.acquire(tare, blocks)
            is_armed = self.event_log.states[-1] == "armed"
            if not (
                findings
                or self.output_queue.is_late
                or clipped.any()
                or np.isnan(block.values).any()
                or (is_armed and (block.step >= 0).any())
            ):
                return acquired
        restore()
        self.output_queue.acquired, self._protection = first, state
        self._answered_end = first + blocks * self.setup.profile.acquisition.block_samples
        return None

    def _count_quiet_blocks(self) -> int:
        """Return after how many blocks, at least 1, the queue is fed or the sequencer decides."""
        samples = min(self.output_queue.samples_until_feed(), self.rate_hz * MAX_QUIET_S)
        if self._state.search is not None or self.output_queue.is_late:
            return 1  # a feedback answers every block
        if self._state.stage.kind in procedure.DECISION_FUNCTIONS:
            samples = min(samples, self._state.stage.last - self.output_queue.acquired)
        return max(math.ceil(samples / self.setup.profile.acquisition.block_samples), 1)

    def protect(self, block: Block, findings: Iterable[Finding]) -> None:
        """Report the findings of a block; the first one that must stop the table is latched."""
        for finding in findings:
            if not finding.stop:
                self.event_log.pending.append(finding.to_event())
            elif not self.output_queue.is_decaying:
                self.event_log.pending.append(finding.to_trip(block.end))
                self.stop("aborted", finding.text)

    def advance_test(self, block: Block) -> None:
        """Advance the sequencer by a block and pass its changes of the drive to the queue."""
        if self.output_queue.is_decaying:
            return
        previous = self._state
        self._state, records = self._advance_sequencer(block)
        self.event_log.pending.extend(records)
        for record in records:
            if isinstance(record, FrequencyResponse):
                self._protection = protection.set_response(self._protection, record)
        if self._state.refusal:
            self.verdict, self.reason = "aborted", self._state.refusal
        elif previous.stage.kind == "check" != self._state.stage.kind:
            self.event_log.enter_state("armed")
        if self.event_log.states[-1] == "armed" and block.step[-1] >= 0:
            self.event_log.enter_state("running")

    def _advance_sequencer(self, block: Block) -> tuple[SequencerState, tuple[Record, ...]]:
        """Return the state and records after a block, its changes of the drive being queued.

        What a feedback changes is due at once: if the machine played past it meanwhile, the
        feedback answers again from a later sample on, each time with more room. Decisions, which
        may take longer than a block, are made once.
        """
        queue = self.output_queue
        decided = procedure.decide_block(self._state, block)
        for attempt in range(MAX_FEEDBACK_TRIES):
            earliest = queue.first_changeable() + attempt * len(block)
            state, records = procedure.answer_block(decided, block, earliest)
            if state.search is None:
                if state.drive is not self._state.drive:
                    queue.change_drive(state.drive, state.changed_from)
                return state, records
            if queue.replace_drive(state.drive, state.changed_from):
                return state, records
        if not queue.has_run_out:  # else `feed` reports it
            self.stop("aborted", f"the feedback came too late {MAX_FEEDBACK_TRIES} times in a row")
        return self._state, ()

    def execute(self, command: OperatorCommand | None) -> None:
        """Execute an operator command if the state allows it, and answer it."""
        if command is not None:
            refusal = self._execute(command)
            command.answer(f"refused: {refusal}" if refusal else ACCEPTED)

    def _execute(self, command: OperatorCommand) -> str:
        """Execute a command; return why it is refused, "" if it is not."""
        is_stop = command.name in ("stop", "abort")
        if self.output_queue.is_decaying:
            return (
                "" if is_stop else f"{command.name} is not possible while the table comes to rest"
            )
        if is_stop:
            self.stop("stopped" if command.name == "stop" else "aborted", command.reason)
            return ""
        previous = self._state
        index = self.output_queue.first_changeable() + round(COMMAND_DELAY_S * self.rate_hz)
        change = {"hold": procedure.hold_test, "resume": procedure.resume_test}[command.name]
        self._state = change(previous, index)
        if self._state is previous:
            refusal = f"{command.name} is not possible in state {self.event_log.states[-1]!r}"
            self.event_log.add_event("refused", refusal)
            return refusal
        self.output_queue.change_drive(self._state.drive, self._state.changed_from)
        self.event_log.enter_state("holding" if command.name == "hold" else "running")
        return ""

    def stop(self, verdict: str, reason: str) -> None:
        """Stop the test: start the final decay to rest."""
        self.verdict, self.reason = verdict, reason
        self.event_log.enter_state("stopping")
        self.event_log.add_event("stop", f"{reason}; decaying to rest")
        self.output_queue.decay()

    def feed(self) -> None:
        """Keep the queue filled; on a buffer underrun the table stops by itself, with a Trip."""
        try:
            self.output_queue.feed()
        except BufferUnderrun as error:
            decay_start = self.output_queue.drive.decay_start or 0
            self.event_log.pending.append(
                Trip(decay_start, self.output_queue.acquired, "late", "", 0.0, 0.0, f"{error}")
            )
            self.verdict, self.reason = "aborted", str(error)
            self.event_log.enter_state("stopping")

    def finish(self) -> Iterator[Record]:
        """Yield the last records of a session that came to rest."""
        if self._state.stage.kind == "open" and not self.output_queue.is_decaying:
            self.verdict, self.reason = "stopped", "hold timed out after 1 h"
        self.event_log.enter_state("at rest")
        yield from self.event_log.drain()
        yield RunStop(
            self.output_queue.acquired, self.verdict, self.reason, tuple(self.event_log.states)
        )

    def report_machine_loss(self, reason: str) -> Iterator[Record]:
        """Yield the last records of a session whose machine no longer answers."""
        self.event_log.enter_state("fault")
        index = self.output_queue.acquired
        self.event_log.pending.append(Trip(index, index, "machine", "", 0.0, 0.0, reason))
        yield from self.event_log.drain()
        self.output_queue.wait_for_rest()
        yield RunStop(index, "halted", reason, tuple(self.event_log.states))


def find_gaps(block: Block, clipped: Bool2D) -> Iterator[SampleGap]:
    """Yield a SampleGap for every run of lost or clipped samples of every channel."""
    if not (clipped.any() or np.isnan(block.values).any()):
        return
    for name, values, at_range in zip(block.channels, block.values, clipped, strict=True):
        for invalid, reason in ((np.isnan(values), "lost"), (at_range, "clipped")):
            for first, last in find_stretches(invalid):
                yield SampleGap(block.index + first, last - first, name, reason)
