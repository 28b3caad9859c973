"""`shaketwin identify` on a log: a model that a run takes, its evidence, and what it refuses."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from typer.testing import CliRunner

from table_io.config.base import format_toml
from table_io.records import RunStop
from tests.builders.rigs import RIG_TEXT, read_model_text
from tests.recovery.recordings import CHANNELS, TRUTH, card, make_noisy_blocks
from tests.reports.folders import draw_in_full_quality
from twin.cli.table import app
from twin.model.config import ModelConfig
from twin.recording.mcap_log import write_items
from twin.results.quantities import format_quantity
from twin.setup.run_config import from_texts, read_model

GAPS = (2.0, 2.0)


@cache
def recording(folder: Path) -> Path:
    """A log as a run leaves it."""
    rig = RIG_TEXT
    snm = read_model_text("snm")
    bundle = from_texts("short", format_toml(card(*GAPS)), rig, snm, "test")
    start = replace(bundle.make_start_factory("short", "table")({}, 0.0), channels=CHANNELS)
    (block,) = make_noisy_blocks(0.01, 3, GAPS)
    path = folder / "short.mcap"
    write_items(path, [start, block, RunStop(block.end, "complete", "")], start)
    return path


@pytest.fixture(scope="module")
def identification(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """(where the model lies, what the terminal said)."""
    folder = tmp_path_factory.mktemp("identify")
    out = folder / "found.toml"
    with draw_in_full_quality():
        outcome = CliRunner().invoke(app, ["identify", str(recording(folder)), "--out", str(out)])
    assert outcome.exit_code == 0, outcome.output
    return out, outcome.output


def test_identified_model_is_readable_by_run(identification: tuple[Path, str]) -> None:
    model, _ = read_model(str(identification[0]))
    assert isinstance(model, ModelConfig)
    assert model.base.stiffness_n_m == pytest.approx(TRUTH["stiffness"], rel=0.003)
    assert model.base.bumper_damping_n_s_m == pytest.approx(TRUTH["bumper_damping"], rel=0.01)
    assert model.effects == ()
    assert model.fitted_on == "short"


def test_identify_writes_evidence_and_figures(identification: tuple[Path, str]) -> None:
    folder = identification[0].with_suffix("")
    evidence = json.loads((folder / "identify.json").read_text(encoding="utf-8"))
    stiffness = evidence["parameters"]["stiffness"]
    assert stiffness["low"] < TRUTH["stiffness"] < stiffness["high"]
    assert stiffness["start"] == 36000.0
    assert stiffness["deviations"] < -10
    gap = evidence["gaps"]["short"]
    assert gap["low"] < 4e-3 < gap["high"]
    assert evidence["windows"][0]["nrmse_identified"] < 0.5 * evidence["windows"][0]["nrmse_start"]
    pictures = {path.name for path in folder.glob("*.png") if path.stat().st_size > 20_000}
    assert pictures == {"laws0.png", "correlation.png", "sources.png"}


def test_the_page_shows_each_value_with_its_interval(identification: tuple[Path, str]) -> None:
    folder = identification[0].with_suffix("")
    page = (folder / "report.html").read_text(encoding="utf-8")
    evidence = json.loads((folder / "identify.json").read_text(encoding="utf-8"))
    assert page.count("data:image/png;base64,") == 3
    for estimate in evidence["parameters"].values():
        half = 0.5 * (estimate["high"] - estimate["low"])
        assert format_quantity(estimate["value"], estimate["unit"], half) in page
        assert estimate["cycles"] > 3


def test_identify_prints_its_result(identification: tuple[Path, str]) -> None:
    for text in ("K_j", "gap of short", "free flight", "contact left", "onsets", "windows of 1 s"):
        assert text in identification[1]


@pytest.mark.parametrize(
    "more, word",
    [
        (["--out", "found.json"], "found.json"),
        (["--out", "there.toml"], "there.toml: exists"),
        (["--model", "nothing"], "nothing"),
    ],
)
def test_invalid_options_of_identify_are_refused_before_reading(
    more: list[str], word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.toml").write_text("title = 'mine'", encoding="utf-8")
    outcome = CliRunner().invoke(app, ["identify", "no.mcap", *more])
    assert outcome.exit_code != 0
    assert word in f"{outcome.output}{outcome.exception}"
    assert (tmp_path / "there.toml").read_text(encoding="utf-8") == "title = 'mine'"


def test_a_log_given_twice_is_refused(identification: tuple[Path, str], tmp_path: Path) -> None:
    log = str(recording(identification[0].parent))
    outcome = CliRunner().invoke(app, ["identify", log, log, "--out", str(tmp_path / "m.toml")])
    assert "the same log" in f"{outcome.output}{outcome.exception}"
    assert not [*tmp_path.iterdir()]
