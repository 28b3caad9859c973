"""Reader of HDF5 and MATLAB v7.3 files; only this file imports h5py.

Datasets are named by their path. Links into other files are never followed.
"""

from pathlib import Path
from typing import Any

import h5py

from twin.exchange.formats import TOML_TEXTS, ColumnKey, SampleTable, add_array, extract_column

UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit", "unit_string")
MAX_CHUNK_BYTES = 2**26  # the library always loads whole chunks


def scan_columns(path: Path) -> SampleTable:
    """Scan the datasets of a file; values are not read."""
    table = SampleTable(path)
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                _add_dataset(table, name, item)

        file.visititems(visit)
    return table


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,)."""
    name, field, k = key
    with h5py.File(path, "r") as file:
        return extract_column(file[name][field or ()], int(k))


def _add_dataset(table: SampleTable, name: str, item: Any) -> None:
    if item.is_virtual or item.external:
        table.skipped[name] = "its values are in another file"
    elif _chunk_bytes(item) > MAX_CHUNK_BYTES:
        table.skipped[name] = f"in chunks of more than {MAX_CHUNK_BYTES} bytes"
    elif _to_text(item.attrs.get("MATLAB_class", "")) == "char":
        table.skipped[name] = "text"
        if name in TOML_TEXTS and item.size < 10**6:
            table.texts[name] = "".join(map(chr, item[()].reshape(-1)))
    elif "MATLAB_empty" in item.attrs or item.shape is None:
        table.skipped[name] = "empty"
    elif item.dtype.names:
        for field in item.dtype.names:
            kind = item.dtype[field].kind if not item.dtype[field].shape else "V"
            add_array(table, f"{name}/{field}", item.shape, kind, (name, field), group=name)
    else:
        unit = next((_to_text(item.attrs[key]) for key in UNIT_ATTRIBUTES if key in item.attrs), "")
        add_array(
            table, name, item.shape, item.dtype.kind, (name, ""), unit, name.rpartition("/")[0]
        )


def _chunk_bytes(item: Any) -> int:
    size = item.dtype.itemsize
    for length in item.chunks or ():
        size *= length
    return int(size)


def _to_text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)
