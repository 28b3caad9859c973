"""Reader of Excel workbooks, .xlsx; only this file imports openpyxl.

Each sheet is a group, whose rows are read as those of a text table (`layout`, `cells`). Formulas
count by the values that Excel stored with them.
"""

import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import openpyxl

from table_io.formats.cells import CellRow, read_cells
from table_io.formats.layout import MAX_HEAD_ROWS, find_layout, turn_rows
from table_io.formats.table import ForeignTable, check_expansion


def scan_columns(path: Path) -> ForeignTable:
    """Read the tables of all sheets; raise InputError for a cell that is not a number."""
    with zipfile.ZipFile(path) as archive:
        check_expansion(sum(member.file_size for member in archive.infolist()), path)
    values, formulas = (
        openpyxl.load_workbook(path, read_only=True, data_only=is_value).worksheets
        for is_value in (True, False)
    )
    parts: list[ForeignTable] = []
    dropped: dict[str, str] = {}
    for sheet, formula_sheet in zip(values, formulas, strict=True):
        part = _read_sheet(sheet, formula_sheet, path)
        if part is None:
            dropped[sheet.title] = "no row of numbers"
        else:
            parts.append(part)
    table = parts[0] if parts else ForeignTable(path, "")
    for part in parts[1:]:
        table.columns.update(part.columns)
        table.facts.update(part.facts)
        dropped |= part.dropped
    return replace(table, dropped=table.dropped | dropped)


def _read_sheet(sheet: Any, formula_sheet: Any, path: Path) -> ForeignTable | None:
    """Read the table of a sheet, its columns named `sheet/column`; None without numbers."""
    rows = sheet.iter_rows(values_only=True)
    head = [[*map(_format_cell, row)] for row in islice(rows, MAX_HEAD_ROWS)]
    unsaved = set()  # columns of formulas whose values Excel did not store
    for cells, formulas in zip(head, formula_sheet.iter_rows(values_only=True), strict=False):
        for k, formula in enumerate(formulas[: len(cells)]):
            if isinstance(formula, str) and formula.startswith("=") and not cells[k]:
                cells[k] = "nan"
                unsaved.add(k)
    width = max((len(_trim(row)) for row in head), default=0)
    texts = [(row + [""] * width)[:width] for row in head]
    layout = find_layout(texts)
    if layout is None:
        return None
    below: Iterator[Sequence[str]] = chain(
        head[layout.first_row :], ([*map(_format_cell, row)] for row in rows)
    )
    if turned := turn_rows(texts, layout):
        layout = find_layout(turned[:MAX_HEAD_ROWS]) or layout
        below = iter(turned[layout.first_row :])
    table = read_cells(
        path, "", layout, _iter_rows(below, layout.first_row, layout.width), sheet.title
    )
    for name in [
        name for name, column in table.columns.items() if int(column.key[0]) - 1 in unsaved
    ]:
        del table.columns[name]
        table.dropped[name] = "formulas without values: open the file in Excel and save it"
    title = sheet.title
    return replace(
        table,
        columns={f"{title}/{name}": replace(c, group=title) for name, c in table.columns.items()},
        dropped={f"{title}/{name}": reason for name, reason in table.dropped.items()},
    )


def _iter_rows(rows: Iterator[Sequence[str]], before: int, width: int) -> Iterator[CellRow]:
    """Yield (row number, cells) of the rows that are not empty in the columns of the table."""
    for number, row in enumerate(rows, before + 1):
        cells = [*row, *[""] * width][:width]
        if any(cell.strip() for cell in cells):
            yield number, cells


def _format_cell(cell: object) -> str:
    """Return the text of a cell, from which its number is read back to the bit."""
    if cell is None:
        return ""
    return str(int(cell)) if isinstance(cell, bool) else str(cell)


def _trim(cells: Sequence[str]) -> Sequence[str]:
    """Return the cells up to the last filled one."""
    return cells[: max((k + 1 for k, cell in enumerate(cells) if cell.strip()), default=0)]
