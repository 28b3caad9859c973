"""CSV reader and writer for text tables of numbers.

The delimiter is a comma, a semicolon, a tab or blanks; the samples may be preceded by remarks, a
row of names and a row of units (`layout`). An empty cell or "NaN" is a lost sample. Any other cell
that is not a finite number is an InputError with file, row and column.
"""

import csv
import re
from array import array
from collections.abc import Iterable, Iterator
from itertools import chain, islice
from pathlib import Path
from typing import TextIO

import numpy as np

from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import list_duplicates
from table_io.errors import InputError
from twin.exchange.formats import FORMATS, SampleTable, make_column
from twin.exchange.formats.layout import MAX_HEAD_ROWS, TableLayout, find_layout, is_number
from twin.recording.tabular import TIME_COLUMN, LogTable

BLANKS = " "  # one or more of them, or tabs
DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs", BLANKS: "blanks"}
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
    head = list(islice(lines, MAX_HEAD_ROWS))
    delimiter, layout = _find_layout(head)
    if layout is None:  # reports what is wrong with the row after a first row of names
        names = _parse_header(head[0], delimiter, path)
        layout = TableLayout((*names,), ("",) * len(names), 1, len(names))
    else:
        names = _check_names(layout, head, delimiter, path)
    first_row = layout.first_row + 1
    rows = _separate(chain(head[layout.first_row :], lines), delimiter)
    values = _read_values(rows, names, layout, path)
    if not values:
        raise InputError(
            "a header and no samples below it", where=path, remedy="export the data too"
        )
    table = np.frombuffer(values).reshape(-1, layout.width)
    for name, column in zip(names, table.T, strict=True):
        if np.isinf(column).any():
            row_with_inf = int(np.flatnonzero(np.isinf(column))[0]) + first_row
            raise InputError(
                "infinite",
                where=f"{path}: row {row_with_inf}, column {name!r}",
                remedy="leave lost samples empty",
            )
    notes = [] if delimiter == "," else [f"cells are separated by {DELIMITERS[delimiter]}"]
    notes += ["numbers have decimal commas"] if layout.has_decimal_commas else []
    columns = {
        name: make_column(np.ascontiguousarray(column), unit)
        for name, column, unit in zip(names, table.T, layout.units, strict=True)
    }
    return SampleTable(path, columns, (*notes,), first_row=first_row, facts=layout.facts)


def _read_values(
    rows: Iterator[list[str]], names: list[str], layout: TableLayout, path: Path
) -> "array[float]":
    """Read the numbers of all rows, one row after the other; InputError for any other cell."""
    width, values = layout.width, array("d")
    row, blank_row = layout.first_row, 0
    try:
        for row, cells in enumerate(rows, start=layout.first_row + 1):
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
            texts = _use_decimal_points(cells, row, path) if layout.has_decimal_commas else cells
            try:
                values.extend([float(text) for text in texts])
            except ValueError:
                values.extend(
                    _parse_number(text, f"{path}: row {row}, column {name!r}")
                    for text, name in zip(texts, names, strict=True)
                )
    except csv.Error as error:
        raise InputError(
            str(error), where=f"{path}: row {row + 1}", remedy="look for an unclosed quote"
        ) from None
    return values


def _find_layout(head: list[str]) -> tuple[str, TableLayout | None]:
    """Find (delimiter, layout) of the first lines: the delimiter that names most columns."""
    layouts = {}
    for delimiter in DELIMITERS:
        try:
            rows = _separate_words(head) if delimiter == BLANKS else _separate(head, delimiter)
            layouts[delimiter] = find_layout([*rows])
        except csv.Error:
            layouts[delimiter] = None
    fits = {
        delimiter: layout
        for delimiter, layout in layouts.items()
        # "1,2" is two cells, unless other delimiters separate several numbers like it
        if layout is not None and not (layout.has_decimal_commas and layout.width == 1)
    }
    if not fits:
        return max((",", ";", "\t"), key=head[0].count), None
    best = max(fits, key=lambda delimiter: (bool(fits[delimiter].names), fits[delimiter].width))
    return best, fits[best]


def _separate(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    """Yield the cells of each line; none for an empty line."""
    if delimiter == BLANKS:
        return (line.split() for line in lines)
    return csv.reader(lines, delimiter=delimiter)


def _separate_words(lines: Iterable[str]) -> Iterator[list[str]]:
    """Yield the cells of lines of a table separated by blanks; names may contain single ones."""
    for line in lines:
        cells = line.split()
        if any(is_number(cell.replace(",", ".", 1)) for cell in cells):
            yield cells
        else:
            spaced = re.split(r"\s{2,}|\t", line.strip())
            yield spaced if len(spaced) > 1 else cells


def _check_names(layout: TableLayout, head: list[str], delimiter: str, path: Path) -> list[str]:
    """Return the names of the columns; raise InputError for those that cannot be."""
    if not layout.names:
        above = next((line for line in reversed(head[: layout.first_row]) if line.strip()), "")
        cells = next(_separate([above], delimiter), [])
        if delimiter != BLANKS and len(cells) > 1 and not above.lstrip().startswith("#"):
            raise _width_error(path, layout.first_row + 1, layout.width, cells)
        return [f"column {number}" for number in range(1, layout.width + 1)]
    names = [*layout.names]
    row = f"row {layout.first_row}"
    if "" in names:
        raise InputError(f"column {names.index('') + 1} has no name", where=f"{path}: {row}")
    repeated = list_duplicates(names)
    if repeated:
        raise InputError(
            f"{row} names {', '.join(repeated)} more than once",
            where=path,
            remedy="keep one of each",
        )
    return names


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
    """Parse the first line as column names; a trailing delimiter is ignored."""
    names = [name.strip() for name in next(_separate([line], delimiter), [])]
    if names and not names[-1]:
        names.pop()
    if not names:
        raise InputError(
            "row 1 names no columns",
            where=path,
            allowed=", ".join((TIME_COLUMN, *CHANNEL_BY_NAME)),
            remedy="put column names there, or other names and map them with --columns MAP",
        )
    return names


def _parse_number(cell: str, location: str) -> float:
    """Parse a cell as a number; an empty cell is NaN."""
    text = cell.strip()
    if not text:
        return float("nan")
    if is_number(text):
        return float(text)
    if is_number(text.replace(",", ".", 1)):
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


def _use_decimal_points(cells: list[str], row: int, path: Path) -> list[str]:
    """Return the cells of a row with points for commas; InputError for one that has a point."""
    for cell in cells:
        if "." in cell:
            raise InputError(
                f"{cell.strip()!r} has a decimal point, other numbers have decimal commas",
                where=f"{path}: row {row}",
                remedy="export the table with one kind of decimal separator",
            )
    return [cell.replace(",", ".", 1) for cell in cells]


def _width_error(path: Path, row: int, count: int, names: list[str]) -> InputError:
    hint = " (for decimal commas: export with points)" if count == 2 * len(names) else ""
    return InputError(
        f"row {row} has {count} cells, the header {len(names)} columns",
        where=path,
        remedy=f"give every row as many cells as the header{hint}",
    )
