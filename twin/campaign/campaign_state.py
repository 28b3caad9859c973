"""A campaign in progress: its plan and its state, saved to disk before anything moves."""

import json
from dataclasses import dataclass
from pathlib import Path

from table_io.clock import local_datetime
from table_io.config.base import ConfigModel
from table_io.config.profile import ResumeConfig, SetUpConfirmation
from table_io.errors import InputError
from twin.campaign.config import CampaignPlan, PlannedRun
from twin.campaign.run_recordings import (
    first_step,
    is_complete,
    is_unaltered,
    new_part_folder,
    settle_part,
    with_summary,
)
from twin.campaign.state import (
    STATE_FILE,
    CampaignState,
    OperatorAnswer,
    RunPart,
    RunState,
    copy_configs,
    read_state,
    require_unchanged,
    write_state,
)
from twin.live.process_config import ProcessConfig
from twin.run.run_config import make_run_id


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
            bundle.rig_toml,
            bundle.model_toml,
        )

    def finish_recording(self, run: PlannedRun) -> bool:
        """Update a run from the summary of its last recording; return whether it is complete."""
        state = self.run_state(run)
        summary = json.loads((self.folder / state.parts[-1].folder / "summary.json").read_text())
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


def append_sections(profile_toml: str, sections: dict[str, ConfigModel]) -> str:
    """Return a profile's TOML text with sections appended.

    A JSON string is a valid TOML string, except for the control character DEL.
    """
    lines = [profile_toml.rstrip("\n")]
    for name, section in sections.items():
        lines += ["", f"[{name}]"]
        for key, value in section.model_dump().items():
            text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
            lines.append(f"{key} = {text}")
    return "\n".join(lines) + "\n"


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
