"""`discover --decide`: the proposal, the rig that plays it or refuses, the operator, the chain."""

import json
import math
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from table_io.config.profile import Profile
from table_io.errors import InputError
from tests.builders.profiles import AT_1_KHZ_BY_50, UNCHECKED, format_test
from tests.builders.rigs import RIG_TEXT
from tests.builders.truths import hide_truth
from tests.input_errors import raises_input_error
from twin.discovery import command, decide, decisive_test
from twin.discovery.command import parse_options, run_decision, run_discovery
from twin.discovery.decisive_test import DecideOptions
from twin.laws.library import EFFECTS
from twin.recording.reader import read_recording
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import play_unpaced
from twin.system import terminal
from twin.system.exit_codes import EXIT_INTERRUPTED

TRUTH = '[[effects]]\nid = "maxwell_damper"\nparameters = { k1 = 12000.0, tau = 0.06 }\n'
KEPT = ("maxwell_damper", "quadratic_damping")
OTHERS = [effect.id for effect in EFFECTS if effect.id not in KEPT]  # left out: it is quick


def record_run(folder: Path, truth: str = "") -> Path:
    """A recording of one frequency at one level, on a rig that may hide an effect."""
    folder.mkdir(parents=True)
    (folder / "rig.toml").write_text(hide_truth(RIG_TEXT, folder, truth))
    profile, log = folder / "p.toml", folder / "first.mcap"
    profile.write_text(
        format_test(
            2.0,
            2.0,
            1.0,
            math.inf,
            AT_1_KHZ_BY_50 | UNCHECKED,
            rig=folder / "rig.toml",
            cycles=15,
            measured_cycles=None,
            acceleration_g=0.05,
            directions=["forward"],
        )
    )
    play_unpaced(read_run_config(profile), "first", log, lambda: None, lambda item: None)
    return log


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_run(tmp_path_factory.mktemp("decide") / "plain")


@pytest.fixture
def few_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two short candidates: quick to simulate."""

    def list_two(profile: Profile) -> Iterator[tuple[str, dict[str, Any]]]:
        chosen = [pair for pair in list_excitations(profile) if "higher freq" in pair[0]]
        yield from chosen[2:4]  # the loudest

    list_excitations = decisive_test.list_excitations
    monkeypatch.setattr(decisive_test, "list_excitations", list_two)


@pytest.fixture
def without_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """No figures: they take most of the time."""
    monkeypatch.setattr(command, "write_discovery_page", lambda *_: None)


def read_verdict(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "verdict.json").read_text())
    return content


def make_answers(*replies: str) -> Callable[..., str]:
    """An operator who gives these answers in turn."""
    remaining = iter(replies)
    return lambda *_args, **_kwargs: next(remaining)


@pytest.mark.slow  # the figures
@pytest.mark.usefixtures("few_tests")
def test_the_proposal_is_a_profile_that_check_and_run_load(plain: Path, tmp_path: Path) -> None:
    profile = tmp_path / "next.toml"
    options = DecideOptions(profile, rig=str(plain.parent / "rig.toml"))
    assert run_discovery([plain], "snm", tmp_path / "out", OTHERS, (), options)[1] == 0
    config = read_run_config(profile)
    verdict = read_verdict(tmp_path / "out")["decide"]
    assert config.profile.title == f"{verdict['title']}: {verdict['purpose']}"
    assert "standard errors" in config.profile.notes
    assert config.expected_s / 60 == pytest.approx(verdict["minutes"])
    assert verdict["profile"] == profile.name
    assert verdict["count"] == 2
    assert verdict["rivals"][0]["peaks"][0]["peak_disp_m"] > 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Expected in: " in page
    assert read_verdict(tmp_path / "out")["next_run"].startswith(verdict["title"])


@pytest.mark.usefixtures("few_tests", "without_page")
def test_the_operator_is_asked_and_may_stop(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(terminal.console, "input", make_answers("q"))
    out = tmp_path / "out"
    code = run_decision([plain], "snm", out, OTHERS, (), DecideOptions(unpaced=True))
    assert code == EXIT_INTERRUPTED
    shown = capsys.readouterr().out
    assert "TEST: sweep, higher frequencies" in shown
    assert "SET-UP: as in the recording" in shown
    assert not (out / "run-1").exists()


@pytest.mark.usefixtures("few_tests", "without_page")
def test_a_refused_test_is_one_message_and_the_next_is_tried(
    plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    refused: list[Path] = []

    def refuse(profile: Path, *_: object) -> int:
        refused.append(profile)
        raise InputError("the pump is off", remedy="start it")

    monkeypatch.setattr(decide, "run_test", refuse)
    out = tmp_path / "out"
    options = DecideOptions(asks=False, unpaced=True)
    assert run_decision([plain], "snm", out, OTHERS, (), options) == 0
    lines = capsys.readouterr().out.splitlines()
    messages = [line for line in lines if line.startswith("the rig refuses ")]
    assert len(messages) == len(refused) == 2
    assert len({*messages}) == 2
    assert all("the pump is off" in message for message in messages)
    assert lines[-1] == "not decided: no proposed test is left to play"


def test_the_budget_counts_the_minutes_that_were_played(plain: Path) -> None:
    recording = read_recording(plain)
    moved_s = recording.contiguous_blocks("meas")[-1].end / 1000.0
    assert 15 / 2.0 < moved_s < 20.0
    assert decide.measure_minutes(plain) == pytest.approx(moved_s / 60.0)


@pytest.mark.usefixtures("without_page")
def test_a_rig_without_the_stroke_gets_no_proposal(plain: Path, tmp_path: Path) -> None:
    weak = tmp_path / "weak.toml"
    text = (plain.parent / "rig.toml").read_text()
    weak.write_text(text.replace("acceleration_g = 1.0", "acceleration_g = 0.0001"))
    options = DecideOptions(tmp_path / "next.toml", rig=str(weak))
    run_discovery([plain], "snm", tmp_path / "out", OTHERS, (), options)
    assert not (tmp_path / "next.toml").exists()
    verdict = read_verdict(tmp_path / "out")
    assert verdict["decide"] is None
    assert "none separates" in verdict["next_run"]


def test_options_without_a_proposal_are_refused(tmp_path: Path) -> None:
    assert parse_options(None, False, "", 10.0, False, "realtime") is None
    with raises_input_error(key="--table", remedy="--decide"):
        parse_options(None, False, "simulated", 10.0, False, "realtime")
    with raises_input_error(key="--speed", allowed="realtime or max"):
        parse_options(None, True, "", 10.0, False, "fast")
    with raises_input_error(key="--budget-min"):
        parse_options(None, True, "", 0.0, False, "realtime")
    existing = tmp_path / "next.toml"
    existing.touch()
    with raises_input_error(key="--decide", problem="overwritten"):
        parse_options(existing, False, "", 10.0, False, "realtime")


@pytest.mark.slow
def test_the_rig_plays_until_a_hidden_effect_is_named(tmp_path: Path) -> None:
    """At one frequency the branch is stiffness and damping; the played test shows what it is."""
    log = record_run(tmp_path / "first", TRUTH)
    out = tmp_path / "out"
    options = DecideOptions(asks=False, unpaced=True)
    assert run_decision([log], "snm", out, (), (), options) == 0
    verdicts = sorted(out.glob("verdict-*"))
    verdict = read_verdict(verdicts[-1])
    chain: Sequence[dict[str, Any]] = verdict["chain"]
    assert len(chain) == len(verdicts) > 1
    assert chain[-1]["effects"] == ["maxwell_damper"]
    assert chain[-1]["confidence"] > 0.5
    assert chain[0]["played"] == ""
    recorded = read_recording(out / chain[1]["log"] / "run.mcap").start
    profile = tomllib.loads(recorded.profile_toml)
    assert profile["title"].startswith(chain[1]["played"])
    assert profile["set_up"]["campaign"] == "discover --decide"
    assert profile["set_up"]["answer"] == "unattended"
    assert "Chain of verdicts" in (verdicts[-1] / "report.html").read_text()
