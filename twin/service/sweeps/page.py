"""The page of a batch, from its table and its summary alone."""

import base64
import json
import math
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from table_io.card import BadInput
from twin.service.report import significant
from twin.service.summary import Json
from twin.service.sweeps import TABLE
from twin.service.sweeps.cases import gap_name
from twin.service.sweeps.rows import read_rows


def write_page(folder: Path) -> Path:
    """Path of folder/report.html, written anew with its figures."""
    from twin.service.sweeps.figures import draw_all

    summary = _summary(folder / "summary.json")
    pictures = draw_all(read_rows(folder / TABLE), summary, folder / "figures")
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters["sig"] = significant
    environment.filters["gap"] = lambda gap: gap_name(math.inf if gap == "inf" else gap)
    images = [(one, base64.b64encode(one.path.read_bytes()).decode()) for one in pictures]
    page = folder / "report.html"
    text = environment.get_template("batch.html").render(summary=summary, images=images)
    page.write_text(text, encoding="utf-8")
    return page


def _summary(path: Path) -> Json:
    """The summary of a batch; BadInput where it is missing or something else."""
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        _ = summary["cases"], summary["models"], summary["run"]["title"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BadInput(
            f"{path}: not the summary of a batch: {error!r}; give the folder that simulate wrote"
        ) from None
    return dict(summary)
