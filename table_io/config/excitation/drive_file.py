"""Drive file of `shaketwin table-drive`: the command by which a table follows one target.

Comments after #, a line `drive_mm`, then one value a line at the rate of the run. Two comments
state the target, so that the drive of one level is not played for another: a specimen with
clearance does not scale. The last comments are TOML, from their line [provenance] on: what the
drive was computed for, and the response of the table that it relies on.
"""

import re

import numpy as np
import numpy.typing as npt
from pydantic import Field

from table_io.block import Float1D
from table_io.config.base import ConfigModel, Finite, Positive, format_toml, parse_toml
from table_io.config.provenance import Provenance, require_seal, seal_text
from table_io.errors import InputError

HEADER = "drive_mm"
DRIVE_KEY = "excitation.drive"
DRIVE_REMEDY = "compute it anew with `shaketwin table-drive`"
TARGET_PATTERN = re.compile(r"^# target_(peak|rms)_mm = (\S+)$", re.MULTILINE)
MAX_TARGET_ERROR = 1e-3  # relative, of peak and rms
MAX_REST_RATIO = 1e-3  # of the peak: largest command at the ends
MAX_MOTION_DIFFERENCE = 0.01  # relative, of frequency and level of the motions of two loop checks
HEADER_PATTERN = re.compile(r"^# \[provenance\]\n(#.*\n)*", re.MULTILINE)


class ExpectedResponse(ConfigModel):
    """Response of a table, acceleration over command, that a loop check is to measure, (motion,).

    At the level of the check: friction holds a table back that follows at that of the test.
    """

    frequencies_hz: tuple[Positive, ...] = Field(description="Of the held motions.")
    levels_m_s2: tuple[Positive, ...] = Field(description="Of their commands.")
    gain: tuple[Positive, ...] = Field(description="Of the fundamental of the acceleration.")
    phase_rad: tuple[Finite, ...] = Field(description="Negative where the table lags.")

    def find_tones(
        self, frequencies_hz: Float1D, levels_m_s2: Float1D
    ) -> npt.NDArray[np.complex128] | None:
        """Return gain and phase at held motions, complex (motion,); None of other motions."""
        asked = np.log(np.array([frequencies_hz, levels_m_s2]))
        known = np.log(np.array([self.frequencies_hz, self.levels_m_s2]))
        if asked.shape != known.shape or np.abs(asked - known).max() > MAX_MOTION_DIFFERENCE:
            return None
        return np.array(self.gain) * np.exp(1j * np.array(self.phase_rad))


class DriveHeader(ConfigModel):
    """TOML in the comments of a drive file."""

    provenance: Provenance = Field(description="What the drive was computed for and from.")
    response: ExpectedResponse | None = Field(None, description="By the twin of the table.")


def format_drive(command_m: Float1D, target_m: Float1D, comment: str, header: DriveHeader) -> str:
    """Return the text of a drive file: command and target in m, (sample,) each."""
    lines = [f"# {' '.join(comment.splitlines())}"]
    lines += [f"# target_{name}_mm = {1e3 * size:.9g}" for name, size in _measure(target_m).items()]
    toml = format_toml(header.model_dump(exclude_none=True))
    lines += [f"# {line}" for line in toml.splitlines() if line]
    return seal_text("\n".join([*lines, HEADER, *(f"{1e3 * value:.6f}" for value in command_m)]))


def parse_drive(text: str, name: str, target_m: Float1D) -> Float1D:
    """Return the command in m of a drive file, (sample,).

    InputError if it is no drive, does not rest at its ends, or is that of another target than
    `target_m`, (sample,).
    """
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    try:
        command: Float1D = 1e-3 * np.array(lines[1:], dtype=np.float64)
    except ValueError as error:
        raise InputError(f"{name}: {error}", key=DRIVE_KEY, remedy=DRIVE_REMEDY) from None
    if lines[:1] != [HEADER] or not command.any() or not np.isfinite(command).all():
        raise InputError(
            f"{name} is no drive",
            key=DRIVE_KEY,
            allowed=f"a line {HEADER}, then one finite number a line, not all 0",
            remedy=DRIVE_REMEDY,
        )
    if max(abs(command[0]), abs(command[-1])) > MAX_REST_RATIO * np.abs(command).max():
        raise InputError(
            f"{name} does not begin and end at rest", key=DRIVE_KEY, remedy=DRIVE_REMEDY
        )
    if command.size != target_m.size:
        raise InputError(
            f"{name}: {command.size} samples, the target has {target_m.size}",
            key=DRIVE_KEY,
            remedy=DRIVE_REMEDY,
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
                key=DRIVE_KEY,
                remedy=DRIVE_REMEDY,
            )
    try:
        require_seal(text, name, DRIVE_REMEDY)
    except InputError as error:
        raise error.replace(key=DRIVE_KEY) from None
    return command


def parse_drive_header(text: str, name: str) -> DriveHeader | None:
    """Return what a drive file was computed for; None if it does not say. InputError if faulty."""
    header = HEADER_PATTERN.search(text)
    if header is None:
        return None
    toml = "\n".join(line.removeprefix("#") for line in header[0].splitlines())
    return parse_toml(toml, DriveHeader, name)


def _measure(target_m: Float1D) -> dict[str, float]:
    """Return peak and rms of a target in m by name."""
    return {"peak": float(np.abs(target_m).max()), "rms": float(np.sqrt(np.mean(target_m**2)))}
