"""TOML files: loaded into validated, frozen models, and written as text.

One message lists all faults of a file.
"""

import json
import math
import re
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Self, TypeVar

from pydantic import AliasChoices, BaseModel, ConfigDict, Field, ValidationError, ValidationInfo
from pydantic.fields import FieldInfo

from table_io.errors import InputError, suggest

# Folder of the shipped tests, rigs, models and campaigns. In a wheel the profiles lie inside the
# package, in a source tree next to it.
PROFILES_DIR = next(
    folder / "profiles"
    for folder in Path(__file__).resolve().parents[1:3]
    if (folder / "profiles").is_dir()
)

# Strict: `true` or "0.05" in place of a number is a mistake, not a 1 or a 0.05.
Number = Annotated[float, Field(strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(strict=True)]


class ConfigModel(BaseModel):
    """Base class of all configs read from a file: unknown keys are errors, values are frozen.

    A relation between two values is checked at the later of the two keys, against the valid earlier
    ones (`info.data`), so that a fault in one key does not hide the others.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    def __deepcopy__(self, memo: dict[int, Any] | None = None) -> Self:
        """Return the config itself: it never changes, and what holds it may be copied often."""
        return self

    @classmethod
    def list_keys(cls) -> list[str]:
        """List the allowed keys."""
        return list(cls.fields_by_key())

    @classmethod
    def fields_by_key(cls) -> dict[str, FieldInfo]:
        """Return the fields by each of their keys in the file."""
        fields: dict[str, FieldInfo] = {}
        for name, field in cls.model_fields.items():
            alias = field.validation_alias
            keys = alias.choices if isinstance(alias, AliasChoices) else [alias or name]
            fields |= {str(key): field for key in keys}
        return fields

    @classmethod
    def find_table_model(cls, key: str) -> "type[ConfigModel] | None":
        """Return the model of the table or tables at `key`; None if it holds no table."""
        fields = cls.fields_by_key()
        stack: list[Any] = [fields[key].annotation] if key in fields else []
        while stack:
            item = stack.pop()
            if isinstance(item, type) and issubclass(item, ConfigModel):
                return item
            stack.extend(getattr(item, "__args__", ()))
        return None

    @classmethod
    def list_variants(cls) -> "dict[str, type[ConfigModel]]":
        """Return the classes that read a table by what they require of it; "" if nothing."""
        return {"": cls}

    @classmethod
    def select_class(cls, table: Mapping[str, Any]) -> "type[ConfigModel]":
        """Return the class that reads a table: this one, unless the table states a kind."""
        return cls

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other values, without cached properties of the old ones."""
        copy = super().model_copy(update=update, deep=deep)
        for name in copy.__dict__.keys() - type(copy).model_fields.keys():
            del copy.__dict__[name]
        return copy


ConfigT = TypeVar("ConfigT", bound=ConfigModel)
SortableT = TypeVar("SortableT", str, float, tuple[str, float])


def list_duplicates(values: Sequence[SortableT]) -> list[SortableT]:
    """List the values that occur more than once, each one time, sorted."""
    return sorted(value for value, count in Counter(values).items() if count > 1)


def require_both(key: str, value: object, other: str, info: ValidationInfo) -> None:
    """Raise InputError if one of two keys is given without the other.

    For a validator of `key`, the later one; an invalid `other` is reported for itself.
    """
    if other in info.data and (info.data[other] is None) != (value is None):
        raise InputError(f"{other} and {key} go together", remedy="give both or neither")


NULL_CHARACTER = re.compile(r"\0|\\u0000|\\U00000000")  # itself, and as TOML writes it


def find_attached_text(name: str | None, info: ValidationInfo) -> str | None:
    """Return the text of a file that a key names; None without one, or if `files` is at fault.

    For a validator of a model with a field `files`: the texts by name, which loading attaches.
    InputError if the file is not among them.
    """
    files = info.data.get("files")
    if name is None or files is None:
        return None
    if name not in files:
        raise InputError(f"{name!r} is not attached", remedy="load the profile from its file")
    text: str = files[name]
    return text


def _known_keys(model: type[ConfigModel], location: tuple[int | str, ...], raw: Any) -> list[str]:
    """Return the keys allowed in the table that holds the last key of `location`."""
    for key in location[:-1]:
        raw = raw[key]
        # An index of a list, or a name that the user chooses, has no model of its own.
        table_model = model.find_table_model(key) if isinstance(key, str) else None
        if table_model is not None:
            model = table_model.select_class(raw) if isinstance(raw, Mapping) else table_model
    return model.list_keys()


def _make_fault(model: type[ConfigModel], error: Any, raw: Any) -> InputError:
    """Return one validation error with its key, value, what is allowed and what to do."""
    location: tuple[int | str, ...] = error["loc"]
    key = ".".join(str(part) for part in location) or "file"
    if error["type"] == "extra_forbidden":
        known = _known_keys(model, location, raw)
        return InputError("unknown key", key=key, remedy=suggest(str(location[-1]), known))
    if error["type"] == "missing":
        return InputError("missing", key=key, remedy="add it")
    if error["type"] in ("tuple_type", "list_type") and isinstance(error["input"], Mapping):
        remedy = f"write [[{key}]] above each of them"
        return InputError("one table", key=key, allowed="a list of tables", remedy=remedy)
    if error["type"] != "value_error":
        message = str(error["msg"])
        return InputError(f"{message[0].lower()}{message[1:]}", key=key, value=error["input"])
    cause = error["ctx"]["error"]
    if not isinstance(cause, InputError):
        return InputError(str(cause), key=key)
    if cause.key or cause.where:  # a key or place below this key of the file
        return cause.add_place(key) if location else cause
    return cause.replace(key=key)


def parse_toml(text: str, model: type[ConfigT], source: str) -> ConfigT:
    """Parse TOML text into a validated config; InputError has all `faults`, where is `source`."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(
            f"not valid TOML: {error}", where=source, remedy="correct the line that it names"
        ) from None
    except RecursionError:
        raise InputError(
            "brackets are nested too deeply", where=source, remedy="remove the nesting"
        ) from None
    try:
        return model.model_validate(raw)
    except ValidationError as error:
        faults = [_make_fault(model, details, raw) for details in error.errors(include_url=False)]
        raise InputError("", where=source, faults=faults) from None


def read_text(path: Path, kind: str) -> str:
    """Read the text of a file; InputError names the kind of file and the TOML files next to it.

    A null character is refused here, before any name in the text is used as that of a file.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        siblings = sorted(other.name for other in path.parent.glob("*.toml"))
        hint = f"there: {', '.join(siblings)}" if siblings else "give the path of a TOML file"
        raise InputError(f"no such {kind}", where=path, remedy=hint) from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read this {kind}: {error}", where=path) from None
    if null := NULL_CHARACTER.search(text):
        line = text.count("\n", 0, null.start()) + 1
        raise InputError("a null character", where=path, key=f"line {line}", remedy="remove it")
    return text


def load_config(path: Path, model: type[ConfigT], kind: str) -> tuple[ConfigT, str]:
    """Load a config from a file; return (validated config, text of the file)."""
    text = read_text(path, kind)
    return parse_toml(text, model, str(path)), text


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
