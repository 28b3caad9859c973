"""numpy's .npz: arrays by their names. Pickled objects are never loaded."""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from twin.stream.tables import Key, Table, part, put


def read(path: Path) -> Table:
    """The arrays of an .npz file, as its headers say; no number is read yet."""
    table = Table(path)
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
            put(table, name, shape, dtype.kind, (name,))
    return table


def load(path: Path, key: Key) -> Any:
    """A column's numbers, (row,)."""
    name, k = key
    with np.load(path, allow_pickle=False) as arrays:
        return part(arrays[name], int(k))
