"""Figures of the free-running twin before and after: PRCs and impacts per cycle."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from table_io.records import PrcPoint
from twin.reports.discovery.figure_data import DiscoveryView
from twin.reports.discovery.free_running import FreeRuns
from twin.reports.report_data import DIRECTIONS
from twin.reports.step_figures import (
    DIRECTION_COLOURS,
    DIRECTION_DASHES,
    FIGURE_WIDTH_IN,
    TWIN_COLOUR,
    CaptionedFigures,
)

LABELS = {
    "eta_d": r"$\eta_d$, displacement", "eta_a": r"$\eta_a$, acceleration",
    "impacts_right": "impacts right", "impacts_left": "impacts left",
}  # fmt: skip


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
    figure = _draw_panels(runs, ["eta_d", "eta_a"])
    yield f"prc{stem}", f"Pseudo-resonance curves, measured and twin{name}", caption, figure
    sides = ["impacts_right", "impacts_left"]
    if any(
        _select_curve(runs[0], "measured", direction, side)[1].any()
        for direction in DIRECTIONS
        for side in sides
    ):
        caption = "Mean over the measured cycles of a step, from the load cells and from the twin."
        title = f"Impacts per forcing cycle{name}"
        yield f"impacts{stem}", title, caption, _draw_panels(runs, sides)


def _select_curve(
    points: Sequence[PrcPoint], source: str, direction: str, name: str
) -> tuple[Float1D, Float1D]:
    """Return (frequency in Hz, quantity) of one direction, in ascending order of frequency."""
    rows = []
    for point in points:
        values = getattr(point, source)
        value = getattr(values, name) if values is not None else np.nan
        if point.direction == direction:
            rows.append((point.frequency_hz, float(np.mean(value)) if np.size(value) else np.nan))
    table = np.array(sorted(rows), dtype=np.float64).reshape(-1, 2)
    return table[:, 0], np.nan_to_num(table[:, 1]) if "impacts" in name else table[:, 1]


def _draw_panels(runs: FreeRuns, names: list[str]) -> Figure:
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.6 * len(names) + 0.6))
    axes = figure.subplots(len(names), 2, sharex=True, sharey="row", squeeze=False)
    for column, (points, title) in enumerate(zip(runs, ("before", "after"), strict=True)):
        for ax, name in zip(axes[:, column], names, strict=True):
            _draw_curves(ax, points, name)
            ax.set_ylabel(LABELS[name] if column == 0 else "")
        axes[0, column].set_title(title)
        axes[-1, column].set_xlabel("frequency in Hz")
    for ax in axes[:, 0]:
        ax.set_ylim(0, 1.06 * ax.get_ylim()[1])
    driven = [
        direction for direction in DIRECTIONS if any(p.direction == direction for p in runs[0])
    ]
    handles = [
        Line2D(
            [],
            [],
            color=DIRECTION_COLOURS[direction],
            marker="o",
            lw=2.2,
            label=f"measured {direction}",
        )
        for direction in driven
    ]
    handles += [
        Line2D([], [], color=TWIN_COLOUR, ls=DIRECTION_DASHES[direction], marker="o", mfc="none",
               ms=6, lw=0.8, label=f"twin {direction}")
        for direction in driven
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def _draw_curves(ax: Axes, points: Sequence[PrcPoint], name: str) -> None:
    for direction in DIRECTIONS:
        style: dict[str, Any] = {"color": DIRECTION_COLOURS[direction], "lw": 2.2, "ms": 4}
        ax.plot(*_select_curve(points, "measured", direction, name), "o-", **style)
    for direction in DIRECTIONS:
        twin: dict[str, Any] = {
            "color": TWIN_COLOUR,
            "ls": DIRECTION_DASHES[direction],
            "lw": 0.8,
            "ms": 6,
            "mfc": "none",
        }
        ax.plot(*_select_curve(points, "twin", direction, name), marker="o", **twin)
