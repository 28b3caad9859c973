"""Record: a displacement or acceleration history from a file, such as an earthquake.

Its table is read as those of an import (`table_io/formats`), one column of it, with its unit and
its sampling rate. The table travels as text with the profile, so that a recording needs neither the
file nor the library that read it: `convert_binary` makes text of other formats, with every digit.

A displacement is scaled and resampled to the rate of the rig by band-limited interpolation; its
first and last samples need not be at rest: quintic blends before and after it, continuous in value
and velocity, lead from rest and to rest. An acceleration is freed of its baseline, limited to a
band and integrated twice (`waveform.py`).

Similitude: with the ratios l of length and a of acceleration, model over prototype, displacements
are multiplied by l, accelerations by a and times by sqrt(l / a). Source: Harris and Sabnis,
Structural Modeling and Experimental Techniques, 2nd ed. 1999, chapter 2.
"""

import csv
import hashlib
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any, ClassVar, Literal, get_args

import numpy as np
import numpy.typing as npt
from pydantic import Field, ValidationInfo, field_validator

from table_io.block import Float1D
from table_io.channels import TIME_COLUMN
from table_io.config.base import ConfigModel, Finite, Number, Positive, find_attached_text
from table_io.config.excitation import History, register_excitation
from table_io.config.excitation.waveform import Baseline, correct_baseline, cut_rest, limit_band
from table_io.errors import InputError, is_control, suggest
from table_io.formats import FORMATS, decode_text, parse_text, read_table
from table_io.formats.strong_motion import drop_integrals, is_volume_2
from table_io.formats.table import ForeignTable
from table_io.formats.timing import (
    MAX_INTERVAL_ERROR,
    check_plausible_rate,
    check_rate,
    describe_wrapped,
    find_remark_rate,
    judge_time_unit,
    measure_rate,
)
from table_io.formats.words import (
    TIME_UNITS,
    find_quantity,
    find_stated_unit,
    find_unit,
    is_unit,
    normalize_unit,
)
from table_io.units import UNITS

Quantity = Literal["displacement", "acceleration"]
RecordUnit = Literal["m", "cm", "mm", "in", "m/s2", "cm/s2", "g"]
QUANTITY_BY_SI: dict[str, Quantity] = {"m": "displacement", "m/s2": "acceleration"}
MIN_SAMPLES, MAX_SAMPLES = 16, 1_000_000
CHECKSUM_SUFFIX = ".sha256"  # of the entry of `files` with the checksum of a converted file
ACCELERATION_BAND_HZ = 0.1, 25.0
MAX_BAND_RATIO = 0.4  # of the sampling rate: resampling keeps what lies below
KERNEL_HALF_WIDTH = 32  # samples, of the interpolation
# Of its Kaiser window: images are 140 dB below the signal, because the acceleration amplifies them;
# the pass band ends at 0.42 of the lower rate.
KERNEL_BETA = 14.0


@dataclass(frozen=True, slots=True)
class SeriesRequest:
    """What a profile states of its file: None for what it leaves to the file."""

    quantity: Quantity | None = None
    unit: RecordUnit | None = None
    step_s: float | None = None
    column: int | str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RecordedSeries:
    """Samples of a file in SI, (sample,), their quantity and their sampling rate in Hz."""

    values: Float1D
    rate_hz: float
    quantity: Quantity


class SeriesKeys(ConfigModel):
    """Keys that say how the history is read from its file."""

    quantity: Quantity | None = Field(None, description="Of the history; omitted: by the unit.")
    unit: RecordUnit | None = Field(None, description="Omitted: of the header.")
    step_s: Positive | None = Field(None, description="Time between samples, if the file has none.")
    variable: str | None = Field(None, description="Array of a mat or npz file, if it has several.")
    column: int | str | None = Field(
        None, description="Number from 1 or header of the history; of a V2 file, the channel."
    )


@register_excitation("record")
class RecordedHistory(SeriesKeys, History):
    """Displacement or acceleration history read from a file: text, AT2, V2, mat and others."""

    FILE_KEYS: ClassVar[tuple[str, ...]] = ("file", *History.FILE_KEYS)
    LEVEL_KEY: ClassVar[str] = "scale"

    sha256: str | None = Field(
        None, pattern="^[0-9a-fA-F]{64}$", description="Checksum that the file must have."
    )
    scale: Finite = Field(1.0, description="Factor on the motion; negative turns it around.")
    length_ratio: Positive = Field(1.0, description="Similitude: length of model over prototype.")
    acceleration_ratio: Positive = Field(
        1.0,
        description="Similitude: acceleration of model over prototype; "
        "time is scaled by the root of length_ratio / acceleration_ratio.",
    )
    baseline: Baseline | None = Field(
        None, description="Removed from an acceleration; omitted: linear."
    )
    band_hz: tuple[Positive, Positive] | None = Field(
        None,
        description="Lower and upper corner of the zero-phase filter, at the time scale of the "
        "table; omitted: 0.1 to 25 for an acceleration, or from 1 / its duration, or to 0.4 of its "
        "rate; no filter for a displacement.",
    )
    blend_s: Number = Field(1.0, ge=0.1, le=60, description="From rest to the record, and back.")
    file: str = Field(description="File with the history, next to the profile.")

    @classmethod
    def convert_file(cls, data: bytes, name: str, table: Mapping[str, Any]) -> dict[str, str]:
        """Return the text of a file, and its checksum if the text is not the file as it is."""
        if PurePath(name).suffix.lower() in FORMATS:
            variable = table.get("variable")
            text = convert_binary(data, name, variable if isinstance(variable, str) else None)
        else:
            text = _decode(data)
            text = drop_integrals(text) if is_volume_2(name) else text
        files = {name: text}
        if text.encode() != data:
            files[name + CHECKSUM_SUFFIX] = hashlib.sha256(data).hexdigest()
        return files

    @field_validator("scale")
    @classmethod
    def _check_scale(cls, scale: float) -> float:
        if scale == 0.0:
            raise InputError("scale is 0, so nothing would move", allowed="any other number")
        return scale

    @field_validator("band_hz")
    @classmethod
    def _check_band(cls, band_hz: tuple[float, float] | None) -> tuple[float, float] | None:
        if band_hz is not None and not band_hz[0] < band_hz[1]:
            raise InputError(f"band_hz {list(band_hz)} is empty", allowed="[lower, upper]")
        return band_hz

    @field_validator("file")
    @classmethod
    def _check_file(cls, name: str, info: ValidationInfo) -> str:
        text, values = find_attached_text(name, info), info.data
        if text is None or not {"quantity", "unit", "step_s", "column", "sha256"} <= values.keys():
            return name
        checksum = _find_checksum(values["files"], name)
        if values["sha256"] is not None and values["sha256"].lower() != checksum:
            raise InputError(
                f"{name} has the SHA-256 {checksum}",
                allowed=values["sha256"],
                remedy="get the record that the profile names, or correct sha256",
            )
        keys = SeriesRequest.__dataclass_fields__
        request = SeriesRequest(**{key: values[key] for key in keys})
        try:
            series = read_series(text, name, request)
        except InputError as error:  # the place is that of the key, so the line is in the words
            place = f"{error.where}: " if error.where else ""
            raise error.replace(problem=place + error.problem, where="") from None
        if {"baseline", "band_hz", "length_ratio", "acceleration_ratio"} <= values.keys():
            _check_processing(series, values)
        return name

    @property
    def checksum(self) -> str:
        """SHA-256 of the file, hexadecimal: records of one name differ."""
        return _find_checksum(self.files, self.file)

    @cached_property
    def series(self) -> RecordedSeries:
        """History of the file in SI, unscaled."""
        request = SeriesRequest(self.quantity, self.unit, self.step_s, self.column)
        return read_series(self.files[self.file], self.file, request)

    @property
    def samples(self) -> tuple[Float1D, float]:
        """Values of the file in SI, unscaled, (sample,), and its sampling rate in Hz."""
        return self.series.values, self.series.rate_hz

    @property
    def time_ratio(self) -> float:
        """Time on the table over time in the file, by similitude."""
        return math.sqrt(self.length_ratio / self.acceleration_ratio)

    @property
    def applied_band_hz(self) -> tuple[float, float] | None:
        """Corners of the filter in Hz at the time scale of the table; None for no filter."""
        rate_hz = self.series.rate_hz / self.time_ratio
        return _choose_band(self.band_hz, self.series, rate_hz)

    def record_acceleration(self, rate_hz: float) -> Float1D | None:
        """Return the acceleration of the file in m/s2, scaled and resampled, (sample,).

        Without the band filter and the baseline, by which the target differs from it. None of a
        displacement, which is its own target.
        """
        values, file_rate_hz = self.samples
        if self.series.quantity != "acceleration":
            return None
        scaled = self.scale * self.acceleration_ratio * values
        return resample(scaled, file_rate_hz / self.time_ratio, rate_hz)

    def displacement(self, rate_hz: float) -> Float1D:
        """Return the history from rest to rest in m at a sampling rate, (sample,)."""
        values, file_rate_hz = self.samples
        file_rate_hz /= self.time_ratio
        is_acceleration = self.series.quantity == "acceleration"
        ratio = self.acceleration_ratio if is_acceleration else self.length_ratio
        band_hz = self.applied_band_hz
        history = self.scale * ratio * values
        if band_hz is None:
            blended = _add_blends(history, round(self.blend_s * file_rate_hz))
            return resample(blended, file_rate_hz, rate_hz)
        if is_acceleration:
            history = correct_baseline(history, self.baseline or "linear")
        motion = limit_band(history, file_rate_hz, band_hz, integrate=is_acceleration)
        rest = np.zeros(KERNEL_HALF_WIDTH)
        moving = cut_rest(motion, round(self.blend_s * file_rate_hz))
        return resample(np.concatenate([rest, moving, rest]), file_rate_hz, rate_hz)


def _decode(data: bytes) -> str:
    """Return the text of a file with line feeds, without the control characters of old systems."""
    text = decode_text(data).replace("\r\n", "\n").replace("\r", "\n")
    if text.isascii() and text.replace("\n", "").isprintable():
        return text
    return "".join(" " if is_control(c) and c != "\n" else c for c in text)


def _find_checksum(files: Mapping[str, str], name: str) -> str:
    """Return the SHA-256 of a file from its entry, or else of its text, which is the file."""
    entry = files.get(name + CHECKSUM_SUFFIX)
    return entry or hashlib.sha256(files[name].encode()).hexdigest()


def _choose_band(
    band_hz: tuple[float, float] | None, series: RecordedSeries, rate_hz: float
) -> tuple[float, float] | None:
    """Return the band of the filter in Hz at a sampling rate; None for no filter."""
    if band_hz is not None or series.quantity == "displacement":
        return band_hz
    low_hz, high_hz = ACCELERATION_BAND_HZ
    return max(low_hz, rate_hz / series.values.size), min(high_hz, MAX_BAND_RATIO * rate_hz)


def _check_processing(series: RecordedSeries, values: Mapping[str, Any]) -> None:
    """Raise InputError if the baseline or the band does not suit the history."""
    if series.quantity == "displacement" and values["baseline"] is not None:
        raise InputError(
            "baseline is for an acceleration, but the file has a displacement",
            remedy="remove baseline",
        )
    rate_hz = series.rate_hz / math.sqrt(values["length_ratio"] / values["acceleration_ratio"])
    band_hz = _choose_band(values["band_hz"], series, rate_hz)
    if band_hz is None:
        return
    low_hz, high_hz = band_hz
    if not low_hz < high_hz <= MAX_BAND_RATIO * rate_hz * (1 + 1e-9):
        raise InputError(
            f"band_hz ends at {high_hz:g} Hz, but the record has {rate_hz:g} samples per second",
            allowed=f"band_hz up to {MAX_BAND_RATIO * rate_hz:.4g} Hz",
        )
    duration_s = series.values.size / rate_hz
    if low_hz * duration_s < 1.0 - 1e-9:
        raise InputError(
            f"band_hz begins at {low_hz:g} Hz, but the record lasts {duration_s:.3g} s only",
            allowed=f"band_hz from {1.0 / duration_s:.3g} Hz",
        )


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


@lru_cache(maxsize=16)  # a campaign plays few records, each at many gaps
def read_series(text: str, name: str, request: SeriesRequest) -> RecordedSeries:
    """Read one history of a file from its text.

    InputError names the row at fault, or the columns of the file to choose from.
    """
    table = parse_text(text, name)
    time_name = _find_times(table, request)
    column = _choose_column(table, name, request, time_name)
    unit = _find_history_unit(table, column, name, request)
    values = table.read_column(column)
    if not MIN_SAMPLES <= values.size <= MAX_SAMPLES:
        raise InputError(
            f"{name}: {values.size} samples", allowed=f"{MIN_SAMPLES} to {MAX_SAMPLES}"
        )
    if np.isnan(values).any():
        raise InputError(
            "a sample is lost",
            where=table.describe_row(int(np.argmax(np.isnan(values)))),
            remedy="fill or remove the gap",
        )
    si, factor = UNITS[unit]
    quantity = QUANTITY_BY_SI[si]
    if request.quantity not in (None, quantity):
        raise InputError(
            f"{name}: quantity = {request.quantity!r}, but {unit} is the unit of a {quantity}",
            remedy="correct quantity or unit",
        )
    rate_hz = _find_rate(table, column, name, request, time_name)
    scaled = factor * values
    scaled.flags.writeable = False  # shared by all who read the file
    return RecordedSeries(scaled, rate_hz, quantity)


def _find_times(table: ForeignTable, request: SeriesRequest) -> str:
    """Return the column of times, "" without one: by its name, else the first one if it rises."""
    if any(column.rate_hz for column in table.columns.values()):
        return ""
    if TIME_COLUMN in table.columns:
        return TIME_COLUMN
    times = [name for name, c in table.columns.items() if find_quantity(name, c.unit) == "time"]
    first = next(iter(table.columns), "")
    if times or request.step_s is not None or len(table.columns) < 2:
        return times[0] if times else ""
    is_rising = bool((np.diff(table.read_column(first)) > 0).all())
    is_unnamed = first == f"column {table.columns[first].key[0]}"
    return first if is_rising or (is_unnamed and "rate_hz" not in table.facts) else ""


def _choose_column(table: ForeignTable, name: str, request: SeriesRequest, time_name: str) -> str:
    """Return the name of the column of the history."""
    names = [column for column in table.columns if column != time_name]
    by_number = {int(table.columns[column].key[0]): column for column in names}
    if isinstance(request.column, int) and request.column in by_number:
        return by_number[request.column]
    if request.column in names:
        return str(request.column)
    if request.column is None and len(names) == 1:
        return names[0]
    if request.column is None and (wrapped := describe_wrapped(table)):
        raise InputError(f"{name}: {table.kind}; {wrapped}")
    wrong = ""
    if request.column is not None:
        reason = table.dropped.get(str(request.column), "")
        wrong = f"column = {request.column!r} is not in it{reason and f': {reason}'}; "
    raise InputError(
        f"{name}: {wrong}{table.kind} with {len(table.columns)} columns: "
        f"{', '.join(table.columns)}",
        allowed=f"column = {min(by_number, default=1)} to {max(by_number, default=1)}",
        remedy=f"set column, {suggest(str(request.column or ''), names)}",
    )


def _find_history_unit(table: ForeignTable, column: str, name: str, request: SeriesRequest) -> str:
    """Return the unit of a column, by the file or as stated; InputError if they differ."""
    stated = normalize_unit(table.columns[column].unit) or find_unit(column)
    ending = find_stated_unit(column)
    if not stated and ending in UNITS and UNITS[ending][0] in QUANTITY_BY_SI:
        stated = ending  # disp_mm; another unit may be a direction, as in acc_n
    if request.unit is not None and stated and request.unit != stated:
        raise InputError(
            f"{name}: unit = {request.unit!r}, but the file states {stated!r} for {column}",
            remedy="remove the unit",
        )
    unit = request.unit or stated
    if unit not in UNITS or UNITS[unit][0] not in QUANTITY_BY_SI:
        raise InputError(
            f"{name}: {table.kind}; the unit of column {column!r} is {unit or 'unknown'}",
            remedy=(
                f"set unit, allowed: {', '.join(get_args(RecordUnit))}, "
                "or end the name with it, such as disp_mm or acc_m_s2"
            ),
        )
    return unit


def _find_rate(
    table: ForeignTable, column: str, name: str, request: SeriesRequest, time_name: str
) -> float:
    """Return the sampling rate in Hz by the times, by the file, or as stated."""
    stated_hz = 1.0 / request.step_s if request.step_s else None
    rate_hz, source = table.columns[column].rate_hz, table.kind
    if time_name:
        per_unit = measure_rate(table.read_column(time_name), table)
        judged = judge_time_unit(table, time_name, stated_hz)
        if judged.question:
            raise InputError(f"{name}: {table.kind}; {judged.question}")
        count_hz = stated_hz or table.facts.get("rate_hz", 1.0)  # of a column that counts samples
        rate_hz = per_unit / TIME_UNITS.get(judged.unit, 1.0 / count_hz)
        source = f"column {time_name}"
        check_plausible_rate(rate_hz, table, source)
    elif rate_hz is None:
        rate_hz = stated_hz or find_remark_rate(table)
    if rate_hz is None:
        raise InputError(
            f"{name}: {table.kind} without times, its columns are {', '.join(table.columns)}",
            allowed="a column of times, such as time_s",
            remedy="or set step_s if the file has no times",
        )
    if stated_hz is not None:
        check_rate(stated_hz, rate_hz, name, source, MAX_INTERVAL_ERROR, "step_s")
    return rate_hz


def convert_binary(data: bytes, name: str, variable: str | None) -> str:
    """Return a file that is no text as columns of numbers with all digits.

    `variable` names one array, whose longer dimension becomes the rows; without it all columns are
    taken, which must be of one length. InputError lists the arrays if it is unclear.
    """
    with TemporaryDirectory() as folder:
        path = Path(folder) / PurePath(name).name
        path.write_bytes(data)
        try:
            return _format_columns(read_table(path), name, variable)
        except InputError as error:
            raise error.replace(where=error.where.replace(str(path), name)) from None


def _format_columns(table: ForeignTable, name: str, variable: str | None) -> str:
    """Return the columns of a table, or those of one array, as text."""
    arrays: dict[str, list[str]] = {}
    for column, info in table.columns.items():
        if MIN_SAMPLES <= info.size <= MAX_SAMPLES:
            base, _, number = column.rpartition(":")
            arrays.setdefault(base if number.isdigit() else column, []).append(column)
    columns = [column for array in arrays.values() for column in array]
    names = arrays.get(variable, []) if variable is not None else columns
    if len({table.columns[column].size for column in names}) != 1:
        wrong = f"has no array {variable!r}" if variable else "has no arrays of one length"
        lengths = [
            f"{key} {table.columns[array[0]].size} x {len(array)}" for key, array in arrays.items()
        ]
        others = [name for name in table.columns if name not in columns]
        raise InputError(
            f"{table.kind}; it {wrong} of {MIN_SAMPLES} to {MAX_SAMPLES} samples"
            f"{'; too short or long: ' if others else ''}{', '.join(others)}",
            where=name,
            allowed=", ".join(lengths),
            remedy="set variable",
        )
    table.check_size(names)
    values = {}
    for column in names:
        try:
            values[column] = table.read_column(column).tolist()
        except InputError:  # complex or infinite; a file may hold such arrays next to its record
            if len(names) == 1:
                raise
    rows = [*zip(*values.values(), strict=True)]
    out = io.StringIO()
    if variable is not None or len(arrays) == 1:
        key = variable or next(iter(arrays))
        out.write(f"# variable {key} of {name}, {len(rows)} x {len(values)}\n")
    else:
        rates = {table.columns[column].rate_hz for column in values} - {None}
        out.writelines(f"# rate_hz = {rate_hz!r}\n" for rate_hz in rates)
        units = [normalize_unit(table.columns[column].unit) for column in values]
        units = [unit if is_unit(unit) else "" for unit in units]
        csv.writer(out, lineterminator="\n").writerows(
            [[*values], *([units] if any(units) else [])]
        )
    out.writelines(",".join(map(repr, row)) + "\n" for row in rows)
    return out.getvalue()
