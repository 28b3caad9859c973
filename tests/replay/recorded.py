"""A recording in memory, as a replay wants it."""

from table_io.records import Comparison
from twin.service.replaying import Recorded
from twin.stream.recording import Recording
from twin.stream.wire import encode


def recorded_in(recording: Recording) -> Recorded:
    """Its comparisons as the bytes that stand in its log; so what was changed in memory is too."""
    compared = recording.of(Comparison)
    return Recorded(recording, {one.index: encode(one, recording.run) for one in compared})
