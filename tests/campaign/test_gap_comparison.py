"""Which gap is best: recovered where it was planted, and equal to what the recordings hold."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from table_io.block import Label
from table_io.config.base import PROFILES_DIR
from table_io.config.profile import Profile
from tests.builders.blocks import select_blocks
from tests.campaign.campaigns import write
from tests.campaign.test_record_grid import BASE, make_record, write_grid
from tests.input_errors import raises_input_error
from twin.campaign import gap_comparison, simulate_grid
from twin.campaign.command import CampaignOptions, run_campaign
from twin.campaign.config import find_campaign, read_plan
from twin.campaign.figures import draw_gap_figures, spread_labels
from twin.campaign.gap_comparison import (
    CRITERIA,
    GapComparison,
    RecordRun,
    compare_gaps,
    describe_comparison,
    format_best,
    format_gap,
    list_record_runs,
    rank_gaps,
)
from twin.campaign.messages import print_gap_comparison
from twin.campaign.report import LARGER, SMALLER, SYMBOLS, list_gap_tables
from twin.campaign.result import GapResult, MergedRun
from twin.campaign.state import RunPart
from twin.campaign.summary import read_campaign
from twin.drawing.page import render_page
from twin.recording.reader import read_recording
from twin.results.contracts import MotionResult, PeakAndRms, RunInfo, RunSummary, WindowResult
from twin.setup.run_config import RunConfig
from twin.simulation.command import simulate_profile

WEIGHT_N = 550.0 * 9.80665
GAPS = (math.inf, 16.0, 4.0, 0.0)
# Peaks of u in m, a in m/s2 and force in N of two records without bumpers and at 16, 4 and 0 mm.
PLANTED = {
    "long": [(0.04, 2.0, 0.0), (0.03, 5.0, 4000.0), (0.02, 1.5, 900.0), (0.01, 1.8, 1100.0)],
    "short": [(0.02, 3.0, 0.0), (0.016, 6.0, 3000.0), (0.006, 2.4, 1300.0), (0.004, 3.6, 800.0)],
    "third": [(0.10, 4.0, 0.0), (0.05, 8.0, 5000.0), (0.03, 3.6, 700.0), (0.02, 3.2, 1000.0)],
}


def make_motion(u: float, a: float, force: float) -> MotionResult:
    peaks = {"u": u, "a": a, "force_r": 0.4 * force, "force_l": force}
    return MotionResult(
        **{name: PeakAndRms(peak=peak, rms=peak / 3) for name, peak in peaks.items()},
        impacts_right=1,
        impacts_left=2,
    )


def make_summary(u: float, a: float, force: float, twin: float = 1.0) -> RunSummary:
    """Of three windows, the second of which has the peaks; the twin's are larger by a factor."""
    windows = [
        WindowResult(
            index=index,
            from_s=0.0,
            to_s=1.0,
            measured=make_motion(k * u, k * a, k * force),
            twin=make_motion(*(k * twin * peak for peak in (u, a, force))),
        )
        for index, k in enumerate((0.5, 1.0, 0.2))
    ]
    return RunSummary(run=RunInfo(), verdict="complete", steps=[], windows=windows)


def make_runs() -> list[RecordRun]:
    return [
        RecordRun(name, name, gap_mm, 550.0, f"{name}-{gap_mm}", make_summary(*peaks, twin=1.1))
        for name, rows in PLANTED.items()
        for gap_mm, peaks in zip(GAPS, rows, strict=True)
    ]


def compare(runs: list[RecordRun]) -> GapComparison:
    comparison = compare_gaps(runs)
    assert comparison is not None
    return comparison


def test_the_planted_best_gap_is_recovered_for_each_criterion() -> None:
    comparison = compare(make_runs())
    assert comparison.gaps_mm == GAPS
    best = {name: rank_gaps(comparison, "measured", name) for name in CRITERIA}
    acceleration = best["eta_a"]
    assert acceleration is not None
    # eta_a at 16, 4, 0 mm: 2.5, 0.75, 0.9; 2, 0.8, 1.2; 2, 0.9, 0.8
    assert (acceleration.gap_mm, acceleration.next_gap_mm) == (4.0, 0.0)
    assert (acceleration.best_in, acceleration.of) == (2, 3)
    assert acceleration.median == pytest.approx(0.8)
    assert acceleration.next_median == pytest.approx(0.9)
    assert acceleration.margin == pytest.approx(0.9 / 0.8 - 1)
    assert not acceleration.is_smallest_gap
    displacement, force = best["eta_d"], best["r"]
    assert displacement is not None
    assert force is not None
    # eta_d at 4 and 0 mm: 0.5, 0.25; 0.3, 0.2; 0.3, 0.2
    assert (displacement.gap_mm, displacement.best_in) == (0.0, 3)
    assert (displacement.median, displacement.next_median) == pytest.approx((0.2, 0.3))
    assert displacement.is_smallest_gap
    # force at 4 and 0 mm: 900, 1100; 1300, 800; 700, 1000
    assert (force.gap_mm, force.best_in) == (4.0, 2)
    assert force.median == pytest.approx(900.0 / WEIGHT_N)
    assert force.compared_gaps_mm == [16.0, 4.0, 0.0]  # there is none without bumpers


def test_the_compromise_is_the_root_mean_square_of_both() -> None:
    values = compare(make_runs()).values
    eta_a, eta_d = values["measured", "eta_a"], values["measured", "eta_d"]
    expected = np.sqrt((eta_a**2 + eta_d**2) / 2)
    np.testing.assert_allclose(values["measured", "compromise"], expected)
    np.testing.assert_allclose(values["measured", "compromise"][:, 0], 1.0)
    assert expected[0, 2] == pytest.approx(math.sqrt((0.75**2 + 0.5**2) / 2))


def test_the_twin_is_divided_by_its_own_reference() -> None:
    values = compare(make_runs()).values
    np.testing.assert_allclose(values["twin", "u_m"], 1.1 * values["measured", "u_m"])
    np.testing.assert_allclose(values["twin", "eta_d"], values["measured", "eta_d"])


def test_without_bumpers_can_be_the_best() -> None:
    runs = [run for run in make_runs() if run.gap_mm in (math.inf, 16.0)]
    comparison = compare(runs)
    best = rank_gaps(comparison, "measured", "eta_a")
    assert best is not None
    assert best.gap_mm == math.inf
    assert rank_gaps(comparison, "measured", "r") is None  # a single gap has a force
    assert "not ranked" in format_best(None)


def test_a_gap_at_which_a_record_is_missing_is_not_ranked() -> None:
    runs = [run for run in make_runs() if (run.record, run.gap_mm) != ("third", 4.0)]
    best = rank_gaps(compare(runs), "measured", "eta_a")
    assert best is not None
    assert best.compared_gaps_mm == [math.inf, 16.0, 0.0]
    assert best.gap_mm == 0.0
    spread = describe_comparison(compare(runs)).gaps[2].measured["eta_a"]
    assert (spread.count, spread.smallest) == (2, pytest.approx(0.75))


def test_repetitions_count_with_their_mean() -> None:
    runs = [
        *make_runs(),
        RecordRun("long", "long", 4.0, 550.0, "rep2", make_summary(0.01, 2.5, 0.0)),
    ]
    values = compare(runs).values
    assert values["measured", "u_m"][0, 2] == pytest.approx(0.015)
    assert values["measured", "eta_a"][0, 2] == pytest.approx(1.0)


def test_different_motions_of_one_name_are_no_repetitions() -> None:
    other = RecordRun("filtered", "long", 4.0, 550.0, "other", make_summary(0.01, 2.5, 0.0))
    at_reference = replace(other, gap_mm=math.inf)
    comparison = compare([*make_runs(), at_reference, other])
    assert comparison.records == (*PLANTED, "long")
    assert comparison.values["measured", "u_m"][0, 2] == pytest.approx(0.02)
    assert comparison.values["measured", "eta_d"][3, 2] == pytest.approx(1.0)


def test_a_record_without_its_reference_is_left_out() -> None:
    runs = [run for run in make_runs() if (run.record, run.gap_mm) != ("short", math.inf)]
    assert compare(runs).records == ("long", "third")
    assert compare_gaps([run for run in runs if run.record == "short"][:1]) is None
    assert compare_gaps([run for run in make_runs() if run.gap_mm == 4.0]) is None
    assert compare_gaps([]) is None


def test_without_a_free_flight_the_widest_gap_is_the_reference() -> None:
    comparison = compare([run for run in make_runs() if run.gap_mm != math.inf])
    assert comparison.reference == "at G16"
    np.testing.assert_array_equal(comparison.values["measured", "eta_a"][:, 0], 1.0)
    assert comparison.values["measured", "eta_d"][0, 1] == pytest.approx(0.02 / 0.03)


def test_a_run_with_dropouts_is_left_out_and_named(capsys: pytest.CaptureFixture[str]) -> None:
    runs = make_runs()
    runs[2].summary.gaps = 3  # of "long" at 4 mm
    # Dropouts of a recording that was repeated do not count.
    parts = [
        RunPart(folder=name, run=name, first_step=0, gaps=gaps)
        for name, gaps in (("a", 2), ("b", 0))
    ]
    repeated = MergedRun.model_construct(**dict(runs[3].summary), parts=parts)
    repeated.gaps = 2
    runs[3] = replace(runs[3], summary=repeated)
    comparison = compare(runs)
    assert comparison.left_out == ("long-4.0",)
    best = rank_gaps(comparison, "measured", "eta_a")
    assert best is not None
    assert best.compared_gaps_mm == [math.inf, 16.0, 0.0]
    print_gap_comparison(describe_comparison(comparison))
    assert "dropouts in the recording: long-4.0" in capsys.readouterr().out
    page = render_page(
        Path(gap_comparison.__file__).with_suffix(".html"),
        gaps=describe_comparison(comparison),
        pictures=[],
        tables=list_gap_tables(comparison),
        symbols=SYMBOLS,
        gap_name=format_gap,
    )
    assert "dropouts in the recording: long-4.0." in page


def test_a_channel_that_is_missing_gives_no_number() -> None:
    runs = make_runs()
    for run in runs:
        windows: Any = run.summary.windows
        for window in windows:
            window.measured.force_r.peak = None
    comparison = compare(runs)
    assert np.isnan(comparison.values["measured", "r"]).all()
    assert rank_gaps(comparison, "measured", "r") is None
    assert rank_gaps(comparison, "measured", "eta_a") is not None
    assert rank_gaps(comparison, "twin", "r") is not None


def test_records_are_distinguished_by_their_motion(tmp_path: Path) -> None:
    write_grid(tmp_path)

    def make_profile(file: str, scale: float, gap_mm: float, **keys: Any) -> Profile:
        excitation = {
            "kind": "record", "file": file, "scale": scale, **keys,
            "files": {file: (tmp_path / file).read_text()},
        }  # fmt: skip
        specimen = {"mass_kg": 550.0, "gap_mm": gap_mm}
        tables = {"title": "t", "specimen": specimen, "excitation": excitation}
        return Profile.model_validate(tables)

    summary = make_summary(0.01, 1.0, 100.0)
    settings = [("own.csv", 1.0, math.inf), ("own.csv", 1.0, 4.0), ("own.csv", 0.5, 4.0),
                ("first.csv", 1.0, 4.0)]  # fmt: skip
    runs = [(f"run{k}", make_profile(*setting), summary) for k, setting in enumerate(settings)]
    stopped = (
        "stopped",
        make_profile("first.csv", 1.0, math.inf),
        summary.model_copy(update={"verdict": "stopped"}),
    )
    listed = list_record_runs([*runs, stopped], {})
    assert [run.record for run in listed] == ["own × 1", "own × 1", "own × 0.5", "first"]
    named = list_record_runs(runs, {"run3": "First 1999"})
    assert named[-1].record == "First 1999"
    filtered = ("filtered", make_profile("own.csv", 0.5, 4.0, band_hz=[1.0, 8.0]), summary)
    listed = list_record_runs([*runs, filtered], {})
    assert [run.record for run in listed] == [
        "own × 1", "own × 1", "own × 0.5 (run2)", "first", "own × 0.5 (filtered)",
    ]  # fmt: skip
    assert len({run.motion for run in listed}) == 4


def test_the_terminal_shows_the_table_and_the_best_gaps(capsys: pytest.CaptureFixture[str]) -> None:
    described = describe_comparison(compare(make_runs()))
    print_gap_comparison(GapResult.model_validate_json(described.to_json()))
    text = " ".join(capsys.readouterr().out.split())
    assert "G4: 0.80, best in 2 of 3 records; next G0: 0.90 (+13 %)" in text
    assert "G0, the smallest gap tested: 0.20, best in 3 of 3 records" in text
    assert "0.80 (0.75 to 0.90) *" in text
    assert text.count("*") == 1 + len(CRITERIA)


def test_a_table_of_the_page_has_the_values_and_marks_the_best() -> None:
    tables = list_gap_tables(compare(make_runs()))
    acceleration, displacement, _, force = tables
    assert acceleration.gaps == ["G16", "G4", "G0"]
    assert [row.name for row in acceleration.rows] == [*PLANTED, "median", "largest"]
    assert [cell.measured for cell in acceleration.rows[0].cells] == ["2.50", "0.75", "0.90"]
    assert [cell.is_best for cell in acceleration.rows[0].cells] == [False, True, False]
    assert acceleration.rows[0].reference == "0.204 g"
    assert displacement.rows[2].reference == "100 mm"
    assert [cell.measured for cell in displacement.rows[3].cells] == ["0.75", "0.30", "0.20"]
    assert [cell.measured for cell in force.rows[0].cells] == ["0.74", "0.17", "0.20"]
    assert [cell.heat for cell in acceleration.rows[0].cells] == [LARGER, SMALLER, SMALLER]


def test_the_lines_of_the_figures_are_the_values() -> None:
    comparison = compare(make_runs())
    over_gap, trade_off = (drawn.figure for drawn in draw_gap_figures(comparison))
    assert isinstance(over_gap, Figure)
    assert isinstance(trade_off, Figure)
    panel = over_gap.axes[0]
    drawn = [np.asarray(line.get_ydata()) for line in panel.lines]
    for row in range(3):
        np.testing.assert_array_equal(drawn[row], comparison.values["measured", "eta_a"][row])
    np.testing.assert_allclose(drawn[3], [1.0, 2.0, 0.8, 0.9])
    assert [tick.get_text() for tick in panel.get_xticklabels()] == ["G∞", "G16", "G4", "G0"]
    median = trade_off.axes[0].lines[3]
    np.testing.assert_allclose(np.asarray(median.get_xdata()), [1.0, 0.75, 0.3, 0.2])
    np.testing.assert_allclose(np.asarray(median.get_ydata()), [1.0, 2.0, 0.8, 0.9])
    names = {text.get_text() for text in trade_off.axes[0].texts}
    assert {*PLANTED, "G∞", "G16", "G4", "G0"} <= names


def test_without_displacement_no_trade_off_is_drawn() -> None:
    runs = make_runs()
    for run in runs:
        windows: Any = run.summary.windows
        for window in windows:
            window.measured.u.peak = None
    (over_gap,) = draw_gap_figures(compare(runs))
    assert over_gap.name == "gaps"


def test_labels_are_moved_as_little_as_needed() -> None:
    heights = spread_labels(np.array([0.1, 0.1, 0.5, 0.9]), 0.1)
    np.testing.assert_allclose(heights, [0.05, 0.15, 0.5, 0.9])
    crowded = spread_labels(np.array([0.2, 0.21, 0.22, 0.23]), 0.05)
    assert np.diff(crowded).min() >= 0.05 - 1e-12
    assert crowded.mean() == pytest.approx(0.215)


SHORT_GRID = """
title = "Two records, two gaps"
[records]
profile = "base.toml"
gaps_mm = [inf, 2.0]
[[records.files]]
file = "first.csv"
title = "First"
scale = 4.0
[[records.files]]
file = "own.csv"
title = "Own"
scale = 4.0
"""


def find_peaks(folder: Path) -> dict[str, tuple[float, float, float]]:
    """Peaks of u, a and the larger force of a bumper by source, from the samples themselves."""
    recording = read_recording(folder / "run.mcap")
    peaks = {}
    for source, stream, prefix in (("measured", "meas", ""), ("twin", "pred", "free/")):
        series: dict[str, list[Any]] = {}
        measured = select_blocks(recording.items, "meas")
        playing = {block.index: block.label == Label.MEASURE for block in measured}
        for block in select_blocks(recording.items, stream):
            for name in block.channels:
                series.setdefault(name, []).append(block.channel(name)[playing[block.index]])
        samples = {name: np.concatenate(parts) for name, parts in series.items()}
        if source == "measured":
            u = samples["mass_disp_m"] - samples["table_disp_m"]
            table = samples["table_disp_m"]
        else:
            u = samples["free/mass_disp_m"] - table
        forces = [
            samples[f"{prefix}force_{side}1_n"] + samples[f"{prefix}force_{side}2_n"]
            for side in "rl"
        ]
        peaks[source] = (
            float(np.abs(u).max()),
            float(np.abs(samples[f"{prefix}mass_acc_m_s2"]).max()),
            float(max(np.abs(force).max() for force in forces)),
        )
    return peaks


@pytest.mark.slow
def test_a_played_grid_reports_what_its_recordings_hold(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_grid(tmp_path, SHORT_GRID, BASE)
    (tmp_path / "own.csv").write_text(make_record(0))
    options = CampaignOptions(
        path=tmp_path / "c.toml", out=tmp_path / "out", resume=False, unpaced=True, model=None,
        table=None, unattended=True, listen="",
    )  # fmt: skip
    assert run_campaign(options) == 0
    folder = tmp_path / "out"
    labels = ["01-ginf-first", "02-ginf-own", "03-g2-first", "04-g2-own"]
    peaks = [find_peaks(folder / label) for label in labels]
    entry = json.loads((folder / "summary.json").read_text())["gap_comparison"]
    responses = entry["responses"]
    assert [(row["record"], row["gap_mm"]) for row in responses] == [
        ("First", None), ("Own", None), ("First", 2.0), ("Own", 2.0),
    ]  # fmt: skip
    for index, row in enumerate(responses):
        for source in ("measured", "twin"):
            u, a, force = peaks[index][source]
            reference_u, reference_a, _ = peaks[index % 2][source]
            values = row[source]
            assert (values["u_m"], values["a_m_s2"]) == pytest.approx((u, a), rel=1e-9)
            assert values["eta_d"] == pytest.approx(u / reference_u, rel=1e-9)
            assert values["eta_a"] == pytest.approx(a / reference_a, rel=1e-9)
            expected = None if index < 2 else pytest.approx(force / WEIGHT_N, rel=1e-9)
            assert values["r"] == expected
    assert peaks[2]["measured"][2] > 100.0  # the bumper was hit
    page = (folder / "report.html").read_text()
    cells = re.findall(r'class="heat"[^>]*>(?:<b>)?([0-9.–]+)', page)
    eta_a = [peaks[k + 2]["measured"][1] / peaks[k]["measured"][1] for k in (0, 1)]
    # Records, then median and largest, of a single gap beyond the reference.
    column = [*eta_a, float(np.mean(eta_a)), max(eta_a)]
    assert cells[:4] == [f"{value:.2f}" for value in column]
    assert page.count("<picture") == 2
    assert page.count("prefers-color-scheme: dark)") >= 3
    assert "u* measured in free flight" not in page
    output = capsys.readouterr().out
    assert "smallest displacement of the bearing: G2" in output
    assert read_campaign(folder).gaps is not None
    assert format_gap(-1.5) == "G−1.5"


def test_the_model_alone_gives_the_same_page(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grid = SHORT_GRID.replace("gaps_mm = [inf, 2.0]", "gaps_mm = [inf, 2.0, 1.0]")
    path = write_grid(tmp_path, grid, BASE)
    assert simulate_profile(path, [], [], None, tmp_path / "model", False) == 0
    entry = json.loads((tmp_path / "model" / "summary.json").read_text())["gap_comparison"]
    assert entry["sources"] == ["twin"]
    assert [row["gap_mm"] for row in entry["gaps"]] == [None, 2.0, 1.0]
    profile = read_plan(path, None, None, lambda *_: None).runs[0].bundle.profile
    history = profile.plan.target_m
    acceleration = np.diff(history, 2, prepend=history[0], append=history[-1]) * 1000.0**2
    u, velocity = integrate_free_flight(acceleration, 1000.0, 550.0, 36e3, 1.1e3)
    first = entry["responses"][0]["twin"]
    assert first["u_m"] == pytest.approx(np.abs(u).max(), rel=2e-3)
    absolute = np.abs(36e3 * u + 1.1e3 * velocity).max() / 550.0
    assert first["a_m_s2"] == pytest.approx(absolute, rel=2e-3)
    assert entry["responses"][2]["twin"]["u_m"] < first["u_m"]
    page = (tmp_path / "model" / "report.html").read_text()
    assert "Nothing was measured" in page
    assert '<th colspan="5">model</th>' in page
    assert 'class="text twin"' not in page
    output = capsys.readouterr().out
    assert "smallest displacement of the bearing: G1, the smallest gap tested" in output


def integrate_free_flight(
    acceleration: Any, rate_hz: float, mass: float, stiffness: float, damping: float
) -> tuple[Any, Any]:
    """Relative displacement and velocity by Newmark's average acceleration."""
    step, u, v, a = 1.0 / rate_hz, 0.0, 0.0, 0.0
    effective = stiffness + 2 * damping / step + 4 * mass / step**2
    rows = []
    for ground in acceleration:
        load = -mass * ground
        load += mass * (4 * u / step**2 + 4 * v / step + a) + damping * (2 * u / step + v)
        new_u = load / effective
        new_v = 2 * (new_u - u) / step - v
        a = 4 * (new_u - u) / step**2 - 4 * v / step - a
        u, v = new_u, new_v
        rows.append((u, v))
    table = np.array(rows)
    return table[:, 0], table[:, 1]


def test_only_the_records_of_a_campaign_are_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, sweep="4.0")
    path = write_grid(tmp_path, SHORT_GRID + '[[runs]]\nprofile = "sweep.toml"\n', BASE)
    simulated = []

    def simulate(config: RunConfig) -> tuple[RunSummary, list[str]]:
        simulated.append(config.name)
        return make_summary(0.01, 1.0, 100.0), []

    monkeypatch.setattr(simulate_grid, "simulate_peaks", simulate)
    assert simulate_profile(path, [], [], None, tmp_path / "model", False) == 0
    assert simulated == ["ginf-first", "ginf-own", "g2-first", "g2-own"]


def test_a_campaign_without_records_at_several_gaps_is_not_simulated(tmp_path: Path) -> None:
    path = write_grid(tmp_path, SHORT_GRID.replace("[inf, 2.0]", "[2.0]"), BASE)
    with raises_input_error(where=path, allowed="[records]"):
        simulate_profile(path, [], [], None, tmp_path / "model", False)
    for models, gaps, view in (([], ["4"], False), (["snm", "snm"], [], False), ([], [], True)):
        with raises_input_error(where=path, remedy="--gap"):
            simulate_profile(path, models, gaps, None, tmp_path / "model", view)
    with raises_input_error(where=path, remedy="--workers"):
        simulate_profile(path, [], [], 2, tmp_path / "model", False)
    assert not (tmp_path / "model").exists()
    assert find_campaign(Path("records")) == PROFILES_DIR / "campaigns" / "records.toml"
    assert find_campaign(Path("el_centro")) is None
    assert find_campaign(Path("nothing")) is None
    assert find_campaign(tmp_path / "base.toml") is None
