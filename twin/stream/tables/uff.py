"""UFF 58, text and binary: a function of time a set. The only file that knows pyuff.

A column is named by the set's first line where that is one of its kind, else `set 3 that line`.
"""

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pyuff

from table_io.card import BadInput
from twin.stream.tables import Held, Key, Table

TIME = (0, 1, 17)  # abscissa: unknown, general, time
FUNCTION = (0, 1)  # general, time response
SECONDS = ("", "none", "s", "sec", "second", "seconds")


def read(path: Path) -> Table:
    """The sets of a file by their headers; BadInput where it has none."""
    file = pyuff.UFF(str(path))
    types = [int(kind) for kind in file.get_set_types()]
    if 58 not in types:
        raise BadInput(f"{path}: no set of type 58 in it; export the functions of time as UFF 58")
    heads = {k: file.read_sets(k, header_only=True) for k, kind in enumerate(types) if kind == 58}
    named = Counter(_line(head, "id1") for head in heads.values())
    table = Table(path)
    for k, head in heads.items():
        line = _line(head, "id1")
        name = line if line and named[line] == 1 else f"set {k + 1} {line}".strip()
        why = _no_time(head)
        if why:
            table.others[name] = why
            continue
        even, step = head["abscissa_spacing"] == 1, float(head["abscissa_inc"])
        table.columns[name] = Held(
            int(head["num_pts"]),
            (k, "data"),
            _line(head, "ordinate_axis_units_lab"),
            1.0 / step if even and step > 0 else None,
            float(head["abscissa_min"]) if even else 0.0,
            "" if even else f"{name}/time",
        )
        if not even:
            table.columns[f"{name}/time"] = Held(int(head["num_pts"]), (k, "x"), "s")
    return table


def _line(head: Any, key: str) -> str:
    text = str(head.get(key, "")).strip()
    return "" if text.upper() == "NONE" else text


def _no_time(head: Any) -> str:
    """Why a set is no column of samples; empty where it is one."""
    if head["ord_data_type"] not in (2, 4):
        return "complex"
    if head["func_type"] not in FUNCTION or head["abscissa_spec_data_type"] not in TIME:
        return "no function of time"
    unit = _line(head, "abscissa_axis_units_lab")
    return "" if unit.lower() in SECONDS else f"its time is in {unit!r}; allowed: s"


def load(path: Path, key: Key) -> Any:
    """A column's numbers, (row,)."""
    k, what = key
    found = pyuff.UFF(str(path)).read_sets(k)
    count = int(found["num_pts"])
    if len(found[what]) < count:
        raise BadInput(
            f"{path}: set {int(k) + 1} says {count} values and has {len(found[what])}; "
            "it was cut off; export it again"
        )
    return np.asarray(found[what])[:count]
