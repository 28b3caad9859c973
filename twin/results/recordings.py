"""Opening of recordings by log or run folder, and their recorded configuration."""

from dataclasses import replace
from pathlib import Path

from twin.recording.reader import Recording, read_recording
from twin.recording.run_paths import PARTS_FOLDER, explain_unmerged_parts, resolve_log_path
from twin.setup.run_config import RunConfig, from_texts, read_model
from twin.system.terminal import error_console


def list_parts(log: Path) -> list[Path]:
    """Return the log itself, the log of a run's folder, or the folder's unmerged parts."""
    parts = sorted((log / PARTS_FOLDER).glob("part-*.mcap")) if explain_unmerged_parts(log) else []
    return parts or [resolve_log_path(log)]


def open_recording(log: Path) -> Recording:
    """Read the recording of a log or a run's folder; warn if the file is damaged."""
    recording = read_recording(resolve_log_path(log))
    warn_if_damaged(recording)
    return recording


def warn_if_damaged(recording: Recording) -> None:
    """Print a warning if a recording is truncated or damaged."""
    if not recording.is_intact:
        end = (
            recording.contiguous_blocks("meas")[-1].end
            if recording.contiguous_blocks("meas")
            else 0
        )
        error_console.print(
            f"warning: {recording.path} is cut off or damaged; it is readable to sample {end}; "
            f"`shaketwin verify {recording.path}` lists what is lost",
            highlight=False,
            soft_wrap=True,
        )


def read_recorded_config(recording: Recording, model: str | None = None) -> RunConfig:
    """Return the `RunConfig` stored in a recording, optionally with another model."""
    start = recording.start
    model_toml = read_model(model, option="--model")[1] if model else start.model_toml
    config = from_texts(
        start.name, start.profile_toml, start.rig_toml, model_toml, str(recording.path)
    )
    # The steps of an imported recording were detected, not planned by the profile.
    return replace(config, drive=replace(config.drive, steps=start.steps))
