"""Opening of recordings by log or run folder, and their recorded configuration."""

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from table_io.config.base import parse_toml
from table_io.config.excitation import History
from table_io.config.profile import Profile
from table_io.config.provenance import HashedFile, Provenance
from table_io.config.rig import RigConfig
from table_io.records import RunStart
from twin.recording.reader import Recording, read_recording
from twin.recording.run_paths import PARTS_FOLDER, explain_unmerged_parts, resolve_log_path
from twin.setup.run_config import RunConfig, from_texts, read_model
from twin.system.files import hash_file
from twin.system.terminal import error_console
from twin.system.versions import read_installed_versions


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


def build_provenance(starts: Mapping[Path, RunStart]) -> Provenance:
    """Return the provenance of what is identified from recordings, by the path of each."""
    profiles = [
        parse_toml(start.profile_toml, Profile, str(path)) for path, start in starts.items()
    ]
    rigs = [
        HashedFile.of_rig(parse_toml(start.rig_toml, RigConfig, str(path)))
        for path, start in starts.items()
    ]
    specimens = [profile.specimen for profile in profiles]
    levels = map(_find_level, starts.values(), profiles)
    return Provenance(
        rigs=tuple(dict.fromkeys(rigs)),
        masses_kg=tuple(sorted({specimen.mass_kg for specimen in specimens})),
        gaps_mm=tuple(sorted({1e3 * sum(specimen.gaps_m) for specimen in specimens})),
        levels_m_s2=tuple(sorted({level for level in levels if math.isfinite(level)})),
        sources=tuple(
            HashedFile(name=start.run, sha256=hash_file(path)) for path, start in starts.items()
        ),
        code=read_installed_versions()["shaketwin"],
    )


def _find_level(start: RunStart, profile: Profile) -> float:
    """Return the peak table acceleration that a test asks for in m/s2; NaN if it is not known."""
    if start.steps:
        return max(step.acceleration_m_s2 for step in start.steps)
    return profile.plan.level_m_s2 if isinstance(profile.excitation, History) else math.nan
