"""`shaketwin paper`: compare a model, and optionally a measured campaign, with the paper."""

from pathlib import Path

from twin.paper.page import (
    PAPER_MODEL,
    ModelSource,
    draw_paper_figures,
    write_paper_json,
    write_paper_page,
)
from twin.paper.study import JOB_COUNT, run_paper_study
from twin.paper.table import DEPARTS, count_causes, make_comparison_table
from twin.results.measured_campaign import MeasuredCampaign, load_measured_campaign
from twin.results.paper_cases import load_paper_cases
from twin.setup.folders import make_output_folder
from twin.setup.run_config import make_run_id, read_model
from twin.setup.warm_up import COMPILING_MESSAGE
from twin.system.progress import make_task_bar
from twin.system.terminal import announce_if_slow, console, print_line


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
