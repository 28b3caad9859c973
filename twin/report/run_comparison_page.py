"""Page of a comparison of two runs: verdicts, curves over each other, jumps, parameters."""

from functools import partial
from pathlib import Path

import numpy as np

from twin.drawing.charts import make_chart_script
from twin.drawing.page import render_page
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Key, PanelFigure
from twin.drawing.plot_style import DIRECTION_DASHES, FIGURE_WIDTH_IN, LineStyle
from twin.drawing.prc_drawing import (
    FREE_PANELS,
    PRC_PANELS,
    break_at_jumps,
    make_prc_panels,
    plot_prc,
)
from twin.report.run_comparison import ComparedRun, RunComparison
from twin.results.quantities import format_quantity
from twin.results.report_data import DIRECTIONS, extract_prc
from twin.results.twin_verdict import CHANNEL_SYMBOLS

RUN_COLOURS = ("#c8741a", "#0f7b7b")  # first, second: neither is that of a direction


def write_comparison_page(
    folder: Path, first: ComparedRun, second: ComparedRun, comparison: RunComparison
) -> Path:
    """Write compare.html into a folder; return the path of the page."""
    figures = list(draw_comparison(first, second))
    page = folder / "compare.html"
    page.write_text(
        render_page(
            Path(__file__).with_name("run_comparison.html"),
            comparison=comparison,
            figures=figures,
            script=make_chart_script(figures),
            quantity=format_quantity,
            symbols=CHANNEL_SYMBOLS,
        ),
        encoding="utf-8",
    )
    return page


def draw_comparison(first: ComparedRun, second: ComparedRun) -> CaptionedFigures:
    """Draw the curves of two runs over each other: measured wide and pale, twin thin on top."""
    points = [run.summary.steps for run in (first, second)]
    if not any(points):
        return
    has_bumpers = any(
        np.isfinite(extract_prc(of_run, source, direction, "r_r")[1]).any()
        for of_run in points
        for source in ("measured", "twin")
        for direction in DIRECTIONS
    )
    contents = PRC_PANELS if has_bumpers else FREE_PANELS
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.6 * len(contents) / 2 + 0.3), len(contents) // 2, 2)
    panels = make_prc_panels(figure.panels, contents)
    keys = []
    named_runs = zip((first, second), points, RUN_COLOURS, ("first", "second"), strict=True)
    for run, of_run, colour, name in named_runs:
        for source, jumps in (("measured", run.summary.jumps), ("twin", run.summary.twin_jumps)):
            curves = break_at_jumps(partial(extract_prc, of_run, source), jumps)
            plot_prc(panels, curves, partial(_run_style, colour, source))
            keys.append(Key(f"{name}, {source}", _run_style(colour, source, "forward")))
    for direction in DIRECTIONS:
        style = {"color": "#555555", "lw": 1.0, "ls": DIRECTION_DASHES[direction]}
        keys.append(Key(direction, style))
    figure.legend(keys, columns=6)
    caption = (
        "One point per frequency step. Measured wide and pale, twin thin; solid forward, dashed "
        "backward; broken where it jumps. Each run is divided by its own u* and a*."
    )
    yield CaptionedFigure("prc", "Pseudo-resonance curves of both runs", caption, figure)


def _run_style(colour: str, source: str, direction: str) -> LineStyle:
    shape: LineStyle = (
        {"lw": 3.0, "alpha": 0.4} if source == "measured" else {"lw": 0.9, "alpha": 1.0}
    )
    return {"color": colour, "ls": DIRECTION_DASHES[direction], **shape}
