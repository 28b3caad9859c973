"""Reader of HDF5 and MATLAB v7.3 files, and writer of HDF5; only this file imports h5py.

Datasets are named by their path; the cells of a cell array and the elements of a structure array
of MATLAB as in `mat`. Links into other files are never followed.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from table_io.errors import InputError
from table_io.formats.table import (
    MAX_MATRIX_COLUMNS,
    TOML_TEXTS,
    ColumnKey,
    ForeignTable,
    extract_column,
)
from table_io.formats.words import LABEL_FIELDS, UNIT_FIELDS, add_fact, find_fact, find_label

Attributes = Mapping[str, str | list[str]]
Fields = Iterable[tuple[str, Any, Attributes]]
UNIT_ATTRIBUTES = ("units", "unit", "Units", "Unit", "unit_string")
FILL_ATTRIBUTES = ("_FillValue", "missing_value")
FACTOR_ATTRIBUTES = ("gain", "scale", "factor", "sensitivity", "calibration")  # of values, perhaps
START_ATTRIBUTES = ("start_time", "start_s", "t0")  # numbers in s
MAX_CHUNK_BYTES = 2**26  # the library always loads whole chunks
MAX_REFERENCES = 1000  # of a cell array


def scan_columns(path: Path) -> ForeignTable:
    """Scan the datasets of a file; values are not read."""
    table, notes = ForeignTable(path, "", loader="hdf5"), list[str]()
    with h5py.File(path, "r") as file:

        def visit(name: str, item: Any) -> None:
            if isinstance(item, h5py.Dataset) and not name.startswith("#"):
                _add_dataset(table, name, item, notes)

        file.visititems(visit)
    return replace(table, notes=(*notes,))


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,)."""
    name, part, k = key
    with h5py.File(path, "r") as file:
        values = extract_column(file[name][part or ()], int(k))
        return _unpack(values, {key: file[name].attrs[key] for key in file[name].attrs})


def _unpack(values: Any, attributes: Mapping[str, Any]) -> Any:
    """Return values with the scale of the CF conventions, as netCDF has it; NaN for fillings."""
    if not attributes.keys() & {*FILL_ATTRIBUTES, "scale_factor", "add_offset"}:
        return values
    lost = [attributes[key] for key in FILL_ATTRIBUTES if key in attributes]
    numbers = np.where(np.isin(values, lost), np.nan, values)
    return attributes.get("scale_factor", 1.0) * numbers + attributes.get("add_offset", 0.0)


def _add_dataset(table: ForeignTable, name: str, item: Any, notes: list[str]) -> None:
    if item.is_virtual or item.external:
        table.dropped[name] = "its values are in another file"
    elif _chunk_bytes(item) > MAX_CHUNK_BYTES:
        table.dropped[name] = f"in chunks of more than {MAX_CHUNK_BYTES} bytes"
    elif _to_text(item.attrs.get("MATLAB_class", "")) == "char":
        table.dropped[name] = "text"
        if name in TOML_TEXTS and item.size < 10**6:
            table.texts[name] = _read_text(item)
    elif "MATLAB_empty" in item.attrs or item.shape is None:
        table.dropped[name] = "empty"
    elif h5py.check_ref_dtype(item.dtype) is h5py.Reference:
        _add_references(table, name, item)
    elif item.dtype.names:
        for field in item.dtype.names:
            kind = item.dtype[field].kind if not item.dtype[field].shape else "V"
            table.add_array(f"{name}/{field}", item.shape, kind, (name, field), group=name)
    else:
        unit = next((_to_text(item.attrs[key]) for key in UNIT_ATTRIBUTES if key in item.attrs), "")
        unit = unit or next(iter(_read_field(item, UNIT_FIELDS)), "")
        notes += [
            f"warning: {name} has an attribute {key} = {value:.6g}, which is not applied"
            for key, value in item.attrs.items()
            if key.lower() in FACTOR_ATTRIBUTES and np.isreal(value).all() and np.size(value) == 1
            if value != 1
        ]
        table.add_array(
            name, item.shape, item.dtype.kind, (name, ""), unit, name.rpartition("/")[0]
        )
        rate_hz = _find_rate(item)
        starts = [item.attrs[key] for key in START_ATTRIBUTES if key in item.attrs]
        start_s = next((float(start) for start in starts if np.isreal(start).all()), 0.0)
        for column in (name, *(f"{name}:{k}" for k in range(1, MAX_MATRIX_COLUMNS + 1))):
            if rate_hz and column in table.columns:
                table.columns[column] = replace(
                    table.columns[column], rate_hz=rate_hz, start_s=start_s
                )


def _find_rate(item: Any) -> float | None:
    """Return the sampling rate in Hz that the attributes of a dataset, or of its groups, state."""
    place = item
    while True:
        facts: dict[str, float] = {}
        for key, value in place.attrs.items():
            fact = find_fact(key)
            if fact in ("rate_hz", "interval_s") and np.size(value) == 1:
                number = np.asarray(value).reshape(-1)[0]
                if np.issubdtype(type(number), np.number):
                    add_fact(facts, fact, float(number))
        if "other_rate_hz" in facts:
            raise InputError(
                f"an HDF5 file; {place.name} states {facts['rate_hz']:.9g} Hz and "
                f"{facts['other_rate_hz']:.9g} Hz",
                where=item.file.filename,
                remedy="correct its attributes",
            )
        if facts or place.name == "/":
            return facts.get("rate_hz")
        place = place.parent


def _add_references(table: ForeignTable, name: str, item: Any) -> None:
    """Add the arrays of a cell array, or of one field of a structure array, by their labels."""
    if item.size > MAX_REFERENCES:
        table.dropped[name] = f"{item.size} cells"
        return
    file, parent = item.file, name.rpartition("/")[0]
    labels = _read_field(item, LABEL_FIELDS)
    units = _read_field(item, UNIT_FIELDS)
    for k, reference in enumerate(item[()].reshape(-1)):
        cell: Any = file[reference] if reference else None
        if getattr(cell, "dtype", None) is None or cell.dtype.kind not in "fiub":
            continue
        if _to_text(cell.attrs.get("MATLAB_class", "")) == "char":
            continue
        label = find_label({"Name": labels[k]}) if labels else ""
        inner = f"{parent}/{label}" if label else f"{name}/{k + 1}"
        unit = units[k] if units else ""
        table.add_array(inner, cell.shape, cell.dtype.kind, (cell.name, ""), unit, parent)


def _read_field(item: Any, fields: tuple[str, ...]) -> list[str]:
    """Return the texts that stand next to the data of a structure, one for each of its elements."""
    for name in fields:
        field: Any = item.parent.get(name) if item.name.rpartition("/")[2] != name else None
        if not isinstance(field, h5py.Dataset):
            continue
        if _to_text(field.attrs.get("MATLAB_class", "")) == "char":
            return [_read_text(field)]
        if h5py.check_ref_dtype(field.dtype) is h5py.Reference and field.shape == item.shape:
            cells = [item.file[reference] for reference in field[()].reshape(-1)]
            return [_read_text(cell) if cell.dtype.kind == "u" else "" for cell in cells]
    return []


def _chunk_bytes(item: Any) -> int:
    size = item.dtype.itemsize
    for length in item.chunks or ():
        size *= length
    return int(size)


def _read_text(item: Any) -> str:
    """Return the text of a char array of MATLAB."""
    return "".join(map(chr, item[()].reshape(-1)))


def _to_text(value: Any) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def write_nexus(path: Path, groups: Iterable[tuple[str, Attributes, Fields]]) -> None:
    """Write groups (path, attributes, fields) as an HDF5 file in the layout of NeXus.

    A field is (name, value, attributes); arrays are compressed without loss, one after the other.
    """
    with h5py.File(path, "w") as file:
        file.attrs["default"], file.attrs["creator"] = "entry", "shaketwin"
        for name, attributes, fields in groups:
            place = file.create_group(name)
            place.attrs.update(attributes)
            for key, value, of_field in fields:
                is_array = isinstance(value, np.ndarray)
                options = {"compression": "gzip", "shuffle": True} if is_array else {}
                place.create_dataset(key, data=value, **options).attrs.update(of_field)
