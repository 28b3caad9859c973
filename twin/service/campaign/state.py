"""What of a campaign is done, and where: campaign.json, replaced as a whole at every change."""

import difflib
import fcntl
import hashlib
import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from table_io.card import BadInput, Card
from table_io.clock import RealClock
from twin.service.bundle import Bundle
from twin.service.campaign.card import Plan

STATE, COPY, CARDS, LOCK = "campaign.json", "campaign.toml", "cards", ".lock"
RECORD = re.compile(r"^\[\[calibrations\]\].*\n?(?:(?!\[).+\n?|\n)*", re.MULTILINE)
WAIT_S = 20.0  # for what is left of a killed campaign: its players, its table, its recorder
Status = Literal["planned", "running", "complete", "interrupted", "skipped"]


class Part(Card):
    """One recording of a run, from step `first_step` on."""

    folder: str
    run: str
    first_step: int
    verdict: str = ""  # empty while it is played, and where nobody saw its end
    reason: str = ""
    measured: tuple[int, ...] = ()  # the steps whose Point stands in it
    gaps: int = 0
    sha256: str = ""  # of its run.mcap


class Answer(Card):
    """What the operator was asked before a run, and answered."""

    asked: str
    answer: Literal["done", "skipped", "unattended", "not asked"]
    who: str
    at: str


class RunState(Card):
    """How far a run has come."""

    name: str
    label: str
    status: Status = "planned"
    parts: tuple[Part, ...] = ()
    set_up: tuple[Answer, ...] = ()


class State(Card):
    """How far a campaign has come."""

    title: str
    began: str
    runs: tuple[RunState, ...]

    def with_run(self, run: RunState) -> "State":
        """The state with this run in the place of the one of its name."""
        runs = tuple(run if one.name == run.name else one for one in self.runs)
        return self.model_copy(update={"runs": runs})


def write_state(folder: Path, state: State) -> None:
    """Replace campaign.json; whoever reads it finds the old or the new one, whole."""
    new = folder / f"{STATE}.new"
    with new.open("w", encoding="utf-8") as file:
        file.write(state.model_dump_json(indent=1) + "\n")
        file.flush()
        os.fsync(file.fileno())
    new.replace(folder / STATE)


def read_state(folder: Path) -> State:
    """The state of the campaign in a folder; BadInput where there is none or it is damaged."""
    path = folder / STATE
    try:
        return State.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput(f"{path}: no campaign began in this folder; leave --resume away") from None
    except ValidationError as error:
        raise BadInput(f"{path}: damaged: {error}; mend it, or begin in a new folder") from None


@contextmanager
def locked(path: Path) -> Iterator[int]:
    """Hold a lock alone; who is given the descriptor holds it too.

    BadInput where another campaign, or what is left of a killed one, does not let it go.
    """
    clock = RealClock()
    until = clock.now() + WAIT_S
    with path.open("a") as lock:
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if clock.now() > until:
                    raise BadInput(
                        f"{path.parent}: a test is still going on in this folder; wait for its end"
                    ) from None
                clock.wait_until(clock.now() + 0.1)
        yield lock.fileno()


def texts(bundle: Bundle) -> dict[str, str]:
    """The cards of a run by the names of their files."""
    return {
        "profile.toml": bundle.profile_toml,
        "rig.toml": bundle.rig_toml,
        "model.toml": bundle.model_toml,
    }


def keep_cards(folder: Path, plan: Plan) -> None:
    """Copies of the campaign's file and of every card of its runs, as they are now."""
    (folder / COPY).write_text(plan.text, encoding="utf-8")
    for run in plan.runs:
        place = folder / CARDS / run.name
        place.mkdir(parents=True, exist_ok=True)
        for name, text in texts(run.bundle).items():
            (place / name).write_text(text, encoding="utf-8")


def unchanged(folder: Path, plan: Plan) -> list[str]:
    """BadInput that says what differs where a campaign is not the one that began here.

    Calibration records that came in between change nothing that is measured: they are told.
    """
    pairs = [(folder / COPY, plan.text, str(plan.path))]
    for run in plan.runs:
        place = folder / CARDS / run.name
        pairs += [
            (place / name, text, f"{name.removesuffix('.toml')} of {run.label}")
            for name, text in texts(run.bundle).items()
        ]
    changed, calibrated = [], []
    for path, text, what in pairs:
        before = path.read_text(encoding="utf-8") if path.is_file() else ""
        if before == text:
            continue
        if path.name == "rig.toml" and _without_records(before) == _without_records(text):
            calibrated.append(
                f"{what}: other calibration records than when it began; what is recorded from now "
                "on carries these"
            )
        else:
            changed += [f"  {what}:", *_lines(before, text)]
    if changed:
        raise BadInput(
            "\n".join(
                [
                    f"{folder}: what is to be resumed is not what began here (- then, + now):",
                    *changed,
                    "  give what it began with, or begin anew in another folder",
                ]
            )
        )
    return calibrated


def _without_records(text: str) -> str:
    """A machine card's text without its calibration records."""
    return RECORD.sub("", text).rstrip()


def _lines(before: str, now: str) -> list[str]:
    """The lines that differ, at most eight."""
    found = [
        f"    {line}"
        for line in difflib.unified_diff(before.splitlines(), now.splitlines(), lineterm="", n=0)
        if not line.startswith(("---", "+++", "@@"))
    ]
    return [*found[:8], f"    and {len(found) - 8} lines more"] if len(found) > 8 else found


def digest(path: Path) -> str:
    """SHA-256 of a file, empty where it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
