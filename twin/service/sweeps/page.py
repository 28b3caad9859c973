"""The page of a batch, from its table and its summary alone."""

import json
import math
from pathlib import Path

from table_io.card import BadInput
from twin.service.page import inside, page
from twin.service.summary import Json
from twin.service.sweeps import TABLE
from twin.service.sweeps.cases import gap_name
from twin.service.sweeps.rows import read_rows


def write_page(folder: Path) -> Path:
    """Path of folder/report.html, written anew with its figures."""
    from twin.service.sweeps.figures import draw_all

    summary = _summary(folder / "summary.json")
    pictures = draw_all(read_rows(folder / TABLE), summary, folder / "figures")
    path = folder / "report.html"
    text = page(
        Path(__file__).with_name("batch.html"),
        summary=summary,
        images=inside(pictures),
        gap=lambda gap: gap_name(math.inf if gap == "inf" else gap),
    )
    path.write_text(text, encoding="utf-8")
    return path


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
