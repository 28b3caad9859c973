"""Index of runs: what a folder of runs holds, newest first, and which one is the last."""

import html
import json
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from table_io.errors import InputError
from twin.recording.run_paths import PARTS_FOLDER
from twin.results.contracts import ChannelError, RunSummary

LOG_NAME = "run.mcap"
# Below the folder itself: a run, a run of a campaign, and both in the default folder `runs`.
PLACES = ("", "*/", "*/*/", "runs/*/*/")
INDEX_MARK = '<meta name="generator" content="shaketwin runs">'


@dataclass(frozen=True, slots=True)
class RunRow:
    """A run in the index; what its summary does not state is None."""

    folder: str
    started_at: str | None
    test: str | None
    title: str | None
    source: str | None  # table or model
    gap_m: float | None
    verdict: str | None
    twin_verdict: str | None
    excitation_verdict: str | None
    misfit: float | None  # of u in multiples of the noise: median over the steps
    misfit_worst: float | None  # the same at the worst step
    nrmse: float | None  # of u, restarted twin
    warnings: int | None
    dropouts: int | None
    model: str | None


def find_run_folders(folder: Path) -> list[Path]:
    """Return the folders of runs in or below a folder, the newest recording first.

    The start of a run is in its summary; of one without, still recording or killed, it is the last
    change of its files. A copied folder keeps its place that way.
    """
    starts: dict[Path, tuple[float, float]] = {}
    for place in PLACES:
        for name in (LOG_NAME, PARTS_FOLDER):
            for path in folder.glob(f"{place}{name}"):
                if not any(part.startswith(".") for part in path.relative_to(folder).parts[:-1]):
                    starts.setdefault(path.parent, _read_start(path))
    return sorted(starts, key=lambda run: starts[run], reverse=True)


def _read_start(recording: Path) -> tuple[float, float]:
    """Return the start of a run and the last change of its recording, in s since 1970.

    The second orders runs that started within the same second.
    """
    try:
        changed_s = recording.stat().st_mtime
    except OSError:  # merged or moved since it was listed
        changed_s = 0.0
    try:
        text = (recording.parent / "summary.json").read_text(encoding="utf-8")
        return datetime.fromisoformat(json.loads(text)["run"]["started_at"]).timestamp(), changed_s
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError):
        return changed_s, changed_s


def find_last_run(folder: Path, *, measured: bool = False) -> Path:
    """Return the folder of the newest run in or below a folder; InputError without one.

    With `measured`, no simulation: the model's own motion lacks no physics.
    """
    folders = find_run_folders(folder)
    if measured:
        folders = [run for run in folders if _read_row(folder, run).source != "model"]
    if not folders:
        raise InputError(
            f"no {'measured ' if measured else ''}run in this folder or in its folder runs",
            where=folder.resolve(),
            key="last",
            remedy="give the folder of a run, or change to the folder that holds the runs",
        )
    return folders[0]


def index_runs(folder: Path) -> list[RunRow]:
    """Return a row per run in or below a folder, the newest first."""
    return [_read_row(folder, run) for run in find_run_folders(folder)]


def _read_row(root: Path, folder: Path) -> RunRow:
    try:
        summary = RunSummary.read(folder / "summary.json", "")
    except InputError:
        return RunRow(str(folder.relative_to(root)), *[None] * 14)
    info, twin, stated = summary.run, summary.twin_verdict, summary.model_fields_set
    return RunRow(
        folder=str(folder.relative_to(root)),
        started_at=info.started_at or None,
        test=info.name or None,
        title=info.title or None,
        source=info.source or None,
        gap_m=info.gap_m,
        verdict=summary.verdict,
        twin_verdict=twin.verdict if twin else None,
        excitation_verdict=summary.excitation_verdict.verdict
        if summary.excitation_verdict
        else None,
        misfit=twin.misfit if twin else None,
        misfit_worst=twin.misfit_worst if twin else None,
        nrmse=summary.comparison.get("rel_disp_m", ChannelError()).nrmse,
        warnings=len(summary.warnings) if "warnings" in stated else None,
        dropouts=summary.gaps if "gaps" in stated else None,
        model=info.model,
    )


def write_run_index(rows: Iterable[RunRow], page: Path, root: Path) -> None:
    """Write the index page, with links to the reports of the runs below `root`.

    InputError if the file exists and is no index: only an index is replaced.
    """
    from twin.drawing.page import render_page  # slow to import

    if page.exists() and INDEX_MARK not in page.read_text(encoding="utf-8", errors="replace"):
        raise InputError(
            "exists and is no index of runs; it is not overwritten",
            key="--page",
            value=str(page),
            remedy="give a new file",
        )
    reports = {
        row.folder: html.escape(str((root / row.folder / "report.html").resolve().as_uri()))
        for row in rows
        if (root / row.folder / "report.html").is_file()
    }
    text = render_page(Path(__file__).with_name("run_index.html"), rows=[*rows], reports=reports)
    page.write_text(text.replace("<head>", f"<head>\n{INDEX_MARK}", 1), encoding="utf-8")
