"""HTML report of a batch, from its table and summary."""

from pathlib import Path

from twin.drawing.page import embed_images, write_page
from twin.studies import TABLE_FILE
from twin.studies.batch import format_gap_mm
from twin.studies.figures import draw_study_figures
from twin.studies.result import REMEDY, SweepSummary, read_batch_rows


def write_study_page(folder: Path) -> Path:
    """Write folder/report.html and its figures; return the path."""
    summary = SweepSummary.read(folder / "summary.json", REMEDY)
    pictures = draw_study_figures(read_batch_rows(folder / TABLE_FILE), summary, folder / "figures")
    return write_page(
        folder,
        Path(__file__).with_name("batch.html"),
        summary=summary,
        images=embed_images(pictures),
        format_gap=format_gap_mm,
    )
