"""Readers of recorded histories: csv, columns of numbers, PEER AT2, CSMIP and COSMOS V2, mat, npz.

A reader takes text; `convert_binary` makes text of mat and npz, with every digit, when a profile is
loaded. So a recording that keeps the text needs neither the file nor the library that read it.
"""

import io
import math
import re
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import PurePath
from typing import Any, Literal, get_args

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError, suggest
from table_io.units import UNITS

Quantity = Literal["displacement", "acceleration"]
RecordUnit = Literal["m", "cm", "mm", "in", "m/s2", "cm/s2", "g"]
QUANTITY_BY_SI: dict[str, Quantity] = {"m": "displacement", "m/s2": "acceleration"}
UNIT_BY_ENDING = {unit.replace("/", "_"): unit for unit in get_args(RecordUnit)}
# As the headers of strong-motion files spell them.
HEADER_UNITS = {
    "g": "g", "cm": "cm", "cm/s2": "cm/s2", "cm/sec2": "cm/s2", "cm/s^2": "cm/s2",
    "cm/sec^2": "cm/s2", "cm/sec/sec": "cm/s2", "cm/s/s": "cm/s2", "gal": "cm/s2",
}  # fmt: skip
MIN_SAMPLES, MAX_SAMPLES = 16, 1_000_000
MAX_JITTER = 0.01  # of the sampling interval; the times of a file are rounded
MAX_HEADER_CHARS = 200  # of a line, in which a header is looked for
MAX_ARRAY_BYTES = 64 * 2**20  # of an array of a mat or npz file, which may be compressed
COSMOS_STEP_ENTRY = 34  # of the real header: time between samples in s
BINARY_SUFFIXES = ".mat", ".npz"
COLUMN_SUFFIXES = ".txt", ".dat", *BINARY_SUFFIXES
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"


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


def read_series(text: str, name: str, request: SeriesRequest) -> RecordedSeries:
    """Read one history of a file by its format, which its name and its first line state.

    InputError names the line at fault, or the columns or channels of the file to choose from.
    """
    suffix = PurePath(name).suffix.lower()
    if suffix in (".at2", ".dt2", ".vt2"):
        return _read_peer(text, name, request)
    if is_volume_2(name):
        return _read_volume_2(text, name, request)
    lines = _list_rows(text)
    first = lines[0][1] if lines else ""
    is_columns = suffix in COLUMN_SUFFIXES or _is_numeric(first)
    if is_columns and not first.lower().startswith("time_s"):
        return _read_columns(lines, name, request)
    return _read_csv(lines, name, request)


def is_volume_2(name: str) -> bool:
    """Return whether a file is a corrected accelerogram by its name: .v2, .V2c."""
    return PurePath(name).suffix.lower().startswith(".v2")


def _list_rows(text: str) -> list[tuple[int, str]]:
    """Return (line number, text) of the lines that are neither empty nor comments."""
    return [
        (number, line.strip())
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith(("#", "%"))
    ]


def _is_numeric(line: str) -> bool:
    try:
        return bool([float(cell) for cell in _split_cells(line)])
    except ValueError:
        return False


def _split_cells(line: str) -> list[str]:
    return re.split(r"\s*[,;]\s*|\s+", line.strip().rstrip(",;"))


def _read_csv(lines: list[tuple[int, str]], name: str, request: SeriesRequest) -> RecordedSeries:
    """Read a table with a line of headers: `time_s`, and histories whose names end with units."""
    headers = [column.strip() for column in lines[0][1].split(",")] if lines else []
    has_times = bool(headers) and headers[0] == "time_s"
    data = headers[1:] if has_times else headers
    listing = f"{name}: the headers are {', '.join(headers) or 'missing'}"
    if not data or not (has_times or request.step_s):
        raise InputError(
            listing,
            allowed="time_s and a displacement or an acceleration, such as time_s,disp_mm",
            remedy="" if has_times or not data else "or set step_s if the file has no times",
        )
    if has_times and request.step_s:
        raise InputError(f"{name} has times in column time_s", remedy="remove step_s")
    if request.column is None and len(data) > 1:
        raise InputError(
            listing, allowed="time_s and one history", remedy=f"set column, {suggest('', data)}"
        )
    column = data[0] if request.column is None else request.column
    if isinstance(column, int) and has_times < column <= len(headers):
        column = headers[column - 1]
    if column not in data:
        raise InputError(f"{name} has no column {column!r}", remedy=suggest(str(column), data))
    unit = _find_unit(str(column), name, request.unit)
    places = [*([0] if has_times else []), headers.index(str(column))]
    rows = lines[1:]
    table = _parse_table(rows, name, len(headers), lambda line: line.split(","))[places]
    rate_hz = _find_rate(table[0], rows, name) if has_times else 1.0 / float(request.step_s or 1)
    return _make_series(table[-1], rate_hz, unit, name, request)


def _read_columns(
    lines: list[tuple[int, str]], name: str, request: SeriesRequest
) -> RecordedSeries:
    """Read columns of numbers, counted from 1; the first holds the times unless step_s is set."""
    count = len(_split_cells(lines[0][1])) if lines else 0
    first_data = 1 if request.step_s else 2
    column: int | str | None = request.column
    if column is None and count == first_data:
        column = count
    if not isinstance(column, int) or not first_data <= column <= count:
        raise InputError(
            f"{name} has {count} column{'s' * (count != 1)}",
            allowed=f"column = {first_data} to {count}" if count >= first_data else "",
            remedy=("set column" if count >= first_data else "set step_s, because it has no times"),
        )
    if request.unit is None:
        raise InputError(
            f"{name}: the unit of its columns is unknown",
            remedy=f"set unit, allowed: {', '.join(get_args(RecordUnit))}",
        )
    table = _parse_table(lines, name, count, _split_cells)
    rate_hz = 1.0 / request.step_s if request.step_s else _find_rate(table[0], lines, name)
    return _make_series(table[column - 1], rate_hz, request.unit, name, request)


def _read_peer(text: str, name: str, request: SeriesRequest) -> RecordedSeries:
    """Read a file of the PEER ground motion database: header with NPTS and DT, then values in g.

    Source: https://ngawest2.berkeley.edu, format of its .AT2 and .DT2 files, old and new headers.
    """
    lines = text.splitlines()
    pattern = re.compile(
        rf"NPTS\s*=\s*(?P<n>\d+).*?DT\s*=\s*(?P<dt>{NUMBER})"
        rf"|^\s*(?P<n0>\d+)\s+(?P<dt0>{NUMBER})\s+NPTS",
        re.IGNORECASE,
    )
    match, at = _find_line(lines, pattern)
    if match is None:
        raise InputError(
            f"{name} has no line with NPTS and DT",
            allowed="the header of a PEER file, such as NPTS= 4000, DT= .0100 SEC",
        )
    units, _ = _find_line(lines[: at + 1], re.compile(r"UNITS OF\s+(?P<unit>\S+)", re.IGNORECASE))
    unit = _read_header_unit(units["unit"] if units else "g", name)
    values = _parse_words(lines[at + 1 :], name, at + 2, str.split)
    _check_count(name, at + 1, int(match["n"] or match["n0"]), len(values))
    rate_hz = 1.0 / _parse_step(match["dt"] or match["dt0"], name, at + 1)
    return _make_series(np.array(values), rate_hz, unit, name, request)


def _read_volume_2(text: str, name: str, request: SeriesRequest) -> RecordedSeries:
    """Read the accelerations of one channel of a corrected accelerogram, CSMIP or COSMOS Volume 2.

    `column` counts the channels from 1. Sources: California Strong Motion Instrumentation Program,
    Report OSMS 85-03 (line "points of accel data equally spaced at"); Strong-motion data format of
    COSMOS, V1.20 (line "acceleration pts", time step in entry 34 of the real header).
    """
    lines = text.splitlines()
    pattern = re.compile(
        rf"^\s*(?P<n>\d+)\s+(?:points of accel\w* data equally spaced at\s*(?P<dt>{NUMBER})\s*sec"
        rf"|acceleration pts)(?P<rest>.*)",
        re.IGNORECASE,
    )
    matches = [
        (at, match)
        for at, line in enumerate(lines)
        if (match := pattern.match(line[:MAX_HEADER_CHARS]))
    ]
    channel = 1 if request.column is None and len(matches) == 1 else request.column
    if not isinstance(channel, int) or not 1 <= channel <= len(matches):
        raise InputError(
            f"{name} has the accelerations of {len(matches)} channels",
            allowed=f"column = 1 to {len(matches)}" if matches else "a CSMIP or COSMOS V2 file",
            remedy="set column to the number of the channel" if matches else "",
        )
    at, match = matches[channel - 1]
    rest = match["rest"]
    unit_match = re.search(r"(?:units\s*=\s*|\bin\s+)([a-z/^0-9]+)", rest, re.IGNORECASE)
    unit = _read_header_unit(unit_match[1] if unit_match else "", name, at + 1)
    step_text = match["dt"] or _find_cosmos_step(lines[:at], name)
    width = re.search(r"[FEG](\d+)\.\d", rest, re.IGNORECASE)
    count = int(match["n"])
    values: list[float] = []
    number = at + 1
    while len(values) < count and number < len(lines):
        if lines[number].lower().startswith(("/&", "end-of-data")):
            break
        values += _parse_words([lines[number]], name, number + 1, _make_splitter(width))
        number += 1
    _check_count(name, at + 1, count, len(values))
    return _make_series(
        np.array(values), 1.0 / _parse_step(step_text, name, at + 1), unit, name, request
    )


def drop_integrals(text: str) -> str:
    """Return the text of a V2 file without its blocks of velocity and displacement."""
    begin = re.compile(
        r"\s*\d+\s+(?:points of (?:veloc|displ)\w* data equally|(?:velocity|displacement) pts)",
        re.IGNORECASE,
    )
    kept, is_integral = list[str](), False
    for line in text.split("\n"):
        if begin.match(line[:MAX_HEADER_CHARS]):
            is_integral = True
        elif line.lower().startswith(("/&", "end-of-data")):
            is_integral = False
        if not is_integral:
            kept.append(line)
    return "\n".join(kept)


def _make_splitter(width: re.Match[str] | None) -> Callable[[str], list[str]]:
    """Return the function that cuts a line into numbers: by width, since they may touch."""
    if width is None:
        return str.split
    size = int(width[1])
    return lambda line: [line[k : k + size] for k in range(0, len(line.rstrip()), size)]


def _find_cosmos_step(lines: list[str], name: str) -> str:
    """Return the time step of the last real header in a part of a COSMOS file, as text."""
    pattern = re.compile(r"real-header values follow on\s*(\d+)\s*lines.*?\(\d*[FEG](\d+)", re.I)
    headers = [
        (at, match)
        for at, line in enumerate(lines)
        if (match := pattern.search(line[:MAX_HEADER_CHARS]))
    ]
    if not headers:
        raise InputError(f"{name} has no real header, which states the time step")
    at, match = headers[-1]
    size = int(match[2])
    cells = [
        line[k : k + size]
        for line in lines[at + 1 : at + 1 + int(match[1])]
        for k in range(0, len(line.rstrip()), size)
    ]
    return cells[COSMOS_STEP_ENTRY - 1] if len(cells) >= COSMOS_STEP_ENTRY else ""


def _find_line(lines: list[str], pattern: re.Pattern[str]) -> tuple[re.Match[str] | None, int]:
    """Return the first match in the lines and its index; (None, -1) if there is none."""
    for at, line in enumerate(lines):
        match = pattern.search(line[:MAX_HEADER_CHARS])
        if match:
            return match, at
    return None, -1


def _parse_step(text: str, name: str, number: int) -> float:
    """Return the time step in s of a header."""
    step_s = float(text.replace("D", "E").replace("d", "e")) if _is_numeric(text) else math.nan
    if not 0.0 < step_s < math.inf:
        raise InputError(
            f"{text.strip()!r} is no time step", where=f"{name} line {number}", allowed="above 0 s"
        )
    return step_s


def _read_header_unit(text: str, name: str, number: int = 0) -> str:
    """Return the unit that a header states; InputError if it is not of a displacement or an
    acceleration."""
    unit = HEADER_UNITS.get(text.lower().strip(".,;()"))
    if unit is None:
        raise InputError(
            f"its unit {text!r} is not read",
            where=f"{name} line {number}" if number else name,
            allowed=", ".join(HEADER_UNITS),
            remedy="give the file of the acceleration",
        )
    return unit


def _check_count(name: str, number: int, stated: int, count: int) -> None:
    if stated != count:
        raise InputError(
            f"the header states {stated} samples, but {count} follow",
            where=f"{name} line {number}",
            remedy="get the whole file",
        )


def _parse_words(
    lines: list[str], name: str, first: int, split: Callable[[str], list[str]]
) -> list[float]:
    """Return the numbers of lines, of which the first has the number `first`."""
    values: list[float] = []
    for number, line in enumerate(lines, first):
        try:
            values += [float(word) for word in split(line)]
        except ValueError:
            raise InputError(
                f"{line.strip()[:40]!r} is not a line of numbers",
                where=f"{name} line {number}",
                remedy="get the whole file, or correct the line",
            ) from None
        if not all(map(math.isfinite, values[-20:])):
            raise InputError(
                f"{line.strip()[:40]!r} is not finite",
                where=f"{name} line {number}",
                remedy="get the whole file",
            )
    return values


def _parse_table(
    rows: list[tuple[int, str]], name: str, count: int, split: Callable[[str], list[str]]
) -> Float2D:
    """Return the numbers of rows of `count` cells each, (column, sample)."""
    if not MIN_SAMPLES <= len(rows) <= MAX_SAMPLES:
        raise InputError(f"{name}: {len(rows)} samples", allowed=f"{MIN_SAMPLES} to {MAX_SAMPLES}")

    def parse_rows() -> Iterator[list[float]]:
        for number, line in rows:
            try:
                cells = [float(cell) for cell in split(line)]
            except ValueError:
                cells = []
            words = {1: "a number", 2: "two numbers"}.get(count, f"{count} numbers")
            if len(cells) != count:
                raise InputError(
                    f"{line[:40]!r} is not {words}",
                    where=f"{name} line {number}",
                    remedy="correct the line, or mark a comment with #",
                )
            if not all(map(math.isfinite, cells)):
                raise InputError(
                    f"{line[:40]!r} is not finite",
                    where=f"{name} line {number}",
                    remedy="fill or remove the gap",
                )
            yield cells

    return np.array(list(parse_rows())).T


def _find_rate(time_s: Float1D, rows: list[tuple[int, str]], name: str) -> float:
    """Return the sampling rate in Hz of times; InputError names the line where they jump."""
    intervals = np.diff(time_s)
    interval_s = float(time_s[-1] - time_s[0]) / (time_s.size - 1)
    for problem, at_fault in (
        ("the time does not increase", intervals <= 0.0),
        (
            f"the sampling is not uniform: {interval_s:.6g} s on average",
            np.abs(intervals - interval_s) > MAX_JITTER * abs(interval_s),
        ),
    ):
        if at_fault.any():
            raise InputError(
                problem,
                where=f"{name} line {rows[int(np.argmax(at_fault)) + 1][0]}",
                remedy="resample it; or if the file has no times, set step_s and column",
            )
    return 1.0 / interval_s


def _find_unit(column: str, name: str, unit: RecordUnit | None) -> str:
    """Return the unit of a column, by the end of its name or as stated; InputError if unclear."""
    endings = [ending for ending in UNIT_BY_ENDING if column.endswith(f"_{ending}")]
    stated = UNIT_BY_ENDING[max(endings, key=len)] if endings else None
    if unit is not None and stated is not None and unit != stated:
        raise InputError(
            f"{name}: unit = {unit!r}, but its column is {column}", remedy="remove the unit"
        )
    if unit is None and stated is None:
        raise InputError(
            f"{name}: the unit of column {column!r} is unknown",
            remedy=(
                f"set unit, allowed: {', '.join(get_args(RecordUnit))}, "
                "or end the name with it, such as disp_mm or acc_m_s2"
            ),
        )
    return unit or stated or "m"


def _make_series(
    values: Float1D, rate_hz: float, unit: str, name: str, request: SeriesRequest
) -> RecordedSeries:
    """Return values converted to SI; InputError if they contradict what the profile states."""
    if not MIN_SAMPLES <= values.size <= MAX_SAMPLES:
        raise InputError(
            f"{name}: {values.size} samples", allowed=f"{MIN_SAMPLES} to {MAX_SAMPLES}"
        )
    if request.unit not in (None, unit):
        raise InputError(
            f"{name}: unit = {request.unit!r}, but the file states {unit!r}",
            remedy="remove the unit",
        )
    si, factor = UNITS[unit]
    quantity = QUANTITY_BY_SI[si]
    if request.quantity not in (None, quantity):
        raise InputError(
            f"{name}: quantity = {request.quantity!r}, but {unit} is the unit of a {quantity}",
            remedy="correct quantity or unit",
        )
    stated_s = request.step_s
    if stated_s is not None and abs(rate_hz * stated_s - 1.0) > MAX_JITTER:
        raise InputError(
            f"{name}: step_s = {stated_s:g}, but the file states {1.0 / rate_hz:g} s",
            remedy="remove step_s",
        )
    return RecordedSeries(factor * values, rate_hz, quantity)


def convert_binary(data: bytes, name: str, variable: str | None) -> str:
    """Return one array of a mat or npz file as columns of numbers with all digits.

    The longer dimension of the array becomes the rows. `variable` names it; it may be omitted if
    the file has one array of real numbers. InputError lists the arrays if it is unclear.
    """
    read = _read_mat if PurePath(name).suffix.lower() == ".mat" else _read_npz
    try:
        arrays = read(data, variable)
    except InputError as error:
        raise error.replace(where=name) from None
    except Exception as error:  # what the readers raise for a damaged file is not documented
        raise InputError(
            f"cannot be read ({error})", where=name, remedy="save it again, or as csv"
        ) from None
    chosen = arrays[variable] if variable in arrays else next(iter(arrays.values()), None)
    if chosen is None or variable not in (None, *arrays) or (variable is None and len(arrays) > 1):
        listing = ", ".join(f"{key} {shape_of(array)}" for key, array in arrays.items())
        raise InputError(
            f"variable {variable!r} is not in it" if variable else "variable is not set",
            where=name,
            allowed=listing or "a file with an array of real numbers",
        )
    table = np.atleast_2d(np.asarray(chosen, dtype=np.float64))
    table = table.T if table.shape[0] < table.shape[1] else table
    rows = (",".join(map(repr, row)) for row in table.tolist())
    key = variable or next(iter(arrays))
    return "\n".join(
        [f"# variable {key} of {name}, {table.shape[0]} x {table.shape[1]}", *rows, ""]
    )


def shape_of(array: Any) -> str:
    """Return the shape of an array as text: `6000 x 2`."""
    return " x ".join(map(str, array.shape))


def _is_series(shape: tuple[int, ...], is_real: bool) -> bool:
    return is_real and len(shape) in (1, 2) and MIN_SAMPLES <= max(shape) <= MAX_SAMPLES


def _read_npz(data: bytes, _: str | None) -> dict[str, Any]:
    """Return the arrays of real numbers of an npz file by name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        _check_array_bytes(sum(member.file_size for member in archive.infolist()))
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        arrays = {key: file[key] for key in file.files}
    return {k: v for k, v in arrays.items() if _is_series(v.shape, v.dtype.kind in "fiu")}


def _read_mat(data: bytes, variable: str | None) -> dict[str, Any]:
    """Return the arrays of real numbers of a mat file by name, or the named one alone."""
    from scipy import io as scipy_io  # takes longer to import than a profile to load

    try:
        listing = scipy_io.whosmat(io.BytesIO(data))
    except NotImplementedError:
        raise InputError("it is an HDF5 file", remedy="save it with the option -v7") from None
    kinds = {"double", "single", *(f"{s}int{n}" for s in ("", "u") for n in (8, 16, 32, 64))}
    names = [key for key, shape, kind in listing if _is_series(shape, kind in kinds)]
    shapes = {key: shape for key, shape, _ in listing}
    wanted = [variable] if variable in names else names
    _check_array_bytes(sum(8 * math.prod(shapes[key]) for key in wanted if key))
    loaded = scipy_io.loadmat(io.BytesIO(data), variable_names=wanted)
    return {key: loaded[key] for key in names if key in loaded}


def _check_array_bytes(count: int) -> None:
    if count > MAX_ARRAY_BYTES:
        raise InputError(
            f"its arrays have {count / 2**20:.0f} MB",
            allowed=f"at most {MAX_ARRAY_BYTES / 2**20:.0f} MB",
            remedy="save the record alone",
        )
