"""`shaketwin paper`: the model's side of the paper, and the rig's beside it where there is one."""

from pathlib import Path

from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from twin.service.bundle import read_model, run_id
from twin.service.folders import new_folder
from twin.service.kernels import COMPILING
from twin.service.paper.cases import cases
from twin.service.paper.page import PAPER_MODEL, Told, draw_all, write_json, write_page
from twin.service.paper.rig import Rig, measured
from twin.service.paper.rows import DEPARTS
from twin.service.paper.study import JOBS, Study, study
from twin.service.paper.table import table
from twin.service.terminal import console, said_if_long, say


def paper(out: Path | None, campaign: list[Path], model: str | None) -> None:
    """The command: a new folder, and everything in it."""
    rig = measured(campaign) if campaign else None
    card, text = read_model(model or PAPER_MODEL)
    told = Told(model or PAPER_MODEL, card, text)
    with said_if_long(COMPILING):
        cases(model)["G4"].player.at_rest()
    write_paper(new_folder(out, run_id("paper")), rig, told)


def write_paper(folder: Path, rig: Rig | None, told: Told) -> None:
    """figures/*.png, report.html and paper.json into a folder that is there."""
    say(f"model {told.name}, {told.card.title}: every test of the paper, forward and backward")
    found = _studied(told, rig)
    rows = table(found)
    sets = [("The model", draw_all(found, None, folder / "figures", say))]
    if rig is not None:
        gaps = ", ".join(rig.runs)
        sets.append((f"The rig: {gaps}", draw_all(found, rig, folder / "figures", say)))
    pictures = [one for _, several in sets for one in several]
    write_json(rows, found, told, pictures, folder / "paper.json")
    write_page(rows, found, told, sets, folder / "report.html")
    for row in rows:
        say(f"{row.case}: paper: {row.paper}; {told.name}: {row.model}")
        mark = "[bold red]" if row.verdict == DEPARTS else ""
        console.print(f"    {mark}{row.verdict}", highlight=False)
    departs = sum(row.verdict == DEPARTS for row in rows)
    say(f"{told.name}: {len(rows)} statements, {departs} depart -> {folder / 'report.html'}")


def _studied(told: Told, rig: Rig | None) -> Study:
    """The study, with a bar on a terminal: an integrated model takes a minute."""
    bar = Progress(
        TextColumn("[bold]{task.description}"), BarColumn(bar_width=40),
        TextColumn("{task.percentage:3.0f} %"), TimeRemainingColumn(),
        console=console, disable=not console.is_terminal, transient=True,
    )  # fmt: skip
    with bar:
        task = bar.add_task("sweeps", total=JOBS)
        return study(told.asked, rig.stars if rig else None, lambda: bar.advance(task))
