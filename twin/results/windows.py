"""Results of a displacement history by windows in time: peaks, rms, impacts and twin errors."""

from collections.abc import Callable

import numpy as np

from table_io.block import Block, Float1D
from table_io.channels import contact_forces, relative_displacement
from twin.compare.cycles import detect_onsets
from twin.recording.columns import ComparisonTable
from twin.recording.reader import Recording
from twin.results.contracts import ChannelError, MotionResult, PeakAndRms, WindowResult
from twin.results.rerun import restore_predictions

CompareChannels = Callable[[ComparisonTable], dict[str, ChannelError]]


def summarise_windows(
    recording: Recording, contact_n: float, compare: CompareChannels
) -> list[WindowResult]:
    """Return the results of each window that was played, SI; "twin" is the free-running one."""
    recording = restore_predictions(recording)
    measured, predicted = (recording.contiguous_blocks(name) for name in ("meas", "pred"))
    comparisons = recording.comparisons
    ends = comparisons.index + comparisons.count
    rate_hz = recording.start.rate_hz
    windows = []
    for number, (first, end) in find_windows(measured).items():
        inside = comparisons.select((first <= comparisons.index) & (ends <= end))
        blocks = cut_blocks(measured, first, end)
        twin_blocks = [extract_free_twin(block) for block in cut_blocks(predicted, first, end)]
        is_measured = recording.start.source == "table"
        windows.append(
            WindowResult(
                index=number,
                from_s=first / rate_hz,
                to_s=end / rate_hz,
                table_disp=_find_peak_and_rms(join_channel(blocks, "table_disp_m")),
                table_acc=_find_peak_and_rms(join_channel(blocks, "table_acc_m_s2")),
                measured=_describe_motion(blocks, contact_n) if is_measured else None,
                twin=_describe_motion(twin_blocks, contact_n),
                comparison=compare(inside),
            )
        )
    return windows


def find_windows(blocks: tuple[Block, ...]) -> dict[int, tuple[int, int]]:
    """Return the samples (first, end) of each window, by its number."""
    windows: dict[int, tuple[int, int]] = {}
    for block in blocks:
        is_played = block.is_history
        for number in np.unique(block.step[is_played]).tolist():
            samples = np.flatnonzero(is_played & (block.step == number)) + block.index
            first, _ = windows.get(number, (int(samples[0]), 0))
            windows[number] = first, int(samples[-1]) + 1
    return windows


def cut_blocks(blocks: tuple[Block, ...], first: int, end: int) -> list[Block]:
    """Return the parts of blocks that lie within samples first .. end - 1."""
    return [
        block.cut(max(first, block.index), min(end, block.end))
        for block in blocks
        if block.index < end and first < block.end
    ]


def extract_free_twin(block: Block) -> Block:
    """Return the free-running twin of a predicted block under the names of its channels."""
    names = tuple(name.removeprefix("free/") for name in block.channels)
    return Block(
        block.stream, block.index, block.rate_hz, names, block.values,
        block.step, block.label, block.cycle,
    )  # fmt: skip


def join_channel(blocks: list[Block], name: str) -> Float1D:
    """Return the samples of a channel, (sample,); NaN where the channel is missing."""
    parts = [
        block.channel(name) if name in block.channels else np.full(len(block), np.nan)
        for block in blocks
    ]
    return np.concatenate([np.empty(0), *parts])


def _find_peak_and_rms(values: Float1D) -> PeakAndRms:
    """Return the largest magnitude and the rms of the known samples; None if none is known."""
    known = values[np.isfinite(values)]
    if not known.size:
        return PeakAndRms(peak=None, rms=None)
    return PeakAndRms(peak=float(np.abs(known).max()), rms=float(np.sqrt(np.mean(known**2))))


def _describe_motion(blocks: list[Block], contact_n: float) -> MotionResult | None:
    """Return peak and rms of u, a and the contact forces, and the impacts on either side."""
    if not blocks:
        return None
    forces = [contact_forces(block) for block in blocks]
    right = np.concatenate([force for force, _ in forces])
    left = -np.concatenate([force for _, force in forces])
    return MotionResult(
        u=_find_peak_and_rms(np.concatenate([relative_displacement(block) for block in blocks])),
        a=_find_peak_and_rms(join_channel(blocks, "mass_acc_m_s2")),
        force_r=_find_peak_and_rms(right),
        force_l=_find_peak_and_rms(left),
        impacts_right=_count_impacts(right, contact_n),
        impacts_left=_count_impacts(left, contact_n),
    )


def _count_impacts(force: Float1D, contact_n: float) -> int | None:
    """Return the number of contacts that begin; None without samples of the force."""
    known = force[np.isfinite(force)]
    return len(detect_onsets(known, contact_n, None)[0]) if known.size else None
