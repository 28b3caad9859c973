"""Figures of periodic branches: stable solid, unstable dashed, bifurcations by symbol.

Colors are periods, the bands chaotic motion.
"""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from twin.drawing.attractor_study import AttractorStudy, draw_attractor_figures
from twin.drawing.branch_curves import BranchQuantity, BranchSet
from twin.drawing.plot_style import (
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    CaptionedFigure,
    CaptionedFigures,
    LineStyle,
    Picture,
    save_figures,
)
from twin.dynamics.continuation import split_by_stability

PERIOD_COLOURS = {
    1: "#111111", 2: "#1559b0", 3: "#2e9e5b", 4: "#7a3b9b", 5: "#c4161c", 6: "#b3730f",
}  # fmt: skip
LONG_PERIOD_COLOUR = "#6b7480"
CHAOS_COLOUR = "#f3d9e6"
BIFURCATION_MARKERS: dict[str, LineStyle] = {
    "fold": {"marker": "s", "mfc": "#c4161c"},
    "period doubling": {"marker": "^", "mfc": "#1559b0"},
    "pitchfork": {"marker": "D", "mfc": "#2e9e5b"},
    "Neimark-Sacker": {"marker": "*", "mfc": "#7a3b9b"},
    "grazing": {"marker": "o", "mfc": "white"},
}
MARKER_SIZE = {"s": 5.5, "^": 6.0, "D": 5.0, "*": 8.5, "o": 5.0}


def period_colour(periods: int) -> str:
    """Return the color of the branches that repeat after `periods` periods of the drive."""
    return PERIOD_COLOURS.get(periods, LONG_PERIOD_COLOUR)


def draw_branch_figures(
    branches: BranchSet, folder: Path, attractors: AttractorStudy | None = None
) -> list[Picture]:
    """Draw branches, multipliers and what is known of attractors into PNG files, in this order."""

    def draw() -> CaptionedFigures:
        yield from _draw_branches(branches)
        yield from _draw_multipliers(branches)
        if attractors is not None:
            yield from draw_attractor_figures(attractors, branches)

    return save_figures(draw(), folder)


def plot_branches(
    ax: Axes, branches: BranchSet, quantity: BranchQuantity, scale: float = 1.0
) -> None:
    """Draw `scale` times a quantity of the branches into `ax`, measured points, chaotic bands."""
    for low, high in branches.chaotic:
        factor = branches.axis.factor
        ax.axvspan(factor * low, factor * high, color=CHAOS_COLOUR, lw=0, zorder=0.4)
    for curve in branches.measured:
        ax.plot(
            curve.x, scale * curve.values[quantity.key], "o", color=curve.colour, ms=5.5,
            alpha=0.55, mec="none", zorder=1.5,
        )  # fmt: skip
    for branch in branches.branches:
        x, y = branches.x(branch), scale * branches.y(branch, quantity)
        colour = period_colour(branch.points[0].orbit.periods)
        for first, last, stable in split_by_stability(branch.stable.tolist()):
            piece = slice(first, last + 1)
            style: LineStyle = {"ls": "-", "lw": 1.5} if stable else {"ls": (0, (4, 2.2))}
            ax.plot(x[piece], y[piece], color=colour, **style)
        for bifurcation in branch.bifurcations:
            marker = BIFURCATION_MARKERS[bifurcation.kind]
            ax.plot(
                branches.axis.factor * bifurcation.value, y[bifurcation.index], ls="",
                mec="#111111", mew=0.7, ms=MARKER_SIZE[marker["marker"]], zorder=3, **marker,
            )  # fmt: skip
    ax.set_ylabel(quantity.label)
    ax.set_ylim(bottom=0)


def branch_handles(branches: BranchSet) -> list[Any]:
    """Return the legend of `plot_branches`: what is drawn, and nothing else."""
    periods = sorted({branch.points[0].orbit.periods for branch in branches.branches})
    kinds = {bifurcation.kind for _, bifurcation in branches.bifurcations}
    handles: list[Any] = [
        Line2D([], [], color=GUIDE_COLOUR, lw=1.5, label="stable"),
        Line2D([], [], color=GUIDE_COLOUR, ls=(0, (4, 2.2)), label="unstable"),
    ]
    if periods not in ([], [1]):
        handles += [
            Line2D([], [], color=period_colour(n), lw=3, label=f"period {n}") for n in periods
        ]
    handles += [
        Line2D(
            [], [], ls="", mec="#111111", mew=0.7, ms=MARKER_SIZE[marker["marker"]], label=kind,
            **marker,
        )
        for kind, marker in BIFURCATION_MARKERS.items()
        if kind in kinds
    ]  # fmt: skip
    if branches.chaotic:
        handles.append(Patch(color=CHAOS_COLOUR, label="chaos"))
    handles += [
        Line2D([], [], ls="", marker="o", color=curve.colour, alpha=0.55, ms=5.5, label=curve.label)
        for curve in branches.measured
    ]
    return handles


def _draw_branches(branches: BranchSet) -> CaptionedFigures:
    """Draw every quantity over the parameter."""
    quantities = branches.quantities
    rows = len(quantities) // 2
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 3.4 * rows + 0.5))
    axes = figure.subplots(rows, 2, sharex=True, squeeze=False)
    for ax, quantity in zip(axes.flat, quantities, strict=True):
        plot_branches(ax, branches, quantity)
    for ax in axes[-1]:
        ax.set_xlabel(branches.axis.label)
    figure.legend(handles=branch_handles(branches), loc="outside upper center", ncols=6)
    caption = (
        "Periodic motions of the model: half of the swing of u and of the total acceleration, and "
        "the largest contact force of each side. A stable motion is one that the table shows; an "
        "unstable one separates the basins of two stable ones."
    )
    if branches.chaotic:
        caption += " In the shaded ranges the motion is chaotic."
    yield CaptionedFigure("branches", "Branches of periodic motions", caption, figure)


def _draw_multipliers(branches: BranchSet) -> CaptionedFigures:
    """Draw the magnitude of the largest Floquet multiplier."""
    if not branches.branches:
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 3.4))
    ax = figure.subplots()
    ax.axhline(1.0, color=GUIDE_COLOUR, lw=0.8)
    for branch in branches.branches:
        x = branches.x(branch)
        y = np.array([abs(point.orbit.multipliers[0]) for point in branch.points])
        colour = period_colour(branch.points[0].orbit.periods)
        for first, last, stable in split_by_stability(branch.stable.tolist()):
            style: LineStyle = {"ls": "-", "lw": 1.5} if stable else {"ls": (0, (4, 2.2))}
            ax.semilogy(x[first : last + 1], y[first : last + 1], color=colour, **style)
    ax.set_xlabel(branches.axis.label)
    ax.set_ylabel("largest Floquet multiplier")
    figure.legend(handles=branch_handles(branches)[:2], loc="outside upper center", ncols=2)
    yield CaptionedFigure(
        "multipliers",
        "Floquet multipliers",
        "Factor by which the largest deviation from the motion grows over one repetition of it: "
        "below 1 it dies out. It jumps where a contact begins to graze.",
        figure,
    )
