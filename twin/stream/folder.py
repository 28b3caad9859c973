"""Where in a run's folder its log is, or the parts of it that were not put together yet."""

from pathlib import Path

from table_io.card import BadInput

PARTS = ".parts"


def log_path(log: Path) -> Path:
    """The log itself, of a log or of a run's folder; BadInput where that holds parts only."""
    if why := apart(log):
        raise BadInput(why)
    return log / "run.mcap" if log.is_dir() else log


def apart(log: Path) -> str:
    """What to do where a run's folder holds the parts of a log and not the log itself, or ""."""
    if (log / "run.mcap").exists() or not (log / PARTS).is_dir():
        return ""
    return f"{log}: its recorder was killed: `shaketwin report {log}` puts it together"
