"""Plot style of the paper's figures: colors, panel letters, contact bands, guide lines."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from twin.model.parameters import Parameters
from twin.reports.figures import HYSTERESIS_COLOURS, RC_PARAMS
from twin.reports.players import SystemMotion
from twin.reports.step_figures import (
    DIRECTION_COLOURS,
    DIRECTION_DASHES,
    GUIDE_COLOUR,
    REST_LINE_STYLE,
    TWIN_COLOUR,
)

__all__ = [
    "DIRECTIONS",
    "DIRECTION_COLOURS",
    "DIRECTION_DASHES",
    "GUIDE_COLOUR",
    "HYSTERESIS_COLOURS",
    "REST_LINE_STYLE",
    "TWIN_COLOUR",
]

DIRECTIONS = ("forward", "backward")
GAP_COLOURS = {
    "G∞": "#2e9e5b", "G30": "#14296b", "G16": "#2f6fb3", "G10": "#63b4dd", "G4": "#7a3b9b",
    "G0": "#c4161c", "G-1": "#f4ac3d", "G-2": "#9ccf4f", "G-10": "#1b6e35",
}  # fmt: skip
TRANSITION_COLOURS = {
    "G4": "#111111", "G0": "#c4161c", "G-1": "#1559b0", "G-2": "#8fcf4a", "G-10": "#1b6e35",
}  # fmt: skip
UNSTABLE_STYLE: dict[str, Any] = {"color": "#777777", "ls": (0, (1, 1.4)), "lw": 1.1}
PAPER_RC_PARAMS = {
    **RC_PARAMS,
    "axes.titlelocation": "center",
    "axes.grid": True,
    "figure.dpi": 100,
}


@dataclass(frozen=True, slots=True)
class PaperFigure:
    """Figure with its file name, number in the paper, title and caption."""

    name: str
    number: str
    title: str
    caption: str
    figure: Figure


PaperFigures = Iterator[PaperFigure]


def format_minus(name: str) -> str:
    """Return the name of a gap with a typographic minus sign."""
    return name.replace("-", "−")


def label_panel(ax: Axes, panel_letter: str, text: str = "") -> None:
    """Write the panel letter and a title above a panel."""
    ax.set_title(text)
    ax.text(
        0,
        1.02,
        panel_letter,
        transform=ax.transAxes,
        weight="bold",
        ha="left",
        va="bottom",
        size=10,
    )


def experiment_style(direction: str, width: float = 1.2) -> dict[str, Any]:
    """Return the line style of the paper's experiments: solid red forward, dashed blue backward."""
    return {"color": DIRECTION_COLOURS[direction], "ls": DIRECTION_DASHES[direction], "lw": width}


def model_style(direction: str, width: float = 1.1) -> dict[str, Any]:
    """Return the line style of the paper's model: black, solid forward, dashed backward."""
    return {"color": TWIN_COLOUR, "ls": DIRECTION_DASHES[direction], "lw": width}


def direction_handles(
    make_style: Callable[[str], dict[str, Any]], prefix: str = ""
) -> list[Line2D]:
    return [
        Line2D([], [], **make_style(direction), label=f"{prefix}{direction} sweep")
        for direction in DIRECTIONS
    ]


def close_loop(values: Float1D) -> Float1D:
    """Return the values with the first one appended, so that a plotted loop is closed."""
    return np.append(values, values[0])


def plot_phase_portrait(ax: Axes, motion: SystemMotion, **style: Any) -> None:
    """Plot the phase portrait, velocity in mm/s over u in mm."""
    ax.plot(motion.u * 1e3, motion.v * 1e3, **style)


def plot_inertia_loop(
    ax: Axes, motion: SystemMotion, mass: float, closed: bool, **style: Any
) -> None:
    """Plot the inertia force -M a in kN over u in mm; `closed` joins the ends of the loop."""
    u, force = motion.u * 1e3, -mass * motion.a / 1e3
    ax.plot(*((close_loop(u), close_loop(force)) if closed else (u, force)), **style)


def plot_bumper_loops(ax: Axes, motion: SystemMotion, closed: bool, **style: Any) -> None:
    """Plot the contact force in kN over the bumper position in mm, both sides."""
    for position, force in ((motion.v_r, motion.force_r), (motion.v_l, motion.force_l)):
        x, y = position * 1e3, force / 1e3
        ax.plot(*((close_loop(x), close_loop(y)) if closed else (x, y)), **style)


def draw_obstacles(parameters: Parameters, draw: Callable[..., Any], **style: Any) -> None:
    """Draw dashed lines at the bumpers at rest, or where contact of a precompressed one ends."""
    for side, gap_m in ((1, parameters.gap_r), (-1, parameters.gap_l)):
        draw(side * abs(gap_m) * 1e3, **{**REST_LINE_STYLE, **style})


def shade_contact(
    ax: Axes, motion: SystemMotion, colour: str, contact_n: float = 0.0, alpha: float = 0.16
) -> None:
    """Shade each contact as a vertical band, darker where both bumpers are in contact."""
    for force in (motion.force_r, -motion.force_l):
        ax.fill_between(
            motion.time, 0, 1, where=force > contact_n, transform=ax.get_xaxis_transform(),
            color=colour, alpha=alpha, lw=0, zorder=0.5,
        )  # fmt: skip
