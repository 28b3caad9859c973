"""Reader of UFF data sets 58, text and binary, each a function of time.

A column is named by ID line 1 of its set if that is unique, else `set 3 <line>`. Only this file
imports pyuff.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyuff

from table_io.errors import InputError
from table_io.formats.table import ColumnKey, ForeignColumn, ForeignTable

TIME_ABSCISSA_TYPES = (0, 1, 17)  # unknown, general, time
TIME_FUNCTION_TYPES = (0, 1)  # general, time response
SECONDS_LABELS = ("", "none", "s", "sec", "second", "seconds")


def scan_columns(path: Path) -> ForeignTable:
    """Scan the data sets of a file by their headers; raise InputError if none has type 58."""
    file = pyuff.UFF(str(path))
    types = [int(kind) for kind in file.get_set_types()]
    if 58 not in types:
        raise InputError(
            "no set of type 58 in it", where=path, remedy="export the time histories as UFF 58"
        )
    headers = {k: file.read_sets(k, header_only=True) for k, kind in enumerate(types) if kind == 58}
    name_counts = Counter(_header_text(head, "id1") for head in headers.values())
    table = ForeignTable(path, "", loader="uff")
    for k, header in headers.items():
        line = _header_text(header, "id1")
        name = line if line and name_counts[line] == 1 else f"set {k + 1} {line}".strip()
        reason = _skip_reason(header)
        if reason:
            table.dropped[name] = reason
            continue
        is_even, step = header["abscissa_spacing"] == 1, float(header["abscissa_inc"])
        table.columns[name] = ForeignColumn(
            int(header["num_pts"]),
            (k, "data"),
            _header_text(header, "ordinate_axis_units_lab"),
            1.0 / step if is_even and step > 0 else None,
            float(header["abscissa_min"]) if is_even else 0.0,
            "" if is_even else f"{name}/time",
        )
        if not is_even:
            table.columns[f"{name}/time"] = ForeignColumn(int(header["num_pts"]), (k, "x"), "s")
    return table


def _header_text(header: Any, key: str) -> str:
    text = str(header.get(key, "")).strip()
    return "" if text.upper() == "NONE" else text


def _skip_reason(header: Any) -> str:
    """Return why a set is not a column of samples, or ""."""
    if header["ord_data_type"] not in (2, 4):
        return "complex"
    if (
        header["func_type"] not in TIME_FUNCTION_TYPES
        or header["abscissa_spec_data_type"] not in TIME_ABSCISSA_TYPES
    ):
        return "not a function of time"
    unit = _header_text(header, "abscissa_axis_units_lab")
    return "" if unit.lower() in SECONDS_LABELS else f"its time is in {unit!r}; allowed: s"


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,)."""
    k, field = key
    dataset = pyuff.UFF(str(path)).read_sets(k)
    count = int(dataset["num_pts"])
    if len(dataset[field]) < count:
        raise InputError(
            f"set {int(k) + 1} declares {count} values and has {len(dataset[field])}",
            where=path,
            remedy="the file was cut off: export it again",
        )
    return np.asarray(dataset[field])[:count]
