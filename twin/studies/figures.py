"""Figures of a batch.

PRC family of each model over its gaps, comparison of models at a gap, and resonance and hysteresis
over the gap.
"""

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, Normalize, to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from twin.reports.figures import RC_PARAMS, Picture
from twin.reports.step_figures import DIRECTION_DASHES, GUIDE_COLOUR
from twin.reports.summary import Json
from twin.studies import over_gap
from twin.studies.cases import format_gap_mm
from twin.studies.rows import Row

Curves = dict[str, list[Row]]  # direction -> rows in ascending frequency
CaseCurves = dict[tuple[str, float], Curves]  # (model, gap in mm) -> curves
PanelAxes = list[tuple[Axes, dict[str, int]]]  # axes and the plotted columns with their signs
CaptionedFigures = Iterator[tuple[str, str, str, Figure]]  # file name, title, caption, figure

PANELS = (
    (r"$\eta_d$, relative displacement", {"eta_d": 1}),
    (r"$\eta_a$, total acceleration", {"eta_a": 1}),
    (r"$\eta_j$, bumper deformation", {"eta_r": 1, "eta_l": -1}),
    (r"$r_j$, contact force over weight", {"r_r": 1, "r_l": -1}),
)
FREE_COLOUR = "#2e9e5b"
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


def draw_study_figures(rows: Sequence[Row], summary: Json, folder: Path) -> list[Picture]:
    """Draw the figures of a batch as PNG files in `folder`; return them in page order."""
    folder.mkdir(parents=True, exist_ok=True)
    pictures: list[Picture] = []
    with mpl.rc_context(RC_PARAMS):
        for name, title, caption, figure in _draw_figures(_group_cases(rows), summary["cases"]):
            path = folder / f"{_unique_name(name, {picture.path.stem for picture in pictures})}.png"
            figure.savefig(path)
            pictures.append(Picture(path, title, caption))
    return pictures


def _group_cases(rows: Sequence[Row]) -> CaseCurves:
    cases: CaseCurves = {}
    for row in rows:
        case = str(row["model"]), float(row["gap_mm"])
        cases.setdefault(case, {}).setdefault(str(row["direction"]), []).append(row)
    for curves in cases.values():
        for rows_in_direction in curves.values():
            rows_in_direction.sort(key=lambda row: float(row["frequency_hz"]))
    return cases


def _unique_name(name: str, taken: set[str]) -> str:
    """Return a unique name without characters that are invalid in a file name."""
    plain = re.sub(r"[^\w.-]+", "_", name)
    return f"{plain}_{len(taken)}" if plain in taken else plain


def _draw_figures(cases: CaseCurves, entries: list[Json]) -> CaptionedFigures:
    labels = list(dict.fromkeys(label for label, _ in cases))
    gaps = list(dict.fromkeys(gap for _, gap in cases))
    for label in labels[:MAX_FIGURES]:
        curves_by_gap = {gap: curves for (model, gap), curves in cases.items() if model == label}
        if len(curves_by_gap) > 1 or len(labels) == 1:
            yield _draw_family(label, curves_by_gap)
        yield from over_gap.draw_gap_figure(
            label, [entry for entry in entries if entry["model"] == label]
        )
    if len(labels) > 1:
        for gap in _thin_out(gaps):
            curves_by_model = {
                model: curves for (model, model_gap), curves in cases.items() if model_gap == gap
            }
            yield _draw_models(gap, curves_by_model)


def _thin_out(gaps: list[float]) -> list[float]:
    """At most `MAX_FIGURES` of the gaps, first and last among them."""
    if len(gaps) <= MAX_FIGURES:
        return gaps
    return [gaps[round(position)] for position in np.linspace(0, len(gaps) - 1, MAX_FIGURES)]


def _make_axes(bumpers: bool) -> tuple[Figure, PanelAxes]:
    panels = PANELS if bumpers else PANELS[:2]
    figure = Figure(figsize=(11, 7.8 if bumpers else 4.4))
    axes = figure.subplots(len(panels) // 2, 2, sharex=True, squeeze=False)
    for ax, (label, names) in zip(axes.flat, panels, strict=True):
        ax.set_ylabel(label)
        if len(names) == 2:
            ax.axhline(0, color="#333333", lw=0.7)
            ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
            for y, va, text in ((0.98, "top", "right"), (0.02, "bottom", "left")):
                ax.text(
                    0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE_COLOUR
                )
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    return figure, [(ax, names) for ax, (_, names) in zip(axes.flat, panels, strict=True)]


def _has_contact(curves: Curves) -> bool:
    return any(row["eta_r"] or row["eta_l"] for rows in curves.values() for row in rows)


def _plot_curves(axes: PanelAxes, curves: Curves, style: dict[str, Any]) -> None:
    for ax, names in axes:
        if len(names) == 2 and not _has_contact(curves):
            continue
        for name, sign in names.items():
            for direction, rows in curves.items():
                f, y = (_extract_column(rows, column) for column in ("frequency_hz", name))
                marker = "o" if f.size == 1 else ""
                ax.plot(f, sign * y, ls=DIRECTION_DASHES[direction], marker=marker, **style)


def _extract_column(rows: list[Row], name: str) -> Float1D:
    return np.array([row[name] for row in rows], dtype=np.float64)


def _direction_handles(curves: Curves) -> list[Line2D]:
    return [
        Line2D([], [], color=GUIDE_COLOUR, ls=DIRECTION_DASHES[direction], label=direction)
        for direction in curves
    ]


def _draw_family(label: str, curves_by_gap: dict[float, Curves]) -> tuple[str, str, str, Figure]:
    figure, axes = _make_axes(any(map(_has_contact, curves_by_gap.values())))
    finite = sorted(gap for gap in curves_by_gap if math.isfinite(gap))
    is_named = len(finite) <= MAX_NAMED_GAPS
    scale = Normalize(finite[0], finite[-1]) if finite else Normalize()
    handles = []
    for gap in sorted(curves_by_gap, reverse=True):
        colour = FREE_COLOUR
        if math.isfinite(gap):  # few gaps: colors evenly spaced; many: colors on a linear scale
            share = finite.index(gap) / max(len(finite) - 1, 1) if is_named else float(scale(gap))
            colour = to_hex(tuple(np.ravel(GAP_COLOURMAP(share)).tolist()))
        _plot_curves(axes, curves_by_gap[gap], {"color": colour, "lw": 1.3 if is_named else 0.9})
        if is_named or math.isinf(gap):
            handles.append(Line2D([], [], color=colour, lw=2, label=_format_gap_label(gap)))
    if not is_named:
        mappable = ScalarMappable(scale, GAP_COLOURMAP)
        figure.colorbar(mappable, ax=[ax for ax, _ in axes], label="total gap in mm", pad=0.01)
    _finish_figure(
        figure, axes, [*handles, *_direction_handles(next(iter(curves_by_gap.values())))]
    )
    gap_text = (
        _format_gap_label(max(curves_by_gap))
        if len(curves_by_gap) == 1
        else f"{len(curves_by_gap)} gaps"
    )
    return f"prc_{label}", f"Pseudo-resonance curves of {label}, {gap_text}", PRC_CAPTION, figure


def _format_gap_label(gap: float) -> str:
    return format_gap_mm(gap).replace("-", "−")


def _finish_figure(figure: Figure, axes: PanelAxes, handles: list[Line2D]) -> None:
    """Start the ratio axes at zero and draw the legend in rows of equal length."""
    for ax, _ in axes[:2]:
        ax.set_ylim(bottom=0)
    row_count = math.ceil(len(handles) / MAX_KEYS_PER_ROW)
    columns = math.ceil(len(handles) / row_count)
    figure.legend(handles=handles, loc="outside upper center", ncols=columns)


def _draw_models(gap: float, curves_by_model: dict[str, Curves]) -> tuple[str, str, str, Figure]:
    figure, axes = _make_axes(any(map(_has_contact, curves_by_model.values())))
    handles = []
    for index, (label, curves) in enumerate(curves_by_model.items()):
        colour = MODEL_COLOURS[index % len(MODEL_COLOURS)]
        _plot_curves(
            axes, curves, {"color": colour, "lw": 1.3 if index < len(MODEL_COLOURS) else 0.7}
        )
        handles.append(Line2D([], [], color=colour, lw=2, label=label))
    _finish_figure(
        figure, axes, [*handles, *_direction_handles(next(iter(curves_by_model.values())))]
    )
    name = "inf" if math.isinf(gap) else f"{gap:g}"
    return (
        f"models_g{name}",
        f"{len(curves_by_model)} models, {_format_gap_label(gap)}",
        PRC_CAPTION,
        figure,
    )
