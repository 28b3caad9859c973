"""Page, tables and figures of a resonance map over a parameter.

Loci of folds and grazings, and the largest motion: the design question of the paper, which gap
keeps the displacement small, and which the acceleration.
"""

import csv
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from twin.drawing.branch_curves import Axis, make_axis
from twin.drawing.page import embed_images, write_page
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Picture
from twin.drawing.pictures import save_figures
from twin.drawing.plot_style import FIGURE_WIDTH_IN, GUIDE_COLOUR, LineStyle
from twin.dynamics.main_branches import ResonanceMap

LOCUS_STYLES: dict[str, LineStyle] = {
    "fold": {"color": "#c4161c", "lw": 1.6},
    "grazing": {"color": "#111111", "lw": 1.0, "ls": (0, (4, 2.2))},
}
PEAK_COLOUR, BEST_COLOUR, WORST_COLOUR = "#1559b0", "#2e9e5b", "#c4161c"


def draw_map_figures(resonance: ResonanceMap, folder: Path) -> list[Picture]:
    """Draw loci and peaks into PNG files; return them in order."""
    return save_figures(
        (figure for draw in (_draw_loci, _draw_peaks) for figure in draw(resonance)), folder
    )


def _draw_loci(resonance: ResonanceMap) -> CaptionedFigures:
    """Draw the loci over frequency and parameter, and the frequency of the largest motion."""
    axis = make_axis(resonance.parameter)
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 5.2))
    ax = figure.subplots()
    peaks = resonance.peaks
    ax.plot(peaks.u_hz, axis.factor * peaks.values, color=PEAK_COLOUR, lw=3.5, alpha=0.3)
    for locus in resonance.loci:
        ax.plot(locus.values[:, 0], axis.factor * locus.values[:, 1], **LOCUS_STYLES[locus.kind])
    ax.set_xlim(resonance.limits_hz)
    ax.set_ylim(axis.factor * peaks.values[0], axis.factor * peaks.values[-1])
    ax.set_xlabel("frequency in Hz")
    ax.set_ylabel(axis.label)
    handles = [Line2D([], [], **style, label=kind) for kind, style in LOCUS_STYLES.items()] + [
        Line2D([], [], color=PEAK_COLOUR, lw=3.5, alpha=0.3, label="largest displacement")
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    yield CaptionedFigure(
        "loci",
        "Folds and grazings",
        "Between two folds the model has two stable motions and shows a hysteresis. At a grazing a "
        "contact appears or vanishes. Wide line: frequency of the largest stable displacement.",
        figure,
    )  # fmt: skip


def _draw_peaks(resonance: ResonanceMap) -> CaptionedFigures:
    """Draw the largest displacement, acceleration and their frequency over the parameter."""
    axis, peaks = make_axis(resonance.parameter), resonance.peaks
    x = axis.factor * peaks.values
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 3.6))
    displacement, acceleration = figure.subplots(1, 2)
    _draw_peak(displacement, x, 1e3 * peaks.u_m, axis)
    displacement.set_ylabel("largest amplitude of u in mm")
    _draw_peak(acceleration, x, peaks.a_m_s2, axis)
    acceleration.set_ylabel("largest amplitude of total\nacceleration in m/s²")
    yield CaptionedFigure(
        "peaks",
        "Resonance peak",
        "Largest stable motion over the frequency range. Green: the least, red: the most, within "
        "the range shown.",
        figure,
    )


def _draw_peak(ax: Axes, x: Float1D, y: Float1D, axis: Axis) -> None:
    """Draw a peak over the parameter; mark where it is least and most."""
    ax.plot(x, y, color=PEAK_COLOUR, lw=1.6)
    ax.set_xlabel(axis.label)
    if not np.isfinite(y).any():
        return
    ax.set_ylim(0, 1.12 * np.nanmax(y))
    ends = ((int(np.nanargmin(y)), BEST_COLOUR, -16), (int(np.nanargmax(y)), WORST_COLOUR, 9))
    for index, colour, offset in ends:
        ax.plot(x[index], y[index], "o", color=colour, ms=7, zorder=3)
        right = x[index] > (x[0] + x[-1]) / 2
        ax.annotate(
            f"{y[index]:.3g} at {x[index]:.3g}".replace("-", "−"), (x[index], y[index]),
            (0, offset), textcoords="offset points", ha="right" if right else "left",
            color=GUIDE_COLOUR,
        )  # fmt: skip


def write_map_report(
    folder: Path, resonance: ResonanceMap, title: str, subtitle: str, model_toml: str
) -> Path:
    """Write report.html, peaks.csv, loci.csv and figures/*.png to `folder`.

    Return the path of the page. The tables are in SI.
    """
    pictures = draw_map_figures(resonance, folder / "figures")
    write_tables(resonance, folder)
    axis, peaks = make_axis(resonance.parameter), resonance.peaks
    columns = (
        axis.factor * peaks.values, 1e3 * peaks.u_m, peaks.u_hz, peaks.a_m_s2, peaks.a_hz
    )  # fmt: skip
    return write_page(
        folder,
        Path(__file__).with_name("map.html"),
        title=title,
        subtitle=subtitle,
        headline=format_map_headline(resonance),
        parameter=axis.label,
        rows=np.column_stack(columns).tolist(),
        images=embed_images(pictures),
        model=model_toml,
    )


def write_tables(resonance: ResonanceMap, folder: Path) -> None:
    """Write peaks.csv and loci.csv, in SI, without loss of precision."""
    name, peaks = resonance.parameter, resonance.peaks
    with (folder / "peaks.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([name, "u_m", "u_frequency_hz", "a_m_s2", "a_frequency_hz"])
        writer.writerows(
            np.column_stack(
                (peaks.values, peaks.u_m, peaks.u_hz, peaks.a_m_s2, peaks.a_hz)
            ).tolist()
        )
    with (folder / "loci.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["locus", "kind", "frequency_hz", name])
        for number, locus in enumerate(resonance.loci, 1):
            writer.writerows([number, locus.kind, *place] for place in locus.values.tolist())


def format_map_headline(resonance: ResonanceMap) -> str:
    """State where the largest displacement and acceleration are least, in one sentence."""
    axis, peaks = make_axis(resonance.parameter), resonance.peaks
    parts = []
    for label, unit, y in (
        ("displacement", "mm", 1e3 * peaks.u_m),
        ("total acceleration", "m/s²", peaks.a_m_s2),
    ):
        if not np.isfinite(y).any():
            continue
        least, most = int(np.nanargmin(y)), int(np.nanargmax(y))
        x = axis.factor * peaks.values
        parts.append(
            f"the largest {label} is least, {y[least]:.3g} {unit}, at {x[least]:.4g} and "
            f"most, {y[most]:.3g} {unit}, at {x[most]:.4g}"
        )
    text = "; ".join(parts) or "no stable motion is known"
    return f"{text[0].upper()}{text[1:]} ({axis.label})."
