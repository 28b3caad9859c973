"""A study as it runs, bad input, verdicts that fail, and controls that must fail."""

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.errors import InputError
from tests.discovery.played import SNM, format_truth, log
from tests.input_errors import raises_input_error
from tests.studies.blind import discovery_study
from tests.studies.blind.cases import draw_case
from tests.studies.blind.discovery_study import (
    discover_without,
    format_row,
    reverse_log,
    run_discovery_study,
    summarize_verdict,
)
from tests.studies.blind.harness import RESULTS_FILE, Study, StudyOptions, read_rows, run_study
from tests.studies.blind.page import (
    CONTROLS_FILE,
    TABLE_FILE,
    compute_shuffled_rates,
    write_study_pages,
)
from tests.studies.blind.plant import CasePaths
from tests.studies.blind.scoring import score_verdict
from tests.studies.blind.test_scoring import OTHER, TRUE, about, verdict
from twin.system.process_pool import Workers

Json = dict[str, Any]


def judge_clean(number: int) -> Json:
    """The row of a clean case, by the process that judged it."""
    case = about("none", number=number, cell="none/1%", size=0.0)
    return score_verdict({"verdict": "none"}, case) | {"process": os.getpid()}


STUDY = Study(judge_clean, format_row, write_study_pages)


def test_a_study_goes_on_after_a_line_that_was_cut(tmp_path: Path) -> None:
    """Done ones are not done again, failed and cut ones are; nothing that was found is lost."""
    rows = [judge_clean(0), judge_clean(2) | {"failed": "why"}]
    text = "".join(json.dumps(row) + "\n" for row in rows) + '{"number": 4, "ri'
    (tmp_path / RESULTS_FILE).write_text(text)
    assert run_study(STUDY, tmp_path, [0, 2, 4], Workers(1)) == 0
    after = read_rows(tmp_path / RESULTS_FILE)
    assert [row["number"] for row in after] == [0, 2, 2, 4]
    assert after[0]["process"] == rows[0]["process"]
    assert "failed" not in after[2]
    assert (tmp_path / RESULTS_FILE).read_text().startswith(text)


def test_a_verdict_that_fails_is_a_miss_that_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = draw_case(3000)
    places = CasePaths(tmp_path, case.label)
    for folder in (places.case_dir, places.sealed_dir):
        folder.mkdir(parents=True)
    places.about.write_text(json.dumps(about("single", TRUE, number=3000)))

    def broken(shown: Path) -> Json:
        raise ValueError("no way")

    row = discovery_study.evaluate_case(tmp_path, 3000, broken)
    assert row["failed"] == "ValueError: no way"
    assert (row["top1"], row["right"], row["sized"]) == (False, False, True)

    def answer(shown: Path) -> Json:
        assert shown == places.case_dir, "a method sees only what is shown"
        return verdict("named", "bumper_hardening", seconds=math.nan)

    monkeypatch.setattr(discovery_study, "RIVALS", {"rival": broken})
    monkeypatch.setattr(discovery_study, "fit_true_structure", lambda shown, effects: 1.05)
    row = discovery_study.evaluate_case(tmp_path, 3000, answer)
    assert row["right"]
    assert row["after_oracle"] == 1.0
    assert row["rivals"]["rival"]["top1"] is False
    assert json.loads(places.verdict.read_text())["verdict"] == "named"
    assert np.isfinite(row["seconds"])


@pytest.mark.parametrize("fails", [False, True])
def test_of_two_effects_the_row_says_what_mark_the_lesser_leaves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    """The factor by which the error grows without it; a verdict that fails has one too."""
    number = 294000
    places = CasePaths(tmp_path, draw_case(number).label)
    for folder in (places.case_dir, places.sealed_dir):
        folder.mkdir(parents=True)
    places.about.write_text(json.dumps(about("pair", TRUE, OTHER, number=number)))
    errors = {(TRUE["name"], OTHER["name"]): 1.0, (TRUE["name"],): 1.2, (OTHER["name"],): 3.0}
    monkeypatch.setattr(
        discovery_study, "fit_true_structure", lambda shown, names: errors[tuple(names)]
    )
    monkeypatch.setattr(discovery_study, "RIVALS", {})

    def answer(shown: Path) -> Json:
        if fails:
            raise ValueError("no way")
        return verdict("named", TRUE["name"])

    row = discovery_study.evaluate_case(tmp_path, number, answer)
    assert row["mark"] == 1.2
    assert (row["both"], row["one"]) == (False, not fails)
    del errors[(OTHER["name"],)]  # no model of the library has it alone
    assert discovery_study.evaluate_case(tmp_path, number, answer)["mark"] is None


def test_what_cannot_be_studied_is_refused(tmp_path: Path) -> None:
    for asked, key, value in (
        ({"seeds": 0}, "--seeds", 0),
        ({"patterns": ["nix/*"]}, "--cells", "nix/*"),
        ({"patterns": ["999999999"]}, "case", 999999999),
        ({"workers": 0}, "--workers", 0),
        ({"resume": True}, "--resume", None),
    ):
        given: Json = {"seeds": 1, "patterns": ["none/1%"], "workers": 1, "resume": False}
        with pytest.raises(InputError) as error:
            run_discovery_study(StudyOptions(tmp_path / "new", **(given | asked)))
        assert (error.value.key, error.value.value) == (key, value)
        assert not (tmp_path / "new").exists()
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / TABLE_FILE).touch()
    with raises_input_error(key="--out", value=str(tmp_path / "there")):
        run_discovery_study(StudyOptions(tmp_path / "there", 1, ["none/1%"], 1, False))


def test_the_page_has_the_controls_and_goes_on_where_it_stopped(tmp_path: Path) -> None:
    good: Json = {"said": "unexplained", "named": [], "confidence": None, "fooled": False}
    bad = {"said": "named", "named": ["table_tilt"], "confidence": 0.9, "fooled": True}
    rows: list[Json] = [
        {"number": 7000, "reversed": good, "without": bad, "right": False},
        {"number": 16000, "reversed": good, "without": good, "right": True},
        {"number": 25000, "failed": "why"},
    ]
    (tmp_path / CONTROLS_FILE).write_text("".join(json.dumps(row) + "\n" for row in rows))
    lines = write_study_pages(tmp_path).read_text().splitlines()
    assert any("time reversed" in line and "(0/2;" in line for line in lines)
    assert any("not in the library: confident" in line and "(1/2;" in line for line in lines)
    controls = Study(judge_clean, format_row, write_study_pages, CONTROLS_FILE)
    assert run_study(controls, tmp_path, [7000, 16000], Workers(1)) == 0
    assert (tmp_path / CONTROLS_FILE).read_text().count("\n") == 3
    assert not (tmp_path / RESULTS_FILE).exists()
    assert (tmp_path / TABLE_FILE).is_file()


QUADRATIC = format_truth("quadratic_damping", c2=6e3)
# Left out of every run of the test, for its length; the study itself leaves out nothing.
LONG = (
    "bouc_wen",
    "maxwell_damper",
    "bumper_maxwell",
    "sensor_gain",
    "sensor_lag",
    "sensor_offset",
)
EFFECTS = ("bumper_hardening", "table_tilt", "gap_drift")


def test_a_log_backwards_is_the_same_motion_with_its_velocity_turned() -> None:
    played = log()
    forward, back = played.signals.fuse_motion(), reverse_log(played).signals.fuse_motion()
    for name, sign in (("u", 1), ("v", -1), ("acc", 1), ("table_disp", 1), ("right", 1)):
        was, reversed_ = getattr(forward, name), getattr(back, name)
        np.testing.assert_allclose(reversed_, sign * was[::-1], atol=1e-9 * np.abs(was).max())
    np.testing.assert_array_equal(back.step, forward.step[::-1])
    again = reverse_log(reverse_log(played)).signals.fuse_motion()
    np.testing.assert_allclose(again.u, forward.u, atol=1e-12)


@pytest.mark.slow  # 5 s
def test_no_control_is_given_a_confident_name() -> None:
    """The same log and library name the truth when it runs forwards and the truth is in it."""
    logs = [log(QUADRATIC)]
    right = summarize_verdict(discover_without(logs, SNM, LONG))
    assert (right["named"], right["fooled"]) == (["quadratic_damping"], True)
    assert not summarize_verdict(discover_without(logs, SNM, [*LONG, "quadratic_damping"]))[
        "fooled"
    ]
    assert not summarize_verdict(discover_without([reverse_log(logs[0])], SNM, LONG))["fooled"]


@pytest.mark.parametrize(
    "word, confidence, fooled",
    [("named", 0.51, True), ("named", 0.5, False), ("unexplained", 0.9, False)],
)
def test_control_named_with_confidence_counts_as_fooled(
    word: str, confidence: float, fooled: bool
) -> None:
    effects = [{"id": "table_tilt", "confidence": confidence}]
    assert summarize_verdict({"verdict": word, "effects": effects})["fooled"] is fooled


def test_shuffled_truths_fall_to_chance() -> None:
    """All right on their own truth; on others' as often as two cases share one by chance."""
    rows = [
        score_verdict(
            verdict("named", name),
            about("single", {"name": name, "parameters": {}, "vanishing": {}}),
        )
        for name in EFFECTS * 2
    ]
    own, others, guess = compute_shuffled_rates(rows)
    assert (own, guess) == (1.0, pytest.approx(1 / 3))
    assert others == pytest.approx(6 / 30), "each case has one other of five with its truth"
    unnamed = [row | {"said": "none"} for row in rows]
    assert compute_shuffled_rates(unnamed)[:2] == (0.0, 0.0)
