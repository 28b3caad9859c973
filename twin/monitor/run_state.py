"""State of a running test as received; `update_run_state` adds one block or record.

Bounded in size. Repeated items and the order of items of different topics do not matter: a late
subscriber receives the history while new items arrive.
"""

import contextlib
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

from table_io.block import Block
from table_io.config.base import parse_toml
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.excitation.trajectory import cycles_to_samples
from table_io.records import (
    Agreement,
    Check,
    Comparison,
    CycleExtremes,
    Estimate,
    Event,
    FrequencyResponse,
    JumpForecast,
    Level,
    OrbitPoint,
    PrcPoint,
    Record,
    RunStart,
    RunStop,
    SampleGap,
    Step,
    StepAdded,
    Timing,
    format_record,
)
from table_io.sequencer.procedure import make_test_plan, nominal_drive
from twin.monitor.recent import WINDOW_S, RecentSamples, TraceBuffer
from twin.recording.validation import (
    validate_block,
    validate_record,
    validate_start,
)

T = TypeVar("T")
K = TypeVar("K")
V = TypeVar("V")

MAX_POINTS = 20_000  # both directions of the largest sweep, and as many added steps
MAX_EVENTS = 200
MAX_TEXT_LENGTH = 1000  # characters
MAX_COMPONENTS = 32  # of components and of channels with gaps


class ExpectedEnd:
    """Sample index at which a test is expected to end: as planned, then by what has happened.

    The nominal drive states how many samples are left from the first held cycle of each step. A
    step that is held by the operator or tuned again has them still ahead; an added step adds its
    own. Raises InputError or ArithmeticError if there is no nominal drive of the profile.
    """

    def __init__(self, start: RunStart, profile: Profile, rig: RigConfig) -> None:
        self.index = start.planned_samples
        self._rate_hz, self._sweep_cycles = start.rate_hz, 0
        self._left: dict[int, int] = {}  # by step, in samples
        self._approach = 0  # samples of blend and tuning before an added step
        self._is_continuation = profile.continuation is not None
        self._steps = {step.index: step for step in start.steps}
        self._measured_step = -1  # whose held cycles have begun; the last step reached by orbits
        self._cycle = (-1, -1)  # last step and held cycle
        drive = nominal_drive(make_test_plan(profile, rig))
        if drive.steps != start.steps or not start.steps:
            return  # not driven by this profile, as an imported table; or a displacement history
        if profile.continuation is not None:
            left = profile.continuation.expected_s * start.rate_hz
            self.index += round(left)
            total = sum(1.0 / step.frequency_hz for step in start.steps)
            share = left / total
            for step in start.steps:
                self._left[step.index] = round(left)
                left -= share / step.frequency_hz
            return
        self._sweep_cycles, last = profile.sweep.cycles, start.steps[-1].index
        for segment in drive.sine_segments:
            if segment.cycles:
                self._left[segment.step] = drive.planned_end - segment.start
            elif segment.step == last and last not in self._left:
                self._approach += segment.count

    def add_step(self, step: Step, index: int) -> None:
        """Add a step that was decided on at sample `index`."""
        if not self._sweep_cycles or step.index in self._left:
            return
        self._steps[step.index] = step
        self._left[step.index] = cycles_to_samples(step, self._sweep_cycles, self._rate_hz)
        self.index = max(self.index, index + self._approach + self._left[step.index])

    def add_block(self, block: Block, is_holding: bool) -> None:
        """Correct the end by a measured block; `is_holding` while the operator holds the test."""
        step, cycle = int(block.step[-1]), int(block.cycle[-1])
        if step not in self._left:
            return
        if self._is_continuation:
            self._add_orbit_block(step, block.end)
        elif is_holding or (cycle < 0 and step != self._measured_step):
            self._measured_step = -1
            self.index = max(self.index, block.end + self._left[step])
        elif cycle >= 0 and self._cycle != (step, cycle):
            begin = block.index + int(((block.step != step) | (block.cycle != cycle)).sum())
            done = round(cycle * self._rate_hz / self._steps[step].frequency_hz)
            self._measured_step = step
            self.index = begin + self._left[step] - done
        self._cycle = step, cycle

    def _add_orbit_block(self, step: int, end: int) -> None:
        """Keep the points after the one that is sought ahead, however often it is retried."""
        if step > self._measured_step:
            self._measured_step = step
            self.index = end + self._left[step]
        self.index = max(self.index, end + self._left.get(self._measured_step + 1, 0))


@dataclass(frozen=True, slots=True)
class EventLine:
    """Event text for the user; `level` is INFO, WARN or ERROR."""

    index: int
    level: str
    text: str


@dataclass(slots=True)
class LiveRunState:
    """State of the run `run` as shown on the screen; SI, times in samples."""

    run: str = ""
    past_runs: tuple[str, ...] = ()  # earlier runs, whose late items are ignored
    start: RunStart | None = None
    profile: Profile | None = None
    rig: RigConfig | None = None
    index: int = 0  # number of samples known to be acquired
    block_end: int = 0  # end of the last block
    rig_state: str = ""
    rig_state_since: int = -1
    position: tuple[int, int, int] = (-1, 0, -1)  # step, label, cycle of the last sample seen
    added_steps: dict[int, Step] = field(default_factory=dict)
    points: dict[int, PrcPoint] = field(default_factory=dict)
    orbits: dict[int, OrbitPoint] = field(default_factory=dict)
    latest: dict[type, Record] = field(default_factory=dict)
    timings: dict[str, Timing] = field(default_factory=dict)
    gaps: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)  # end, samples
    events: dict[Hashable, EventLine] = field(default_factory=dict)
    stop: RunStop | None = None
    expected_end: ExpectedEnd | None = None  # None: as planned
    recent: RecentSamples = field(default_factory=RecentSamples)
    traces: TraceBuffer = field(default_factory=TraceBuffer)
    pending: deque[tuple[str, Record]] = field(default_factory=lambda: deque(maxlen=MAX_POINTS))

    @property
    def rate_hz(self) -> float:
        return self.start.rate_hz if self.start else 1.0

    @property
    def step(self) -> Step | None:
        """Current step; None outside the sweep or if the step is unknown."""
        return self.find_step(self.position[0])

    def find_step(self, index: int) -> Step | None:
        """Return the step of this index, planned or added during the test; None if unknown."""
        if self.start and 0 <= index < len(self.start.steps):
            return self.start.steps[index]
        return self.added_steps.get(index)

    @property
    def step_count(self) -> int:
        """Number of steps of the test known so far."""
        return max([len(self.start.steps) if self.start else 0, *(k + 1 for k in self.added_steps)])

    @property
    def end(self) -> int:
        """Sample at which the test is expected to end; 0 if that is not known."""
        if self.expected_end is not None:
            return self.expected_end.index
        return self.start.planned_samples if self.start else 0

    @property
    def progress(self) -> float | None:
        """Share of the expected samples that are acquired, at most 1; None without a plan."""
        return min(self.index / self.end, 1.0) if self.end > 0 else None

    @property
    def remaining_s(self) -> float:
        """Expected time left in s; negative if the test takes longer than expected."""
        return (self.end - self.index) / self.rate_hz

    def add_message(self, text: str) -> None:
        """Add a message of the monitor itself to the events."""
        self.events[self.index, text] = EventLine(self.index, "INFO", text)

    def get_latest(self, kind: type[T]) -> T | None:
        """Return the newest record of a type."""
        return cast("T | None", self.latest.get(kind))


def update_run_state(run_state: LiveRunState, run: str, item: Block | Record) -> LiveRunState:
    """Return the run state updated with one item; a new state if another run starts.

    Records that arrive before the start record are kept for it; invalid items are ignored.
    """
    if run in run_state.past_runs:
        return run_state
    if run_state.start is None or run != run_state.run:
        if isinstance(item, RunStart) and not validate_start(item):
            return _start_run(run_state, item)
        if not isinstance(item, Block):
            run_state.pending.append((run, item))
    elif isinstance(item, Block):
        return _add_block(run_state, item, run_state.start)
    elif not validate_record(item, run_state.start):
        run_state.index = max(run_state.index, item.index)
        _add_record(run_state, item)
        _add_event(run_state, item)
    return run_state


def _start_run(previous: LiveRunState, start: RunStart) -> LiveRunState:
    """Return the state of a new run from its start record, valid configs and pending records."""
    past = (
        (*previous.past_runs, previous.run)[-MAX_COMPONENTS:]
        if previous.start
        else previous.past_runs
    )
    run_state = LiveRunState(start.run, past, start)
    with contextlib.suppress(InputError):
        run_state.profile = parse_toml(start.profile_toml, Profile, "profile of the run")
    with contextlib.suppress(InputError):
        run_state.rig = parse_toml(start.rig_toml, RigConfig, "rig file of the run")
    run_state.expected_end = _expect_end(run_state)
    for run, record in previous.pending:
        update_run_state(run_state, run, record)
    return run_state


def _expect_end(run_state: LiveRunState) -> ExpectedEnd | None:
    """Return the expected end by the profile of the run; None if it cannot be computed."""
    start, profile, rig = run_state.start, run_state.profile, run_state.rig
    if start is None or profile is None or rig is None:
        return None
    try:
        return ExpectedEnd(start, profile, rig)
    except (InputError, ArithmeticError):
        return None


def _add_block(run_state: LiveRunState, block: Block, start: RunStart) -> LiveRunState:
    """Add a block; a block near sample 0 after later ones is a replay that starts again."""
    if validate_block(block, None, start):
        return run_state
    if block.stream != "meas":
        run_state.traces.add(block)
        return run_state
    window_samples = round(WINDOW_S * block.rate_hz)
    if block.index < window_samples and run_state.block_end > block.end + window_samples:
        run_state = LiveRunState(
            run_state.run, run_state.past_runs, start, run_state.profile, run_state.rig
        )
        run_state.expected_end = _expect_end(run_state)
    run_state.index, run_state.block_end = max(run_state.index, block.end), block.end
    run_state.position = int(block.step[-1]), int(block.label[-1]), int(block.cycle[-1])
    run_state.recent.add(block, 1.0 / run_state.step.frequency_hz if run_state.step else 0.0)
    run_state.traces.add(block)
    if run_state.expected_end is not None:
        run_state.expected_end.add_block(block, run_state.rig_state == "holding")
    return run_state


def _add_record(run_state: LiveRunState, record: Record) -> None:
    """Store a record unless a newer one of its kind is known."""
    match record:
        case RunStop():
            run_state.stop = record
        case Comparison():
            run_state.recent.add_comparison(record, run_state.rate_hz)
        case Event(kind="state") if record.index >= run_state.rig_state_since:
            run_state.rig_state, run_state.rig_state_since = record.text, record.index
        case PrcPoint():
            _put_bounded(run_state.points, record.step, record, MAX_POINTS)
        case OrbitPoint():
            _put_bounded(run_state.orbits, record.step, record, MAX_POINTS)
        case StepAdded():
            _put_bounded(run_state.added_steps, record.step, record.as_step, MAX_POINTS)
            if run_state.expected_end is not None:
                run_state.expected_end.add_step(record.as_step, record.index)
        case Timing():
            _put_bounded(run_state.timings, record.component, record, MAX_COMPONENTS)
        case Agreement() | JumpForecast() | CycleExtremes() | Estimate() | Level():
            previous = run_state.latest.get(type(record))
            if previous is None or previous.index <= record.index:
                run_state.latest[type(record)] = record


def _add_event(run_state: LiveRunState, record: Record) -> None:
    """Add the event text of a record; gaps of one channel and reason are merged into one."""
    if isinstance(record, SampleGap):
        gap_key = record.channel, record.reason
        end, samples = run_state.gaps.get(gap_key, (-1, 0))
        if record.index < end:
            return
        samples += record.count
        _put_bounded(run_state.gaps, gap_key, (record.end, samples), MAX_COMPONENTS)
        record = replace(record, count=samples)
    entry = format_record(record, run_state.rate_hz)
    if entry and not _is_shown_elsewhere(record):
        key = gap_key if isinstance(record, SampleGap) else (record.index, entry[1])
        run_state.events.pop(key, None)
        run_state.events[key] = EventLine(record.index, entry[0], entry[1][:MAX_TEXT_LENGTH])
        if len(run_state.events) > MAX_EVENTS:
            del run_state.events[
                min(run_state.events, key=lambda event_key: run_state.events[event_key].index)
            ]


def _is_shown_elsewhere(record: Record) -> bool:
    """Return True for a record shown in another panel, or a passed check."""
    return isinstance(record, Level | FrequencyResponse) or (
        isinstance(record, Check) and record.passed
    )


def _put_bounded(entries: dict[K, V], key: K, value: V, max_entries: int) -> None:
    """Store a value under its key; drop the oldest entry beyond `max_entries`."""
    entries[key] = value
    if len(entries) > max_entries:
        del entries[next(iter(entries))]
