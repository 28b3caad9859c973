"""Argument LOG, DIR or RUN: a path, or `last` for the newest run."""

from pathlib import Path

LAST = "last"
LOG_HELP = "A run.mcap, the folder of a run, or `last`, the newest run here or in runs."


def parse_run_path(text: str) -> Path:
    """Parse a log or folder; `last` is the newest run here or in the folder runs.

    A file or folder of this name comes first.
    """
    path = Path(text)
    if text != LAST or path.exists():
        return path
    from twin.reports.run_index import find_last_run

    return find_last_run(Path())
