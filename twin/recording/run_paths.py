"""Paths in a run's folder: the log, or the unmerged parts of an interrupted recording."""

from pathlib import Path

from table_io.errors import InputError

PARTS_FOLDER = ".parts"


def resolve_log_path(log: Path) -> Path:
    """Return the log of a run's folder, or a log itself.

    Raises InputError for a folder without a log, or with unmerged parts of one.
    """
    if reason := explain_unmerged_parts(log):
        raise InputError(reason)
    if not log.is_dir():
        return log
    if not (log / "run.mcap").exists():
        raise InputError(
            "no recording (run.mcap) in this folder",
            where=log,
            remedy="give the folder of a run, or its run.mcap",
        )
    return log / "run.mcap"


def explain_unmerged_parts(log: Path) -> str:
    """Return the remedy where a run's folder holds only unmerged parts of a log, else ""."""
    if (log / "run.mcap").exists() or not (log / PARTS_FOLDER).is_dir():
        return ""
    return f"{log}: its recorder was killed: `shaketwin report {log}` merges the parts"
