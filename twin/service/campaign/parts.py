"""The recordings of a run: what stands in them, whether it is whole, and where to go on."""

from pathlib import Path

from table_io.card import BadInput
from table_io.policies import policy_of
from table_io.profile import Profile
from twin.service import summary as summaries
from twin.service.campaign.card import Mode
from twin.service.campaign.state import Part, RunState, digest, locked
from twin.service.parts import LOCK, gather
from twin.service.recordings import recorded_bundle
from twin.service.report import write_report
from twin.service.summary import Json
from twin.stream.folder import PARTS
from twin.stream.recording import read

LOG = "run.mcap"


def finish(folder: Path) -> Json:
    """The summary of a run's recording, written with its report into the run's folder."""
    recording = read(folder / LOG)
    found = summaries.summarise(recording, recorded_bundle(recording).parameters)
    found["sha256"] = digest(recording.path)
    summaries.write(found, folder / "summary.json")
    write_report(folder, recording)
    return found


def told(part: Part, found: Json) -> Part:
    """The part with what its summary says."""
    return part.model_copy(
        update={
            "verdict": found["verdict"],
            "reason": found["reason"],
            "measured": tuple(step["index"] for step in found["steps"] if step["measured"]),
            "gaps": found["gaps"],
            "sha256": found["sha256"],
        }
    )


def settled(folder: Path, part: Part) -> Part:
    """A part whose end nobody saw, as its recording tells it; the recording stays as it is."""
    place = folder / part.folder
    if (place / PARTS).is_dir():
        with locked(place / PARTS / LOCK):
            pass  # the table is at rest, its recorder done
    try:
        if (place / PARTS).is_dir():
            gather(place)
        return told(part, finish(place))
    except BadInput as error:
        return part.model_copy(update={"verdict": "halted", "reason": f"nothing to read: {error}"})


def sound(folder: Path, part: Part) -> bool:
    """True where a part's recording is to the byte what was read when it had been played."""
    return not part.sha256 or digest(folder / part.folder / LOG) == part.sha256


def complete(run: RunState, profile: Profile) -> bool:
    """True where nothing is left to measure."""
    if run.parts and run.parts[-1].verdict == "complete":
        return True
    return policy_of(profile) is None and not missing(run, profile)


def missing(run: RunState, profile: Profile) -> list[int]:
    """Steps whose Point stands in no recording of a run."""
    measured = {step for part in run.parts for step in part.measured}
    return [step.index for step in profile.sweep.steps if step.index not in measured]


def first_step(run: RunState, profile: Profile, mode: Mode) -> int:
    """The step from which a run goes on."""
    left, steps = missing(run, profile), profile.sweep.steps
    if mode == "run" or not left or policy_of(profile) is not None:
        return 0  # a test that finds its way needs the results of all its steps
    if mode == "step":
        return left[0]
    return next(one.index for one in steps if one.direction == steps[left[0]].direction)


def part_folder(folder: Path, run: RunState) -> str:
    """The name of a new folder for a run: NN-label, then NN-label-2 and on."""
    number = len(run.parts) + 1
    while (folder / (name := run.name if number == 1 else f"{run.name}-{number}")).exists():
        number += 1
    return name
