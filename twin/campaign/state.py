"""State of a campaign: campaign.json, replaced atomically at every change."""

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

from table_io.clock import RealClock
from table_io.config.base import ConfigModel
from table_io.errors import InputError
from twin.campaign.config import CampaignPlan
from twin.run.run_config import RunConfig

STATE_FILE, CAMPAIGN_FILE, CONFIG_FOLDER, LOCK_FILE = (
    "campaign.json",
    "campaign.toml",
    "cards",
    ".lock",
)
CALIBRATION_RECORDS = re.compile(r"^\[\[calibrations\]\].*\n?(?:(?!\[).+\n?|\n)*", re.MULTILINE)
LOCK_TIMEOUT_S = 20.0  # until the processes of a killed campaign have ended
Status = Literal["planned", "running", "complete", "interrupted", "skipped"]


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
    answer: Literal["done", "skipped", "unattended", "not asked"]
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
    new = folder / f"{STATE_FILE}.new"
    with new.open("w", encoding="utf-8") as file:
        file.write(state.model_dump_json(indent=1) + "\n")
        file.flush()
        os.fsync(file.fileno())
    new.replace(folder / STATE_FILE)


def read_state(folder: Path) -> CampaignState:
    """Return the state of the campaign in a folder; InputError if it is missing or damaged."""
    path = folder / STATE_FILE
    try:
        return CampaignState.model_validate_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(
            "no campaign to resume in this folder",
            where=path,
            remedy="omit --resume to start one",
        ) from None
    except ValidationError as error:
        raise InputError(
            f"damaged: {error}",
            where=path,
            remedy="repair it, or start a campaign in a new folder",
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
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
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

    Calibration records added since the start change no measurement and give only a warning.
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
                f"{title}: the calibration records have changed since the campaign started; new "
                "recordings carry the new ones"
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
    """Return the text of a rig config without its calibration records."""
    return CALIBRATION_RECORDS.sub("", text).rstrip()


def _diff_lines(before: str, after: str) -> list[str]:
    """Return the lines that differ, at most eight."""
    lines = [
        f"    {line}"
        for line in difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=0)
        if not line.startswith(("---", "+++", "@@"))
    ]
    return [*lines[:8], f"    and {len(lines) - 8} more lines"] if len(lines) > 8 else lines


def hash_file(path: Path) -> str:
    """Return the SHA-256 of a file; empty if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError:
        return ""
