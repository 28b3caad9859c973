"""A range of steps, as `--steps` says it."""

import re

from table_io.card import BadInput


def step_range(steps: str) -> tuple[int, int]:
    """(first, last) index of "FIRST:LAST" or of one step."""
    match = re.fullmatch(r"(\d{1,9})(?::(\d{1,9}))?", steps)
    first, last = (int(match[1]), int(match[2] or match[1])) if match else (1, 0)
    if last < first:
        raise BadInput(
            f"--steps {steps}: allowed: FIRST:LAST, both ends included, or one step, by `index` in "
            "summary.json, from 0; 12:20"
        )
    return first, last
