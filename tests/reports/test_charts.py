"""Figures in the page: what the browser gets, and what it draws."""

import json
import re
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure

from tests.monitor.browser import Browser, open_browser
from tests.reports.folders import Drawn
from twin.drawing import page
from twin.drawing.charts import MAX_POINTS, make_chart_script, reduce_envelope, reduce_line
from twin.drawing.panels import CaptionedFigure, Key, PanelFigure
from twin.drawing.pictures import save_figures

COUNT_INKED = """[...document.querySelectorAll('.chart .uplot canvas')].map((canvas) =>
  canvas.getContext('2d').getImageData(0, 0, canvas.width, canvas.height).data
  .filter((value, i) => i % 4 === 3 && value > 0).length > 200)"""


@given(
    size=st.integers(2, 30_000),
    peaks=st.lists(st.integers(0, 2**31), min_size=1, max_size=5),
    gap=st.integers(0, 2**31),
)
def test_reduce_line_keeps_every_peak_and_gap(size: int, peaks: list[int], gap: int) -> None:
    x, y = np.arange(size, dtype=float), np.zeros(size)
    for number, place in enumerate(peaks):
        y[place % size] = 1.0 + number if number % 2 else -1.0 - number
    y[gap % size] = np.nan
    short_x, short_y = reduce_line(x, y)
    assert short_x.size <= 1.5 * MAX_POINTS
    assert np.isnan(short_y).sum() == 1
    assert np.nanmax(short_y) == np.nanmax(y)
    assert np.nanmin(short_y) == np.nanmin(y)
    np.testing.assert_array_equal(short_y, y[short_x.astype(int)])
    assert (np.diff(short_x) > 0).all()


def test_reduce_line_of_a_loop_keeps_both_extents() -> None:
    angle = np.linspace(0.0, 200.0 * np.pi, 50_000)
    x, y = reduce_line(2.0 * np.cos(angle), 3.0 * np.sin(angle))
    assert np.ptp(x) == pytest.approx(4.0, abs=1e-6)
    assert np.ptp(y) == pytest.approx(6.0, abs=1e-6)


def test_reduce_envelope_contains_the_whole() -> None:
    x = np.arange(10_000.0)
    low, high = -np.ones_like(x), np.ones_like(x)
    low[1234], high[7777] = -5.0, 9.0
    short, lowest, highest = reduce_envelope(x, low, high)
    assert short.size <= MAX_POINTS
    assert (lowest.min(), highest.max()) == (-5.0, 9.0)


def read_charts(figure: PanelFigure) -> Any:
    script = make_chart_script([CaptionedFigure("one", "title", "caption", figure)])
    text = re.search(r"const CHARTS=(.*);\n", script)
    assert text is not None
    return json.loads(text[1].replace(r"<\/", "</"))


def test_limits_are_those_of_the_data_or_set_and_shared() -> None:
    figure = PanelFigure((10.0, 4.0), 1, 2, sharey="row")
    left, right = figure.panels[0]
    left.plot([1.0, 3.0], [0.0, 10.0], color="#c4161c")
    right.plot([1.0, 5.0], [-10.0, 5.0], color="#1559b0", marker="o", ls="")
    right.set_xlim(0.5, None)
    charts = read_charts(figure)
    first, second = charts["figures"][0]["rows"][0]
    assert first["x"] == second["x"] == pytest.approx([0.5, 5.2])
    assert first["y"] == second["y"] == pytest.approx([-10.75, 10.5])
    assert charts["columns"][0] == [1.0, 3.0]


def test_marks_have_the_label_of_the_key_of_their_style() -> None:
    figure = PanelFigure((10.0, 4.0))
    style = {"color": "#c4161c", "lw": 2.0}
    figure.panels[0, 0].plot([1.0], [2.0], **style)
    figure.panels[0, 0].set_ylabel(r"$\eta_d$ <b>")
    figure.legend([Key("measured", style)], columns=1)
    [[panel]] = read_charts(figure)["figures"][0]["rows"]
    assert panel["marks"][0]["label"] == "measured"
    assert panel["ylabel"] == "<i>η<sub>d</sub></i> &lt;b&gt;"


def test_detail_of_a_long_line_keeps_its_samples() -> None:
    figure = PanelFigure((10.0, 4.0))
    time_s = np.arange(100_000) / 1000.0
    figure.panels[0, 0].plot(time_s, np.sin(time_s), color="#c4161c")
    figure.panels[0, 0].set_xlim(50.0, 51.0)
    charts = read_charts(figure)
    [[panel]] = charts["figures"][0]["rows"]
    column = charts["columns"][panel["marks"][0]["x"]]
    assert column["low"] == pytest.approx(49.999)
    assert len(column["codes"]) // 4 * 3 // 2 >= 1001


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with open_browser(tmp_path_factory.mktemp("chromium") / "profile") as browser:
        yield browser


@pytest.mark.parametrize(("width", "dark"), [(1280, False), (420, True)])
def test_every_panel_is_drawn_in_the_browser(
    browser: Browser, drawn_report: Drawn, tmp_path: Path, width: int, dark: bool
) -> None:
    page = tmp_path / "report.html"
    page.write_text(drawn_report.html, encoding="utf-8")
    assert page.stat().st_size < 1.5e6
    browser.open(page.as_uri(), width=width, dark=dark)
    inked = browser.wait_for(COUNT_INKED)
    names = {picture.path.stem for picture in drawn_report.pictures}
    assert (
        set(browser.evaluate("[...document.querySelectorAll('figure')].map((f) => f.id)")) == names
    )
    assert len(inked) >= len(names)
    assert all(inked)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    assert browser.console == []


def test_pointer_shows_the_value_and_drag_zooms_the_panels_of_a_figure(
    browser: Browser, drawn_report: Drawn, tmp_path: Path
) -> None:
    page = tmp_path / "report.html"
    page.write_text(drawn_report.html, encoding="utf-8")
    browser.open(page.as_uri())
    browser.wait_for(COUNT_INKED)
    browser.evaluate("document.querySelector('#prc').scrollIntoView()")
    left, top, width, height = browser.evaluate(
        "(({x, y, width, height}) => [x, y, width, height])"
        "(document.querySelector('#prc .u-over').getBoundingClientRect())"
    )

    def send(
        kind: str, across: float, down: float, is_pressed: bool = False, count: int = 1
    ) -> None:
        browser.call(
            "Input.dispatchMouseEvent", type=kind, x=left + across * width, y=top + down * height,
            button="left" if is_pressed else "none", buttons=int(is_pressed), clickCount=count,
        )  # fmt: skip

    def draw() -> Any:
        return browser.evaluate(
            "[...document.querySelectorAll('#prc canvas')].map((each) => each.toDataURL())"
        )

    shown = "[...document.querySelectorAll('#prc .tip')].filter((t) => !t.hidden)[0]?.innerText"
    texts = []
    for across, down in product(np.linspace(0.03, 0.97, 12), np.linspace(0.03, 0.97, 12)):
        send("mouseMoved", across, down)
        texts.append(browser.evaluate(shown) or "")
    measured = next((text for text in texts if text.startswith("measured")), str(set(texts)))
    assert re.search(r"^measured (for|back)ward\n\d[\d.]*, 0\.\d+$", measured)

    whole = draw()
    send("mousePressed", 0.3, 0.2, True)
    send("mouseMoved", 0.45, 0.5, True)
    send("mouseMoved", 0.6, 0.8, True)
    send("mouseReleased", 0.6, 0.8, True)
    send("mouseMoved", 0.01, 0.01)
    zoomed = draw()
    changed = [before != after for before, after in zip(whole, zoomed, strict=True)]
    assert sum(changed) == 4  # its four panels, no key of the legend
    for count in (1, 2):
        send("mousePressed", 0.5, 0.5, True, count)
        send("mouseReleased", 0.5, 0.5, True, count)
    send("mouseMoved", 0.01, 0.01)
    assert draw() == whole


def draw_line() -> Iterator[CaptionedFigure]:
    figure = Figure()
    axes = figure.subplots()
    axes.plot([0.0, 1.0, 2.0], [0.0, 3.0, 1.0])
    axes.set_xlim(0.5, 1.5)  # the line is clipped
    yield CaptionedFigure("line", "title", "caption", figure)


def test_equal_figures_are_equal_bytes_as_svg(tmp_path: Path) -> None:
    for name in ("first", "second"):
        save_figures(draw_line(), tmp_path / name, more_formats=("svg",))
    first, second = ((tmp_path / name / "line.svg").read_bytes() for name in ("first", "second"))
    assert first == second
    assert b"clip" in first
    assert b"<dc:date>" not in first


def test_a_template_that_was_compiled_before_follows_its_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(page, "CACHE_DIR", tmp_path / "cache")
    template = tmp_path / "page.html"
    for text in ("{{ value }} mm", "{{ value }} mm", "{{ 2 * value }} mm"):
        template.write_text(text)
        rendered = page.render_page(template, value=4)
    assert rendered == "8 mm"
    assert len([*(tmp_path / "cache").iterdir()]) == 1


def test_a_page_is_rendered_where_no_cache_can_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setattr(page, "CACHE_DIR", tmp_path / "file" / "cache")
    template = tmp_path / "page.html"
    template.write_text("{{ value }} mm")
    assert page.render_page(template, value=4) == "4 mm"
