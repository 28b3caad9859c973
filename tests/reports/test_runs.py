"""Index of runs, the name `last`, and the comparison of two runs."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.command_line import call_main
from tests.input_errors import raises_input_error
from tests.reports.folders import make
from tests.reports.recordings import summary
from twin.archive.page import write_run_index
from twin.archive.query import index_runs
from twin.options import parse_run_path
from twin.report.compare_command import _load_run
from twin.report.run_comparison import compare_summaries
from twin.report.run_index import find_last_run, find_run_folders

MODEL = 'title = "m"\n[base]\nstiffness_n_m = {}\n'


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs, the second after a repair, and one of a campaign without a summary."""
    root = tmp_path_factory.mktemp("runs")
    for number, folder in enumerate(("before", "runs/after", "runs/campaign/g4")):
        run_folder = root / folder
        run_folder.mkdir(parents=True)
        make(run_folder, items=[], run_summary=make_summary(number))
        os.utime(run_folder / "run.mcap", (1.75e9 + number, 1.75e9 + number))
    (root / "runs/campaign/g4/summary.json").unlink()
    return root


def make_summary(number: int) -> dict[str, Any]:
    """Summary of a run; of the second the stiffness is higher and a jump is gone."""
    values = summary()
    estimate = {"value": 36e3 + 2e3 * number, "sd": 100.0, "drift": None, "drift_sd": None}
    return values | {
        "jumps": [] if number else values["jumps"],
        "estimates": {"stiffness": estimate, "damping": estimate | {"value": 1100.0}},
        "warnings": [{"at_s": 1.0, "kind": "drift", "text": ""}] * number,
        "run": values["run"] | {"started_at": f"2025-01-0{1 + number}T10:00:00", "gap_m": 0.004},
        "twin_verdict": {
            "verdict": "departs" if number else "agrees",
            "misfit": 1.0 + number,
            "reason": "",
            "tolerance": "",
            "worst": None,
            "steps_outside": 0,
            "steps_judged": 8,
            "missing_jumps": [],
            "unexpected_jumps": [],
            "warnings": 0,
            "next_command": "",
        },
    }


@pytest.fixture
def in_root(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(root)


def test_runs_are_listed_newest_first_with_what_their_summary_states(root: Path) -> None:
    rows = index_runs(root)
    assert [row.folder for row in rows] == ["runs/after", "before", "runs/campaign/g4"]
    after, before, last = rows
    assert (last.verdict, last.twin_verdict, last.nrmse) == (None, None, None)
    assert (before.verdict, before.twin_verdict, before.misfit) == ("complete", "agrees", 1.0)
    assert (after.twin_verdict, after.warnings, after.gap_m) == ("departs", 1, 0.004)
    assert before.nrmse == 0.0512


def test_hidden_folders_hold_no_runs(root: Path, tmp_path: Path) -> None:
    (tmp_path / ".trash").mkdir()
    (tmp_path / ".trash" / "run.mcap").touch()
    assert find_run_folders(tmp_path) == []


@pytest.mark.usefixtures("in_root")
def test_last_is_the_newest_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert parse_run_path("last") == Path("runs/after")
    assert parse_run_path("before") == Path("before")
    monkeypatch.chdir(tmp_path)
    with raises_input_error(key="last", where=tmp_path):
        parse_run_path("last")
    Path("last").mkdir()
    assert parse_run_path("last") == Path("last")


def test_the_start_of_a_run_orders_it_not_the_date_of_a_copy(tmp_path: Path) -> None:
    for number, folder in enumerate(("older", "newer")):
        (tmp_path / folder).mkdir()
        make(tmp_path / folder, items=[], run_summary=make_summary(number))
        os.utime(tmp_path / folder / "run.mcap", (2e9 - number, 2e9 - number))
    assert [path.name for path in find_run_folders(tmp_path)] == ["newer", "older"]


@pytest.mark.parametrize("start", ["0001-01-01T00:00:00", "yesterday", 5, None])
def test_a_summary_without_a_date_hides_no_run(tmp_path: Path, start: object) -> None:
    values = make_summary(0)
    values["run"]["started_at"] = start
    make(tmp_path, items=[], run_summary=values)
    assert find_run_folders(tmp_path) == [tmp_path]


def test_the_last_measured_run_is_no_simulation(tmp_path: Path) -> None:
    for number, source in enumerate(("table", "model")):
        (tmp_path / source).mkdir()
        values = make_summary(number)
        values["run"]["source"] = source
        make(tmp_path / source, items=[], run_summary=values)
    assert find_last_run(tmp_path).name == "model"
    assert find_last_run(tmp_path, measured=True).name == "table"


def test_last_works_on_the_command_line(root: Path) -> None:
    result = call_main("verify", "last", "--json", cwd=root)
    assert json.loads(result.stdout)["log"] == ["runs/after/run.mcap"]


def test_the_command_prints_json_and_writes_an_index(root: Path, tmp_path: Path) -> None:
    page = tmp_path / "index.html"
    result = call_main("runs", root, "--json", "--page", page)
    assert [row["folder"] for row in json.loads(result.stdout)["runs"]][-2] == "before"
    assert page.read_text().count("<tr data-row=") == 3
    assert call_main("runs", root, "--page", page).returncode == 0, "an index is replaced"


def test_only_an_index_is_replaced(root: Path, tmp_path: Path) -> None:
    page = tmp_path / "index.html"
    page.write_text("mine")
    with raises_input_error(key="--page", value=str(page)):
        write_run_index(index_runs(root), page, root)
    assert page.read_text() == "mine"


@pytest.fixture(scope="module")
def comparable(tmp_path_factory: pytest.TempPathFactory, log_file: Path) -> list[Path]:
    """The same recording with two summaries, as of two runs."""
    folders = []
    for number in (0, 1):
        folder = tmp_path_factory.mktemp(f"compared{number}")
        (folder / "run.mcap").write_bytes(log_file.read_bytes())
        (folder / "summary.json").write_text(json.dumps(make_summary(number)))
        folders.append(folder)
    return folders


def test_two_runs_are_compared(comparable: list[Path]) -> None:
    result = call_main("compare", *comparable, "--json")
    comparison = json.loads(result.stdout)
    stiffness, damping = comparison["estimates"]
    assert (stiffness["change"], stiffness["changed"], stiffness["unit"]) == (2e3, True, "N/m")
    assert stiffness["sigma"] == pytest.approx(2e3 / (100 * 2**0.5))
    assert (damping["change"], damping["changed"]) == (0.0, False)
    assert comparison["jumps"]["measured"] == [
        {"direction": "forward", "kind": "down", "between_hz": [[2.0, 2.5], None],
         "shift_hz": None}
    ]  # fmt: skip
    assert len(comparison["steps"]) == 8
    assert comparison["misfit"]["rel_disp_m"]["nrmse"] == [0.0512, 0.0512]
    assert [run["twin_verdict"] for run in comparison["runs"]] == ["agrees", "departs"]
    assert {row["name"] for row in comparison["model"]} >= {"stiffness", "gap_r"}


def test_estimates_beside_two_models_have_no_standard_deviations(comparable: list[Path]) -> None:
    runs = [_load_run(path) for path in comparable]
    other = replace(runs[1], parameters={**runs[1].parameters, "coulomb_friction.fc": 50.0})
    stiffness, _ = compare_summaries(runs[0], other).estimates
    assert (stiffness.change, stiffness.sigma, stiffness.changed) == (2e3, None, False)


def test_the_comparison_has_a_page_and_its_data(comparable: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "compared"
    assert call_main("compare", *comparable, "--out", out).returncode == 0
    page = (out / "compare.html").read_text()
    assert page.count('<figure id="prc">') == 1
    assert "38.00 ± 0.20 kN/m" in page
    assert (
        json.loads((out / "comparison.json").read_text())["runs"][1]["misfit"]
        == "2 times the noise"
    )
    assert call_main("compare", *comparable, "--out", out).returncode == 2, "nothing overwritten"
