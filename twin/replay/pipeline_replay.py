"""Replay of a recording: the rig's stream as recorded, the twin's results recomputed."""

import heapq
import math
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
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
    Record,
    RunStart,
    RunStop,
    StepAdded,
    Timing,
)
from twin.compare import COMPARED_CHANNELS, pipeline
from twin.recording.reader import Recording, build_recording
from twin.recording.recovery import recover_log
from twin.replay.provenance import find_earlier_run, iter_start_records
from twin.run.run_config import RunConfig
from twin.run.unpaced import ItemHandler, record_items
from twin.transport.codec import RECORD_TOPICS, TOPIC_TYPES, Item, WireError, decode_item, strip_run
from twin.transport.endpoint import CMP_TOPIC, PRED_TOPIC

TIMING_TOPIC = RECORD_TOPICS[Timing]
MAX_COMPARISON_SAMPLES = 10_000  # covered by one comparison
LAST_WORDS_S = 1.5  # what a twin and a recorder that die together may take with them
BLOCK_DURATION_S = 1.0  # offline; results do not depend on the block size
STAMPED_AT_END = (
    CycleExtremes,
    PrcPoint,
    Agreement,
    Estimate,
    JumpForecast,
)  # their index is the end of the interval that they describe
TWIN_RECORDS = (Comparison, Params, *STAMPED_AT_END)
TWIN_TOPICS = {PRED_TOPIC, *(RECORD_TOPICS[kind] for kind in (Comparison, *STAMPED_AT_END, Timing))}


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Recording to replay, and its encoded comparisons by sample index.

    Comparisons stay encoded: a replay reproduces them and compares their bytes. A live twin that is
    at work reports its latencies every second, and at the end; -1 if none was recorded.
    """

    recording: Recording
    comparisons: dict[int, bytes]
    last_twin_timing: int = -1

    @classmethod
    def open(cls, path: Path) -> "RecordedRun":
        """Read from a log what a replay needs."""
        own_topics = {CMP_TOPIC, TIMING_TOPIC}
        recovered = recover_log(path, frozenset(TOPIC_TYPES.keys() - TWIN_TOPICS | own_topics))
        own = [message for message in recovered.messages if message.topic in own_topics]
        recovered.messages = [
            message for message in recovered.messages if message.topic not in own_topics
        ]
        recording = build_recording(path, recovered)[0]
        rate = recording.start.rate_hz
        timing_ends = [
            item.index
            for message in own
            if message.topic == TIMING_TOPIC
            and isinstance(item := _decode(TIMING_TOPIC, message.payload), Timing)
            and item.component == "twin"
        ]
        return cls(
            recording,
            {
                round(message.log_time * rate / 1e9): message.payload
                for message in own
                if message.topic == CMP_TOPIC
            },
            last_twin_timing=max(timing_ends, default=-1),
        )

    @property
    def start(self) -> RunStart:
        return self.recording.start


@dataclass(frozen=True, slots=True)
class SampleRange:
    """Samples first .. last - 1 of a recording; earlier ones are computed but not written.

    So the twin has its recorded state at the first sample, and the results equal the recorded ones,
    also of the free-running twin.
    """

    first: int
    last: int

    @classmethod
    def all_samples(cls, recording: Recording) -> "SampleRange":
        return cls(recording.start.index, 2**62)

    @classmethod
    def of_steps(cls, recording: Recording, first: int, last: int) -> "SampleRange":
        """Return the samples of steps first to last; raise InputError if none was recorded."""
        indices: list[int] = []
        recorded_steps: set[int] = set()
        for block in recording.contiguous_blocks("meas"):
            recorded_steps |= set(np.unique(block.step).tolist())
            positions = np.flatnonzero((block.step >= first) & (block.step <= last))
            indices += (block.index + positions).tolist()
        if not indices:
            available = sorted(recorded_steps - {-1})
            available_range = f"{available[0]} to {available[-1]}" if available else "none"
            raise InputError(
                f"no such steps in {recording.path}",
                where=f"--steps {first}:{last}",
                allowed=f"{available_range} (the `index` of a step in summary.json)",
            )
        return cls(min(indices), max(indices) + 1)

    def contains_comparison(self, compared: tuple[int, bytes]) -> bool:
        """Return whether all samples of a recorded comparison (index, payload) are in the range."""
        index, payload = compared
        if not self.first <= index < self.last:
            return False
        # decode only where the comparison may extend beyond the range
        near_the_end = index + MAX_COMPARISON_SAMPLES > self.last
        return (
            not near_the_end
            or (comparison := _decode_comparison(payload)) is None
            or self.includes(comparison)
        )

    def includes(self, item: Item) -> bool:
        """Return whether an item belongs to the range; cycles and points have their end index."""
        if isinstance(item, Block):
            return self.first <= item.index and item.end <= self.last
        if isinstance(item, Comparison):
            return self.first <= item.index and item.index + item.count <= self.last
        if isinstance(item, STAMPED_AT_END) or (isinstance(item, Event) and not _is_rig_item(item)):
            return self.first < item.index <= self.last
        return self.first <= item.index <= self.last


@dataclass(slots=True)
class ReplayComparison:
    """Result of a replay: its comparisons against the recorded ones, as counts."""

    recorded: int = 0
    compared: int = 0
    differing: int = 0
    missing: int = 0  # recorded, but not made by the replay
    unrecorded: int = 0  # made by the replay, but missing in a finished recording
    lost_with_twin: int = 0  # the same, where a twin had died before it was recorded
    made: int = 0
    beginning: str = ""  # run with the samples before the recording, see `find_earlier_run`
    first_difference: int | None = None  # sample index
    largest: dict[str, float] = field(default_factory=dict)  # |difference| of error sums, SI^2

    @property
    def differs(self) -> bool:
        """True if the comparisons should be identical but are not."""
        return self.is_identical is False

    @property
    def is_identical(self) -> bool | None:
        """True if all comparisons are identical; None if there are none or the start is missing."""
        if not self.recorded or self.beginning:
            return None
        return not (self.differing or self.missing or self.unrecorded)


def replay_recording(
    recorded: RecordedRun,
    config: RunConfig,
    path: Path,
    run: str,
    on_item: ItemHandler,
    span: SampleRange | None = None,
    block_samples: int = 0,
) -> ReplayComparison:
    """Replay a recording through the pipeline into a new log at `path`.

    The twin has no output where it had failed. `block_samples` is the block size, 0 for offline
    replay.
    """
    recording = recorded.recording
    span = span or SampleRange.all_samples(recording)
    result = ReplayComparison(largest=dict.fromkeys(COMPARED_CHANNELS, 0.0))
    result.beginning = find_earlier_run(recording)
    result.recorded = sum(span.contains_comparison(entry) for entry in recorded.comparisons.items())
    block_samples = block_samples or round(BLOCK_DURATION_S * recording.start.rate_hz)

    unrecorded: list[int] = []
    compare = partial(_compare_item, result, recorded, run, unrecorded)
    items = replay_items(recording, config, run, span, block_samples)
    record_items(items, path, run, recording.start.rate_hz, on_item, compare)
    result.missing = result.recorded - result.compared
    result.lost_with_twin = _count_lost_with_twin(recorded, unrecorded)
    result.unrecorded = len(unrecorded) - result.lost_with_twin
    return result


def _count_lost_with_twin(recorded: RecordedRun, unrecorded: Sequence[int]) -> int:
    """Return how many unrecorded comparisons a twin made last before it died, or never made.

    They lie in the `LAST_WORDS_S` before a Fault of the twin, with no recorded one behind them; or
    after the last recorded one, if a twin whose latencies were recorded reported none from then on.
    Nothing is excused in a damaged recording.
    """
    recording = recorded.recording
    if not recording.is_intact:
        return 0
    known = sorted(recorded.comparisons)
    last_known = max(known, default=-1)
    last_words = round(LAST_WORDS_S * recording.start.rate_hz)
    deaths = [fault.from_index for fault in recording.records(Fault) if fault.component == "twin"]
    is_silent = 0 <= recorded.last_twin_timing <= last_known + last_words
    count = 0
    for index in unrecorded:
        following = bisect_right(known, index)
        next_known = known[following] if following < len(known) else index + last_words
        end = min(next_known, index + last_words)
        is_before_death = any(index < death <= end for death in deaths)
        count += is_before_death or (is_silent and index > last_known)
    return count


def _compare_item(
    result: ReplayComparison,
    recorded: RecordedRun,
    run: str,
    unrecorded: list[int],
    new: Item,
    payload: bytes,
) -> None:
    """Update `result` with an item of the replay and its payload, if it is a comparison."""
    if not isinstance(new, Comparison):
        return
    result.made += 1
    old = recorded.comparisons.get(new.index)
    if old is None:
        if recorded.recording.stop is not None:  # else the last comparisons may be missing
            unrecorded.append(new.index)
        return
    result.compared += 1
    if strip_run(old, Comparison, recorded.recording.run) == strip_run(payload, Comparison, run):
        return
    result.differing += 1
    if result.first_difference is None:
        result.first_difference = new.index
    old_comparison = _decode_comparison(old)
    if old_comparison is None or old_comparison.channels != new.channels:
        return  # damaged: the difference is unknown
    for name, old_sum, new_sum in zip(
        new.channels, old_comparison.window_error_ss, new.window_error_ss, strict=False
    ):
        if math.isfinite(old_sum) and math.isfinite(new_sum):
            result.largest[name] = max(result.largest.get(name, 0.0), abs(old_sum - new_sum))


def _decode_comparison(payload: bytes) -> Comparison | None:
    """Decode a recorded comparison; return None if it is damaged."""
    item = _decode(CMP_TOPIC, payload)
    return item if isinstance(item, Comparison) else None


def _decode(topic: str, payload: bytes) -> Item | None:
    try:
        return decode_item(topic, payload)[1]
    except WireError:
        return None


def replay_items(
    recording: Recording, config: RunConfig, run: str, span: SampleRange, block_samples: int
) -> Iterator[Item]:
    """Yield the rig's items and recomputed twin results, with recorded faults and changes."""
    setup = config.prepare_twin(from_rest=recording.start.source == "model")
    setup = pipeline.add_steps(setup, *recording.records(StepAdded))
    faults = [fault for fault in recording.records(Fault) if fault.component == "twin"]
    changes = _parameter_changes(recording, config)
    edges = {span.first, span.last, *(change.index for change in changes)}
    edges |= {edge for fault in faults for edge in (fault.from_index, fault.to_index)}
    yield from iter_start_records(recording, run, config.model_toml, span.first)
    state, start_records = pipeline.start_pipeline(setup, recording.start.index)
    yield from (replace(record, index=span.first) for record in start_records)
    for item in _iter_source(recording, block_samples, sorted(edges)):
        if isinstance(item, Block):
            if item.index > span.last:
                break
            records: list[Block | Record] = [item]
            while changes and changes[0].index <= item.index:
                change = changes.pop(0)
                setup = pipeline.adopt_params(setup, change)
                records.append(replace(change, index=max(change.index, span.first)))
            if not any(fault.from_index <= item.index < fault.to_index for fault in faults):
                if any(fault.to_index == item.index for fault in faults):
                    state, start_records = pipeline.start_pipeline(setup, item.index)
                    records.extend(start_records)
                state, new_records = pipeline.step(setup, state, item)
                records.extend(new_records)
            yield from (record for record in records if span.includes(record))
        elif span.includes(item) and not (isinstance(item, RunStop) and item.index > span.last):
            yield item
    stop = recording.stop
    if stop is not None and stop.index > span.last:
        yield RunStop(span.last, stop.verdict, "the steps that were asked for", stop.states)


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

    records: Iterable[Item] = [item for item in recording.items if _is_rig_item(item)]
    yield from heapq.merge(iter_blocks(), records, key=lambda item: item.index)


def _is_rig_item(item: Item) -> bool:
    """Return whether an item comes from the rig and is copied, not recomputed by the twin."""
    if isinstance(item, Event):
        # "divergence" is a twin event kind in old logs
        return item.kind not in (*pipeline.EVENT_KINDS, "divergence")
    return not isinstance(item, (Block, RunStart, Timing, *TWIN_RECORDS))
