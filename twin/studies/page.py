"""HTML report of a batch, from its table and summary."""

import json
import math
from pathlib import Path

from table_io.errors import InputError
from twin.reports.page import embed_images, render_page
from twin.reports.summary import Json
from twin.studies import TABLE_FILE
from twin.studies.cases import format_gap_mm
from twin.studies.rows import read_batch_rows


def write_study_page(folder: Path) -> Path:
    """Write folder/report.html and its figures; return the path."""
    from twin.studies.figures import draw_study_figures

    summary = _read_summary(folder / "summary.json")
    pictures = draw_study_figures(read_batch_rows(folder / TABLE_FILE), summary, folder / "figures")
    path = folder / "report.html"
    text = render_page(
        Path(__file__).with_name("batch.html"),
        summary=summary,
        images=embed_images(pictures),
        format_gap=lambda gap: format_gap_mm(math.inf if gap == "inf" else gap),
    )
    path.write_text(text, encoding="utf-8")
    return path


def _read_summary(path: Path) -> Json:
    """Read the summary of a batch; raise InputError if it is missing or of another kind."""
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        _ = summary["cases"], summary["models"], summary["run"]["title"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"not the summary of a batch: {error!r}",
            where=path,
            remedy="give a folder written by simulate",
        ) from None
    return dict(summary)
