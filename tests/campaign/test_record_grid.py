"""Records times gaps: the runs of a grid, their profiles, and what is refused."""

import hashlib
import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

from table_io.config.base import PROFILES_DIR, load_config
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.safety.preflight import check_limits, compute_demands
from tests.builders.rigs import read_model_text
from tests.campaign.campaigns import Players, make_options, prepare_campaign
from tests.input_errors import raises_input_error
from twin.campaign.command import run_campaign
from twin.campaign.config import CampaignPlan, list_campaign_warnings, read_plan
from twin.setup.run_config import RunConfig, from_texts

BASE = """
title = "base"
notes = "about the record of the base"
[specimen]
mass_kg = 550.0
gap_mm = 7.0
[excitation]
kind = "record"
file = "own.csv"
scale = 0.5
sha256 = "{checksum}"
blend_s = 0.5
band_hz = [0.4, 15.0]
windows = 3
[acquisition]
rate_hz = 1000.0
[loop_check]
enabled = false
"""
GRID = """
title = "Grid"
[records]
profile = "base.toml"
gaps_mm = [inf, 4.0, 0, -1.5]
band_hz = [0.5, 12.0]
[[records.files]]
file = "first.csv"
title = "First"
scale = 1.0
[[records.files]]
file = "second.txt"
label = "other"
notes = "turned around"
scale = -2.0
unit = "cm/s2"
step_s = 0.01
band_hz = [1.0, 10.0]
"""


def make_record(seed: int) -> str:
    """A decaying random acceleration of 4 s in cm/s2, as a csv file."""
    time = np.arange(400) * 0.01
    noise = np.random.default_rng(seed).normal(size=time.size)
    acceleration = 30.0 * noise * np.exp(-time)
    rows = [f"{t:.2f},{a:.4f}" for t, a in zip(time, acceleration, strict=True)]
    return "\n".join(["time_s,acc_cm_s2", *rows, ""])


def write_grid(folder: Path, grid: str = GRID, base: str = BASE) -> Path:
    """A campaign file with a base and two records next to it."""
    texts = {"own.csv": make_record(0), "first.csv": make_record(1)}
    lines = make_record(2).splitlines()[1:]
    texts["second.txt"] = "\n".join([*(line.split(",")[1] for line in lines), ""])
    for name, text in texts.items():
        (folder / name).write_text(text)
    checksum = hashlib.sha256(texts["own.csv"].encode()).hexdigest()
    (folder / "base.toml").write_text(base.replace("{checksum}", checksum))
    (folder / "c.toml").write_text(grid)
    return folder / "c.toml"


def plan(folder: Path, grid: str = GRID, base: str = BASE) -> CampaignPlan:
    return read_plan(write_grid(folder, grid, base), None, None, lambda *_: None)


def test_a_grid_is_played_gap_by_gap_and_asks_once_per_gap(tmp_path: Path) -> None:
    runs = plan(tmp_path).runs
    assert [run.name for run in runs] == [
        "01-ginf-first", "02-ginf-other", "03-g4-first", "04-g4-other",
        "05-g0-first", "06-g0-other", "07-gm1.5-first", "08-gm1.5-other",
    ]  # fmt: skip
    assert [bool(run.prompt) for run in runs] == [True, False] * 4
    assert "without force" in runs[4].prompt
    for index, words in ((0, "Free flight"), (2, "4 mm a total, 2 mm"), (6, "-1.5 mm a total")):
        assert words in runs[index].prompt
    assert [run.notes for run in runs[:2]] == ["", "turned around"]


def test_each_run_has_a_whole_profile_of_its_own(tmp_path: Path) -> None:
    campaign = plan(tmp_path)
    for run, (gap, name) in zip(
        campaign.runs,
        [(gap, name) for gap in (math.inf, 4.0, 0.0, -1.5) for name in ("first", "second")],
        strict=True,
    ):
        tables = tomllib.loads(run.bundle.profile_toml)
        excitation = tables["excitation"]
        file = "first.csv" if name == "first" else "second.txt"
        assert tables["specimen"] == {"mass_kg": 550.0, "gap_mm": gap}
        assert excitation.pop("files") == {file: (tmp_path / file).read_text()}
        expected = {"kind": "record", "file": file, "blend_s": 0.5, "windows": 3}
        if name == "first":
            expected |= {"scale": 1.0, "band_hz": [0.5, 12.0]}
        else:
            expected |= {"scale": -2.0, "band_hz": [1.0, 10.0], "unit": "cm/s2", "step_s": 0.01}
        assert excitation == expected  # nothing is left of the record of the base
        assert tables["acquisition"] == {"rate_hz": 1000.0}
        assert tables["loop_check"] == {"enabled": False}
        assert tables.get("notes") == (None if name == "first" else "turned around")
    titles = [run.bundle.profile.title for run in campaign.runs]
    assert titles[0] == "First at 1 of its level, without bumpers"
    assert len(set(titles)) == len(titles)


def test_the_texts_of_a_run_alone_give_the_run(tmp_path: Path) -> None:
    for run in plan(tmp_path).runs:
        bundle = run.bundle
        alone = from_texts(
            bundle.name, bundle.profile_toml, bundle.rig_toml, bundle.model_toml, "alone"
        )
        assert repr(alone.margins) == repr(bundle.margins)  # a record has no frequency: nan
        assert alone.profile == bundle.profile
        assert alone.parameters == bundle.parameters
        np.testing.assert_array_equal(alone.profile.plan.target_m, bundle.profile.plan.target_m)
        assert alone.drive.planned_end == bundle.drive.planned_end


def test_records_lie_next_to_the_base_too(tmp_path: Path) -> None:
    write_grid(tmp_path)
    (tmp_path / "mine").mkdir()
    path = tmp_path / "mine" / "c.toml"
    path.write_text(GRID.replace("base.toml", "../base.toml"))
    campaign = read_plan(path, None, None, lambda *_: None)
    assert len(campaign.runs) == 8
    (tmp_path / "mine" / "first.csv").write_text(make_record(5))  # the nearer one counts
    nearer = read_plan(path, None, None, lambda *_: None)
    assert nearer.runs[0].bundle.profile_toml != campaign.runs[0].bundle.profile_toml
    assert nearer.runs[1].bundle.profile_toml == campaign.runs[1].bundle.profile_toml


def test_listed_runs_come_before_the_grid(tmp_path: Path) -> None:
    extra = '[[runs]]\nprofile = "base.toml"\nprompt = "As it is"\n'
    campaign = plan(tmp_path, GRID + extra)
    assert [run.label for run in campaign.runs][:2] == ["base", "ginf-first"]
    assert campaign.config.tests == tuple(run.label for run in campaign.runs)
    assert campaign.runs[0].bundle.profile.specimen.gap_mm == 7.0
    assert list_campaign_warnings(campaign) == []


@pytest.mark.parametrize(
    ("old", "new", "fields"),
    [
        ('"first.csv"', '"frist.csv"', {"key": "file", "value": "frist.csv",
                                        "remedy": "first.csv"}),
        ("scale = 1.0", "scael = 1.0", {"key": "records.files.0.scael", "remedy": "scale"}),
        ("scale = 1.0\n", "", {"key": "records.files.0.scale", "problem": "missing"}),
        ("[inf, 4.0, 0", "[inf, 4.0, 4", {"key": "records.gaps_mm", "problem": "4"}),
        ("[inf, 4.0, 0", "[nan, 4.0, 0", {"key": "records.gaps_mm", "problem": "nan"}),
        ("[inf, 4.0, 0, -1.5]", "[]", {"key": "records.gaps_mm"}),
        ("gaps_mm", "gap_mm", {"key": "records.gap_mm", "remedy": "gaps_mm"}),
        ('label = "other"', 'label = "first"', {"key": "records.files", "problem": "first"}),
        ('label = "other"\nnotes = "turned around"\nscale = -2.0', 'title = "First"\nscale = 1.0',
         {"key": "records.files", "problem": "'First' and the scale 1"}),
        ('label = "other"', 'label = "a/b"', {"key": "records.files.1.label"}),
        ('"base.toml"', '"bas.toml"', {"where": "bas.toml", "remedy": "base.toml"}),
        ("step_s = 0.01", "step_s = 0.0", {"key": "records.files.1.step_s"}),
    ],
)  # fmt: skip
def test_bad_input_is_refused(
    tmp_path: Path, old: str, new: str, fields: dict[str, object]
) -> None:
    assert old in GRID
    with raises_input_error(**fields):
        plan(tmp_path, GRID.replace(old, new))


@pytest.mark.parametrize(
    ("old", "new", "key"),
    [
        (BASE[BASE.index("[excitation]") : BASE.index("[acquisition]")],
         "[sweep]\nstart_hz = 3.0\nstop_hz = 4.0\nstep_hz = 0.5\ncycles = 4\n"
         "acceleration_g = 0.05\n", "excitation.kind"),
        ("gap_mm = 7.0", "gap_mm = 7.0\ngap_right_mm = 3.0\ngap_left_mm = 4.0",
         "specimen.gap_right_mm"),
        ("blend_s = 0.5", 'blend_s = 0.5\ndrive = "first.csv"', "excitation.drive"),
    ],
    ids=["sweep", "measured-gaps", "drive"],
)  # fmt: skip
def test_a_base_that_cannot_be_one_is_refused(tmp_path: Path, old: str, new: str, key: str) -> None:
    assert old in BASE
    path = write_grid(tmp_path, base=BASE.replace(old, new))
    words = "one record" if key == "excitation.drive" else "[records]"
    with raises_input_error(key=key, problem=words):
        read_plan(path, None, None, lambda *_: None)


def test_a_rate_too_low_for_the_bumper_is_refused_at_any_gap(tmp_path: Path) -> None:
    model = read_model_text("snm")
    assert "bumper_stiffness_n_m = 510000.0" in model
    (tmp_path / "stiff.toml").write_text(model.replace("510000.0", "5.1e8"))
    path = write_grid(tmp_path, base=f'model = "stiff.toml"\n{BASE}')
    with raises_input_error(key="rate_hz", value=1000.0, problem="too low for the bumper"):
        read_plan(path, None, None, lambda *_: None)


def list_faults(error: InputError) -> list[InputError]:
    """The error and all faults in it, at any depth."""
    return [error, *(inner for fault in error.faults for inner in list_faults(fault))]


@pytest.mark.parametrize(
    ("file", "old", "new", "key"),
    [
        ("c.toml", "scale = 1.0", "scale = 1000.0", "displacement"),
        ("c.toml", 'title = "First"', f'sha256 = "{"0" * 64}"', "excitation.file"),
        ("c.toml", "band_hz = [0.5, 12.0]", "band_hz = [12.0, 0.5]", "excitation.band_hz"),
        ("base.toml", "blend_s = 0.5", "blend_s = -1.0", "excitation.blend_s"),
        ("base.toml", "windows = 3", "windows = 3\nwindow = 3", "excitation.window"),
    ],
    ids=["level", "checksum", "band", "base", "key-of-base"],
)
def test_a_fault_of_a_profile_is_named_by_its_key(
    tmp_path: Path, file: str, old: str, new: str, key: str
) -> None:
    path = write_grid(tmp_path)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        read_plan(path, None, None, lambda *_: None)
    assert key in [fault.key for fault in list_faults(error.value)]


def test_a_fault_of_a_record_is_listed_once_and_those_of_others_too(tmp_path: Path) -> None:
    grid = GRID.replace("scale = 1.0", "scale = 1000.0").replace("second.txt", "third.txt")
    with pytest.raises(InputError) as error:
        plan(tmp_path, grid)
    assert [fault.where for fault in error.value.faults] == ["records, first", "records, other"]


def test_a_label_of_the_grid_that_a_run_has_is_refused(tmp_path: Path) -> None:
    extra = '[[runs]]\nprofile = "base.toml"\nlabel = "g4-first"\n'
    with raises_input_error(key="label", value="g4-first"):
        plan(tmp_path, GRID + extra)


def test_a_grid_is_played_and_resumed_as_any_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare_campaign(tmp_path, monkeypatch)
    write_grid(tmp_path)
    Players.ends["g4-first"] = ("aborted", 0)
    assert run_campaign(make_options(tmp_path)) == 3
    assert [Path(config.folder).name for config in Players.given] == [
        "01-ginf-first", "02-ginf-other", "03-g4-first",
    ]  # fmt: skip
    set_up = [tomllib.loads(config.profile_toml)["set_up"] for config in Players.given]
    assert [entry["answer"] for entry in set_up] == ["unattended", "not asked", "unattended"]
    Players.given.clear()
    Players.ends.clear()
    assert run_campaign(make_options(tmp_path, resume=True)) == 0
    assert [Path(config.folder).name for config in Players.given][:2] == [
        "03-g4-first-2", "04-g4-other",
    ]  # fmt: skip
    with (tmp_path / "second.txt").open("a") as file:
        file.write("0.5\n")
    with raises_input_error(where=tmp_path / "out", problem="g4-other"):
        run_campaign(make_options(tmp_path, resume=True))


@pytest.fixture(scope="module")
def shipped_grid() -> CampaignPlan:
    return read_plan(PROFILES_DIR / "campaigns" / "records.toml", None, None, lambda *_: None)


def test_the_shipped_grid_is_seven_records_at_the_gaps_of_the_paper(
    shipped_grid: CampaignPlan,
) -> None:
    gaps = [math.inf, 30.0, 16.0, 10.0, 4.0, 0.0, -1.0, -2.0]
    names = ["el_centro", "erzincan", "chi_chi", "kobe", "newhall", "rinaldi", "sylmar"]
    played = [
        (run.bundle.profile.specimen.gap_mm, run.label.split("-", 1)[1])
        for run in shipped_grid.runs
    ]
    assert played == [(gap, name) for gap in gaps for name in names]
    assert [run.number for run in shipped_grid.runs if run.prompt] == [1, 8, 15, 22, 29, 36, 43, 50]
    assert list_campaign_warnings(shipped_grid) == []


def test_the_shipped_records_have_one_level_within_the_hydraulic_table(
    shipped_grid: CampaignPlan,
) -> None:
    rig, _ = load_config(PROFILES_DIR / "rigs" / "hydraulic.toml", RigConfig, "rig file")
    strokes = []
    for run in shipped_grid.runs[:7]:
        bundle: RunConfig = run.bundle
        target = bundle.profile.plan.target_m
        level = np.abs(np.diff(target, 2)).max() * 2000.0**2 / 9.80665
        assert level == pytest.approx(0.12, rel=0.005), run.label
        strokes.append(float(np.abs(target).max()))
        demands = compute_demands(bundle.drive, bundle.profile, rig)
        check_limits(demands, bundle.profile, rig, run.label)
    assert 0.054 < max(strokes) < 0.06  # a larger level would not fit


@pytest.mark.parametrize(
    "path", sorted((PROFILES_DIR / "tests").glob("*.csv")), ids=lambda p: p.stem
)
def test_a_shipped_acceleration_has_the_peak_that_its_header_states(path: Path) -> None:
    lines = path.read_text().splitlines()
    if "time_s,acc_cm_s2" not in lines:
        pytest.skip("a displacement")
    header = " ".join(line.removeprefix("# ") for line in lines if line.startswith("#"))
    rows = np.loadtxt(lines[lines.index("time_s,acc_cm_s2") + 1 :], delimiter=",")
    peak = np.abs(rows[:, 1]).max()
    at_s = rows[np.abs(rows[:, 1]).argmax(), 0]
    assert f"Peak {peak:.4g} cm/s2 ({peak / 980.665:.3f} g) at {at_s:g} s" in header
    np.testing.assert_allclose(np.diff(rows[:, 0]), 0.005, atol=1e-9)
    for words in ("https://github.com/", "Apache License 2.0", "SHA-256", "Changed:"):
        assert words in header
