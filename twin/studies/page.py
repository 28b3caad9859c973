"""HTML report of a batch, from its table and summary."""

import math
from pathlib import Path
from typing import Any

from twin.drawing.page import embed_images, render_page
from twin.results.contract import Contract
from twin.studies import TABLE_FILE
from twin.studies.cases import format_gap_mm
from twin.studies.rows import read_batch_rows


class BatchSummary(Contract):
    """Keys that every summary.json of a batch has."""

    run: dict[str, Any]
    verdict: str
    reason: str
    models: dict[str, Any]
    cases: list[dict[str, Any]]


def write_study_page(folder: Path) -> Path:
    """Write folder/report.html and its figures; return the path."""
    from twin.studies.figures import draw_study_figures

    remedy = "give a folder written by simulate"
    summary = BatchSummary.read(folder / "summary.json", remedy).to_plain()
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
