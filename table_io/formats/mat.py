"""Reader and writer of MATLAB .mat files up to v7 (scipy.io); v7.3 is read as HDF5.

The fields of a structure are named `structure/field`, the elements of a structure array
`structure/label` by their field Name or label.
"""

import zlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.io import loadmat, savemat, whosmat

from table_io.errors import InputError
from table_io.formats.table import (
    EXPANSION_BYTES,
    MAX_EXPANSION,
    TOML_TEXTS,
    ColumnKey,
    ForeignTable,
    TableColumns,
    check_expansion,
    extract_column,
)
from table_io.formats.words import UNIT_FIELDS, add_fact, find_fact, find_label

HEADER_BYTES = 128
HDF5_MAGIC = b"\x89HDF"
MI_COMPRESSED = 15  # miCOMPRESSED
MAX_DEPTH = 8
MAX_ELEMENTS = 1000  # of a structure array
NUMPY_KINDS = {"double": "f", "single": "f", "logical": "b", "char": "U", "cell": "O"}
INTEGER_CLASSES = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))
DATA_FIELDS = ("Data", "data", "values", "Values")  # their name is left out if the element has one
CLOCK_FIELDS = ("X", "X/Data", "time")  # of a structure: times of all in it


def scan_columns(path: Path) -> ForeignTable:
    """Scan the variables of a file; structures are read now, other values on demand."""
    if _is_hdf5(path):
        from table_io.formats.hdf5 import scan_columns as read_hdf5

        return read_hdf5(path)
    _check_compression(path)
    table = ForeignTable(path, "", loader="mat")
    for name, shape, kind in whosmat(path):
        if kind == "struct":
            _add_structure(table, name, (name,), _load_variable(path, name))
            continue
        code = "i" if kind in INTEGER_CLASSES else NUMPY_KINDS.get(kind, "V")
        table.add_array(name, shape, code, (name,))
        if (fact := find_fact(name)) and code in "fi" and set(shape) == {1}:
            add_fact(table.facts, fact, float(_load_variable(path, name).item()))
        if name in TOML_TEXTS and kind == "char":
            table.texts[name] = "".join(_load_variable(path, name).reshape(-1))
    return table


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,)."""
    name, *fields, k = key
    value = _load_variable(path, str(name))
    for field in fields:
        value = _get_part(value, field)
    return extract_column(value, int(k))


def write_mat(
    units: Mapping[str, str],
    columns: Iterable[TableColumns],
    facts: Mapping[str, str | float],
    file: BinaryIO,
) -> None:
    """Write MATLAB v5: the facts, `units`, and a variable per column; `columns` in some pieces."""
    savemat(file, {**facts, "units": {name: unit for name, unit in units.items() if unit}})
    for piece in columns:
        savemat(file, piece, oned_as="column")


def _load_variable(path: Path, name: str) -> Any:
    return loadmat(path, variable_names=[name])[name]


def _get_part(value: Any, part: str | int) -> Any:
    """Return element `part` of a structure array, or that field of a structure."""
    if isinstance(part, int):
        return value.reshape(-1)[part : part + 1]
    return np.asarray(value.reshape(-1)[0][part])


def _add_structure(
    table: ForeignTable, name: str, key: ColumnKey, value: Any, unit: str = ""
) -> None:
    """Add the fields of a structure, and the elements of a structure array, recursively."""
    fields = value.dtype.names
    if fields is None:
        group = name.rpartition("/")[0]
        table.add_array(name, value.shape, value.dtype.kind, key, unit, group)
        return
    if len(key) > MAX_DEPTH or not 0 < value.size <= MAX_ELEMENTS:
        table.dropped[name] = f"{value.size} structures, in {len(key)} levels"
        return
    if value.size > 1:
        elements = [_get_part(value, k) for k in range(value.size)]
        labels = [find_label(_read_texts(element)) for element in elements]
        for k, (element, label) in enumerate(zip(elements, labels, strict=True)):
            is_unique = label and labels.count(label) == 1
            inner = label if is_unique else f"{label} {k + 1}".strip()
            _add_structure(table, f"{name}/{inner}", (*key, k), element)
        return
    texts = _read_texts(value)
    unit = next((texts[field] for field in UNIT_FIELDS if field in texts), "")
    is_element = isinstance(key[-1], int)
    for field in fields:
        if is_element and field in texts:
            continue
        is_data = field in DATA_FIELDS
        inner = name if is_element and is_data else f"{name}/{field}"
        _add_structure(
            table, inner, (*key, field), _get_part(value, field), unit if is_data else ""
        )
    _set_clock(table, name)


def _read_texts(structure: Any) -> dict[str, str]:
    """Return the fields of a structure that are text, by name."""
    parts = {field: _get_part(structure, field) for field in structure.dtype.names}
    return {
        field: str(part.item()).strip()
        for field, part in parts.items()
        if part.dtype.kind == "U" and part.size == 1
    }


def _set_clock(table: ForeignTable, name: str) -> None:
    """Take a field for times of a structure as those of all other columns in it."""
    clock = next((f"{name}/{f}" for f in CLOCK_FIELDS if f"{name}/{f}" in table.columns), "")
    size = table.columns[clock].size if clock else 0
    for inner, column in table.columns.items():
        is_inside = inner.startswith(f"{name}/") and inner != clock
        if is_inside and column.size == size and not column.clock:
            table.columns[inner] = replace(column, clock=clock)


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(HEADER_BYTES)
        file.seek(512)
        return file.read(4) == HDF5_MAGIC or head.startswith((b"MATLAB 7.3", HDF5_MAGIC))


def _check_compression(path: Path) -> None:
    """Raise InputError if compressed variables expand beyond the limit (decompression bomb)."""
    limit = EXPANSION_BYTES + MAX_EXPANSION * path.stat().st_size
    size = 0
    with path.open("rb") as file:
        byte_order = "big" if file.read(HEADER_BYTES)[126:] == b"MI" else "little"
        while len(tag := file.read(8)) == 8:
            kind, length = (int.from_bytes(tag[k : k + 4], byte_order) for k in (0, 4))  # type: ignore[arg-type]
            end = file.tell() + length
            decompressor = zlib.decompressobj()
            while kind == MI_COMPRESSED and file.tell() < end and not decompressor.eof:
                compressed = file.read(min(2**16, end - file.tell()))
                if not compressed:
                    raise InputError(
                        "cut off inside a variable", where=path, remedy="export it again"
                    )
                size += len(decompressor.decompress(compressed, limit - size + 1))
                check_expansion(size, path)
            file.seek(end)
