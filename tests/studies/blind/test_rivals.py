"""Rivals on the same readings: what they name, how far down they come, and the table of it."""

from typing import Any

import numpy as np
import pytest

from tests.discovery.played import SNM, format_truth, log
from tests.studies.blind import rivals
from tests.studies.blind.page import format_rival_table
from tests.studies.blind.rivals import make_regression_problem
from tests.studies.blind.scoring import score_verdict
from tests.studies.blind.test_scoring import about, verdict


def test_without_the_packages_the_study_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rivals, "find_spec", lambda package: None)
    assert rivals.find_rivals() == {}
    assert "not installed: pysindy, pyoperon, sklearn; pip install" in rivals.describe_missing()
    monkeypatch.setattr(rivals, "find_spec", lambda package: True)
    assert set(rivals.find_rivals()) == {"pysindy", "pyoperon", "blackbox"}
    assert rivals.describe_missing() == ""


def test_where_nothing_is_hidden_the_base_makes_the_forces() -> None:
    """Rows, noise and states are those of discovery: with the true base, noise is left."""
    bench = make_regression_problem(log(), SNM)
    left = []
    for regression in bench.regressions:
        fitted = np.linalg.lstsq(regression.base, regression.force, rcond=None)[0]
        left.append(regression.force - regression.base @ fitted)
    gap = bench.gap(left)
    # plain least squares also fits some of the noise in its slopes
    assert gap["held_out_after"] == pytest.approx(gap["held_out_before"], rel=0.02)
    assert gap["held_out_after"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize(
    "effect, values",
    [
        ("cubic_stiffness", {"k3": 1e9}),
        ("gap_drift", {"rate": 3e-5}),
        ("bumper_asymmetry", {"ratio": 1.2}),
    ],
)
def test_sparse_regression_names_what_the_state_makes(effect: str, values: Any) -> None:
    pytest.importorskip("pysindy", exc_type=ImportError)
    fitted = rivals.select_terms(make_regression_problem(log(format_truth(effect, **values)), SNM))
    assert fitted["effects"][0]["id"] == effect
    assert fitted["gap"]["held_out_after"] < 0.7 * fitted["gap"]["held_out_before"]


def test_boosted_trees_close_a_gap_that_has_no_name() -> None:
    pytest.importorskip("sklearn", exc_type=ImportError)
    truth = format_truth("cubic_stiffness", k3=1e9)
    fitted = rivals.fit_boosted_trees(make_regression_problem(log(truth), SNM))
    assert fitted["effects"] == []
    assert fitted["gap"]["held_out_after"] < 0.7 * fitted["gap"]["held_out_before"]


def test_the_table_lays_them_side_by_side() -> None:
    true = {"name": "table_tilt", "parameters": {}, "vanishing": {}}
    case = about("single", true)
    rows = [
        score_verdict(verdict("named", "table_tilt"), case) | {"held_out": 1.01, "rivals": {
            "pysindy": score_verdict(verdict("named", "mass_error"), case) | {"held_out": 1.5},
            "blackbox": score_verdict(verdict("unexplained"), case) | {"held_out": 2.25},
        }},
        score_verdict(verdict("none"), about("none")) | {"held_out": 1.0},
    ]  # fmt: skip
    lines = list(format_rival_table(rows))
    assert "| table_tilt | 1/1 | 0/1 | 1.010 | 1.500 | 2.250 |" in lines
    assert not any("(nothing)" in line for line in lines), "no rival saw that case"
    assert list(format_rival_table(rows[1:])) == []
