"""What cannot be in a run, though its bytes are in order: each a few words, or nothing.

Whoever reads a recording may rely on what is refused here.
"""

import math
from collections.abc import Sequence

import numpy as np

from table_io.block import Block, Label
from table_io.records import (
    Agreement,
    Comparison,
    Cycle,
    Decided,
    Estimate,
    Fault,
    Level,
    Point,
    Record,
    Response,
    RunStart,
    Step,
)

DIRECTIONS = ("forward", "backward")
MOST_STEPS = 100_000
MOST_CYCLES = 10_000_000
FASTEST_HZ = 1e7
LONGEST_S = 1e7  # of a run: four months


def unsound_start(start: RunStart) -> str:
    """Why no run can begin so."""
    if not 0 < start.rate_hz <= FASTEST_HZ:
        return f"rate_hz = {start.rate_hz:g}"
    if not start.channels or len(set(start.channels)) < len(start.channels):
        return "no channels, or one of them twice"
    if not 0 < start.block_samples <= start.rate_hz * LONGEST_S:
        return f"block_samples = {start.block_samples}"
    if max(start.index, start.planned_samples) > start.rate_hz * LONGEST_S:
        return f"index = {start.index}, planned_samples = {start.planned_samples}"
    if not start.steps:
        return "no steps"
    if len(start.steps) > MOST_STEPS or not all(map(_sound_step, start.steps)):
        return "a step that no sweep has"
    if [one.index for one in start.steps] != sorted({one.index for one in start.steps}):
        return "steps out of order"
    return ""


def _sound_step(step: Step) -> bool:
    return (
        step.direction in DIRECTIONS
        and step.index <= MOST_STEPS
        and 0 < step.frequency_hz <= FASTEST_HZ
        and 0 <= step.acceleration_m_s2 < math.inf
    )


def misfit(block: Block, before: Block | None, start: RunStart) -> str:
    """Why a block cannot follow another of its stream in a run."""
    if block.rate_hz != start.rate_hz:
        return "at another rate than the run's"
    if not len(block) or block.end > start.rate_hz * LONGEST_S:
        return "no samples, or after the end of any run"
    if block.stream == "meas" and block.channels != start.channels:
        return "with other channels than the run's"
    if before is not None and before.channels != block.channels:
        return "with other channels than before"
    if before is not None and block.index < before.end:
        return "samples that are there already"
    return ""


def mislabelled(blocks: Sequence[Block]) -> bool:
    """True where one of the blocks has a step, label or cycle that no drive has."""
    limits = {"step": (-1, MOST_STEPS), "label": (0, max(Label)), "cycle": (-1, MOST_CYCLES)}
    for name, (least, most) in limits.items():
        labels = np.concatenate([getattr(block, name) for block in blocks])
        if labels.size and (labels.min() < least or labels.max() > most):
            return True
    return False


def unsound(record: Record, start: RunStart) -> str:
    """Why a record cannot be in a run."""
    late = record.index > start.rate_hz * LONGEST_S
    return "after the end of any run" if late else _inconsistent(record)


def _uneven(record: Record) -> bool:
    """True where columns of a table are not equally long."""
    match record:
        case Comparison():
            columns = record.measured_ss, record.free_error_ss, record.window_error_ss
            return any(len(one) != len(record.channels) for one in columns)
        case Agreement():
            parts = record.error, record.band, record.flight, record.right, record.left
            return any(len(one) != len(record.channels) for one in parts)
        case Estimate():
            known = record.values, record.sd, record.drift, record.drift_sd
            return any(len(one) != len(record.names) for one in known)
        case Response():
            return not len(record.frequencies_hz) == len(record.gain) == len(record.phase_rad)
    return False


def _inconsistent(record: Record) -> str:
    if _uneven(record):
        return "of unequal lengths"
    match record:
        case Comparison():
            sums = record.measured_ss, record.free_error_ss, record.window_error_ss
            if any(one < 0 for some in sums for one in some):
                return "of squares below zero"
        case Cycle() | Level():
            if record.step > MOST_STEPS:
                return f"step = {record.step}"
        case Point() | Decided():
            if record.step > MOST_STEPS or record.direction not in DIRECTIONS:
                return f"step = {record.step}, direction = {record.direction[:20]!r}"
            if not 0 < record.frequency_hz <= FASTEST_HZ:
                return f"frequency_hz = {record.frequency_hz:g}"
        case Fault():
            if record.from_index > record.to_index:
                return "that ends before it begins"
    return ""
