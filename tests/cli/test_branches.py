"""`shaketwin branches`: what it writes over each kind of parameter, and what it refuses."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from table_io.units import GRAVITY_M_S2
from tests.input_errors import raises_input_error
from twin.branches.task import BranchOptions, follow_branches

OPTIONS = BranchOptions("quickstart")


def read_bifurcations(folder: Path) -> dict[str, list[float]]:
    """Return the values of the bifurcations by kind, ascending."""
    values: dict[str, list[float]] = {}
    for branch in json.loads((folder / "branches.json").read_text())["branches"]:
        for item in branch["bifurcations"]:
            values.setdefault(item["kind"], []).append(item["value"])
    return {kind: sorted(group) for kind, group in values.items()}


def test_over_the_frequency_it_finds_the_jumps_of_the_test(tmp_path: Path) -> None:
    follow_branches(replace(OPTIONS, out=tmp_path / "new"))
    bifurcations = read_bifurcations(tmp_path / "new")
    assert bifurcations["fold"] == pytest.approx([2.787294, 4.027372], abs=1e-5)
    assert bifurcations["grazing"] == pytest.approx([2.793586], abs=1e-5)
    assert {path.name for path in (tmp_path / "new").iterdir()} == {
        "branches.csv", "branches.json", "figures", "report.html",
    }  # fmt: skip


def test_over_the_gap_at_a_frequency_units_are_those_of_the_command_line(tmp_path: Path) -> None:
    options = replace(OPTIONS, over="gap", low=0.0, high=10.0, at_hz=3.4, out=tmp_path / "new")
    follow_branches(options)
    bifurcations = read_bifurcations(tmp_path / "new")
    assert bifurcations["grazing"] == pytest.approx([2.493783e-3], abs=1e-8)
    assert max(bifurcations["fold"]) == pytest.approx(7.950152e-3, abs=1e-8)


def test_another_gap_and_level_take_the_place_of_those_of_the_test(tmp_path: Path) -> None:
    """In free flight and in proportion: twice gap and level, the same frequencies."""
    options = replace(OPTIONS, gap_mm=8.0, level_g=0.1, out=tmp_path / "new")
    follow_branches(options)
    assert read_bifurcations(tmp_path / "new")["fold"] == pytest.approx(
        [2.787294, 4.027372], abs=1e-5
    )


def test_over_the_level_without_a_frequency_it_maps_the_resonance(tmp_path: Path) -> None:
    options = replace(OPTIONS, over="level", low=0.03, high=0.05, out=tmp_path / "new")
    follow_branches(options)
    rows = list(csv.DictReader((tmp_path / "new" / "peaks.csv").read_text().splitlines()))
    assert float(rows[0]["level"]) == pytest.approx(0.03 * GRAVITY_M_S2)
    peaks = [float(row["u_m"]) for row in rows]
    assert peaks == sorted(peaks)
    assert peaks[-1] == pytest.approx(6.55e-3, abs=2e-5)
    kinds = {
        row["kind"]
        for row in csv.DictReader((tmp_path / "new" / "loci.csv").read_text().splitlines())
    }
    assert kinds == {"fold", "grazing"}


@pytest.mark.parametrize(
    ("changes", "fields"),
    [
        ({"over": "gapp", "low": 0.0, "high": 1.0}, {"key": "gapp"}),
        ({"over": "gap"}, {"key": "--from, --to"}),
        ({"low": 3.0, "high": 2.0}, {"key": "--from, --to"}),
        ({"low": 0.0, "high": 2.0}, {"key": "--from, --to"}),
        ({"at_hz": 3.0}, {"key": "--at", "value": 3.0}),
        ({"over": "gap", "low": 0.0, "high": 1.0, "at_hz": -1.0}, {"key": "--at", "value": -1.0}),
        ({"level_g": 0.0}, {"key": "--level", "value": 0.0}),
        ({"level_g": float("nan")}, {"key": "--level"}),
        ({"basins_hz": 0.0}, {"key": "--basins", "value": 0.0}),
        ({"over": "gap", "low": 0.0, "high": 1.0, "attractors": True}, {"key": "--at"}),
    ],
)
def test_what_cannot_be_followed_is_refused_and_leaves_no_folder(
    tmp_path: Path, changes: dict[str, object], fields: dict[str, object]
) -> None:
    options = replace(OPTIONS, out=tmp_path / "new", **changes)  # type: ignore[arg-type]
    with raises_input_error(**fields):
        follow_branches(options)
    assert not (tmp_path / "new").exists()
