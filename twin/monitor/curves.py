"""Pseudo-resonance curves of the points so far, measured and twin, in braille characters."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from rich.text import Text

from table_io.block import Float2D
from twin.monitor.panels import DIM_STYLE
from twin.monitor.run_view import RunView, eta_d
from twin.viewer.plots import nice_ceil
from twin.viewer.view_model import ResponseQuantity

FORWARD_COLOUR, BACKWARD_COLOUR = "bright_red", "dodger_blue1"
TWIN_COLOUR, STEP_COLOUR = "white", "grey30"
CURVE_MARKS = {  # style and mark
    ("twin", "forward"): (TWIN_COLOUR, "○"), ("twin", "backward"): (DIM_STYLE, "○"),
    ("measured", "forward"): (FORWARD_COLOUR, ""), ("measured", "backward"): (BACKWARD_COLOUR, ""),
    ("orbit", "forward"): (FORWARD_COLOUR, "●"), ("orbit", "backward"): (BACKWARD_COLOUR, "●"),
}  # fmt: skip
DOT_BITS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
BLANK_BRAILLE = 0x2800
AXIS_STYLE = "grey50"
MAX_DOT = 1e4  # dots: points farther out are clipped
MIN_MARK_SPACING = 3  # cells between the marks of a curve


@dataclass(frozen=True, slots=True)
class PlotCurve:
    """Curve of points (x, y) joined by lines, with a rich style and a mark where it fits."""

    style: str
    mark: str
    points: Sequence[tuple[float, float]]


def draw_prc(view: RunView, width: int, height: int, value: ResponseQuantity = eta_d) -> list[Text]:
    """Plot the PRC so far, measured in color, twin in white, with the frequency of the step.

    Of a continuation, the amplitudes of measured orbits in mm over those of the plan.
    """
    plot = view.plot(value)
    if plot.range_hz is None:
        is_known = view.run_state.start is not None
        text = "a displacement history has no curves over frequency"
        return [Text(text if is_known else "waiting for the test plan", DIM_STYLE)]
    y_max = nice_ceil(plot.highest or 1.0)
    curves = [
        PlotCurve(*CURVE_MARKS[curve.source, curve.direction], curve.points)
        for curve in plot.curves
    ]
    if plot.newest is not None:
        style, _ = CURVE_MARKS["orbit", plot.newest.direction]
        curves.append(PlotCurve(style, "●", plot.newest.points))
    if plot.step_hz is not None:
        line = [(plot.step_hz, 0.0), (plot.step_hz, y_max)]
        curves.insert(0, PlotCurve(STEP_COLOUR, "", line))
    return plot_curves(curves, plot.range_hz, y_max, width, height, "Hz")


def plot_curves(
    curves: Sequence[PlotCurve],
    x: tuple[float, float],
    top: float,
    width: int,
    height: int,
    unit: str,
) -> list[Text]:
    """Plot curves over the range `x` from 0 to `top` with axis labels.

    Returns `height` lines of at most `width` cells. The later curve sets the style of a shared
    character.
    """
    margin = max(len(_format_number(top)), len(_format_number(top / 2)))
    columns, rows = max(width - margin - 1, 1), max(height - 2, 1)
    cells = np.full((rows, columns), BLANK_BRAILLE)
    styles = np.full((rows, columns), -1)
    marks: dict[tuple[int, int], tuple[str, str]] = {}
    scale = np.array([(2 * columns - 1) / ((x[1] - x[0]) or 1.0), (4 * rows - 1) / (top or 1.0)])
    for number, curve in enumerate(curves):
        dots = (np.array(curve.points, dtype=float).reshape(-1, 2) - (x[0], 0.0)) * scale
        dots = dots[np.isfinite(dots).all(axis=1)].clip(-MAX_DOT, MAX_DOT)
        for column, row in _rasterize(dots):
            if 0 <= column < 2 * columns and 0 <= row < 4 * rows:
                cell = (4 * rows - 1 - row) // 4, column // 2
                cells[cell] |= DOT_BITS[(4 * rows - 1 - row) % 4, column % 2]
                styles[cell] = number
        last_mark = -MIN_MARK_SPACING
        for column, row in np.rint(dots).astype(int).tolist() if curve.mark else ():
            if column // 2 >= last_mark + MIN_MARK_SPACING and 0 <= row < 4 * rows:
                last_mark = column // 2
                marks[(4 * rows - 1 - row) // 4, last_mark] = curve.mark, curve.style
    numbers = {0: _format_number(top), rows // 2: _format_number(top / 2)}
    lines = []
    for row in range(rows):
        line = Text(f"{numbers.get(row, ''):>{margin}}", AXIS_STYLE).append(
            "┤" if row in numbers else "│"
        )
        letters = [
            marks.get((row, column)) or _cell_text(cells[row, column], styles[row, column], curves)
            for column in range(columns)
        ]
        for style, cells_in_style in groupby(letters, key=lambda cell: cell[1]):
            line.append("".join(letter for letter, _ in cells_in_style), style)
        lines.append(line)
    return [*lines, *_draw_x_axis(x, margin, columns, unit)]


def _cell_text(dots: int, number: int, curves: Sequence[PlotCurve]) -> tuple[str, str]:
    """Return (character, style); a space without dots: not every font has the blank braille."""
    return (" ", "") if dots == BLANK_BRAILLE else (chr(dots), curves[number].style)


def _rasterize(points: Float2D) -> list[tuple[int, int]]:
    """Return every dot (column, row) on the straight lines between the points."""
    dots = [tuple(np.rint(points[0]).astype(int))] if len(points) else []
    for a, b in pairwise(points):
        count = max(int(np.ceil(np.abs(b - a).max())), 1)
        line = a + (b - a) * np.linspace(0.0, 1.0, count + 1)[:, None]
        dots += [tuple(dot) for dot in np.rint(line).astype(int)]
    return dots


def _draw_x_axis(x: tuple[float, float], margin: int, columns: int, unit: str) -> list[Text]:
    """Draw the x axis and its labels: both ends, and the middle if there is space."""
    ticks = {0: x[0], columns - 1: x[1]}
    if columns >= 30:
        ticks[columns // 2] = (x[0] + x[1]) / 2
    axis = "".join("┴" if column in ticks else "─" for column in range(columns))
    labels = [" "] * (margin + 1 + columns)
    for column, value in ticks.items():
        text = f"{value:.3g}" + (f" {unit}" if column == columns - 1 else "")
        start = (
            margin
            + 1
            + column
            - (0 if column == 0 else len(text) - 1 if column == columns - 1 else 2)
        )
        labels[start : start + len(text)] = text
    return [Text(f"{'0':>{margin}}└{axis}", AXIS_STYLE), Text("".join(labels), AXIS_STYLE)]


def _format_number(value: float) -> str:
    return f"{value:.3g}"
