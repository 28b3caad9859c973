"""A recording through the pipeline again: the rig's stream as recorded, what the twin says anew."""

import heapq
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.card import BadInput
from table_io.records import (
    Agreement,
    Ahead,
    Comparison,
    Cycle,
    Decided,
    Estimate,
    Event,
    Fault,
    Params,
    Point,
    Record,
    RunStart,
    RunStop,
    Timing,
)
from twin.compare import COMPARED, pipeline, watch
from twin.service.bundle import Bundle
from twin.service.origin import beginning, begun
from twin.service.runs import Watch, record
from twin.stream.recording import Recording, understood
from twin.stream.salvage import salvage
from twin.stream.wire import (
    CMP_TOPIC,
    PRED_TOPIC,
    RECORD_TOPICS,
    TOPIC_TYPES,
    Item,
    WireError,
    decode,
    unsigned,
)

LONGEST_CELL = 10_000  # samples that a comparison may cover
LONG_BLOCK_S = 1.0  # where nobody watches the time; the result is the same however it is cut
AT_END = (Cycle, Point, Agreement, Estimate, Ahead)  # stand at the end of what they are about
TWIN_RECORDS = (Comparison, Params, *AT_END)
TWIN_TOPICS = {PRED_TOPIC, *(RECORD_TOPICS[kind] for kind in (Comparison, *AT_END, Timing))}


@dataclass(frozen=True, slots=True)
class Recorded:
    """What is played again: the rig's stream, and what the twin then compared, as bytes by sample.

    Comparisons are kept as they are: a replay makes the same ones and compares their bytes.
    """

    recording: Recording
    comparisons: dict[int, bytes]

    @classmethod
    def open(cls, path: Path) -> "Recorded":
        """Of a log, of which only what a replay needs is read."""
        found = salvage(path, frozenset(TOPIC_TYPES.keys() - TWIN_TOPICS | {CMP_TOPIC}))
        compared = [one for one in found.messages if one.topic == CMP_TOPIC]
        found.messages = [one for one in found.messages if one.topic != CMP_TOPIC]
        recording = understood(path, found)[0]
        rate = recording.start.rate_hz
        return cls(recording, {round(one.log_time * rate / 1e9): one.payload for one in compared})

    @property
    def start(self) -> RunStart:
        return self.recording.start


@dataclass(frozen=True, slots=True)
class Span:
    """Samples first .. last - 1 of a recording; what lies before is computed and not shown.

    So the twin comes to the first sample with the state that it had there, and whatever is shown
    is equal to what was recorded, the free-running twin too.
    """

    first: int
    last: int

    @classmethod
    def whole(cls, recording: Recording) -> "Span":
        return cls(recording.start.index, 2**62)

    @classmethod
    def of_steps(cls, recording: Recording, first: int, last: int) -> "Span":
        """The steps of index first to last; BadInput where the recording has none of them."""
        inside: list[int] = []
        there: set[int] = set()
        for piece in recording.pieces("meas"):
            there |= set(np.unique(piece.step).tolist())
            chosen = np.flatnonzero((piece.step >= first) & (piece.step <= last))
            inside += (piece.index + chosen).tolist()
        if not inside:
            has = sorted(there - {-1})
            held = f"{has[0]} to {has[-1]}" if has else "none"
            raise BadInput(
                f"--steps {first}:{last}: no such steps in {recording.path}; there: {held} "
                "(the `index` of a step in summary.json)"
            )
        return cls(min(inside), max(inside) + 1)

    def holds(self, compared: tuple[int, bytes]) -> bool:
        """True for a recorded comparison, by its index, whose samples all are shown."""
        index, payload = compared
        if not self.first <= index < self.last:
            return False
        # the last one alone may reach beyond
        near_the_end = index + LONGEST_CELL > self.last
        return not near_the_end or (one := _comparison(payload)) is None or self.shows(one)

    def shows(self, item: Item) -> bool:
        """True for what belongs to these samples; a cycle or point stands at its end."""
        if isinstance(item, Block):
            return self.first <= item.index and item.end <= self.last
        if isinstance(item, Comparison):
            return self.first <= item.index and item.index + item.count <= self.last
        if isinstance(item, AT_END) or (isinstance(item, Event) and not _of_the_rig(item)):
            return self.first < item.index <= self.last
        return self.first <= item.index <= self.last


@dataclass(slots=True)
class Identity:
    """How the comparisons of a replay relate to the recorded ones."""

    recorded: int = 0
    compared: int = 0
    differing: int = 0
    missing: int = 0
    unrecorded: int = 0  # that the recording should have and has not
    made: int = 0
    beginning: str = ""  # the run that holds what the recording lacks before its first sample
    first_difference: int | None = None
    largest: dict[str, float] = field(default_factory=dict)  # of |difference| of error sums, SI^2

    @property
    def differs(self) -> bool:
        """True where all should be equal and is not."""
        return self.identical is False

    @property
    def identical(self) -> bool | None:
        """True where all is equal; None where nothing was recorded, or the beginning is missing."""
        if not self.recorded or self.beginning:
            return None
        return not (self.differing or self.missing or self.unrecorded)


def replay(
    recorded: Recorded,
    bundle: Bundle,
    path: Path,
    run: str,
    watch: Watch,
    span: Span | None = None,
    cut: int = 0,
) -> Identity:
    """The pipeline on a recording, recorded to `path`; where the twin was dead, so it is again.

    `cut` is the samples of a block, 0 where nobody watches the time.
    """
    recording = recorded.recording
    span = span or Span.whole(recording)
    identity = Identity(largest=dict.fromkeys(COMPARED, 0.0))
    identity.beginning = beginning(recording)
    identity.recorded = sum(span.holds(one) for one in recorded.comparisons.items())
    cut = cut or round(LONG_BLOCK_S * recording.start.rate_hz)

    compare = partial(_compare, identity, recorded, run)
    items = again(recording, bundle, run, span, cut)
    record(items, path, run, recording.start.rate_hz, watch, compare)
    identity.missing = identity.recorded - identity.compared
    return identity


def _compare(identity: Identity, recorded: Recorded, run: str, new: Item, payload: bytes) -> None:
    """Take in what the replay `run` has made, if it is a comparison, and its bytes."""
    if not isinstance(new, Comparison):
        return
    identity.made += 1
    old = recorded.comparisons.get(new.index)
    if old is None:
        # A recording that was cut off may lack its last ones.
        identity.unrecorded += recorded.recording.stop is not None
        return
    identity.compared += 1
    if unsigned(old, Comparison, recorded.recording.run) == unsigned(payload, Comparison, run):
        return
    identity.differing += 1
    if identity.first_difference is None:
        identity.first_difference = new.index
    before = _comparison(old)
    if before is None or before.channels != new.channels:
        return  # damaged: how large the difference is, nobody knows
    for name, a, b in zip(new.channels, before.window_error_ss, new.window_error_ss, strict=False):
        if math.isfinite(a) and math.isfinite(b):
            identity.largest[name] = max(identity.largest[name], abs(a - b))


def _comparison(payload: bytes) -> Comparison | None:
    """A recorded comparison; None where it is damaged."""
    try:
        item = decode(CMP_TOPIC, payload)[1]
    except WireError:
        return None
    return item if isinstance(item, Comparison) else None


def again(recording: Recording, bundle: Bundle, run: str, span: Span, cut: int) -> Iterator[Item]:
    """What the rig recorded, with a twin beside it that respects recorded faults and changes."""
    setup = bundle.twin(from_rest=recording.start.source == "model")
    setup = pipeline.knowing(setup, *recording.of(Decided))
    faults = [fault for fault in recording.of(Fault) if fault.component == "twin"]
    changes = _changes(recording, bundle)
    edges = {span.first, span.last, *(one.index for one in changes)}
    edges |= {edge for fault in faults for edge in (fault.from_index, fault.to_index)}
    yield from begun(recording, run, bundle.model_toml, span.first)
    state, said_first = pipeline.start(setup, recording.start.index)
    yield from (replace(one, index=span.first) for one in said_first)
    for item in _source(recording, cut, sorted(edges)):
        if isinstance(item, Block):
            if item.index > span.last:
                break
            said: list[Block | Record] = [item]
            while changes and changes[0].index <= item.index:
                change = changes.pop(0)
                setup = pipeline.adopting(setup, change)
                said.append(replace(change, index=max(change.index, span.first)))
            if not any(fault.from_index <= item.index < fault.to_index for fault in faults):
                if any(fault.to_index == item.index for fault in faults):
                    state, said_first = pipeline.start(setup, item.index)
                    said.extend(said_first)
                state, made = pipeline.step(setup, state, item)
                said.extend(made)
            yield from (one for one in said if span.shows(one))
        elif span.shows(item) and not (isinstance(item, RunStop) and item.index > span.last):
            yield item
    stop = recording.stop
    if stop is not None and stop.index > span.last:
        yield RunStop(span.last, stop.verdict, "the steps that were asked for", stop.states)


def _changes(recording: Recording, bundle: Bundle) -> list[Params]:
    """Parameters that took effect during the run; none with another model than the recorded one."""
    if bundle.model_toml != recording.start.model_toml:
        return []
    return [one for one in recording.of(Params) if one.reason != "start"]


def _source(recording: Recording, cut: int, edges: list[int]) -> Iterator[Item]:
    """What the rig recorded by sample index, its blocks cut anew and at every edge."""

    def blocks() -> Iterator[Block]:
        for piece in recording.pieces("meas"):
            whole = range(piece.index - piece.index % cut + cut, piece.end, cut)
            inside = (edge for edge in edges if piece.index < edge < piece.end)
            for first, last in pairwise(sorted({piece.index, *whole, *inside, piece.end})):
                yield piece.cut(first, last)

    records: Iterable[Item] = [item for item in recording.items if _of_the_rig(item)]
    yield from heapq.merge(blocks(), records, key=lambda item: item.index)


def _of_the_rig(item: Item) -> bool:
    """True for what a replay repeats; what the twin said is said anew."""
    if isinstance(item, Event):
        return item.kind not in (*watch.KINDS, "divergence")  # as it was once called
    return not isinstance(item, (Block, RunStart, Timing, *TWIN_RECORDS))
