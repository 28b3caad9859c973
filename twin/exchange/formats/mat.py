"""Reader and writer of MATLAB .mat files up to v7 (scipy.io); v7.3 is read as HDF5.

The fields of a structure are named `structure/field`.
"""

import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.io import loadmat, savemat, whosmat

from table_io.errors import InputError
from twin.exchange.formats import (
    MAX_EXPANSION,
    TOML_TEXTS,
    ColumnKey,
    SampleTable,
    add_array,
    extract_column,
)
from twin.exchange.formats.layout import add_fact, find_fact
from twin.recording.tabular import LogTable

HEADER_BYTES = 128
HDF5_MAGIC = b"\x89HDF"
MI_COMPRESSED = 15  # miCOMPRESSED
MAX_DEPTH = 8
NUMPY_KINDS = {"double": "f", "single": "f", "logical": "b", "char": "U", "cell": "O"}
INTEGER_CLASSES = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))


def scan_columns(path: Path) -> SampleTable:
    """Scan the variables of a file; structures are read now, other values on demand."""
    if _is_hdf5(path):
        from twin.exchange.formats.hdf5 import scan_columns as read_hdf5

        return read_hdf5(path)
    _check_expansion(path)
    table = SampleTable(path)
    for name, shape, kind in whosmat(path):
        if kind == "struct":
            _add_structure(table, (name,), _load_variable(path, name))
            continue
        code = "i" if kind in INTEGER_CLASSES else NUMPY_KINDS.get(kind, "V")
        add_array(table, name, shape, code, (name,))
        if (fact := find_fact(name)) and code in "fi" and set(shape) == {1}:
            add_fact(table.facts, fact, float(_load_variable(path, name).item()))
        if name in TOML_TEXTS and kind == "char":
            table.texts[name] = "".join(_load_variable(path, name).reshape(-1))
    return table


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,)."""
    if _is_hdf5(path):
        from twin.exchange.formats.hdf5 import load_column as load_hdf5

        return load_hdf5(path, key)
    name, *fields, k = key
    value = _load_variable(path, str(name))
    for field in fields:
        value = np.asarray(value.reshape(-1)[0][field])
    return extract_column(value, int(k))


def write_mat(rows: LogTable, file: BinaryIO) -> None:
    """Write the rows as MATLAB v5: one variable per column, `units`, and the config texts."""
    run_data = {**rows.toml_texts, "run": rows.start.run, "rate_hz": rows.start.rate_hz}
    savemat(file, {**run_data, "units": {name: unit for name, unit in rows.units.items() if unit}})
    for name in rows.units:  # one by one, to limit memory
        column = rows.read_columns(slice(None), name)[name]
        savemat(file, {name: column}, oned_as="column")


def _load_variable(path: Path, name: str) -> Any:
    return loadmat(path, variable_names=[name])[name]


def _add_structure(table: SampleTable, key: ColumnKey, value: Any) -> None:
    """Add the fields of a structure recursively."""
    name = "/".join(map(str, key))
    if value.dtype.names is None:
        add_array(table, name, value.shape, value.dtype.kind, key, group=name.rpartition("/")[0])
    elif value.size != 1 or len(key) > MAX_DEPTH:
        table.skipped[name] = "an array of structures"
    else:
        for field in value.dtype.names:
            _add_structure(table, (*key, field), np.asarray(value.reshape(-1)[0][field]))


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
        file.seek(512)
        return file.read(4) == HDF5_MAGIC or head.startswith((b"MATLAB 7.3", HDF5_MAGIC))


def _check_expansion(path: Path) -> None:
    """Raise InputError if compressed variables expand beyond the limit (decompression bomb)."""
    remaining_bytes = 2**26 + MAX_EXPANSION * path.stat().st_size
    with path.open("rb") as file:
        byte_order = "big" if file.read(HEADER_BYTES)[126:] == b"MI" else "little"
        while len(tag := file.read(8)) == 8:
            kind, size = (int.from_bytes(tag[k : k + 4], byte_order) for k in (0, 4))  # type: ignore[arg-type]
            end = file.tell() + size
            decompressor = zlib.decompressobj()
            while kind == MI_COMPRESSED and file.tell() < end and not decompressor.eof:
                compressed = file.read(min(2**16, end - file.tell()))
                if not compressed:
                    raise InputError(
                        "cut off inside a variable", where=path, remedy="export it again"
                    )
                remaining_bytes -= len(decompressor.decompress(compressed, remaining_bytes + 1))
                if remaining_bytes < 0:
                    raise InputError(
                        f"decompresses to more than {MAX_EXPANSION} times its size",
                        where=path,
                        remedy="the file is damaged, or save it uncompressed",
                    )
            file.seek(end)
