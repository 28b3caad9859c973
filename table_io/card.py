"""TOML files -> validated, frozen models. Every fault of a file stands in one message."""

import difflib
import tomllib
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

PROFILES = Path(__file__).resolve().parent.parent / "profiles"

# Strict: `true` or "0.05" where a number belongs is a slip, not a 1 or a 0.05.
Number = Annotated[float, Field(strict=True)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(strict=True)]


class BadInput(ValueError):
    """Something a person must mend: says where, what, what is allowed, what to do. Exit code 2."""


class Card(BaseModel):
    """Base of everything read from a file: no unknown keys, nothing changes afterwards.

    What a value must be beside another one is checked where the later of the two keys is read, from
    the valid ones before it (`info.data`): so a fault elsewhere hides nothing.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)


C = TypeVar("C", bound=Card)


def _known_keys(card: type[BaseModel], where: tuple[int | str, ...]) -> list[str]:
    """Keys allowed at the table that holds the last key of `where`."""
    current: Any = card
    for key in where[:-1]:
        if isinstance(key, int) or key not in current.model_fields:
            continue  # a place in a list, or a name that a table gives freely
        annotation: Any = current.model_fields[key].annotation
        stack = [annotation]
        while stack:
            item = stack.pop()
            if isinstance(item, type) and issubclass(item, BaseModel):
                current = item
                break
            stack.extend(getattr(item, "__args__", ()))
    return list(current.model_fields)


def _sentence(card: type[BaseModel], error: Any) -> str:
    """One fault in words: key, value, what is allowed, what to do."""
    where: tuple[int | str, ...] = error["loc"]
    key = ".".join(str(part) for part in where) or "file"
    if error["type"] == "extra_forbidden":
        known = _known_keys(card, where)
        near = difflib.get_close_matches(str(where[-1]), known, 1, 0.4)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(known)}"
        return f"{key}: unknown key; {hint}"
    if error["type"] == "missing":
        return f"{key}: missing; add it"
    message = str(error["msg"]).removeprefix("Value error, ")
    if error["type"] == "value_error":
        return f"{key}: {message}"
    return f"{key} = {error['input']!r}: {message[0].lower()}{message[1:]}"


def parse(text: str, card: type[C], where: str) -> C:
    """A validated card from TOML text; BadInput with every fault of it, `where` names the file."""
    try:
        raw = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise BadInput(f"{where}: not valid TOML: {error}. Mend the line it names.") from None
    except RecursionError:
        raise BadInput(f"{where}: brackets within brackets without end; take them out") from None
    try:
        return card.model_validate(raw)
    except ValidationError as error:
        faults = [_sentence(card, one) for one in error.errors(include_url=False)]
        raise BadInput("\n".join([f"{where}:", *(f"  {fault}" for fault in faults)])) from None


def read_text(path: Path, what: str) -> str:
    """The file's text; BadInput says what kind of file was wanted and what lies near it."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        there = sorted(other.name for other in path.parent.glob("*.toml"))
        hint = f"there: {', '.join(there)}" if there else "give the path of a TOML file"
        raise BadInput(f"{path}: no such {what}; {hint}") from None
    except (OSError, UnicodeDecodeError) as error:
        raise BadInput(f"{path}: cannot read this {what}: {error}") from None


def find(name: str, folder: str, beside: Path | None = None) -> Path:
    """Path of the card `name`: a path, or a name in `folder`, beside a profile or ours."""
    direct = Path(name)
    if direct.suffix == ".toml":
        by_profile = beside.parent / direct if beside is not None else direct
        return by_profile if by_profile.is_file() else direct
    places = [PROFILES / folder]
    if beside is not None:
        places.insert(0, beside.resolve().parent.parent / folder)
    for place in places:
        if (place / f"{name}.toml").is_file():
            return place / f"{name}.toml"
    known = sorted({path.stem for place in places for path in place.glob("*.toml")})
    near = difflib.get_close_matches(name, known, 1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    where = f"{beside}: " if beside is not None else ""
    raise BadInput(
        f"{where}{name}: not found in {folder}; {hint}known: {', '.join(known) or 'none'}; "
        "or give the path of a .toml file"
    )


def load(path: Path, card: type[C], what: str) -> tuple[C, str]:
    """(validated card, the file's text)."""
    text = read_text(path, what)
    return parse(text, card, str(path)), text
