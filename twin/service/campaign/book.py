"""A campaign under way: its plan and how far it has come, on disk before anything moves."""

import json
from dataclasses import dataclass
from pathlib import Path

from table_io.card import BadInput, Card
from table_io.clock import today
from table_io.profile import Resume, SetUp
from twin.service.bundle import run_id
from twin.service.campaign.card import Plan, Planned
from twin.service.campaign.parts import complete, first_step, part_folder, settled, sound, told
from twin.service.campaign.state import (
    STATE,
    Answer,
    Part,
    RunState,
    State,
    keep_cards,
    read_state,
    unchanged,
    write_state,
)
from twin.service.spec import Spec


@dataclass(slots=True)
class Book:
    """What a campaign has done and has left to do; every change is written at once."""

    folder: Path
    plan: Plan
    state: State
    resumed: bool = False

    def of(self, run: Planned) -> RunState:
        """How far a run has come."""
        return next(one for one in self.state.runs if one.name == run.name)

    def change(self, state: RunState, **changes: object) -> None:
        """Put a run's state in the place of what it was."""
        self.state = self.state.with_run(state.model_copy(update=changes))
        write_state(self.folder, self.state)

    def pending(self) -> list[Planned]:
        """The runs that are not complete, in order."""
        return [run for run in self.plan.runs if self.of(run).status != "complete"]

    def from_step(self, run: Planned) -> int:
        """The step at which a run begins, or goes on."""
        state = self.of(run)
        profile = run.bundle.profile
        return first_step(state, profile, self.plan.card.resume) if state.parts else 0

    def begin(self, run: Planned, answer: Answer, endpoint: str) -> Spec:
        """The next recording of a run, its folder made; nothing that is there is touched."""
        state, first = self.of(run), self.from_step(run)
        before = state.parts[-1].run if state.parts else ""
        name = part_folder(self.folder, state)
        part = Part(folder=name, run=run_id(name), first_step=first)
        self.change(
            state, status="running", parts=(*state.parts, part), set_up=(*state.set_up, answer)
        )
        (self.folder / name).mkdir()
        noted = SetUp(
            campaign=self.plan.card.title, label=run.label, notes=run.notes, **answer.model_dump()
        )
        cards: dict[str, Card] = {"set_up": noted}
        if first:
            cards["resume"] = Resume(first_step=first, of=before)
        bundle = run.bundle
        return Spec(
            part.run,
            bundle.name,
            str(self.folder / name),
            endpoint,
            appended(bundle.profile_toml, cards),
            bundle.rig_toml,
            bundle.model_toml,
        )

    def ended(self, run: Planned) -> bool:
        """Take in what the summary of a run's last recording says; True where it is complete."""
        state = self.of(run)
        found = json.loads((self.folder / state.parts[-1].folder / "summary.json").read_text())
        parts = (*state.parts[:-1], told(state.parts[-1], found))
        whole = complete(state.model_copy(update={"parts": parts}), run.bundle.profile)
        self.change(state, parts=parts, status="complete" if whole else "interrupted")
        return whole

    def lost(self, run: Planned, why: str) -> None:
        """Nobody could say how the last recording of a run ended; a resume reads it again."""
        state = self.of(run)
        part = state.parts[-1].model_copy(update={"reason": why})
        self.change(state, parts=(*state.parts[:-1], part), status="interrupted")

    def set_up(self, run: Planned) -> str:
        """The set-up that a run needs: its own prompt, or the last one before it."""
        asked = [one.prompt for one in self.plan.runs[: run.number] if one.prompt]
        return asked[-1] if asked else ""

    def never_began(self, run: Planned) -> None:
        """Forget a recording before whose start a person stopped it: nothing moved."""
        state = self.of(run)
        parts = state.parts[:-1]
        self.change(state, parts=parts, status="interrupted" if parts else "planned")

    def skipped(self, run: Planned, answer: Answer) -> None:
        state = self.of(run)
        self.change(state, set_up=(*state.set_up, answer), status="skipped")


def appended(profile_toml: str, cards: dict[str, Card]) -> str:
    """A profile's text with cards at its end. A JSON string is a TOML string, but for DEL."""
    lines = [profile_toml.rstrip("\n")]
    for name, card in cards.items():
        lines += ["", f"[{name}]"]
        for key, value in card.model_dump().items():
            text = json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
            lines.append(f"{key} = {text}")
    return "\n".join(lines) + "\n"


def begun(folder: Path, plan: Plan) -> Book:
    """A new campaign in a new folder."""
    keep_cards(folder, plan)
    runs = tuple(RunState(name=run.name, label=run.label) for run in plan.runs)
    state = State(title=plan.card.title, began=today().isoformat(timespec="seconds"), runs=runs)
    write_state(folder, state)
    return Book(folder, plan, state)


def reopened(folder: Path, plan: Plan) -> tuple[Book, list[str]]:
    """The campaign that began in a folder, its recordings read again; and what was found."""
    if not (folder / STATE).exists() and not any(folder.rglob("*.mcap")):
        if not (folder / "campaign.toml").exists():
            raise BadInput(f"--resume: no campaign began in {folder}; leave --resume away")
        return begun(folder, plan), []
    said = unchanged(folder, plan)
    book = Book(folder, plan, read_state(folder), resumed=True)
    for run in plan.runs:
        state = book.of(run)
        parts = [part if part.verdict else settled(folder, part) for part in state.parts]
        for place, part in enumerate(parts):
            if not sound(folder, part):
                parts[place] = part.model_copy(update={"measured": (), "verdict": "halted"})
                said.append(
                    f"{run.label}: {part.folder}/run.mcap is missing or not what was recorded; "
                    "what it held is measured anew, what is left of it is kept"
                )
        state = state.model_copy(update={"parts": tuple(parts)})
        whole = complete(state, run.bundle.profile)
        book.change(state, status="complete" if whole else "interrupted" if parts else "planned")
    return book, said
