"""Text tables of samples: a CSV file -> its columns, as numbers and nothing else.

The delimiter (comma, semicolon or tab) is that of the header. An empty cell and "NaN" are a lost
sample. Whatever else is no finite number is refused, with file, row, column and what to do.
"""

import csv
from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

import numpy as np

from table_io.card import BadInput
from table_io.channels import BY_NAME
from twin.stream.rows import TIME, Rows
from twin.stream.tables import FORMATS, Table, in_memory

DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs"}
LONGEST_LINE = 1_000_000  # characters
SNIFFED = 4096


def read(path: Path) -> Table:
    """The table in a text file; BadInput names the row and column that is wrong."""
    try:
        with path.open("rb") as raw:
            start = raw.read(SNIFFED)
        if not start.strip():
            raise BadInput(f"{path}: empty; give a table with a header and a row a sample")
        if b"\0" in start:
            raise BadInput(
                f"{path}: a binary file; give a text table (CSV, UTF-8), or one that ends in "
                f"{', '.join(FORMATS)}"
            )
        with path.open(encoding="utf-8-sig", newline="") as file:
            return _read(file, path)
    except UnicodeDecodeError:
        raise BadInput(f"{path}: not UTF-8 text; export it as CSV in UTF-8") from None


def write(rows: Rows, file: TextIO) -> None:
    """The rows as text; a number in the fewest digits that give the same bits back."""
    file.write(",".join(rows.units) + "\n")
    for window in rows.windows():
        cells = zip(*(column.tolist() for column in window.values()), strict=True)
        file.writelines(",".join(map(repr, row)) + "\n" for row in cells)


def _read(file: TextIO, path: Path) -> Table:
    lines = _lines(file, path)
    head = next(lines)
    delimiter = max(DELIMITERS, key=head.count)
    names = _header(head, delimiter, path)
    reader = csv.reader(lines, delimiter=delimiter)
    width, values = len(names), array("d")
    row, blank = 1, 0
    try:
        for row, cells in enumerate(reader, start=2):
            if not cells:
                blank = blank or row
                continue
            if blank:
                raise BadInput(f"{path}: row {blank} is empty, with more below it; take it out")
            if len(cells) == width + 1 and not cells[-1].strip():
                cells.pop()
            if len(cells) != width:
                raise _wrong_width(path, row, len(cells), names)
            try:
                values.extend([float(cell) for cell in cells])
            except ValueError:
                values.extend(
                    _number(cell, f"{path}: row {row}, column {name!r}")
                    for cell, name in zip(cells, names, strict=True)
                )
    except csv.Error as error:
        raise BadInput(f"{path}: row {row + 1}: {error}; look for an open quote") from None
    if not values:
        raise BadInput(f"{path}: a header and no samples below it; export the data too")
    table = np.frombuffer(values).reshape(-1, width)
    for name, column in zip(names, table.T, strict=True):
        if np.isinf(column).any():
            at = int(np.flatnonzero(np.isinf(column))[0]) + 2
            raise BadInput(f"{path}: row {at}, column {name!r}: infinite; leave lost samples empty")
    said = () if delimiter == "," else (f"cells are separated by {DELIMITERS[delimiter]}",)
    columns = {
        name: in_memory(np.ascontiguousarray(column))
        for name, column in zip(names, table.T, strict=True)
    }
    return Table(path, columns, said, first_row=2)


def _lines(file: TextIO, path: Path) -> Iterator[str]:
    """The file line by line, none of them endless."""
    while line := file.readline(LONGEST_LINE):
        if len(line) == LONGEST_LINE:
            raise BadInput(
                f"{path}: a line of more than {LONGEST_LINE} characters; give a row a sample"
            )
        yield line


def _header(line: str, delimiter: str, path: Path) -> list[str]:
    """Names of the columns; a delimiter at the end of the line is no column."""
    names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter), [])]
    if names and not names[-1]:
        names.pop()
    if not names or all(_is_number(name) for name in names):
        raise BadInput(
            f"{path}: row 1 names no columns; put their names there, of "
            f"{', '.join((TIME, *BY_NAME))}; or others, and say by --columns MAP which are which"
        )
    if "" in names:
        raise BadInput(f"{path}: row 1: column {names.index('') + 1} has no name; give it one")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise BadInput(f"{path}: row 1 names {', '.join(twice)} more than once; keep one of each")
    return names


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _number(cell: str, where: str) -> float:
    """The number in a cell, NaN of an empty one."""
    text = cell.strip()
    if not text:
        return float("nan")
    if _is_number(text):
        return float(text)
    if _is_number(text.replace(",", ".", 1)):
        raise BadInput(f"{where}: {text!r} has a decimal comma; allowed: a point; export it so")
    raise BadInput(
        f"{where}: {text[:40]!r} is no number; leave a lost sample empty, put units into the "
        "header or into --columns"
    )


def _wrong_width(path: Path, row: int, count: int, names: list[str]) -> BadInput:
    hint = "; are its decimal commas? export it with points" if count == 2 * len(names) else ""
    return BadInput(
        f"{path}: row {row} has {count} cells, the header {len(names)} columns; give every row as "
        f"many cells{hint}"
    )
