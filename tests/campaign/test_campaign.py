"""A campaign from its file to its end: order, refusals, what a resume keeps."""

import math
import shlex
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from table_io.config.base import PROFILES_DIR
from table_io.config.excitation.stepped_sine import Sweep
from table_io.config.profile import SetUpConfirmation
from table_io.errors import InputError
from table_io.records import Check, PrcPoint
from tests.campaign.campaigns import (
    LISTED,
    Players,
    files,
    make_options,
    prepare_campaign,
    statuses,
)
from tests.command_line import call_main
from tests.input_errors import raises_input_error
from twin.campaign import command
from twin.campaign.command import CampaignOptions, run_campaign
from twin.campaign.config import CampaignPlan
from twin.campaign.figures import _is_covered_finer
from twin.campaign.state import (
    LOCK_FILE,
    RunPart,
    RunState,
    append_sections,
    copy_configs,
    hold_lock,
    read_state,
    require_unchanged,
    write_state,
)
from twin.campaign.summary import merge_summaries
from twin.recording.reader import read_recording
from twin.results.summary import summarise
from twin.setup.run_config import RunConfig, read_run_config
from twin.setup.unpaced import play_unpaced


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    return prepare_campaign(tmp_path, monkeypatch)


def test_the_runs_are_played_in_order_each_in_a_folder_of_its_own(folder: Path) -> None:
    assert run_campaign(make_options(folder)) == 0
    assert [Path(run.folder).name for run in Players.given] == ["01-free", "02-g4", "03-again"]
    assert [run.name for run in Players.given] == ["free", "g4", "g4"]
    assert statuses(folder) == ["complete"] * 3
    assert (folder / "out" / "campaign.toml").read_text() == LISTED


def test_a_recording_says_what_was_asked_before_it_and_who_answered(folder: Path) -> None:
    run_campaign(make_options(folder))
    noted = [tomllib.loads(run.profile_toml)["set_up"] for run in Players.given]
    assert [set_up["asked"] for set_up in noted] == ["Take the bumpers away", "Set 4 mm", ""]
    assert [set_up["answer"] for set_up in noted] == ["unattended", "unattended", "not asked"]
    assert noted[1]["notes"] == "look at the bolts"
    assert noted[0]["campaign"] == "Three gaps"
    set_up = read_state(folder / "out").runs[1].set_up[0]
    assert (set_up.who, set_up.at) == (noted[1]["who"], noted[1]["at"])
    assert set_up.who
    assert set_up.at.startswith("20")


def test_any_text_of_an_operator_is_kept_as_it_is(folder: Path) -> None:
    wild = 'a "quote" \\ back\nline\ttab \x7f \u2212 \U0001f600'
    card = SetUpConfirmation(campaign=wild, label="l", asked=wild, answer="done", who="w", at="now")
    text = append_sections((folder / "g4.toml").read_text(), {"set_up": card})
    assert tomllib.loads(text)["set_up"]["asked"] == wild


def test_after_a_protection_no_run_begins_and_it_says_how_to_go_on(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Players.ends["g4"] = ("aborted", 2)
    assert run_campaign(make_options(folder)) == 3
    assert statuses(folder) == ["complete", "interrupted", "planned"]
    output = capsys.readouterr().out
    assert "g4, again" in output
    again = f"shaketwin campaign {folder}/c.toml --out {folder}/out --resume --speed max"
    assert again in output.replace("\n", "")


def test_a_resume_keeps_what_is_complete_and_goes_on_with_the_rest(folder: Path) -> None:
    Players.ends["g4"] = ("aborted", 2)
    run_campaign(make_options(folder))
    kept = files(folder / "out")
    Players.given.clear()
    Players.ends.clear()
    assert run_campaign(make_options(folder, resume=True)) == 0
    assert [Path(run.folder).name for run in Players.given] == ["02-g4-2", "03-again"]
    assert statuses(folder) == ["complete"] * 3
    assert {name: files(folder / "out")[name] for name in kept} == kept
    assert "resume" not in tomllib.loads(Players.given[0].profile_toml)  # forward began anew


def test_a_run_goes_on_at_the_direction_that_was_interrupted(folder: Path) -> None:
    Players.ends["g4"] = ("stopped", 5)  # three forward, two of three backward
    run_campaign(make_options(folder))
    first = read_state(folder / "out").runs[1].parts[0].run
    Players.given.clear()
    Players.ends.clear()
    run_campaign(make_options(folder, resume=True))
    assert tomllib.loads(Players.given[0].profile_toml)["resume"] == {"first_step": 3, "of": first}
    assert [part.first_step for part in read_state(folder / "out").runs[1].parts] == [0, 3]


def test_a_complete_campaign_is_resumed_by_doing_nothing(folder: Path) -> None:
    run_campaign(make_options(folder))
    before = files(folder / "out")
    Players.given.clear()
    assert run_campaign(make_options(folder, resume=True)) == 0
    assert Players.given == []
    assert files(folder / "out") == before


def test_what_was_recorded_and_is_no_longer_so_is_measured_anew(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_campaign(make_options(folder))
    (folder / "out" / "01-free" / "run.mcap").write_bytes(b"damaged")
    Players.given.clear()
    assert run_campaign(make_options(folder, resume=True)) == 0
    assert [Path(run.folder).name for run in Players.given] == ["01-free-2"]
    assert (folder / "out" / "01-free" / "run.mcap").read_bytes() == b"damaged"
    assert "free: 01-free/run.mcap" in capsys.readouterr().out.replace("\n", "")


RECORDED = """
[[calibrations]]
channel = "table_acc_m_s2"
applied = [0.0, 1.0]
"""


def test_campaign_warns_of_a_new_calibration_record_and_goes_on(tmp_path: Path) -> None:
    def plan(rig_toml: str) -> CampaignPlan:
        bundle = SimpleNamespace(profile_toml="p", rig_toml=rig_toml, model_toml="m")
        run = SimpleNamespace(name="01", label="free", bundle=bundle)
        return cast(CampaignPlan, SimpleNamespace(text="x", path=Path("c.toml"), runs=[run]))

    card = 'name = "r"\n[output]\nspan_mm = 60.0\n'
    copy_configs(tmp_path, plan(card))
    assert require_unchanged(tmp_path, plan(card)) == []
    for text in (card + RECORDED, card + RECORDED + RECORDED):
        (warning,) = require_unchanged(tmp_path, plan(text))
        assert "free" in warning
        assert "calibration records" in warning
    for text in (
        card.replace("60.0", "50.0") + RECORDED,
        card + RECORDED + '[[sensors]]\nchannel = "table_acc_m_s2"\n',
    ):
        with raises_input_error(where=str(tmp_path)):
            require_unchanged(tmp_path, plan(text))


@pytest.mark.parametrize(
    ("file", "old", "new", "named"),
    [
        ("c.toml", "Set 4 mm", "Set 5 mm", '-prompt = "Set 4 mm"'),
        ("g4.toml", "cycles = 4", "cycles = 6", "+cycles = 6"),
    ],
)
def test_another_campaign_is_not_resumed(
    folder: Path, file: str, old: str, new: str, named: str
) -> None:
    Players.ends["free"] = ("aborted", 2)
    run_campaign(make_options(folder))
    before = files(folder / "out")
    path = folder / file
    path.write_text(path.read_text().replace(old, new))
    Players.given.clear()
    with raises_input_error(where=folder / "out", problem=named):
        run_campaign(make_options(folder, resume=True))
    assert Players.given == []
    assert files(folder / "out") == before


def test_a_folder_with_content_is_refused_unless_it_is_resumed(folder: Path) -> None:
    run_campaign(make_options(folder))
    with raises_input_error(key="--out", value=str(folder / "out"), remedy="--resume"):
        run_campaign(make_options(folder))
    with raises_input_error(key="--resume", remedy="--out"):
        run_campaign(make_options(folder, resume=True, out=None))
    with raises_input_error(key="--out", value=str(folder / "nowhere"), remedy="--resume"):
        run_campaign(make_options(folder, resume=True, out=folder / "nowhere"))
    (folder / "other").mkdir()
    (folder / "other" / "mine.txt").write_text("mine")
    with raises_input_error(where=str(folder / "other")):
        run_campaign(make_options(folder, resume=True, out=folder / "other"))


def test_a_table_that_keeps_its_own_time_is_refused_at_full_speed(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "table_io.config.rig.RigConfig.runs_at_any_speed", property(lambda _: False)
    )
    with raises_input_error(where="--speed max"):
        run_campaign(make_options(folder))
    assert not (folder / "out").exists()


def test_two_campaigns_do_not_work_in_one_folder(folder: Path) -> None:
    Players.ends["free"] = ("aborted", 2)
    run_campaign(make_options(folder))
    with hold_lock(folder / "out" / LOCK_FILE), raises_input_error(where=folder / "out"):
        run_campaign(make_options(folder, resume=True))


def test_a_state_that_cannot_be_written_leaves_the_old_one(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_campaign(make_options(folder))
    before = read_state(folder / "out")

    def full(_: int) -> None:
        raise OSError("no space left")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="no space"):
        write_state(folder / "out", before.model_copy(update={"runs": ()}))
    assert read_state(folder / "out") == before


def test_every_test_is_judged_before_the_first_one_moves(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = []

    def judge(_has_page: bool, bundle: RunConfig, _: Path) -> None:
        judged.append(bundle.name)
        if bundle.name == "g4":
            raise InputError("the machine does not answer")

    monkeypatch.setattr(command, "_require_any_speed", judge)
    with raises_input_error(where="g4.toml"):
        run_campaign(make_options(folder))
    assert judged == ["free", "g4"]
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    "words",
    [
        ["--yes", "--speed", "max", "--table", "hydraulic"],
        ["--web", "--listen", "tcp/127.0.0.1:7555"],
        ["--web-listen", "127.0.0.1:8123", "--model", "snm"],
    ],
)
def test_the_resume_command_repeats_every_option(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[CampaignOptions] = []

    def note(options: CampaignOptions) -> int:
        asked.append(options)
        return 0

    monkeypatch.setattr(command, "run_campaign", note)
    folder = tmp_path / "out"
    call_main("campaign", "paper", "--out", folder, *words)
    call_main(*shlex.split(asked[0].resume_command(folder))[1:])
    first, again = asked
    assert (first.resume, again.resume) == (False, True)
    for name in ("path", "out", "unpaced", "model", "table", "unattended", "listen"):
        assert getattr(again, name) == getattr(first, name)
    assert again.access_words == first.access_words
    assert (again.start_page is None) == (first.start_page is None)


def test_checks_of_a_resumed_run_are_those_of_its_last_part(tmp_path: Path) -> None:
    text = (PROFILES_DIR / "tests" / "quickstart.toml").read_text()
    profile = tmp_path / "short.toml"
    profile.write_text(
        text.replace("start_hz = 2.4", "start_hz = 4.2").replace("cycles = 5", "cycles = 3")
    )
    config = read_run_config(profile)
    path = tmp_path / "run.mcap"
    play_unpaced(config, "run", path, lambda: None, lambda _: None)
    recording = read_recording(path)
    summary = summarise(recording, config.parameters)
    assert len(summary.checks) == len(recording.records(Check)) > 0
    parts = tuple(RunPart(folder=f"{n}", run=f"run{n}", first_step=0) for n in range(3))
    state = RunState(name="short", label="short", status="complete", parts=parts)
    for summaries in ([summary] * 3, [summary, summary, None]):  # the last part has none yet
        merged = merge_summaries(state, config.profile, summaries)
        assert merged.checks == summary.checks


@pytest.mark.parametrize(
    ("direction", "hz", "is_covered"),
    [("forward", 3.4, True), ("backward", 3.4, False), ("forward", 4.4, False)],
)
def test_a_finer_sweep_of_one_direction_covers_its_own_points_only(
    direction: str, hz: float, is_covered: bool
) -> None:
    coarse = Sweep(start_hz=2.0, stop_hz=5.0, step_hz=0.2, cycles=4)
    finer = Sweep(start_hz=3.0, stop_hz=4.0, step_hz=0.1, cycles=4, directions=("forward",))
    point = PrcPoint(0, 0, direction, hz, None, None, math.nan, math.nan, math.nan)
    assert _is_covered_finer(point, coarse, [coarse, finer]) == is_covered
