"""Sketches: position and deformation of a bumper (Fig. 4), the numerical model (Fig. 10)."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from twin.drawing.panels import CaptionedFigure, CaptionedFigures
from twin.drawing.pictures import label_panel
from twin.drawing.plot_style import GUIDE_COLOUR, REST_LINE_STYLE, SIDE_COLOURS, LineStyle
from twin.paper.study import PaperStudy
from twin.results.measured_campaign import MeasuredCampaign

INK, MASS_COLOUR = "#222222", "#dfe3e8"
SPRING_COILS, SPRING_HEIGHT = 5, 0.22
PANEL_GAPS = (("a", "$G_{0R} > 0$", 1.0), ("b", "$G_{0R} = 0$", 0.0), ("c", "$G_{0R} < 0$", -1.0))
END_POSITION = 2.2  # of the bumper's end in every panel of Fig. 4, from the mass at rest


def draw_sketches(study: PaperStudy, campaign: MeasuredCampaign | None) -> CaptionedFigures:
    """Draw Figs. 4 and 10, which show no results."""
    if campaign is not None:
        return
    yield _draw_positions()
    yield _draw_model()


def _draw_positions() -> CaptionedFigure:
    figure = Figure(figsize=(11, 2.5))
    for ax, (letter, title, gap) in zip(figure.subplots(1, 3), PANEL_GAPS, strict=True):
        _draw_position(ax, gap)
        label_panel(ax, letter, title)
    return CaptionedFigure(
        "fig04_positions", "Position and deformation of the right bumper",
        "Position v_R = u_R + G_0R, from the side of the mass at rest, for a positive, b zero and "
        "c negative initial gap. Solid: the mass has moved by u to the right and compresses the "
        "bumper. Dashed: side of the mass at rest (0) and end of the unloaded bumper (G_0R); in c "
        "the bumper is compressed by −G_0R already at rest.",
        figure, "4",
    )  # fmt: skip


def _draw_position(ax: Axes, gap: float) -> None:
    """Draw one panel of Fig. 4: mass, bumper and wall, compressed to `END_POSITION`."""
    _hide_axes(ax, (-2.7, 5.4), (-1.75, 2.0))
    ax.add_patch(Rectangle((END_POSITION - 1.9, -0.75), 1.9, 1.5, fc=MASS_COLOUR, ec=INK, lw=1.2))
    ax.text(END_POSITION - 0.95, 0, "$M$", ha="center", va="center", size=11)
    _draw_wall(ax, 4.9, (-0.95, 0.95), 1)
    _draw_bumper(ax, END_POSITION, 4.9, SIDE_COLOURS["right"], 0.0)
    for x, label in ((0.0, "0"), (gap, "$G_{0R}$")) if gap else ((0.0, "$G_{0R} = 0$"),):
        ax.plot([x, x], [-1.25, 1.25], **{**REST_LINE_STYLE, "color": INK})
        ax.text(x, -1.32, label, ha="center", va="top", size=9)
    ax.plot([END_POSITION, END_POSITION], [0.75, 1.75], color=GUIDE_COLOUR, lw=0.7)
    _draw_dimension(ax, 0.0, END_POSITION, 1.62, "$v_R$")
    _draw_dimension(ax, gap, END_POSITION, 1.08, "$u_R$", SIDE_COLOURS["right"])


def _draw_model() -> CaptionedFigure:
    figure = Figure(figsize=(9.5, 4.2))
    ax = figure.subplots()
    _hide_axes(ax, (-6.6, 6.6), (-1.5, 4.2))
    ax.plot([-6.2, 6.2], [0, 0], color=INK, lw=1.4)
    ax.add_patch(
        Rectangle((-6.2, -0.28), 12.4, 0.28, fc="none", ec=GUIDE_COLOUR, hatch="////", lw=0)
    )
    ax.add_patch(Rectangle((-1.4, 0.4), 2.8, 1.6, fc=MASS_COLOUR, ec=INK, lw=1.3))
    ax.text(0, 1.2, "$M$", ha="center", va="center", size=13)
    for x in (-0.9, 0.0, 0.9):
        ax.add_patch(Circle((x, 0.2), 0.2, fc="white", ec=INK, lw=1.0))
    for side, name in ((1, "R"), (-1, "L")):
        colour = SIDE_COLOURS["right" if side > 0 else "left"]
        _draw_wall(ax, 5.4 * side, (0, 2.2 if side > 0 else 3.9), side)
        _draw_bumper(ax, 2.7 * side, 5.4 * side, colour, 1.2)
        ax.text(4.15 * side, 1.85, f"$K_{name}$", ha="center", va="bottom", color=colour, size=11)
        ax.text(4.15 * side, 0.52, f"$C_{name}$", ha="center", va="top", color=colour, size=11)
        _draw_dimension(ax, 1.4 * side, 2.7 * side, 0.25, f"$G_{{0{name}}}$")
        ax.annotate(
            "", (2.7 * side + 0.7, 2.35), (2.7 * side, 2.35), arrowprops=_arrow("-|>", colour)
        )
        ax.plot([2.7 * side] * 2, [1.85, 2.45], color=colour, lw=0.8)
        ax.text(
            2.7 * side + 0.8, 2.35, f"$u_{name}$", ha="left", va="center", color=colour, size=11
        )
    ax.plot([-1.0, -1.0, -1.0], [2.0, 2.9, 3.6], color=INK, lw=1.3)
    _draw_spring(ax, -5.4, -1.0, 3.5, INK)
    _draw_dashpot(ax, -5.4, -1.0, 2.95, INK)
    ax.text(-3.2, 3.75, "$K$", ha="center", va="bottom", size=11)
    ax.text(-2.35, 2.8, "$C$", ha="center", va="top", size=11)
    ax.annotate("", (1.0, 2.75), (0.0, 2.75), arrowprops=_arrow("-|>", INK))
    ax.plot([0, 0], [2.0, 2.85], color=INK, lw=0.8)
    ax.text(1.1, 2.75, "$u(t)$", ha="left", va="center", size=11)
    ax.annotate("", (1.3, -0.75), (-1.3, -0.75), arrowprops=_arrow("<|-|>", INK))
    ax.text(0, -0.9, "table acceleration $A(t)$", ha="center", va="top", size=10)
    return CaptionedFigure(
        "fig10_model", "The simplified nonlinear model",
        "Mass M on the damper (K, C); right and left bumper (K_j, C_j) at the initial gaps G_0j, "
        "linear spring and dashpot each. u is the displacement of the mass relative to the table, "
        "u_j the deformation of a bumper; right is positive. A bumper pushes and never pulls: the "
        "gaps, the one-sided contact and the impacts are what is nonlinear.",
        figure, "10",
    )  # fmt: skip


def _hide_axes(ax: Axes, x_limits: tuple[float, float], y_limits: tuple[float, float]) -> None:
    ax.set_xlim(*x_limits)
    ax.set_ylim(*y_limits)
    ax.set_aspect("equal")
    ax.axis("off")


def _arrow(style: str, colour: str) -> LineStyle:
    return {"arrowstyle": style, "color": colour, "lw": 1.1, "shrinkA": 0, "shrinkB": 0}


def _draw_dimension(
    ax: Axes, start: float, stop: float, y: float, text: str, colour: str = INK
) -> None:
    """Draw a double arrow between two positions with its label in the middle."""
    ax.annotate("", (stop, y), (start, y), arrowprops=_arrow("<|-|>", colour))
    ax.text(
        (start + stop) / 2, y, text, ha="center", va="center", color=colour, size=10,
        bbox={"fc": "white", "lw": 0, "pad": 1},
    )  # fmt: skip


def _draw_wall(ax: Axes, x: float, y_range: tuple[float, float], side: int) -> None:
    """Draw a wall, hatched on the side away from the mass."""
    low, high = y_range
    ax.plot([x, x], [low, high], color=INK, lw=1.6)
    left = x if side > 0 else x - 0.3
    ax.add_patch(
        Rectangle((left, low), 0.3, high - low, fc="none", ec=GUIDE_COLOUR, hatch="////", lw=0)
    )


def _draw_bumper(ax: Axes, end: float, wall: float, colour: str, y: float) -> None:
    """Draw a bumper: end plate, spring above and dashpot below, to the wall."""
    ax.plot([end, end], [y - 0.65, y + 0.65], color=colour, lw=2.6, solid_capstyle="butt")
    _draw_spring(ax, end, wall, y + 0.35, colour)
    _draw_dashpot(ax, end, wall, y - 0.35, colour)


def _draw_spring(ax: Axes, start: float, stop: float, y: float, colour: str) -> None:
    count = 2 * SPRING_COILS
    x = np.concatenate([[0.0], 0.2 + 0.6 * np.arange(count + 1) / count, [1.0]])
    offsets = np.concatenate([[0.0, 0.0], [(-1.0) ** k for k in range(count - 1)], [0.0, 0.0]])
    ax.plot(start + (stop - start) * x, y + SPRING_HEIGHT * offsets, color=colour, lw=1.2)


def _draw_dashpot(ax: Axes, start: float, stop: float, y: float, colour: str) -> None:
    cup, piston, closed = (start + (stop - start) * share for share in (0.35, 0.55, 0.65))
    style: LineStyle = {"color": colour, "lw": 1.2}
    height = 0.2
    ax.plot([start, piston], [y, y], **style)
    ax.plot([piston, piston], [y - 0.8 * height, y + 0.8 * height], **{**style, "lw": 2.2})
    ax.plot([cup, closed, closed, cup], [y + height, y + height, y - height, y - height], **style)
    ax.plot([closed, stop], [y, y], **style)
