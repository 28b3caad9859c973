"""Record: a displacement history from a CSV file, such as the displacement of an earthquake.

The file has a line of headers, `time_s` and one displacement whose name ends with its unit
(`disp_mm`), uniform sampling, and comments after #. It is scaled and resampled to the rate of the
rig by band-limited interpolation. Its first and last samples need not be at rest: quintic blends
before and after them, continuous in value and velocity, lead from rest and to rest.
"""

import math
from functools import cached_property
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D
from table_io.config.base import Finite, Number
from table_io.config.excitation import History, register_excitation
from table_io.errors import InputError

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
MIN_SAMPLES, MAX_SAMPLES = 16, 1_000_000
MAX_JITTER = 0.01  # of the sampling interval; the times of a file are rounded
KERNEL_HALF_WIDTH = 32  # samples, of the interpolation
# Of its Kaiser window: images are 140 dB below the signal, because the acceleration amplifies them;
# the pass band ends at 0.42 of the lower rate.
KERNEL_BETA = 14.0


@register_excitation("record")
class RecordedHistory(History):
    """Displacement history read from a file."""

    FILE_KEYS: ClassVar[tuple[str, ...]] = ("file", *History.FILE_KEYS)

    unit: Literal["m", "cm", "mm", "in"] | None = Field(None, description="Omitted: of the header.")
    scale: Finite = Field(1.0, description="Factor on the displacement; negative turns it around.")
    blend_s: Number = Field(1.0, ge=0.1, le=60, description="From rest to the record, and back.")
    file: str = Field(
        description="CSV file next to the profile with `time_s` and one displacement."
    )

    @field_validator("scale")
    @classmethod
    def _check_scale(cls, scale: float) -> float:
        if scale == 0.0:
            raise InputError("scale is 0, so nothing would move", allowed="any other number")
        return scale

    @field_validator("file")
    @classmethod
    def _check_file(cls, name: str, info: ValidationInfo) -> str:
        files = info.data.get("files")
        if files is None:
            return name
        if name not in files:
            raise InputError(f"{name!r} is not attached", remedy="load the profile from its file")
        if "unit" in info.data:
            parse_history(files[name], name, info.data["unit"])
        return name

    @cached_property
    def samples(self) -> tuple[Float1D, float]:
        """Displacement in m, unscaled, (sample,), and sampling rate in Hz of the file."""
        return parse_history(self.files[self.file], self.file, self.unit)

    def displacement(self, rate_hz: float) -> Float1D:
        """Return blend, scaled record and blend in m at a sampling rate, (sample,)."""
        history, file_rate_hz = self.samples
        blended = _add_blends(self.scale * history, round(self.blend_s * file_rate_hz))
        return resample(blended, file_rate_hz, rate_hz)


def parse_history(text: str, name: str, unit: str | None) -> tuple[Float1D, float]:
    """Parse a CSV text: return (displacement in m, (sample,), sampling rate in Hz).

    ValueError names the line at fault.
    """
    numbered = [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    columns = [column.strip() for column in numbered[0][1].split(",")] if numbered else []
    if len(columns) != 2 or columns[0] != "time_s":
        raise InputError(
            f"{name}: the headers are {', '.join(columns) or 'missing'}",
            allowed="time_s and one displacement, such as time_s,disp_mm",
        )
    factor = _find_unit(columns[1], name, unit)
    rows = numbered[1:]
    if not MIN_SAMPLES <= len(rows) <= MAX_SAMPLES:
        raise InputError(f"{name}: {len(rows)} samples", allowed=f"{MIN_SAMPLES} to {MAX_SAMPLES}")
    table = np.array([_parse_row(name, number, line) for number, line in rows])
    time_s, displacement = table.T
    intervals = np.diff(time_s)
    interval_s = float(time_s[-1] - time_s[0]) / (time_s.size - 1)
    for problem, at_fault in (
        ("time_s does not increase", intervals <= 0.0),
        (
            f"the sampling is not uniform: {interval_s:.6g} s on average",
            np.abs(intervals - interval_s) > MAX_JITTER * abs(interval_s),
        ),
    ):
        if at_fault.any():
            raise ValueError(f"{name} line {rows[int(np.argmax(at_fault)) + 1][0]}: {problem}")
    return factor * displacement, 1.0 / interval_s


def _find_unit(column: str, name: str, unit: str | None) -> float:
    """Return m per unit of a column, by the end of its name or as stated; ValueError if unclear."""
    suffix = column.rpartition("_")[2]
    named = suffix if suffix in UNITS_M and "_" in column else None
    if unit is not None and named is not None and unit != named:
        raise InputError(
            f"{name}: unit = {unit!r}, but its column is {column}", remedy="remove the unit"
        )
    if unit is None and named is None:
        raise InputError(
            f"{name}: the unit of column {column!r} is unknown",
            remedy=(
                f"set unit, allowed: {', '.join(UNITS_M)}, or end the name with it, such as disp_mm"
            ),
        )
    return UNITS_M[unit or named or "m"]


def _parse_row(name: str, number: int, line: str) -> tuple[float, float]:
    try:
        time_s, displacement = map(float, line.split(","))
    except ValueError:
        raise ValueError(f"{name} line {number}: {line[:40]!r} is not two numbers") from None
    if not (math.isfinite(time_s) and math.isfinite(displacement)):
        raise ValueError(f"{name} line {number}: {line[:40]!r} is not finite")
    return time_s, displacement


def _add_blends(history: Float1D, count: int) -> Float1D:
    """Return a history with a quintic blend of `count` samples from rest before it, and after."""
    start = _blend_from_rest(history[:3], count)
    end = _blend_from_rest(history[:-4:-1], count)[::-1]
    rest = np.zeros(KERNEL_HALF_WIDTH)
    return np.concatenate([rest, start, history, end, rest])


def _blend_from_rest(first: Float1D, count: int) -> Float1D:
    """Return the `count` samples that lead from rest to the first three samples of a history."""
    d = float(first[0])
    v = float(count * (-1.5 * first[0] + 2.0 * first[1] - 0.5 * first[2]))
    x = np.arange(count) / count
    return x**3 * ((10.0 * d - 4.0 * v) + x * ((-15.0 * d + 7.0 * v) + x * (6.0 * d - 3.0 * v)))


def resample(values: Float1D, from_hz: float, to_hz: float) -> Float1D:
    """Return values resampled by band-limited interpolation; they are taken as 0 outside.

    Windowed sinc, with the cut-off at half of the lower rate: no aliases where the rate falls.
    """
    ratio = from_hz / to_hz
    stretch = max(ratio, 1.0)
    half = math.ceil(KERNEL_HALF_WIDTH * stretch)
    positions = np.arange(math.floor((values.size - 1) / ratio) + 1) * ratio
    nearest = np.rint(positions).astype(np.int64)
    padded = np.concatenate([np.zeros(half), values, np.zeros(half)])
    result, weights = np.zeros(positions.size), np.zeros(positions.size)
    for offset in range(-half, half + 1):
        weight = _kernel((nearest + offset - positions) / stretch)
        result += weight * padded[nearest + offset + half]
        weights += weight
    return result / weights


def _kernel(x: Float1D) -> npt.NDArray[np.float64]:
    """Return a sinc under a Kaiser window of KERNEL_HALF_WIDTH, 0 outside."""
    inside = np.sqrt(np.clip(1.0 - (x / KERNEL_HALF_WIDTH) ** 2, 0.0, None))
    window = np.where(inside > 0.0, np.i0(KERNEL_BETA * inside), 0.0) / np.i0(KERNEL_BETA)
    return np.sinc(x) * window
