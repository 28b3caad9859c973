"""The runs in a folder, at any depth: all of them, the newest first, and which one is the last."""

import json
import os
from collections.abc import Iterator
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from table_io.errors import InputError
from twin.recording.run_paths import PARTS_FOLDER

LOG_NAME = "run.mcap"
FIGURES_FOLDER = "figures"
LEFT_OUT_SUFFIX = ".foxglove.mcap"  # of an export, which is no log


def iter_runs(root: Path) -> Iterator[Path]:
    """Yield the folder of each run in or below a folder, and each single log; no hidden ones."""
    for path, folders, files in os.walk(root):
        if LOG_NAME in files or PARTS_FOLDER in folders:
            yield Path(path)
        for name in files:
            is_log = name.endswith(".mcap") and not name.endswith(LEFT_OUT_SUFFIX)
            if is_log and name != LOG_NAME and not name.startswith("."):
                yield Path(path, name)
        folders[:] = sorted(
            name
            for name in folders
            if not name.startswith(".") and name not in (FIGURES_FOLDER, PARTS_FOLDER)
        )


def find_run_folders(folder: Path) -> list[Path]:
    """Return the folders of runs in or below a folder, the newest recording first.

    The start of a run is in its summary, else in its recording; of one still recording or killed it
    is the last change of its files. A copied folder keeps its place that way.
    """
    runs = (run for run in iter_runs(folder) if run.suffix != ".mcap" or run.is_dir())
    return sorted(runs, key=_read_start, reverse=True)


def _read_start(run: Path) -> tuple[float, float]:
    """Return the start of a run and the last change of its recording, in s since 1970.

    The second orders runs that started within the same second.
    """
    changed_s = 0.0
    for name in (PARTS_FOLDER, LOG_NAME):
        with suppress(OSError):  # merged or moved since it was listed
            changed_s = (run / name).stat().st_mtime
    started_at = _read_run_info(run).get("started_at")
    if started_at is None and (run / LOG_NAME).is_file():
        from twin.recording.reader import read_start  # slow to import, and `runs` is quick

        with suppress(InputError, OSError):
            started_at = read_start(run / LOG_NAME).started_at
    return order_by_start(started_at, changed_s)


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
