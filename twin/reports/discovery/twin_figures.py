"""Figures of the free-running twin before and after: PRCs and impacts per cycle."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from twin.reports.discovery.figure_data import DiscoveryView
from twin.reports.discovery.free_running import FreeRuns
from twin.reports.plot_style import (
    FIGURE_WIDTH_IN,
    CaptionedFigure,
    CaptionedFigures,
    LineStyle,
    direction_handles,
    measured_style,
    twin_style,
)
from twin.reports.prc_drawing import (
    FREE_PANELS,
    IMPACT_PANELS,
    make_prc_panels,
    plot_prc,
)
from twin.reports.report_data import DIRECTIONS, IMPACT_KEYS, extract_prc


def draw_free_running(
    view: DiscoveryView, runs: dict[int, FreeRuns], chosen: Sequence[int]
) -> CaptionedFigures:
    """Draw PRCs and impacts of the chosen logs, before left, after right."""
    for number in chosen:
        if number in runs:
            yield from _draw_log(view, runs[number], number)


def _draw_log(view: DiscoveryView, runs: FreeRuns, number: int) -> CaptionedFigures:
    name = view.title_suffix(number)
    stem = f"_{number}" if name else ""
    caption = (
        "One point per step, from its measured cycles. The twin runs free from the first sample, "
        "driven by the measured table acceleration, with the parameters fitted to all steps. In "
        "chaotic bands the trajectories diverge; compare amplitudes, not samples."
    )
    title = f"Pseudo-resonance curves, measured and twin{name}"
    yield CaptionedFigure(f"prc{stem}", title, caption, _draw_panels(runs, FREE_PANELS))
    if any(
        np.nan_to_num(extract_prc(runs[0], "measured", direction, side)[1]).any()
        for direction in DIRECTIONS
        for side in IMPACT_KEYS
    ):
        caption = "Mean over the measured cycles of a step, from the load cells and from the twin."
        title = f"Impacts per forcing cycle{name}"
        yield CaptionedFigure(f"impacts{stem}", title, caption, _draw_panels(runs, IMPACT_PANELS))


def _draw_panels(runs: FreeRuns, contents: Any) -> Figure:
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.6 * len(contents) + 0.6))
    axes = figure.subplots(len(contents), 2, sharex=True, sharey="row", squeeze=False)
    for column, (points, title) in enumerate(zip(runs, ("before", "after"), strict=True)):
        panels = make_prc_panels(axes[:, [column]], contents)
        plot_prc(panels, partial(extract_prc, points, "measured"), _dotted_style)
        plot_prc(panels, partial(extract_prc, points, "twin"), _circled_style)
        axes[0, column].set_title(title)
    for ax in axes[:, 1]:
        ax.set_ylabel("")
    driven = [
        direction for direction in DIRECTIONS if any(p.direction == direction for p in runs[0])
    ]
    handles = [
        *direction_handles(_dotted_style, "measured ", driven),
        *direction_handles(_circled_style, "twin ", driven),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def _dotted_style(direction: str) -> LineStyle:
    return {**measured_style(direction), "marker": "o", "ms": 4}


def _circled_style(direction: str) -> LineStyle:
    return {**twin_style(direction), "marker": "o", "ms": 6, "mfc": "none"}
