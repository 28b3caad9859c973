"""`simulate` with several models and gaps: what it computes, leaves, draws and refuses."""

import csv
import json
import math
import re
import signal
import subprocess
import sys
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from table_io.config.base import load_config
from table_io.config.profile import Profile
from tests.builders.profiles import format_test
from tests.input_errors import raises_input_error
from twin.inspection.folder_report import write_folder_report
from twin.laws.effect import Effect, EffectParameter
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model
from twin.setup.run_config import read_model
from twin.simulation.command import simulate_profile
from twin.studies import figures
from twin.studies.batch import parse_gaps_mm
from twin.studies.result import COLUMNS, SweepSummary, read_batch_rows
from twin.system.exit_codes import EXIT_INTERRUPTED

pytestmark = pytest.mark.usefixtures("forget_entry_points")

SHAKETWIN = str(Path(sys.executable).parent / "shaketwin")
TEST = format_test(2.4, 4.4, 0.2, cycles=5)
EFFECT = '[[effects]]\nid = "{}"\nparameters = {{ {} }}\n'
HARDENING = EFFECT.format("bumper_hardening", "k2 = 6e7")


@pytest.fixture
def profile(tmp_path: Path) -> Path:
    path = tmp_path / "through.toml"
    path.write_text(TEST)
    return path


def model(folder: Path, name: str, effects: str = "", **changed: float) -> str:
    """A model card beside the paper's: other numbers, effects on top."""
    text = read_model("snm")[1] + effects
    for key, value in changed.items():
        text = re.sub(rf"{key} = .*", f"{key} = {value}", text)
    path = folder / f"{name}.toml"
    path.write_text(text)
    return str(path)


def simulate_batch(
    profile: Path, models: list[str], gaps: list[str], workers: int | None = None
) -> Path:
    """The folder of a batch."""
    out = profile.parent / "out"
    assert simulate_profile(profile, models, gaps, workers, out, False) == 0
    return out


def summary(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "summary.json").read_text())


def read_rows(path: Path) -> list[dict[str, Any]]:
    """The rows of a batch, in whose columns some are texts and the others numbers."""
    return list(map(dict[str, Any], read_batch_rows(path)))


def whole(profile: Path, name: str) -> Model:
    return read_model(name)[0].build_model(load_config(profile, Profile, "test")[0].specimen)


@pytest.mark.parametrize(
    ("words", "gaps"),
    [
        (["4"], [4.0]),
        (["30", "-2", "inf"], [30.0, -2.0, math.inf]),
        (["0:6:2"], [0.0, 2.0, 4.0, 6.0]),
        (["1:-1:-1", "8"], [1.0, 0.0, -1.0, 8.0]),
        (["0:0.3:0.1"], [0.0, 0.1, 0.2, 0.3]),
        (["5:5:1"], [5.0]),
    ],
)
def test_gaps_are_read_as_they_are_written(words: list[str], gaps: list[float]) -> None:
    assert parse_gaps_mm(words) == gaps


@pytest.mark.parametrize(
    ("words", "fields"),
    [
        (["4 m"], {"allowed": "FROM:TO:STEP"}),
        ([""], {"allowed": "FROM:TO:STEP"}),
        (["nan"], {"allowed": "FROM:TO:STEP"}),
        (["-inf"], {"allowed": "FROM:TO:STEP"}),
        (["0:30"], {"allowed": "FROM:TO:STEP"}),
        (["0:inf:2"], {"allowed": "FROM:TO:STEP"}),
        (["0:30:7"], {"problem": "step 7 ", "remedy": "7.5"}),
        (["0:30:-2"], {"problem": "step -2 "}),
        (["0:30:0"], {"problem": "step 0 "}),
        (["0:30:1e-9"], {"problem": "10000"}),
        (["4", "0:8:2"], {"problem": "--gap 4"}),
        (["inf", "inf"], {"problem": "--gap inf"}),
    ],
)
def test_a_gap_that_is_none_is_refused(words: list[str], fields: dict[str, str]) -> None:
    with raises_input_error(where=f"--gap {words[-1]}", **fields):
        parse_gaps_mm(words)


def test_the_table_holds_the_motion_of_every_case(profile: Path) -> None:
    hard = model(profile.parent, "hard", HARDENING)
    out = simulate_batch(profile, ["snm", hard], ["4", "-1", "inf"])
    rows = read_rows(out / "batch.csv")
    assert (out / "batch.csv").read_text().splitlines()[0] == ",".join(COLUMNS)
    assert len(rows) == 2 * 3 * 22
    sweep = load_config(profile, Profile, "test")[0].sweep
    for name, label in (("snm", "snm"), (hard, "hard")):
        for gap in (4.0, -1.0, math.inf):
            base = replace(whole(profile, name).base, gap_r=gap / 2e3, gap_l=gap / 2e3)
            own = Model(base, whole(profile, name).effects)
            hz = [step.frequency_hz for step in sweep.steps]
            played = simulate_sweep(own, hz, 0.05 * 9.80665, 5)
            mine = [row for row in rows if (row["model"], row["gap_mm"]) == (label, gap)]
            assert [row["frequency_hz"] for row in mine] == hz
            assert [row["direction"] for row in mine] == ["forward"] * 11 + ["backward"] * 11
            size = (played.column("u_max") - played.column("u_min"))[:, -2:].mean(axis=1)
            eta = [row["eta_d"] for row in mine]
            np.testing.assert_allclose(eta, size / 2 / 30.5371e-3, rtol=2e-5)
            force = played.column("f_r_max")[:, -2:].mean(axis=1)
            np.testing.assert_allclose([row["r_r"] for row in mine], force / 550 / 9.80665)
            hits = played.column("onsets_l")[:, -2:].mean(axis=1)
            assert [row["impacts_left"] for row in mine] == hits.tolist()
            if math.isinf(gap):
                assert all(row["eta_r"] == row["r_l"] == 0 for row in mine)
            else:
                depth = played.column("u_max")[:, -2:] - gap / 2e3
                depth = np.where(played.column("f_r_max")[:, -2:] > 0, depth, 0).mean(axis=1)
                np.testing.assert_allclose([row["eta_r"] for row in mine], depth / 30.5371e-3,
                                           rtol=2e-5, atol=1e-12)  # fmt: skip


def test_the_summary_tells_jumps_and_hysteresis_of_each_case(profile: Path) -> None:
    values = summary(simulate_batch(profile, [], ["4", "inf"]))
    assert values["verdict"] == "complete"
    g4, free = values["cases"]
    assert (g4["model"], g4["gap_mm"], free["gap_mm"]) == ("snm", 4.0, "inf")
    assert [interval["kind"] for interval in g4["hysteresis"]] == ["right"]
    assert [(jump["direction"], jump["kind"]) for jump in g4["jumps"]] == [
        ("forward", "down"), ("backward", "up"),
    ]  # fmt: skip
    assert g4["peak"]["frequency_hz"] == 4.0
    assert free["hysteresis"] == free["jumps"] == []
    assert g4["u_star_m"] == pytest.approx(30.537e-3, abs=1e-6)


def test_models_without_a_gap_keep_the_gaps_of_the_profile(profile: Path) -> None:
    profile.write_text(
        TEST.replace("gap_mm = 4.0", "gap_mm = 4.0\ngap_right_mm = 1.0\ngap_left_mm = 2.5")
    )
    soft = model(profile.parent, "soft", stiffness_n_m=30e3)
    rows = read_rows(simulate_batch(profile, ["snm", soft], []) / "batch.csv")
    assert {row["gap_mm"] for row in rows} == {3.5}
    mine = [row for row in rows if row["model"] == "snm" and row["r_l"] > 0]
    sweep = load_config(profile, Profile, "test")[0].sweep
    hz = [step.frequency_hz for step in sweep.steps]
    played = simulate_sweep(whole(profile, "snm"), hz, 0.05 * 9.80665, 5)
    force = -played.column("f_l_min")[:, -2:].mean(axis=1)
    np.testing.assert_allclose([r["r_l"] for r in mine], force[force > 0] / 550 / 9.80665)


def test_a_drifting_gap_is_the_one_of_its_time(profile: Path) -> None:
    drift = model(profile.parent, "drift", EFFECT.format("gap_drift", "rate = 1e-5"))
    rows = read_rows(simulate_batch(profile, [drift], ["4"]) / "batch.csv")
    deep = {row["frequency_hz"]: row for row in rows if row["direction"] == "forward"}[3.4]
    # 510 kN/m on this deformation, and little from the dashpot, is this force
    force = 510e3 * deep["eta_r"] * 30.5371e-3 / 550 / 9.80665
    assert deep["r_r"] == pytest.approx(force, rel=0.005)


def test_a_plug_in_effect_is_played_like_any_other(
    profile: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    number = EffectParameter("k3", "N/m3", 0.0, 1e10, 0.0, 1e6, "")
    cubic = Effect("my_cubic", (number,), term="k3 u^3", force="k3 * u * u * u")

    @dataclass
    class Entry:
        name: str = "mine"
        value: str = "mine:CUBIC"

        def load(self) -> Effect:
            return cubic

    monkeypatch.setattr(metadata, "entry_points", lambda group: [Entry()])
    mine = model(profile.parent, "mine", EFFECT.format("my_cubic", "k3 = 5e6"))
    ours = model(profile.parent, "ours", EFFECT.format("cubic_stiffness", "k3 = 5e6"))
    rows = read_rows(simulate_batch(profile, [mine, ours], []) / "batch.csv")
    eta = {name: [r["eta_d"] for r in rows if r["model"] == name] for name in ("mine", "ours")}
    np.testing.assert_allclose(eta["mine"], eta["ours"], rtol=1e-9)


def test_a_motion_without_bound_is_said_and_drawn(profile: Path) -> None:
    soft = model(
        profile.parent, "soft", EFFECT.format("cubic_stiffness", "k3 = -3e7"), damping_n_s_m=50.0
    )
    profile.write_text(TEST.replace("start_hz = 2.4", "start_hz = 1.0"))
    out = simulate_batch(profile, [soft], ["inf"])
    (case,) = summary(out)["cases"]
    assert case["unbounded_from"]["direction"] == "forward"
    assert "unbounded from" in (out / "report.html").read_text()


def test_workers_change_nothing(profile: Path) -> None:
    tables = []
    for cores in (1, 2):
        folder = profile.parent / f"{cores}"
        folder.mkdir()
        own = folder / "through.toml"
        own.write_text(TEST)
        tables.append((simulate_batch(own, [], ["0:8:2"], cores) / "batch.csv").read_bytes())
    assert tables[0] == tables[1]


def test_one_model_at_its_gap_is_a_run_as_ever(profile: Path) -> None:
    out = profile.parent / "out"
    assert simulate_profile(profile, ["snm"], [], 1, out, False) == 0
    assert (out / "run.mcap").exists()
    assert not (out / "batch.csv").exists()


def require_refused(
    profile: Path, models: list[str], gaps: list[str], fields: dict[str, object], **more: Any
) -> None:
    out = profile.parent / "out"
    with raises_input_error(**fields):
        simulate_profile(profile, models, gaps, more.get("workers"), out, bool(more.get("view")))
    assert not out.exists()


def test_a_batch_that_cannot_be_is_refused_before_it_begins(profile: Path) -> None:
    require_refused(profile, ["snm", "snn"], [], {"where": "--model snn", "remedy": "'snm'"})
    require_refused(profile, ["snm", "snm"], ["4"], {"where": "--model snm"})
    same = model(profile.parent, "same")
    require_refused(
        profile, ["snm", same], ["4", "6"], {"where": profile, "problem": "snm and same"}
    )
    hard = model(profile.parent, "hard", bumper_stiffness_n_m=5e9)
    case = f"{profile}: hard, G = 4 mm"
    require_refused(
        profile, ["snm", hard], ["4"], {"where": case, "key": "rate_hz", "value": 2000.0}
    )
    require_refused(profile, [], ["4"], {"key": "--workers", "value": 0}, workers=0)
    require_refused(profile, [], ["4"], {"where": "--view"}, view=True)
    undamped = model(profile.parent, "undamped", damping_n_s_m=0.0)
    case = f"{profile}: undamped, no bumpers"
    require_refused(profile, [undamped], ["inf"], {"where": case, "key": "damping", "value": 0})


def test_ctrl_c_keeps_the_sweeps_that_are_done(tmp_path: Path) -> None:
    profile = tmp_path / "long.toml"
    profile.write_text(TEST.replace("cycles = 5", "cycles = 60", 1))
    hard = model(tmp_path, "hard", HARDENING)
    words = ["simulate", profile, "--model", hard, "--gap", "1:60:1", "--out", tmp_path / "out"]
    process = subprocess.Popen(
        [SHAKETWIN, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    for line in process.stdout:
        if "2/60" in line:
            break
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate()
    assert process.returncode == EXIT_INTERRUPTED, output
    assert "stopping" in output
    values = summary(tmp_path / "out")
    assert values["verdict"] == "stopped"
    assert 2 <= len(values["cases"]) < 60
    rows = read_rows(tmp_path / "out" / "batch.csv")
    assert len(rows) == 22 * len(values["cases"])
    assert (tmp_path / "out" / "report.html").exists()


def test_the_pictures_name_what_is_in_them(profile: Path) -> None:
    hard = model(profile.parent, "hard", HARDENING)
    out = simulate_batch(profile, ["snm", hard], ["4", "0", "-1", "inf"])
    names = sorted(path.stem for path in (out / "figures").glob("*.png"))
    assert names == [
        "gaps_hard", "gaps_snm", "models_g-1", "models_g0", "models_g4", "models_ginf",
        "prc_hard", "prc_snm",
    ]  # fmt: skip
    cases = figures.group_cases(read_batch_rows(out / "batch.csv"))
    own = {gap: curves for (label, gap), curves in cases.items() if label == "snm"}
    family = figures.draw_family("snm", own).figure
    assert isinstance(family, Figure)
    words = [text.get_text() for text in family.legends[0].get_texts()]
    assert words == ["no bumpers", "G = 4 mm", "G = 0 mm", "G = −1 mm", "forward", "backward"]
    for ax in family.axes:
        assert ax.get_ylabel()
        drawn = [line for line in ax.lines if np.size(line.get_xdata()) == 11]
        assert {line.get_linestyle() for line in drawn} == {"-", "--"}
    top = max(float(np.max(np.asarray(line.get_ydata()))) for line in family.axes[1].lines)
    assert top < family.axes[1].get_ylim()[1] < 1.3 * top
    beside = figures.draw_models(4.0, {label: case for (label, gap), case in cases.items()
                                       if gap == 4.0}).figure  # fmt: skip
    assert isinstance(beside, Figure)
    words = [text.get_text() for text in beside.legends[0].get_texts()]
    assert words == ["snm", "hard", "forward", "backward"]
    (gaps,) = figures.draw_gap_figure(
        "snm",
        [case for case in SweepSummary.read(out / "summary.json", "").cases if case.model == "snm"],
    )
    assert isinstance(gaps.figure, Figure)
    assert all(ax.get_ylabel() for ax in gaps.figure.axes)


def test_many_gaps_are_read_off_a_scale(profile: Path) -> None:
    cases = figures.group_cases(
        read_batch_rows(simulate_batch(profile, [], ["0:20:2"]) / "batch.csv")
    )
    family = figures.draw_family("snm", {gap: curves for (_, gap), curves in cases.items()}).figure
    assert isinstance(family, Figure)
    assert family.axes[-1].get_ylabel() == "total gap in mm"
    colours = {line.get_color() for line in family.axes[0].lines}
    assert len(colours) == 11


def test_the_page_is_written_anew_from_what_is_in_the_folder(profile: Path) -> None:
    out = simulate_batch(profile, [], ["4", "6", "8"])
    html = (out / "report.html").read_text()
    assert html.count("data:image/png;base64,") == len(list((out / "figures").iterdir())) == 2
    assert not re.search(r"(?:src|href)=[\"'](?!data:)", html)
    assert "G = 6 mm" in html
    before = (out / "batch.csv").read_bytes(), (out / "summary.json").read_bytes()
    (out / "report.html").unlink()
    write_folder_report(out)
    assert (out / "report.html").read_text() == html
    assert ((out / "batch.csv").read_bytes(), (out / "summary.json").read_bytes()) == before
    (out / "batch.csv").write_text("a,b\n1,2\n")
    with raises_input_error(where=out / "batch.csv"):
        write_folder_report(out)


def test_files_of_models_with_odd_names_do_not_meet(tmp_path: Path) -> None:
    first, other = tmp_path / "a", tmp_path / "b"
    for folder in (first, other):
        folder.mkdir()
    cards = [model(first, "soft", stiffness_n_m=30e3), model(other, "soft", stiffness_n_m=33e3)]
    (tmp_path / "through.toml").write_text(TEST)
    out = simulate_batch(tmp_path / "through.toml", cards, ["4", "6"])
    with (out / "batch.csv").open() as file:
        labels = {row["model"] for row in csv.DictReader(file)}
    assert labels == {card.removesuffix(".toml") for card in cards}
    assert len(list((out / "figures").iterdir())) == 4
