"""Readers of the texts of LabVIEW: measurement files, .lvm, and exports of SignalExpress.

An .lvm has a header a file and a header a segment; the last cell of a row may be a comment. Source:
NI, "Specification for the LabVIEW Measurement File (.lvm)", version 2. SignalExpress writes a key
such as `dt:` in a line, and below it a cell a channel.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import TextIO

import numpy as np

from table_io.errors import InputError
from table_io.formats.cells import read_cells
from table_io.formats.layout import ClockReader, TableLayout, is_number, parse_number
from table_io.formats.table import ForeignColumn, ForeignTable, make_column

FIRST_WORDS = "LabVIEW Measurement"
EXPRESS_WORDS = "channel names:"
EXPRESS_KIND = "a text of LabVIEW SignalExpress"
KIND = "a LabVIEW measurement file (.lvm)"
HEADER_END = "***End_of_Header***"
SEPARATORS = {"Tab": "\t", "Comma": ","}
CLOCK = "X_Value"
Columns = dict[str, ForeignColumn]


def parse_lvm(file: TextIO, path: Path) -> ForeignTable:
    """Read all segments: joined if time goes on, else each one is a group `segment 1`, ..."""
    lines = file.read().splitlines()
    ends = [k for k, line in enumerate(lines) if line.startswith(HEADER_END)]
    if len(ends) < 2:
        raise InputError(
            f"{KIND}: it has no segment of samples", where=path, remedy="export TDMS or CSV"
        )
    mark = "\t" if "\t" in lines[1] else ","
    header = {
        key: cells[0] for line in lines[: ends[0]] for key, *cells in [line.split(mark)] if cells
    }
    separator = SEPARATORS.get(header.get("Separator", "").strip(), "\t")
    rows = [[cell.strip() for cell in line.split(separator)] for line in lines]
    begins = [k for k, row in enumerate(rows) if row[0] == "Channels"]
    segments = [
        _read_segment(rows, begin, end, after, header, path)
        for begin, end, after in zip(begins, ends[1:], [*begins[1:], len(rows)], strict=False)
    ]
    table = ForeignTable(path, KIND, segments[0], first_row=ends[1] + 3)
    if len(segments) == 1:
        return table
    if all(_goes_on(before, after) for before, after in pairwise(segments)):
        joined = {
            name: [np.asarray(segment[name].values) for segment in segments] for name in segments[0]
        }
        columns = {
            name: replace(segments[0][name], size=sum(map(np.size, parts)), values=np.hstack(parts))
            for name, parts in joined.items()
        }
        return replace(table, columns=columns, notes=(f"{len(segments)} segments, joined",))
    columns = {}
    for number, segment in enumerate(segments, 1):
        group = f"segment {number}"
        columns |= {
            f"{group}/{name}": replace(
                column, group=group, clock=column.clock and f"{group}/{column.clock}"
            )
            for name, column in segment.items()
        }
    note = f"{len(segments)} segments, each one is a group: time does not go on"
    return replace(table, columns=columns, notes=(note,))


def parse_express(file: TextIO, path: Path) -> ForeignTable:
    """Read an export of SignalExpress: names, starts and intervals of channels, then samples."""
    rows = [[cell.strip() for cell in line.rstrip().split("\t")] for line in file]
    keys = {row[0].lower(): rows[k + 1] for k, row in enumerate(rows[:-1]) if row[0][-1:] == ":"}
    names, intervals = keys[EXPRESS_WORDS], keys.get("dt:", [])
    first = next((k for k, row in enumerate(rows, 1) if row[0].lower() == "data:"), len(rows))
    if not all(map(is_number, intervals)) or first == len(rows):
        raise InputError(
            f"{EXPRESS_KIND} without samples, or with an interval that is no number",
            where=path,
            remedy="export TDMS or CSV",
        )
    clock = ClockReader()
    try:
        starts_s = [clock(cell) for cell in keys.get("start times:", [])]
    except ValueError as error:
        raise InputError(f"{EXPRESS_KIND}: {error} is no time", where=path) from None
    layout = TableLayout((*names,), ("",) * len(names), first, "n" * len(names))
    samples = ((number, row) for number, row in enumerate(rows, 1) if number > first and any(row))
    table = read_cells(path, EXPRESS_KIND, layout, samples)
    for name, cell, start_s in zip_longest(names, intervals, starts_s):
        if name in table.columns and cell is not None and parse_number(cell) > 0.0:
            table.columns[name] = replace(
                table.columns[name],
                rate_hz=1.0 / parse_number(cell),
                start_s=0.0 if start_s is None else start_s - starts_s[0],
            )
    return table


def _goes_on(before: Columns, after: Columns) -> bool:
    """Return True if a segment has the channels and units of the one before it, and later times."""
    units = [{name: column.unit for name, column in part.items()} for part in (before, after)]
    clocks = [name for name in before if name.startswith(CLOCK)]
    return units[0] == units[1] and all(
        after[name].values[0] > before[name].values[-1]  # type: ignore[index]
        for name in clocks
    )


def _read_segment(
    rows: Sequence[list[str]], begin: int, end: int, after: int, header: dict[str, str], path: Path
) -> Columns:
    """Read the columns of the segment whose header is in rows `begin` to `end`."""
    keys = {row[0]: row[1:] for row in rows[begin:end]}
    names = rows[end + 1]
    if names[-1] in ("Comment", ""):
        names = names[:-1]
    x_columns = header.get("X_Columns", "One").strip()
    if x_columns == "Multi":
        names = [name if k % 2 else f"{CLOCK} of {names[k + 1]}" for k, name in enumerate(names)]
    layout = TableLayout(
        (*names,), ("",) * len(names), end + 2, "n" * len(names),
        header.get("Decimal_Separator", ".").strip() == ",", ("Comment",),
    )  # fmt: skip
    samples = ((number, row) for number, row in enumerate(rows[:after], 1) if number > end + 2)
    part = read_cells(path, KIND, layout, ((n, row) for n, row in samples if any(row)))
    channels = [name for name in names if not name.startswith(CLOCK)]
    columns: Columns = {}
    starts_s: list[float] = []
    for k, name in enumerate(channels):
        if name not in part.columns:  # no numbers, or two channels of this name
            continue
        unit, size_text, start_text, interval_text = (
            _list_cells(keys.get(key, []), len(channels))[k].replace(",", ".")
            for key in ("Y_Unit_Label", "Samples", "X0", "Delta_X")
        )
        size = int(size_text) if size_text.isdigit() else part.columns[name].size
        start_s, interval_s = (
            float(text) if is_number(text) else 0.0 for text in (start_text, interval_text)
        )
        clock = f"{CLOCK} of {name}"
        values = part.read_column(name)[:size]
        if x_columns == "No":
            times = np.asarray(start_s + interval_s * np.arange(values.size), dtype=np.float64)
        else:
            times = part.read_column(clock if x_columns == "Multi" else CLOCK)[:size]
        starts_s.append(start_s)
        if x_columns == "One":  # the column is that of the first channel
            times = times + (start_s - starts_s[0])
        if x_columns != "Multi" and len({*starts_s}) == 1:
            clock = CLOCK
        columns.setdefault(clock, make_column(times, "s", 0))
        rate_hz = 1.0 / interval_s if interval_s > 0 else None
        columns[name] = ForeignColumn(
            values.size, (k + 1,), unit, rate_hz, start_s, clock, values=values
        )
    return columns


def _list_cells(cells: list[str], count: int) -> list[str]:
    """Return the cells of a header line, one for each channel; those of X columns are empty."""
    filled = [cell for cell in cells if cell]
    return filled if len(filled) == count else [*cells, *[""] * count]
