"""Study of decisive runs: what is counted as decided, and the stated against the seen rate."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from table_io.config.base import PROFILES_DIR
from tests.studies.blind.cases import draw_case, list_case_numbers
from tests.studies.blind.decide_study import evaluate_decision, format_rates
from tests.studies.blind.plant import record_test
from tests.studies.blind.rig import PROFILE_TOML
from twin.discovery.discover import discover_effects
from twin.discovery.loading import load_logs
from twin.discovery.parameters import STIFFNESS, EffectKey
from twin.setup.run_config import read_model_template

Json = dict[str, Any]


def score(outcome: str, right: bool, decided: bool, confidence: float = 0.9) -> Json:
    return {"outcome": outcome, "right": right, "decided": decided, "confidence": confidence}


def find_row(text: str, name: str) -> str:
    return next(line for line in text.splitlines() if line.startswith(f"| {name} |"))


def test_an_open_verdict_counts_as_decided_only_if_the_next_is_right() -> None:
    first = score("none", False, False, 0.5)
    proposal = {"probability": 0.95}
    rows: list[Json] = [
        {"first": score("named", True, True)},
        {
            "first": first, "proposal": proposal, "random_probability": 0.1,
            "proposed": score("named", True, True), "random": score("none", False, False, 0.5),
        },
        {
            "first": first, "proposal": proposal, "random_probability": 0.2,
            "proposed": score("named", False, True), "random": score("named", True, True),
        },
        {"first": first, "proposal": None},
    ]  # fmt: skip
    text = format_rates(rows)
    assert "(2/3;" in find_row(text, "undecided before, decided after proposed")
    assert "(1/3;" in find_row(text, "undecided before, decided and right after proposed")
    assert "(1/3;" in find_row(text, "undecided before, decided and right after random")
    assert "(1/1;" in find_row(text, "decided by the first recording, of these right")
    assert "| 0.9 to 1 | 0.95 | 50.0 % (1/2;" in text
    assert "| 0 to 0.5 | 0.15 | 50.0 % (1/2;" in text


@pytest.mark.slow  # 20 s
def test_a_case_in_which_a_study_was_interrupted_is_begun_anew(tmp_path: Path) -> None:
    (number,) = list_case_numbers(1, ["single/coulomb_friction/10/1%"])
    folder = tmp_path / "cases" / draw_case(number).label
    folder.mkdir(parents=True)
    for name in ("first.mcap", "proposed.mcap"):
        (folder / name).write_bytes(b"the beginning of a recording")
    row = evaluate_decision(tmp_path, "sweep", number)
    assert row["first"]["named"] == ["coulomb_friction"]
    assert {path.name for path in folder.glob("*.mcap")} == {"first.mcap"}


@pytest.mark.slow
def test_the_hysteresis_of_the_paper_like_rig_is_named_within_its_intervals(tmp_path: Path) -> None:
    """Its form is another one than the library's: the intervals hold that error, too."""
    text = (PROFILES_DIR / "rigs" / "paper_like.toml").read_text()
    log = tmp_path / "first.mcap"
    profile = PROFILE_TOML.replace('rig = "simulated"', 'rig = "paper_like"')
    assert record_test(text, "first", log, True, profile).verdict == "complete"
    verdict = discover_effects(load_logs([log])[0], read_model_template("snm")[0]).verdict
    assert verdict.outcome == "named"
    assert verdict.best.names == ("bouc_wen",)
    assert verdict.form_errors
    hidden = tomllib.loads(text)["simulated"]["hidden"]
    true = {
        EffectKey("bouc_wen", name, ""): value
        for name, value in hidden["effects"][0]["parameters"].items()
    } | {STIFFNESS: hidden["base"]["damper_stiffness_n_m"]}
    fit = verdict.best.fit
    for key, value in true.items():
        assert fit.values[key] == pytest.approx(value, abs=1.96 * fit.std_errors[key])
        assert fit.std_errors[key] < 0.05 * value
