"""Errors that a user can correct."""

import difflib
from collections.abc import Iterable, Sequence
from importlib.util import find_spec
from typing import Any
from unicodedata import category

MIN_SIMILARITY = 0.5  # of a known name that is suggested, 1 for the same
MAX_LISTED_NAMES = 40
CONTROL_CATEGORIES = {"Cc", "Cf", "Cn", "Co", "Cs", "Zl", "Zp"}  # of Unicode


class InputError(ValueError):
    """A file, value or option that a user must correct; commands end with exit code 2.

    The message is composed of the given fields in this order: `where: key = value: problem;
    allowed: ...; remedy`, and then `faults` on lines of their own: the errors of the single keys
    of a file. Tests and programs read the fields, users read the message.
    """

    def __init__(
        self,
        problem: str,
        *,
        where: object = "",
        key: str = "",
        value: object = None,
        allowed: str = "",
        remedy: str = "",
        faults: Sequence["InputError"] = (),
    ) -> None:
        self.problem = problem
        self.where = str(where)
        self.key = key
        self.value = value
        self.allowed = allowed
        self.remedy = remedy
        self.faults = tuple(faults)
        subject = key if value is None else f"{key} = {value!r}" if key else repr(value)
        message = ": ".join(part for part in (self.where, subject, problem) if part)
        if allowed:
            message += f"; allowed: {allowed}"
        if remedy:
            message += f"; {remedy}"
        if self.faults:
            lines = (line for fault in self.faults for line in str(fault).splitlines())
            message = "\n".join([f"{message}:", *(f"  {line}" for line in lines)])
        super().__init__(replace_escapes(message))

    def replace(self, **changes: Any) -> "InputError":
        """Return a copy with other fields."""
        fields: dict[str, Any] = {
            "problem": self.problem,
            "where": self.where,
            "key": self.key,
            "value": self.value,
            "allowed": self.allowed,
            "remedy": self.remedy,
            "faults": self.faults,
        }
        return InputError(**(fields | changes))

    def add_place(self, place: object) -> "InputError":
        """Return a copy with `place` before `where`."""
        return self.replace(where=f"{place}: {self.where}" if self.where else place)


def replace_nonprintable(line: str) -> str:
    """Return a line with control characters replaced by ?: foreign text may hold escapes."""
    if line.isprintable():
        return line
    return "".join("?" if is_control(character) else character for character in line)


def is_control(character: str) -> bool:
    """Return whether a terminal may obey a character instead of showing it; tabs are shown."""
    return category(character) in CONTROL_CATEGORIES and character != "\t"


def replace_escapes(text: str) -> str:
    """Return a text with the nonprintable characters of its lines replaced by ?."""
    return "\n".join(map(replace_nonprintable, text.split("\n")))


def suggest(name: str, known: Iterable[str]) -> str:
    """Return the remedy for an unknown name: the known name closest to it, or all of them."""
    known_names = list(known)
    matches = difflib.get_close_matches(name, known_names, 1, MIN_SIMILARITY)
    if matches:
        return f"did you mean {matches[0]!r}?"
    hidden_count = len(known_names[MAX_LISTED_NAMES:])
    suffix = f" and {hidden_count} more" if hidden_count else ""
    return f"known: {', '.join(known_names[:MAX_LISTED_NAMES]) or 'none'}{suffix}"


def format_pip_line(extra: str) -> str:
    """Return the remedy for a package that is not installed, which an extra of ours brings."""
    return f'pip install "shaketwin[{extra}]"'


def require_package(package: str, extra: str, where: str) -> None:
    """Raise InputError with the pip line unless `package` can be imported; imports nothing."""
    if find_spec(package) is None:
        raise InputError(f"{package} is not installed", where=where, remedy=format_pip_line(extra))
