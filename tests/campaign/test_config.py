"""The campaign's file: every fault of it and of its tests in one message, before anything moves."""

from pathlib import Path

import pytest

from table_io.config.base import PROFILES_DIR
from table_io.errors import InputError
from tests.campaign.campaigns import write
from tests.input_errors import raises_input_error
from twin.campaign.config import CampaignPlan, list_campaign_warnings, read_plan
from twin.setup.run_config import RunConfig


def anything(_: RunConfig, __: Path) -> None:
    """Nothing is refused."""


def plan(folder: Path, text: str) -> CampaignPlan:
    path = folder / "campaign.toml"
    path.write_text(text)
    return read_plan(path, None, None, anything)


def format_runs(*runs: str) -> str:
    return 'title = "C"\n' + "".join(f'[[runs]]\nprofile = "{run}.toml"\n' for run in runs)


def test_every_fault_stands_in_one_message(tmp_path: Path) -> None:
    write(tmp_path, free="inf", g4="4.0", wild="4.0 1.2")
    (tmp_path / "odd.toml").write_text("titel = 1\n")
    with pytest.raises(InputError) as error:
        plan(tmp_path, format_runs("free", "g44", "wild", "odd", "g4", "g4") + 'promt = "x"\n')
    misspelt, *listed = error.value.faults
    assert misspelt.key == "runs.5.promt"
    assert "'prompt'" in misspelt.remedy
    faults = {fault.where: fault.faults[0] for fault in listed}
    assert faults.keys() == {"g44.toml", "wild.toml", "odd.toml", "runs"}  # not the sound ones
    assert "'g4.toml'" in faults["g44.toml"].remedy  # the missing file's nearest
    assert {fault.key for fault in faults["odd.toml"].faults} >= {"titel", "title"}
    assert (faults["runs"].key, faults["runs"].value) == ("label", "g4")


def test_what_all_have_in_common_is_said_once(tmp_path: Path) -> None:
    write(tmp_path, free="inf", g4="4.0")
    (tmp_path / "campaign.toml").write_text(format_runs("free", "g4"))
    with pytest.raises(InputError) as error:
        read_plan(tmp_path / "campaign.toml", "nowhere", None, anything)
    (shared,) = error.value.faults
    assert shared.where == "free.toml, g4.toml"
    assert [fault.where for fault in shared.faults] == ["--table nowhere"]


def test_what_a_table_cannot_do_in_several_tests_is_said_once(tmp_path: Path) -> None:
    def refuse(_: object, place: Path) -> None:
        raise InputError("not possible", where=place, faults=[InputError("too far", key="k")])

    write(tmp_path, free="inf", g4="4.0")
    (tmp_path / "campaign.toml").write_text(format_runs("free", "g4"))
    with pytest.raises(InputError) as error:
        read_plan(tmp_path / "campaign.toml", None, None, refuse)
    (shared,) = error.value.faults
    assert shared.where == "free.toml, g4.toml"
    assert [inner.key for fault in shared.faults for inner in fault.faults] == ["k"]


@pytest.mark.parametrize("text", ['title = "C"\n', 'title = "C"\nruns = []\n'])
def test_a_campaign_of_nothing_is_refused(tmp_path: Path, text: str) -> None:
    with raises_input_error(key="runs", problem="[[runs]]"):
        plan(tmp_path, text)


def test_the_same_label_twice_is_refused(tmp_path: Path) -> None:
    write(tmp_path, free="inf", g4="4.0")
    with raises_input_error(key="label", value="g4"):
        plan(tmp_path, format_runs("free", "g4", "g4"))
    twice = (
        format_runs("free", "g4") + 'repeat = 2\n[[runs]]\nprofile = "g4.toml"\nlabel = "g4-rep2"\n'
    )
    with raises_input_error(key="label", value="g4-rep2"):
        plan(tmp_path, twice)


@pytest.mark.parametrize("label", ["a/b", "..", "a b"])
def test_a_label_that_is_no_name_of_a_folder_is_refused(tmp_path: Path, label: str) -> None:
    write(tmp_path, free="inf")
    with raises_input_error(key="runs.0.label", value=label):
        plan(tmp_path, format_runs("free") + f'label = "{label}"\n')


def test_what_a_run_says_about_itself_in_a_campaign_is_refused(tmp_path: Path) -> None:
    write(tmp_path, free="inf")
    path = tmp_path / "free.toml"
    path.write_text(path.read_text() + '[resume]\nfirst_step = 1\nof = "x"\n')
    with raises_input_error(key="[resume]"):
        plan(tmp_path, format_runs("free"))


def test_a_repeated_run_asks_for_its_set_up_once(tmp_path: Path) -> None:
    write(tmp_path, free="inf", g4="4.0")
    campaign = plan(tmp_path, format_runs("free", "g4") + 'prompt = "Set it"\nrepeat = 3\n')
    assert [run.name for run in campaign.runs] == ["01-free", "02-g4", "03-g4-rep2", "04-g4-rep3"]
    assert [run.prompt for run in campaign.runs] == ["", "Set it", "", ""]


def test_free_flight_comes_first_or_it_is_said(tmp_path: Path) -> None:
    write(tmp_path, free="inf", g4="4.0", low="inf 0.02")
    assert list_campaign_warnings(plan(tmp_path, format_runs("free", "g4"))) == []
    (warning,) = list_campaign_warnings(plan(tmp_path, format_runs("g4", "free")))
    assert "free flight (free) is not the first run" in warning
    (warning,) = list_campaign_warnings(plan(tmp_path, format_runs("g4")))
    assert "no free flight" in warning
    (warning,) = list_campaign_warnings(plan(tmp_path, format_runs("low", "g4")))
    assert "g4: another level than the free flight's 0.02 g" in warning


def test_the_campaign_of_the_paper_is_its_whole_test_matrix() -> None:
    campaign = read_plan(PROFILES_DIR / "campaigns" / "paper.toml", None, None, anything)
    assert [run.label for run in campaign.runs] == [
        "ginf", "g30", "g16", "g10", "g4_ss1", "g4_ss2", "g4_ss3", "g0", "gm1", "gm2", "gm10",
    ]  # fmt: skip
    assert list_campaign_warnings(campaign) == []
    gaps = [run.bundle.profile.specimen.gap_mm for run in campaign.runs]
    changes = [before != gap for before, gap in zip([None, *gaps], gaps, strict=False)]
    assert [bool(run.prompt) for run in campaign.runs] == changes
    assert gaps == sorted(gaps, reverse=True)  # the screws are turned one way
    for run in campaign.runs:
        if run.bundle.profile.specimen.gap_mm < 0:
            assert "tare" in run.prompt.lower()
