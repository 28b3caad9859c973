"""Parser of the option `--steps`, a range of steps."""

import re

from table_io.errors import InputError


def parse_step_range(steps: str) -> tuple[int, int]:
    """Return (first, last) step index of "FIRST:LAST" or of a single step."""
    match = re.fullmatch(r"(\d{1,9})(?::(\d{1,9}))?", steps)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if last < first:
        raise InputError(
            "not a range of steps",
            where=f"--steps {steps}",
            allowed="FIRST:LAST, both ends included, or one step, by `index` in summary.json "
            "(from 0), for example 12:20",
        )
    return first, last
