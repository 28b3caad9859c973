"""Rows of text cells, of a text file or a sheet, as a table of numbers.

An empty cell, "NaN" or one of LOST_MARKS is a lost sample. A column whose first cell is text is no
column of numbers, nor is one that is empty and has no name; elsewhere a cell that is no number is
an InputError with file, row and column. What stands below the samples and is none is left out.
"""

from array import array
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.formats.layout import (
    LOST_MARKS,
    ClockReader,
    QuantityReader,
    TableLayout,
    is_number,
    parse_number,
    split_quantity,
    start_at_zero,
    strip_cells,
    use_decimal_point,
)
from table_io.formats.table import ForeignTable, check_column_count, make_column
from table_io.formats.words import normalize_unit

MAX_QUOTED_CHARS = 40  # of a cell in a message
# Of numbers with marks of thousands that were read as decimals: whole ones, and of the others those
# whose third decimal is not 0. Among readings with three decimals 1 in 1000 is whole, and of those
# in steps of 1/8 the third decimal of 4 in 7 is not 0.
MIN_WHOLE_SHARE, MIN_LAST_DIGITS = 0.05, 0.75
CellRow = tuple[int, Sequence[str]]  # number in the file, cells


class _CellReader:
    """Numbers of the rows of a table, row by row, and the first text of columns of text."""

    def __init__(self, layout: TableLayout, place: str) -> None:
        self._place = place
        self._names = layout.column_names
        self._has_commas = layout.has_decimal_commas
        self._has_spare = bool(layout.spare)
        readers: dict[str, type[ClockReader | QuantityReader]] = {
            "c": ClockReader,
            "q": QuantityReader,
        }
        self._converters: list[Callable[[str], float]] = [
            readers[kind]() if kind in readers else parse_number for kind in layout.kinds
        ]
        self.values = array("d")
        self.row_numbers = array("q")
        self.texts: dict[int, str] = {}

    def add_row(self, number: int, cells: Sequence[str]) -> None:
        """Add the numbers of a row; raise InputError if a cell is none, or the width another."""
        width = len(self._names)
        if len(cells) == width + 1 and (self._has_spare or not cells[-1].strip()):
            cells = cells[:-1]
        if len(cells) != width:
            raise make_width_error(self._place, number, len(cells), width)
        if self._has_commas:
            cells = [self._use_point(cell, number) for cell in cells]
        try:
            numbers = [convert(cell) for convert, cell in zip(self._converters, cells, strict=True)]
        except ValueError:
            numbers = [self._parse_cell(k, cell.strip(), number) for k, cell in enumerate(cells)]
        self.values.extend(numbers)
        self.row_numbers.append(number)

    def find_unit(self, k: int) -> str:
        """Return the unit of the cells of a column, "" if they have none."""
        converter = self._converters[k]
        return converter.unit if isinstance(converter, QuantityReader) else ""

    def _use_point(self, cell: str, number: int) -> str:
        if "." in cell and is_number(cell):
            raise InputError(
                f"{cell.strip()!r} has a point, of decimals or between thousands, other numbers "
                "have decimal commas",
                where=f"{self._place}: row {number}",
                remedy="export the table with one decimal separator, and without marks of "
                "thousands",
            )
        return use_decimal_point(cell)

    def _parse_cell(self, k: int, text: str, number: int) -> float:
        """Return the number of a cell; NaN if it is empty, or in a column of text."""
        if not text or text.lower() in LOST_MARKS or k in self.texts:
            return float("nan")
        try:
            return self._converters[k](text)
        except ValueError:
            pass
        if not np.isfinite(np.array(self.values[k :: len(self._names)])).any():
            self.texts[k] = text[:MAX_QUOTED_CHARS]
            return float("nan")
        where = f"{self._place}: row {number}, column {self._names[k]!r}"
        if unit := self.find_unit(k):
            raise InputError(
                f"{text[:MAX_QUOTED_CHARS]!r} is no number in {unit!r}, as others are",
                where=where,
                remedy="export the column in one unit",
            )
        if is_number(text.replace(",", ".", 1)):
            raise InputError(
                f"{text!r} has a decimal comma",
                where=where,
                remedy="export the table with a point as decimal separator",
            )
        raise InputError(
            f"{text[:MAX_QUOTED_CHARS]!r} is not a number",
            where=where,
            remedy="leave a lost sample empty; state units in the --columns file",
        )


def read_cells(
    path: Path, kind: str, layout: TableLayout, rows: Iterator[CellRow], sheet: str = ""
) -> ForeignTable:
    """Read the table of the rows from the first one of samples; `kind` says what the file is."""
    check_column_count(layout.width, path)
    reader = _CellReader(layout, f"{path}: sheet {sheet!r}" if sheet else str(path))
    notes = []
    for number, cells in rows:
        try:
            reader.add_row(number, cells)
        except InputError:
            if strip_cells(cells) in layout.head:
                continue  # counted below, as lines that hold no samples
            rest = ((number, cells), *rows) if _is_remark(cells, layout.width) else ()
            if not rest or not all(_is_remark(others, layout.width) for _, others in rest):
                raise
            notes.append(f"left out: {len(rest)} lines below the samples, from row {number}")
            break
    samples = np.frombuffer(reader.values).reshape(-1, layout.width)
    row_numbers = np.array(reader.row_numbers, dtype=np.int64)
    filled = np.flatnonzero(~np.isnan(samples).all(axis=1))
    if not filled.size and not reader.texts:
        raise InputError(
            "a header and no samples below it", where=path, remedy="export the data too"
        )
    if filled.size and filled[-1] < len(samples) - 1:  # a spreadsheet keeps rows that were cleared
        notes.append(f"left out: {len(samples) - 1 - filled[-1]} empty rows at the end")
        samples, row_numbers = samples[: filled[-1] + 1], row_numbers[: filled[-1] + 1]
    skipped = int(row_numbers[-1] - row_numbers[0]) + 1 - row_numbers.size
    if skipped:
        notes.append(f"left out: {skipped} lines between the samples that hold none")
    table = ForeignTable(
        path,
        kind,
        dropped=dict.fromkeys(layout.spare, "no cells"),
        notes=(*notes,),
        first_row=int(row_numbers[0]),
        rows=row_numbers if skipped else None,
        facts=layout.facts,
    )
    _add_columns(table, layout, [*samples.T], reader)
    return table


def _hides_thousands(values: Float1D) -> bool:
    """Return True if three decimals may be thousands: 998, 999, 1.001, 1.003 of whole numbers."""
    size = np.abs(values[np.isfinite(values)])
    is_whole = size == np.rint(size)
    whole, broken = size[is_whole], size[~is_whole]
    if whole.size <= MIN_WHOLE_SHARE * size.size or not broken.size:
        return False
    thousandths = np.rint(1e3 * broken)
    return bool(
        100.0 <= whole.max() < 1e3
        and broken.min() >= 1.0
        and broken.max() < 1e3
        and (np.abs(1e3 * broken - thousandths) < 1e-6).all()
        and (thousandths % 10.0 > 0.0).mean() > MIN_LAST_DIGITS
    )


def _is_fraction(layout: TableLayout, samples: Sequence[Float1D], k: int) -> bool:
    """Return True if a column holds the milliseconds of the dates in the one before it."""
    is_named = k > 0 and layout.kinds[k - 1] == "c" and "ms" in (
        layout.units[k], normalize_unit(layout.column_names[k])
    )  # fmt: skip
    return is_named and bool(((samples[k] >= 0) & (samples[k] < 1000)).all())


def _add_columns(
    table: ForeignTable, layout: TableLayout, samples: Sequence[Float1D], reader: _CellReader
) -> None:
    """Add the columns, (row,) each; one that is text or an index, or has a name twice, is none."""
    repeated: dict[str, int] = {}
    for k, (name, values) in enumerate(zip(layout.column_names, samples, strict=True)):
        stated, unit = layout.units[k], reader.find_unit(k)
        if stated and unit and stated != unit:
            raise InputError(
                f"column {name!r} is in {stated} by its head, in {unit} by its cells",
                where=table.path,
                remedy="correct one of them",
            )
        column = make_column(np.ascontiguousarray(values), stated or unit, k + 1)
        if layout.kinds[k] == "c" and k not in reader.texts:
            is_fine = k + 1 < layout.width and _is_fraction(layout, samples, k + 1)
            times = values + 1e-3 * samples[k + 1] if is_fine else values
            column = make_column(start_at_zero(times), "s", k + 1)
        if why := _find_drop_reason(layout, samples, reader, k):
            table.dropped[name] = why
        elif name not in repeated and _hides_thousands(values):
            table.dropped[name] = "its points or commas may be marks of thousands: export without"
        elif name in repeated:
            repeated[name] += 1
            kept = table.columns.get(name)
            if kept is not None and not np.array_equal(kept.values, values, equal_nan=True):  # type: ignore[arg-type]
                del table.columns[name]
            if name not in table.columns:
                table.dropped[name] = f"{repeated[name]} columns have this name"
        else:
            repeated[name] = 1
            table.columns[name] = column


def _find_drop_reason(
    layout: TableLayout, samples: Sequence[Float1D], reader: _CellReader, k: int
) -> str:
    """Return why a column holds no samples, or ""."""
    values = samples[k]
    is_unnamed = bool(layout.names) and not layout.names[k]
    if k in reader.texts:
        return f"text, such as {reader.texts[k]!r}"
    if k - 1 not in reader.texts and _is_fraction(layout, samples, k):
        return "the milliseconds of the times before it"
    if is_unnamed and np.isnan(values).all():
        return "empty, without a name"
    if is_unnamed and k == 0 and values.size > 1 and (np.diff(values) == 1).all():
        return "without a name, it counts the rows"
    return ""


def make_width_error(place: object, row: int, count: int, named: int) -> InputError:
    """Return the error of a row whose cells are not as many as the columns of the header."""
    hint = " (for decimal commas: export with points)" if count == 2 * named else ""
    return InputError(
        f"row {row} has {count} cells, the header {named} columns",
        where=place,
        remedy=f"give every row as many cells as the header{hint}",
    )


def _is_remark(cells: Sequence[str], width: int) -> bool:
    """Return True if a row is no sample: words only, or a line of words of another width."""
    filled = [split_quantity(cell)[0].strip() for cell in cells if cell.strip()]
    is_value = [is_number(cell.replace(",", ".", 1)) for cell in filled]
    return not any(is_value) or (len(cells) != width and not is_value[0])
