"""Tare with the bumpers clear, on a simulated rig whose tare is that of a real table.

The rig loads its cells by pressed bumpers in a tare too. Truth: the static equilibrium and the PRCs
of the same specimen on the rig that answers as if the bumpers were clear.
"""

import re
from datetime import timedelta
from pathlib import Path

import numpy as np
import pytest

from table_io.clock import local_datetime
from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.rig_file import tares_dir
from table_io.config.tare import TareFile
from table_io.errors import InputError
from tests.command_line import call_main
from twin.api import TareOptions, check_test, run_simulated, tare
from twin.campaign.config import CampaignPlan, read_plan
from twin.campaign.state import OperatorAnswer, begin_campaign, require_unchanged
from twin.results.contracts import RunSummary
from twin.setup.run_config import read_run_config

RIG_TEXT = (PROFILES_DIR / "rigs" / "simulated.toml").read_text(encoding="utf-8")
REAL_RIG = RIG_TEXT.replace('name = "simulated"', 'name = "real"').replace(
    "[simulated]\n", "[simulated]\ntares_as_set_up = true\n"
)


@pytest.fixture
def rig_file(tmp_path: Path) -> Path:
    path = tmp_path / "real.toml"
    path.write_text(REAL_RIG, encoding="utf-8")
    return path


def write_test(folder: Path, gap_mm: float) -> Path:
    path = folder / f"g{gap_mm:g}.toml"
    path.write_text(
        f'title = "G"\nrig = "real.toml"\nmodel = "snm"\n[specimen]\nmass_kg = 550.0\n'
        f"gap_mm = {gap_mm}\n[sweep]\nstart_hz = 1.0\nstop_hz = 3.0\nstep_hz = 1.0\n"
        'directions = ["forward"]\nacceleration_g = 0.05\ncycles = 10\nmeasured_cycles = 4\n',
        encoding="utf-8",
    )
    return path


def play(test: Path, folder: Path, rig: Path) -> RunSummary:
    run_simulated(test, folder, table=rig)
    return RunSummary.read(folder / "summary.json", "")


def take_tare(rig_file: Path) -> Path:
    asked: list[str] = []
    tared = tare(TareOptions(str(rig_file), 21.5), asked.append)
    assert len(asked) == 1
    assert "clear of the mass" in asked[0]
    return tared.path


@pytest.mark.parametrize("gap_mm", [0.0, -1.0, -10.0])
def test_run_with_pressed_bumpers_is_refused_without_a_valid_tare(
    rig_file: Path, gap_mm: float
) -> None:
    test = write_test(rig_file.parent, gap_mm)
    with pytest.raises(InputError, match="no tare with its bumpers clear") as caught:
        check_test(test)
    assert "shaketwin tare" in caught.value.remedy
    take_tare(rig_file)
    check_test(test)
    assert read_run_config(write_test(rig_file.parent, 4.0)).rig.tare is not None


def test_clear_bumpers_need_no_tare_and_neither_does_a_rig_that_knows_the_truth(
    rig_file: Path,
) -> None:
    check_test(write_test(rig_file.parent, 4.0))
    assert read_run_config(Path("gm1")).rig.tare is None


@pytest.mark.parametrize(
    "change, problem",
    [
        ("age", "h old"),
        ("future", "h old"),
        ("channel", "lacks force_l2_n"),
    ],
)
def test_tare_that_is_not_valid_is_refused(rig_file: Path, change: str, problem: str) -> None:
    path = take_tare(rig_file)
    record = load_config(path, TareFile, "tare")[0].tare
    text = path.read_text(encoding="utf-8")
    hours = {"age": -200.0, "future": 30.0}.get(change)
    if hours is not None:
        at = (local_datetime() + timedelta(hours=hours)).isoformat(timespec="seconds")
        text = text.replace(record.at, at)
    else:
        keep = len(record.channels) - 1
        assert record.channels[keep] == "force_l2_n"
        for key in ("channels", "volts", "noise_v"):
            text = re.sub(rf"^({key} = \[.*), [^,\]]*\]$", r"\1]", text, flags=re.M)
    path.write_text(re.sub(r"^sha256.*\n", "", text, flags=re.M), encoding="utf-8")
    with pytest.raises(InputError, match=problem):
        check_test(write_test(rig_file.parent, -1.0))


def test_altered_tare_is_noticed_at_every_digit(rig_file: Path) -> None:
    path = take_tare(rig_file)
    text = path.read_text(encoding="utf-8")
    digits = [match.start() for match in re.finditer(r"\d", text)]
    test = write_test(rig_file.parent, -1.0)
    for position in np.random.default_rng(1).choice(digits, 40, replace=False):
        digit = str((int(text[position]) + 3) % 10)
        path.write_text(text[:position] + digit + text[position + 1 :], encoding="utf-8")
        with pytest.raises(InputError):
            check_test(test)
    path.write_text(text, encoding="utf-8")
    check_test(test)


@pytest.mark.slow  # 20 s
@pytest.mark.parametrize("gap_mm", [-1.0, -2.0, -10.0])
def test_preload_is_measured_with_a_tare_as_the_rig_that_knows_it_measures_it(
    rig_file: Path, gap_mm: float, tmp_path: Path
) -> None:
    take_tare(rig_file)
    test = write_test(rig_file.parent, gap_mm)
    (rig_file.parent / "truth.toml").write_text(RIG_TEXT, encoding="utf-8")
    folders = [tmp_path / name for name in ("measured", "truth")]
    measured, true = (
        play(test, folder, rig_file.parent / rig)
        for folder, rig in zip(folders, ("real.toml", "truth.toml"), strict=True)
    )
    assert measured.verdict == "complete"
    for step, expected in zip(measured.steps, true.steps, strict=True):
        assert step.measured is not None
        assert expected.measured is not None
        for name in ("eta_r", "eta_l", "r_r", "r_l"):
            value, truth = getattr(step.measured, name), getattr(expected.measured, name)
            assert value == pytest.approx(truth, rel=0.02, abs=1e-3), name
        assert step.measured.impacts_right == expected.measured.impacts_right
        assert step.measured.impacts_left == expected.measured.impacts_left


def test_preload_that_the_tare_has_swallowed_ends_the_test_in_the_loop_check(
    rig_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The operator tares although the bumpers press: the cells then show nothing."""
    from twin.rig import tare as tare_module

    pressed = read_run_config(Path("gm1"))

    def make_pressed(rig: object, clock: object) -> object:
        from table_io.backends import open_backend

        return open_backend(rig, pressed.profile, clock)  # type: ignore[arg-type]

    monkeypatch.setattr(tare_module, "make_machine", make_pressed)
    take_tare(rig_file)
    summary = play(write_test(rig_file.parent, -1.0), tmp_path / "run", rig_file)
    assert summary.verdict == "aborted"
    assert "preload of the right bumper" in summary.reason
    assert "shaketwin tare" in summary.reason


def test_tare_command_prints_each_sensor_and_refuses_a_rig_that_is_shipped(
    rig_file: Path,
) -> None:
    result = call_main("tare", "--table", rig_file, "--yes")
    assert result.returncode == 0
    assert "force_r1_n" in result.stdout
    assert f"{rig_file.stem}.tares" in result.stdout.replace("\n", "")
    shipped = call_main("tare", "--table", "simulated", "--yes")
    assert shipped.returncode == 2
    assert "comes with shaketwin" in shipped.stderr


def test_campaign_refuses_without_a_tare_and_each_run_takes_the_newest(rig_file: Path) -> None:
    """A tare at the prompt before a run is in the configuration of its recording."""
    folder = rig_file.parent
    write_test(folder, -1.0)
    campaign = folder / "campaign.toml"
    campaign.write_text('title = "C"\n[[runs]]\nprofile = "g-1.toml"\n', encoding="utf-8")

    def read() -> CampaignPlan:
        return read_plan(campaign, None, None, lambda bundle, path: None)

    with pytest.raises(InputError, match="no tare with its bumpers clear"):
        read()
    take_tare(rig_file)
    plan = read()
    (folder / "runs").mkdir()
    active = begin_campaign(folder / "runs", plan)
    later = tare(
        TareOptions(str(rig_file), 23.5, tares_dir(rig_file) / "later.toml"), lambda _: None
    )
    text = later.path.read_text(encoding="utf-8")
    at = (local_datetime() + timedelta(minutes=2)).isoformat(timespec="seconds")
    text = re.sub(r"^sha256.*\n", "", text.replace(later.record.at, at), flags=re.M)
    later.path.write_text(text, encoding="utf-8")
    answer = OperatorAnswer(asked="", answer="done", who="", at="")
    config = active.begin_recording(plan.runs[0], answer, "")
    assert f'at = "{at}"' in config.rig_toml
    assert config.rig_toml.count("[tare]") == 1
    assert require_unchanged(folder / "runs", read())  # a warning, no refusal
