"""`catalog`, `runs`, `note` and `fleet`: call their tasks, print what came of them."""

import json
from collections.abc import Sequence
from pathlib import Path

from rich.table import Table
from rich.text import Text

from table_io.clock import RealClock
from table_io.errors import replace_escapes
from twin.archive.catalog import update_catalog
from twin.archive.fleet import TABLE_FILE, FleetOptions, run_fleet
from twin.archive.notes import note_run
from twin.archive.query import index_runs
from twin.archive.run_row import COLUMN_TYPES, NUMBER_TYPE, RunRow, replace_nonfinite
from twin.system.exit_codes import EXIT_GAPS, EXIT_INTERRUPTED
from twin.system.grid import watch_on_terminal
from twin.system.terminal import (
    VERDICT_COLOURS,
    catch_interrupts,
    console,
    print_line,
    print_table,
)

COLOURS = VERDICT_COLOURS | {"complete": "green", "stopped": "yellow"}
MAX_LISTED = 10  # runs with a problem
POLL_S = 0.2  # within which Ctrl-C ends the page
PROGRESS_RUNS = 100  # between lines

MAX_FLEET_LISTED = 20  # failures, and changes; all of them are in the tables


def print_fleet(options: FleetOptions) -> int:
    """Run a fleet, print its table, failures and changes; return the exit code."""
    with watch_on_terminal("stopping after the logs in progress") as watch:
        fleet = run_fleet(options, watch)
    for failed in fleet.failures[:MAX_FLEET_LISTED]:
        print_line(f"failed: {failed.log}: {failed.failure}")
    for change in fleet.changes[:MAX_FLEET_LISTED]:
        print_line(f"changed: {change.log}: {change.column} {change.before} -> {change.after}")
    state = "complete"
    if not fleet.is_complete:
        state = f"stopped ({fleet.stop_reason}); continue with --resume"
    changes = "" if options.since is None else f", {len(fleet.changes)} values changed"
    print_line(
        f"{len(fleet.results)} of {fleet.total} logs, {len(fleet.failures)} failed{changes}, "
        f"{state} -> {fleet.folder / TABLE_FILE}"
    )
    if not fleet.is_complete:
        return EXIT_INTERRUPTED
    return EXIT_GAPS if fleet.failures else 0


def print_catalog(folders: Sequence[Path], out: Path | None) -> None:
    """Write the catalogue of folders and print what is in it and what is wrong with runs."""

    def tell(done: int, total: int) -> None:
        if done % PROGRESS_RUNS == 0:
            print_line(f"{done} of {total} runs")

    catalog = update_catalog(folders, out, tell)
    faulty = [row for row in catalog.runs if row.problem]
    for row in faulty[:MAX_LISTED]:
        print_line(f"{row.folder}: {row.problem}")
    if len(faulty) > MAX_LISTED:
        print_line(f"and {len(faulty) - MAX_LISTED} more: --where \"problem != ''\" lists them")
    print_line(
        f"{len(catalog.runs)} runs with {catalog.steps} steps, {catalog.read} of them read, "
        f"{catalog.removed} gone, {len(faulty)} with a problem -> {catalog.folder}"
    )


def print_runs(
    folder: Path, as_json: bool, page: Path | None, where: str | None, list_columns: bool
) -> None:
    """Print the runs in a folder as a table or JSON, and write an index page where asked for.

    With `list_columns` only the columns over which --where selects.
    """
    rows = index_runs(folder, where)
    if list_columns:
        for name in dict.fromkeys(
            [*COLUMN_TYPES, *(key for row in rows for key in row.to_columns())]
        ):
            print_line(f"{name} {COLUMN_TYPES.get(name, NUMBER_TYPE)}")
        return
    if page is not None:
        from twin.archive.page import write_run_index  # slow to import

        write_run_index(rows, page, folder, where or "")
    if as_json:
        runs = [replace_nonfinite(row.to_columns()) for row in rows]
        print(json.dumps({"runs": runs}, indent=1, allow_nan=False))
        return
    if rows:
        print_table(console, _make_table(rows))
        faulty = sum(row.problem is not None for row in rows)
        if faulty:
            print_line(f"{faulty} with a problem; --json states them")
    elif where is not None:
        print_line(f"no run in {folder.resolve()} meets --where {where}")
    else:
        print_line(f"no runs in {folder.resolve()} or in its folder runs")
    if page is not None:
        print_line(f"{page}")


def show_runs(folder: Path, where: str | None) -> None:
    """Serve the page of the runs in a folder until the user ends it."""
    from twin.archive.page_server import serve_runs  # slow to import

    with serve_runs(folder, where) as address, catch_interrupts("closing the page") as find_stop:
        print_line(f"{address} shows the runs and edits notes, on this machine; Ctrl-C ends it")
        clock = RealClock()
        while not find_stop():
            clock.wait_until(clock.now() + POLL_S)


def print_note(folder: Path, text: str | None, tags: Sequence[str], untag: Sequence[str]) -> None:
    """Note on a run, and print its note and tags as they are then."""
    notes = note_run(folder, text, tuple(tags), tuple(untag))
    print_line(f"note: {notes.note or '-'}")
    print_line(f"tags: {', '.join(notes.tags) or '-'}")


def _make_table(rows: Sequence[RunRow]) -> Table:
    table = Table(title="Runs, the newest first; misfit of u")
    heads = ["folder", "date", "test", "gap [mm]", "test ended", "excitation", "twin",
             "misfit [%]", "x noise", "worst", "warnings", "dropouts"]  # fmt: skip
    has_tags = any(row.tags for row in rows)
    for head in [*heads, "tags"] if has_tags else heads:
        is_number = head.endswith("]") or head in ("x noise", "worst", "warnings", "dropouts")
        table.add_column(head, justify="right" if is_number else "left")
    for row in rows:
        tags = [", ".join(row.tags)] if has_tags else []
        table.add_row(
            row.folder,
            (row.started_at or "-")[:16].replace("T", " "),
            row.test or "-",
            _format(row.gap_m, 1e3),
            _colour(row.verdict or "no summary"),
            _colour(row.excitation_verdict or "-"),
            _colour(row.twin_verdict or "-"),
            _format(row.nrmse, 100, 2),
            _format(row.misfit, 1, 2),
            _format(row.misfit_worst, 1, 2),
            "-" if row.warnings is None else str(row.warnings),
            "-" if row.dropouts is None else str(row.dropouts),
            *tags,
        )
    return table


def _format(value: float | None, scale: float, digits: int = 4) -> str:
    return "-" if value is None else f"{scale * value:.{digits}g}"


def _colour(word: str) -> Text:
    is_bad = word in ("aborted", "halted", "departs", "missed", "no summary")
    return Text(replace_escapes(word), style=COLOURS.get(word, "red" if is_bad else ""))
