"""Runs in one process, without real time: `--speed max` and `simulate`."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from table_io.acquisition.session import (
    CommandSource,
    OperatorCommand,
    SessionOutput,
    find_take_back,
    run_session,
)
from table_io.backends import open_backend
from table_io.block import Block
from table_io.clock import ManualClock
from table_io.records import Comparison, Record, RunStart, RunStop, StepAdded
from twin.compare import pipeline
from twin.recording.mcap_log import LogWriter
from twin.setup.realtime import check_full_speed
from twin.setup.run_config import RunConfig
from twin.setup.swept_prediction import generate_swept_twin
from twin.transport.codec import Item, encode_comparisons, encode_item, topic_for
from twin.transport.endpoint import CMP_TOPIC

ItemHandler = Callable[[Item], None]
PayloadHandler = Callable[[Sequence[Item], Sequence[bytes]], None]
FLUSH_INTERVAL_S = 5.0  # of recorded time
SIMULATED_BLOCK_SAMPLES = 500


@dataclass(frozen=True, eq=False)
class ShownRun:
    """Run that a task is about to make: samples `first` up to `last`, which is not among them."""

    config: RunConfig
    run: str
    first: int
    last: int


Observe = Callable[[ShownRun], AbstractContextManager[ItemHandler]]


def observe_nothing(_: ShownRun) -> AbstractContextManager[ItemHandler]:
    """Show no item of a run."""
    return nullcontext(lambda item: None)


def record_items(
    items: Iterator[Item],
    path: Path,
    run: str,
    rate_hz: float,
    on_item: ItemHandler,
    on_payloads: PayloadHandler = lambda *_: None,
) -> None:
    """Write every item to a new log at `path`; the log is closed on errors too.

    `on_payloads` is called with recorded items of one kind and their payloads before writing,
    `on_item` with each item after. Comparisons that follow each other are written at once.
    """
    writer = LogWriter(path, rate_hz)
    flushed_index = 0
    compared: list[Comparison] = []

    def write_compared() -> None:
        if not compared:
            return
        payloads = encode_comparisons(compared, run)
        on_payloads(compared, payloads)
        writer.write_all(CMP_TOPIC, payloads, [item.index for item in compared])
        for item in compared:
            on_item(item)
        compared.clear()

    try:
        for item in items:
            if isinstance(item, Comparison):
                compared.append(item)
                continue
            write_compared()
            if isinstance(item, RunStart):
                writer.write_run_description(item)
            for part in writer.select_recorded(item):
                payload = encode_item(part, run)
                on_payloads([part], [payload])
                writer.write(topic_for(part), payload, part.index)
            if item.index - flushed_index > FLUSH_INTERVAL_S * rate_hz:
                writer.flush()
                flushed_index = item.index
            on_item(item)
    finally:
        write_compared()
        writer.close()


def add_twin_items(
    source: Iterator[Block | Record], setup: pipeline.PipelineSetup
) -> Iterator[Item]:
    """Yield every item of a source, each followed by the twin's output for it."""
    state = None
    for item in source:
        yield item
        if isinstance(item, StepAdded):
            setup = pipeline.add_steps(setup, item)
        elif isinstance(item, RunStart):
            state, begun = pipeline.start_pipeline(setup)
            yield from begun
        elif isinstance(item, Block) and state is not None:
            state, items = pipeline.step(setup, state, item)
            yield from items


def iter_simulated_session(
    config: RunConfig, run: str, commands: CommandSource = lambda: None
) -> SessionOutput:
    """Yield what a session on the simulated table yields, from decision to decision."""
    clock = ManualClock()
    backend = open_backend(config.rig, config.profile, clock)
    return run_session(
        config.session_setup,
        backend,
        clock,
        config.make_start_factory(run, "table"),
        commands,
        take_back=find_take_back(backend, clock),
    )


def play_unpaced(
    config: RunConfig,
    run: str,
    path: Path,
    poll_interrupt: Callable[[], str | None],
    on_item: ItemHandler,
) -> None:
    """Run the test on a simulated table at full speed, recorded to `path`."""
    check_full_speed(config.rig)

    def poll_command() -> OperatorCommand | None:
        return OperatorCommand("stop", why) if (why := poll_interrupt()) else None

    items = add_twin_items(iter_simulated_session(config, run, poll_command), config.prepare_twin())
    record_items(items, path, run, config.drive.rate_hz, on_item)


def simulate_ideal(config: RunConfig, run: str, path: Path, on_item: ItemHandler) -> None:
    """Simulate the model on the ideal drive, without table and noise, recorded to `path`."""
    record_items(generate_ideal_twin(config, run), path, run, config.drive.rate_hz, on_item)


def generate_ideal_twin(config: RunConfig, run: str = "") -> Iterator[Item]:
    """Yield the items of an ideal table, each followed by the twin's items for it."""
    if config.profile.swept_sine is not None:
        return generate_swept_twin(config, run)
    return add_twin_items(_generate_ideal(config, run), config.prepare_twin(from_rest=True))


def _generate_ideal(config: RunConfig, run: str) -> Iterator[Item]:
    """Yield the items of an ideal table, which follows the drive exactly."""
    drive = config.ideal_drive
    start = config.make_start_factory(run, "model")({}, 0.0)
    yield start
    end = drive.planned_end + math.ceil(config.profile.acquisition.rest_s * drive.rate_hz)
    for first in range(0, end, SIMULATED_BLOCK_SAMPLES):
        count = min(SIMULATED_BLOCK_SAMPLES, end - first)
        command = drive.command(first, count)
        values = np.array([command, command, drive.acceleration(first, count)])
        labels = drive.labels(first, count)
        yield Block("meas", first, drive.rate_hz, start.channels, values, *labels)
    yield RunStop(end, "complete", "the whole drive was played", ("idle", "running", "at rest"))
