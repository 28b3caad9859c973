"""Recordings as a person names them, and what they were made with."""

from dataclasses import replace
from pathlib import Path

from rich.console import Console

from twin.service.bundle import Bundle, from_texts, read_model
from twin.stream.folder import PARTS, apart, log_path
from twin.stream.recording import Recording, read


def parts_of(log: Path) -> list[Path]:
    """The log of a run's folder, or the parts that its recorder left; or the log itself."""
    parts = sorted((log / PARTS).glob("part-*.mcap")) if apart(log) else []
    return parts or [log_path(log)]


def recording_of(log: Path) -> Recording:
    """The recording in a log or a run's folder; says so where the file is not whole."""
    recording = read(log_path(log))
    warned(recording)
    return recording


def warned(recording: Recording) -> None:
    """Says so where a file is not whole."""
    if not recording.whole:
        end = recording.pieces("meas")[-1].end if recording.pieces("meas") else 0
        Console(stderr=True).print(
            f"warning: {recording.path} is cut off or damaged; it is readable to sample {end}; "
            f"`shaketwin verify {recording.path}` says what is lost",
            highlight=False,
            soft_wrap=True,
        )


def recorded_bundle(recording: Recording, model: str | None = None) -> Bundle:
    """The bundle that a recording was made with, or with another model in it."""
    start = recording.start
    model_toml = read_model(model)[1] if model else start.model_toml
    bundle = from_texts(
        start.name, start.profile_toml, start.rig_toml, model_toml, str(recording.path)
    )
    # In an imported recording the steps are those that were found, not the profile's.
    return replace(bundle, drive=replace(bundle.drive, steps=start.steps))
