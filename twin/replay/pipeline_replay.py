"""Replay of a recording: the rig's stream as recorded, the twin's results recomputed."""

import math
import platform
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from table_io.block import Block
from table_io.clock import local_datetime
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
    RunStop,
    Timing,
)
from twin.compare import COMPARED_CHANNELS, TWIN_CHANNELS
from twin.recording.log_metadata import select_recorded
from twin.recording.reader import (
    CUT_EVENT_KIND,
    Recording,
    read_recording,
    read_start,
)
from twin.recording.recovery import LogMessage
from twin.results.rerun import TWIN_RECORDS, is_rig_item, rerun_twin
from twin.setup.run_config import RunConfig
from twin.setup.unpaced import ItemHandler, record_items
from twin.system.versions import read_installed_versions
from twin.transport.codec import (
    RECORD_TOPICS,
    TOPIC_TYPES,
    Item,
    WireError,
    decode_item,
    encode_run,
    strip_run,
)
from twin.transport.endpoint import CMP_TOPIC, HASH_TOPIC, PRED_TOPIC


def iter_start_records(
    recording: Recording, run: str, model_toml: str, first: int, predictions_every: int
) -> Iterator[RunStart | Event]:
    """Yield the start record of a replay from sample `first`, and its provenance events.

    Host, time and versions are those of the replay; the recording keeps its own.
    """
    yield replace(
        recording.start,
        index=first,
        run=run,
        model_toml=model_toml,
        versions=dict(read_installed_versions()),
        host=platform.node(),
        started_at=local_datetime().isoformat(timespec="seconds"),
        predictions_every=predictions_every,
    )
    content = recording.metadata.get("content", {}).get("sha256")
    description = f"sha256 of its content {content}" if content else "which was never finished"
    yield Event(first, "replay", f"replay of {recording.run}, {description}")
    if first > recording.start.index:
        yield Event(first, CUT_EVENT_KIND, f"from {recording.run} at sample {first}")


TIMING_TOPIC = RECORD_TOPICS[Timing]
MAX_COMPARISON_SAMPLES = 10_000  # covered by one comparison
LAST_WORDS_S = 1.5  # what a twin and a recorder that die together may take with them
STAMPED_AT_END = (
    CycleExtremes,
    PrcPoint,
    Agreement,
    Estimate,
    JumpForecast,
)  # their index is the end of the interval that they describe
TWIN_TOPICS = {
    PRED_TOPIC,
    *(RECORD_TOPICS[kind] for kind in TWIN_RECORDS if kind is not Params),
    TIMING_TOPIC,
}


@dataclass(frozen=True, slots=True)
class RecordedRun:
    """Recording to replay, and its encoded comparisons by sample index.

    Comparisons stay encoded: a replay reproduces them and compares their bytes. `predictions` are
    encoded blocks, and only those of a recording that has a part of them. A live twin that is
    at work reports its latencies every second, and at the end; -1 if none was recorded.
    """

    recording: Recording
    comparisons: dict[int, bytes]
    last_twin_timing: int = -1
    hashes: dict[int, PredictionHash] = field(default_factory=dict)
    predictions: dict[int, bytes] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> "RecordedRun":
        """Read from a log what a replay needs."""
        own_topics = {CMP_TOPIC, TIMING_TOPIC, HASH_TOPIC}
        if read_start(path).predictions_every:
            own_topics.add(PRED_TOPIC)
        own: dict[str, list[LogMessage]] = {topic: [] for topic in own_topics}
        handlers = {topic: messages.extend for topic, messages in own.items()}
        recording = read_recording(path, TOPIC_TYPES.keys() - TWIN_TOPICS | {CMP_TOPIC}, handlers)
        rate = recording.start.rate_hz
        payloads = {
            topic: {round(message.log_time * rate / 1e9): message.payload for message in messages}
            for topic, messages in own.items()
        }
        timings = (_decode(TIMING_TOPIC, message.payload) for message in own[TIMING_TOPIC])
        twin_timings = (
            timing.index
            for timing in timings
            if isinstance(timing, Timing) and timing.component == "twin"
        )
        hashes = (_decode(HASH_TOPIC, payload) for payload in payloads[HASH_TOPIC].values())
        return cls(
            recording,
            payloads[CMP_TOPIC],
            max(twin_timings, default=-1),
            {item.index: item for item in hashes if isinstance(item, PredictionHash)},
            payloads.get(PRED_TOPIC, {}),
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
        if isinstance(item, (Comparison, PredictionHash)):
            return self.first <= item.index and item.index + item.count <= self.last
        if isinstance(item, STAMPED_AT_END) or (isinstance(item, Event) and not is_rig_item(item)):
            return self.first < item.index <= self.last
        return self.first <= item.index <= self.last


@dataclass(slots=True)
class ReplayComparison:
    """Result of a replay: its comparisons and predictions against the recorded, as counts."""

    recorded: int = 0
    compared: int = 0
    differing: int = 0
    missing: int = 0  # recorded, but not made by the replay
    unrecorded: int = 0  # made by the replay, but missing in a finished recording
    lost_with_twin: int = 0  # the same, where a twin had died before it was recorded
    made: int = 0
    hashes: int = 0  # of predictions, recorded
    hashes_compared: int = 0
    hashes_differing: int = 0
    predictions_compared: int = 0  # blocks
    predictions_differing: int = 0
    beginning: str = ""  # run with the samples before the recording, see `Recording.earlier_run`
    first_difference: int | None = None  # sample index
    largest: dict[str, float] = field(default_factory=dict)  # |difference| of error sums, SI^2

    def note_difference(self, index: int) -> None:
        """Keep the sample of the first difference."""
        if self.first_difference is None or index < self.first_difference:
            self.first_difference = index

    @property
    def differs(self) -> bool:
        """True if the comparisons should be identical but are not."""
        return self.is_identical is False

    @property
    def is_identical(self) -> bool | None:
        """True if all comparisons are identical; None if there are none or the start is missing."""
        if not self.recorded or self.beginning:
            return None
        return not (
            self.differing
            or self.missing
            or self.unrecorded
            or self.hashes_compared < self.hashes
            or self.hashes_differing
            or self.predictions_differing
        )


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
    result.beginning = recording.earlier_run
    result.recorded = sum(span.contains_comparison(entry) for entry in recorded.comparisons.items())
    result.hashes = sum(map(span.includes, _list_expected_hashes(recorded)))

    unrecorded: list[int] = []
    compare = partial(_compare_items, result, recorded, run, unrecorded)
    items = replay_items(recording, config, run, span, block_samples)
    record_items(items, path, run, recording.start.rate_hz, on_item, compare)
    result.missing = result.recorded - result.compared
    result.lost_with_twin = _count_lost_with_twin(recorded, unrecorded)
    result.unrecorded = len(unrecorded) - result.lost_with_twin
    return result


def _list_expected_hashes(recorded: RecordedRun) -> list[PredictionHash]:
    """Return the recorded hashes; without those where the twin had failed, which none makes."""
    faults = [fault for fault in recorded.recording.records(Fault) if fault.component == "twin"]
    return [
        entry
        for entry in recorded.hashes.values()
        if not any(
            fault.from_index < entry.index + entry.count and entry.index < fault.to_index
            for fault in faults
        )
    ]


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


def _compare_items(
    result: ReplayComparison,
    recorded: RecordedRun,
    run: str,
    unrecorded: list[int],
    items: Sequence[Item],
    payloads: Sequence[bytes],
) -> None:
    """Update `result` with items of the replay, of one kind, that the recording has too."""
    if isinstance(items[0], Comparison):
        result.made += len(items)
        _compare_comparisons(result, recorded, run, unrecorded, items, payloads)
        return
    for new, payload in zip(items, payloads, strict=True):
        if isinstance(new, PredictionHash) and new.index in recorded.hashes:
            result.hashes_compared += 1
            if not new.is_same_output(recorded.hashes[new.index]):
                result.hashes_differing += 1
                result.note_difference(new.index)
        elif isinstance(new, Block) and new.stream == "pred" and recorded.predictions:
            old = recorded.predictions.get(new.index, b"")
            old = strip_run(old, Block, recorded.recording.run)
            if old and old == strip_run(payload, Block, run):
                result.predictions_compared += 1
                continue
            for part in select_recorded(new, recorded.start):
                _compare_predictions(result, recorded, part)


def _compare_comparisons(
    result: ReplayComparison,
    recorded: RecordedRun,
    run: str,
    unrecorded: list[int],
    items: Sequence[Item],
    payloads: Sequence[bytes],
) -> None:
    """Update `result` with the payloads of comparisons, and `unrecorded` with their samples."""
    field, old_field = (encode_run(Comparison, each) for each in (run, recorded.recording.run))
    for new, payload in zip(items, payloads, strict=True):
        old = recorded.comparisons.get(new.index)
        if old is None:
            if recorded.recording.stop is not None:  # else the last comparisons may be missing
                unrecorded.append(new.index)
            continue
        result.compared += 1
        if old.removesuffix(old_field) != payload.removesuffix(field):
            result.differing += 1
            result.note_difference(new.index)
            _measure_difference(result, old, payload)


def _measure_difference(result: ReplayComparison, old_payload: bytes, payload: bytes) -> None:
    """Update `result.largest` with two comparisons that differ; a damaged one tells nothing."""
    old, new = _decode_comparison(old_payload), _decode_comparison(payload)
    if old is None or new is None or old.channels != new.channels:
        return
    sums = zip(new.channels, old.window_error_ss, new.window_error_ss, strict=False)
    for name, old_sum, new_sum in sums:
        if math.isfinite(old_sum) and math.isfinite(new_sum):
            result.largest[name] = max(result.largest.get(name, 0.0), abs(old_sum - new_sum))


def _compare_predictions(result: ReplayComparison, recorded: RecordedRun, new: Block) -> None:
    """Update `result` with a predicted block, if a recorded one begins at the same sample."""
    payload = recorded.predictions.get(new.index)
    old = None if payload is None else _decode(PRED_TOPIC, payload)
    if not isinstance(old, Block):
        return
    end = min(old.end, new.end)
    result.predictions_compared += 1
    if not old.cut(old.index, end).is_identical(new.cut(new.index, end)):
        result.predictions_differing += 1
        result.note_difference(new.index)


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
    """Yield the rig's items and recomputed twin results, with recorded faults and changes.

    The log of a replay of some steps cannot be replayed, so it has all predictions.
    """
    first = recording.start.index
    is_whole = span.first == first and not recording.earlier_run
    has_every = span == SampleRange.all_samples(recording)
    every = 0 if recording.start.source == "model" or not is_whole else config.predictions_every
    yield from iter_start_records(recording, run, config.model_toml, span.first, every)
    for item in rerun_twin(recording, config, block_samples, (span.first, span.last)):
        if isinstance(item, Block) and item.index > span.last:
            break
        if isinstance(item, Params) and (item.reason != "start" or item.index == first):
            yield replace(item, index=max(item.index, span.first))
        elif (has_every and isinstance(item, Comparison)) or span.includes(item):
            yield item
    stop = recording.stop
    if stop is not None and stop.index > span.last:
        yield RunStop(span.last, stop.verdict, "the steps that were asked for", stop.states)


def compute_deviation(old_path: Path, new_path: Path) -> dict[str, float | None]:
    """Return rms(new - old) / rms(old) by predicted channel, over samples recorded in both.

    None where a recording has no predictions of the channel.
    """
    old_blocks, new_blocks = (
        read_recording(path, (PRED_TOPIC,)).contiguous_blocks("pred")
        for path in (old_path, new_path)
    )
    squares = np.zeros((2, len(TWIN_CHANNELS)))
    ends = [block.end for block in new_blocks]
    for old_block in old_blocks:
        for new_block in new_blocks[bisect_right(ends, old_block.index) :]:
            if new_block.index >= old_block.end:
                break
            first, last = max(old_block.index, new_block.index), min(old_block.end, new_block.end)
            if old_block.channels == new_block.channels == TWIN_CHANNELS:
                squares += _sum_squares(old_block.cut(first, last), new_block.cut(first, last))
    return {
        name: math.sqrt(difference / signal) if signal > 0 else None
        for name, difference, signal in zip(TWIN_CHANNELS, *squares.tolist(), strict=True)
    }


def _sum_squares(old: Block, new: Block) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Return the sums of squares of difference and old signal, both finite, (2, channel)."""
    known = np.isfinite(old.values) & np.isfinite(new.values)
    signal = np.where(known, old.values, 0.0)
    difference = signal - np.where(known, new.values, 0.0)
    return np.array([(difference**2).sum(axis=1), (signal**2).sum(axis=1)])


def describe_deviation(shares: Mapping[str, float | None]) -> str:
    """Describe the channel with the largest deviation, for the restarted and the free twin."""
    parts = []
    for track, title in (("window", "restarted twin"), ("free", "free-running twin")):
        track_shares = {
            name: share for name, share in shares.items() if name.startswith(track) and share
        }
        if track_shares:
            name = max(track_shares, key=lambda channel: track_shares[channel])
            parts.append(
                f"the {title} by up to {track_shares[name]:.2g} of {name.split('/')[1]} (rms)"
            )
    return " and ".join(parts) or "the predictions are the same"
