"""Somebody's file as columns: their names, lengths and units first, their numbers when asked for.

A format is one file beside this one, `<format>.py`. What a foreign library makes of a damaged
file stays in a process of its own and comes out as one sentence.
"""

from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Float1D
from table_io.card import BadInput
from twin.stream.tables.sandbox import apart

FORMATS = {
    ".parquet": "parquet",
    ".mat": "mat",
    ".uff": "uff", ".unv": "uff", ".uf": "uff", ".u58": "uff", ".58": "uff",
    ".tdms": "tdms",
    ".h5": "hdf5", ".hdf5": "hdf5", ".hdf": "hdf5",
    ".npz": "npz",
}  # fmt: skip
TEXTS = ("profile_toml", "rig_toml", "model_toml")  # what our own exports carry beside the samples
MOST_ROWS = 2**27  # of a column: 18 h at 2 kHz
MOST_BYTES = 2**32  # of all columns that are taken, as float64
MOST_TIMES = 200  # what is in a file may be so much larger than the file, and 64 MiB
MOST_COLUMNS = 64  # of an array of two dimensions
MOST_NAMED = 20  # columns in a message
EXACT = 2**53  # integers up to here are the same as float64
KINDS = {"c": "complex", "O": "objects", "S": "text", "U": "text", "M": "dates", "V": "records"}
Key = tuple[str | int, ...]  # how a reader finds a column again


@dataclass(frozen=True, eq=False)
class Held:
    """A column of `size` rows, still in its file; unit, rate and begin as the file has it.

    `clock` is the column with its times, where the file has such a one for it. `values` are its
    numbers where they were read at once. `group` is the group, structure or table that its name
    begins with: a "/" alone is none, it may stand in a unit.
    """

    size: int
    key: Key = ()
    unit: str = ""
    rate_hz: float | None = None
    start_s: float = 0.0
    clock: str = ""
    group: str = ""
    values: Float1D | None = None


@dataclass(frozen=True, eq=False)
class Table:
    """What a file holds: columns by name, and what cannot be a column with the reason."""

    path: Path
    columns: dict[str, Held] = field(default_factory=dict)
    said: tuple[str, ...] = ()
    first_row: int = 1  # number in the file of the first row of numbers
    others: dict[str, str] = field(default_factory=dict)
    texts: dict[str, str] = field(default_factory=dict)  # of TEXTS

    def read(self, name: str) -> Float1D:
        """The numbers of a column, (row,), float64; NaN where a sample is lost."""
        where, held = f"{self.path}: column {name!r}", self.columns[name]
        if held.values is not None:
            values = held.values
        else:
            load = _reader(self.path).load
            values = np.asarray(apart(self.path, lambda: load(self.path, held.key)))
        if values.dtype.kind not in "fiub" or values.shape != (held.size,):
            what = KINDS.get(values.dtype.kind, f"{values.shape} of {values.dtype}")
            raise BadInput(f"{where}: {what}; allowed: real numbers, one a sample")
        if values.dtype.kind in "iu" and max(-int(values.min()), int(values.max())) > EXACT:
            raise BadInput(f"{where}: integers beyond 2^53; subtract the first, export it again")
        numbers = np.ascontiguousarray(values, dtype=np.float64)
        if np.isinf(numbers).any():
            row = int(np.argmax(np.isinf(numbers))) + self.first_row
            raise BadInput(
                f"{self.path}: row {row}, column {name!r}: infinite; leave lost samples empty"
            )
        return numbers

    @property
    def contents(self) -> tuple[str, ...]:
        """A line for everything in the file."""
        lines = []
        for name, held in self.columns.items():
            unit = f", in {held.unit!r}" if held.unit else ""
            rate = f", {held.rate_hz:.9g} Hz" if held.rate_hz else ""
            lines.append(f"{name}: {held.size} rows{unit}{rate}")
        return (*lines, *(f"{name}: no column: {why}" for name, why in self.others.items()))


def read_table(path: Path, group: str = "") -> Table:
    """The table in a file, or in one group of it; BadInput where it is none."""
    read = _reader(path).read
    try:
        path.open("rb").close()
        table = apart(path, lambda: read(path)) if path.suffix.lower() in FORMATS else read(path)
    except OSError as error:
        raise BadInput(f"{path}: cannot read this table: {error.strerror}") from None
    if not table.columns:
        what = [f"{name} ({why})" for name, why in table.others.items()][:MOST_NAMED]
        raise BadInput(
            f"{path}: no column of numbers in it; there: {', '.join(what) or 'nothing'}; "
            "is it what its name says?"
        )
    return _within(table, group.strip("/"))


def _reader(path: Path) -> Any:
    """The file beside this one that reads a format: `read(path)` gives a Table, `load(path, key)`
    a column."""
    kind = FORMATS.get(path.suffix.lower(), "csv")
    try:
        return import_module(f"twin.stream.tables.{kind}")
    except ModuleNotFoundError as error:
        raise BadInput(
            f"{path}: {error.name} is not installed; pip install shaketwin[formats]"
        ) from None


def in_memory(values: Float1D, unit: str = "") -> Held:
    """A column that is read already."""
    return Held(values.size, unit=unit, values=values)


def put(
    table: Table,
    name: str,
    shape: tuple[int, ...],
    kind: str,
    key: Key,
    unit: str = "",
    group: str = "",
) -> None:
    """Add an array of a file to its table: one column, or those of a matrix as `name:1`, `name:2`.

    `kind` is numpy's (dtype.kind). The samples of a matrix lie along its longer side. A column's
    key is the array's and its number, which `part` undoes.
    """
    long = [int(length) for length in shape if length != 1]
    if kind not in "fiub":
        table.others[name] = KINDS.get(kind, "no numbers")
    elif not long or 0 in shape:
        table.others[name] = "empty" if 0 in shape else "a single value"
    elif len(long) > 2 or (len(long) == 2 and min(long) > MOST_COLUMNS):
        table.others[name] = f"{' x '.join(map(str, shape))} values; allowed: a few columns"
    elif len(long) == 1:
        table.columns[name] = Held(long[0], (*key, 0), unit, group=group)
    else:
        for k in range(min(long)):
            table.columns[f"{name}:{k + 1}"] = Held(max(long), (*key, k), unit, group=group)


def part(array: Any, k: int) -> Any:
    """Column `k` of an array that `put` has seen, (row,)."""
    array = np.asarray(array)
    array = array.reshape([length for length in array.shape if length != 1])
    return array.reshape(max(array.shape), -1)[:, k] if _tall(array) else array[k]


def _tall(array: Any) -> bool:
    return array.ndim < 2 or array.shape[0] >= array.shape[1]


def bounded(table: Table, names: list[str]) -> None:
    """BadInput where the columns to be taken are larger than such a file can mean."""
    at_most = min(MOST_BYTES, 2**26 + MOST_TIMES * table.path.stat().st_size)
    rows = [table.columns[name].size for name in names]
    if max(rows, default=0) > MOST_ROWS or 8 * sum(rows) > at_most:
        raise BadInput(
            f"{table.path}: says that it holds {sum(rows)} numbers in {table.path.stat().st_size} "
            f"bytes; allowed: {at_most // 8}; it is damaged, or import its parts one by one"
        )


def _within(table: Table, group: str) -> Table:
    """The columns inside a group, without its name; without one, the group that all are in goes."""
    groups = sorted({held.group for held in table.columns.values()})
    if not group:
        group = groups[0] if len(groups) == 1 else ""
    elif not any(name.startswith(f"{group}/") for name in table.columns):
        groups = [one for one in groups if one]
        raise BadInput(f"{table.path}: no group {group!r}; there: {', '.join(groups) or 'none'}")
    if not group:
        return table
    inside = {
        name.removeprefix(f"{group}/"): replace(held, clock=held.clock.removeprefix(f"{group}/"))
        for name, held in table.columns.items()
        if name.startswith(f"{group}/")
    }
    return replace(table, columns=inside)
