"""Relative deviation between the predictions of two recordings of one test."""

import math
from bisect import bisect_right
from pathlib import Path

import numpy as np

from table_io.block import Block
from twin.compare import TWIN_CHANNELS
from twin.recording.reader import read_recording
from twin.reports.summary import Json
from twin.transport.endpoint import PRED_TOPIC


def compute_deviation(old_path: Path, new_path: Path) -> Json:
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


def describe_deviation(shares: Json) -> str:
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
