"""Errors that a user can correct."""

import difflib
from collections.abc import Iterable

MIN_SIMILARITY = 0.5  # of a known name that is suggested, 1 for the same
MAX_LISTED_NAMES = 40


class InputError(ValueError):
    """A file, value or option that a user must correct; commands end with exit code 2.

    The message is composed of the given fields in this order: `where: key = value: problem;
    allowed: ...; remedy`. Tests and programs read the fields, users read the message.
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
    ) -> None:
        self.problem = problem
        self.where = str(where)
        self.key = key
        self.value = value
        self.allowed = allowed
        self.remedy = remedy
        subject = key if value is None else f"{key} = {value!r}" if key else repr(value)
        message = ": ".join(part for part in (self.where, subject, problem) if part)
        if allowed:
            message += f"; allowed: {allowed}"
        if remedy:
            message += f"; {remedy}"
        super().__init__(message)


def suggest(name: str, known: Iterable[str]) -> str:
    """Return the remedy for an unknown name: the known name closest to it, or all of them."""
    known_names = list(known)
    matches = difflib.get_close_matches(name, known_names, 1, MIN_SIMILARITY)
    if matches:
        return f"did you mean {matches[0]!r}?"
    hidden_count = len(known_names[MAX_LISTED_NAMES:])
    suffix = f" and {hidden_count} more" if hidden_count else ""
    return f"known: {', '.join(known_names[:MAX_LISTED_NAMES]) or 'none'}{suffix}"
