"""A study as it runs: processes that die, what is done already, verdicts that fail, bad input."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.card import BadInput
from twin.service.study import crew, judging
from twin.service.study.cells import case_of
from twin.service.study.command import discovery, run
from twin.service.study.crew import by_crew
from twin.service.study.pages import RESULTS, TABLE, read_rows

from . import study_work
from .test_study_scores import OTHER, TRUE, about, verdict

Json = dict[str, Any]


def test_a_study_goes_on_after_a_line_that_was_cut(tmp_path: Path) -> None:
    """Done ones are not done again, failed and cut ones are; nothing that was found is lost."""
    there = [study_work.fine(0), study_work.fine(2) | {"failed": "why"}]
    text = "".join(json.dumps(one) + "\n" for one in there) + '{"number": 4, "ri'
    (tmp_path / RESULTS).write_text(text)
    assert run(tmp_path, [0, 2, 4], 1, study_work.fine) == 0
    after = read_rows(tmp_path / RESULTS)
    assert [one["number"] for one in after] == [0, 2, 2, 4]
    assert after[0]["process"] == there[0]["process"]
    assert "failed" not in after[2]
    assert (tmp_path / RESULTS).read_text().startswith(text)


@pytest.mark.parametrize("workers", [1, 2])
def test_a_process_that_dies_loses_only_its_case(workers: int) -> None:
    found = {
        one["number"]: one for one in by_crew(range(4), workers, study_work.deadly, lambda: False)
    }
    assert sorted(found) == [0, 1, 2, 3]
    for number, row in found.items():
        assert ("failed" in row) == bool(number % 2)
    assert found[1]["failed"] == "its process died (exit code -9)"


def test_a_case_that_does_not_end_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew, "LONGEST_S", 0.3)
    found = list(by_crew([1, 3], 1, study_work.endless, lambda: False))
    assert [one["number"] for one in found] == [1, 3]
    assert all(one["failed"] == "took longer than 0.3 s" for one in found)


def test_a_stop_hands_out_what_is_under_way() -> None:
    asked: list[int] = []

    def stop() -> bool:
        return len(asked) > 0

    found = []
    for row in by_crew(range(100), 1, study_work.fine, stop):
        found.append(row["number"])
        asked.append(1)
    assert found == [0, 1]


def test_a_verdict_that_fails_is_a_miss_that_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    case = case_of(3000)
    places = judging.Places(tmp_path, case.label)
    for folder in (places.shown, places.sealed):
        folder.mkdir(parents=True)
    places.about.write_text(json.dumps(about("single", TRUE, number=3000)))

    def broken(shown: Path) -> Json:
        raise ValueError("no way")

    row = judging.judge(tmp_path, 3000, broken)
    assert row["failed"] == "ValueError: no way"
    assert (row["top1"], row["right"], row["sized"]) == (False, False, True)

    def told(shown: Path) -> Json:
        assert shown == places.shown, "a method sees only what is shown"
        return verdict("named", "bumper_hardening", seconds=math.nan)

    monkeypatch.setattr(judging, "RIVALS", {"rival": broken})
    monkeypatch.setattr(judging, "true_structure", lambda shown, effects: 1.05)
    row = judging.judge(tmp_path, 3000, told)
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
    places = judging.Places(tmp_path, case_of(number).label)
    for folder in (places.shown, places.sealed):
        folder.mkdir(parents=True)
    places.about.write_text(json.dumps(about("pair", TRUE, OTHER, number=number)))
    errors = {(TRUE["name"], OTHER["name"]): 1.0, (TRUE["name"],): 1.2, (OTHER["name"],): 3.0}
    monkeypatch.setattr(judging, "true_structure", lambda shown, names: errors[tuple(names)])
    monkeypatch.setattr(judging, "RIVALS", {})

    def told(shown: Path) -> Json:
        if fails:
            raise ValueError("no way")
        return verdict("named", TRUE["name"])

    row = judging.judge(tmp_path, number, told)
    assert row["mark"] == 1.2
    assert (row["both"], row["one"]) == (False, not fails)
    del errors[(OTHER["name"],)]  # no model of the library has it alone
    assert judging.judge(tmp_path, number, told)["mark"] is None


def test_bad_input_is_told(tmp_path: Path) -> None:
    for asked, words in (
        ({"seeds": 0}, "--seeds 0: allowed: 1 to 200"),
        ({"patterns": ["nix/*"]}, "--cells nix/\\*: fits no cell"),
        ({"patterns": ["999999999"]}, "case 999999999: allowed: 0 to"),
        ({"workers": 0}, "--workers 0: allowed: 1 or more"),
        ({"resume": True}, "no study there to resume"),
    ):
        given: Json = {"seeds": 1, "patterns": ["none/1%"], "workers": 1, "resume": False}
        with pytest.raises(BadInput, match=words):
            discovery(tmp_path / "new", **(given | asked))
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / TABLE).touch()
    with pytest.raises(BadInput, match="has content"):
        discovery(tmp_path / "there", 1, ["none/1%"], 1, False)
