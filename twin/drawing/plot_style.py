"""Plot style of every figure: colors, line styles and figure size.

Measured: wide and pale, red forward, blue backward.
Twin: thin, black, solid forward, dashed backward.
"""

from collections.abc import Callable, Sequence
from typing import Any

from twin.drawing.panels import Key
from twin.results.report_data import DIRECTIONS

FIGURE_WIDTH_IN = 10.0
LineStyle = dict[str, Any]  # keywords of a matplotlib line
DIRECTION_COLOURS = {"forward": "#c4161c", "backward": "#1559b0"}
SIDE_COLOURS = {"right": "#c4161c", "left": "#1559b0"}
DIRECTION_DASHES: dict[str, Any] = {"forward": "-", "backward": (0, (4, 1.8))}
TWIN_COLOUR, GUIDE_COLOUR, ZERO_COLOUR = "#111111", "#555555", "#333333"
HYSTERESIS_COLOURS = {"right": "#fff0a8", "left": "#b9f0f4"}
PRECOMPRESSION_COLOUR = "#d4d4d4"
FREE_FLIGHT_COLOUR = "#2e9e5b"
GAP_COLOURS = {
    "G∞": FREE_FLIGHT_COLOUR, "G30": "#14296b", "G16": "#2f6fb3", "G10": "#63b4dd",
    "G4": "#7a3b9b", "G0": "#c4161c", "G-1": "#f4ac3d", "G-2": "#9ccf4f", "G-10": "#1b6e35",
}  # fmt: skip
TRANSITION_COLOURS = {
    "G4": "#111111", "G0": "#c4161c", "G-1": "#1559b0", "G-2": "#8fcf4a", "G-10": "#1b6e35",
}  # fmt: skip
REST_LINE_STYLE: LineStyle = {"color": GUIDE_COLOUR, "ls": (0, (5, 3)), "lw": 0.8}
UNSTABLE_STYLE: LineStyle = {"color": "#777777", "ls": (0, (1, 1.4)), "lw": 1.1}
MEASURED_ALPHA = 0.45
DirectionStyle = Callable[[str], LineStyle]  # line style of a direction


def measured_style(direction: str, width: float = 3.2) -> LineStyle:
    """Return a wide, pale line in the color of the direction: a twin line on top shows."""
    return {"color": DIRECTION_COLOURS[direction], "lw": width, "alpha": MEASURED_ALPHA}


def twin_style(direction: str, width: float = 0.9) -> LineStyle:
    """Return the line style of a twin or model: black, solid forward, dashed backward."""
    return {"color": TWIN_COLOUR, "ls": DIRECTION_DASHES[direction], "lw": width}


def experiment_style(direction: str, width: float = 1.2) -> LineStyle:
    """Return the line style of the paper's experiments: solid red forward, dashed blue backward."""
    return {"color": DIRECTION_COLOURS[direction], "ls": DIRECTION_DASHES[direction], "lw": width}


def guide_style(direction: str) -> LineStyle:
    """Return the line style of a direction in legends whose colors mean something else."""
    return {"color": GUIDE_COLOUR, "ls": DIRECTION_DASHES[direction]}


def direction_keys(
    make_style: DirectionStyle, prefix: str = "", directions: Sequence[str] = DIRECTIONS
) -> list[Key]:
    """Return a legend entry per direction, labelled "<prefix><direction>"."""
    return [Key(f"{prefix}{direction}", make_style(direction)) for direction in directions]


def format_minus(name: str) -> str:
    """Return the name of a gap with a typographic minus sign."""
    return name.replace("-", "−")
