"""Readers of the texts of oscilloscopes.

Of Rigol: the head states start and interval of the times, as `X,CH1,CH2,Start,Increment` with the
units and the two numbers below it, or as `CH1V,CH2V,t0 = -0.5,tInc = 1e-3`; then come the samples.
Of Tektronix: the samples are in the fourth and fifth column, the settings beside the first ones.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TextIO

from table_io.errors import InputError
from table_io.formats.cells import CellRow, read_cells
from table_io.formats.layout import TableLayout, is_number
from table_io.formats.table import ForeignTable
from table_io.formats.words import find_unit, normalize_unit

KIND = "a text of an oscilloscope"
SCOPE_HEAD = re.compile(r'"?(?:X\b|CH\d|Time\b).*,\s*(?:Start,\s*Increment|t0\s*=.*tInc\s*=)', re.I)
SETTINGS_HEAD = "record length,"
SETTINGS_COLUMNS = 3
COUNTER = "Sequence"  # unit of the first column where it counts samples


def parse_scope(file: TextIO, path: Path) -> ForeignTable:
    """Read the channels, at the rate that the head states."""
    lines = file.read().splitlines()
    cells = _split(lines[0])
    place = next(k for k, cell in enumerate(cells) if re.match(r"(start|t0)\b", cell, re.I))
    names, facts = cells[:place], cells[place : place + 2]
    units, first = [find_unit(name) for name in names], 1
    if not facts[0].startswith(("t0", "T0")):
        below = _split(lines[1]) if len(lines) > 1 else []
        units, facts, first = below[:place], below[place : place + 2], 2
    numbers = [re.sub(r"^.*=\s*|\s*s$", "", fact) for fact in facts]
    if len(numbers) < 2 or not all(map(is_number, numbers)) or float(numbers[1]) <= 0:
        raise InputError(f"{KIND} without start and increment of its times", where=path)
    layout = TableLayout(
        (*names,), (*map(normalize_unit, units),), first, "n" * len(names), spare=("start",)
    )

    def iter_rows() -> Iterator[CellRow]:
        for number, line in enumerate(lines[first:], first + 1):
            row = _split(line)
            if any(row):
                yield number, row[:place] if not any(row[place:]) else row

    table = read_cells(path, KIND, layout, iter_rows())
    start_s, step_s = map(float, numbers)
    columns = {
        name: replace(column, rate_hz=1.0 / step_s, start_s=start_s)
        for name, column in table.columns.items()
        if column.unit != COUNTER
    }
    return replace(table, columns=columns)


def parse_settings(file: TextIO, path: Path) -> ForeignTable:
    """Read the times and samples of the channel that stand beside its settings."""
    rows = [_split(line) for line in file]
    settings = {row[0].lower(): row[1] for row in rows if len(row) > 1 and row[0]}
    units = [settings.get(f"{axis} units", "").lower() for axis in ("horizontal", "vertical")]
    layout = TableLayout(
        ("Time", settings.get("source", "") or "channel"), (*map(normalize_unit, units),), 0, "nn"
    )
    samples = ((k, row[SETTINGS_COLUMNS:][:2]) for k, row in enumerate(rows, 1) if any(row))
    return read_cells(path, KIND, layout, samples)


def _split(line: str) -> list[str]:
    return [cell.strip(' "') for cell in line.split(",")]
