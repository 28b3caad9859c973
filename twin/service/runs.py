"""Runs in one process: `--speed max`, `simulate`, `replay`: the same steps, other sources."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from table_io.backends import open_backend
from table_io.block import Block
from table_io.card import BadInput
from table_io.clock import ManualClock
from table_io.records import (
    Comparison,
    Cycle,
    Decided,
    Event,
    Fault,
    Params,
    Point,
    Record,
    RunStart,
    RunStop,
    Timing,
)
from table_io.session import Order, play
from twin.compare import COMPARED, pipeline
from twin.service.bundle import Bundle
from twin.stream.mcap_log import LogWriter, Recording
from twin.stream.wire import Item, encode, topic

Watch = Callable[[Item], None]
FLUSH_SAMPLES_S = 5.0  # of recorded time between flushes where nothing is live
SIMULATED_BLOCK = 500
TWIN_RECORDS = (Comparison, Params, Cycle, Point)


@dataclass(slots=True)
class _Log:
    """Writes items, flushing now and then, and shows each to whoever watches."""

    writer: LogWriter
    run: str
    rate_hz: float
    watch: Watch
    flushed: int = 0

    def put(self, item: Item) -> None:
        self.writer.write(topic(item), encode(item, self.run), item.index)
        if item.index - self.flushed > FLUSH_SAMPLES_S * self.rate_hz:
            self.writer.flush()
            self.flushed = item.index
        self.watch(item)


def record(items: Iterator[Item], path: Path, run: str, rate_hz: float, watch: Watch) -> None:
    """Write every item to a new log at `path`; the log is closed whatever happens."""
    writer = LogWriter(path, rate_hz)
    log = _Log(writer, run, rate_hz, watch)
    try:
        for item in items:
            if isinstance(item, RunStart):
                writer.describe(item)
            log.put(item)
    finally:
        writer.close()


def beside(source: Iterator[Block | Record], setup: pipeline.Setup) -> Iterator[Item]:
    """Every item of a source, each followed by what the twin says about it."""
    state = None
    for item in source:
        yield item
        if isinstance(item, Decided):
            setup = pipeline.knowing(setup, item)
        elif isinstance(item, RunStart):
            state, begun = pipeline.start(setup)
            yield from begun
        elif isinstance(item, Block) and state is not None:
            state, items = pipeline.step(setup, state, item)
            yield from items


def play_unpaced(
    bundle: Bundle, run: str, path: Path, asked: Callable[[], str | None], watch: Watch
) -> None:
    """The whole test on a simulated table as fast as it goes, recorded to `path`."""
    if not bundle.rig.any_speed:
        raise BadInput(
            f"--speed max: table {bundle.rig.name!r} keeps its own time; use --speed realtime"
        )
    clock = ManualClock()
    backend = open_backend(bundle.rig, bundle.profile, clock)

    def commands() -> Order | None:
        return Order("stop", why) if (why := asked()) else None

    source = play(bundle.session, backend, clock, bundle.describe(run, "table"), commands)
    record(beside(source, bundle.twin()), path, run, bundle.drive.rate_hz, watch)


def simulate(bundle: Bundle, run: str, path: Path, watch: Watch) -> None:
    """The model alone on the ideal drive: no table, no noise."""
    items = beside(_ideal(bundle, run), bundle.twin(from_rest=True))
    record(items, path, run, bundle.drive.rate_hz, watch)


def _ideal(bundle: Bundle, run: str) -> Iterator[Item]:
    """The stream of an ideal table: it does what the drive says."""
    drive = bundle.ideal
    start = bundle.describe(run, "model")({}, 0.0)
    yield start
    end = drive.planned_end + math.ceil(bundle.profile.acquisition.rest_s * drive.rate_hz)
    for first in range(0, end, SIMULATED_BLOCK):
        count = min(SIMULATED_BLOCK, end - first)
        command = drive.command(first, count)
        values = np.array([command, command, drive.acceleration(first, count)])
        labels = drive.labels(first, count)
        yield Block("meas", first, drive.rate_hz, start.channels, values, *labels)
    yield RunStop(end, "complete", "the whole drive was played", ("idle", "running", "at rest"))


@dataclass(slots=True)
class Identity:
    """How the comparisons of a replay relate to the recorded ones."""

    recorded: int = 0
    compared: int = 0
    differing: int = 0
    missing: int = 0
    unrecorded: int = 0  # that the recording should have and has not
    first_difference: int | None = None
    largest: dict[str, float] = field(default_factory=dict)  # of |difference| of error sums, SI^2

    @property
    def identical(self) -> bool:
        wrong = self.differing or self.missing or self.unrecorded
        return self.compared == self.recorded > 0 and not wrong


def replay(recording: Recording, bundle: Bundle, path: Path, run: str, watch: Watch) -> Identity:
    """The pipeline on a recording, recorded to `path`; where the twin was dead, so it is again."""
    setup = bundle.twin(from_rest=recording.start.source == "model")
    recorded = {one.index: one for one in recording.of(Comparison)}
    identity = Identity(recorded=len(recorded), largest=dict.fromkeys(COMPARED, 0.0))

    def compared() -> Iterator[Item]:
        seen = set()
        for item in _again(recording, setup, run, bundle):
            if isinstance(item, Comparison) and item.index in recorded:
                seen.add(item.index)
                _differ(identity, recorded[item.index], item)
            elif isinstance(item, Comparison) and recording.stop is not None:
                identity.unrecorded += 1  # a recording that was cut off may lack its last ones
            yield item
        identity.missing = len(recorded) - len(seen)

    record(compared(), path, run, recording.start.rate_hz, watch)
    return identity


def _differ(identity: Identity, old: Comparison, new: Comparison) -> None:
    identity.compared += 1
    if encode(old, "") == encode(new, ""):
        return
    identity.differing += 1
    if identity.first_difference is None:
        identity.first_difference = new.index
    for name, a, b in zip(new.channels, old.window_error_ss, new.window_error_ss, strict=True):
        if math.isfinite(a) and math.isfinite(b):
            identity.largest[name] = max(identity.largest[name], abs(a - b))


def _again(recording: Recording, setup: pipeline.Setup, run: str, bundle: Bundle) -> Iterator[Item]:
    """What the rig recorded, with a twin beside it that respects the recorded faults."""
    setup = pipeline.knowing(setup, *recording.of(Decided))
    faults = [fault for fault in recording.of(Fault) if fault.component == "twin"]
    yield replace(recording.start, run=run, model_toml=bundle.model_toml)
    state, begun = pipeline.start(setup)
    yield from begun
    for item in recording.items:
        if isinstance(item, Block) and item.stream == "meas":
            yield item
            for block in _alive(item, faults):
                if any(fault.to_index == block.index for fault in faults):
                    state, begun = pipeline.start(setup, block.index)
                    yield from begun
                state, items = pipeline.step(setup, state, block)
                yield from items
        elif _of_the_rig(item):
            yield item


def _of_the_rig(item: Item) -> bool:
    """True for what a replay repeats; what the twin said is said anew."""
    if isinstance(item, Event):
        return item.kind not in ("jump", "divergence")
    return not isinstance(item, (Block, RunStart, Timing, *TWIN_RECORDS))


def _alive(block: Block, faults: list[Fault]) -> Iterator[Block]:
    """The parts of a block that the twin saw."""
    edges = {block.index, block.end}
    edges |= {
        edge
        for fault in faults
        for edge in (fault.from_index, fault.to_index)
        if block.index < edge < block.end
    }
    cuts = sorted(edges)
    for first, last in pairwise(cuts):
        if not any(fault.from_index <= first < fault.to_index for fault in faults):
            yield block.cut(first, last)
