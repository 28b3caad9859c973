"""Pictures of figures: PNG, SVG and PDF by matplotlib, CSV of the lines.

Import only to draw: matplotlib is slow to import.
"""

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from twin.drawing.panels import (
    AXES_COORDINATES,
    CaptionedFigure,
    FigurePanel,
    Key,
    PanelFigure,
    Picture,
    write_line_data,
)
from twin.drawing.plot_style import DirectionStyle, direction_keys
from twin.recording.recovery import pause_collection
from twin.results.report_data import DIRECTIONS
from twin.system.terminal import show_status

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
MARGINS_IN = {"left": 0.75, "panel": 0.12, "title": 0.2, "ticks": 0.25, "bottom": 0.5, "key": 0.2}
PNG_OPTIONS = {"compress_level": 3}  # 6 takes twice the time for a twentieth of the size
MAX_DIGITS_RATIO = 1e3  # of a logarithmic axis: up to it 1, 2 and 5 are labelled, not 1 alone
NO_DATE = {"svg": {"Date": None}, "pdf": {"CreationDate": None}}  # equal figures, equal bytes


def save_figures(
    figures: Iterable[CaptionedFigure],
    folder: Path,
    dark: bool = False,
    more_formats: Sequence[str] = (),
) -> list[Picture]:
    """Save figures as PNG files in `folder`; return them in order.

    `more_formats`: also as svg, pdf, or csv, the data of the lines of panels.

    The figures are drawn while they are iterated over: `figures` must be a generator, so that
    the style applies. `dark`: on a dark ground; only for figures whose colors allow it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    pictures = []
    style = RC_PARAMS | (DARK_RC_PARAMS if dark else {})
    with mpl.rc_context(style), pause_collection(), show_status("drawing the figures") as show_part:
        for drawing in figures:
            show_part(drawing.title)
            path = folder / f"{drawing.name}.png"
            figure = render_figure(drawing.figure)
            _fix_layout(figure)
            figure.savefig(path, pil_kwargs=PNG_OPTIONS)
            if "csv" in more_formats and isinstance(drawing.figure, PanelFigure):
                write_line_data(drawing.figure, path.with_suffix(".csv"))
            for suffix in more_formats:
                if suffix != "csv":
                    figure.savefig(path.with_suffix(f".{suffix}"), metadata=NO_DATE.get(suffix))
            pictures.append(Picture(path, drawing.title, drawing.caption))
    return pictures


def render_figure(figure: PanelFigure | Figure) -> Figure:
    """Return the matplotlib figure of panels."""
    if isinstance(figure, Figure):
        return figure
    rendered = Figure(figsize=figure.size_in)
    rendered.set_layout_engine("none")
    draw_panels(figure, rendered)
    return rendered


def draw_panels(figure: PanelFigure, onto: FigureBase) -> None:
    """Draw panels on a matplotlib figure, or on a part of one that has their proportions."""
    rows, columns = figure.panels.shape
    axes = onto.subplots(
        rows, columns, sharex=figure.sharex, sharey=figure.sharey, squeeze=False,
        height_ratios=figure.heights, width_ratios=figure.widths,
        gridspec_kw=_place_panels(figure),
    )  # fmt: skip
    for place, ax in np.ndenumerate(axes):
        panel = figure.panels[place]
        if panel is None:
            ax.remove()
        else:
            _repeat_calls(panel, ax)
    if figure.keys:
        handles = make_handles(figure.keys)
        onto.legend(handles=handles, loc="upper center", ncols=figure.key_columns)


def scale_style(share: float) -> dict[Any, Any]:
    """Return RC_PARAMS with letters and lines of a share of their size."""
    native = mpl.rcParamsDefault | RC_PARAMS
    return RC_PARAMS | {
        key: share * native[key]
        for key in native
        if key in ("font.size", "axes.titlesize", "axes.labelpad", "axes.titlepad")
        or re.fullmatch(r"(axes|grid|lines|patch)\.(linewidth|markersize)", key)
        or re.fullmatch(r"[xy]tick\.(major|minor)\.(size|width|pad)", key)
    }


def _place_panels(figure: PanelFigure) -> dict[str, float]:
    """Return margins and distances with room for labels: measuring all doubles the time."""
    (width, height), (rows, columns) = figure.size_in, figure.panels.shape
    has_titles = any(any(panel.find("set_title")) for _, _, panel in figure.list_panels())
    above = MARGINS_IN["title"] * has_titles
    between = MARGINS_IN["panel"] + above + MARGINS_IN["ticks"] * (not figure.sharex)
    key_rows = -(-len(figure.keys) // figure.key_columns)
    top = MARGINS_IN["panel"] + above + MARGINS_IN["key"] * key_rows
    inner = height - top - MARGINS_IN["bottom"] - (rows - 1) * between
    across = width - columns * MARGINS_IN["left"] - MARGINS_IN["panel"]
    return {
        "left": MARGINS_IN["left"] / width, "right": 1 - MARGINS_IN["panel"] / width,
        "top": 1 - top / height, "bottom": MARGINS_IN["bottom"] / height,
        "hspace": between / (inner / rows), "wspace": MARGINS_IN["left"] / (across / columns),
    }  # fmt: skip


def _repeat_calls(panel: FigurePanel, ax: Axes) -> None:
    for call in panel.calls:
        if call.name == "set_absolute_labels":
            ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
            continue
        style = dict(call.style)
        if style.get("transform") == AXES_COORDINATES:
            style["transform"] = ax.transAxes
        getattr(ax, call.name)(*call.arguments, **style)
    for axis in (ax.xaxis, ax.yaxis):
        if axis.get_scale() == "log":
            low, high = axis.get_view_interval()
            digits = (1.0, 2.0, 5.0) if high < MAX_DIGITS_RATIO * low else (1.0,)
            axis.set_major_locator(LogLocator(subs=digits))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
            axis.set_minor_formatter(NullFormatter())


def make_handles(keys: Iterable[Key]) -> list[Line2D | Patch]:
    """Return the legend of matplotlib for keys."""
    return [
        Patch(**key.style, label=key.label)
        if key.is_patch
        else Line2D([], [], **key.style, label=key.label)
        for key in keys
    ]


def direction_handles(
    make_style: DirectionStyle, prefix: str = "", directions: Sequence[str] = DIRECTIONS
) -> list[Line2D]:
    """Return a legend handle per direction, labelled "<prefix><direction>"."""
    keys = direction_keys(make_style, prefix, directions)
    return [Line2D([], [], **key.style, label=key.label) for key in keys]


def _fix_layout(figure: Figure) -> None:
    """Lay out a figure once: `savefig` with a layout engine would draw it twice."""
    engine = figure.get_layout_engine()
    if engine is not None:
        figure.set_dpi(mpl.rcParams["savefig.dpi"])
        engine.execute(figure)
        figure.set_layout_engine("none")


def label_panel(ax: Axes, panel_letter: str, text: str = "") -> None:
    """Write the panel letter and a centered title above a panel."""
    ax.set_title(text, loc="center")
    ax.text(
        0, 1.02, panel_letter, transform=ax.transAxes, weight="bold", ha="left", va="bottom",
        size=10,
    )  # fmt: skip
