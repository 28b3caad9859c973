"""Pictures, page and paper.json of the whole paper in one folder."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl

from twin.model.card import ModelCard
from twin.service.bundle import read_model
from twin.service.figures import Picture
from twin.service.page import inside, page
from twin.service.paper import against, extra, families, loops, secondary
from twin.service.paper.look import PAPER_STYLE, Drawing
from twin.service.paper.rig import Rig
from twin.service.paper.rows import Row
from twin.service.paper.study import Study
from twin.service.summary import dumps

PAPER_MODEL = "snm"
ORDER = ("2", "3", "5", "6", "7", "8", "9", "11", "12", "")
Progress = Callable[[str], None]


def draw_all(found: Study, rig: Rig | None, folder: Path, say: Progress) -> list[Picture]:
    """The paper's pictures of the model, or those that a rig's points add, in the paper's order."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(PAPER_STYLE):
        drawings: list[Drawing] = []
        for room in (families, loops, secondary, against, extra):
            drawings += room.draw(found, rig)
        drawings.sort(key=lambda one: ORDER.index(one.number))
        pictures = []
        for one in drawings:
            path = folder / f"{one.name}.png"
            one.figure.savefig(path)
            say(f"{path}")
            title = f"Figure {one.number}. {one.title}" if one.number else one.title
            pictures.append(Picture(path, title, one.caption))
    return pictures


@dataclass(frozen=True, slots=True)
class Told:
    """The model as a person named it, its card and the text of that."""

    asked: str
    card: ModelCard
    text: str

    @property
    def name(self) -> str:
        return Path(self.asked).stem if self.asked.endswith(".toml") else self.asked


def write_json(
    rows: list[Row], found: Study, model: Told, pictures: list[Picture], path: Path
) -> None:
    """The table, the PRC points and the impacts as strict JSON."""
    told: dict[str, Any] = {
        "model": {"name": model.name, "title": model.card.title, "toml": model.text},
        "table": [asdict(row) for row in rows],
        "prc": {
            name: [
                {"frequency_hz": one.frequency_hz, "direction": one.direction}
                | (asdict(one.twin) if one.twin else {})
                for one in case.points
            ]
            for name, case in found.cases.items()
        },
        "impacts": {
            f"{hz:g}": {f"{r}/{l_}": share for (r, l_), share in seen.shares}
            for hz, seen in found.impacts.items()
        },
        "figures": [f"figures/{one.path.name}" for one in pictures],
    }
    path.write_text(dumps(told) + "\n", encoding="utf-8")


def write_page(
    rows: list[Row], found: Study, told: Told, sets: list[tuple[str, list[Picture]]], path: Path
) -> None:
    """One self-contained HTML file: the table, then each set of pictures."""
    images = [(title, inside(pictures)) for title, pictures in sets]
    counts = {verdict: sum(row.verdict == verdict for row in rows) for verdict in
              ("agrees", "agrees in kind", "departs")}  # fmt: skip
    text = page(
        Path(__file__).with_name("paper.html"),
        rows=rows, sets=images, counts=counts, told=told, exact=found.exact,
        models={name: case.player.model.flat() for name, case in found.cases.items()},
        paper_model=told.text == read_model(PAPER_MODEL)[1],
    )  # fmt: skip
    path.write_text(text, encoding="utf-8")
