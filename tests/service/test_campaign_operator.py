"""What the operator is asked between the runs of a campaign, and what an answer does."""

from pathlib import Path
from typing import Any

import pytest

from table_io.card import BadInput
from twin.service.campaign import flow, paced, words
from twin.service.campaign.flow import campaign
from twin.service.campaign.state import read_state

from .campaigns import Players, asked, prepared, record, statuses


class Operator:
    """Answers, in order; what it was shown is kept."""

    def __init__(self, *answers: str) -> None:
        self.answers = list(answers)
        self.asked = 0

    def __call__(self, _: str) -> str:
        self.asked += 1
        answer = self.answers.pop(0)
        if answer == "^C":
            raise KeyboardInterrupt
        return answer


@pytest.fixture
def attended(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A campaign in real time, at a terminal; a run ends as soon as it begins."""
    folder = prepared(tmp_path, monkeypatch)

    def play(book: Any, run: Any, said: Any, listen: str, _: Any) -> int:
        spec = book.begin(run, said, listen)
        Players.given.append(spec)
        record(spec)
        return 0 if book.ended(run) else 3

    monkeypatch.setattr(paced, "_play", play)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr(flow, "real_time", lambda *_: None)
    return folder


def answers(monkeypatch: pytest.MonkeyPatch, *told: str) -> Operator:
    operator = Operator(*told)
    monkeypatch.setattr(words.console, "input", operator)
    return operator


def test_the_operator_is_asked_where_the_set_up_changes(
    attended: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    operator = answers(monkeypatch, "", "")
    assert campaign(asked(attended, unpaced=False)) == 0
    assert operator.asked == 2  # the third run is at the same gap
    assert "SET-UP: Set 4 mm" in capsys.readouterr().out
    told = [run.set_up[0].answer for run in read_state(attended / "out").runs]
    assert told == ["done", "done", "not asked"]


def test_a_run_is_skipped_and_asked_for_again_on_resume(
    attended: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers(monkeypatch, "", "what?", "s")
    assert campaign(asked(attended, unpaced=False)) == 0
    assert statuses(attended) == ["complete", "skipped", "complete"]
    operator = answers(monkeypatch, "")
    Players.given.clear()
    assert campaign(asked(attended, unpaced=False, resume=True)) == 0
    assert operator.asked == 1
    assert [Path(one.folder).name for one in Players.given] == ["02-g4"]


@pytest.mark.parametrize("answer", ["q", "^C"])
def test_the_operator_stops_between_runs(
    attended: Path, monkeypatch: pytest.MonkeyPatch, answer: str
) -> None:
    answers(monkeypatch, "", answer)
    assert campaign(asked(attended, unpaced=False)) == 130
    assert statuses(attended) == ["complete", "planned", "planned"]


def test_the_first_run_of_a_resume_asks_for_the_set_up_that_it_needs(
    attended: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Players.ends["again"] = ("aborted", 1)
    answers(monkeypatch, "", "")
    assert campaign(asked(attended, unpaced=False)) == 3
    Players.ends.clear()
    operator = answers(monkeypatch, "")
    capsys.readouterr()
    assert campaign(asked(attended, unpaced=False, resume=True)) == 0
    assert operator.asked == 1
    assert "SET-UP: Set 4 mm" in capsys.readouterr().out


def test_without_a_terminal_somebody_has_to_say_yes(
    attended: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    with pytest.raises(BadInput, match="give --yes"):
        campaign(asked(attended, unpaced=False))
    assert not (attended / "out").exists()
    assert campaign(asked(attended, unpaced=False, unattended=True)) == 0
