"""A recording in memory, as a replay wants it."""

from pathlib import Path

from table_io.records import Comparison
from twin.recording.reader import Recording, read_recording
from twin.replay.pipeline_replay import RecordedRun, ReplayComparison, SampleRange, replay_recording
from twin.setup.run_config import RunConfig
from twin.transport.codec import encode_item


def recorded_in(recording: Recording) -> RecordedRun:
    """Its comparisons as the bytes that stand in its log; so what was changed in memory is too."""
    compared = recording.records(Comparison)
    return RecordedRun(
        recording,
        {comparison.index: encode_item(comparison, recording.run) for comparison in compared},
    )


def again(
    recorded: RecordedRun,
    bundle: RunConfig,
    path: Path,
    span: SampleRange | None = None,
    cut: int = 0,
    run: str = "again",
) -> tuple[ReplayComparison, Recording]:
    """What a replay found, and the log that it wrote."""
    identity = replay_recording(recorded, bundle, path, run, lambda _: None, span, cut)
    return identity, read_recording(path)
