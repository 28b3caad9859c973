"""State of a campaign: campaign.json, replaced atomically at every change, and its recordings."""

import difflib
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from table_io.adaptive.policy import make_policy
from table_io.clock import RealClock, local_datetime
from table_io.config.base import ConfigModel, format_toml
from table_io.config.profile import Profile, ResumeConfig, SetUpConfirmation
from table_io.config.rig_file import load_rig
from table_io.errors import InputError
from twin.campaign import STATE_FILE
from twin.campaign.config import CampaignPlan, PlannedRun, ResumeMode
from twin.live.process_config import ProcessConfig
from twin.recording.merge import LOCK_FILE as PARTS_LOCK_FILE
from twin.recording.merge import merge_run_parts
from twin.recording.reader import read_recording
from twin.recording.run_paths import PARTS_FOLDER
from twin.report.report import write_report
from twin.results.contracts import RunSummary
from twin.results.recordings import read_recorded_config
from twin.results.summary import summarise
from twin.setup.run_config import RunConfig, make_run_id
from twin.system.files import hash_file, lock_file, replace_text

CAMPAIGN_FILE, CONFIG_FOLDER, LOCK_FILE = "campaign.toml", "cards", ".lock"
RIG_RECORDS = re.compile(r"^\[(?:\[calibrations\]|tare)\].*\n?(?:(?!\[).+\n?|\n)*", re.MULTILINE)
LOCK_TIMEOUT_S = 20.0  # until the processes of a killed campaign have ended
Status = Literal["planned", "running", "complete", "interrupted", "skipped"]
Reply = Literal["done", "skipped", "unattended", "not asked"]
LOG_NAME = "run.mcap"


class RunPart(ConfigModel):
    """One recording of a run, from step `first_step` on."""

    folder: str
    run: str
    first_step: int
    verdict: str = ""  # empty during the run, and after a crash
    reason: str = ""
    measured: tuple[int, ...] = ()  # indices of the steps with a PRC point
    gaps: int = 0
    sha256: str = ""  # of its run.mcap


class OperatorAnswer(ConfigModel):
    """Set-up prompt before a run, with the operator's answer."""

    asked: str
    answer: Reply
    who: str
    at: str


class RunState(ConfigModel):
    """Status and recordings of a run."""

    name: str
    label: str
    status: Status = "planned"
    parts: tuple[RunPart, ...] = ()
    set_up: tuple[OperatorAnswer, ...] = ()


class CampaignState(ConfigModel):
    """Status of all runs of a campaign."""

    title: str
    began: str
    runs: tuple[RunState, ...]

    def with_run(self, run: RunState) -> "CampaignState":
        """Return a copy in which this run replaces the run of the same name."""
        runs = tuple(run if other.name == run.name else other for other in self.runs)
        return self.model_copy(update={"runs": runs})


def write_state(folder: Path, state: CampaignState) -> None:
    """Replace campaign.json atomically: a reader sees the old or the new file, never a part."""
    replace_text(folder / STATE_FILE, state.model_dump_json(indent=1) + "\n")


def read_state(folder: Path) -> CampaignState:
    """Return the state of the campaign in a folder; InputError if it is missing or damaged."""
    path = folder / STATE_FILE
    try:
        return CampaignState.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            "no campaign to resume in this folder", where=path, remedy="omit --resume to start one"
        ) from None
    except ValidationError as error:
        raise InputError(
            f"damaged: {error}", where=path, remedy="repair it, or start a campaign in a new folder"
        ) from None


@contextmanager
def hold_lock(path: Path) -> Iterator[int]:
    """Hold an exclusive file lock; yield its descriptor, which child processes may inherit.

    InputError if another process, perhaps of a killed campaign, keeps it for `LOCK_TIMEOUT_S`.
    """
    clock = RealClock()
    until = clock.now() + LOCK_TIMEOUT_S
    with path.open("a") as lock:
        while True:
            try:
                lock_file(lock, exclusive=True)
                break
            except BlockingIOError:
                if clock.now() > until:
                    raise InputError(
                        "a test is still running in this folder",
                        where=path.parent,
                        remedy="wait until it has ended",
                    ) from None
                clock.wait_until(clock.now() + 0.1)
        yield lock.fileno()


def config_texts(bundle: RunConfig) -> dict[str, str]:
    """Return the configuration texts of a run by file name."""
    return {
        "profile.toml": bundle.profile_toml,
        "rig.toml": bundle.rig_toml,
        "model.toml": bundle.model_toml,
    }


def copy_configs(folder: Path, plan: CampaignPlan) -> None:
    """Copy the campaign file and the configs of its runs into the campaign's folder."""
    (folder / CAMPAIGN_FILE).write_text(plan.text, encoding="utf-8")
    for run in plan.runs:
        config_dir = folder / CONFIG_FOLDER / run.name
        config_dir.mkdir(parents=True, exist_ok=True)
        for name, text in config_texts(run.bundle).items():
            (config_dir / name).write_text(text, encoding="utf-8")


def require_unchanged(folder: Path, plan: CampaignPlan) -> list[str]:
    """Raise InputError with the differences if the plan is not that of the folder; return warnings.

    Calibration records and tares added since the start are those of new recordings and give only a
    warning.
    """
    pairs = [(folder / CAMPAIGN_FILE, plan.text, str(plan.path))]
    for run in plan.runs:
        config_dir = folder / CONFIG_FOLDER / run.name
        pairs += [
            (config_dir / name, text, f"{name.removesuffix('.toml')} of {run.label}")
            for name, text in config_texts(run.bundle).items()
        ]
    changed, notes = [], []
    for path, text, title in pairs:
        before = path.read_text(encoding="utf-8") if path.is_file() else ""
        if before == text:
            continue
        if path.name == "rig.toml" and _without_records(before) == _without_records(text):
            notes.append(
                f"{title}: calibration records or tares have changed since the campaign started; "
                "new recordings carry the new ones"
            )
        else:
            changed += [f"  {title}:", *_diff_lines(before, text)]
    if changed:
        raise InputError(
            "\n".join(
                [
                    "the campaign has changed since it started here (- start, + now):",
                    *changed,
                    "  restore the original files, or start a new campaign in another folder",
                ]
            ),
            where=folder,
        )
    return notes


def _without_records(text: str) -> str:
    """Return the text of a rig config without its calibration records and tare."""
    return RIG_RECORDS.sub("", text).rstrip()


def _diff_lines(before: str, after: str) -> list[str]:
    """Return the lines that differ, at most eight."""
    lines = [
        f"    {line}"
        for line in difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=0)
        if not line.startswith(("---", "+++", "@@"))
    ]
    return [*lines[:8], f"    and {len(lines) - 8} more lines"] if len(lines) > 8 else lines


@dataclass(slots=True)
class ActiveCampaign:
    """Plan and state of a campaign; every change is saved to campaign.json immediately."""

    folder: Path
    plan: CampaignPlan
    state: CampaignState
    resumed: bool = False

    def run_state(self, run: PlannedRun) -> RunState:
        """Return the saved state of a run."""
        return next(state for state in self.state.runs if state.name == run.name)

    def update_run(self, state: RunState, **changes: object) -> None:
        """Replace a run's state with a changed copy and save it."""
        self.state = self.state.with_run(state.model_copy(update=changes))
        write_state(self.folder, self.state)

    def pending_runs(self) -> list[PlannedRun]:
        """Return the runs that are not complete, in order."""
        return [run for run in self.plan.runs if self.run_state(run).status != "complete"]

    def starting_step(self, run: PlannedRun) -> int:
        """Return the index of the step at which a run begins or continues."""
        state = self.run_state(run)
        profile = run.bundle.profile
        return first_step(state, profile, self.plan.config.resume) if state.parts else 0

    def begin_recording(
        self, run: PlannedRun, answer: OperatorAnswer, endpoint: str
    ) -> ProcessConfig:
        """Register the next recording of a run, make its folder, return its process config."""
        state, first = self.run_state(run), self.starting_step(run)
        before = state.parts[-1].run if state.parts else ""
        name = new_part_folder(self.folder, state)
        part = RunPart(folder=name, run=make_run_id(name), first_step=first)
        self.update_run(
            state, status="running", parts=(*state.parts, part), set_up=(*state.set_up, answer)
        )
        (self.folder / name).mkdir()
        set_up = SetUpConfirmation(
            campaign=self.plan.config.title, label=run.label, notes=run.notes, **answer.model_dump()
        )
        sections: dict[str, ConfigModel] = {"set_up": set_up}
        if first:
            sections["resume"] = ResumeConfig(first_step=first, of=before)
        bundle = run.bundle
        return ProcessConfig(
            part.run,
            bundle.name,
            str(self.folder / name),
            endpoint,
            append_sections(bundle.profile_toml, sections),
            _read_newest_tare(bundle),
            bundle.model_toml,
        )

    def finish_recording(self, run: PlannedRun) -> bool:
        """Update a run from the summary of its last recording; return whether it is complete."""
        state = self.run_state(run)
        summary = RunSummary.read(
            self.folder / state.parts[-1].folder / "summary.json", "resume the campaign"
        )
        parts = (*state.parts[:-1], with_summary(state.parts[-1], summary))
        all_measured = is_complete(state.model_copy(update={"parts": parts}), run.bundle.profile)
        self.update_run(state, parts=parts, status="complete" if all_measured else "interrupted")
        return all_measured

    def mark_unreadable(self, run: PlannedRun, reason: str) -> None:
        """Mark the last recording of a run as unreadable; `resume_campaign` reads it again."""
        state = self.run_state(run)
        part = state.parts[-1].model_copy(update={"reason": reason})
        self.update_run(state, parts=(*state.parts[:-1], part), status="interrupted")

    def required_set_up(self, run: PlannedRun) -> str:
        """Return the prompt of the set-up that a run needs: its own, or the last one before it."""
        prompts = [planned.prompt for planned in self.plan.runs[: run.number] if planned.prompt]
        return prompts[-1] if prompts else ""

    def discard_recording(self, run: PlannedRun) -> None:
        """Remove the last recording of a run that was cancelled before its start."""
        state = self.run_state(run)
        parts = state.parts[:-1]
        self.update_run(state, parts=parts, status="interrupted" if parts else "planned")

    def skip_run(self, run: PlannedRun, answer: OperatorAnswer) -> None:
        """Mark a run as skipped by the operator."""
        state = self.run_state(run)
        self.update_run(state, set_up=(*state.set_up, answer), status="skipped")


def _read_newest_tare(bundle: RunConfig) -> str:
    """Return the rig text of a run with the records that its file has by now.

    A tare at the prompt before a run is used by that run. A rig file that was edited is not.
    """
    if bundle.rig_file is None or not bundle.rig_file.is_file():
        return bundle.rig_toml
    text = load_rig(bundle.rig_file)[1]
    is_same = _without_records(text) == _without_records(bundle.rig_toml)
    return text if is_same else bundle.rig_toml


def append_sections(profile_toml: str, sections: dict[str, ConfigModel]) -> str:
    """Return a profile's TOML text with sections appended."""
    tables = {name: section.model_dump() for name, section in sections.items()}
    return profile_toml.rstrip("\n") + "\n" + format_toml(tables)


def begin_campaign(folder: Path, plan: CampaignPlan) -> ActiveCampaign:
    """Start a new campaign in a new folder: copy its configs and save the first state."""
    copy_configs(folder, plan)
    runs = tuple(RunState(name=run.name, label=run.label) for run in plan.runs)
    state = CampaignState(
        title=plan.config.title, began=local_datetime().isoformat(timespec="seconds"), runs=runs
    )
    write_state(folder, state)
    return ActiveCampaign(folder, plan, state)


def resume_campaign(folder: Path, plan: CampaignPlan) -> tuple[ActiveCampaign, list[str]]:
    """Return the campaign of a folder, checked against its recordings, and warnings."""
    if not (folder / STATE_FILE).exists() and not any(folder.rglob("*.mcap")):
        if not (folder / "campaign.toml").exists():
            raise InputError(
                "no campaign to resume in this folder",
                where=folder,
                remedy="omit --resume to start one",
            )
        return begin_campaign(folder, plan), []
    warnings = require_unchanged(folder, plan)
    campaign = ActiveCampaign(folder, plan, read_state(folder), resumed=True)
    for run in plan.runs:
        state = campaign.run_state(run)
        parts = [part if part.verdict else settle_part(folder, part) for part in state.parts]
        for index, part in enumerate(parts):
            if not is_unaltered(folder, part):
                parts[index] = part.model_copy(update={"measured": (), "verdict": "halted"})
                warnings.append(
                    f"{run.label}: {part.folder}/run.mcap is missing or was changed after the "
                    "recording; its steps are measured again, the file is kept"
                )
        state = state.model_copy(update={"parts": tuple(parts)})
        all_measured = is_complete(state, run.bundle.profile)
        campaign.update_run(
            state, status="complete" if all_measured else "interrupted" if parts else "planned"
        )
    return campaign, warnings


def write_summary_and_report(folder: Path) -> RunSummary:
    """Write summary and report of a recording into the run's folder; return the summary."""
    recording = read_recording(folder / LOG_NAME)
    summary = summarise(recording, read_recorded_config(recording).parameters)
    summary.sha256 = hash_file(recording.path)
    summary.write(folder / "summary.json")
    write_report(folder, recording)
    return summary


def read_part_summaries(folder: Path, run: RunState) -> list[RunSummary | None]:
    """Return the summary of each recording of a run; None if there is none yet."""
    summaries: list[RunSummary | None] = []
    for part in run.parts:
        try:
            path = folder / part.folder / "summary.json"
            summaries.append(RunSummary.read(path, "resume the campaign"))
        except InputError:
            summaries.append(None)
    return summaries


def with_summary(part: RunPart, summary: RunSummary) -> RunPart:
    """Return a copy of the part with verdict, measured steps and hash from its summary."""
    return part.model_copy(
        update={
            "verdict": summary.verdict,
            "reason": summary.reason,
            "measured": tuple(step.index for step in summary.steps if step.measured),
            "gaps": summary.gaps,
            "sha256": summary.sha256,
        }
    )


def settle_part(folder: Path, part: RunPart) -> RunPart:
    """Return an interrupted part with the verdict of its recording, which stays unchanged."""
    part_dir = folder / part.folder
    if (part_dir / PARTS_FOLDER).is_dir():
        with hold_lock(part_dir / PARTS_FOLDER / PARTS_LOCK_FILE):
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
    """Return whether every step is measured, or the whole history is played."""
    if run.parts and run.parts[-1].verdict == "complete":
        return True
    if not profile.steps:
        return False
    return make_policy(profile) is None and not missing_steps(run, profile)


def missing_steps(run: RunState, profile: Profile) -> list[int]:
    """Return the indices of the steps that no recording of a run has measured."""
    measured = {step for part in run.parts for step in part.measured}
    return [step.index for step in profile.steps if step.index not in measured]


def first_step(run: RunState, profile: Profile, mode: ResumeMode) -> int:
    """Return the index of the step from which an interrupted run continues."""
    missing, steps = missing_steps(run, profile), profile.steps
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
