"""`shaketwin paper`: compare a model, and optionally a measured campaign, with the paper."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from twin.drawing.page import embed_images, write_page
from twin.drawing.panels import CaptionedFigures, Picture
from twin.drawing.pictures import save_figures
from twin.drawing.prc_families import draw_all_gaps, draw_transition
from twin.model.config import ModelConfig
from twin.paper.force_loops import draw_paper_loop_figures
from twin.paper.frequency_figures import draw_chaos_figure, draw_frequency_figures
from twin.paper.secondary_resonances import draw_secondary_resonance_figure
from twin.paper.study import JOB_COUNT, PaperStudy, run_paper_study
from twin.paper.table import DEPARTS, VERDICTS, ComparisonRow, count_causes, make_comparison_table
from twin.results.contract import format_json
from twin.results.measured_campaign import MeasuredCampaign, load_measured_campaign
from twin.results.paper_cases import load_paper_cases
from twin.setup.folders import make_output_folder
from twin.setup.run_config import make_run_id, read_model
from twin.setup.warm_up import COMPILING_MESSAGE
from twin.system.progress import make_task_bar
from twin.system.terminal import announce_if_slow, console, print_line

PAPER_MODEL = "snm"
FIGURE_ORDER = ("2", "3", "5", "6", "7", "8", "9", "11", "12", "")
ProgressReporter = Callable[[str], None]


def draw_paper_figures(
    study: PaperStudy, campaign: MeasuredCampaign | None, folder: Path, report: ProgressReporter
) -> list[Picture]:
    """Draw the figures in the paper's order: of the model, or with the points of a campaign."""
    pictures = save_figures(_draw_in_order(study, campaign), folder)
    for picture in pictures:
        report(f"{picture.path}")
    return pictures


def _draw_in_order(study: PaperStudy, campaign: MeasuredCampaign | None) -> CaptionedFigures:
    figures = [
        figure
        for draw in (
            _draw_prc_families,
            draw_paper_loop_figures,
            draw_secondary_resonance_figure,
            draw_frequency_figures,
            draw_chaos_figure,
        )
        for figure in draw(study, campaign)
    ]
    for figure in sorted(figures, key=lambda figure: FIGURE_ORDER.index(figure.number)):
        prefix = f"Figure {figure.number}. " if figure.number else ""
        yield replace(figure, title=f"{prefix}{figure.title}")


def _draw_prc_families(study: PaperStudy, campaign: MeasuredCampaign | None) -> CaptionedFigures:
    """Draw Figs. 2 and 5; with a campaign, its measured points on the model's curves."""
    yield draw_all_gaps(study.cases, campaign)
    yield draw_transition(study.cases, campaign)


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
    """Write the table, PRC points, exponents, hystereses and impact distributions as JSON."""
    document: dict[str, Any] = {
        "model": {"name": source.name, "title": source.config.title, "toml": source.toml_text},
        "table": [asdict(row) | {"paper": row.paper} for row in rows],
        "departures": count_causes(rows),
        "prc": {
            name: [
                {"frequency_hz": point.frequency_hz, "direction": point.direction}
                | (asdict(point.twin) if point.twin else {})
                for point in case.points
            ]
            for name, case in study.cases.items()
        },
        "lyapunov": {f"{hz:g}": asdict(measure) for hz, measure in study.chaos.items()},
        "secondary_hysteresis": {
            name: [asdict(interval) for interval in scan.intervals]
            for name, scan in study.secondary.items()
        },
        "impacts": {
            f"{hz:g}": {f"{r}/{l_}": share for (r, l_), share in distribution.shares}
            for hz, distribution in study.impacts.items()
        },
        "figures": [f"figures/{picture.path.name}" for picture in pictures],
    }
    path.write_text(format_json(document) + "\n", encoding="utf-8")


def write_paper_page(
    rows: list[ComparisonRow],
    study: PaperStudy,
    source: ModelSource,
    figure_sets: list[tuple[str, list[Picture]]],
    folder: Path,
) -> Path:
    """Write report.html, self-contained: the table, then each set of figures; return its path."""
    figure_images = [(title, embed_images(pictures)) for title, pictures in figure_sets]
    counts = {verdict: sum(row.verdict == verdict for row in rows) for verdict in VERDICTS}
    return write_page(
        folder,
        Path(__file__).with_name("paper.html"),
        rows=rows,
        sets=figure_images,
        counts=counts,
        causes=count_causes(rows),
        model=source,
        exact=study.is_exact,
        models={name: case.simulator.model.flatten() for name, case in study.cases.items()},
        paper_model=source.toml_text == read_model(PAPER_MODEL)[1],
    )


def compare_with_paper(out: Path | None, campaign_paths: list[Path], model: str | None) -> None:
    """Run the paper study and write its results into a new folder."""
    campaign = load_measured_campaign(campaign_paths) if campaign_paths else None
    config, toml_text = read_model(model or PAPER_MODEL, option="--model")
    source = ModelSource(model or PAPER_MODEL, config, toml_text)
    with announce_if_slow(COMPILING_MESSAGE):
        load_paper_cases(model)["G4"].simulator.bumper_preload()
    write_comparison(make_output_folder(out, make_run_id("paper")), campaign, source)


def write_comparison(folder: Path, campaign: MeasuredCampaign | None, source: ModelSource) -> None:
    """Write figures/*.png, report.html and paper.json into an existing folder."""
    print_line(
        f"model {source.name}, {source.config.title}: every test of the paper, forward and backward"
    )
    with make_task_bar() as bar:
        task = bar.add_task("sweeps", total=JOB_COUNT)
        scale = campaign.scale if campaign else None
        study = run_paper_study(source.reference, scale, lambda: bar.advance(task))
    rows = make_comparison_table(study)
    figure_sets = [("The model", draw_paper_figures(study, None, folder / "figures", print_line))]
    if campaign is not None:
        gaps = ", ".join(campaign.runs)
        figure_sets.append(
            (
                f"The rig: {gaps}",
                draw_paper_figures(study, campaign, folder / "figures", print_line),
            )
        )
    images = [picture for _, pictures in figure_sets for picture in pictures]
    write_paper_json(rows, study, source, images, folder / "paper.json")
    page = write_paper_page(rows, study, source, figure_sets, folder)
    for row in rows:
        print_line(f"{row.case}: paper: {row.paper}; {source.name}: {row.model}")
        style = "bold red" if row.verdict == DEPARTS else ""
        console.print(f"    {row.verdict}", style=style, highlight=False)
    causes = count_causes(rows)
    for cause, count in causes.items():
        print_line(f"departs in {count}: {cause}")
    print_line(
        f"{source.name}: {len(rows)} statements, {sum(causes.values())} depart for {len(causes)} "
        f"causes -> {page}"
    )
