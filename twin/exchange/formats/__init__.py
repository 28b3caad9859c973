"""Readers of sample tables: names, lengths and units of columns first, values on demand.

Each format has a module `<format>.py` in this folder. Parsing runs in a separate process, so that a
library that fails on a damaged file yields one InputError.
"""

from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError, format_pip_line
from twin.exchange.formats.sandbox import run_isolated

FORMATS = {
    ".parquet": "parquet",
    ".mat": "mat",
    ".uff": "uff", ".unv": "uff", ".uf": "uff", ".u58": "uff", ".58": "uff",
    ".tdms": "tdms",
    ".h5": "hdf5", ".hdf5": "hdf5", ".hdf": "hdf5",
    ".npz": "npz",
    ".xlsx": "xlsx", ".xlsm": "xlsx",
}  # fmt: skip
TOML_TEXTS = (
    "profile_toml",
    "rig_toml",
    "model_toml",
)  # config texts in exports of `shaketwin export`
MAX_ROWS = 2**27  # of a column: 18 h at 2 kHz
MAX_BYTES = 2**32  # of all imported columns, as float64
MAX_EXPANSION = 200  # uncompressed size over file size, plus 64 MiB
MAX_MATRIX_COLUMNS = 64  # of a two-dimensional array
MAX_LISTED_COLUMNS = 20  # in a message
MAX_EXACT_INTEGER = 2**53  # largest range that float64 represents exactly
KIND_NAMES = {
    "c": "complex",
    "O": "objects",
    "S": "text",
    "U": "text",
    "M": "dates",
    "V": "records",
}
ColumnKey = tuple[str | int, ...]  # identifies a column within its file


@dataclass(frozen=True, eq=False)
class ColumnInfo:
    """Description of a column of `size` rows; unit, rate and start time as stated in the file.

    `clock` names the column with its times, if any. `values` are set if they were read already.
    `group` is the group, structure or table that prefixes the name; a "/" in a name does not imply
    one.
    """

    size: int
    key: ColumnKey = ()
    unit: str = ""
    rate_hz: float | None = None
    start_s: float = 0.0
    clock: str = ""
    group: str = ""
    values: Float1D | None = None


@dataclass(frozen=True, eq=False)
class SampleTable:
    """Table of a file: columns by name, and skipped items with the reason."""

    path: Path
    columns: dict[str, ColumnInfo] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    first_row: int = 1  # row number in the file of the first sample
    skipped: dict[str, str] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)  # of TOML_TEXTS
    facts: dict[str, float] = field(default_factory=dict)  # stated: rate_hz, mass_kg

    def read_column(self, name: str) -> Float1D:
        """Read the values of a column, (row,), float64; NaN where a sample is lost."""
        source, held = f"{self.path}: column {name!r}", self.columns[name]
        if held.values is not None:
            values = held.values
        else:
            load = _load_format_module(self.path).load_column
            values = np.asarray(run_isolated(self.path, lambda: load(self.path, held.key)))
        if values.dtype.kind not in "fiub" or values.shape != (held.size,):
            description = KIND_NAMES.get(values.dtype.kind, f"{values.shape} of {values.dtype}")
            raise InputError(description, where=source, allowed="real numbers, one per sample")
        if (
            values.dtype.kind in "iu"
            and max(-int(values.min()), int(values.max())) > MAX_EXACT_INTEGER
        ):
            raise InputError(
                "integers beyond 2^53",
                where=source,
                remedy="subtract the first value and export the file again",
            )
        numbers = np.ascontiguousarray(values, dtype=np.float64)
        if np.isinf(numbers).any():
            row = int(np.argmax(np.isinf(numbers))) + self.first_row
            raise InputError(
                "infinite",
                where=f"{self.path}: row {row}, column {name!r}",
                remedy="leave lost samples empty",
            )
        return numbers

    @property
    def contents(self) -> tuple[str, ...]:
        """One line of text per column or skipped item."""
        lines = []
        for name, column in self.columns.items():
            unit = f", in {column.unit!r}" if column.unit else ""
            rate = f", {column.rate_hz:.9g} Hz" if column.rate_hz else ""
            lines.append(f"{name}: {column.size} rows{unit}{rate}")
        return (*lines, *(f"{name}: not a column: {why}" for name, why in self.skipped.items()))


def read_table(path: Path, group: str = "") -> SampleTable:
    """Read the table in a file, or in one group of it; raise InputError if there is none."""
    read = _load_format_module(path).scan_columns
    try:
        path.open("rb").close()
        table = (
            run_isolated(path, lambda: read(path)) if path.suffix.lower() in FORMATS else read(path)
        )
    except OSError as error:
        raise InputError(f"cannot read this table: {error.strerror}", where=path) from None
    if not table.columns:
        skipped = [f"{name} ({why})" for name, why in table.skipped.items()][:MAX_LISTED_COLUMNS]
        raise InputError(
            f"no column of numbers in it, only: {', '.join(skipped) or 'nothing'}",
            where=path,
            remedy="check that the suffix matches the format",
        )
    return _select_group(table, group.strip("/"))


def _load_format_module(path: Path) -> Any:
    """Import the reader module of a format.

    Its `scan_columns(path)` returns a SampleTable, `load_column(path, key)` the values of a column.
    """
    kind = FORMATS.get(path.suffix.lower(), "csv")
    try:
        return import_module(f"twin.exchange.formats.{kind}")
    except ModuleNotFoundError as error:
        raise InputError(
            f"{error.name} is not installed",
            where=path,
            remedy=format_pip_line("formats"),
        ) from None


def make_column(values: Float1D, unit: str = "") -> ColumnInfo:
    """Return a column whose values were read already."""
    return ColumnInfo(values.size, unit=unit, values=values)


def add_array(
    table: SampleTable,
    name: str,
    shape: tuple[int, ...],
    kind: str,
    key: ColumnKey,
    unit: str = "",
    group: str = "",
) -> None:
    """Add an array to a table: as one column, or a matrix as columns `name:1`, `name:2`, ...

    `kind` is numpy's dtype.kind. The samples of a matrix are along its longer side. The key of a
    column is that of the array and the column number, for `extract_column`.
    """
    lengths = [int(length) for length in shape if length != 1]
    if kind not in "fiub":
        table.skipped[name] = KIND_NAMES.get(kind, "no numbers")
    elif not lengths or 0 in shape:
        table.skipped[name] = "empty" if 0 in shape else "a single value"
    elif len(lengths) > 2 or (len(lengths) == 2 and min(lengths) > MAX_MATRIX_COLUMNS):
        table.skipped[name] = f"{' x '.join(map(str, shape))} values; allowed: a few columns"
    elif len(lengths) == 1:
        table.columns[name] = ColumnInfo(lengths[0], (*key, 0), unit, group=group)
    else:
        for k in range(min(lengths)):
            table.columns[f"{name}:{k + 1}"] = ColumnInfo(
                max(lengths), (*key, k), unit, group=group
            )


def extract_column(array: Any, k: int) -> Any:
    """Return column `k`, (row,), of an array added by `add_array`."""
    array = np.asarray(array)
    array = array.reshape([length for length in array.shape if length != 1])
    return array.reshape(max(array.shape), -1)[:, k] if _is_tall(array) else array[k]


def _is_tall(array: Any) -> bool:
    return array.ndim < 2 or array.shape[0] >= array.shape[1]


def check_size(table: SampleTable, names: list[str]) -> None:
    """Raise InputError if the columns to import are implausibly large for the file (zip bomb)."""
    max_bytes = min(MAX_BYTES, 2**26 + MAX_EXPANSION * table.path.stat().st_size)
    rows = [table.columns[name].size for name in names]
    if max(rows, default=0) > MAX_ROWS or 8 * sum(rows) > max_bytes:
        raise InputError(
            f"declares {sum(rows)} numbers in {table.path.stat().st_size} bytes",
            where=table.path,
            allowed=f"up to {max_bytes // 8}",
            remedy="the file is damaged, or import its parts one by one",
        )


def _select_group(table: SampleTable, group: str) -> SampleTable:
    """Select the columns of a group and strip its name; by default the group common to all."""
    groups = sorted({column.group for column in table.columns.values()})
    if not group:
        group = groups[0] if len(groups) == 1 else ""
    elif not any(name.startswith(f"{group}/") for name in table.columns):
        groups = [name for name in groups if name]
        raise InputError(
            f"no group {group!r}", where=table.path, allowed=", ".join(groups) or "none"
        )
    if not group:
        return table
    inside = {
        name.removeprefix(f"{group}/"): replace(
            column, clock=column.clock.removeprefix(f"{group}/")
        )
        for name, column in table.columns.items()
        if name.startswith(f"{group}/")
    }
    return replace(table, columns=inside)
