"""Recordings of a run: summaries, integrity check, and the step at which to continue."""

from pathlib import Path

from table_io.adaptive import make_policy
from table_io.config.profile import Profile
from table_io.errors import InputError
from twin.campaign.config import ResumeMode
from twin.campaign.state import RunPart, RunState, hash_file, hold_lock
from twin.recording.reader import read_recording
from twin.recording.run_paths import PARTS_FOLDER
from twin.reports import summary as summaries
from twin.reports.report import write_report
from twin.reports.summary import Json
from twin.run.merge_parts import LOCK_FILE, merge_run_parts
from twin.run.recordings import read_recorded_config

LOG_NAME = "run.mcap"


def write_summary_and_report(folder: Path) -> Json:
    """Write summary and report of a recording into the run's folder; return the summary."""
    recording = read_recording(folder / LOG_NAME)
    summary = summaries.summarise(recording, read_recorded_config(recording).parameters)
    summary["sha256"] = hash_file(recording.path)
    summaries.write_summary(summary, folder / "summary.json")
    write_report(folder, recording)
    return summary


def with_summary(part: RunPart, summary: Json) -> RunPart:
    """Return a copy of the part with verdict, measured steps and hash from its summary."""
    return part.model_copy(
        update={
            "verdict": summary["verdict"],
            "reason": summary["reason"],
            "measured": tuple(step["index"] for step in summary["steps"] if step["measured"]),
            "gaps": summary["gaps"],
            "sha256": summary["sha256"],
        }
    )


def settle_part(folder: Path, part: RunPart) -> RunPart:
    """Return an interrupted part with the verdict of its recording, which stays unchanged."""
    part_dir = folder / part.folder
    if (part_dir / PARTS_FOLDER).is_dir():
        with hold_lock(part_dir / PARTS_FOLDER / LOCK_FILE):
            pass  # wait until the table is at rest and its recorder has finished
    try:
        if (part_dir / PARTS_FOLDER).is_dir():
            merge_run_parts(part_dir)
        return with_summary(part, write_summary_and_report(part_dir))
    except InputError as error:
        return part.model_copy(update={"verdict": "halted", "reason": f"cannot be read: {error}"})


def is_unaltered(folder: Path, part: RunPart) -> bool:
    """Return whether a recording still has the SHA-256 stored after the run."""
    return not part.sha256 or hash_file(folder / part.folder / LOG_NAME) == part.sha256


def is_complete(run: RunState, profile: Profile) -> bool:
    """Return whether every step is measured."""
    if run.parts and run.parts[-1].verdict == "complete":
        return True
    return make_policy(profile) is None and not missing_steps(run, profile)


def missing_steps(run: RunState, profile: Profile) -> list[int]:
    """Return the indices of the steps that no recording of a run has measured."""
    measured = {step for part in run.parts for step in part.measured}
    return [step.index for step in profile.sweep.steps if step.index not in measured]


def first_step(run: RunState, profile: Profile, mode: ResumeMode) -> int:
    """Return the index of the step from which an interrupted run continues."""
    missing, steps = missing_steps(run, profile), profile.sweep.steps
    if mode == "run" or not missing or make_policy(profile) is not None:
        return 0  # an adaptive test needs the results of all its steps
    if mode == "step":
        return missing[0]
    return next(step.index for step in steps if step.direction == steps[missing[0]].direction)


def new_part_folder(folder: Path, run: RunState) -> str:
    """Return an unused folder name for a run: NN-label, then NN-label-2, -3, ..."""
    number = len(run.parts) + 1
    while (folder / (name := run.name if number == 1 else f"{run.name}-{number}")).exists():
        number += 1
    return name
