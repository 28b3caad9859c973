"""Drive file of `shaketwin table-drive`: the command by which a table follows one target.

Comments after #, a line `drive_mm`, then one value a line at the rate of the run. Two comments
state the target, so that the drive of one level is not played for another: a specimen with
clearance does not scale.
"""

import re

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError

HEADER, KEY = "drive_mm", "excitation.drive"
REMEDY = "compute it anew with `shaketwin table-drive`"
TARGET_PATTERN = re.compile(r"^# target_(peak|rms)_mm = (\S+)$", re.MULTILINE)
MAX_TARGET_ERROR = 1e-3  # relative, of peak and rms
MAX_REST_RATIO = 1e-3  # of the peak: largest command at the ends


def format_drive(command_m: Float1D, target_m: Float1D, comment: str) -> str:
    """Return the text of a drive file: command and target in m, (sample,) each."""
    lines = [f"# {line}" for line in comment.splitlines()]
    lines += [f"# target_{name}_mm = {1e3 * size:.9g}" for name, size in _measure(target_m).items()]
    return "\n".join([*lines, HEADER, *(f"{1e3 * value:.6f}" for value in command_m), ""])


def parse_drive(text: str, name: str, target_m: Float1D) -> Float1D:
    """Return the command in m of a drive file, (sample,).

    InputError if it is no drive, does not rest at its ends, or is that of another target than
    `target_m`, (sample,).
    """
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    try:
        command: Float1D = 1e-3 * np.array(lines[1:], dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{name}: {error}", key=KEY, remedy=REMEDY) from None
    if lines[:1] != [HEADER] or not command.any() or not np.isfinite(command).all():
        raise InputError(
            f"{name} is no drive",
            key=KEY,
            allowed=f"a line {HEADER}, then one finite number a line, not all 0",
            remedy=REMEDY,
        )
    if max(abs(command[0]), abs(command[-1])) > MAX_REST_RATIO * np.abs(command).max():
        raise InputError(f"{name} does not begin and end at rest", key=KEY, remedy=REMEDY)
    if command.size != target_m.size:
        raise InputError(
            f"{name}: {command.size} samples, the target has {target_m.size}",
            key=KEY,
            remedy=REMEDY,
        )
    stated = dict(TARGET_PATTERN.findall(text))
    for quantity, size in _measure(target_m).items():
        try:
            is_same = abs(1e-3 * float(stated[quantity]) / size - 1.0) <= MAX_TARGET_ERROR
        except (KeyError, ValueError):
            is_same = False
        if not is_same:
            raise InputError(
                f"{name} is of another target: its {quantity} is "
                f"{stated.get(quantity, 'unknown')} mm, here {1e3 * size:.6g} mm",
                key=KEY,
                remedy=REMEDY,
            )
    return command


def _measure(target_m: Float1D) -> dict[str, float]:
    """Return peak and rms of a target in m by name."""
    return {
        "peak": float(np.abs(target_m).max()),
        "rms": float(np.sqrt(np.mean(target_m**2))),
    }
