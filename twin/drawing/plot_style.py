"""Plot style of every figure: colors, line styles, figure size, and how figures are saved.

Measured: wide and pale, red forward, blue backward.
Twin: thin, black, solid forward, dashed backward.
Import only to draw: matplotlib is slow to import.
"""

import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.lines import Line2D

from twin.recording.recovery import pause_collection
from twin.results.report_data import DIRECTIONS
from twin.system.terminal import show_status

FIGURE_WIDTH_IN = 10.0
RC_PARAMS: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.linewidth": 0.7,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "#e4e4e4", "grid.linewidth": 0.6, "axes.axisbelow": True, "savefig.dpi": 150,
    "svg.hashsalt": "shaketwin",  # equal ids of clips, so that equal figures are equal bytes
    "legend.frameon": False, "lines.linewidth": 1.1, "lines.markersize": 3.6,
    "figure.constrained_layout.use": True, "figure.constrained_layout.hspace": 0.06,
}  # fmt: skip
DARK_RC_PARAMS: dict[Any, Any] = {
    "figure.facecolor": "#16181d", "savefig.facecolor": "#16181d", "axes.facecolor": "#16181d",
    "text.color": "#e6e6e6", "axes.labelcolor": "#e6e6e6", "axes.edgecolor": "#9a9a9a",
    "xtick.color": "#c8c8c8", "ytick.color": "#c8c8c8", "grid.color": "#33363d",
}  # fmt: skip
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
PNG_OPTIONS = {"compress_level": 3}  # 6 takes twice the time for a twentieth of the size
NO_DATE = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # equal figures, equal bytes
DirectionStyle = Callable[[str], LineStyle]  # line style of a direction


@dataclass(frozen=True, slots=True)
class CaptionedFigure:
    """Figure with its file name, title, caption and, where it has one, number in the paper."""

    name: str
    title: str
    caption: str
    figure: Figure
    number: str = ""


CaptionedFigures = Iterator[CaptionedFigure]


@dataclass(frozen=True, slots=True)
class Picture:
    """PNG file with title and caption."""

    path: Path
    title: str
    caption: str


class QuickLayout(ConstrainedLayoutEngine):
    """Constrained layout that measures the labels of each axes in its second pass only.

    Both passes measure all labels, which takes longer than drawing them. The first only brings the
    axes about to their place, for which a guess of the margins is enough.
    """

    GUESSED_MARGIN_IN = 0.2

    def execute(self, fig: Figure) -> Any:
        """Lay out the axes of a figure."""
        for axes in fig.axes:
            measure = self._guess_first(axes, self.GUESSED_MARGIN_IN * fig.dpi)
            axes.get_tightbbox = measure  # type: ignore[method-assign]
        try:
            return super().execute(fig)
        finally:
            for axes in fig.axes:
                del axes.get_tightbbox  # that of the class again

    @staticmethod
    def _guess_first(axes: Axes, margin: float) -> Callable[..., Any]:
        """Return a `get_tightbbox` for the axes whose first call guesses; `margin` in pixels."""
        calls = iter([True])

        def get_tightbbox(*arguments: Any, **options: Any) -> Any:
            if not next(calls, False) or not axes.get_visible():
                return type(axes).get_tightbbox(axes, *arguments, **options)
            return axes.get_window_extent().padded(margin)

        return get_tightbbox


def save_figures(
    figures: Iterable[CaptionedFigure],
    folder: Path,
    dark: bool = False,
    more_formats: Sequence[str] = (),
) -> list[Picture]:
    """Save figures as PNG files in `folder`; return them in order.

    `more_formats`: also as svg, pdf, or csv, the data of the drawn lines.

    The figures are drawn while they are iterated over: `figures` must be a generator, so that
    the style applies. `dark`: on a dark ground; only for figures whose colors allow it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    style = RC_PARAMS | (DARK_RC_PARAMS if dark else {})
    with (
        mpl.rc_context(style),
        pause_collection(),
        show_status("drawing the figures") as show_part,
    ):
        for drawing in figures:
            show_part(drawing.title)
            path = folder / f"{drawing.name}.png"
            _fix_layout(drawing.figure)
            drawing.figure.savefig(path, pil_kwargs=PNG_OPTIONS)
            for suffix in more_formats:
                other = path.with_suffix(f".{suffix}")
                if suffix == "csv":
                    write_line_data(drawing.figure, other)
                else:
                    drawing.figure.savefig(other, metadata=NO_DATE.get(suffix))
            pictures.append(Picture(path, drawing.title, drawing.caption))
    return pictures


def _fix_layout(figure: Figure) -> None:
    """Lay out a figure once: `savefig` with a layout engine would draw it twice."""
    engine = figure.get_layout_engine()
    if isinstance(engine, ConstrainedLayoutEngine):
        figure.set_dpi(mpl.rcParams["savefig.dpi"])
        QuickLayout(**engine.get()).execute(figure)
        figure.set_layout_engine("none")


def write_line_data(figure: Figure, path: Path) -> None:
    """Write the points of every drawn line of a figure as CSV: panel, axes, line, x, y."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("panel", "x_label", "y_label", "line", "style", "x", "y"))
        for panel, ax in enumerate(figure.axes, 1):
            for number, line in enumerate(ax.lines, 1):
                label = str(line.get_label())
                name = f"line {number}" if label.startswith("_") else label
                style = f"{line.get_color()} {line.get_linestyle()}"
                for x, y in np.column_stack(line.get_data(orig=False)).tolist():
                    row = (panel, ax.get_xlabel(), ax.get_ylabel(), name, style, x, y)
                    writer.writerow(row)


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


def direction_handles(
    make_style: DirectionStyle, prefix: str = "", directions: Sequence[str] = DIRECTIONS
) -> list[Line2D]:
    """Return a legend handle per direction, labelled "<prefix><direction>"."""
    return [
        Line2D([], [], **make_style(direction), label=f"{prefix}{direction}")
        for direction in directions
    ]


def format_minus(name: str) -> str:
    """Return the name of a gap with a typographic minus sign."""
    return name.replace("-", "−")


def label_panel(ax: Axes, panel_letter: str, text: str = "") -> None:
    """Write the panel letter and a centered title above a panel."""
    ax.set_title(text, loc="center")
    ax.text(
        0, 1.02, panel_letter, transform=ax.transAxes, weight="bold", ha="left", va="bottom",
        size=10,
    )  # fmt: skip
