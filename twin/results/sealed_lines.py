"""Lines of a resumable task: a JSON line for each part that is stored, with a hash of itself.

Only the process that runs the task adds lines; a line is on the disk before the next part is kept,
so that a task that was killed goes on where it was.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Generic, TypeVar

from pydantic import ValidationError

from table_io.errors import InputError
from twin.results.contract import Contract
from twin.system.files import replace_text


class SealedLine(Contract):
    """Line of a file of lines."""

    line_sha256: str = ""  # of the line itself, none in a file of an earlier version


Line = TypeVar("Line", bound=SealedLine)


def hash_contract(contract: Contract, key: str) -> str:
    """Return a hash of all that a contract holds but `key`, where the hash stands."""
    plain = {name: value for name, value in contract.to_plain().items() if name != key}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def is_sealed(contract: Contract, key: str, must_be: bool) -> bool:
    """Return whether the hash at `key` is that of the rest; an empty one where none `must_be`."""
    stated: str = getattr(contract, key)
    return stated == hash_contract(contract, key) if stated else not must_be


def make_damage_error(path: Path, error: ValidationError | str, place: str = "") -> InputError:
    """Return the error of a file of a task that is not as it was written."""
    problem = error if isinstance(error, str) else _describe_first(error)
    return InputError(
        f"damaged: {place}: {problem}" if place else f"damaged: {problem}",
        where=path,
        remedy="restore it, or start a new study elsewhere",
    )


def _describe_first(error: ValidationError) -> str:
    first = error.errors()[0]
    return ": ".join(filter(None, (".".join(map(str, first["loc"])), first["msg"])))


class SealedLines(Generic[Line]):
    """File of lines of a kind; with `must_be_sealed` every line has its hash."""

    def __init__(self, path: Path, kind: type[Line], must_be_sealed: bool = True) -> None:
        self._path, self._kind, self._must_be_sealed = path, kind, must_be_sealed

    def read(self) -> Iterator[Line]:
        """Yield the lines, without one that was cut; InputError for one that was altered."""
        if not self._path.exists():
            return
        text = self._path.read_text(encoding="utf-8", errors="replace")
        for number, line in enumerate(text.splitlines(keepends=True), 1):
            if not line.endswith("\n"):  # the process died while it wrote it
                continue
            try:
                entry = self._kind.model_validate_json(line, extra="ignore")
            except ValidationError as error:
                raise make_damage_error(self._path, error, f"line {number}") from None
            if not is_sealed(entry, "line_sha256", self._must_be_sealed):
                problem = "it is not what was written"
                raise make_damage_error(self._path, problem, f"line {number}")
            yield entry

    def add(self, line: Line) -> Line:
        """Add a line and return it with its hash; it is on the disk when this returns."""
        line = line.model_copy()
        line.line_sha256 = hash_contract(line, "line_sha256")
        with self._path.open("a", encoding="utf-8") as file:
            file.write(_format_line(line))
            file.flush()
            os.fsync(file.fileno())
        return line

    def rewrite(self, lines: Iterable[Line]) -> None:
        """Replace the file as a whole."""
        replace_text(self._path, "".join(map(_format_line, lines)))


def _format_line(line: SealedLine) -> str:
    """Return the text of a line, its hash at the end."""
    plain = line.to_plain()
    if "line_sha256" in plain:
        plain["line_sha256"] = plain.pop("line_sha256")
    return json.dumps(plain) + "\n"
