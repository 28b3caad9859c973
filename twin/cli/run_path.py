"""Argument LOG, DIR or RUN: a path, or `last` for the newest run."""

import sys
from pathlib import Path

from table_io.errors import replace_escapes

LAST = "last"
LOG_HELP = "A run.mcap, the folder of a run, or `last`, the newest run here or in runs."
MEASURED_LOG_HELP = LOG_HELP.replace("newest run", "newest run that is no simulation,")


def parse_run_path(text: str) -> Path:
    """Parse a log or folder; `last` is the newest run here or in the folder runs.

    A file or folder of this name comes first.
    """
    return _find_run(text, measured=False)


def parse_measured_path(text: str) -> Path:
    """Parse a log or folder as `parse_run_path` does; `last` is no simulation."""
    return _find_run(text, measured=True)


def _find_run(text: str, *, measured: bool) -> Path:
    path = Path(text)
    if text != LAST or path.exists():
        return path
    from twin.report.run_index import find_last_run

    folder = find_last_run(Path(), measured=measured)
    print(replace_escapes(f"last: {folder}"), file=sys.stderr)  # standard output may be JSON
    return folder
