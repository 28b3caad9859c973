"""Figures of a study: maps with slices, samples, Sobol indices, and the front of a trade."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import FixedLocator, FuncFormatter

from table_io.block import Float1D
from twin.compare.curves import FloatND
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Picture
from twin.drawing.pictures import save_figures
from twin.studies.maps.config import VariedParameter
from twin.studies.maps.outcomes import OutcomeVariable
from twin.studies.maps.results import (
    SensitivityIndices,
    StudyResults,
    find_front,
    format_plain,
    format_unit,
)

MAX_PANELS = 6  # of the values of a third parameter
MAX_SLICES = 7  # lines of one figure
MAX_POINTS = 4000  # drawn of samples
BIN_COUNT = 40  # of the mean over samples
COLOURMAP = mpl.colormaps["viridis"]
MISSING_COLOUR = "#e4e4e4"


@dataclass(frozen=True)
class PlotAxis:
    """Axis of a parameter: its positions, in the logarithm where the study is, and its label."""

    results: StudyResults
    parameter: VariedParameter
    values: Float1D

    @property
    def positions(self) -> Float1D:
        return self.place(self.values)

    @property
    def label(self) -> str:
        return self.results.label_parameter(self.parameter.name)

    def place(self, values: Float1D) -> Float1D:
        """Return where values lie on the axis."""
        return np.log10(values) if self.parameter.scale == "log" else values

    def set_up(self, axis: Any) -> None:
        """Label a matplotlib axis in the values of the parameter."""
        axis.set_label_text(self.label)
        if self.parameter.scale == "log":
            axis.set_major_locator(FixedLocator(choose_log_ticks(*self.parameter.limits)))
            axis.set_major_formatter(FuncFormatter(lambda position, _: format_plain(10**position)))

    def format_value(self, value: float) -> str:
        return self.results.describe_value(self.parameter.name, value)


def choose_log_ticks(low: float, high: float) -> list[float]:
    """Return the logarithms of round values from low to high: 1, 2, 5 of a decade, or decades."""
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    digits = (1,) if last - first > 3 else (1, 2, 5) if last - first > 1 else range(1, 10)
    values = [digit * 10.0**decade for decade in range(first, last + 1) for digit in digits]
    return [math.log10(value) for value in values if low * 0.999 <= value <= high * 1.001]


def draw_outcome_figures(
    results: StudyResults, sensitivity: dict[str, SensitivityIndices], folder: Path
) -> list[Picture]:
    """Draw the figures of a study as PNG and SVG files in `folder`; return them in page order."""
    return save_figures(_draw_figures(results, sensitivity), folder, more_formats=("svg",))


def _draw_figures(
    results: StudyResults, sensitivity: dict[str, SensitivityIndices]
) -> CaptionedFigures:
    if results.study.config.front is not None:
        yield draw_front(results)
    if sensitivity:
        yield draw_sensitivity(results, sensitivity)
    for variable in results.scalars:
        if not results.is_grid:
            yield draw_samples(results, variable)
        elif len(results.study.config.parameters) == 1:
            yield draw_line(results, variable)
        else:
            yield draw_map(results, variable)


def _grid_plot_axes(results: StudyResults) -> list[PlotAxis]:
    axes = results.grid_axes()
    return [PlotAxis(results, p, axes[p.name]) for p in results.study.config.parameters]


def _label_unit(variable: OutcomeVariable) -> str:
    """Return the label of an axis in a figure that is titled with the outcome."""
    return "ratio or count" if variable.unit == "1" else f"in {format_unit(variable.unit)}"


def label_variable(variable: OutcomeVariable) -> str:
    """Return the title of an outcome with its unit."""
    return (
        variable.title
        if variable.unit == "1"
        else f"{variable.title} in {format_unit(variable.unit)}"
    )


def draw_line(results: StudyResults, variable: OutcomeVariable) -> CaptionedFigure:
    """Draw an outcome over the only parameter of a grid."""
    (axis,) = _grid_plot_axes(results)
    figure = Figure(figsize=(10, 3.6))
    ax = figure.subplots()
    ax.plot(axis.positions, results.read_grid(variable.name), "o-", ms=3)
    axis.set_up(ax.xaxis)
    ax.set_ylabel(label_variable(variable))
    return CaptionedFigure(variable.name, _title(variable), "", figure)


def _title(variable: OutcomeVariable) -> str:
    return variable.title[0].upper() + variable.title[1:]


def _take_plane(values: FloatND, plane: Sequence[int]) -> FloatND:
    """Return the first two dimensions of a grid at indices of the others."""
    return np.moveaxis(values, (0, 1), (-2, -1))[tuple(plane)]


def _choose_panels(axes: Sequence[PlotAxis]) -> Iterator[tuple[str, tuple[int, ...]]]:
    """Yield (title, indices of the parameters after the second) of each panel."""
    middle = [axis.values.size // 2 for axis in axes[2:]]
    if not middle:
        yield "", ()
        return
    third, *rest = axes[2:]
    count = min(third.values.size, MAX_PANELS)
    for index in np.unique(np.linspace(0, third.values.size - 1, count).round().astype(int)):
        fixed = [
            axis.format_value(axis.values[k]) for axis, k in zip(rest, middle[1:], strict=True)
        ]
        title = ", ".join([third.format_value(third.values[index]), *fixed])
        yield title, (int(index), *middle[1:])


def draw_map(results: StudyResults, variable: OutcomeVariable) -> CaptionedFigure:
    """Draw an outcome over the first two parameters of a grid, and slices of it.

    A panel for values of the third parameter; the slices are at its middle value.
    """
    axes = _grid_plot_axes(results)
    values = results.read_grid(variable.name)
    panels = list(_choose_panels(axes))
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    heights = (4.0 if columns == 1 else 2.7 * rows + 0.3), 3.4
    figure = Figure(figsize=(10, sum(heights)))
    parts: Any = figure.subfigures(2, 1, height_ratios=heights, hspace=0.02)
    top, bottom = parts
    grid = top.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    planes = [_take_plane(values, plane) for _, plane in panels]
    finite = np.concatenate([plane[np.isfinite(plane)] for plane in planes])
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 1.0)
    image: Any = None
    for ax, (title, _), plane in zip(grid.flat, panels, planes, strict=False):
        ax.set_facecolor(MISSING_COLOUR)
        ax.grid(visible=False)
        image = ax.pcolorfast(
            _edges(axes[0].positions), _edges(axes[1].positions), np.ma.masked_invalid(plane.T),
            cmap=COLOURMAP, vmin=low, vmax=high,
        )  # fmt: skip
        ax.set_title(title)
    for ax in grid.flat[len(panels) :]:
        ax.set_visible(False)
    for ax in grid[-1]:
        axes[0].set_up(ax.xaxis)
    for ax in grid[:, 0]:
        axes[1].set_up(ax.yaxis)
    top.colorbar(image, ax=grid.ravel().tolist(), label=_label_unit(variable), pad=0.015)
    middle = [axis.values.size // 2 for axis in axes[2:]]
    _draw_slices(bottom, axes, _take_plane(values, middle), variable)
    fixed = [axis.format_value(axis.values[k]) for axis, k in zip(axes[2:], middle, strict=True)]
    caption = f"Below: slices at {', '.join(fixed)}." if fixed else "Below: slices."
    if results.study.config.repeats > 1:
        caption = f"Means of {results.study.config.repeats} cases. {caption}"
    if np.isnan(values).any():
        caption = f"Gray: no such value, for example no jump, or not stored. {caption}"
    if len(axes) > 3:
        caption = f"Parameters without a panel of their own are at their middle value. {caption}"
    return CaptionedFigure(f"map_{variable.name}", _title(variable), caption, figure)


def _draw_slices(
    figure: SubFigure, axes: Sequence[PlotAxis], plane: FloatND, variable: OutcomeVariable
) -> None:
    """Draw a plane over each of its two parameters, a line for values of the other."""
    for ax, along, across, values in zip(
        figure.subplots(1, 2, sharey=True), axes[:2], (axes[1], axes[0]), (plane, plane.T),
        strict=True,
    ):  # fmt: skip
        _plot_slices(ax, along, across, values)
        ax.set_ylabel(_label_unit(variable))
        ax.label_outer()


def _edges(positions: Float1D) -> Float1D:
    """Return the edges of cells around ascending positions, (position + 1,)."""
    if positions.size == 1:
        return np.array([positions[0] - 0.5, positions[0] + 0.5])
    middles = (positions[1:] + positions[:-1]) / 2
    first, last = 2 * positions[0] - middles[0], 2 * positions[-1] - middles[-1]
    return np.r_[first, middles, last]


def _plot_slices(ax: Axes, along: PlotAxis, across: PlotAxis, values: FloatND) -> None:
    """Plot values (along, across) over the one parameter for values of the other."""
    count = min(across.values.size, MAX_SLICES)
    indices = np.unique(np.linspace(0, across.values.size - 1, count).round().astype(int))
    for share, index in zip(np.linspace(0, 0.9, indices.size), indices, strict=True):
        ax.plot(
            along.positions, values[:, index], color=COLOURMAP(share),
            label=format_plain(across.values[index]),
        )  # fmt: skip
    along.set_up(ax.xaxis)
    ax.legend(title=across.label, fontsize=7.5, title_fontsize=8, loc="center left",
              bbox_to_anchor=(1.0, 0.5))  # fmt: skip


def draw_samples(results: StudyResults, variable: OutcomeVariable) -> CaptionedFigure:
    """Draw an outcome of samples over each parameter, with the mean over narrow ranges of it."""
    parameters = results.study.config.parameters
    values = results.read_by_case(variable.name)
    columns = min(3, len(parameters))
    rows = -(-len(parameters) // columns)
    figure = Figure(figsize=(10, 2.9 * rows + 0.3))
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    shown = slice(None, None, max(1, values.size // MAX_POINTS))
    for ax, parameter in zip(grid.flat, parameters, strict=False):
        axis = PlotAxis(results, parameter, results.read_by_case(parameter.name))
        ax.plot(axis.positions[shown], values[shown], ".", ms=3, alpha=0.35, color="#1559b0",
                mew=0, rasterized=True)  # fmt: skip
        centres, means = _mean_in_bins(axis.positions, values)
        ax.plot(centres, means, color="#c4161c", lw=1.8)
        axis.set_up(ax.xaxis)
    for ax in grid.flat[len(parameters) :]:
        ax.set_visible(False)
    for ax in grid[:, 0]:
        ax.set_ylabel(_label_unit(variable))
    missing = float(np.isnan(values).mean())
    caption = "Points: cases; line: mean over a fortieth of the range."
    if missing:
        caption += f" {100 * missing:.3g} % of the cases have no such value."
    return CaptionedFigure(f"samples_{variable.name}", _title(variable), caption, figure)


def _mean_in_bins(positions: Float1D, values: Float1D) -> tuple[Float1D, Float1D]:
    """Return (centres, means) of the values in `BIN_COUNT` equal ranges of the positions."""
    known = np.isfinite(values)
    edges = np.linspace(positions.min(), positions.max(), BIN_COUNT + 1)
    counts, _ = np.histogram(positions[known], edges)
    sums, _ = np.histogram(positions[known], edges, weights=values[known])
    means = np.divide(sums, counts, out=np.full(BIN_COUNT, np.nan), where=counts > 0)
    return (edges[1:] + edges[:-1]) / 2, means


def draw_sensitivity(
    results: StudyResults, sensitivity: dict[str, SensitivityIndices]
) -> CaptionedFigure:
    """Draw first-order and total Sobol indices of each outcome with their intervals."""
    labels = [
        results.label_parameter(p.name).split(" in ")[0] for p in results.study.config.parameters
    ]
    variables = [variable for variable in results.scalars if variable.name in sensitivity]
    columns = min(3, len(variables))
    rows = -(-len(variables) // columns)
    figure = Figure(figsize=(10, (0.32 * len(labels) + 1.0) * rows + 0.6))
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    places = np.arange(len(labels))
    for ax, variable in zip(grid.flat, variables, strict=False):
        indices = sensitivity[variable.name]
        for offset, values, interval, colour, name in (
            (-0.2, indices.first, indices.first_interval, "#1559b0", "first order: alone"),
            (0.2, indices.total, indices.total_interval, "#e08a00", "total: with interactions"),
        ):
            ax.barh(places + offset, values, 0.38, color=colour, label=name)
            ax.hlines(places + offset, *interval, color="#111111", lw=1.2)
        ax.set_title(variable.title, fontsize=8.5)
        ax.set_yticks(places, labels)
        ax.grid(visible=False, axis="y")
    grid[0, 0].invert_yaxis()
    for ax in grid.flat[len(variables) :]:
        ax.set_visible(False)
    for ax in grid[-1]:
        ax.set_xlabel("share of variance")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return CaptionedFigure(
        "sensitivity", "Sobol indices: which parameter explains the variance of an outcome",
        "Black: 95 % intervals by the bootstrap. Where the total exceeds the first order, "
        "the parameter acts together with others.", figure,
    )  # fmt: skip


def draw_front(results: StudyResults) -> CaptionedFigure:
    """Draw two outcomes against each other, the cases that none betters, and their parameters."""
    front = results.study.config.front
    assert front is not None
    by_name = {variable.name: variable for variable in results.scalars}
    first, second = (by_name[name] for name in front.minimise)
    shown = [p for p in results.study.config.parameters if p.name != front.each]
    heights = (5.2, 3.0) if shown else (5.2,)
    figure = Figure(figsize=(10, sum(heights)))
    parts: Any = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)
    ax = parts[0, 0].subplots()
    panels = parts[1, 0].subplots(1, len(shown), squeeze=False)[0] if shown else ()
    groups = list(group_front(results))
    for share, group in zip(np.linspace(0, 0.85, len(groups)), groups, strict=True):
        colour, cases = COLOURMAP(share), group.cases[group.front]
        drawn = slice(None, None, max(1, group.first.size * len(groups) // (4 * MAX_POINTS)))
        ax.plot(group.first[drawn], group.second[drawn], ".", ms=4, alpha=0.35, mew=0,
                color=colour, rasterized=True)  # fmt: skip
        ax.plot(group.first[group.front], group.second[group.front], "o-", ms=4, lw=1.4,
                color=colour, label=group.title or "front")  # fmt: skip
        for panel, parameter in zip(panels, shown, strict=True):
            axis = PlotAxis(results, parameter, results.read_by_case(parameter.name)[cases])
            panel.plot(group.second[group.front], axis.positions, "o-", ms=3, lw=1.2, color=colour)
            axis.set_up(panel.yaxis)
            low, high = axis.place(np.array(parameter.limits))
            panel.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
            panel.set_xlabel(label_variable(second))
    for limit in front.limits:
        ax.axhline(limit, color="#777777", lw=0.8, ls=":")
    ax.set_xlabel(label_variable(first))
    ax.set_ylabel(label_variable(second))
    ax.legend(loc="upper right")
    return CaptionedFigure(
        "front", f"{_title(first)} against {second.title}",
        "Dots: all cases; line: those that no other betters in both (front.csv)"
        + ("; dotted: limits" if front.limits else "")
        + ". Below: the parameters along the line.", figure,
    )  # fmt: skip


@dataclass(frozen=True)
class FrontGroup:
    """Two outcomes of the cases of one front, (case,), and the places of those on the front.

    `cases`: their numbers in the study.
    """

    title: str
    cases: np.ndarray[Any, np.dtype[np.intp]]
    first: Float1D
    second: Float1D

    @cached_property
    def front(self) -> np.ndarray[Any, np.dtype[np.intp]]:
        return find_front(self.first, self.second)

    def find_least(self, limit: float) -> int | None:
        """Return the number of the case of least first whose second is at most `limit`."""
        places = self.front[self.second[self.front] <= limit]  # ascending in the first
        return int(self.cases[places[0]]) if places.size else None


def group_front(results: StudyResults) -> Iterator[FrontGroup]:
    """Yield the group of each front of a study."""
    front = results.study.config.front
    assert front is not None
    first, second = (results.read_by_case(name) for name in front.minimise)
    if not front.each:
        yield FrontGroup("", np.arange(first.size), first, second)
        return
    values = results.read_by_case(front.each)
    for value in np.unique(values):
        cases = np.flatnonzero(values == value)
        title = results.describe_value(front.each, float(value))
        yield FrontGroup(title, cases, first[cases], second[cases])
