"""Drives seen by their parts, and commands in closed form."""

import numpy as np

from table_io.block import Float1D
from table_io.excitation.drive import Drive, HistorySegment, Segment


def sine_segments(drive: Drive) -> list[Segment]:
    """Return the segments of a drive that has no displacement history, as sines."""
    segments: list[Segment] = []
    for segment in drive.segments:
        assert not isinstance(segment, HistorySegment)
        segments.append(segment)
    return segments


def sine_segment_at(drive: Drive, index: int) -> Segment:
    """Return the sine in which a sample lies."""
    segment = drive.segment_at(index)
    assert not isinstance(segment, HistorySegment)
    return segment


def make_bump(height: float, count: int) -> Float1D:
    """Return a smooth motion away from 0 and back, (count,), still at both ends."""
    x = np.clip(np.arange(count) / (count - 2), 0.0, 1.0)
    return height * 64.0 * (x * (1.0 - x)) ** 3


def make_rise(height: float, count: int) -> Float1D:
    """Return a smooth motion from 0 to `height`, (count,), still at both ends."""
    x = np.clip(np.arange(count) / (count - 2), 0.0, 1.0)
    return height * x**3 * (10.0 + x * (-15.0 + 6.0 * x))
