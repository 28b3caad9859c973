"""CSV reader and writer for text tables of numbers.

The delimiter (comma, semicolon or tab) is that of the header. An empty cell or "NaN" is a lost
sample. Any other cell that is not a finite number is an InputError with file, row and column.
"""

import csv
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np

from table_io.channels import CHANNEL_BY_NAME
from table_io.errors import InputError
from twin.exchange.formats import FORMATS, SampleTable, make_column
from twin.recording.tabular import TIME_COLUMN, LogTable

DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs"}
MAX_LINE_CHARS = 1_000_000
SNIFF_BYTES = 4096


def scan_columns(path: Path) -> SampleTable:
    """Read the table in a text file; raise InputError that names the invalid row and column."""
    try:
        with path.open("rb") as raw:
            start = raw.read(SNIFF_BYTES)
        if not start.strip():
            raise InputError(
                "empty", where=path, remedy="give a table with a header and one row per sample"
            )
        if b"\0" in start:
            raise InputError(
                "a binary file",
                where=path,
                allowed=f"text tables (CSV, UTF-8), or files that end in {', '.join(FORMATS)}",
            )
        with path.open(encoding="utf-8-sig", newline="") as file:
            return _parse_table(file, path)
    except UnicodeDecodeError:
        raise InputError("not UTF-8 text", where=path, remedy="export it as CSV in UTF-8") from None


def write_csv(rows: LogTable, file: TextIO) -> None:
    """Write the rows as CSV, with the shortest digits that read back to the same float64."""
    file.write(",".join(rows.units) + "\n")
    for window in rows.iter_windows():
        cells = zip(*(column.tolist() for column in window.values()), strict=True)
        file.writelines(",".join(map(repr, row)) + "\n" for row in cells)


def _parse_table(file: TextIO, path: Path) -> SampleTable:
    lines = _iter_lines(file, path)
    header = next(lines)
    delimiter = max(DELIMITERS, key=header.count)
    names = _parse_header(header, delimiter, path)
    reader = csv.reader(lines, delimiter=delimiter)
    width, values = len(names), array("d")
    row, blank_row = 1, 0
    try:
        for row, cells in enumerate(reader, start=2):
            if not cells:
                blank_row = blank_row or row
                continue
            if blank_row:
                raise InputError(
                    f"row {blank_row} is empty, with more below it", where=path, remedy="remove it"
                )
            if len(cells) == width + 1 and not cells[-1].strip():
                cells.pop()
            if len(cells) != width:
                raise _width_error(path, row, len(cells), names)
            try:
                values.extend([float(cell) for cell in cells])
            except ValueError:
                values.extend(
                    _parse_number(cell, f"{path}: row {row}, column {name!r}")
                    for cell, name in zip(cells, names, strict=True)
                )
    except csv.Error as error:
        raise InputError(
            str(error), where=f"{path}: row {row + 1}", remedy="look for an unclosed quote"
        ) from None
    if not values:
        raise InputError(
            "a header and no samples below it", where=path, remedy="export the data too"
        )
    table = np.frombuffer(values).reshape(-1, width)
    for name, column in zip(names, table.T, strict=True):
        if np.isinf(column).any():
            row_with_inf = int(np.flatnonzero(np.isinf(column))[0]) + 2
            raise InputError(
                "infinite",
                where=f"{path}: row {row_with_inf}, column {name!r}",
                remedy="leave lost samples empty",
            )
    notes = () if delimiter == "," else (f"cells are separated by {DELIMITERS[delimiter]}",)
    columns = {
        name: make_column(np.ascontiguousarray(column))
        for name, column in zip(names, table.T, strict=True)
    }
    return SampleTable(path, columns, notes, first_row=2)


def _iter_lines(file: TextIO, path: Path) -> Iterator[str]:
    """Yield the lines of a file; raise InputError for one beyond MAX_LINE_CHARS."""
    while line := file.readline(MAX_LINE_CHARS):
        if len(line) == MAX_LINE_CHARS:
            raise InputError(
                f"a line of more than {MAX_LINE_CHARS} characters",
                where=path,
                remedy="give one row per sample",
            )
        yield line


def _parse_header(line: str, delimiter: str, path: Path) -> list[str]:
    """Parse the column names; a trailing delimiter is ignored."""
    names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter), [])]
    if names and not names[-1]:
        names.pop()
    if not names or all(_is_number(name) for name in names):
        raise InputError(
            "row 1 names no columns",
            where=path,
            allowed=", ".join((TIME_COLUMN, *CHANNEL_BY_NAME)),
            remedy="put column names there, or other names and map them with --columns MAP",
        )
    if "" in names:
        raise InputError(f"column {names.index('') + 1} has no name", where=f"{path}: row 1")
    repeated = sorted({name for name in names if names.count(name) > 1})
    if repeated:
        raise InputError(
            f"row 1 names {', '.join(repeated)} more than once",
            where=path,
            remedy="keep one of each",
        )
    return names


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _parse_number(cell: str, location: str) -> float:
    """Parse a cell as a number; an empty cell is NaN."""
    text = cell.strip()
    if not text:
        return float("nan")
    if _is_number(text):
        return float(text)
    if _is_number(text.replace(",", ".", 1)):
        raise InputError(
            f"{text!r} has a decimal comma",
            where=location,
            remedy="export the table with a point as decimal separator",
        )
    raise InputError(
        f"{text[:40]!r} is not a number",
        where=location,
        remedy="leave a lost sample empty; state units in the --columns file",
    )


def _width_error(path: Path, row: int, count: int, names: list[str]) -> InputError:
    hint = " (for decimal commas: export with points)" if count == 2 * len(names) else ""
    return InputError(
        f"row {row} has {count} cells, the header {len(names)} columns",
        where=path,
        remedy=f"give every row as many cells as the header{hint}",
    )
