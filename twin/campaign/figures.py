"""Figures of a campaign: PRC families as in the paper's Figs. 2 and 5, and level errors."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import NullLocator

from table_io.block import Float1D, Float2D
from table_io.config.excitation.stepped_sine import Sweep
from table_io.records import PrcPoint
from twin.campaign.gap_comparison import ETA_A, ETA_D, FORCE_RATIO, GapComparison, format_gap
from twin.campaign.summary import CampaignData, CampaignRunData, describe_normalization
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Picture
from twin.drawing.pictures import direction_handles, save_figures
from twin.drawing.plot_style import DIRECTION_COLOURS, GUIDE_COLOUR, TRANSITION_COLOURS, LineStyle
from twin.drawing.prc_families import draw_all_gaps, draw_transition
from twin.results.excitation_verdict import list_level_errors
from twin.results.measured_campaign import MeasuredCampaign
from twin.results.paper_cases import PaperCase, PaperTest, name_gap
from twin.results.report_data import DIRECTIONS
from twin.results.summary import prc_points

NEAR_HZ = 1e-9


def draw_campaign_figures(campaign: CampaignData, folder: Path) -> list[Picture]:
    """Draw the figures as PNG files in `folder`; return them with titles and captions."""
    return save_figures(_draw_each(campaign), folder)


def draw_gap_pairs(comparison: GapComparison | None, folder: Path) -> list[tuple[Picture, Picture]]:
    """Draw the comparison of gaps in `folder`; return pairs on a light and on a dark ground."""
    if comparison is None:
        return []
    light = save_figures(draw_gap_figures(comparison), folder)
    dark = save_figures(draw_gap_figures(comparison), folder / "dark", dark=True)
    return list(zip(light, dark, strict=True))


def _draw_each(campaign: CampaignData) -> CaptionedFigures:
    cases, measured_campaign = prc_families(campaign)
    if not cases:
        return
    drawn = [draw_all_gaps(cases, measured_campaign)]
    if sum(name in cases for name in TRANSITION_COLOURS) > 1:
        drawn.append(draw_transition(cases, measured_campaign))
    normalization = describe_normalization(campaign.free_flight)
    for drawing in drawn:
        caption = f"{drawing.caption} {normalization[0].upper()}{normalization[1:]}."
        yield replace(drawing, name=drawing.name.removeprefix("rig_"), caption=caption)
    if list_swept_runs(campaign):
        yield _draw_levels(campaign)


@dataclass(frozen=True, eq=False)
class CampaignGap(PaperCase):
    """A gap of a campaign; where its sweeps overlap, only the finest grid is drawn."""

    @cached_property
    def points(self) -> tuple[PrcPoint, ...]:
        sweeps = [test.profile.sweep for test in self.tests]
        return tuple(
            point
            for test in self.tests
            for point in test.points
            if not _is_covered_finer(point, test.profile.sweep, sweeps)
        )


def _is_covered_finer(point: PrcPoint, of: Sweep, sweeps: list[Sweep]) -> bool:
    """Return whether another sweep covers a point of a sweep in finer steps, in its direction."""
    return any(
        sweep.step_hz < of.step_hz
        and point.direction in sweep.directions
        and sweep.start_hz - NEAR_HZ <= point.frequency_hz <= sweep.stop_hz + NEAR_HZ
        for sweep in sweeps
    )


def list_swept_runs(campaign: CampaignData) -> list[CampaignRunData]:
    """List the runs of a stepped sine of which a step was measured: only they are drawn."""
    return [run for run in campaign.runs if run.profile.steps and run.summary.steps]


def prc_families(campaign: CampaignData) -> tuple[dict[str, PaperCase], MeasuredCampaign]:
    """Return the model's curves and the measured points by gap, the largest gap first."""
    stars = campaign.free_flight.stars if campaign.free_flight else None
    by_gap: dict[float, list[CampaignRunData]] = {}
    for run in list_swept_runs(campaign):
        by_gap.setdefault(run.profile.specimen.gap_mm, []).append(run)
    cases: dict[str, PaperCase] = {}
    measured_campaign = MeasuredCampaign()
    for gap_mm in sorted(by_gap, reverse=True):
        runs = by_gap[gap_mm]
        name = name_gap(gap_mm)
        tests = {
            (run.test, run.profile.sweep): PaperTest(
                run.test, run.profile, run.model.parameters,
                run.model if run.model.present_effects else None, stars,
            )
            for run in runs
        }  # fmt: skip
        cases[name] = CampaignGap(name, tuple(tests.values()))
        sweeps = [run.profile.sweep for run in runs]
        measured_campaign.points[name] = [
            point
            for run in runs
            for point in prc_points(run.summary.steps)
            if not _is_covered_finer(point, run.profile.sweep, sweeps)
        ]
    return cases, measured_campaign


def _draw_levels(campaign: CampaignData) -> CaptionedFigure:
    """Draw the level error: fundamental of the table acceleration over the demand, minus 1."""
    figure = Figure(figsize=(11, 3.4))
    ax = figure.subplots()
    band = 100 * max(run.profile.control.tolerance for run in campaign.runs)
    ax.axhspan(-band, band, color="#1a7f37", alpha=0.10, lw=0)
    errors = [
        (step.direction, step.frequency_hz, 100 * error)
        for run in list_swept_runs(campaign)
        for error, step in list_level_errors(run.summary.steps)
    ]
    for direction in DIRECTIONS:
        own = [place for name, *place in errors if name == direction]
        ax.plot(*np.reshape(own, (-1, 2)).T, **_dot_style(direction))
    ax.axhline(0, color=GUIDE_COLOUR, lw=0.8)
    low, high = ax.get_ylim()
    ax.set_ylim(min(low, -1.2 * band), max(high, 1.2 * band))
    ax.set_xlabel("frequency in Hz")
    ax.set_ylabel("level error in %")
    handles = direction_handles(_dot_style)
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    return CaptionedFigure(
        "level",
        "Level of the table at every measured step",
        "Fundamental of the measured table acceleration over the demanded one, minus one. Green: "
        f"the tolerance of ±{band:g} %.",
        figure,
    )


def _dot_style(direction: str) -> LineStyle:
    return {"color": DIRECTION_COLOURS[direction], "ls": "", "marker": "o", "ms": 2.8, "mew": 0}


FIGURE_SIZE_IN = 11.0, 4.1
TRADE_OFF_SIZE_IN = 11.0, 5.6
# Distinct on a light and on a dark ground.
RECORD_COLOURS = (
    "#4a86c5", "#ee6677", "#2b9a4f", "#c0a030", "#3aa6c9", "#bb4a92", "#8c8c8c", "#e08030",
)  # fmt: skip
PANELS = {
    ETA_A: "peak acceleration of the mass, $\\eta_a$",
    ETA_D: "peak displacement of the bearing, $\\eta_d$",
    FORCE_RATIO: "peak force of a bumper over weight, $r$",
}
MIN_LABEL_DISTANCE = 0.052  # of the height of a panel, between the labels of two lines
LINE_LABEL_DISTANCE, LINE_LABEL_SHIFT = 0.042, 0.025  # of the panel
RATIO_TICKS = 0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0, 20.0
COMPROMISE_LEVELS = 0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6
AXIS_MARGIN, LABEL_MARGIN = 0.07, 0.22  # of the length of a logarithmic axis
BETTER_COLOUR = "#2b8f46"


def draw_gap_figures(comparison: GapComparison) -> CaptionedFigures:
    """Draw the responses over the gap, and acceleration against displacement."""
    yield _draw_over_gap(comparison)
    if _has_trade_off(comparison):
        yield _draw_trade_off(comparison)


def _has_trade_off(comparison: GapComparison) -> bool:
    """Return whether a record has both ratios at a gap beyond the reference."""
    ratios = [comparison.values[comparison.main_source, name][:, 1:] for name in (ETA_A, ETA_D)]
    return bool(np.isfinite(ratios).all(axis=0).any())


def _draw_over_gap(comparison: GapComparison) -> CaptionedFigure:
    figure = Figure(figsize=FIGURE_SIZE_IN)
    for axis, (criterion, title) in zip(figure.subplots(1, 3), PANELS.items(), strict=True):
        _draw_panel(axis, comparison, criterion)
        axis.set_title(title)
    figure.legend(handles=_make_handles(comparison), loc="outside upper center", ncols=3)
    return CaptionedFigure(
        "gaps",
        "Response to each record over the gap",
        f"Left and middle: peaks over the record, divided by those of the same record "
        f"{comparison.reference}; below the line at 1 a gap is better. Right: the larger force of "
        f"the two bumpers over the weight of the mass. {_describe_lines(comparison)}",
        figure,
    )


def _draw_panel(axis: Axes, comparison: GapComparison, criterion: str) -> None:
    places = np.arange(len(comparison.gaps_mm), dtype=np.float64)
    table = comparison.values[comparison.main_source, criterion]
    for row, values in enumerate(table):
        axis.plot(places, values, **_record_style(row), marker="o", ms=2.4)
    for source, style in _list_median_styles(comparison):
        axis.plot(places, _median(comparison.values[source, criterion]), **style)
    axis.set_xticks(places, [format_gap(gap_mm) for gap_mm in comparison.gaps_mm], fontsize=8)
    axis.set_ylim(bottom=0.0)
    axis.set_xlim(-0.25, places[-1] + 0.25)
    if criterion != FORCE_RATIO:
        axis.axhline(1.0, color=mpl.rcParams["axes.edgecolor"], lw=0.8, ls=(0, (5, 3)))
    axis.set_xlabel("gap; G16: 16 mm in total")
    _label_ends(axis, places, table, comparison.records)


def _label_ends(axis: Axes, places: Float1D, table: Float2D, names: Sequence[str]) -> None:
    """Write the name of each line at its right end, (line, place), without overlap."""
    ends = []
    for row, values in enumerate(table):
        known = np.flatnonzero(np.isfinite(values))
        if known.size:
            ends.append((float(values[known[-1]]), float(places[known[-1]]), row))
    low, high = axis.get_ylim()
    wanted = sorted((value - low) / (high - low) for value, _, _ in ends)
    heights = spread_labels(np.array(wanted), MIN_LABEL_DISTANCE)
    for (value, place, row), height in zip(sorted(ends), heights, strict=True):
        axis.annotate(
            names[row],
            xy=(place, value),
            xytext=(1.02, height),
            textcoords="axes fraction",
            va="center",
            fontsize=7.5,
            color=_record_style(row)["color"],
            arrowprops={"arrowstyle": "-", "lw": 0.5, "color": _record_style(row)["color"]},
            annotation_clip=False,
        )


def spread_labels(heights: Float1D, distance: float) -> Float1D:
    """Return ascending heights, (label,), moved as little as needed to lie `distance` apart."""
    # Least squares under h[k + 1] - h[k] >= distance: isotonic regression of h[k] - k * distance.
    offsets = distance * np.arange(heights.size)
    groups: list[list[float]] = []
    for value in heights - offsets:
        groups.append([float(value)])
        while len(groups) > 1 and np.mean(groups[-2]) > np.mean(groups[-1]):
            groups[-2:] = [groups[-2] + groups[-1]]
    means = [float(np.mean(group)) for group in groups for _ in group]
    return np.array(means) + offsets


def _draw_trade_off(comparison: GapComparison) -> CaptionedFigure:
    figure = Figure(figsize=TRADE_OFF_SIZE_IN)
    axis = figure.subplots()
    eta_d, eta_a = (comparison.values[comparison.main_source, name] for name in (ETA_D, ETA_A))
    for row in range(len(comparison.records)):
        axis.plot(eta_d[row], eta_a[row], **_record_style(row), marker="o", ms=2.4)
    for source, style in _list_median_styles(comparison):
        medians = [_median(comparison.values[source, name]) for name in (ETA_D, ETA_A)]
        axis.plot(
            *medians, **style, marker="o", ms=6.0 if source == comparison.main_source else 3.0
        )
        if source == comparison.main_source:
            _label_gaps(axis, medians[0], medians[1], comparison)
    _set_ratio_axes(axis, eta_d, eta_a)
    _draw_compromise(axis, comparison.reference)
    _label_lines(axis, eta_d, eta_a, comparison.records)
    axis.set_xlabel(f"$\\eta_d$: peak displacement of the bearing over that {comparison.reference}")
    axis.set_ylabel(f"$\\eta_a$: peak acceleration over that\n{comparison.reference}")
    figure.legend(handles=_make_handles(comparison), loc="outside upper center", ncols=3)
    return CaptionedFigure(
        "gaps_trade_off",
        "Trade-off of acceleration and displacement",
        "Each line leads from the widest gap, at (1, 1), to the smallest, with the name of the "
        "record. Down is less acceleration, left is less displacement; on a dotted line the "
        "compromise, the root mean square of both, has the value at its left end. Both scales are "
        "logarithmic. " + _describe_lines(comparison, ", with the names of the gaps"),
        figure,
    )


def _set_ratio_axes(axis: Axes, eta_d: Float2D, eta_a: Float2D) -> None:
    """Give both axes a logarithmic scale with plain numbers, and room for the names at the left."""
    for name, scale, values in (("x", axis.set_xscale, eta_d), ("y", axis.set_yscale, eta_a)):
        scale("log")
        low, high = _find_range(values, LABEL_MARGIN if name == "x" else AXIS_MARGIN)
        axis.set(**{f"{name}lim": (low, high)})
        ticks = [tick for tick in RATIO_TICKS if low <= tick <= high]
        axis.set(**{f"{name}ticks": ticks, f"{name}ticklabels": [f"{tick:g}" for tick in ticks]})
        getattr(axis, f"{name}axis").set_minor_locator(NullLocator())


def _draw_compromise(axis: Axes, reference: str) -> None:
    """Shade where both ratios are below 1, and draw lines of the same compromise."""
    left, (bottom, top) = axis.get_xlim()[0], axis.get_ylim()
    axis.fill_between([left, 1.0], bottom, 1.0, color=BETTER_COLOUR, alpha=0.10, lw=0)
    axis.text(
        0.99, 0.03, f"green: both smaller than {reference}", color=BETTER_COLOUR,
        fontsize=8.5, ha="right", transform=axis.transAxes,
    )  # fmt: skip
    angle = np.linspace(0.001, np.pi / 2 - 0.001, 400)
    for level in COMPROMISE_LEVELS:
        radius = math.sqrt(2.0) * level
        axis.plot(
            radius * np.cos(angle), radius * np.sin(angle),
            color=mpl.rcParams["axes.edgecolor"], lw=0.6, ls=(0, (1, 3)), zorder=0,
        )  # fmt: skip
        height = math.sqrt(max(radius**2 - left**2, 0.0))
        if bottom < height < top:
            axis.annotate(
                f"{level:g}", (left, height), xytext=(3, 1), textcoords="offset points",
                fontsize=7, color=mpl.rcParams["axes.edgecolor"],
            )  # fmt: skip


def _label_gaps(axis: Axes, eta_d: Float1D, eta_a: Float1D, comparison: GapComparison) -> None:
    for gap_mm, x, y in zip(comparison.gaps_mm, eta_d, eta_a, strict=True):
        if np.isfinite([x, y]).all():
            axis.annotate(
                format_gap(gap_mm), (x, y), xytext=(0, -16), textcoords="offset points",
                ha="center", fontsize=10.5, weight="bold", zorder=8,
            )  # fmt: skip


def _label_lines(axis: Axes, eta_d: Float2D, eta_a: Float2D, names: Sequence[str]) -> None:
    """Write the names of the lines, (record, gap), left of their ends at the smallest gap."""
    ends = []
    for row in range(len(names)):
        known = np.flatnonzero(np.isfinite(eta_d[row]) & np.isfinite(eta_a[row]))
        if known.size:
            ends.append((float(eta_a[row][known[-1]]), float(eta_d[row][known[-1]]), row))
    wanted = [_to_fraction(a, axis.get_ylim()) for a, _, _ in sorted(ends)]
    heights = spread_labels(np.array(wanted), LINE_LABEL_DISTANCE)
    leftmost = min(_to_fraction(d, axis.get_xlim()) for _, d, _ in ends)
    for (a, d, row), height in zip(sorted(ends), heights, strict=True):
        colour = _record_style(row)["color"]
        axis.annotate(
            names[row], (d, a), xytext=(leftmost - LINE_LABEL_SHIFT, height),
            textcoords="axes fraction", va="center", ha="right", fontsize=8.5, zorder=7,
            color=colour, arrowprops={"arrowstyle": "-", "lw": 0.5, "color": colour, "alpha": 0.6},
        )  # fmt: skip


def _find_range(ratios: Float2D, margin: float) -> tuple[float, float]:
    """Return the ends of a logarithmic axis that holds 1 and these ratios.

    `margin` is that at the lower end, as a share of the length; AXIS_MARGIN at the upper end.
    """
    known = ratios[np.isfinite(ratios) & (ratios > 0.0)]
    low, high = min(1.0, float(known.min())), max(1.0, float(known.max()))
    length = max(math.log(high / low), math.log(2.0))
    return low * math.exp(-margin * length), high * math.exp(AXIS_MARGIN * length)


def _to_fraction(value: float, limits: tuple[float, float]) -> float:
    """Return the place of a value on a logarithmic axis, 0 to 1."""
    return math.log(value / limits[0]) / math.log(limits[1] / limits[0])


def _median(table: Float2D) -> Float1D:
    """Return the median over the records, (gap,); NaN where a record is missing."""
    return np.median(table, axis=0)


def _record_style(row: int) -> LineStyle:
    return {"color": RECORD_COLOURS[row % len(RECORD_COLOURS)], "lw": 0.9}


def _median_style() -> LineStyle:
    return {"color": mpl.rcParams["text.color"], "lw": 3.0, "zorder": 4}


def _twin_style() -> LineStyle:
    return {"color": "#d9730d", "lw": 1.4, "ls": (0, (4, 2)), "zorder": 5}


def _list_median_styles(comparison: GapComparison) -> list[tuple[str, LineStyle]]:
    """Return the style of the median of each source."""
    return list(zip(comparison.sources, (_median_style(), _twin_style()), strict=False))


def _make_handles(comparison: GapComparison) -> list[Line2D]:
    name = comparison.main_name
    handles = [
        Line2D([], [], color="#888888", lw=0.9, marker="o", ms=2.4, label=f"one record, {name}"),
        Line2D([], [], **_median_style(), label=f"median, {name}"),
    ]
    if len(comparison.sources) > 1:
        handles.append(Line2D([], [], **_twin_style(), label="median, twin"))
    return handles


def _describe_lines(comparison: GapComparison, of_median: str = "") -> str:
    """Return the sentences of a caption that say what the lines are."""
    name = comparison.main_name
    text = f"Thin: one record, {name}. Thick{of_median}: median of the records, {name}."
    if len(comparison.sources) > 1:
        text += " Dashed: median of the twin, which is driven by the measured motion of the table."
    return text
