"""Reader of LabVIEW measurement files, .lvm: text with a header a file and a header a segment.

Source: NI, "Specification for the LabVIEW Measurement File (.lvm)", version 2. Columns are those of
the Y values; the last cell of a row may be a comment.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TextIO

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from table_io.formats.table import ForeignColumn, ForeignTable

FIRST_WORDS = "LabVIEW Measurement"
KIND = "a LabVIEW measurement file (.lvm)"
HEADER_END = "***End_of_Header***"
SEPARATORS = {"Tab": "\t", "Comma": ",", "Semicolon": ";"}


@dataclass(frozen=True, eq=False)
class _LvmSegment:
    """Channels of one segment: names, units, intervals and first times in s; values (cell, row)."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    intervals_s: tuple[float, ...]
    starts_s: tuple[float, ...]
    sizes: tuple[int, ...]
    values: Float2D
    first_row: int

    def times(self, k: int, x_columns: str) -> Float1D:
        """Return the times of channel `k` in s, (row,): those in the file, or of its interval."""
        if x_columns == "No":
            return np.asarray(
                self.starts_s[k] + self.intervals_s[k] * np.arange(self.sizes[k]), dtype=np.float64
            )
        return self.values[2 * k if x_columns == "Multi" else 0, : self.sizes[k]]

    def channel(self, k: int, x_columns: str) -> Float1D:
        """Return the values of channel `k`, (row,)."""
        return self.values[2 * k + 1 if x_columns == "Multi" else k + 1, : self.sizes[k]]


def parse_lvm(file: TextIO, path: Path) -> ForeignTable:
    """Read all segments: joined if time goes on, else each one is a group `segment 1`, ..."""
    lines = file.read().splitlines()
    ends = [k for k, line in enumerate(lines) if line.startswith(HEADER_END)]
    if len(ends) < 2:
        raise InputError(
            f"{KIND}: it has no segment of samples", where=path, remedy="export TDMS or CSV"
        )
    header = _read_keys(lines[: ends[0]], None)
    separator = SEPARATORS.get(header.get("Separator", ["Tab"])[0], "\t")
    has_commas = header.get("Decimal_Separator", ["."])[0] == ","
    x_columns = header.get("X_Columns", ["One"])[0]
    begins = [k for k, line in enumerate(lines) if line.split(separator)[0] == "Channels"]
    segments = [
        _read_segment(lines, begin, end, after, separator, has_commas, x_columns, path)
        for begin, end, after in zip(begins, ends[1:], [*begins[1:], len(lines)], strict=False)
    ]
    table = ForeignTable(path, KIND, first_row=segments[0].first_row)
    joined = _join_segments(segments, x_columns)
    if joined is not None:
        _add_segment(table, joined, x_columns, is_joined=len(segments) > 1)
    else:
        for number, segment in enumerate(segments, 1):
            _add_segment(table, segment, x_columns, f"segment {number}")
    if len(segments) > 1:
        how = "joined" if joined is not None else "each one is a group; time does not go on"
        table = replace(table, notes=(f"{len(segments)} segments, {how}",))
    return table


def _read_keys(lines: list[str], separator: str | None) -> dict[str, list[str]]:
    """Return the cells of each line by its first one."""
    keys = {}
    for line in lines:
        mark = separator or ("\t" if "\t" in line else "," if "," in line else ";")
        key, *cells = (cell.strip() for cell in line.split(mark))
        keys[key] = cells
    return keys


def _read_segment(
    lines: list[str], begin: int, end: int, after: int, separator: str, has_commas: bool,
    x_columns: str, path: Path,
) -> _LvmSegment:  # fmt: skip
    """Read the segment whose header is in lines `begin` to `end`, its samples before `after`."""
    keys = _read_keys(lines[begin:end], separator)
    names = [name.strip() for name in lines[end + 1].split(separator)]
    if names[-1] in ("Comment", ""):
        names.pop()
    width = len(names)
    names = names[1::2] if x_columns == "Multi" else names[1:]
    count = len(names)
    rows = []
    for number, line in enumerate(lines[end + 2 : after], end + 3):
        if not line.strip():
            continue
        cells = [cell.strip() for cell in line.split(separator)][:width]
        try:
            numbers = [
                float(cell.replace(",", ".") if has_commas else cell) if cell else np.nan
                for cell in cells
            ]
        except ValueError:
            raise InputError(
                f"{KIND}: {line.strip()[:40]!r} is no row of numbers", where=f"{path}: row {number}"
            ) from None
        rows.append(numbers + [np.nan] * (width - len(numbers)))

    def read_numbers(key: str) -> tuple[float, ...]:
        cells = [cell.replace(",", ".") for cell in keys.get(key, [])[:count]]
        numbers = [float(cell) if cell else 0.0 for cell in cells]
        return (*numbers, *[0.0] * (count - len(numbers)))

    values = np.array(rows, dtype=np.float64).reshape(-1, width).T
    sizes = [min(int(size) or values.shape[1], values.shape[1]) for size in read_numbers("Samples")]
    units = [unit or "" for unit in keys.get("Y_Unit_Label", [])[:count]]
    units += [""] * (count - len(units))
    return _LvmSegment(
        (*names,),
        (*units,),
        read_numbers("Delta_X"),
        read_numbers("X0"),
        (*sizes,),
        values,
        end + 3,
    )


def _join_segments(segments: list[_LvmSegment], x_columns: str) -> _LvmSegment | None:
    """Return all segments as one; None if their channels differ or time does not go on."""
    first = segments[0]
    for before, segment in pairwise(segments):
        is_same = (segment.names, segment.units, segment.intervals_s) == (
            first.names, first.units, first.intervals_s,
        )  # fmt: skip
        if not is_same or len({*segment.sizes}) > 1 or not before.sizes[0]:
            return None
        if not segment.times(0, x_columns)[0] > before.times(0, x_columns)[-1]:
            return None
    if len(segments) == 1:
        return first
    values = [segment.values[:, : segment.sizes[0]] for segment in segments]
    if x_columns == "No":
        times = np.concatenate([segment.times(0, x_columns) for segment in segments])
        joined = np.concatenate(values, axis=1)
        joined[0] = times
    else:
        joined = np.concatenate(values, axis=1)
    return replace(first, values=joined, sizes=(joined.shape[1],) * len(first.names))


def _add_segment(
    table: ForeignTable,
    segment: _LvmSegment,
    x_columns: str,
    group: str = "",
    is_joined: bool = False,
) -> None:
    prefix = f"{group}/" if group else ""
    has_times = x_columns != "No" or is_joined
    if has_times and x_columns == "No":
        x_columns = "One"
    for k, name in enumerate(segment.names):
        clock = ""
        if has_times:
            clock = f"{prefix}X_Value" + (f" of {name}" if x_columns == "Multi" else "")
            times = segment.times(k, x_columns)
            table.columns.setdefault(
                clock, ForeignColumn(times.size, (0,), "s", group=group, values=times.copy())
            )
        values = segment.channel(k, x_columns).copy()
        interval_s = segment.intervals_s[k]
        table.columns[prefix + name] = ForeignColumn(
            values.size,
            (k + 1,),
            segment.units[k],
            1.0 / interval_s if interval_s > 0 else None,
            segment.starts_s[k],
            clock,
            group,
            values,
        )
