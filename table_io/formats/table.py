"""What a foreign file holds: columns with name, unit and times, and what is no column, with reason.

A format's `scan_columns` describes the columns; values that are long are read on demand by its
`load_column`, in a process of their own.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.errors import InputError
from table_io.formats.sandbox import run_isolated

TOML_TEXTS = ("profile_toml", "rig_toml", "model_toml")  # config texts in an export of ours
MAX_ROWS = 2**27  # of a column: 18 h at 2 kHz
MAX_BYTES = 2**32  # of all columns that are read, as float64
MAX_EXPANSION = 200  # uncompressed size over file size, plus EXPANSION_BYTES
EXPANSION_BYTES = 2**26
MAX_COLUMNS = 4096  # of a table or a group: hundreds of channels, several runs of them
MAX_MATRIX_COLUMNS = 64  # of a two-dimensional array
MAX_EXACT_INTEGER = 2**53  # largest range that float64 represents exactly
KIND_NAMES = {
    "c": "complex",
    "O": "objects",
    "S": "text",
    "U": "text",
    "V": "records",
}
ColumnKey = tuple[str | int, ...]  # identifies a column within its file
TableColumns = Mapping[str, Any]  # arrays of one length by name, to be written


@dataclass(frozen=True, eq=False)
class ForeignColumn:
    """Description of a column of `size` rows; unit and times as stated in the file.

    Its times follow from `rate_hz` and `start_s`, or are the values of the column `clock`, or those
    of another column of the table. `values` are set if they were read already. `group` is the
    group, structure or sheet that prefixes the name; a "/" in a name does not imply one.
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
class ForeignTable:
    """Table of a file: what the file is, its columns by name, and what is no column, and why.

    `facts` are numbers that the file states of the test: `rate_hz`, `mass_kg`. `texts` are the
    configs of an export of ours, by TOML_TEXTS.
    """

    path: Path
    kind: str  # what the file is, in words
    columns: dict[str, ForeignColumn] = field(default_factory=dict)
    dropped: dict[str, str] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    first_row: int = 1  # row number in the file of the first sample
    rows: Int1D | None = None  # row numbers of all samples, if lines between them are no samples
    texts: dict[str, str] = field(default_factory=dict)
    facts: dict[str, float] = field(default_factory=dict)
    loader: str = ""  # module of this package whose `load_column` reads the values of a column

    def describe_row(self, place: int) -> str:
        """Return the file and the row in it of the sample at `place`, from 0."""
        row = place + self.first_row if self.rows is None else int(self.rows[place])
        return f"{self.path}: row {row}"

    def read_column(self, name: str) -> Float1D:
        """Read the values of a column, (row,), float64; NaN where a sample is lost.

        Dates are read as times in s from the first one, durations in s.
        """
        source, column = f"{self.path}: column {name!r}", self.columns[name]
        values: Any = column.values
        if values is None:
            load = import_module(f"table_io.formats.{self.loader}").load_column
            values = np.asarray(run_isolated(self.path, lambda: load(self.path, column.key)))
        if values.dtype.kind == "M":
            values = values - values[:1]
        if values.dtype.kind == "m":
            values = values / np.timedelta64(1, "s")
        if values.dtype.kind not in "fiub" or values.shape != (column.size,):
            description = KIND_NAMES.get(values.dtype.kind, f"{values.shape} of {values.dtype}")
            raise InputError(description, where=source, allowed="real numbers, one per sample")
        is_clock = values.dtype.kind in "iu" and bool((values[1:] > values[:-1]).all())
        if (
            values.dtype.kind in "iu"
            and max(-int(values.min()), int(values.max())) > MAX_EXACT_INTEGER
            and not is_clock  # ns since 1970 keep 0.3 us
        ):
            raise InputError(
                "integers beyond 2^53",
                where=source,
                remedy="subtract the first value and export the file again",
            )
        numbers = np.ascontiguousarray(values, dtype=np.float64)
        if np.isinf(numbers).any():
            raise InputError(
                "infinite",
                where=f"{self.describe_row(int(np.argmax(np.isinf(numbers))))}, column {name!r}",
                remedy="leave lost samples empty",
            )
        return numbers

    @property
    def contents(self) -> tuple[str, ...]:
        """One line of text per column or dropped item."""
        lines = []
        for name, column in self.columns.items():
            unit = f", in {column.unit!r}" if column.unit else ""
            rate = f", {column.rate_hz:.9g} Hz" if column.rate_hz else ""
            lines.append(f"{name}: {column.size} rows{unit}{rate}")
        return (*lines, *(f"{name}: not a column: {why}" for name, why in self.dropped.items()))

    def select_group(self, group: str) -> "ForeignTable":
        """Return the columns of a group, without its name; by default of the one common to all."""
        groups = sorted({column.group for column in self.columns.values()})
        if not group:
            group = groups[0] if len(groups) == 1 else ""
        elif not any(name.startswith(f"{group}/") for name in self.columns):
            allowed = ", ".join(name for name in groups if name)
            raise InputError(f"no group {group!r}", where=self.path, allowed=allowed or "none")
        if not group:
            return self
        prefix = f"{group}/"
        inside = {
            name.removeprefix(prefix): replace(column, clock=column.clock.removeprefix(prefix))
            for name, column in self.columns.items()
            if name.startswith(prefix)
        }
        dropped = {name.removeprefix(prefix): why for name, why in self.dropped.items()}
        return replace(self, columns=inside, dropped=dropped)

    def check_size(self, names: list[str]) -> None:
        """Raise InputError if columns are implausibly large for the file (zip bomb)."""
        file_bytes = self.path.stat().st_size
        max_bytes = min(MAX_BYTES, EXPANSION_BYTES + MAX_EXPANSION * file_bytes)
        sizes = [self.columns[name].size for name in names]
        if max(sizes, default=0) > MAX_ROWS or 8 * sum(sizes) > max_bytes:
            raise InputError(
                f"declares {sum(sizes)} numbers in {file_bytes} bytes",
                where=self.path,
                allowed=f"up to {max_bytes // 8}",
                remedy="the file is damaged, or import its parts one by one",
            )

    def add_array(
        self,
        name: str,
        shape: tuple[int, ...],
        kind: str,
        key: ColumnKey,
        unit: str = "",
        group: str = "",
    ) -> None:
        """Add an array: as one column, or a matrix as columns `name:1`, `name:2`, ...

        `kind` is numpy's dtype.kind. The samples of a matrix are along its longer side. The key of
        a column is that of the array and the column number, for `extract_column`.
        """
        lengths = [int(length) for length in shape if length != 1]
        if kind not in "fiubM":
            self.dropped[name] = KIND_NAMES.get(kind, "no numbers")
        elif not lengths or 0 in shape:
            self.dropped[name] = "empty" if 0 in shape else "a single value"
        elif len(lengths) > 2 or (len(lengths) == 2 and min(lengths) > MAX_MATRIX_COLUMNS):
            self.dropped[name] = f"{' x '.join(map(str, shape))} values; allowed: a few columns"
        elif len(lengths) == 1:
            self.columns[name] = ForeignColumn(lengths[0], (*key, 0), unit, group=group)
        else:
            for k in range(min(lengths)):
                self.columns[f"{name}:{k + 1}"] = ForeignColumn(
                    max(lengths), (*key, k), unit, group=group
                )


def make_column(values: Float1D, unit: str = "", number: int = 1) -> ForeignColumn:
    """Return a column, the `number`-th of its file, whose values were read already."""
    return ForeignColumn(values.size, (number,), unit, values=values)


def extract_column(array: Any, k: int) -> Any:
    """Return column `k`, (row,), of an array added by `add_array`."""
    array = np.asarray(array)
    array = array.reshape([length for length in array.shape if length != 1])
    is_tall = array.ndim < 2 or array.shape[0] >= array.shape[1]
    return array.reshape(max(array.shape), -1)[:, k] if is_tall else array[k]


def check_column_count(count: int, path: Path) -> None:
    """Raise InputError if a table has more columns than the channels of any laboratory."""
    if count > MAX_COLUMNS:
        raise InputError(
            f"{count} columns",
            where=path,
            allowed=f"up to {MAX_COLUMNS}",
            remedy="export the channels of the test alone, or name one group of the file",
        )


def check_expansion(size: int, path: Path) -> None:
    """Raise InputError if the parts of an archive expand beyond the limit (decompression bomb)."""
    if size > EXPANSION_BYTES + MAX_EXPANSION * path.stat().st_size:
        raise InputError(
            f"expands to {size} bytes, more than {MAX_EXPANSION} times its size",
            where=path,
            remedy="the file is damaged, or export the table as CSV",
        )
