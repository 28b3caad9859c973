"""Text tables of numbers: their encoding, delimiter and rows; and their writer.

A comma, a semicolon, a tab, a bar or blanks separate cells; samples may be preceded by remarks, a
row of names and a row of units (`layout`), and followed by remarks. Lines that begin with # or %
and empty lines are no samples.
"""

import csv
import re
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import TextIO

from table_io.channels import CHANNEL_BY_NAME, TIME_COLUMN
from table_io.errors import InputError
from table_io.formats.cells import MAX_QUOTED_CHARS, CellRow, make_width_error, read_cells
from table_io.formats.layout import (
    MAX_HEAD_ROWS,
    TableLayout,
    find_layout,
    is_number,
    turn_rows,
)
from table_io.formats.table import ForeignTable, TableColumns, check_column_count
from table_io.formats.words import read_facts

BLANKS = " "  # one or more of them, or tabs
DELIMITERS = {",": "commas", ";": "semicolons", "\t": "tabs", "|": "bars", BLANKS: "blanks"}
MAX_LINE_CHARS = 1_000_000
MAX_REMARK_CHARS = 1000  # of a line that states a fact, next to rows of samples
# With the last one of a file that ends in no line feed: a writer that drops zeros at the end makes
# one number in ten shorter, so of so many rows some are.
COMPARED_ROWS = 100
DECIMALS = re.compile(r"\d\.(\d+)\s*$")


def parse_table(file: TextIO, path: Path) -> ForeignTable:
    """Read the table in a text; raise InputError that names the invalid row and column."""
    lines = _iter_lines(file, path)
    head = list(islice(lines, MAX_HEAD_ROWS))
    marks = (line.count(mark) for line in head for mark in DELIMITERS if mark != BLANKS)
    check_column_count(max(marks, default=0), path)  # before each cell of the head is judged
    delimiter, layout = _find_layout(head)
    kind = f"a text table, separated by {DELIMITERS[delimiter]}"
    if layout is not None and (rows := turn_rows(_separate_head(head, delimiter)[0], layout)):
        return _parse_turned(rows, head, path, kind)
    if layout is None:  # reports what is wrong with the row after a first row of names
        names = _parse_header(head[0] if head else "", delimiter, path)
        layout = TableLayout((*names,), ("",) * len(names), 1, "n" * len(names))
    elif not layout.names:
        _check_header(layout, head, delimiter, path)
    lines = chain(head[layout.first_row :], lines)
    table = read_cells(path, kind, layout, _number_rows(lines, delimiter, layout.first_row, path))
    notes = [] if delimiter == "," else [f"cells are separated by {DELIMITERS[delimiter]}"]
    notes += ["numbers have decimal commas"] if layout.has_decimal_commas else []
    return replace(table, notes=(*notes, *table.notes))


def _parse_turned(
    rows: Sequence[Sequence[str]], lines: Iterable[str], path: Path, kind: str
) -> ForeignTable:
    """Read a table whose channels are in rows, from its columns; `lines` may state facts."""
    layout = find_layout(rows[:MAX_HEAD_ROWS])
    if layout is None:
        raise InputError(f"{kind}, its channels in rows, without samples", where=path)
    cells = enumerate(rows[layout.first_row :], layout.first_row + 1)
    table = read_cells(path, f"{kind}, its channels in rows", layout, cells)
    facts = read_facts(line for line in lines if len(line) < MAX_REMARK_CHARS)
    note = "its channels are in rows: a row below is a column of the file"
    return replace(table, notes=(note, *table.notes), facts=facts)


def write_csv(names: Iterable[str], windows: Iterable[TableColumns], file: TextIO) -> None:
    """Write columns as CSV, with the shortest digits that read back to the same float64."""
    file.write(",".join(names) + "\n")
    for window in windows:
        cells = zip(*(column.tolist() for column in window.values()), strict=True)
        file.writelines(",".join(map(repr, row)) + "\n" for row in cells)


def _find_layout(head: list[str]) -> tuple[str, TableLayout | None]:
    """Find (delimiter, layout) of the first lines: the delimiter that names most columns."""
    fits = {}
    for delimiter in DELIMITERS:
        try:
            rows, first_lines = _separate_head(head, delimiter)
        except csv.Error:
            continue
        layout = find_layout(rows)
        if layout is not None:
            layout = replace(layout, first_row=first_lines[layout.first_row])
        if layout is not None and layout.spare and delimiter == BLANKS:  # a remark of as many words
            layout = replace(layout, names=(), units=("",) * layout.width, spare=())
        # "1,2" is two cells, unless other delimiters separate several numbers like it
        if layout is not None and not (layout.has_decimal_commas and layout.width == 1):
            fits[delimiter] = layout
    if not fits:
        return max((",", ";", "\t"), key=(head or [""])[0].count), None
    best = max(fits, key=lambda delimiter: _rank_layout(fits[delimiter]))
    return best, fits[best]


def _rank_layout(layout: TableLayout) -> tuple[bool, bool, int, bool, int]:
    """Return the rank of a layout: numbers alone, no empty column, many rows, names, columns."""
    is_full = bool(layout.names) or " " not in layout.kinds
    return "t" not in layout.kinds, is_full, layout.samples, bool(layout.names), layout.width


def _separate_head(head: list[str], delimiter: str) -> tuple[list[list[str]], list[int]]:
    """Return (cells, index of the first line) of each row: a cell in quotes may hold several."""
    if delimiter == BLANKS:
        return [*_separate_words(head)], [*range(len(head))]
    reader = csv.reader(head, delimiter=delimiter, skipinitialspace=True)
    rows, first_lines = list[list[str]](), [0]
    for row in reader:
        rows.append(row)
        first_lines.append(reader.line_num)
    return rows, first_lines[:-1]


def _separate(lines: Iterable[str], delimiter: str) -> Iterator[list[str]]:
    """Yield the cells of each line; none for an empty line."""
    if delimiter == BLANKS:
        return map(_split_blanks, lines)
    return csv.reader(lines, delimiter=delimiter, skipinitialspace=True)


def _split_blanks(line: str) -> list[str]:
    """Return the words of a line; one in quotes may hold blanks."""
    if '"' not in line:
        return line.split()
    return [quoted or word for quoted, word in re.findall(r'"([^"]*)"|(\S+)', line)]


def _separate_words(lines: Iterable[str]) -> Iterator[list[str]]:
    """Yield the cells of lines of a table separated by blanks; names may contain single ones."""
    for line in lines:
        cells = _split_blanks(line)
        if any(is_number(cell.replace(",", ".", 1)) for cell in cells):
            yield cells
        else:
            spaced = re.split(r"\s{2,}|\t", line.strip())
            yield spaced if len(spaced) > 1 else cells


def _number_rows(
    lines: Iterable[str], delimiter: str, before: int, path: Path
) -> Iterator[CellRow]:
    """Yield (row number, cells) of the lines that are neither empty nor remarks."""
    number, complete = before, before
    blanks = None if delimiter == BLANKS else "\r\n "  # an empty cell beside a tab is a lost sample

    def select_lines() -> Iterator[str]:
        nonlocal number
        for line in lines:
            number += 1
            if line.strip(blanks) and line.lstrip()[:1] not in ("#", "%"):
                yield line

    try:
        for cells in _separate(select_lines(), delimiter):
            yield number, cells
            complete = number
    except csv.Error as error:
        raise InputError(
            str(error), where=f"{path}: row {complete + 1}", remedy="look for an unclosed quote"
        ) from None


def _check_header(layout: TableLayout, head: list[str], delimiter: str, path: Path) -> None:
    """Raise InputError if the row above samples without names has another number of cells."""
    above = next((line for line in reversed(head[: layout.first_row]) if line.strip()), "")
    cells = next(_separate([above], delimiter), [])
    is_remark = above.lstrip()[:1] in ("#", "%") or "".join(cells[:1]).rstrip().endswith(":")
    if delimiter != BLANKS and 1 < len(cells) != layout.width and not is_remark:
        raise make_width_error(path, layout.first_row + 1, layout.width, len(cells))


def _iter_lines(file: TextIO, path: Path) -> Iterator[str]:
    """Yield the lines of a file; raise InputError for one beyond MAX_LINE_CHARS."""
    recent: deque[str] = deque(maxlen=COMPARED_ROWS)
    while line := file.readline(MAX_LINE_CHARS):
        if len(line) == MAX_LINE_CHARS:
            raise InputError(
                f"a line of more than {MAX_LINE_CHARS} characters",
                where=path,
                remedy="give one row per sample",
            )
        if line[-1:] not in "\r\n" and _is_cut_off(line, recent):
            raise InputError(
                f"its last row ends in {line[-MAX_QUOTED_CHARS:]!r}, with fewer digits than all "
                "before: the file is cut off",
                where=path,
                remedy="export it again, or remove the last row",
            )
        recent.append(line)
        yield line


def _is_cut_off(line: str, before: Iterable[str]) -> bool:
    """Return True if a row has fewer decimals at its end than the rows before, which have alike."""
    last, *counts = (
        len(match[1]) if (match := DECIMALS.search(row)) else 0 for row in (line, *before)
    )
    is_alike = len(counts) == COMPARED_ROWS and len({*counts}) == 1
    return is_alike and last < counts[0] and line[:1] in "+-.0123456789"


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
