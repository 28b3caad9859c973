"""`runs`: table, JSON or index page of the runs in a folder."""

from dataclasses import asdict
from pathlib import Path

from rich.table import Table
from rich.text import Text

from table_io.errors import InputError, replace_escapes
from twin.report.finalize import VERDICT_COLOURS
from twin.report.run_index import RunRow, index_runs, write_run_index
from twin.results.contract import format_json
from twin.system.terminal import console, print_line, print_table

COLOURS = VERDICT_COLOURS | {"complete": "green", "stopped": "yellow"}


def print_runs(folder: Path, as_json: bool, page: Path | None) -> None:
    """Print the runs in a folder as a table or JSON, and write an index page where asked for."""
    if not folder.is_dir():
        raise InputError("no such folder", where=folder, remedy="give a folder that holds runs")
    rows = index_runs(folder)
    if page is not None:
        write_run_index(rows, page, folder)
    if as_json:
        print(format_json({"runs": [asdict(row) for row in rows]}))
        return
    if rows:
        print_table(console, _make_table(rows))
    else:
        print_line(f"no runs in {folder.resolve()} or in its folder runs")
    if page is not None:
        print_line(f"{page}")


def _make_table(rows: list[RunRow]) -> Table:
    table = Table(title="Runs, the newest first; misfit of u")
    for head in ("folder", "date", "test", "gap [mm]", "test ended", "excitation", "twin",
                 "misfit [%]", "x noise", "worst", "warnings", "dropouts"):  # fmt: skip
        is_number = head.endswith("]") or head in ("x noise", "worst", "warnings", "dropouts")
        table.add_column(head, justify="right" if is_number else "left")
    for row in rows:
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
        )
    return table


def _format(value: float | None, scale: float, digits: int = 4) -> str:
    return "-" if value is None else f"{scale * value:.{digits}g}"


def _colour(word: str) -> Text:
    is_bad = word in ("aborted", "halted", "departs", "missed", "no summary")
    return Text(replace_escapes(word), style=COLOURS.get(word, "red" if is_bad else ""))
