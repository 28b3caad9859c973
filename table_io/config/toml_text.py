"""TOML text of tables."""

import json
import math
import re
from collections.abc import Mapping
from typing import Any

BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def format_toml(table: Mapping[str, Any], path: str = "") -> str:
    """Return the TOML text of a table of numbers, strings, lists and nested tables.

    Numbers keep all digits: the text is parsed to an equal table.
    """
    plain, nested = [], []
    for key, value in table.items():
        name = key if BARE_KEY.fullmatch(key) else _format_value(key)
        where = f"{path}.{name}" if path else name
        if isinstance(value, Mapping):
            nested.append(f"\n[{where}]\n{format_toml(value, where)}")
        elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
            nested += [f"\n[[{where}]]\n{format_toml(entry, where)}" for entry in value]
        else:
            plain.append(f"{name} = {_format_value(value)}\n")
    return "".join(plain + nested)


def _format_value(value: Any) -> str:
    """Return a value as TOML: a JSON string is a TOML string, except for the character DEL."""
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else "inf" if value > 0 else "-inf"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_format_value, value))}]"
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
