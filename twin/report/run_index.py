"""The folders of runs in a folder, newest first, and which one is the last."""

import json
from datetime import datetime
from pathlib import Path
from typing import Any

from table_io.errors import InputError
from twin.recording.run_paths import PARTS_FOLDER

LOG_NAME = "run.mcap"
# Below the folder itself: a run, a run of a campaign, and both in the default folder `runs`.
PLACES = ("", "*/", "*/*/", "runs/*/*/")


def find_run_folders(folder: Path) -> list[Path]:
    """Return the folders of runs in or below a folder, the newest recording first.

    The start of a run is in its summary; of one without, still recording or killed, it is the last
    change of its files. A copied folder keeps its place that way.
    """
    starts: dict[Path, tuple[float, float]] = {}
    for place in PLACES:
        for name in (LOG_NAME, PARTS_FOLDER):
            for path in folder.glob(f"{place}{name}"):
                if not any(part.startswith(".") for part in path.relative_to(folder).parts[:-1]):
                    starts.setdefault(path.parent, _read_start(path))
    return sorted(starts, key=lambda run: starts[run], reverse=True)


def _read_start(recording: Path) -> tuple[float, float]:
    """Return the start of a run and the last change of its recording, in s since 1970.

    The second orders runs that started within the same second.
    """
    try:
        changed_s = recording.stat().st_mtime
    except OSError:  # merged or moved since it was listed
        changed_s = 0.0
    return order_by_start(_read_run_info(recording.parent).get("started_at", ""), changed_s)


def order_by_start(started_at: object, changed_s: float) -> tuple[float, float]:
    """Return (start, last change) of a recording in s since 1970, by which runs are sorted.

    A start that is no date is the last change.
    """
    try:
        return datetime.fromisoformat(str(started_at)).timestamp(), changed_s
    except (ValueError, OverflowError):
        return changed_s, changed_s


def _read_run_info(folder: Path) -> dict[str, Any]:
    """Return the entry `run` of the summary of a run; {} if it cannot be read."""
    try:
        info = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["run"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}
    return info if isinstance(info, dict) else {}


def find_last_run(folder: Path, *, measured: bool = False) -> Path:
    """Return the folder of the newest run in or below a folder; InputError without one.

    With `measured`, no simulation: the model's own motion lacks no physics.
    """
    folders = find_run_folders(folder)
    if measured:
        folders = [run for run in folders if _read_run_info(run).get("source") != "model"]
    if not folders:
        raise InputError(
            f"no {'measured ' if measured else ''}run in this folder or in its folder runs",
            where=folder.resolve(),
            key="last",
            remedy="give the folder of a run, or change to the folder that holds the runs",
        )
    return folders[0]
