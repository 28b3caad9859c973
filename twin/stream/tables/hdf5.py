"""HDF5, and MATLAB's v7.3 which is HDF5. The only file that knows h5py.

Every dataset is named by its path. Links into other files are never followed.
"""

from pathlib import Path
from typing import Any

import h5py

from twin.stream.tables import TEXTS, Key, Table, part, put

UNITS = ("units", "unit", "Units", "Unit", "unit_string")
LARGEST_CHUNK = 2**26  # bytes: the library holds a whole chunk, whatever is read of it


def read(path: Path) -> Table:
    """The datasets of a file, as they describe themselves; no number is read yet."""
    table = Table(path)
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                _dataset(table, name, item)

        file.visititems(visit)
    return table


def load(path: Path, key: Key) -> Any:
    """A column's numbers, (row,)."""
    name, field, k = key
    with h5py.File(path, "r") as file:
        return part(file[name][field or ()], int(k))


def _dataset(table: Table, name: str, item: Any) -> None:
    if item.is_virtual or item.external:
        table.others[name] = "its numbers lie in another file"
    elif _chunk_bytes(item) > LARGEST_CHUNK:
        table.others[name] = f"in chunks of more than {LARGEST_CHUNK} bytes"
    elif _word(item.attrs.get("MATLAB_class", "")) == "char":
        table.others[name] = "text"
        if name in TEXTS and item.size < 10**6:
            table.texts[name] = "".join(map(chr, item[()].reshape(-1)))
    elif "MATLAB_empty" in item.attrs or item.shape is None:
        table.others[name] = "empty"
    elif item.dtype.names:
        for one in item.dtype.names:
            kind = item.dtype[one].kind if not item.dtype[one].shape else "V"
            put(table, f"{name}/{one}", item.shape, kind, (name, one), group=name)
    else:
        unit = next((_word(item.attrs[key]) for key in UNITS if key in item.attrs), "")
        put(table, name, item.shape, item.dtype.kind, (name, ""), unit, name.rpartition("/")[0])


def _chunk_bytes(item: Any) -> int:
    size = item.dtype.itemsize
    for length in item.chunks or ():
        size *= length
    return int(size)


def _word(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
