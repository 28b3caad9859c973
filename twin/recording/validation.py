"""Semantic validation of decoded records; each function returns a reason or an empty string.

Code that works on a recording may rely on these checks.
"""

import math

import numpy as np

from table_io.block import Block, Float2D, Int2D, Label
from table_io.records import (
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    Fault,
    FrequencyResponse,
    Level,
    OrbitPoint,
    PrcPoint,
    Record,
    RunStart,
    Step,
    StepAdded,
    SweepLevel,
)
from twin.transport.series import SeriesItem, split_item

DIRECTIONS = ("forward", "backward")
MAX_STEPS = 100_000
MAX_CYCLES = 10_000_000
MAX_FREQUENCY_HZ = 1e7
MAX_DURATION_S = 1e7  # four months
# Of step, label and cycle of a sample, (3, 1).
MIN_LABELS = np.array([[-1], [min(Label)], [-1]])
MAX_LABELS = np.array([[MAX_STEPS], [max(Label)], [MAX_CYCLES]])


def validate_start(start: RunStart) -> str:
    """Return why a start record is invalid, or ""."""
    if not 0 < start.rate_hz <= MAX_FREQUENCY_HZ:
        return f"rate_hz = {start.rate_hz:g}"
    if not start.channels or len(set(start.channels)) < len(start.channels):
        return "no channels, or duplicate channels"
    if not 0 < start.block_samples <= start.rate_hz * MAX_DURATION_S:
        return f"block_samples = {start.block_samples}"
    if start.predictions_every > MAX_STEPS:
        return f"predictions_every = {start.predictions_every}"
    if max(start.index, start.planned_samples) > start.rate_hz * MAX_DURATION_S:
        return f"index = {start.index}, planned_samples = {start.planned_samples}"
    if len(start.steps) > MAX_STEPS or not all(map(_is_valid_step, start.steps)):
        return "too many or invalid steps"
    if [step.index for step in start.steps] != sorted({step.index for step in start.steps}):
        return "steps out of order"
    return ""


def _is_valid_step(step: Step) -> bool:
    return (
        step.direction in DIRECTIONS
        and step.index <= MAX_STEPS
        and 0 < step.frequency_hz <= MAX_FREQUENCY_HZ
        and 0 <= step.acceleration_m_s2 < math.inf
    )


def validate_block(block: Block, before: Block | None, start: RunStart) -> str:
    """Return why a block is invalid after block `before` of its stream, or ""."""
    if block.rate_hz != start.rate_hz:
        return "the sampling rate is not that of the run"
    if not len(block) or block.end > start.rate_hz * MAX_DURATION_S:
        return "no samples, or after the end of any run"
    if block.stream == "meas" and block.channels != start.channels:
        return "the channels are not those of the run"
    if before is not None and before.channels != block.channels:
        return "the channels differ from earlier blocks"
    if before is not None and block.index < before.end:
        return "duplicate samples"
    return "samples with invalid labels" if has_invalid_numbers(block, *split_item(block)) else ""


def has_invalid_numbers(head: SeriesItem, values: Float2D, integers: Int2D) -> bool:
    """Return whether a label of blocks, or a sum of squares of comparisons, is out of range.

    `values` and `integers` are the columns of any number of items like `head`.
    """
    if isinstance(head, Comparison):
        return bool((values < 0).any())
    return bool(((integers < MIN_LABELS) | (integers > MAX_LABELS)).any())


def validate_record(record: Record, start: RunStart) -> str:
    """Return why a record is invalid in the run of `start`, or ""."""
    is_late = record.index > start.rate_hz * MAX_DURATION_S
    return "after the end of any run" if is_late else _validate_fields(record)


def _has_unequal_lengths(record: Record) -> bool:
    """Return whether parallel columns of a record differ in length."""
    match record:
        case Comparison():
            columns = record.measured_ss, record.free_error_ss, record.window_error_ss
            return {*map(len, columns)} != {len(record.channels)}
        case Agreement():
            parts = record.error, record.band, record.flight, record.right, record.left
            return any(len(column) != len(record.channels) for column in parts)
        case Estimate():
            known = record.values, record.sd, record.drift, record.drift_sd
            return any(len(column) != len(record.names) for column in known)
        case SweepLevel():
            return len(record.channels) != len(record.amplitudes)
        case OrbitPoint():
            return len(record.u_m) != 2 * len(record.feedback_m)
        case FrequencyResponse():
            return not len(record.frequencies_hz) == len(record.gain) == len(record.phase_rad)
    return False


def _validate_fields(record: Record) -> str:
    if _has_unequal_lengths(record):
        return "columns of unequal lengths"
    match record:
        case Comparison():
            if has_invalid_numbers(record, *split_item(record)):
                return "negative sum of squares"
        case CycleExtremes() | Level():
            if record.step > MAX_STEPS:
                return f"step = {record.step}"
        case PrcPoint() | StepAdded():
            if record.step > MAX_STEPS or record.direction not in DIRECTIONS:
                return f"step = {record.step}, direction = {record.direction[:20]!r}"
            if not 0 < record.frequency_hz <= MAX_FREQUENCY_HZ:
                return f"frequency_hz = {record.frequency_hz:g}"
        case OrbitPoint() | SweepLevel():
            is_valid = record.step <= MAX_STEPS and 0 < record.frequency_hz <= MAX_FREQUENCY_HZ
            return "" if is_valid else f"step = {record.step}, {record.frequency_hz:g} Hz"
        case Fault():
            if record.from_index > record.to_index:
                return "the end is before the beginning"
    return ""
