"""Reader of numpy .npz files; pickled objects are never loaded."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from table_io.formats.table import ColumnKey, ForeignTable, extract_column
from table_io.formats.words import add_fact, find_fact


def scan_columns(path: Path) -> ForeignTable:
    """Scan the array headers of a file; values are not read."""
    table = ForeignTable(path, "", loader="npz")
    with zipfile.ZipFile(path) as archive:
        for member in archive.namelist():
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                header = (
                    np.lib.format.read_array_header_1_0
                    if version == (1, 0)
                    else np.lib.format.read_array_header_2_0
                )
                shape, _, dtype = header(file)
            name = member.removesuffix(".npy")
            for field in dtype.names or ():
                kind = dtype[field].kind if not dtype[field].shape else "V"
                table.add_array(f"{name}/{field}", shape, kind, (name, field), group=name)
            if not dtype.names:
                table.add_array(name, shape, dtype.kind, (name, ""))
            if (fact := find_fact(name)) and dtype.kind in "fiu" and {*shape} <= {1}:
                with np.load(path, allow_pickle=False) as arrays:
                    add_fact(table.facts, fact, float(arrays[name].item()))
    return table


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,)."""
    name, field, k = key
    with np.load(path, allow_pickle=False) as arrays:
        array = arrays[name]
        return extract_column(array[field] if field else array, int(k))
