"""Figures of the free-running models: PRCs, impacts per cycle and histories of u."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from twin.discovery.figure_data import DiscoveryView, select_close_ups
from twin.discovery.free_running import MODELS, FreeRuns
from twin.drawing.panels import CaptionedFigure, CaptionedFigures
from twin.drawing.pictures import direction_handles
from twin.drawing.plot_style import (
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    TWIN_COLOUR,
    LineStyle,
    measured_style,
    twin_style,
)
from twin.drawing.prc_drawing import (
    FREE_PANELS,
    IMPACT_PANELS,
    make_prc_panels,
    plot_prc,
)
from twin.results.report_data import DIRECTIONS, IMPACT_KEYS, extract_prc


def draw_free_running(
    view: DiscoveryView, runs: dict[int, FreeRuns], chosen: Sequence[int]
) -> CaptionedFigures:
    """Draw PRCs, impacts and histories of the chosen logs, a column per model."""
    for number in chosen:
        if number in runs:
            yield from _draw_log(view, runs[number], number)


def _draw_log(view: DiscoveryView, runs: FreeRuns, number: int) -> CaptionedFigures:
    name = view.title_suffix(number)
    stem = f"_{number}" if name else ""
    caption = (
        "One point per step, from its measured cycles. The model runs free from the first sample, "
        "driven by the measured table acceleration. In chaotic bands the trajectories diverge; "
        "compare amplitudes, not samples. The axes are the same in every column."
    )
    title = f"Pseudo-resonance curves, measured and modelled{name}"
    yield CaptionedFigure(f"prc{stem}", title, caption, _draw_panels(runs, FREE_PANELS))
    if any(
        np.nan_to_num(extract_prc(runs[0].points, "measured", direction, side)[1]).any()
        for direction in DIRECTIONS
        for side in IMPACT_KEYS
    ):
        caption = "Mean over the measured cycles of a step, from the load cells and from the model."
        title = f"Impacts per forcing cycle{name}"
        yield CaptionedFigure(f"impacts{stem}", title, caption, _draw_panels(runs, IMPACT_PANELS))
    yield from _draw_motion(view, runs, number, name, stem)


def _draw_motion(
    view: DiscoveryView, runs: FreeRuns, number: int, name: str, stem: str
) -> CaptionedFigures:
    """Draw the last cycles of u at three steps, a row each, and the residual below."""
    residuals = view.log_residuals[number]
    close_ups = select_close_ups(residuals, view.sweep_steps(number), 0)
    if not close_ups:
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.3 * len(close_ups) + 0.6))
    axes = figure.subplots(
        2 * len(close_ups), len(MODELS), sharex="row", sharey="row", squeeze=False,
        height_ratios=[2, 1] * len(close_ups),
    )  # fmt: skip
    measured = runs[0].block.channel("rel_disp_m")
    time_s = runs[0].block.time_s
    for row, close_up in enumerate(close_ups):
        shown = close_up.samples
        t = time_s[shown] - time_s[shown[0]]
        for column, run in enumerate(runs):
            upper, lower = axes[2 * row : 2 * row + 2, column]
            upper.plot(t, 1e3 * measured[shown], **measured_style(close_up.direction))
            upper.plot(t, 1e3 * run.u[shown], **twin_style("forward"))
            lower.plot(t, 1e3 * (measured - run.u)[shown], color=TWIN_COLOUR, lw=0.8)
            lower.axhline(0, color=GUIDE_COLOUR, lw=0.5)
            if row == 0:
                upper.set_title(MODELS[column])
        axes[2 * row, 0].set_ylabel(f"u in mm\n{close_up.title}")
        axes[2 * row + 1, 0].set_ylabel("residual")
    for ax in axes[-1]:
        ax.set_xlabel("time in s")
    caption = (
        "Last cycles of three steps: measured (wide, pale) and the free-running model (thin); "
        "below, measured minus model in mm. The model keeps its own phase and branch, so after a "
        "jump that only one of them makes the curves part."
    )
    yield CaptionedFigure(f"motion{stem}", f"Displacement u{name}", caption, figure)


def _draw_panels(runs: FreeRuns, contents: Any) -> Figure:
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.6 * len(contents) + 0.6))
    axes = figure.subplots(len(contents), len(runs), sharex=True, sharey="row", squeeze=False)
    for column, (run, title) in enumerate(zip(runs, MODELS, strict=True)):
        panels = make_prc_panels(axes[:, [column]], contents)
        plot_prc(panels, partial(extract_prc, run.points, "measured"), _dotted_style)
        plot_prc(panels, partial(extract_prc, run.points, "twin"), _circled_style)
        axes[0, column].set_title(title)
    for ax in axes[:, 1:].flat:
        ax.set_ylabel("")
    driven = [
        direction
        for direction in DIRECTIONS
        if any(p.direction == direction for p in runs[0].points)
    ]
    handles = [
        *direction_handles(_dotted_style, "measured ", driven),
        *direction_handles(_circled_style, "model ", driven),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def _dotted_style(direction: str) -> LineStyle:
    return {**measured_style(direction), "marker": "o", "ms": 4}


def _circled_style(direction: str) -> LineStyle:
    return {**twin_style(direction), "marker": "o", "ms": 6, "mfc": "none"}
