"""Reader of Excel workbooks, .xlsx; only this file imports openpyxl.

Each sheet is a group. Names, units and remarks are found as in text tables (`layout`). Formulas
count by the values that Excel stored with them.
"""

import zipfile
from array import array
from dataclasses import replace
from itertools import chain, islice
from pathlib import Path
from typing import Any

import numpy as np
import openpyxl

from table_io.config.base import list_duplicates
from table_io.errors import InputError
from twin.exchange.formats import MAX_EXPANSION, SampleTable, make_column
from twin.exchange.formats.layout import MAX_HEAD_ROWS, find_layout


def scan_columns(path: Path) -> SampleTable:
    """Read the tables of all sheets; raise InputError for a cell that is not a number."""
    _check_expansion(path)
    table = SampleTable(path)
    workbook = openpyxl.load_workbook(path, read_only=True, data_only=True)
    for sheet in workbook.worksheets:
        _add_sheet(table, sheet)
    return table


def load_column(path: Path, key: Any) -> Any:
    """Never called: the values of all columns are read at once."""
    raise NotImplementedError(f"{path}: {key}")


def _add_sheet(table: SampleTable, sheet: Any) -> None:
    """Add the table of a sheet; a sheet without a row of numbers is skipped."""
    rows = sheet.iter_rows(values_only=True)
    head = list(islice(rows, MAX_HEAD_ROWS))
    texts = [_trim([_format_cell(cell) for cell in row]) for row in head]
    layout = find_layout(texts)
    if layout is None:
        table.skipped[sheet.title] = "no row of numbers"
        return
    names = layout.names or tuple(f"column {k}" for k in range(1, layout.width + 1))
    repeated = [""] if "" in names else list_duplicates(names)
    if repeated:
        raise InputError(
            f"row {layout.first_row} leaves a column without a name, or names one twice",
            where=f"{table.path}: sheet {sheet.title!r}",
            value=repeated[0],
            remedy="give each column a name of its own",
        )
    values = array("d")
    for number, row in enumerate(chain(head[layout.first_row :], rows), layout.first_row + 1):
        cells = row[: layout.width] if len(row) >= layout.width else (*row, *[None] * layout.width)
        if all(cell is None for cell in cells):
            break  # the table ends; what a person wrote below it is no sample
        for name, cell in zip(names, cells, strict=False):
            values.append(_parse_cell(cell, f"{table.path}: {sheet.title}, row {number}, {name}"))
    samples = np.frombuffer(values).reshape(-1, layout.width)
    for name, column, unit in zip(names, samples.T, layout.units, strict=True):
        table.columns[f"{sheet.title}/{name}"] = replace(
            make_column(np.ascontiguousarray(column), unit), group=sheet.title
        )
    table.facts.update(layout.facts)


def _format_cell(cell: object) -> str:
    return "" if cell is None else str(cell)


def _trim(cells: list[str]) -> list[str]:
    """Return the cells up to the last filled one."""
    count = max((k + 1 for k, cell in enumerate(cells) if cell.strip()), default=0)
    return cells[:count]


def _parse_cell(cell: object, location: str) -> float:
    """Return the number of a cell; NaN if it is empty."""
    if cell is None or (isinstance(cell, str) and not cell.strip()):
        return float("nan")
    if isinstance(cell, int | float):
        return float(cell)
    try:
        return float(str(cell).replace(",", ".", 1))
    except ValueError:
        raise InputError(
            f"{str(cell)[:40]!r} is not a number",
            where=location,
            remedy="leave a lost sample empty",
        ) from None


def _check_expansion(path: Path) -> None:
    """Raise InputError if the sheets expand beyond the limit (decompression bomb)."""
    with zipfile.ZipFile(path) as archive:
        size = sum(member.file_size for member in archive.infolist())
    if size > 2**26 + MAX_EXPANSION * path.stat().st_size:
        raise InputError(
            f"expands to {size} bytes",
            where=path,
            remedy="the file is damaged, or export the table as CSV",
        )
