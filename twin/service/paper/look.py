"""How the paper's pictures look: colours, letters, bands of contact, dashed guides."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from twin.model.parameters import Parameters
from twin.service.close_ups import AT_REST, COLOUR, DASH, GUIDE, TWIN
from twin.service.figures import BAND, STYLE
from twin.service.paper.players import Motion

__all__ = ["AT_REST", "BAND", "COLOUR", "DASH", "DIRECTIONS", "GUIDE", "TWIN"]

DIRECTIONS = ("forward", "backward")
OF_GAP = {
    "G∞": "#2e9e5b", "G30": "#14296b", "G16": "#2f6fb3", "G10": "#63b4dd", "G4": "#7a3b9b",
    "G0": "#c4161c", "G-1": "#f4ac3d", "G-2": "#9ccf4f", "G-10": "#1b6e35",
}  # fmt: skip
TRANSITION = {
    "G4": "#111111", "G0": "#c4161c", "G-1": "#1559b0", "G-2": "#8fcf4a", "G-10": "#1b6e35",
}  # fmt: skip
UNSTABLE: dict[str, Any] = {"color": "#777777", "ls": (0, (1, 1.4)), "lw": 1.1}
PAPER_STYLE = {**STYLE, "axes.titlelocation": "center", "axes.grid": True, "figure.dpi": 100}


@dataclass(frozen=True, slots=True)
class Drawing:
    """A figure with the name of its file, its number in the paper, title and caption."""

    name: str
    number: str
    title: str
    caption: str
    figure: Figure


Drawings = Iterator[Drawing]


def minus(name: str) -> str:
    """A gap's name with a proper minus sign."""
    return name.replace("-", "−")


def letter(ax: Axes, which: str, text: str = "") -> None:
    """The panel's letter, and what it shows, above it."""
    ax.set_title(text)
    ax.text(0, 1.02, which, transform=ax.transAxes, weight="bold", ha="left", va="bottom", size=10)


def pen(direction: str, width: float = 1.2) -> dict[str, Any]:
    """Solid red forward, dashed blue backward, as the paper draws its experiments."""
    return {"color": COLOUR[direction], "ls": DASH[direction], "lw": width}


def ink(direction: str, width: float = 1.1) -> dict[str, Any]:
    """Black, solid forward, dashed backward, as the paper draws its model."""
    return {"color": TWIN, "ls": DASH[direction], "lw": width}


def directions_key(look: Callable[[str], dict[str, Any]], who: str = "") -> list[Line2D]:
    return [Line2D([], [], **look(one), label=f"{who}{one} sweep") for one in DIRECTIONS]


def closed(values: Float1D) -> Float1D:
    """A loop's values, the first one again at the end."""
    return np.append(values, values[0])


def portrait(ax: Axes, motion: Motion, **look: Any) -> None:
    """Phase portrait in mm and mm/s."""
    ax.plot(motion.u * 1e3, motion.v * 1e3, **look)


def mass_loop(ax: Axes, motion: Motion, mass: float, ring: bool, **look: Any) -> None:
    """Inertia force -M a in kN against u in mm; a `ring` closes."""
    u, force = motion.u * 1e3, -mass * motion.a / 1e3
    ax.plot(*((closed(u), closed(force)) if ring else (u, force)), **look)


def bumper_loops(ax: Axes, motion: Motion, ring: bool, **look: Any) -> None:
    """Contact force in kN against the position of the bumper in mm, both sides."""
    for place, force in ((motion.v_r, motion.force_r), (motion.v_l, motion.force_l)):
        x, y = place * 1e3, force / 1e3
        ax.plot(*((closed(x), closed(y)) if ring else (x, y)), **look)


def obstacles(parameters: Parameters, draw: Callable[..., Any], **look: Any) -> None:
    """Dashed lines where the bumpers stand at rest, or where a precompressed one would let go."""
    for side, gap_m in ((1, parameters.gap_r), (-1, parameters.gap_l)):
        draw(side * abs(gap_m) * 1e3, **{**AT_REST, **look})


def contact_bands(
    ax: Axes, motion: Motion, colour: str, contact_n: float = 0.0, alpha: float = 0.16
) -> None:
    """Vertical bands over each contact; where both bumpers touch they darken."""
    for touch in (motion.force_r, -motion.force_l):
        ax.fill_between(
            motion.time, 0, 1, where=touch > contact_n, transform=ax.get_xaxis_transform(),
            color=colour, alpha=alpha, lw=0, zorder=0.5,
        )  # fmt: skip
