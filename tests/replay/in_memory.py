"""A recording in memory, as a replay wants it."""

from table_io.records import Comparison
from twin.recording.reader import Recording
from twin.replay.pipeline_replay import RecordedRun
from twin.transport.codec import encode_item


def recorded_in(recording: Recording) -> RecordedRun:
    """Its comparisons as the bytes that stand in its log; so what was changed in memory is too."""
    compared = recording.records(Comparison)
    return RecordedRun(
        recording,
        {comparison.index: encode_item(comparison, recording.run) for comparison in compared},
    )
