"""The segments of a drive that has no displacement history, as sines."""

from table_io.excitation.drive import Drive, HistorySegment, Segment


def sine_segments(drive: Drive) -> list[Segment]:
    segments: list[Segment] = []
    for segment in drive.segments:
        assert not isinstance(segment, HistorySegment)
        segments.append(segment)
    return segments


def sine_segment_at(drive: Drive, index: int) -> Segment:
    segment = drive.segment_at(index)
    assert not isinstance(segment, HistorySegment)
    return segment
