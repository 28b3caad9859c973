"""History of a record: one column of a foreign table, with its unit and its sampling rate.

All formats of `table_io/formats` are read. The table travels as text with the profile, so that a
recording needs neither the file nor the library that read it: `convert_binary` makes text of other
formats, with every digit.
"""

import csv
import io
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Literal, get_args

import numpy as np

from table_io.block import Float1D
from table_io.channels import TIME_COLUMN
from table_io.errors import InputError, suggest
from table_io.formats import parse_text, read_table
from table_io.formats.table import ForeignTable
from table_io.formats.timing import (
    MAX_INTERVAL_ERROR,
    check_plausible_rate,
    check_rate,
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
        unit = find_stated_unit(time_name, table.columns[time_name].unit)
        rate_hz = measure_rate(TIME_UNITS.get(unit, 1.0) * table.read_column(time_name), table)
        source = f"column {time_name}"
        check_plausible_rate(rate_hz, table, source)
    elif rate_hz is None:
        rate_hz = stated_hz or table.facts.get("rate_hz")
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
