"""Report of branches: curves, tables and the data of the page against the branch itself."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR
from table_io.units import GRAVITY_M_S2
from twin.branches.page import make_page_data, write_branch_report
from twin.drawing.branch_curves import BranchSet, make_axis
from twin.dynamics.continuation import Branch, continue_branch, split_by_stability
from twin.dynamics.event_driven_map import make_period_map
from twin.dynamics.orbits import settle_to_orbit
from twin.dynamics.period_map import FREQUENCY, GAP, LEVEL
from twin.setup.run_config import read_run_config

LIMITS_HZ = (2.5, 4.5)
LEVEL_M_S2 = 0.05 * GRAVITY_M_S2
BAND_HZ = (2.55, 2.6)  # not real: only to see it drawn


@pytest.fixture(scope="module")
def branch() -> Branch:
    """Branch of G4 through its right hysteresis: stable, unstable, stable."""
    model = read_run_config(PROFILES_DIR / "tests" / "g4_ss3.toml").model
    start = settle_to_orbit(make_period_map(model, LIMITS_HZ[1], LEVEL_M_S2))
    assert start is not None
    return continue_branch(start, FREQUENCY, LIMITS_HZ)


@pytest.fixture(scope="module")
def folder(branch: Branch, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("branches")
    write_branch_report(folder, BranchSet((branch,), (BAND_HZ,)), "G4", "</script>", "model = 1")
    return folder


@pytest.mark.parametrize(
    ("stable", "pieces"),
    [
        ([], []),
        ([True], []),
        ([True, True, True], [(0, 2, True)]),
        ([True, True, False, False, True], [(0, 1, True), (1, 4, False)]),
        ([False, True, True], [(0, 1, False), (1, 2, True)]),
    ],
)
def test_a_segment_is_stable_if_both_of_its_ends_are(
    stable: list[bool], pieces: list[tuple[int, int, bool]]
) -> None:
    assert split_by_stability(stable) == pieces


def test_parameters_are_shown_in_the_units_of_a_laboratory() -> None:
    assert make_axis(FREQUENCY).factor == 1.0
    assert make_axis(GAP).factor == 1e3
    assert make_axis(LEVEL).factor == pytest.approx(1 / GRAVITY_M_S2)
    assert make_axis("stiffness").factor == 1.0


def test_the_table_holds_every_point_of_the_branch(branch: Branch, folder: Path) -> None:
    rows = list(csv.DictReader((folder / "branches.csv").read_text().splitlines()))
    assert [float(row["frequency"]) for row in rows] == branch.values.tolist()
    assert [float(row["u_max_m"]) for row in rows] == branch.extreme("u_max").tolist()
    assert [row["stable"] == "1" for row in rows] == branch.stable.tolist()
    unstable = [float(row["largest_multiplier_real"]) for row in rows if row["stable"] == "0"]
    assert min(unstable) >= 1


def test_the_summary_states_bifurcations_and_why_each_branch_ends(
    branch: Branch, folder: Path
) -> None:
    summary = json.loads((folder / "branches.json").read_text())
    (entry,) = summary["branches"]
    assert {end["reason"] for end in entry["ends"]} == {"range end"}
    assert sorted(end["value"] for end in entry["ends"]) == list(LIMITS_HZ)
    folds = sorted(item["value"] for item in entry["bifurcations"] if item["kind"] == "fold")
    assert folds == pytest.approx([2.787294, 4.027372], abs=1e-5)
    assert summary["chaotic"] == [list(BAND_HZ)]
    assert len(entry["points"]) == len(branch.points)


def test_the_page_shows_each_point_with_its_motion(branch: Branch, folder: Path) -> None:
    data: Any = make_page_data(BranchSet((branch,), (BAND_HZ,)))
    (shown,) = data["branches"]
    assert shown["x"] == pytest.approx(branch.values.tolist(), rel=1e-6)
    amplitude_mm = 500 * (branch.extreme("u_max") - branch.extreme("u_min"))
    assert shown["values"]["u_mm"] == pytest.approx(amplitude_mm.tolist(), rel=1e-4)
    for (u_mm, _), swing_mm in zip(shown["orbits"], 2 * amplitude_mm, strict=True):
        assert np.ptp(u_mm) == pytest.approx(swing_mm, rel=5e-3)
    assert set(map(tuple, shown["walls"])) == {(2.0, -2.0)}
    page = (folder / "report.html").read_text()
    text = page.split('<script type="application/json" id="data">')[1].split("</script>")[0]
    assert json.loads(text) == json.loads(json.dumps(data))
    assert page.count("</script>") == 2  # a title cannot end the data


def test_the_page_loads_nothing(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    assert "default-src &#39;none&#39;" in page or "default-src 'none'" in page
    assert 'src="http' not in page
    assert 'href="http' not in page
    assert sorted(path.name for path in (folder / "figures").iterdir()) == [
        "branches.png", "multipliers.png",
    ]  # fmt: skip
