"""Figures of periodic branches: stable solid, unstable dashed, bifurcations by symbol.

Colors are periods, the bands chaotic motion.
"""

from pathlib import Path

import numpy as np

from twin.drawing.attractor_study import AttractorStudy, draw_attractor_figures
from twin.drawing.branch_curves import BranchSet, list_branch_keys, period_colour, plot_branches
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, PanelFigure, Picture
from twin.drawing.pictures import save_figures
from twin.drawing.plot_style import FIGURE_WIDTH_IN, GUIDE_COLOUR, LineStyle
from twin.dynamics.continuation import split_by_stability


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


def _draw_branches(branches: BranchSet) -> CaptionedFigures:
    """Draw every quantity over the parameter."""
    quantities = branches.quantities
    rows = len(quantities) // 2
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.4 * rows + 0.5), rows, 2)
    axes = figure.panels
    for ax, quantity in zip(axes.flat, quantities, strict=True):
        plot_branches(ax, branches, quantity)
    for ax in axes[-1]:
        ax.set_xlabel(branches.axis.label)
    figure.legend(list_branch_keys(branches), columns=6)
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
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.4))
    ax = figure.panels[0, 0]
    ax.set_yscale("log")
    ax.axhline(1.0, color=GUIDE_COLOUR, lw=0.8)
    for branch in branches.branches:
        x = branches.x(branch)
        y = np.array([abs(point.orbit.multipliers[0]) for point in branch.points])
        colour = period_colour(branch.points[0].orbit.periods)
        for first, last, stable in split_by_stability(branch.stable.tolist()):
            style: LineStyle = {"ls": "-", "lw": 1.5} if stable else {"ls": (0, (4, 2.2))}
            ax.plot(x[first : last + 1], y[first : last + 1], color=colour, **style)
    ax.set_xlabel(branches.axis.label)
    ax.set_ylabel("largest Floquet multiplier")
    figure.legend(list_branch_keys(branches)[:2], columns=2)
    yield CaptionedFigure(
        "multipliers",
        "Floquet multipliers",
        "Factor by which the largest deviation from the motion grows over one repetition of it: "
        "below 1 it dies out. It jumps where a contact begins to graze.",
        figure,
    )
