"""Folders of runs for the report, as the recorder and the summary leave them."""

import json
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from tests.reports.recordings import blocks, start_record, summary
from twin.drawing import plot_style
from twin.recording.mcap_log import write_items
from twin.report import figures
from twin.report.report import load_report_data, render_report
from twin.transport.codec import Item

Maker = Callable[..., Path]
COARSE = {"savefig.dpi": 30, "figure.constrained_layout.use": False, "axes.grid": False}
BARE = dict.fromkeys(("xtick.bottom", "ytick.left", "xtick.labelbottom", "ytick.labelleft"), False)
# Makes pictures coarse in a process that draws; one that does not draw imports nothing for it.
DRAFT_SITE = f"""
import importlib.util, sys

class DraftFinder:
    def find_spec(self, name, path=None, target=None):
        if name != "twin.drawing.plot_style":
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        execute = spec.loader.exec_module
        def execute_as_draft(module):
            execute(module)
            module.RC_PARAMS.update({COARSE | BARE})
        spec.loader.exec_module = execute_as_draft
        return spec

sys.meta_path.insert(0, DraftFinder())
"""


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
    run = load_report_data(folder)
    pictures = figures.draw_run_figures(run, folder / "figures")
    return Drawn(folder, pictures, render_report(run, pictures))


@pytest.fixture(scope="session")
def draft_path(tmp_path_factory: pytest.TempPathFactory) -> str:
    """PYTHONPATH with which a process draws as `draft` does."""
    folder = tmp_path_factory.mktemp("draft")
    (folder / "sitecustomize.py").write_text(DRAFT_SITE)
    return os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH"))))


@pytest.fixture(scope="module")
def drafts(draft_path: str) -> Iterator[None]:
    """As `draft`, in all of a module and in the processes that it starts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plot_style, "RC_PARAMS", {**plot_style.RC_PARAMS, **COARSE, **BARE})
        patch.setenv("PYTHONPATH", draft_path)
        yield


@pytest.fixture
def draft(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every line of every picture, but coarse and without ticks: in a third of the time."""
    monkeypatch.setattr(plot_style, "RC_PARAMS", {**plot_style.RC_PARAMS, **COARSE, **BARE})
