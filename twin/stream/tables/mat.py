"""MATLAB's .mat up to v7, by scipy.io; v7.3 is HDF5. A structure's fields are `name/field`."""

import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from scipy.io import loadmat, savemat, whosmat

from table_io.card import BadInput
from twin.stream.rows import Rows
from twin.stream.tables import MOST_TIMES, TEXTS, Key, Table, part, put

HEADER = 128
HDF5 = b"\x89HDF"
COMPRESSED = 15  # miCOMPRESSED
DEEPEST = 8
KINDS = {"double": "f", "single": "f", "logical": "b", "char": "U", "cell": "O"}
INTEGERS = tuple(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64))


def read(path: Path) -> Table:
    """The variables of a file; structures are read now, the rest when it is asked for."""
    if _is_hdf5(path):
        from twin.stream.tables.hdf5 import read as read_hdf5

        return read_hdf5(path)
    _no_bomb(path)
    table = Table(path)
    for name, shape, kind in whosmat(path):
        if kind == "struct":
            _structure(table, (name,), _variable(path, name))
            continue
        code = "i" if kind in INTEGERS else KINDS.get(kind, "V")
        put(table, name, shape, code, (name,))
        if name in TEXTS and kind == "char":
            table.texts[name] = "".join(_variable(path, name).reshape(-1))
    return table


def load(path: Path, key: Key) -> Any:
    """A column's numbers, (row,)."""
    if _is_hdf5(path):
        from twin.stream.tables.hdf5 import load as load_hdf5

        return load_hdf5(path, key)
    name, *fields, k = key
    value = _variable(path, str(name))
    for field in fields:
        value = np.asarray(value.reshape(-1)[0][field])
    return part(value, int(k))


def write(rows: Rows, file: BinaryIO) -> None:
    """The rows as MATLAB's v5: a variable a column, `units`, and the texts of the run."""
    about = {**rows.texts, "run": rows.start.run, "rate_hz": rows.start.rate_hz}
    savemat(file, {**about, "units": {name: unit for name, unit in rows.units.items() if unit}})
    for name in rows.units:  # one by one: the whole need not fit into memory
        column = rows.window(slice(None), name)[name]
        savemat(file, {name: column}, oned_as="column")


def _variable(path: Path, name: str) -> Any:
    return loadmat(path, variable_names=[name])[name]


def _structure(table: Table, key: Key, value: Any) -> None:
    """Add the fields of a structure, at any depth."""
    name = "/".join(map(str, key))
    if value.dtype.names is None:
        put(table, name, value.shape, value.dtype.kind, key, group=name.rpartition("/")[0])
    elif value.size != 1 or len(key) > DEEPEST:
        table.others[name] = "an array of structures"
    else:
        for field in value.dtype.names:
            _structure(table, (*key, field), np.asarray(value.reshape(-1)[0][field]))


def _is_hdf5(path: Path) -> bool:
    with path.open("rb") as file:
        head = file.read(HEADER)
        file.seek(512)
        return file.read(4) == HDF5 or head.startswith((b"MATLAB 7.3", HDF5))


def _no_bomb(path: Path) -> None:
    """BadInput where a compressed variable unpacks to far more than a recording would."""
    left = 2**26 + MOST_TIMES * path.stat().st_size
    with path.open("rb") as file:
        order = "big" if file.read(HEADER)[126:] == b"MI" else "little"
        while len(tag := file.read(8)) == 8:
            kind, size = (int.from_bytes(tag[k : k + 4], order) for k in (0, 4))  # type: ignore[arg-type]
            end = file.tell() + size
            unpack = zlib.decompressobj()
            while kind == COMPRESSED and file.tell() < end and not unpack.eof:
                packed = file.read(min(2**16, end - file.tell()))
                if not packed:
                    raise BadInput(f"{path}: cut off inside a variable; export it again")
                left -= len(unpack.decompress(packed, left + 1))
                if left < 0:
                    raise BadInput(f"{path}: unpacks to more than {MOST_TIMES} times its size")
            file.seek(end)
