"""Selection of runs by an expression over the columns of the catalogue, as of SQL after WHERE.

Comparisons of a column with a number or a text in single quotes, and `'TAG' in tags`, joined by
`and`; with DuckDB any expression.
"""

import operator
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from table_io.errors import InputError, format_pip_line, suggest
from twin.archive.catalog import EXTRA, ROWS_FILE, load_rows, make_relation, open_database
from twin.archive.run_row import COLUMN_TYPES, LIST_TYPE, Row, RunRow

OPTION = "--where"
OPERATORS: dict[str, Callable[[Any, Any], bool]] = {
    "=": operator.eq, "!=": operator.ne, "<>": operator.ne, "<": operator.lt, "<=": operator.le,
    ">": operator.gt, ">=": operator.ge,
}  # fmt: skip
TEXT = r"'(?:[^']|'')*'"
NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
COMPARISON = re.compile(
    rf"\s*(?:(?P<tag>{TEXT})\s+in\s+tags|(?P<key>\w+)\s*(?P<operator>=|!=|<>|<=|>=|<|>)\s*"
    rf"(?:(?P<text>{TEXT})|(?P<number>{NUMBER})))\s*",
    re.IGNORECASE,
)
CONJUNCTION = re.compile(r"and\b", re.IGNORECASE)


def index_runs(folder: str | Path, where: str | None = None) -> list[RunRow]:
    """Return the runs in a folder that meet `where`, all by default, the newest first.

    From the catalogue of the folder, refreshed by what changed since, or else from the runs.
    InputError if `where` is not an expression over the columns.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError("no such folder", where=folder, remedy="give a folder that holds runs")
    rows = load_rows(folder)
    if where is not None:
        try:
            rows = select_by_comparisons(rows, where)
        except InputError:
            if find_spec("duckdb") is None:
                raise
            rows = _select_rows(rows, where)  # importing DuckDB takes as long as the rest
    return [*map(RunRow.from_columns, rows)]


def _select_rows(rows: Sequence[Row], where: str) -> list[Row]:
    """Return the rows that meet an SQL expression."""
    import duckdb

    database = open_database()
    with TemporaryDirectory() as scratch:
        relation = make_relation(database, rows, COLUMN_TYPES, Path(scratch, ROWS_FILE))
        relation.to_table("runs")
    database.execute("SET enable_external_access = false")  # the expression reads no other file
    try:
        if not where.strip():
            raise duckdb.Error("an empty expression")
        numbered = database.sql("SELECT *, row_number() OVER () - 1 AS number FROM runs")
        # As a filter, so that it is one expression, and no further statements.
        numbers = numbered.filter(f"({where}\n)").project("number").fetchall()
    except duckdb.Error as error:
        raise InputError(
            " ".join(str(error).split("\n\n", maxsplit=1)[0].split()),
            where=OPTION,
            value=where,
            allowed="what SQL allows after WHERE, over the columns of the catalogue; texts in "
            "single quotes",
            remedy="`shaketwin runs --columns` lists the columns",
        ) from None
    return [rows[number] for (number,) in numbers]


def select_by_comparisons(rows: Sequence[Row], where: str) -> list[Row]:
    """Return the rows that meet comparisons joined by `and`; InputError for anything else."""
    columns = dict.fromkeys([*COLUMN_TYPES, *(name for row in rows for name in row)])
    conditions = [*_parse_comparisons(where, columns)]
    return [row for row in rows if all(meets(row) for meets in conditions)]


def _parse_comparisons(where: str, columns: Iterable[str]) -> Iterator[Callable[[Row], bool]]:
    position = 0
    separator: re.Match[str] | bool | None = True
    while separator:
        match = COMPARISON.match(where, position)
        if match is None:
            break
        yield _make_condition(match, columns)
        position = match.end()
        if position == len(where):
            return
        separator = CONJUNCTION.match(where, position)
        position = separator.end() if separator else position
    raise InputError(
        "not a comparison, and duckdb, which takes any expression, is not installed",
        where=OPTION,
        value=where[position:],
        allowed="COLUMN = VALUE (or != < <= > >=) and 'TAG' in tags, joined by `and`; "
        "a VALUE is a number or a text in single quotes",
        remedy=format_pip_line(EXTRA),
    )


def _make_condition(match: re.Match[str], columns: Iterable[str]) -> Callable[[Row], bool]:
    """Return whether a row meets a comparison; as in SQL a value that is missing meets none."""
    if match["tag"]:
        tag = _unquote(match["tag"])
        return lambda row: isinstance(tags := row["tags"], list) and tag in tags
    key, compare = match["key"], OPERATORS[match["operator"]]
    is_text = COLUMN_TYPES.get(key) == "VARCHAR"
    if key not in columns:
        raise InputError("no such column", where=OPTION, key=key, remedy=suggest(key, columns))
    if COLUMN_TYPES.get(key) == LIST_TYPE:
        raise InputError("is a list", where=OPTION, key=key, remedy="ask for 'TAG' in it")
    if is_text != (match["text"] is not None):
        kind = "a text: put it in single quotes" if is_text else "a number"
        raise InputError(f"is compared with {kind}", where=OPTION, key=key, value=match[0].strip())
    value = _unquote(match["text"]) if is_text else float(match["number"])
    return lambda row: row.get(key) is not None and compare(row[key], value)


def _unquote(text: str) -> str:
    return text[1:-1].replace("''", "'")
