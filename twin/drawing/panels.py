"""Figures as data: panels that record what is drawn in them.

A panel takes the calls of matplotlib's axes that the figures use and keeps them in order. So one
description serves two renderers: `pictures` repeats the calls on real axes, `charts` writes them
for the browser. A function that draws into a panel draws into real axes as well (`Canvas`).
Nothing here imports matplotlib.
"""

import csv
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

AXES_COORDINATES = "axes"  # as `transform` of a text: fractions of the panel
Share = Literal[False, "all", "col", "row"]


@dataclass(frozen=True, slots=True)
class Call:
    """One call: name of a method of axes, arguments and style."""

    name: str
    arguments: tuple[Any, ...]
    style: dict[str, Any]


@dataclass(slots=True, eq=False)
class FigurePanel:
    """The calls that draw a pair of axes, in order; see matplotlib's `Axes` for each."""

    calls: list[Call] = field(default_factory=list)
    transAxes: str = AXES_COORDINATES

    def _record(self, name: str, *arguments: Any, **style: Any) -> None:
        self.calls.append(Call(name, arguments, style))

    def plot(self, x: Any, y: Any, **style: Any) -> None:
        self._record("plot", np.atleast_1d(x), np.atleast_1d(y), **style)

    def fill_between(self, x: Any, low: Any, high: Any, **style: Any) -> None:
        self._record("fill_between", x, low, high, **style)

    def vlines(self, x: Any, low: Any, high: Any, **style: Any) -> None:
        self._record("vlines", x, low, high, **style)

    def errorbar(self, x: Any, y: Any, error: Any, **style: Any) -> None:
        self._record("errorbar", x, y, error, **style)

    def axhline(self, y: float, **style: Any) -> None:
        self._record("axhline", y, **style)

    def axvline(self, x: float, **style: Any) -> None:
        self._record("axvline", x, **style)

    def axhspan(self, low: float, high: float, **style: Any) -> None:
        self._record("axhspan", low, high, **style)

    def axvspan(self, low: float, high: float, **style: Any) -> None:
        self._record("axvspan", low, high, **style)

    def text(self, x: float, y: float, text: str, **style: Any) -> None:
        self._record("text", x, y, text, **style)

    def annotate(self, text: str, xy: Any, xytext: Any = None, **style: Any) -> None:
        self._record("annotate", text, xy, xytext, **style)

    def set_title(self, text: str) -> None:
        self._record("set_title", text)

    def set_xlabel(self, text: str) -> None:
        self._record("set_xlabel", text)

    def set_ylabel(self, text: str) -> None:
        self._record("set_ylabel", text)

    def set_xlim(self, left: float | None = None, right: float | None = None) -> None:
        self._record("set_xlim", left, right)

    def set_ylim(self, bottom: float | None = None, top: float | None = None) -> None:
        self._record("set_ylim", bottom, top)

    def set_xscale(self, scale: str) -> None:
        self._record("set_xscale", scale)

    def set_yscale(self, scale: str) -> None:
        self._record("set_yscale", scale)

    def set_absolute_labels(self) -> None:
        """Label the vertical axis by absolute values, of a quantity drawn up and down."""
        self._record("set_absolute_labels")

    def autoscale(self, **options: Any) -> None:
        self._record("autoscale", **options)

    def legend(self, **options: Any) -> None:
        self._record("legend", **options)

    def find(self, name: str) -> Iterator[Call]:
        """Yield the calls of one method, in order."""
        return (call for call in self.calls if call.name == name)


Canvas = Any  # matplotlib's `Axes` or a `FigurePanel`: what is drawn into either


@dataclass(frozen=True, slots=True)
class Key:
    """An entry of a legend: a line with its style, or a patch of colour."""

    label: str
    style: Mapping[str, Any]
    is_patch: bool = False


class PanelFigure:
    """Panels in rows and columns, with a legend above them; `panels[row, column]` may be None."""

    def __init__(
        self,
        size_in: tuple[float, float],
        rows: int = 1,
        columns: int = 1,
        *,
        sharex: Share = "all",
        sharey: Share = False,
        heights: Sequence[float] | None = None,
        widths: Sequence[float] | None = None,
    ) -> None:
        self.size_in = size_in
        self.sharex, self.sharey = sharex, sharey
        self.heights, self.widths = heights or [1.0] * rows, widths or [1.0] * columns
        self.panels: Any = np.empty((rows, columns), dtype=object)  # as of Figure.subplots
        for place in np.ndindex(rows, columns):
            self.panels[place] = FigurePanel()
        self.keys: list[Key] = []
        self.key_columns = 1

    def legend(self, keys: Sequence[Key], columns: int) -> None:
        """Set the legend above the panels."""
        self.keys, self.key_columns = list(keys), columns

    def list_panels(self) -> list[tuple[int, int, FigurePanel]]:
        """Return (row, column, panel) of all panels."""
        places = np.ndindex(*self.panels.shape)
        return [(*place, self.panels[place]) for place in places if self.panels[place]]


@dataclass(frozen=True, slots=True)
class CaptionedFigure:
    """Figure with its file name, title, caption and, where it has one, number in the paper.

    A figure is panels, or drawn with matplotlib where no panel serves.
    """

    name: str
    title: str
    caption: str
    figure: "PanelFigure | Figure"
    number: str = ""


CaptionedFigures = Iterator[CaptionedFigure]


@dataclass(frozen=True, slots=True)
class Picture:
    """PNG file with title and caption."""

    path: Path
    title: str
    caption: str


def write_line_data(figure: PanelFigure, path: Path) -> None:
    """Write the points of every drawn line of a figure as CSV: panel, axes, line, x, y."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("panel", "x_label", "y_label", "line", "style", "x", "y"))
        for number, (_, _, panel) in enumerate(figure.list_panels(), 1):
            labels = [
                next((call.arguments[0] for call in panel.find(f"set_{axis}label")), "")
                for axis in "xy"
            ]
            for line, call in enumerate(panel.find("plot"), 1):
                name = call.style.get("label", f"line {line}")
                style = f"{call.style.get('color', '')} {call.style.get('ls', '-')}"
                for x, y in np.column_stack(call.arguments).tolist():
                    writer.writerow((number, *labels, name, style, x, y))
