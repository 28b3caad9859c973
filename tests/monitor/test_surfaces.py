"""Terminal, web page and Rerun view of one run show the same facts, each in its own layout."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from table_io.records import Agreement, Estimate
from tests.monitor.monitored import point, receive, records, start, stream
from tests.viewer.example_run import content, scalars
from twin.monitor.page_data import build_sections
from twin.monitor.panels import draw_events, draw_specimen, draw_twin
from twin.monitor.run_view import RunView, SessionStatus, eta_d
from twin.viewer.plots import FrequencyCurves
from twin.viewer.view import RerunView

ITEMS = [*records(), point(9), *stream()]


@pytest.fixture(scope="module")
def terminal() -> RunView:
    return RunView(receive(*ITEMS), SessionStatus())


@pytest.fixture(scope="module")
def page(terminal: RunView) -> dict[str, Any]:
    return {name: json.loads(text) for name, text in build_sections(terminal).items()}


@pytest.fixture(scope="module")
def rerun_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("surfaces") / "view.rrd"
    view = RerunView(start(), save=path)
    view.feed(ITEMS)
    view.close()
    return path


def test_twin_errors_agree_on_every_surface(
    terminal: RunView, page: dict[str, Any], rerun_file: Path
) -> None:
    """0.1 mm of u with a band of 0.05 mm."""
    (agreement,) = (item for item in ITEMS if isinstance(item, Agreement))
    rows = {row["name"]: row for row in page["twin"]["rows"]}
    assert (rows["u rel"]["error"], rows["u rel"]["band"]) == (0.1, 0.05)
    (line,) = (line.plain for line in draw_twin(terminal, 59, 9) if line.plain.startswith("u rel"))
    assert "0.100  0.050 mm     200 %" in line
    assert scalars(rerun_file, "/disagreement/u")[1].tolist() == [[2.0]]
    document = content(rerun_file)["/agreement"]["TextDocument:text"][1][0][0]
    assert "| rel_disp_m | 0.0001 | 5e-05 | 2.00 | contact left |" in document
    exceeding = {row["name"] for row in page["twin"]["rows"] if row["exceeds"]}
    assert exceeding == {"u rel"}
    assert [
        error > band for error, band in zip(agreement.error, agreement.band, strict=True)
    ].count(True) == 1


def test_drifts_are_shares_of_the_first_value_on_every_surface(
    terminal: RunView, rerun_file: Path
) -> None:
    """-1.8 of 37.9 kN/m at the start."""
    (estimate,) = (item for item in ITEMS if isinstance(item, Estimate))
    first = estimate.values[0] - estimate.drift[0]
    share = 100 * estimate.drift[0] / first
    assert share == pytest.approx(-4.749, abs=1e-3)
    assert " -4.7±0.2 %" in draw_specimen(terminal, 39, 6)[0].plain
    assert scalars(rerun_file, "/drift/stiffness")[1][0][0] == pytest.approx(share)


def test_curves_and_forecast_agree_on_every_surface(
    terminal: RunView, page: dict[str, Any], rerun_file: Path
) -> None:
    curves = {
        (curve.source, curve.direction): curve.points for curve in terminal.plot(eta_d).curves
    }
    shown = {(c["source"], c["direction"]): c["points"] for c in page["prc"]["curves"]}
    assert shown.keys() == curves.keys()
    for key, points in curves.items():
        assert shown[key] == [pytest.approx(list(pair), rel=1e-4) for pair in points]
    for source in ("measured", "twin"):
        strips = content(rerun_file)[f"/prc/data/{source}"]["LineStrips2D:strips"][1][-1]
        for strip, direction in zip(strips, ("forward", "backward"), strict=True):
            assert [tuple(pair) for pair in strip] == [
                pytest.approx(pair, rel=1e-6) for pair in curves[source, direction]
            ]
    assert page["prc"]["forecast"]["jump_hz"] == 3.982
    assert "jump down at 3.982 Hz" in draw_specimen(terminal, 39, 6)[1].plain
    document = content(rerun_file)["/ahead"]["TextDocument:text"][1][-1][0]
    assert document.startswith("**down at 3.98 Hz**")


def test_a_step_measured_again_has_one_point_on_every_surface() -> None:
    again = replace(point(1), index=9000, measured=point(4).measured)
    plot = RunView(receive(start(), point(1), again), SessionStatus()).plot(eta_d)
    curves = FrequencyCurves(0.5, 5.0)
    for repeated in (point(1), again):
        curves.add(repeated)
    (_, strip), *others = curves.get_curves("measured")
    assert others == []
    (measured,) = (curve.points for curve in plot.curves if curve.source == "measured")
    assert [tuple(pair) for pair in strip] == list(measured) == [(2.5, pytest.approx(0.18))]


def test_events_are_the_same_and_newest_first(terminal: RunView, page: dict[str, Any]) -> None:
    lines = [line.plain for line in draw_events(terminal, 200, 9)]
    assert [f"0:00:0{row['time_s']} {row['text']}" for row in page["events"]["rows"]] == lines
