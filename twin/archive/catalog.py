"""The catalogue of an archive: a row a run in runs.parquet, a row a step in steps.parquet.

runs.ndjson holds the rows of runs.parquet: what is asked most needs no DuckDB, slow to import. A
run is read when it is new, or when the size or the time of one of its files changed; its hashes
then decide whether its rows are made again.
"""

import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from table_io.errors import InputError, require_package
from twin.archive.notes import NOTES_FILE
from twin.archive.run_row import (
    COLUMN_TYPES,
    NUMBER_TYPE,
    STEP_TYPES,
    Row,
    RunRow,
    replace_nonfinite,
)
from twin.recording.run_paths import PARTS_FOLDER
from twin.report.run_index import LOG_NAME, iter_runs, order_by_start
from twin.system.terminal import error_console

if TYPE_CHECKING:
    from duckdb import DuckDBPyConnection, DuckDBPyRelation  # of the extra `archive`

CATALOG_FOLDER = "catalog"
ROWS_FILE, RUNS_FILE, STEPS_FILE = "runs.ndjson", "runs.parquet", "steps.parquet"
EXTRA = "archive"
LAYOUT = "2"  # of the rows: a catalogue with another one is made anew
KEY_TYPES = {"root": "VARCHAR", "folder": "VARCHAR"}
Key = tuple[str, str]  # root and folder of a run


@dataclass(frozen=True, slots=True)
class Catalog:
    """The catalogue of an archive, as it was written."""

    folder: Path
    runs: tuple[RunRow, ...]
    steps: int
    read: int  # runs that are new or have changed
    removed: int  # runs that are no longer there


@dataclass(slots=True)
class _Refreshed:
    """Rows by run as they are now, and the rows of steps of the runs that were read."""

    rows: dict[Key, Row] = field(default_factory=dict)
    steps: dict[Key, list[Row]] = field(default_factory=dict)


def update_catalog(
    folders: Sequence[str | Path],
    out: str | Path | None = None,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> Catalog:
    """Write the catalogue of all runs in or below folders, and return it.

    It is the folder `out`, by default `catalog` in the one folder. Runs in it that did not change
    since are not read again. InputError without DuckDB, or if `out` holds something else.
    """
    roots = [Path(folder) for folder in folders]
    for root in roots:
        if not root.is_dir():
            raise InputError("no such folder", where=root, remedy="give a folder that holds runs")
    if out is None and len(roots) > 1:
        raise InputError(
            "several folders need a place for their catalogue", key="--out", remedy="name one"
        )
    require_package("duckdb", EXTRA, "catalog")
    folder = roots[0] / CATALOG_FOLDER if out is None else Path(out)
    is_new = not (folder / RUNS_FILE).is_file()
    if is_new and folder.exists() and any(folder.iterdir()):
        raise InputError("holds no catalogue", where=folder, remedy="name a new folder by --out")
    folder.mkdir(parents=True, exist_ok=True)
    with open_database() as database:
        before = _read_rows(folder) if (folder / ROWS_FILE).is_file() else {}
        names = [os.path.relpath(root.resolve(), folder.resolve()) for root in roots]
        refreshed = _refresh(folder, names, before, tell)
        rows = _sort_newest_first(refreshed.rows.values())
        kept = before.keys() & (refreshed.rows.keys() - refreshed.steps.keys())
        step_count = _write_steps(database, folder / STEPS_FILE, kept, refreshed)
        fresh = folder / f"{ROWS_FILE}.new"
        _write_parquet(make_relation(database, rows, COLUMN_TYPES, fresh), folder / RUNS_FILE)
        fresh.replace(folder / ROWS_FILE)
    return Catalog(
        folder,
        tuple(map(RunRow.from_columns, rows)),
        step_count,
        read=len(refreshed.steps),
        removed=len(before.keys() - refreshed.rows.keys()),
    )


def load_rows(folder: Path) -> list[Row]:
    """Return the rows of the runs in a folder, the newest first.

    From its catalogue, with what changed since, which is read but not written. Without a catalogue,
    or with a damaged one, all runs in the folder are read.
    """
    catalog = next(
        (c for c in (folder, folder / CATALOG_FOLDER) if (c / ROWS_FILE).is_file()), None
    )
    before = None
    if catalog is not None:
        try:
            before = _read_rows(catalog)
        except InputError as error:
            error_console.print(f"warning: {error}", highlight=False, soft_wrap=True)
    if catalog is None or before is None:
        return _sort_newest_first(_refresh(folder, ["."], None).rows.values())
    roots = dict.fromkeys(root for root, _ in before) or {os.pardir: None}
    rows = _sort_newest_first(_refresh(catalog, list(roots), before).rows.values())
    for row in rows:
        row["folder"] = os.path.relpath(catalog / f"{row['root']}/{row['folder']}", folder)
    return rows


def _read_run(
    folder: Path, name: str, before: Row | None = None
) -> tuple[RunRow, list[Row] | None]:
    from twin.archive.run_reading import read_run  # slow to import, and only for what changed

    return read_run(folder, name, before)


def _describe_files(run: Path) -> str:
    """Return size and last change of the files of a run, by which a change of them is noticed."""
    parts = [LAYOUT]
    for name in (
        (LOG_NAME, PARTS_FOLDER, "summary.json", NOTES_FILE) if run.suffix != ".mcap" else ("",)
    ):
        with suppress(OSError):
            state = os.stat(os.path.join(run, name) if name else run)
            parts.append(f"{name or LOG_NAME} {state.st_size} {state.st_mtime_ns}")
    return "; ".join(parts)


def _refresh(
    catalog: Path,
    roots: Iterable[str],
    before: Mapping[Key, Row] | None,
    tell: Callable[[int, int], None] = lambda done, total: None,
) -> _Refreshed:
    """Return the rows of all runs below the roots, of those that did not change as they were.

    Without rows of a catalogue `before` no file is hashed.
    """
    refreshed = _Refreshed()
    runs = {
        (root, os.path.relpath(run, catalog / root)): run
        for root in roots
        for run in iter_runs(Path(os.path.normpath(catalog / root)))
    }
    for number, (key, folder) in enumerate(runs.items(), start=1):
        row, files = (before or {}).get(key), _describe_files(folder)
        if row is None or row["files"] != files:
            is_known = row is not None and str(row["files"]).split(";")[0] == LAYOUT
            known = row if row and is_known else {}
            read, steps = _read_run(folder, key[1], None if before is None else known)
            row = replace(read, root=key[0], files=files).to_columns()
            if steps is not None:
                refreshed.steps[key] = steps
            tell(number, len(runs))
        refreshed.rows[key] = row
    return refreshed


def _sort_newest_first(rows: Iterable[Row]) -> list[Row]:
    return sorted(rows, key=_find_start, reverse=True)


def _find_start(row: Row) -> tuple[float, float]:
    """Return the start of a run and the last change of its recording, in s since 1970."""
    changed_s = 0.0
    for part in str(row["files"]).split("; "):
        name, _, state = part.partition(" ")
        if name in (LOG_NAME, PARTS_FOLDER):
            changed_s = float(state.split()[1]) / 1e9
    return order_by_start(row["started_at"], changed_s)


def open_database() -> "DuckDBPyConnection":
    """Return an empty DuckDB database in memory, which fetches no extension from anywhere."""
    import duckdb

    return duckdb.connect(
        config={"threads": 1, "autoinstall_known_extensions": False}  # rows are few
    )


def _read_rows(catalog: Path) -> dict[Key, Row]:
    """Return the rows of a catalogue by run; InputError if its file is damaged."""
    path = catalog / ROWS_FILE
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return {(row["root"], row["folder"]): row for row in rows}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"no catalogue of runs: {error}",
            where=path,
            remedy="remove its folder and run `shaketwin catalog` again",
        ) from None


def make_relation(
    database: "DuckDBPyConnection", rows: Iterable[Row], types: Mapping[str, str], path: Path
) -> "DuckDBPyRelation":
    """Write rows to a file of JSON lines, and return it as a relation of a database.

    Columns without a type hold numbers.
    """
    names = dict.fromkeys(types)
    with path.open("w", encoding="utf-8") as file:
        for row in rows:
            names |= dict.fromkeys(row)
            file.write(json.dumps(replace_nonfinite(row)) + "\n")
    columns = {name: types.get(name, NUMBER_TYPE) for name in names}
    return database.read_json(str(path), format="newline_delimited", columns=columns)


def _write_steps(
    database: "DuckDBPyConnection", path: Path, kept: Iterable[Key], refreshed: _Refreshed
) -> int:
    """Write the rows of the steps, of runs that are `kept` as they are; return how many."""
    rows = (row | {"root": key[0]} for key, steps in refreshed.steps.items() for row in steps)
    keys: list[Row] = [{"root": root, "folder": folder} for root, folder in kept]
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        steps = make_relation(database, rows, STEP_TYPES, scratch / "steps.ndjson")
        if path.is_file():
            kept_runs = make_relation(database, keys, KEY_TYPES, scratch / "kept.ndjson")
            kept_runs.create_view("kept")
            database.read_parquet(str(path)).create_view("old")
            steps.create_view("fresh")
            steps = database.sql(
                "SELECT old.* FROM old SEMI JOIN kept USING (root, folder) "
                "UNION ALL BY NAME SELECT * FROM fresh"
            )
        steps = steps.order("root, folder, step")
        _write_parquet(steps, path)
    ((count,),) = database.read_parquet(str(path)).count("*").fetchall()
    return int(count)


def _write_parquet(relation: "DuckDBPyRelation", path: Path) -> None:
    """Write a relation to a Parquet file, which is replaced as a whole."""
    new = path.with_name(f"{path.name}.new")
    relation.write_parquet(str(new))
    new.replace(path)
