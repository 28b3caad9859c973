"""Rerun of the twin on the measured samples of a recording, and the predictions not recorded."""

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from itertools import pairwise, zip_longest
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.errors import InputError
from table_io.records import (
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    Event,
    Fault,
    JumpForecast,
    Params,
    PrcPoint,
    PredictionHash,
    RunStart,
    StepAdded,
    Timing,
)
from twin.compare import pipeline
from twin.compare.pipeline import EVENT_KINDS
from twin.compare.prediction_hash import hash_cells
from twin.compare.twins import TwinSetup, advance_twins, resume_twins
from twin.recording.columns import SeriesStore, StoredItems
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_start
from twin.results.recordings import open_recording, read_recorded_config
from twin.setup.run_config import RunConfig
from twin.system.terminal import error_console
from twin.transport.codec import Item
from twin.transport.endpoint import PRED_TOPIC
from twin.transport.series import split_item

DRIVE_CHANNEL = "table_acc_m_s2"  # of the twin
BLOCK_DURATION_S = 1.0  # offline; results do not depend on the block size
TWIN_RECORDS = (
    Comparison, PredictionHash, Params, CycleExtremes, PrcPoint, Agreement, Estimate, JumpForecast,
)  # fmt: skip


def rerun_twin(
    recording: Recording, config: RunConfig, block_samples: int = 0, edges: Iterable[int] = ()
) -> Iterator[Item]:
    """Yield the rig's items and the recomputed results of the twin, without the start record.

    Recorded faults of the twin and changes of its parameters are repeated. Blocks have
    `block_samples`, 0 for about a second, and end at each sample of `edges` too.
    """
    block_samples = block_samples or round(BLOCK_DURATION_S * recording.start.rate_hz)
    setup = config.prepare_twin(from_rest=recording.start.source == "model")
    setup = pipeline.add_steps(setup, *recording.records(StepAdded))
    faults = _list_twin_faults(recording)
    changes = _parameter_changes(recording, config)
    cuts = {*edges, *(change.index for change in changes)}
    cuts |= {edge for fault in faults for edge in (fault.from_index, fault.to_index)}
    state, start_records = pipeline.start_pipeline(setup, recording.start.index)
    yield from start_records
    for item in _iter_source(recording, block_samples, sorted(cuts)):
        yield item
        if not isinstance(item, Block):
            continue
        while changes and changes[0].index <= item.index:
            setup = pipeline.adopt_params(setup, changes[0])
            yield changes.pop(0)
        if not any(fault.from_index <= item.index < fault.to_index for fault in faults):
            if any(fault.to_index == item.index for fault in faults):
                state, start_records = pipeline.start_pipeline(setup, item.index)
                yield from start_records
            state, new_records = pipeline.step(setup, state, item)
            yield from new_records


def _list_twin_faults(recording: Recording) -> list[Fault]:
    return [fault for fault in recording.records(Fault) if fault.component == "twin"]


def _parameter_changes(recording: Recording, config: RunConfig) -> list[Params]:
    """Return the parameter changes during the run; empty for a model other than the recorded."""
    if config.model_toml != recording.start.model_toml:
        return []
    return [params for params in recording.records(Params) if params.reason != "start"]


def _iter_source(recording: Recording, block_samples: int, edges: list[int]) -> Iterator[Item]:
    """Yield the rig's items by sample index, in blocks of `block_samples`, also cut at `edges`."""

    def iter_blocks() -> Iterator[Block]:
        for block in recording.contiguous_blocks("meas"):
            boundaries = range(
                block.index - block.index % block_samples + block_samples, block.end, block_samples
            )
            inside = (edge for edge in edges if block.index < edge < block.end)
            for first, last in pairwise(sorted({block.index, *boundaries, *inside, block.end})):
                yield block.cut(first, last)

    records: Iterable[Item] = filter(is_rig_item, recording.items.records)
    yield from heapq.merge(iter_blocks(), records, key=lambda item: item.index)


class Predictions:
    """Predictions of a recording, of which those that were not recorded are computed when asked."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording

    def read(self, first: int, end: int) -> tuple[Block, ...]:
        """Return blocks of predictions with all known ones of samples first .. end - 1."""
        block = None if self._config is None else self._resume(self._config, first, end)
        return self._whole if block is None else (block,)

    @cached_property
    def _config(self) -> RunConfig | None:
        start = self._recording.start
        if start.has_all_predictions or DRIVE_CHANNEL not in start.channels:
            return None
        try:
            return read_recorded_config(self._recording)
        except InputError:
            return None

    @cached_property
    def _whole(self) -> tuple[Block, ...]:
        return restore_predictions(self._recording, self._config).contiguous_blocks("pred")

    def _resume(self, config: RunConfig, first: int, end: int) -> Block | None:
        """Return the predictions of samples first .. end - 1, from the last saved states.

        None where these, the samples or the hashes do not suffice: then the twin must be rerun.
        """
        setup = pipeline.prepare_twins(config.profile, config.model)
        hashes = self._recording.records(PredictionHash)
        covering = [entry for entry in hashes if entry.index < end and first < entry.end]
        changes = _parameter_changes(self._recording, config)
        if not covering or changes or _list_twin_faults(self._recording):
            return None
        begin, last = covering[0].index, covering[-1].end
        saved = _find_saved(hashes, setup, begin - setup.delay_samples)
        if saved is None or not begin <= first < end <= last:
            return None
        start = saved.end
        for block in self._recording.contiguous_blocks("meas"):
            before = max(start - setup.history_samples, block.index)
            if not (block.index <= before < start and last <= block.end):
                continue
            twins = resume_twins(setup, (saved.free, saved.window), block.cut(before, start))
            predicted = advance_twins(setup, twins, block.cut(start, last))[1].cut(begin, last)
            values, size = predicted.values, setup.hash_samples
            _, again = hash_cells(values[:, :0], last, values, size, {})
            pairs = zip_longest(again, covering)
            is_same = all(new and new.is_same_output(old) for new, old in pairs)
            return predicted.cut(first, end) if is_same else None
        return None


def _find_saved(
    hashes: Iterable[PredictionHash], setup: TwinSetup, latest: int
) -> PredictionHash | None:
    """Return the last hash up to sample `latest` that states both solvers, None without one."""
    size = setup.solver.rest_state(0).size  # a compiled solver does not check it
    fitting = (entry for entry in hashes if len(entry.free) == len(entry.window) == size)
    return max(
        (entry for entry in fitting if entry.end <= latest),
        key=lambda entry: entry.end,
        default=None,
    )


def is_rig_item(item: Item) -> bool:
    """Return whether an item comes from the rig and is copied, not recomputed by the twin."""
    if isinstance(item, Event):
        # "divergence" is a twin event kind in old logs
        return item.kind not in (*EVENT_KINDS, "divergence")
    return not isinstance(item, (Block, RunStart, Timing, *TWIN_RECORDS))


def restore_predictions(recording: Recording, config: RunConfig | None = None) -> Recording:
    """Return a recording with all predictions: those that were not recorded are recomputed.

    A recording with all of them is returned itself. Each hash is compared with the recorded one; a
    warning says where predictions are missing or are not those of the run.
    """
    if recording.start.has_all_predictions:
        return recording
    try:
        if DRIVE_CHANNEL not in recording.start.channels:
            raise InputError("drives the twin, but was not recorded", key=DRIVE_CHANNEL)
        config = config or read_recorded_config(recording)
    except InputError as error:
        _warn(recording, f"only a part is recorded, and the rest cannot be recomputed: {error}")
        return recording
    sample_count = sum(map(len, recording.contiguous_blocks("meas")))
    store = SeriesStore(lambda _: sample_count)
    hashes: dict[int, PredictionHash] = {}
    for item in rerun_twin(recording, config):
        if isinstance(item, Block) and item.stream == "pred":
            store.add(item, np.array([item.index]), *split_item(item))
        elif isinstance(item, PredictionHash):
            hashes[item.index] = item
    recorded = recording.records(PredictionHash)
    differing = sum(not entry.is_same_output(hashes.get(entry.index)) for entry in recorded)
    if differing:
        _warn(recording, f"{differing} of {len(recorded)} hashes differ from those of the run")
    start = replace(recording.start, predictions_every=0)
    records = [start if isinstance(each, RunStart) else each for each in recording.items.records]
    items = StoredItems(records, {**recording.items.series, PRED_TOPIC: store.close()})
    return replace(recording, start=start, items=items)


def _warn(recording: Recording, problem: str) -> None:
    error_console.print(
        f"warning: predictions of {recording.path}: {problem}; see `shaketwin replay`",
        highlight=False,
        soft_wrap=True,
    )


def restore_log(path: Path, folder: Path) -> Path:
    """Return a log with all predictions: `path` itself, or a copy of it in `folder`."""
    if read_start(path).has_all_predictions:
        return path
    recording = open_recording(path)
    restored = restore_predictions(recording)
    if restored is recording:
        return path
    write_items(folder / path.name, list(restored.items), restored.start)
    return folder / path.name
