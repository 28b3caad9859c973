"""Task: the twin again on a recording, with its model or another one."""

from pathlib import Path

from table_io.errors import InputError
from twin.log import Log
from twin.recording.reader import Recording, read_start
from twin.recording.run_paths import resolve_log_path
from twin.recording.tabular import parse_step_range
from twin.replay.pipeline_replay import (
    RecordedRun,
    ReplayComparison,
    SampleRange,
    compute_deviation,
    replay_recording,
)
from twin.report.finalize import write_results
from twin.results import summary as summaries
from twin.results.contracts import ReplayResult
from twin.results.recordings import read_recorded_config, warn_if_damaged
from twin.results.rerun import DRIVE_CHANNEL
from twin.results.twin_verdict import list_failed_twins
from twin.setup.folders import make_run_folder
from twin.setup.run_config import RunConfig
from twin.setup.unpaced import Observe, ShownRun, observe_nothing
from twin.setup.warm_up import compile_kernels
from twin.system.versions import find_version_changes

RECORDED = "recorded"  # model name: the model stored in the log


class ReplayedLog(Log):
    """New log of a replay; `identity` compares it with the recorded one, `result` is its summary.

    `result` is the entry `replay` of summary.json.
    """

    def __init__(self, path: Path, identity: ReplayComparison, result: ReplayResult) -> None:
        super().__init__(path, read_start(path))
        self.identity = identity
        self.result = result


def replay(
    log: str | Path,
    out: str | Path | None = None,
    model: str | Path | None = None,
    steps: str | None = None,
    view: bool = False,
    observe: Observe = observe_nothing,
    in_blocks: bool = False,
) -> ReplayedLog:
    """Recompute the twin on a recording, with another `model` if given; return the new log.

    With the recorded model its results equal the recorded ones to the bit. Writes summary and
    report, with `view` view.rrd. `steps`: FIRST:LAST, all by default; `in_blocks`: in the blocks of
    the rig, as on the bus. InputError if the log cannot be read or lacks the table's acceleration.
    """
    recorded = open_replay_log(Path(log))
    recording = recorded.recording
    name = None if model is None else str(model)
    config = load_replay_config(recording, name)
    span = select_span(recording, steps)
    folder, run = make_run_folder(None if out is None else Path(out), f"{config.name}-replay")
    new_log = folder / "run.mcap"
    last = min(config.drive.planned_end, span.last)
    block_samples = recorded.start.block_samples if in_blocks else 0
    with observe(ShownRun(config, run, span.first, last)) as on_item:
        identity = replay_recording(recorded, config, new_log, run, on_item, span, block_samples)
    result = describe_replay(recorded, config, name, identity, new_log)
    write_results(folder, config, view, result)
    return ReplayedLog(new_log, identity, result)


def open_replay_log(log: Path) -> RecordedRun:
    """Open a log for replay; InputError if it lacks the channel that drives the twin."""
    recorded = RecordedRun.open(resolve_log_path(log))
    warn_if_damaged(recorded.recording)
    require_drive_channel(recorded.recording)
    return recorded


def require_drive_channel(recording: Recording) -> None:
    """Raise InputError if a recording lacks the channel that drives the twin."""
    channels = recording.start.channels
    if DRIVE_CHANNEL not in channels:
        raise InputError(
            f"not recorded, but it drives the twin; there: {', '.join(channels)}",
            where=recording.path,
            key=DRIVE_CHANNEL,
            remedy="import the table's acceleration too",
        )


def load_replay_config(recording: Recording, model: str | None) -> RunConfig:
    """Return the `RunConfig` of a recording, with `model` in place of the recorded one if given."""
    config = read_recorded_config(recording, None if model in (None, RECORDED) else model)
    compile_kernels(config)
    return config


def select_span(recording: Recording, steps: str | None) -> SampleRange:
    """Return the samples of the selected steps, all if `steps` is None."""
    if steps is None:
        return SampleRange.all_samples(recording)
    return SampleRange.of_steps(recording, *parse_step_range(steps))


def describe_replay(
    recorded: RecordedRun,
    config: RunConfig,
    model: str | None,
    identity: ReplayComparison,
    log: Path,
) -> ReplayResult:
    """Compare a replay with its recording."""
    recording = recorded.recording
    same = config.model_toml == recording.start.model_toml
    return ReplayResult(
        of=str(recording.path),
        run=recording.run,
        model=RECORDED if same else model,
        identical=identity.is_identical,
        beginning=identity.beginning or None,
        comparisons=identity.recorded,
        compared=identity.compared,
        differing=identity.differing,
        missing=identity.missing,
        unrecorded=identity.unrecorded,
        lost_with_twin=identity.lost_with_twin,
        hashes=identity.hashes,
        hashes_compared=identity.hashes_compared,
        hashes_differing=identity.hashes_differing,
        predictions_compared=identity.predictions_compared,
        predictions_differing=identity.predictions_differing,
        first_difference_index=identity.first_difference,
        largest_difference_of_error_sums=identity.largest,
        relative_difference=compute_deviation(recording.path, log) if identity.differs else {},
        versions_differing=find_version_changes(recording.start.versions),
        recorded_comparison=summaries.channel_nrmse(
            recording.comparisons,
            config.parameters,
            config.rig.channel_by_name,
            summaries.find_channel_noise(recording),
            list_failed_twins(recording),
        ),
    )
