"""Folders of runs for the report, as the recorder and the summary leave them."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import pytest

from tests.reports.recordings import blocks, start_record, summary
from twin.drawing import panels, pictures
from twin.recording.mcap_log import write_items
from twin.report import figures
from twin.report.report import load_report_data, render_report
from twin.transport.codec import Item

Maker = Callable[..., Path]


@dataclass(frozen=True, slots=True)
class Drawn:
    """A whole run, the pictures of its figures and its page, as a user gets them."""

    folder: Path
    pictures: list[panels.Picture]
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
    with draw_in_full_quality():
        drawn = list(figures.draw_figures(run))
        return Drawn(
            folder, pictures.save_figures(drawn, folder / "figures"), render_report(run, drawn)
        )


@contextmanager
def draw_in_full_quality() -> Iterator[None]:
    """Draw as users see it, which `tests/draft` prevents for the sake of time."""
    full = vars(pictures).get("FULL_RC_PARAMS", pictures.RC_PARAMS)
    with patch.dict(pictures.RC_PARAMS, dict(full), clear=True):
        yield


@pytest.fixture
def full_quality() -> Iterator[None]:
    """Pictures as users see them, in this process."""
    with draw_in_full_quality():
        yield
