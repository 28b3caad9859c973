"""Figures, HTML page and paper.json of the comparison."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

from twin.model.config import ModelConfig
from twin.reports.figures import Picture
from twin.reports.measured_campaign import MeasuredCampaign
from twin.reports.page import embed_images, render_page
from twin.reports.plot_style import PAPER_RC_PARAMS, PaperFigure
from twin.reports.summary import dump_strict_json
from twin.run.run_config import read_model
from twin.validation.paper.extra_figures import draw_chaos_figure
from twin.validation.paper.force_loops import draw_paper_loop_figures
from twin.validation.paper.frequency_figures import draw_frequency_figures
from twin.validation.paper.prc_figures import draw_prc_figures
from twin.validation.paper.rows import ComparisonRow
from twin.validation.paper.secondary_resonances import draw_secondary_resonance_figure
from twin.validation.paper.study import PaperStudy

PAPER_MODEL = "snm"
FIGURE_ORDER = ("2", "3", "5", "6", "7", "8", "9", "11", "12", "")
ProgressReporter = Callable[[str], None]


def draw_paper_figures(
    study: PaperStudy, campaign: MeasuredCampaign | None, folder: Path, report: ProgressReporter
) -> list[Picture]:
    """Draw the figures in the paper's order: of the model, or with the points of a campaign."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(PAPER_RC_PARAMS):
        figures: list[PaperFigure] = []
        for draw in (
            draw_prc_figures,
            draw_paper_loop_figures,
            draw_secondary_resonance_figure,
            draw_frequency_figures,
            draw_chaos_figure,
        ):
            figures += draw(study, campaign)
        figures.sort(key=lambda figure: FIGURE_ORDER.index(figure.number))
        pictures = []
        for figure in figures:
            path = folder / f"{figure.name}.png"
            figure.figure.savefig(path)
            report(f"{path}")
            title = f"Figure {figure.number}. {figure.title}" if figure.number else figure.title
            pictures.append(Picture(path, title, figure.caption))
    return pictures


@dataclass(frozen=True, slots=True)
class ModelSource:
    """Model as given on the command line (`reference`), its config and its TOML text."""

    reference: str
    config: ModelConfig
    toml_text: str

    @property
    def name(self) -> str:
        """Name of the model without folder and suffix."""
        return Path(self.reference).stem if self.reference.endswith(".toml") else self.reference


def write_paper_json(
    rows: list[ComparisonRow],
    study: PaperStudy,
    source: ModelSource,
    pictures: list[Picture],
    path: Path,
) -> None:
    """Write the table, the PRC points and the impact distributions as strict JSON."""
    document: dict[str, Any] = {
        "model": {"name": source.name, "title": source.config.title, "toml": source.toml_text},
        "table": [asdict(row) for row in rows],
        "prc": {
            name: [
                {"frequency_hz": point.frequency_hz, "direction": point.direction}
                | (asdict(point.twin) if point.twin else {})
                for point in case.points
            ]
            for name, case in study.cases.items()
        },
        "impacts": {
            f"{hz:g}": {f"{r}/{l_}": share for (r, l_), share in distribution.shares}
            for hz, distribution in study.impacts.items()
        },
        "figures": [f"figures/{picture.path.name}" for picture in pictures],
    }
    path.write_text(dump_strict_json(document) + "\n", encoding="utf-8")


def write_paper_page(
    rows: list[ComparisonRow],
    study: PaperStudy,
    source: ModelSource,
    figure_sets: list[tuple[str, list[Picture]]],
    path: Path,
) -> None:
    """Write a self-contained HTML file: the table, then each set of figures."""
    figure_images = [(title, embed_images(pictures)) for title, pictures in figure_sets]
    counts = {verdict: sum(row.verdict == verdict for row in rows) for verdict in
              ("agrees", "agrees in kind", "departs")}  # fmt: skip
    text = render_page(
        Path(__file__).with_name("paper.html"),
        rows=rows, sets=figure_images, counts=counts, model=source, exact=study.is_exact,
        models={name: case.simulator.model.flatten() for name, case in study.cases.items()},
        paper_model=source.toml_text == read_model(PAPER_MODEL)[1],
    )  # fmt: skip
    path.write_text(text, encoding="utf-8")
