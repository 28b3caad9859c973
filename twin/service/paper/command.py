"""`shaketwin paper`: the model's side of the paper, and the rig's beside it where there is one."""

from pathlib import Path

from rich.console import Console

from twin.service.bundle import run_id
from twin.service.folders import new_folder
from twin.service.paper.page import draw_all, write_json, write_page
from twin.service.paper.rig import Rig, measured
from twin.service.paper.study import study
from twin.service.paper.table import DEPARTS, table
from twin.service.terminal import console


def paper(out: Path | None, campaign: list[Path]) -> None:
    """The command: a new folder, and everything in it."""
    rig = measured(campaign) if campaign else None
    folder = new_folder(out, run_id("paper"))
    write_paper(folder, rig, console)


def write_paper(folder: Path, rig: Rig | None, console: Console) -> None:
    """figures/*.png, report.html and paper.json into a folder that is there."""

    def say(text: str) -> None:
        console.print(text, highlight=False, soft_wrap=True)

    say("the model on every test of the paper, forward and backward")
    found = study()
    rows = table(found)
    sets = [("The model", draw_all(found, None, folder / "figures", say))]
    if rig is not None:
        gaps = ", ".join(rig.runs)
        sets.append((f"The rig: {gaps}", draw_all(found, rig, folder / "figures", say)))
    pictures = [one for _, several in sets for one in several]
    write_json(rows, found, pictures, folder / "paper.json")
    models = {name: case.parameters.as_dict() for name, case in found.cases.items()}
    write_page(rows, sets, models, folder / "report.html")
    for row in rows:
        mark = "[bold red]" if row.verdict == DEPARTS else ""
        console.print(f"{row.case}: paper: {row.paper}; model: {row.model}", highlight=False)
        console.print(f"    {mark}{row.verdict}", highlight=False)
    departs = sum(row.verdict == DEPARTS for row in rows)
    say(f"{len(rows)} statements, {departs} depart -> {folder / 'report.html'}")
