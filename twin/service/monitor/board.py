"""What is known of a running test, from its Blocks and records alone; `step` takes in the next.

Bounded, however long the test; twice the same item changes nothing, nor does the order in which
items of different topics come: who joins late gets the old ones while new ones go on.
"""

import contextlib
from collections import deque
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from typing import TypeVar, cast

from table_io.block import Block
from table_io.card import BadInput, parse
from table_io.profile import Profile
from table_io.records import (
    Agreement,
    Ahead,
    Check,
    Comparison,
    Cycle,
    Decided,
    Estimate,
    Event,
    Gap,
    Level,
    Point,
    Record,
    Response,
    RunStart,
    RunStop,
    Step,
    Timing,
)
from table_io.rig import Rig
from table_io.words import sentence
from twin.service.monitor.recent import SECOND, Recent
from twin.stream.soundness import misfit, mislabelled, unsound, unsound_start

T = TypeVar("T")
K = TypeVar("K")
V = TypeVar("V")

POINTS = 20_000  # both directions of the largest sweep, and as many visits
NEWS = 200
LONGEST = 1000  # letters of a sentence
PARTS = 32  # components, channels with gaps: more than any rig has


@dataclass(frozen=True, slots=True)
class News:
    """A sentence for people: `level` is INFO, WARN or ERROR."""

    index: int
    level: str
    text: str


@dataclass(slots=True)
class Board:
    """Everything that the screen shows of the run `run`; SI, times in samples."""

    run: str = ""
    past: tuple[str, ...] = ()  # runs that were here before
    start: RunStart | None = None
    profile: Profile | None = None
    rig: Rig | None = None
    index: int = 0  # samples that are known to be acquired
    seen: int = 0  # end of the last block
    state: str = ""
    state_since: int = -1
    now: tuple[int, int, int] = (-1, 0, -1)  # step, label, cycle of the last sample seen
    decided: dict[int, Step] = field(default_factory=dict)
    points: dict[int, Point] = field(default_factory=dict)
    latest: dict[type, Record] = field(default_factory=dict)
    timings: dict[str, Timing] = field(default_factory=dict)
    gaps: dict[tuple[str, str], tuple[int, int]] = field(default_factory=dict)  # end, samples
    news: dict[Hashable, News] = field(default_factory=dict)
    stop: RunStop | None = None
    recent: Recent = field(default_factory=Recent)
    waiting: deque[tuple[str, Record]] = field(default_factory=lambda: deque(maxlen=POINTS))

    @property
    def rate_hz(self) -> float:
        return self.start.rate_hz if self.start else 1.0

    @property
    def step(self) -> Step | None:
        """The step under way; None outside the sweep, or where nobody told of it."""
        return self.planned(self.now[0])

    def planned(self, index: int) -> Step | None:
        """The step of this index, planned or decided on during the test."""
        if self.start and 0 <= index < len(self.start.steps):
            return self.start.steps[index]
        return self.decided.get(index)

    @property
    def steps(self) -> int:
        """How many steps the test has, as far as is known."""
        return max([len(self.start.steps) if self.start else 0, *(k + 1 for k in self.decided)])

    def remark(self, text: str) -> None:
        """Put a sentence of this end among the news."""
        self.news[self.index, text] = News(self.index, "INFO", text)

    def last(self, kind: type[T]) -> T | None:
        """The newest record of a kind."""
        return cast("T | None", self.latest.get(kind))


def step(board: Board, run: str, item: Block | Record) -> Board:
    """The board with one item more; a new one where a run starts that was not here before.

    What comes before its start waits for it; what cannot be in a run is left out.
    """
    if run in board.past:
        return board
    if board.start is None or run != board.run:
        if isinstance(item, RunStart) and not unsound_start(item):
            return _begin(board, item)
        if not isinstance(item, Block):
            board.waiting.append((run, item))
    elif isinstance(item, Block):
        return _block(board, item, board.start)
    elif not unsound(item, board.start):
        board.index = max(board.index, item.index)
        _take(board, item)
        _say(board, item)
    return board


def _begin(before: Board, start: RunStart) -> Board:
    """The board of a run: its start, the cards in it that can be read, and what waited for it."""
    past = (*before.past, before.run)[-PARTS:] if before.start else before.past
    board = Board(start.run, past, start)
    with contextlib.suppress(BadInput):
        board.profile = parse(start.profile_toml, Profile, "profile of the run")
    with contextlib.suppress(BadInput):
        board.rig = parse(start.rig_toml, Rig, "machine card of the run")
    for run, one in before.waiting:
        step(board, run, one)
    return board


def _block(board: Board, block: Block, start: RunStart) -> Board:
    """Take in a block; one at the beginning of a run already seen is a replay that begins again."""
    if block.stream != "meas" or misfit(block, None, start) or mislabelled([block]):
        return board
    second = round(SECOND * block.rate_hz)
    if block.index < second and board.seen > block.end + second:
        board = Board(board.run, board.past, start, board.profile, board.rig)
    board.index, board.seen = max(board.index, block.end), block.end
    board.now = int(block.step[-1]), int(block.label[-1]), int(block.cycle[-1])
    board.recent.add(block, 1.0 / board.step.frequency_hz if board.step else 0.0)
    return board


def _take(board: Board, record: Record) -> None:
    """Keep what a record says where it is newer than what is known."""
    match record:
        case RunStop():
            board.stop = record
        case Comparison():
            board.recent.compare(record, board.rate_hz)
        case Event(kind="state") if record.index >= board.state_since:
            board.state, board.state_since = record.text, record.index
        case Point():
            _keep(board.points, record.step, record, POINTS)
        case Decided(step=index, direction=direction, frequency_hz=f, acceleration_m_s2=a):
            _keep(board.decided, index, Step(index, direction, f, a), POINTS)
        case Timing():
            _keep(board.timings, record.component, record, PARTS)
        case Agreement() | Ahead() | Cycle() | Estimate() | Level():
            before = board.latest.get(type(record))
            if before is None or before.index <= record.index:
                board.latest[type(record)] = record


def _say(board: Board, record: Record) -> None:
    """Put among the news what a record has to say; the gaps of a channel are one of them."""
    if isinstance(record, Gap):
        where = record.channel, record.reason
        end, samples = board.gaps.get(where, (-1, 0))
        if record.index < end:
            return
        samples += record.count
        _keep(board.gaps, where, (record.index + record.count, samples), PARTS)
        record = replace(record, count=samples)
    told = sentence(record, board.rate_hz)
    if told and not _data(record):
        key = where if isinstance(record, Gap) else (record.index, told[1])
        board.news.pop(key, None)
        board.news[key] = News(record.index, told[0], told[1][:LONGEST])
        if len(board.news) > NEWS:
            del board.news[min(board.news, key=lambda one: board.news[one].index)]


def _data(record: Record) -> bool:
    """True for what is a number on the screen, or one of many that are as they should be."""
    return isinstance(record, Level | Response) or (isinstance(record, Check) and record.passed)


def _keep(found: dict[K, V], key: K, value: V, most: int) -> None:
    """Put a value in its place; where there are too many, the oldest goes."""
    found[key] = value
    if len(found) > most:
        del found[next(iter(found))]
