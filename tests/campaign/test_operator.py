"""What the operator is asked between the runs of a campaign, and what an answer does."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.campaign.campaigns import (
    LISTED,
    Players,
    make_options,
    prepare_campaign,
    record,
    statuses,
)
from tests.input_errors import raises_input_error
from twin.campaign import command, players
from twin.campaign.command import run_campaign
from twin.campaign.state import read_state


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
def attended_campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A campaign in real time, at a terminal; a run ends as soon as it begins."""
    folder = prepare_campaign(tmp_path, monkeypatch)

    def play(book: Any, run: Any, voice: Any, listen: str, _: Any) -> int:
        spec = book.begin_recording(run, voice, listen)
        Players.given.append(spec)
        record(spec)
        return 0 if book.finish_recording(run) else 3

    monkeypatch.setattr(players, "_play_run", play)
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr(command, "check_realtime", lambda *_: None)
    return folder


def answers(monkeypatch: pytest.MonkeyPatch, *typed: str) -> Operator:
    operator = Operator(*typed)
    monkeypatch.setattr("twin.campaign.messages.console.input", operator)
    return operator


def test_the_operator_is_asked_where_the_set_up_changes(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    operator = answers(monkeypatch, "", "")
    assert run_campaign(make_options(attended_campaign, unpaced=False)) == 0
    assert operator.asked == 2  # the third run is at the same gap
    assert "SET-UP: Set 4 mm" in capsys.readouterr().out
    typed = [run.set_up[0].answer for run in read_state(attended_campaign / "out").runs]
    assert typed == ["done", "done", "not asked"]


def test_a_run_is_skipped_and_asked_for_again_on_resume(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers(monkeypatch, "", "what?", "s", "")
    assert run_campaign(make_options(attended_campaign, unpaced=False)) == 0
    assert statuses(attended_campaign) == ["complete", "skipped", "complete"]
    operator = answers(monkeypatch, "")
    Players.given.clear()
    assert run_campaign(make_options(attended_campaign, unpaced=False, resume=True)) == 0
    assert operator.asked == 1
    assert [Path(run.folder).name for run in Players.given] == ["02-g4"]


def test_a_skip_confirms_no_set_up(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    operator = answers(monkeypatch, "", "s", "s")
    assert run_campaign(make_options(attended_campaign, unpaced=False)) == 0
    assert operator.asked == 3
    assert capsys.readouterr().out.count("SET-UP: Set 4 mm") == 2
    assert statuses(attended_campaign) == ["complete", "skipped", "skipped"]
    operator = answers(monkeypatch, "s", "")
    assert run_campaign(make_options(attended_campaign, unpaced=False, resume=True)) == 0
    assert operator.asked == 2
    assert statuses(attended_campaign) == ["complete", "skipped", "complete"]
    again = read_state(attended_campaign / "out").runs[2].set_up[-1]
    assert (again.asked, again.answer) == ("Set 4 mm", "done")


def test_a_set_up_is_asked_for_where_the_run_that_prompts_for_it_is_complete(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    second = '[[runs]]\nprofile = "free.toml"\nlabel = "second"\n'
    before, separator, g4 = LISTED.rpartition('[[runs]]\nprofile = "g4.toml"\nprompt')
    (attended_campaign / "c.toml").write_text(before + second + separator + g4)
    answers(monkeypatch, "", "")
    assert run_campaign(make_options(attended_campaign, unpaced=False)) == 0
    for folder in ("02-second", "04-again"):
        (attended_campaign / "out" / folder / "run.mcap").write_bytes(b"altered")
    operator = answers(monkeypatch, "", "")
    capsys.readouterr()
    assert run_campaign(make_options(attended_campaign, unpaced=False, resume=True)) == 0
    assert operator.asked == 2
    shown = [line for line in capsys.readouterr().out.splitlines() if line.startswith("SET-UP")]
    assert shown == ["SET-UP: Take the bumpers away", "SET-UP: Set 4 mm"]


def test_one_page_shows_all_runs_and_none_at_full_speed(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers(monkeypatch, "", "")
    runs_shown: dict[str, int] = {}

    @contextmanager
    def start_page(rig: str) -> Iterator[None]:
        yield
        runs_shown[rig] = len(Players.given)

    options = make_options(attended_campaign, unpaced=False, start_page=start_page)
    assert run_campaign(options) == 0
    assert runs_shown == {"simulated": 3}
    with raises_input_error(key="--web"):
        run_campaign(replace(options, unpaced=True, out=attended_campaign / "other"))


@pytest.mark.parametrize("answer", ["q", "^C"])
def test_the_operator_stops_between_runs(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch, answer: str
) -> None:
    answers(monkeypatch, "", answer)
    assert run_campaign(make_options(attended_campaign, unpaced=False)) == 130
    assert statuses(attended_campaign) == ["complete", "planned", "planned"]


def test_the_first_run_of_a_resume_asks_for_the_set_up_that_it_needs(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    Players.ends["again"] = ("aborted", 1)
    answers(monkeypatch, "", "")
    assert run_campaign(make_options(attended_campaign, unpaced=False)) == 3
    Players.ends.clear()
    operator = answers(monkeypatch, "")
    capsys.readouterr()
    assert run_campaign(make_options(attended_campaign, unpaced=False, resume=True)) == 0
    assert operator.asked == 1
    assert "SET-UP: Set 4 mm" in capsys.readouterr().out


def test_without_a_terminal_somebody_has_to_say_yes(
    attended_campaign: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin.isatty", lambda: False, raising=False)
    with raises_input_error(remedy="--yes"):
        run_campaign(make_options(attended_campaign, unpaced=False))
    assert not (attended_campaign / "out").exists()
    assert run_campaign(make_options(attended_campaign, unpaced=False, unattended=True)) == 0
