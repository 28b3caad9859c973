"""The evidence and the pictures of a report: drawn is what was recorded."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from table_io.block import Block
from table_io.records import Params
from tests.builders.recordings import store_items
from tests.reports.folders import Drawn, Maker
from tests.reports.recordings import STEPS, blocks, one_step, signals, summary
from twin.drawing.pictures import save_figures
from twin.drawing.plot_style import PRECOMPRESSION_COLOUR
from twin.model.parameters import Parameters
from twin.recording.reader import read_recording
from twin.report.figures import draw_figures
from twin.report.report import load_report_data
from twin.results.contracts import RunSummary
from twin.results.report_data import (
    ReportData,
    build_report_data,
    compute_prestress,
    compute_step_errors,
    differentiate,
    extract_step_motion,
    select_frequencies,
)

CARD = Path(__file__).resolve().parents[2] / "profiles/models/snm.toml"
BUMPER = 510e3, 900.0
MODEL = Parameters(550.0, 36e3, 1.1e3, *BUMPER, *BUMPER, -0.5e-3, -0.5e-3).as_dict()


def test_figures_are_written_and_not_blank(drawn_report: Drawn) -> None:
    names = [picture.path.stem for picture in drawn_report.pictures]
    for name in ("prc", "impacts", "portraits", "loops", "bumpers", "comparison", "overview"):
        assert name in names
    for picture in drawn_report.pictures:
        pixels = imread(picture.path)[..., :3]
        inked = (pixels < 0.9).any(axis=2)
        assert inked.mean() > 0.01, picture.path.name
        assert inked.any(axis=0).mean() > 0.6, picture.path.name
        assert picture.caption


def test_steps_looked_at_are_hysteresis_peak_and_most_impacts(run_folder: Maker) -> None:
    values = summary()
    values["steps"][0]["measured"]["impacts_left"] = [4, 4, 4]
    folder = run_folder(run_summary=values)
    reasons = select_frequencies(load_report_data(folder))
    assert reasons == {
        1.0: "largest excursion, most impacts per cycle",  # backward ends at 1 Hz, eta_d rises
        1.5: "inside the right hysteresis",
    }


def test_pictures_show_measured_samples_and_leave_gaps_empty(run_folder: Maker) -> None:
    items = blocks()
    whole = next(item for item in items if isinstance(item, Block) and item.step[0] == 1)
    parts = [whole.cut(whole.index, whole.index + 400), whole.cut(whole.index + 450, whole.end)]
    folder = run_folder([*(item for item in items if item is not whole), *parts])
    motion = extract_step_motion(load_report_data(folder), "meas", 1)
    assert motion is not None
    assert motion.u.size == len(whole)
    assert np.isnan(motion.u[400:450]).all()
    truth = signals(STEPS[1], 1.0)
    np.testing.assert_allclose(motion.u[:400], truth["rel_disp_m"][:400], atol=1e-12)
    known = np.isfinite(motion.v)
    peak = np.abs(truth["rel_vel_m_s"]).max()
    np.testing.assert_allclose(motion.v[known], truth["rel_vel_m_s"][known], atol=0.01 * peak)


def test_errors_per_step_are_those_of_the_comparisons(run_folder: Maker) -> None:
    errors = compute_step_errors(load_report_data(run_folder()))
    assert errors["u"][0] == pytest.approx((0.1, 0.05))
    assert errors["F_R"][0] == pytest.approx((0.1, 0.05))
    assert np.isnan(errors["F_R"][7]).all()  # backward never touches


def build_precompressed(folder: Path) -> ReportData:
    return build_report_data(
        read_recording(folder / "run.mcap"), RunSummary.model_validate(one_step()[1])
    )


def test_precompression_is_that_of_the_recorded_model_or_of_its_card(run_folder: Maker) -> None:
    items, values = one_step()
    run = build_precompressed(run_folder([Params(0, MODEL, "start"), *items], values, "-1.0"))
    start = replace(run.recording.start, model_toml=CARD.read_text(encoding="utf-8"))
    by_card = replace(run, recording=replace(run.recording, start=start, items=store_items(items)))
    eta, r = 0.5e-3 / 0.030537, 510e3 * 0.5e-3 / (550.0 * 9.80665)
    for folder_run in (run, by_card):
        assert compute_prestress(folder_run) == pytest.approx(
            {"eta_r": eta, "r_r": r, "eta_l": eta, "r_l": r}
        )


@pytest.mark.parametrize("gap, known", [("-1.0", {"eta_r", "eta_l"}), ("4.0", set())])
def test_precompression_without_a_model(run_folder: Maker, gap: str, known: set[str]) -> None:
    assert set(compute_prestress(build_precompressed(run_folder(*one_step(), gap)))) == known


def test_precompression_is_drawn_grey(run_folder: Maker, drawn_report: Drawn) -> None:
    items, values = one_step()
    folder = run_folder([Params(0, MODEL, "start"), *items], values, "-1.0")
    save_figures(draw_figures(build_precompressed(folder)), folder / "figures")
    grey = int(PRECOMPRESSION_COLOUR[1:3], 16) / 255
    for place, is_marked in ((folder, True), (drawn_report.folder, False)):
        pixels = imread(place / "figures" / "prc.png")[..., :3]
        share = (np.abs(pixels - grey) < 1e-3).all(axis=2).mean()
        assert (share > 0.01) == is_marked


@pytest.mark.parametrize("rate", [200.0, 2000.0])
def test_a_drawn_velocity_is_exact_for_a_cubic_and_missing_at_its_ends(rate: float) -> None:
    t = np.arange(100) / rate
    slope = differentiate(1.0 - 2.0 * t + 30.0 * t**2 - 400.0 * t**3, rate)
    inside = np.isfinite(slope)
    ends = 2 * max(2, round(0.01 * rate))
    assert inside.sum() == t.size - ends
    assert slope[inside] == pytest.approx((-2.0 + 60.0 * t - 1200.0 * t**2)[inside], rel=1e-6)
