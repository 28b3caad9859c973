"""The reader of tables that others made: for `shaketwin import` and for records of a profile.

`read_table` finds the format of a file by its first bytes, else by its suffix; `parse_text` reads
one that is text. Each binary format has a module, whose `scan_columns(path)` describes the columns;
it runs in a process of its own, so that a library that fails on a damaged file yields one
InputError. A refusal says what the file is, then what is wrong.
"""

import re
from dataclasses import replace
from importlib import import_module
from io import StringIO
from pathlib import Path
from typing import TextIO

from table_io.errors import InputError, format_pip_line
from table_io.formats.lvm import EXPRESS_WORDS, FIRST_WORDS, parse_express, parse_lvm
from table_io.formats.sandbox import run_isolated
from table_io.formats.scope import SCOPE_HEAD, SETTINGS_HEAD, parse_scope, parse_settings
from table_io.formats.strong_motion import (
    KNET_WORDS,
    PEER_SUFFIXES,
    SMC_WORDS,
    is_volume_2,
    parse_knet,
    parse_peer,
    parse_smc,
    parse_volume_2,
)
from table_io.formats.table import ForeignTable, check_column_count
from table_io.formats.text import parse_table

FORMATS = {  # module by suffix
    ".parquet": "parquet",
    ".mat": "mat",
    ".uff": "uff", ".unv": "uff", ".uf": "uff", ".u58": "uff", ".58": "uff",
    ".tdms": "tdms",
    ".h5": "hdf5", ".hdf5": "hdf5", ".hdf": "hdf5",
    ".npz": "npz",
    ".xlsx": "xlsx", ".xlsm": "xlsx",
}  # fmt: skip
KINDS = {  # what a file is, by module
    "parquet": "a Parquet file", "mat": "a MATLAB file", "uff": "a universal file (UFF)",
    "tdms": "a LabVIEW TDMS file", "hdf5": "an HDF5 file", "npz": "an archive of numpy",
    "xlsx": "an Excel workbook",
}  # fmt: skip
SIGNATURES = {  # first bytes by module; other formats have none that is safe
    "parquet": b"PAR1", "tdms": b"TDSm", "npz": b"PK", "xlsx": b"PK",
}  # fmt: skip
OTHER_SIGNATURES = {  # what a file is that is not read
    b"\x89PNG": "a PNG image", b"%PDF": "a PDF document", b"\xd0\xcf\x11\xe0": "an old Excel file",
    b"PK": "a ZIP archive (a workbook is read if named .xlsx)", b"\x89HDF": "an HDF5 file",
    b"\x1f\x8b": "a gzip archive",
    b"PAR1": "a Parquet file", b"TDSm": "a LabVIEW TDMS file", b"MATLAB": "a MATLAB file",
    b"RIFF": "a WAV sound file", b"\x93NUMPY": "an array of numpy (.npy), to be saved as .npz",
    b"\x80": "a pickle of Python, which is never loaded", b"ARROW1": "an Arrow or Feather file",
    b"SQLite format 3": "an SQLite database",
}  # fmt: skip
OTHER_TEXTS = {  # what a text is that is not read, by its first characters
    rb"\s*<(!doctype html|html)": "an HTML page", rb"\s*<\?xml": "an XML file",
    rb"\s*(\{\s*[\"}]|\[\s*[\[{])": "a JSON file", rb"\{\\rtf": "an RTF document",
    rb"TIMESERIES \S+, \d+ samples": "a time series of FDSN (SLIST, TSPAIR)",
    rb"\d{6}[DRQM][ \d]": "a miniSEED file", rb"(BEGIN GSE|WID[12] )": "a GSE file",
    rb"(un)?corrected accelerogram \S+ GNS": "a record of GeoNet (V1A, V2A)",
}  # fmt: skip
UTF_32_MARKS = (b"\xff\xfe\0\0", b"\0\0\xfe\xff")
UTF_16_MARKS = (b"\xff\xfe", b"\xfe\xff")
MIN_ZERO_SHARE = 0.9  # of the upper bytes of a Latin text in UTF-16, if it has no mark
SNIFF_BYTES = 4096
MAX_LISTED_COLUMNS = 20  # in a message


def read_table(path: Path, group: str = "") -> ForeignTable:
    """Read the table in a file, or in one group of it; raise InputError if there is none."""
    try:
        with path.open("rb") as file:
            start = file.read(SNIFF_BYTES)
        name = FORMATS.get(path.suffix.lower())
        table = _scan_text(path, start) if name is None else _scan_binary(path, name, start)
    except OSError as error:
        raise InputError(f"cannot read this table: {error.strerror}", where=path) from None
    if not table.columns:
        dropped = [f"{name} ({why})" for name, why in table.dropped.items()][:MAX_LISTED_COLUMNS]
        raise InputError(
            f"{table.kind} with no column of numbers in it, only: "
            f"{', '.join(dropped) or 'nothing'}",
            where=path,
        )
    selected = table.select_group(group.strip("/"))
    check_column_count(len(selected.columns), path)
    return selected


def parse_text(text: str, name: str) -> ForeignTable:
    """Read the table in the text of the file `name`; raise InputError if there is none."""
    if not text.strip():
        raise InputError("empty", where=name, remedy="give a table with one row per sample")
    return _parse_lines(StringIO(text, newline=""), Path(name))


def decode_text(data: bytes) -> str:
    """Return the text of a file: UTF-16 by its mark, else UTF-8, else Windows-1252."""
    for encoding in _list_encodings(data):
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            pass
    return data.decode("cp1252", errors="replace")


def _list_encodings(start: bytes) -> tuple[str, ...]:
    """Return the encodings that a text may have, by its first bytes."""
    if start.startswith(UTF_32_MARKS):
        return ("utf-32",)
    if start.startswith(UTF_16_MARKS):
        return ("utf-16",)
    for encoding, high in (("utf-16-le", start[1::2]), ("utf-16-be", start[::2])):
        is_text = len(start) > 2 and not start.startswith((*OTHER_SIGNATURES,))
        if (
            is_text
            and high.count(0) > MIN_ZERO_SHARE * len(high) > 0
            and start.count(0) == high.count(0)
        ):
            return (encoding,)
    return ("utf-8-sig", "cp1252")


def _scan_text(path: Path, start: bytes) -> ForeignTable:
    """Read the table in a text file."""
    if not start.strip():
        raise InputError(
            "empty", where=path, remedy="give a table with a header and one row per sample"
        )
    encodings = _list_encodings(start)
    is_binary = b"\0" in start and not encodings[0].startswith(("utf-16", "utf-32"))
    kinds = [
        kind for mark, kind in OTHER_SIGNATURES.items() if start.startswith(mark) and is_binary
    ]
    kinds += [kind for mark, kind in OTHER_TEXTS.items() if re.match(mark, start, re.IGNORECASE)]
    if is_binary or kinds:
        raise InputError(
            next(iter(kinds), "a binary file"),
            where=path,
            allowed=f"text tables, or files that end in {', '.join(FORMATS)}",
        )
    for encoding in encodings:
        errors = "replace" if encoding == "cp1252" else "strict"
        try:
            with path.open(encoding=encoding, errors=errors, newline="") as file:
                table = _parse_lines(file, path)
        except UnicodeDecodeError:
            continue
        notes = () if encoding == "utf-8-sig" else (f"its text is in {encoding}",)
        return replace(table, notes=(*notes, *table.notes))
    raise InputError(
        f"a text in {encodings[0]} that is damaged", where=path, remedy="export it again"
    )


def _parse_lines(file: TextIO, path: Path) -> ForeignTable:
    """Read the table in a text by the format that its suffix or its first line states."""
    first = file.readline(SNIFF_BYTES)
    file.seek(0)
    if SMC_WORDS.match(first):
        return parse_smc(file, path)
    if first.startswith(KNET_WORDS):
        return parse_knet(file, path)
    if path.suffix.lower() in PEER_SUFFIXES:
        return parse_peer(file, path)
    if is_volume_2(path.name):
        return parse_volume_2(file, path)
    if first.lower().startswith(EXPRESS_WORDS):
        return parse_express(file, path)
    if first.lower().startswith(SETTINGS_HEAD) and first.count(",") > 3:
        return parse_settings(file, path)
    if SCOPE_HEAD.match(first):
        return parse_scope(file, path)
    return parse_lvm(file, path) if first.startswith(FIRST_WORDS) else parse_table(file, path)


def _scan_binary(path: Path, name: str, start: bytes) -> ForeignTable:
    """Describe the columns of a file of a binary format; imports its library."""
    mark = SIGNATURES.get(name, b"")
    if not start.startswith(mark):
        raise InputError(
            f"not {KINDS[name]}: it begins with {start[: len(mark)]!r}",
            where=path,
            allowed=repr(mark),
            remedy="check that the suffix matches the format",
        )
    try:
        scan = import_module(f"table_io.formats.{name}").scan_columns
    except ModuleNotFoundError as error:
        raise InputError(
            f"{KINDS[name]}: {error.name} is not installed",
            where=path,
            remedy=format_pip_line("formats"),
        ) from None
    table: ForeignTable = run_isolated(path, lambda: scan(path))
    return replace(table, kind=KINDS[name])
