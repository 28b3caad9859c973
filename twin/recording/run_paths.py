"""Paths in a run's folder: the log, or the unmerged parts of an interrupted recording."""

from pathlib import Path

from table_io.errors import InputError

PARTS_FOLDER = ".parts"


def resolve_log_path(log: Path) -> Path:
    """Return the log file of a run's folder (or a log itself); raise InputError if unmerged."""
    if reason := explain_unmerged_parts(log):
        raise InputError(reason)
    return log / "run.mcap" if log.is_dir() else log


def explain_unmerged_parts(log: Path) -> str:
    """Return the remedy where a run's folder holds only unmerged parts of a log, else ""."""
    if (log / "run.mcap").exists() or not (log / PARTS_FOLDER).is_dir():
        return ""
    return f"{log}: its recorder was killed: `shaketwin report {log}` merges the parts"
