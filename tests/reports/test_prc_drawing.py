"""The one drawing of pseudo-resonance curves: axes, signs, markers and jumps."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from matplotlib.figure import Figure

from table_io.records import PrcPoint
from tests.reports.recordings import summary
from twin.compare.curves import PrcJump
from twin.drawing.plot_style import twin_style
from twin.drawing.prc_drawing import (
    PrcPanel,
    break_at_jumps,
    draw_jumps,
    make_prc_panels,
    plot_prc,
)
from twin.results.contracts import RunSummary
from twin.results.report_data import extract_prc
from twin.results.summary import prc_points


@pytest.fixture
def points() -> list[PrcPoint]:
    return prc_points(RunSummary.model_validate(summary()).steps)


@pytest.fixture
def panels() -> list[PrcPanel]:
    return make_prc_panels(Figure().subplots(2, 2))


def test_a_missing_response_leaves_a_gap_in_the_curve(points: list[PrcPoint]) -> None:
    points[1] = replace(points[1], measured=None)
    f, eta_d = extract_prc(points, "measured", "forward", "eta_d")
    assert f.tolist() == [1.0, 1.5, 2.0, 2.5]
    assert np.isnan(eta_d).tolist() == [False, True, False, False]
    impacts = extract_prc(points, "measured", "forward", "impacts_right")[1]
    assert impacts[0] == pytest.approx(7 / 3)


def test_left_is_drawn_below_zero_and_amplitudes_start_at_zero(
    points: list[PrcPoint], panels: list[PrcPanel]
) -> None:
    plot_prc(panels, partial(extract_prc, points, "twin"), twin_style)
    plot_prc(panels, lambda *_: (np.array([1.0]), np.array([9.0])), twin_style)
    (eta_d, _), _, (eta_j, _), _ = panels
    bottom, top = eta_d.get_ylim()
    assert bottom == 0
    assert top > 9
    means = [
        float(np.mean(np.asarray(line.get_ydata()))) for line in eta_j.lines[1:5]
    ]  # after the zero line
    assert [mean > 0 for mean in means] == [True, True, False, False]
    assert [line.get_marker() for line in eta_d.lines] == ["", "", "o", "o"]
    assert all(ax.get_ylabel() for ax, _ in panels)
    assert [bool(ax.get_xlabel()) for ax, _ in panels] == [False, False, True, True]


@pytest.mark.parametrize(("count", "label"), [(1, "2–2.5 Hz"), (5, "5")])
def test_jumps_are_labelled_by_frequencies_or_numbers(
    points: list[PrcPoint], panels: list[PrcPanel], count: int, label: str
) -> None:
    jumps = [PrcJump("forward", 2.0, 2.5, "down")] * count
    draw_jumps(panels, partial(extract_prc, points, "twin"), jumps, label_in="eta_d")
    texts = [[text.get_text() for text in ax.texts if text.get_text()] for ax, _ in panels]
    assert texts[0][-1] == label
    assert texts[1] == []
    assert len(panels[2][0].texts) == 2 + 2 * count  # names of both sides, an arrow a side and jump


def test_a_jump_at_a_frequency_that_was_not_measured_is_left_out(
    points: list[PrcPoint], panels: list[PrcPanel]
) -> None:
    jumps = [PrcJump("forward", 2.0, 2.6, "down")]
    draw_jumps(panels, partial(extract_prc, points, "twin"), jumps)
    assert list(panels[0][0].texts) == []


def test_a_curve_is_broken_at_the_jumps_of_its_direction(points: list[PrcPoint]) -> None:
    curves = partial(extract_prc, points, "measured")
    broken = break_at_jumps(curves, [PrcJump("forward", 2.0, 2.5, "down")])
    f, eta_d = broken("forward", "eta_d")
    assert f.tolist() == [1.0, 1.5, 2.0, 2.25, 2.5]
    assert np.isnan(eta_d).tolist() == [False, False, False, True, False]
    assert np.isfinite(broken("backward", "eta_d")[1]).all()
