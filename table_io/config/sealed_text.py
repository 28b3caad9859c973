"""Texts that end with their own hash, so that whoever reads one notices what was altered."""

import hashlib
import re

from table_io.errors import InputError

NOTE = "# The last line is the SHA-256 of the lines above."
SEAL = re.compile(r"# sha256 ([0-9a-f]{64})")


def seal_text(text: str) -> str:
    """Return a text, of which lines with # are comments, with a note and the hash of its lines."""
    lines = [*text.splitlines(), NOTE]
    return "\n".join([*lines, f"# sha256 {_hash_lines(lines)}", ""])


def require_seal(text: str, name: str, remedy: str) -> None:
    """Raise InputError where a sealed text is not what was written.

    One without note and hash is of an earlier version or written by hand, and is accepted.
    """
    lines = text.splitlines()
    while lines and not lines[-1]:
        lines.pop()
    seal = SEAL.fullmatch(lines[-1]) if lines else None
    if seal is None and NOTE not in text:
        return
    if seal is None or seal[1] != _hash_lines(lines[:-1]):
        raise InputError(f"{name} was altered after it was written", remedy=remedy)


def _hash_lines(lines: list[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()
