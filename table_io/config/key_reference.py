"""Reference of the keys of a TOML file: unit, default, limits, meaning."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, get_args, get_origin

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from table_io.config.base import ConfigModel

# Unit by the ending of a key, the longest that fits.
UNIT_ENDINGS = {
    "mm_s": "mm/s", "l_min": "l/min", "cm2": "cm2", "m_s2": "m/s2", "n_m": "N/m",
    "n_s_m": "N s/m", "mm": "mm", "m": "m", "hz": "Hz", "s": "s", "ms": "ms", "g": "g", "kn": "kN",
    "n": "N", "kg": "kg", "db": "dB", "deg": "degrees", "c": "degC", "v": "V", "lsb": "LSB",
    "percent": "%", "samples": "samples", "months": "months",
}  # fmt: skip
TYPE_NAMES = {str: "text", float: "number", int: "integer", bool: "true or false", dict: "table"}


@dataclass(frozen=True, slots=True)
class KeyDescription:
    """One key: `default` is TOML text, "" if there is none; `is_required` if it must be given."""

    key: str
    unit: str
    default: str
    is_required: bool
    allowed: str
    meaning: str


@dataclass(frozen=True, slots=True)
class TableDescription:
    """Table of a file: its name as in the file, "" for the top of it; its meaning and its keys."""

    name: str
    meaning: str
    keys: tuple[KeyDescription, ...]


def describe_tables(model: type[ConfigModel], name: str = "") -> Iterator[TableDescription]:
    """Describe the tables of a file in their order, those inside a table after it.

    `name` is the name of the table that `model` reads, such as "[excitation]".
    """
    fields = model.fields_by_key()
    tables = {key: model.find_table_model(key) for key in model.list_keys()}
    keys = tuple(
        _describe_key(key, fields[key])
        for key, table in tables.items()
        if table is None and f" {key} = " not in name  # which the name of the table states
    )
    yield TableDescription(name, " ".join((model.__doc__ or "").split()), keys)
    described: set[type[ConfigModel]] = set()
    for key, table in tables.items():
        if table is None:
            continue
        path = f"{name.strip('[]')}.{key}".lstrip(".")
        annotation = fields[key].annotation if key in fields else None
        # A second name of the same table is for its default kind.
        is_alias = table in described
        described.add(table)
        variants = {"": table.select_class({})} if is_alias else table.list_variants()
        for requirement, variant in variants.items():
            table_name = f"[[{path}]]" if get_origin(annotation) is tuple else f"[{path}]"
            yield from describe_tables(variant, f"{table_name} {requirement}".strip())


def derive_unit(key: str) -> str:
    """Return the unit in which a key states its value by its name, "" if it has none."""
    endings = [ending for ending in UNIT_ENDINGS if key.endswith(f"_{ending}")]
    return UNIT_ENDINGS[max(endings, key=len)] if endings else ""


def _describe_key(key: str, field: FieldInfo) -> KeyDescription:
    has_default = field.default is not PydanticUndefined
    return KeyDescription(
        key,
        derive_unit(key),
        _format_default(field.default) if has_default else "",
        field.is_required(),
        describe_limits(field),
        field.description or "",
    )


def _format_default(value: Any) -> str:
    """Return a default as TOML text; "" for none and for an empty one."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"' if value else ""
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(_format_default, value))}]" if value else ""
    return f"{value:g}" if isinstance(value, int | float) else ""


def describe_limits(field: FieldInfo) -> str:
    """Return the type and the limits of a value in words: `number, 0.05 to 60`."""
    limits: dict[str, Any] = {}
    types: list[str] = []
    choices: list[str] = []
    _collect_limits(field.annotation, field.metadata, limits, types, choices)
    parts = [*dict.fromkeys(types)][:1] if not choices else [" or ".join(dict.fromkeys(choices))]
    low = f"above {limits['gt']:g}" if "gt" in limits else ""
    low = f"from {limits['ge']:g}" if "ge" in limits else low
    high = f"below {limits['lt']:g}" if "lt" in limits else ""
    high = f"to {limits['le']:g}" if "le" in limits else high
    parts += [" ".join(filter(None, (low, high)))] if low or high else []
    if "pattern" in limits:
        parts.append(f"pattern {limits['pattern']}")
    if limits.get("min_length"):
        parts.append(f"at least {limits['min_length']}")
    if "max_length" in limits:
        parts.append(f"at most {limits['max_length']}")
    return ", ".join(parts)


def _collect_limits(
    annotation: Any, metadata: Any, limits: dict[str, Any], types: list[str], choices: list[str]
) -> None:
    """Add the limits of an annotation and of what it is made of."""
    for item in metadata:
        if isinstance(item, FieldInfo):
            _collect_limits(item.annotation, item.metadata, limits, types, choices)
        for name in ("gt", "ge", "lt", "le", "pattern", "min_length", "max_length"):
            value = getattr(item, name, None)
            if value is not None:
                limits[name] = value
    if get_origin(annotation) is Literal:
        choices += [f'"{choice}"' for choice in get_args(annotation) if choice]
    elif get_origin(annotation) in (tuple, list):
        types.append("list")
        for item in get_args(annotation)[:1]:
            _collect_limits(item, (), limits, types, choices)
    elif get_origin(annotation) is dict:
        types.append("table")
    elif hasattr(annotation, "__metadata__"):
        _collect_limits(annotation.__origin__, annotation.__metadata__, limits, types, choices)
    elif get_args(annotation):
        for item in get_args(annotation):
            _collect_limits(item, (), limits, types, choices)
    elif annotation in TYPE_NAMES:
        types.append(TYPE_NAMES[annotation])
