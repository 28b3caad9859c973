"""Curves in a text: eight dots to a character, two wide and four high."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby, pairwise

import numpy as np
from rich.text import Text

from table_io.block import Float2D

DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
EMPTY = 0x2800
AXIS = "grey50"
FAR = 1e4  # dots: what lies farther out is as good as there
APART = 3  # cells from one mark of a curve to its next


@dataclass(frozen=True, slots=True)
class Curve:
    """Points (x, y) joined by lines, in a style of rich, with a mark upon those that have room."""

    style: str
    points: Sequence[tuple[float, float]]
    mark: str = ""


def plot(
    curves: Sequence[Curve], x: tuple[float, float], top: float, width: int, height: int, unit: str
) -> list[Text]:
    """`height` lines of at most `width` cells: curves over `x` from 0 to `top`, both axes numbered.

    Where curves share a character it has the style of the later one.
    """
    left = max(len(_number(top)), len(_number(top / 2)))
    wide, high = max(width - left - 1, 1), max(height - 2, 1)
    cells = np.full((high, wide), EMPTY)
    styles = np.full((high, wide), -1)
    marks: dict[tuple[int, int], tuple[str, str]] = {}
    scale = np.array([(2 * wide - 1) / ((x[1] - x[0]) or 1.0), (4 * high - 1) / (top or 1.0)])
    for number, curve in enumerate(curves):
        at = (np.array(curve.points, dtype=float).reshape(-1, 2) - (x[0], 0.0)) * scale
        at = at[np.isfinite(at).all(axis=1)].clip(-FAR, FAR)
        for column, row in _dots(at):
            if 0 <= column < 2 * wide and 0 <= row < 4 * high:
                cell = (4 * high - 1 - row) // 4, column // 2
                cells[cell] |= DOTS[(4 * high - 1 - row) % 4, column % 2]
                styles[cell] = number
        marked = -APART
        for column, row in np.rint(at).astype(int).tolist() if curve.mark else ():
            if column // 2 >= marked + APART and 0 <= row < 4 * high:
                marked = column // 2
                marks[(4 * high - 1 - row) // 4, marked] = curve.mark, curve.style
    numbers = {0: _number(top), high // 2: _number(top / 2)}
    lines = []
    for row in range(high):
        line = Text(f"{numbers.get(row, ''):>{left}}", AXIS).append("┤" if row in numbers else "│")
        letters = [
            marks.get((row, column)) or _letter(cells[row, column], styles[row, column], curves)
            for column in range(wide)
        ]
        for style, run in groupby(letters, key=lambda one: one[1]):
            line.append("".join(letter for letter, _ in run), style)
        lines.append(line)
    return [*lines, *_below(x, left, wide, unit)]


def _letter(dots: int, number: int, curves: Sequence[Curve]) -> tuple[str, str]:
    """(letter, style); a space where there are no dots: not every font has an empty letter."""
    return (" ", "") if dots == EMPTY else (chr(dots), curves[number].style)


def _dots(at: Float2D) -> list[tuple[int, int]]:
    """Every dot (column, row) on the straight lines between the points."""
    found = [tuple(np.rint(at[0]).astype(int))] if len(at) else []
    for a, b in pairwise(at):
        count = max(int(np.ceil(np.abs(b - a).max())), 1)
        steps = a + (b - a) * np.linspace(0.0, 1.0, count + 1)[:, None]
        found += [tuple(one) for one in np.rint(steps).astype(int)]
    return found


def _below(x: tuple[float, float], left: int, wide: int, unit: str) -> list[Text]:
    """The axis below, and its numbers: both ends, and between them where there is room."""
    ticks = {0: x[0], wide - 1: x[1]}
    if wide >= 30:
        ticks[wide // 2] = (x[0] + x[1]) / 2
    axis = "".join("┴" if column in ticks else "─" for column in range(wide))
    row = [" "] * (left + 1 + wide)
    for column, value in ticks.items():
        text = f"{value:.3g}" + (f" {unit}" if column == wide - 1 else "")
        at = left + 1 + column - (0 if column == 0 else len(text) - 1 if column == wide - 1 else 2)
        row[at : at + len(text)] = text
    return [Text(f"{'0':>{left}}└{axis}", AXIS), Text("".join(row), AXIS)]


def _number(value: float) -> str:
    return f"{value:.3g}"
