"""Runs in one process: `--speed max`, `simulate`: the same steps, other sources."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from table_io.backends import open_backend
from table_io.block import Block
from table_io.card import BadInput
from table_io.clock import ManualClock
from table_io.records import (
    Decided,
    Record,
    RunStart,
    RunStop,
)
from table_io.session import Order, play
from twin.compare import pipeline
from twin.service.bundle import Bundle
from twin.stream.mcap_log import LogWriter
from twin.stream.wire import Item, encode, topic

Watch = Callable[[Item], None]
Heard = Callable[[Item, bytes], None]
FLUSH_SAMPLES_S = 5.0  # of recorded time between flushes where nothing is live
SIMULATED_BLOCK = 500


def record(
    items: Iterator[Item],
    path: Path,
    run: str,
    rate_hz: float,
    watch: Watch,
    heard: Heard = lambda *_: None,
) -> None:
    """Write every item to a new log at `path`; the log is closed whatever happens.

    `heard` takes the bytes of each item before they are written, `watch` the item afterwards.
    """
    writer = LogWriter(path, rate_hz)
    flushed = 0
    try:
        for item in items:
            if isinstance(item, RunStart):
                writer.describe(item)
            payload = encode(item, run)
            heard(item, payload)
            writer.write(topic(item), payload, item.index)
            if item.index - flushed > FLUSH_SAMPLES_S * rate_hz:
                writer.flush()
                flushed = item.index
            watch(item)
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
