"""Figures of a batch.

PRC family of each model over its gaps, comparison of models at a gap, and resonance and hysteresis
over the gap.
"""

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from twin.drawing.page import embed_images, write_page
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Picture
from twin.drawing.pictures import direction_handles, save_figures
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    DIRECTION_DASHES,
    FREE_FLIGHT_COLOUR,
    HYSTERESIS_COLOURS,
    TWIN_COLOUR,
    LineStyle,
    guide_style,
)
from twin.drawing.prc_drawing import FREE_PANELS, PRC_PANELS, PrcPanel, make_prc_panels, plot_prc
from twin.results.report_data import Curve
from twin.studies import TABLE_FILE
from twin.studies.batch import format_gap_mm
from twin.studies.result import REMEDY, CaseSummary, Row, SweepSummary, read_batch_rows

Curves = dict[str, list[Row]]  # direction -> rows in ascending frequency
CaseCurves = dict[tuple[str, float], Curves]  # (model, gap in mm) -> curves

MODEL_COLOURS = (
    "#1559b0",
    "#c4161c",
    "#e08a00",
    "#7a3b9b",
    "#111111",
    "#3aa6b9",
    "#8c564b",
    "#7f7f7f",
)
# Dark for small gaps; without the yellow end, which is invisible on white.
GAP_COLOURMAP = ListedColormap(mpl.colormaps["plasma"](np.linspace(0.0, 0.85, 256)))
MAX_NAMED_GAPS = 9  # gaps in a legend; more get a color bar
MAX_KEYS_PER_ROW = 8  # legend entries per row
MAX_FIGURES = 12  # figures of each kind
PRC_CAPTION = (
    "Solid: forward; dashed: backward. Displacement and deformation are divided by the free-flight "
    "maximum u* of the model, acceleration by a*, forces by the weight."
)
MIN_FINITE_GAPS = 3  # for the figure over the gap
JUMP_MARKERS = {"up": "^", "down": "v"}
GAP_CAPTION = (
    "Top: largest η_d of each sweep. Bottom: bars, hysteresis from the first to the last grid "
    "frequency at which the directions differ; triangles, jumps between two grid frequencies, "
    "pointing in the direction of the change of η_d; black, frequency of the largest η_d."
)


def draw_study_figures(rows: Sequence[Row], summary: SweepSummary, folder: Path) -> list[Picture]:
    """Draw the figures of a batch as PNG files in `folder`; return them in page order."""
    return save_figures(_draw_figures(group_cases(rows), summary.cases), folder)


def group_cases(rows: Sequence[Row]) -> CaseCurves:
    cases: CaseCurves = {}
    for row in rows:
        case = str(row["model"]), float(row["gap_mm"])
        cases.setdefault(case, {}).setdefault(str(row["direction"]), []).append(row)
    for curves in cases.values():
        for rows_in_direction in curves.values():
            rows_in_direction.sort(key=lambda row: float(row["frequency_hz"]))
    return cases


def _draw_figures(cases: CaseCurves, entries: list[CaseSummary]) -> CaptionedFigures:
    """Yield the figures with unique names that are valid as file names."""
    names: set[str] = set()
    for figure in _draw_each(cases, entries):
        name = re.sub(r"[^\w.-]+", "_", figure.name)
        name = f"{name}_{len(names)}" if name in names else name
        names.add(name)
        yield replace(figure, name=name)


def _draw_each(cases: CaseCurves, entries: list[CaseSummary]) -> CaptionedFigures:
    labels = list(dict.fromkeys(label for label, _ in cases))
    gaps = list(dict.fromkeys(gap for _, gap in cases))
    for label in labels[:MAX_FIGURES]:
        curves_by_gap = {gap: curves for (model, gap), curves in cases.items() if model == label}
        if len(curves_by_gap) > 1 or len(labels) == 1:
            yield draw_family(label, curves_by_gap)
        yield from draw_gap_figure(label, [entry for entry in entries if entry.model == label])
    if len(labels) > 1:
        for gap in _thin_out(gaps):
            curves_by_model = {
                model: curves for (model, model_gap), curves in cases.items() if model_gap == gap
            }
            yield draw_models(gap, curves_by_model)


def _thin_out(gaps: list[float]) -> list[float]:
    """At most `MAX_FIGURES` of the gaps, first and last among them."""
    if len(gaps) <= MAX_FIGURES:
        return gaps
    return [gaps[round(position)] for position in np.linspace(0, len(gaps) - 1, MAX_FIGURES)]


def _make_panels(curves: Iterable[Curves]) -> tuple[Figure, list[PrcPanel]]:
    contents = PRC_PANELS if any(map(_has_contact, curves)) else FREE_PANELS
    figure = Figure(figsize=(11, 3.4 * len(contents) / 2 + 1))
    axes = figure.subplots(len(contents) // 2, 2, sharex=True, squeeze=False)
    return figure, make_prc_panels(axes, contents)


def _has_contact(curves: Curves) -> bool:
    return any(row["eta_r"] or row["eta_l"] for rows in curves.values() for row in rows)


def _draw_case(panels: list[PrcPanel], curves: Curves, colour: str, width: float) -> None:
    def extract_column(direction: str, name: str) -> Curve:
        rows = curves.get(direction, ())
        f, y = (np.array([row[column] for row in rows], dtype=np.float64)
                for column in ("frequency_hz", name))  # fmt: skip
        return f, y

    def make_style(direction: str) -> LineStyle:
        return {"color": colour, "lw": width, "ls": DIRECTION_DASHES[direction]}

    plot_prc(panels if _has_contact(curves) else panels[:2], extract_column, make_style)


def draw_family(label: str, curves_by_gap: dict[float, Curves]) -> CaptionedFigure:
    figure, panels = _make_panels(curves_by_gap.values())
    finite = sorted(gap for gap in curves_by_gap if math.isfinite(gap))
    is_named = len(finite) <= MAX_NAMED_GAPS
    scale = Normalize(finite[0], finite[-1]) if finite else Normalize()
    handles = []
    for gap in sorted(curves_by_gap, reverse=True):
        colour = FREE_FLIGHT_COLOUR
        if math.isfinite(gap):  # few gaps: colors evenly spaced; many: colors on a linear scale
            share = finite.index(gap) / max(len(finite) - 1, 1) if is_named else float(scale(gap))
            colour = to_hex(tuple(np.ravel(GAP_COLOURMAP(share)).tolist()))
        _draw_case(panels, curves_by_gap[gap], colour, 1.3 if is_named else 0.9)
        if is_named or math.isinf(gap):
            handles.append(Line2D([], [], color=colour, lw=2, label=_format_gap_label(gap)))
    if not is_named:
        mappable = ScalarMappable(scale, GAP_COLOURMAP)
        figure.colorbar(mappable, ax=[ax for ax, _ in panels], label="total gap in mm", pad=0.01)
    _draw_legend(figure, handles, next(iter(curves_by_gap.values())))
    gap_text = (
        _format_gap_label(max(curves_by_gap))
        if len(curves_by_gap) == 1
        else f"{len(curves_by_gap)} gaps"
    )
    title = f"Pseudo-resonance curves of {label}, {gap_text}"
    return CaptionedFigure(f"prc_{label}", title, PRC_CAPTION, figure)


def _format_gap_label(gap: float) -> str:
    return format_gap_mm(gap).replace("-", "−")


def _draw_legend(figure: Figure, handles: list[Line2D], curves: Curves) -> None:
    """Draw the legend of these handles and of the directions, in rows of equal length."""
    handles = [*handles, *direction_handles(guide_style, directions=list(curves))]
    row_count = math.ceil(len(handles) / MAX_KEYS_PER_ROW)
    columns = math.ceil(len(handles) / row_count)
    figure.legend(handles=handles, loc="outside upper center", ncols=columns)


def draw_models(gap: float, curves_by_model: dict[str, Curves]) -> CaptionedFigure:
    figure, panels = _make_panels(curves_by_model.values())
    handles = []
    for index, (label, curves) in enumerate(curves_by_model.items()):
        colour = MODEL_COLOURS[index % len(MODEL_COLOURS)]
        _draw_case(panels, curves, colour, 1.3 if index < len(MODEL_COLOURS) else 0.7)
        handles.append(Line2D([], [], color=colour, lw=2, label=label))
    _draw_legend(figure, handles, next(iter(curves_by_model.values())))
    name = "inf" if math.isinf(gap) else f"{gap:g}"
    return CaptionedFigure(
        f"models_g{name}",
        f"{len(curves_by_model)} models, {_format_gap_label(gap)}",
        PRC_CAPTION,
        figure,
    )


def draw_gap_figure(label: str, entries: list[CaseSummary]) -> CaptionedFigures:
    """Draw one figure from the summary entries of the cases of one model."""
    peaks = {case.gap_mm: case.peak for case in entries if case.peak and math.isfinite(case.gap_mm)}
    cases = sorted((case for case in entries if case.gap_mm in peaks), key=lambda case: case.gap_mm)
    if len(cases) < MIN_FINITE_GAPS:
        return
    figure = Figure(figsize=(11, 6.4))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    gaps = sorted(peaks)
    top.plot(gaps, [peaks[gap].eta_d for gap in gaps], "o-", color=TWIN_COLOUR)
    top.set_ylabel(r"largest $\eta_d$")
    top.set_ylim(bottom=0)
    width = 0.7 * min(b - a for a, b in pairwise(gaps))
    for case in cases:
        _plot_branches(bottom, case, width)
    bottom.plot(gaps, [peaks[gap].frequency_hz for gap in gaps], "o-", ms=3, lw=0.8,
                color=TWIN_COLOUR, zorder=3)  # fmt: skip
    bottom.set_ylabel("frequency in Hz")
    bottom.set_xlabel("total gap in mm")
    figure.legend(handles=_legend_handles(cases), loc="outside upper center", ncols=4)
    yield CaptionedFigure(f"gaps_{label}", f"{label} over the gap", GAP_CAPTION, figure)


def _plot_branches(ax: Axes, case: CaseSummary, width: float) -> None:
    gap = case.gap_mm
    for interval in case.hysteresis:
        height_hz = max(
            interval.to_hz - interval.from_hz, 0.02
        )  # keeps an interval of a single grid frequency visible
        ax.bar(
            gap,
            height_hz,
            width,
            interval.from_hz,
            color=HYSTERESIS_COLOURS[interval.kind],
            lw=0.6,
            ec="#b0b0b0",
        )
    for jump in case.jumps:
        middle_hz = (jump.from_hz + jump.to_hz) / 2
        ax.plot(
            gap,
            middle_hz,
            JUMP_MARKERS[jump.kind],
            color=DIRECTION_COLOURS[jump.direction],
            ms=6,
            zorder=4,
        )


def _legend_handles(cases: list[CaseSummary]) -> list[Line2D | Patch]:
    """Return legend handles of the plotted kinds only."""
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=TWIN_COLOUR, marker="o", ms=3, label=r"largest $\eta_d$")
    ]
    kinds = sorted({interval.kind for case in cases for interval in case.hysteresis})
    handles += [
        Patch(fc=HYSTERESIS_COLOURS[kind], ec="#b0b0b0", label=f"{kind} hysteresis")
        for kind in kinds
    ]
    jumps = sorted({(jump.direction, jump.kind) for case in cases for jump in case.jumps})
    return handles + [
        Line2D(
            [],
            [],
            color=DIRECTION_COLOURS[direction],
            marker=JUMP_MARKERS[kind],
            ls="",
            label=f"jump {kind}, {direction}",
        )
        for direction, kind in jumps
    ]


def write_study_page(folder: Path) -> Path:
    """Write folder/report.html and its figures; return the path."""
    summary = SweepSummary.read(folder / "summary.json", REMEDY)
    pictures = draw_study_figures(read_batch_rows(folder / TABLE_FILE), summary, folder / "figures")
    return write_page(
        folder,
        Path(__file__).with_name("batch.html"),
        summary=summary,
        images=embed_images(pictures),
        format_gap=format_gap_mm,
    )
