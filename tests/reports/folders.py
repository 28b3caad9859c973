"""Folders of runs for the report, as the recorder and the summary leave them."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.reports.recordings import blocks, start_record, summary
from twin.recording.mcap_log import write_items
from twin.recording.reader import read_recording
from twin.reports import figures, plot_style
from twin.reports.report import render_report
from twin.reports.report_data import build_report_data
from twin.transport.codec import Item

Maker = Callable[..., Path]
COARSE = {"savefig.dpi": 30, "figure.constrained_layout.use": False, "axes.grid": False}
BARE = dict.fromkeys(("xtick.bottom", "ytick.left", "xtick.labelbottom", "ytick.labelleft"), False)


@dataclass(frozen=True, slots=True)
class Drawn:
    """A whole run, its pictures and its page, as a user gets them."""

    folder: Path
    pictures: list[plot_style.Picture]
    html: str


def make(
    folder: Path, items: list[Item] | None = None, run_summary: Any = None, gap: str = "4.0"
) -> Path:
    """The folder, with run.mcap and summary.json written into it."""
    start = start_record(gap)
    write_items(folder / "run.mcap", [start, *(blocks() if items is None else items)], start)
    (folder / "summary.json").write_text(
        json.dumps(summary() if run_summary is None else run_summary)
    )
    return folder


@pytest.fixture
def run_folder(tmp_path: Path) -> Maker:
    """Writes run.mcap and summary.json; returns their folder."""
    return lambda *args, **kwargs: make(tmp_path, *args, **kwargs)


@pytest.fixture(scope="session")
def drawn_report(tmp_path_factory: pytest.TempPathFactory) -> Drawn:
    """Drawn once, in full quality; to look at, not to write into."""
    folder = make(tmp_path_factory.mktemp("drawn"))
    run = build_report_data(read_recording(folder / "run.mcap"), summary())
    pictures = figures.draw_run_figures(run, folder / "figures")
    return Drawn(folder, pictures, render_report(run, pictures))


@pytest.fixture
def draft(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line of every picture, but coarse and without ticks: in a third of the time."""
    monkeypatch.setattr(plot_style, "RC_PARAMS", {**plot_style.RC_PARAMS, **COARSE, **BARE})
