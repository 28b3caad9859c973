"""Index page of runs: filter, sort, compare two, trends over time, and the command that notes."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from table_io.errors import InputError
from twin.archive.run_row import RunRow, replace_nonfinite
from twin.drawing.page import render_page

INDEX_MARK = '<meta name="generator" content="shaketwin runs">'


@dataclass(frozen=True, slots=True)
class Column:
    """Column of the table of the page: its head, and the key by which it is sorted."""

    head: str
    key: str
    is_text: bool = False


COLUMNS = (
    Column("Date", "started_at", True),
    Column("Test", "test", True),
    Column("gap in mm", "gap_mm"),
    Column("Test ended", "verdict", True),
    Column("Excitation", "excitation_verdict", True),
    Column("Twin", "twin_verdict", True),
    Column("misfit of u in %", "nrmse"),
    Column("times the noise", "twin_misfit"),
    Column("worst step", "twin_misfit_worst"),
    Column("warnings", "warnings"),
    Column("dropouts", "dropouts"),
    Column("Model", "model", True),
    Column("Folder", "folder", True),
    Column("Tags and note", "note", True),
)


def write_run_index(rows: Sequence[RunRow], page: Path, root: Path, where: str = "") -> None:
    """Write the index page, with links to the reports of the runs below `root`.

    InputError if the file exists and is no index: only an index is replaced.
    """
    if page.exists() and INDEX_MARK not in page.read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            "exists and is no index of runs; it is not overwritten",
            key="--page",
            value=str(page),
            remedy="give a new file",
        )
    text = render_run_index(rows, root, where)
    page.write_text(text.replace("<head>", f"<head>\n{INDEX_MARK}", 1), encoding="utf-8")


def render_run_index(
    rows: Sequence[RunRow], root: Path, where: str = "", *, is_served: bool = False
) -> str:
    """Return the index page; one that is served edits notes, and gets reports from its server."""
    paths = {row.folder: (root / row.folder).resolve() for row in rows}
    reports = {
        folder: f"report?{quote(folder)}" if is_served else (path / "report.html").as_uri()
        for folder, path in paths.items()
        if (path / "report.html").is_file()
    }
    data = [replace_nonfinite(row.to_columns()) | {"path": str(paths[row.folder])} for row in rows]
    return render_page(
        Path(__file__).with_name("runs.html"),
        rows=[*rows],
        reports=reports,
        columns=COLUMNS,
        where=where,
        is_served=is_served,
        data=json.dumps(data).replace("<", "\\u003c"),
    )
