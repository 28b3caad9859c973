"""Figures of a run, arranged and colored as in Stefani, De Angelis, Andreaus, Figs. 2 to 12.

Import this module and `step_figures` only to draw: matplotlib is slow to import.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from table_io.block import Block
from twin.reports.level_figure import draw_level_figure
from twin.reports.report_data import (
    DIRECTIONS,
    IMPACT_KEYS,
    ReportData,
    compute_envelopes,
    compute_prestress,
    compute_step_errors,
    extract_run_prc,
)
from twin.reports.step_figures import (
    DIRECTION_COLOURS,
    DIRECTION_DASHES,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    REST_LINE_STYLE,
    TWIN_COLOUR,
    CaptionedFigures,
    draw_gap_lines,
    draw_histories,
    draw_legend,
    draw_loop_figures,
)

MARKER_SIZES = {"forward": 4.6, "backward": 2.6}  # both show where they coincide
HYSTERESIS_COLOURS = {"right": "#fff0a8", "left": "#b9f0f4"}
PRECOMPRESSION_COLOUR = "#d4d4d4"
MAX_LABELLED_JUMPS = 4
RC_PARAMS: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.linewidth": 0.7,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "#e4e4e4", "grid.linewidth": 0.6, "axes.axisbelow": True, "savefig.dpi": 150,
    "legend.frameon": False, "lines.linewidth": 1.1, "lines.markersize": 3.6,
    "figure.constrained_layout.use": True, "figure.constrained_layout.hspace": 0.06,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Picture:
    """PNG file with title and caption."""

    path: Path
    title: str
    caption: str


def draw_run_figures(run: ReportData, folder: Path) -> list[Picture]:
    """Draw all figures for which the run has data into PNG files; return them in report order."""
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("histories_*hz.png"):
        stale.unlink()
    pictures = []
    with mpl.rc_context(RC_PARAMS):
        for draw in (
            _draw_prc,
            _draw_impacts,
            draw_histories,
            draw_loop_figures,
            _draw_errors,
            _draw_overview,
            draw_level_figure,
        ):
            for name, title, caption, figure in draw(run):
                figure.savefig(folder / f"{name}.png")
                pictures.append(Picture(folder / f"{name}.png", title, caption))
    return pictures


def _format_mirrored_axis(ax: Axes) -> None:
    """Format a mirrored axis: right side above zero, left below, both labelled positive."""
    ax.axhline(0, color="#333333", lw=0.7)
    ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
    for y, va, text in ((0.98, "top", "right"), (0.02, "bottom", "left")):
        ax.text(0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE_COLOUR)


def _draw_prc(run: ReportData) -> CaptionedFigures:
    """Draw the pseudo-resonance curves (Figs. 2 and 11)."""
    panels = [
        (r"$\eta_d$, relative displacement", {"eta_d": 1}),
        (r"$\eta_a$, total acceleration", {"eta_a": 1}),
    ]
    if run.has_bumpers:
        panels += [
            (r"$\eta_j$, bumper deformation", {"eta_r": 1, "eta_l": -1}),
            (r"$r_j$, contact force over weight", {"r_r": 1, "r_l": -1}),
        ]
    if not any(
        np.isfinite(extract_run_prc(run, run.source, direction, "eta_d")[1]).any()
        for direction in DIRECTIONS
    ):
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 3.6 * len(panels) / 2 + 0.3))
    axes = figure.subplots(len(panels) // 2, 2, sharex=True, squeeze=False)
    intervals = run.summary.get("hysteresis") or []
    prestress = compute_prestress(run)
    for ax, (label, names) in zip(axes.flat, panels, strict=True):
        for interval in intervals:
            ax.axvspan(
                interval["from_hz"],
                interval["to_hz"],
                color=HYSTERESIS_COLOURS[interval["kind"]],
                lw=0,
            )
        for name, sign in names.items():
            _shade_precompression(ax, sign * prestress.get(name, 0.0))
            _plot_prc(run, ax, name, sign)
            _annotate_jumps(run, ax, name, sign)
        ax.set_ylabel(label)
        if len(names) == 2:
            _format_mirrored_axis(ax)
        else:
            ax.set_ylim(bottom=0)
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    kinds = sorted({interval["kind"] for interval in intervals})
    patches = [Patch(color=HYSTERESIS_COLOURS[kind], label=f"{kind} hysteresis") for kind in kinds]
    if prestress:
        patches.append(
            Patch(
                fc=PRECOMPRESSION_COLOUR, ec=GUIDE_COLOUR, ls="--", lw=0.8, label="precompression"
            )
        )
    draw_legend(run, figure, *patches, marker="o")
    caption = (
        "One point per frequency step, averaged over its measured cycles. Arrows: jumps between "
        "two grid frequencies. Displacement and deformation are divided by the free-flight maximum "
        "u*, acceleration by a*, forces by the weight."
    )
    if prestress:
        caption += " Grey: deformation and force of a precompressed bumper at rest, from the model."
    yield "prc", "Pseudo-resonance curves", caption, figure


def _shade_precompression(ax: Axes, y: float) -> None:
    """Shade from zero to the value `y` of a precompressed bumper at rest (Fig. 5)."""
    if y:
        ax.axhspan(0, y, color=PRECOMPRESSION_COLOUR, lw=0)
        ax.axhline(y, **REST_LINE_STYLE)


def _plot_prc(run: ReportData, ax: Axes, name: str, sign: int) -> None:
    for direction in DIRECTIONS:
        f, y = extract_run_prc(run, "measured", direction, name)
        ax.plot(
            f,
            sign * y,
            "o-",
            color=DIRECTION_COLOURS[direction],
            ms=MARKER_SIZES[direction],
            lw=2.2,
        )
    for direction in DIRECTIONS:
        f, y = extract_run_prc(run, "twin", direction, name)
        ax.plot(
            f,
            sign * y,
            color=TWIN_COLOUR,
            ls=DIRECTION_DASHES[direction],
            lw=0.8,
            marker="." if f.size == 1 else "",
        )


def _annotate_jumps(run: ReportData, ax: Axes, name: str, sign: int) -> None:
    jumps = run.summary.get("jumps") or []
    for number, jump in enumerate(jumps, 1):
        f, y = extract_run_prc(run, run.source, jump["direction"], name)
        ends = [y[np.isclose(f, jump[end])] for end in ("from_hz", "to_hz")]
        if not all(end.size and np.isfinite(end[0]) for end in ends):
            continue
        x, (start, stop) = (jump["from_hz"] + jump["to_hz"]) / 2, (sign * end[0] for end in ends)
        colour = DIRECTION_COLOURS[jump["direction"]]
        style = {"arrowstyle": "-|>", "color": colour, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", (x, stop), (x, start), arrowprops=style)
        if name == "eta_d":
            is_labelled = len(jumps) <= MAX_LABELLED_JUMPS
            low, high = sorted((jump["from_hz"], jump["to_hz"]))
            text = f"{low:g}–{high:g} Hz" if is_labelled else f"{number}"
            right = jump["to_hz"] >= jump["from_hz"] and x < f[0] + 0.85 * (f[-1] - f[0])
            ax.annotate(
                text, (x, (start + stop) / 2), (5 if right else -5, 0), color=colour, size=8,
                textcoords="offset points", ha="left" if right else "right", va="center",
                bbox={"facecolor": "white", "alpha": 0.85, "lw": 0, "pad": 1}, zorder=5,
            )  # fmt: skip


def _draw_impacts(run: ReportData) -> CaptionedFigures:
    """Draw the impacts per forcing cycle of both sides, one row per direction."""
    directions = [
        direction
        for direction in DIRECTIONS
        if extract_run_prc(run, run.source, direction, IMPACT_KEYS[0])[0].size
    ]
    counts = [
        extract_run_prc(run, run.source, direction, side)[1]
        for direction in directions
        for side in IMPACT_KEYS
    ]
    if not run.has_bumpers or not any(np.isfinite(count).any() for count in counts):
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.3 * len(directions) + 0.4))
    rows = figure.subplots(len(directions), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for ax, direction in zip(rows, directions, strict=True):
        for side, sign in zip(IMPACT_KEYS, (1, -1), strict=True):
            f, y = extract_run_prc(run, "measured", direction, side)
            ax.vlines(f, 0, sign * y, color=DIRECTION_COLOURS[direction], lw=3, alpha=0.35)
            ax.plot(f, sign * y, "o", color=DIRECTION_COLOURS[direction])
            f, y = extract_run_prc(run, "twin", direction, side)
            ax.plot(f, sign * y, "o", ms=6.5, mfc="none", mec=TWIN_COLOUR, mew=0.8)
        ax.set_ylabel("impacts per cycle")
        ax.set_title(direction)
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        _format_mirrored_axis(ax)
    rows[-1].set_xlabel("frequency in Hz")
    handles = [
        Line2D([], [], color=TWIN_COLOUR, marker="o", ms=6.5, mfc="none", ls="", label="twin")
    ]
    if run.source == "measured":
        handles += [
            Line2D(
                [],
                [],
                color=DIRECTION_COLOURS[direction],
                marker="o",
                label=f"measured {direction}",
            )
            for direction in directions
        ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    caption = (
        "Mean over the measured cycles of a step; a fractional value means that the count varies "
        "from cycle to cycle."
    )
    yield "impacts", "Impacts per forcing cycle", caption, figure


def _draw_errors(run: ReportData) -> CaptionedFigures:
    """Draw the NRMSE of the free-running and the restarted twin over frequency."""
    errors = {
        part: step_nrmse
        for part, step_nrmse in compute_step_errors(run).items()
        if np.isfinite(list(step_nrmse.values())).any()
    }
    if not errors:
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.5 * ((len(errors) + 1) // 2) + 0.4))
    axes = figure.subplots((len(errors) + 1) // 2, 2, sharex=True, sharey=True, squeeze=False)
    for ax, (part, step_nrmse) in zip(axes.flat, errors.items(), strict=False):
        for direction in DIRECTIONS:
            steps = [
                step
                for step in run.steps
                if step["direction"] == direction and step["index"] in step_nrmse
            ]
            f = [step["frequency_hz"] for step in steps]
            nrmse = np.array([step_nrmse[step["index"]] for step in steps]).reshape(-1, 2)
            ax.semilogy(f, nrmse[:, 0], "o-", color=DIRECTION_COLOURS[direction], lw=0.9)
            ax.semilogy(
                f, nrmse[:, 1], "o:", color=DIRECTION_COLOURS[direction], lw=0.9, mfc="white"
            )
        ax.set_title(f"${part}$")
    for ax in axes[:, 0]:
        ax.set_ylabel("NRMSE")
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    handles = [
        Line2D(
            [],
            [],
            color=DIRECTION_COLOURS[direction],
            marker="o",
            ls=ls,
            mfc=face,
            label=f"{twin_kind}, {direction}",
        )
        for direction in DIRECTIONS
        for twin_kind, ls, face in (
            ("free-running", "-", DIRECTION_COLOURS[direction]),
            ("restarted", ":", "white"),
        )
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    caption = (
        "NRMSE: RMS error divided by RMS measurement over the measured cycles of each step; a "
        "constant zero would give 1. The restarted twin starts every window from the measured "
        "state. Contact forces only with contact."
    )
    yield "comparison", "Error of the twin", caption, figure


def _draw_overview(run: ReportData) -> CaptionedFigures:
    """Draw envelopes of table and mass motion over the whole run, with the steps shaded."""
    blocks, rows = compute_envelopes(run)
    if not rows:
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 1.7 * len(rows) + 0.4))
    axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
    peaks = {step.acceleration_m_s2 for step in run.recording.start.steps}
    for ax, (label, envelopes) in zip(axes, rows.items(), strict=True):
        for time, low, high in envelopes:
            ax.fill_between(time, low, high, color="#8b929c", lw=0)
        ax.set_ylabel(label)
        _shade_steps(run, ax, blocks, ax is axes[0])
        if label.startswith("$u$"):
            draw_gap_lines(run, ax.axhline)
        for peak in peaks if label == "table in m/s²" else ():
            ax.axhline(peak, color="#111111", ls="--", lw=0.9)
            ax.axhline(-peak, color="#111111", ls="--", lw=0.9)
    axes[-1].set_xlabel("time in s")
    axes[-1].set_xlim(blocks[0].time_s[0], blocks[-1].time_s[-1])
    caption = (
        "Envelopes. Shading: steps, red forward, blue backward, with their frequencies in Hz on "
        "top. Dashed: demanded peak acceleration and positions of the bumpers at rest."
    )
    yield "overview", "Drive and response over the run", caption, figure


def _shade_steps(run: ReportData, ax: Axes, blocks: tuple[Block, ...], show_labels: bool) -> None:
    visits = run.summary.get("visits") or []
    steps_by_index = {step["index"]: step for step in (*run.steps, *visits)}
    duration_s = blocks[-1].time_s[-1] - blocks[0].time_s[0]
    next_label_s = 0.0
    for block in blocks:
        cuts = np.flatnonzero(np.diff(block.step)) + 1
        for first, last in zip([0, *cuts], [*cuts, len(block)], strict=True):
            step = steps_by_index.get(int(block.step[first]))
            if step is None:
                continue
            start, stop = block.time_s[first], block.time_s[last - 1]
            shade = 0.20 if step["index"] % 2 else 0.09
            ax.axvspan(
                start, stop, color=DIRECTION_COLOURS[step["direction"]], alpha=shade, lw=0, zorder=0
            )
            if show_labels and start >= next_label_s:
                middle = (start + stop) / 2
                ax.annotate(
                    f"{step['frequency_hz']:g}", (middle, 1.02), xycoords=("data", "axes fraction"),
                    ha="center", size=8, color=GUIDE_COLOUR,
                )  # fmt: skip
                next_label_s = start + duration_s / 22
