"""Figures of a discovery: residual map, candidates, and residual over time.

`draw_discovery_figures` also draws the force close-ups of `force_figures` and the free-running
twin of `twin_figures`.
"""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from table_io.block import Float1D, Float2D
from table_io.records import Step
from twin.discovery.figure_data import DiscoveryView, is_periodic, list_phases
from twin.discovery.force_figures import draw_force_histories, draw_residual_forces
from twin.discovery.free_running import FreeRuns
from twin.discovery.localization import ResidualCell
from twin.discovery.parameters import TARE_PREFIX
from twin.discovery.residuals import FORCE_ROWS, LogResiduals
from twin.discovery.result import CandidateResult, DecisiveTest, Verdict
from twin.discovery.twin_figures import draw_free_running
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, Picture
from twin.drawing.pictures import save_figures
from twin.drawing.plot_style import DIRECTION_COLOURS, FIGURE_WIDTH_IN, GUIDE_COLOUR, TWIN_COLOUR

MAX_LOGS, MAX_BARS, MAX_TICKS = 6, 24, 24
RIVAL_STYLES = (("#1559b0", "o-"), ("#cf222e", "s--"), ("#1a7f37", "^:"), ("#9a6700", "v-."))
MIN_INSIDE_SHARE = 0.3  # of the longest bar: longer bars carry their note inside
MIN_EXCESS = 0.1  # lower end of the color scale, relative to the noise
MIN_TOP_EXCESS = 10.0  # smallest upper end of the color scale, so that noise stays pale
MIN_CELL_SIGMA = 3.0  # standard errors above which a cell is marked
PHASE_LABELS = {
    "flight": "flight", "contact_right": "right", "contact_left": "left", "contact_both": "both",
}  # fmt: skip
GIVEN_COLOUR = "#c9ced6"
BEFORE_COLOUR, AFTER_COLOUR, BEST_COLOUR = "#8b929c", "#1a7f37", "#1a7f37"


def draw_discovery_figures(
    view: DiscoveryView, verdict: Verdict, runs: dict[int, FreeRuns], folder: Path
) -> dict[str, list[Picture]]:
    """Draw all figures as PNG files in `folder`; return them by section of the page."""
    return {
        section: save_figures(figures, folder)
        for section, figures in {
            "staircase": _draw_staircase(verdict),
            "where": _draw_maps(view), "candidates": _draw_candidates(verdict),
            "forces": draw_residual_forces(view),
            "histories": draw_force_histories(view),
            "twin": draw_free_running(view, runs, select_logs(view)),
            "time": _draw_time(view),
            "decide": _draw_prediction(verdict.decide),
        }.items()
    }  # fmt: skip


def _draw_staircase(verdict: Verdict) -> CaptionedFigures:
    """Draw the misfit falling step by step, from the model as given to the noise floor."""
    steps = verdict.staircase
    sizes = [step.misfit for step in steps]
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 3.3))
    ax = figure.subplots()
    floor = sizes[-1]
    bottom = 0.5 * min(sizes)
    for number, size in enumerate(sizes[:-1]):
        colour = (GIVEN_COLOUR, BEFORE_COLOUR, BEST_COLOUR)[min(number, 2)]
        ax.bar(number, size - bottom, bottom=bottom, width=0.62, color=colour)
        ax.annotate(f"{size:.3g} ×", (number, size), (0, 3), textcoords="offset points",
                    ha="center", weight="bold")  # fmt: skip
        if number:
            fall = f"÷ {sizes[number - 1] / size:.2g}" if size > 0 else ""
            ax.plot((number - 1.31, number + 0.31), [sizes[number - 1]] * 2, color=GUIDE_COLOUR,
                    lw=0.8, ls=":")  # fmt: skip
            ax.annotate(fall, (number - 0.5, math.sqrt(size * sizes[number - 1])), ha="center",
                        size=8, color=GUIDE_COLOUR)  # fmt: skip
    ax.axhline(floor, color=TWIN_COLOUR, ls="--", lw=1)
    ax.annotate(f"noise floor {floor:.3g} ×", (len(sizes) - 1.45, floor), (0, 3),
                textcoords="offset points", size=8)  # fmt: skip
    ax.set_yscale("log")
    ax.set_ylim(bottom, 2.2 * max(sizes))
    ax.set_xlim(-0.6, len(sizes) - 0.9)
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_formatter("")
    labels = [step.label.replace("_", " ").replace(" + ", "\n+ ") for step in steps[:-1]]
    ax.set_xticks(range(len(labels)), labels)
    ax.grid(visible=False, axis="x")
    ax.set_ylabel("misfit, multiples of the noise")
    caption = (
        "rms of measured minus modelled forces on the measured motion, in multiples of the sensor "
        "noise: the model as given, its parameters refitted without an effect, then each effect "
        "added. What is fitted is judged on held-out steps."
    )
    yield CaptionedFigure("staircase", "How the misfit falls", caption, figure)


def select_logs(view: DiscoveryView) -> list[int]:
    """Return the logs to draw: at most `MAX_LOGS`, those with the largest residuals."""
    squares = [
        float(values @ values) / max(values.size, 1) for values in view.before_after[0].held_out
    ]
    return sorted(np.argsort(squares)[::-1][:MAX_LOGS].tolist())


def _draw_maps(view: DiscoveryView) -> CaptionedFigures:
    """Draw the residual map before and after, one figure per log."""
    for number in select_logs(view):
        residuals, steps = view.log_residuals[number], view.sweep_steps(number)
        cell_maps = [
            [cell for cell in cells if cell.log == number]
            for cells in (view.discovery.map_before, view.discovery.map_after)
        ]
        if steps and cell_maps[0]:
            figure = _draw_map(residuals, steps, cell_maps)
            caption = (
                "Mean square of measured minus model over that of the noise, less the floor, "
                "held out. Steps in the order in which they were driven: red forward, blue "
                f"backward. A dot marks a significant excess (more than {MIN_CELL_SIGMA:g} "
                "standard errors). Hatched: the measured motion is aperiodic (chaos, transient); "
                "forces on the measured motion remain comparable."
            )
            title = f"Residual map{view.title_suffix(number)}"
            yield CaptionedFigure(f"map_{number}", title, caption, figure)


def _draw_map(
    residuals: LogResiduals, steps: Sequence[Step], maps: list[list[ResidualCell]]
) -> Figure:
    """Draw one panel per residual row, before left, after right."""
    present = {cell.row for cell in maps[0]}
    rows = {
        name: list_phases(residuals, k) for k, name in enumerate(residuals.rows) if name in present
    }
    heights = [len(phases) + 0.4 for phases in rows.values()]
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 0.21 * sum(heights) + 0.22 * len(rows) + 1.3))
    axes = figure.subplots(len(rows), 2, sharey="row", squeeze=False, height_ratios=heights)
    top = max([cell.excess for cells in maps for cell in cells] + [MIN_TOP_EXCESS])
    norm = LogNorm(MIN_EXCESS, top, clip=True)
    image = None
    for column, cells in enumerate(maps):
        for ax, (name, phases) in zip(axes[:, column], rows.items(), strict=True):
            excess, errors = _cell_table(
                [cell for cell in cells if cell.row == name], steps, phases
            )
            shaded = np.where(np.isnan(excess), np.nan, np.maximum(excess, MIN_EXCESS))
            image = ax.imshow(
                shaded, norm=norm, cmap="YlOrRd", aspect="auto", interpolation="nearest"
            )
            y, x = np.nonzero((errors > MIN_CELL_SIGMA) & (excess > 0))
            ax.plot(x, y, "o", color=TWIN_COLOUR, ms=1.8)
            _style_map_axes(ax, residuals, steps, phases)
        axes[0, column].set_title(("before: the model alone", "after")[column], pad=14)
        _label_map_rows(axes[:, column].tolist(), list(rows))
        _label_map_steps(axes[-1, column], steps)
    if image is not None:
        colour_bar = figure.colorbar(image, ax=axes, fraction=0.025, pad=0.015)
        colour_bar.set_label("excess over the noise")
    return figure


def _label_map_rows(axes: Sequence[Axes], names: list[str]) -> None:
    for ax, name in zip(axes, names, strict=True):
        text = {"right": "right bumper", "left": "left bumper"}.get(name, name)
        if name not in FORCE_ROWS:
            text = f"{text}: sensor consistency"
        ax.annotate(
            text, (0, 1), (0, 2), xycoords="axes fraction", textcoords="offset points", size=8,
            color=GUIDE_COLOUR,
        )  # fmt: skip


def _cell_table(
    cells: list[ResidualCell], steps: Sequence[Step], phases: list[str]
) -> tuple[Float2D, Float2D]:
    """Return (excess, standard errors) of the cells of a row, (phase, step); NaN without cell."""
    column_of = {step.index: k for k, step in enumerate(steps)}
    excess = np.full((len(phases), len(steps)), np.nan)
    errors = np.full(excess.shape, np.nan)
    for cell in cells:
        if cell.step in column_of:
            at = phases.index(cell.phase), column_of[cell.step]
            excess[at], errors[at] = cell.excess, cell.significance
    return excess, errors


def _style_map_axes(
    ax: Axes, residuals: LogResiduals, steps: Sequence[Step], phases: list[str]
) -> None:
    ax.grid(visible=False)
    ax.set_facecolor("#f3f4f6")
    ax.set_yticks(range(len(phases)), [PHASE_LABELS[phase] for phase in phases], size=7.5)
    ax.set_xticks([])
    ax.tick_params(length=0)
    for k, step in enumerate(steps):
        if k and step.direction != steps[k - 1].direction:
            ax.axvline(k - 0.5, color=GUIDE_COLOUR, lw=0.8)
        if not is_periodic(residuals, step):
            ax.axvspan(k - 0.5, k + 0.5, fc="none", ec="#00000038", hatch="////", lw=0)


def _label_map_steps(ax: Axes, steps: Sequence[Step]) -> None:
    """Label the lowest panel with frequencies in the color of their direction."""
    places = range(0, len(steps), -(-len(steps) // MAX_TICKS))
    ax.set_xticks(places, [f"{steps[k].frequency_hz:.3g}" for k in places], size=7, rotation=90)
    for label, k in zip(ax.get_xticklabels(), places, strict=True):
        label.set_color(DIRECTION_COLOURS[steps[k].direction])
    ax.set_xlabel("step, frequency in Hz")


def _draw_candidates(verdict: Verdict) -> CaptionedFigures:
    """Draw the held-out error of every fitted set, best first."""
    candidates = verdict.candidates
    null = next(candidate for candidate in candidates if candidate.id == "nothing added")
    sets = candidates[:MAX_BARS]
    if null not in sets:
        sets = [*sets[:-1], null]
    added_ids = {effect.name for effect in verdict.effects}
    floor, best = verdict.gap.noise_floor, sets[0].held_out_error
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 0.23 * len(sets) + 1.2))
    ax = figure.subplots()
    is_log_scale = sets[-1].held_out_error > 8 * min(best, floor)
    for y, candidate in enumerate(sets):
        ax.barh(
            y,
            candidate.held_out_error,
            color=_bar_colour(candidate, null, added_ids),
            height=0.68,
        )
        inside = (
            bool(_format_doubts(candidate))
            and candidate.held_out_error > MIN_INSIDE_SHARE * sets[-1].held_out_error
        )
        ax.annotate(
            f"{candidate.held_out_error:.3g}{_format_doubts(candidate)}",
            (candidate.held_out_error, y),
            (-4 if inside else 4, 0), textcoords="offset points", va="center", size=7.5,
            ha="right" if inside else "left", color=TWIN_COLOUR if inside else GUIDE_COLOUR,
        )  # fmt: skip
    ax.set_yticks(range(len(sets)), [candidate.id for candidate in sets], size=8)
    ax.set_ylim(len(sets) - 0.4, -0.6)
    if is_log_scale:
        ax.set_xscale("log")
        ax.xaxis.set_major_formatter("{x:g}")
        ax.set_xlim(0.7 * min(best, floor), 2 * sets[-1].held_out_error)
    else:
        ax.set_xlim(0, 1.15 * max(sets[-1].held_out_error, floor))
    ax.axvline(floor, color=TWIN_COLOUR, ls="--", lw=1)
    ax.grid(visible=False, axis="y")
    ax.set_xlabel("rms of measured minus model over the noise, held out")
    kinds = {"nothing added": BEFORE_COLOUR, "selected": BEST_COLOUR,
             "other effects": "#9db7d5"}  # fmt: skip
    colours = {_bar_colour(candidate, null, added_ids) for candidate in sets}
    handles = [Patch(color=c, label=text) for text, c in kinds.items() if c in colours]
    all_handles = [*handles, Line2D([], [], color=TWIN_COLOUR, ls="--", label="noise floor")]
    figure.legend(handles=all_handles, loc="outside upper center", ncols=5)
    hidden_count = len(candidates) - len(sets)
    caption = (
        "Held-out error of every fitted set of effects, by three-fold cross-validation over the "
        "steps; the base parameters are refitted with each set. What is selected is the most "
        "probable set, by its evidence."
    )
    caption += f" {hidden_count} worse sets are not drawn." if hidden_count > 0 else ""
    yield CaptionedFigure("candidates", "Candidate effects", caption, figure)


def _format_doubts(candidate: CandidateResult) -> str:
    """Return remarks on a fit: not converged, parameters at a bound (tare errors do not count)."""
    at_bound = [name for name in candidate.at_bound if not name.startswith(TARE_PREFIX)]
    text = "" if candidate.converged else ", not converged"
    return f"{text}, {at_bound[0]} at its bound" if at_bound else text


def _bar_colour(candidate: CandidateResult, null: CandidateResult, added_ids: set[str]) -> str:
    if candidate is null:
        return BEFORE_COLOUR
    return BEST_COLOUR if set(candidate.id.split(" + ")) == added_ids else "#9db7d5"


def _draw_time(view: DiscoveryView) -> CaptionedFigures:
    """Draw the mean square of each block over time, before and after; it shows drifts."""
    for number in select_logs(view):
        residuals = view.log_residuals[number]
        rows = {"damper": [0], "bumpers": [1, 2]}
        rows = {k: v for k, v in rows.items() if np.isin(residuals.entry_row, v).any()}
        figure = Figure(figsize=(FIGURE_WIDTH_IN, 1.8 * len(rows) + 0.6))
        axes = figure.subplots(len(rows), 1, sharex=True, squeeze=False)[:, 0]
        for fitted, colour in zip(view.before_after, (BEFORE_COLOUR, AFTER_COLOUR), strict=True):
            for ax, row_numbers in zip(axes, rows.values(), strict=True):
                t, squares = _block_means(residuals, view.evaluate(fitted, number), row_numbers)
                marker_style = (
                    {"ms": 4.5, "mfc": "none"} if colour == BEFORE_COLOUR else {"ms": 2.6}
                )
                ax.semilogy(t, squares, "o", color=colour, **marker_style)
                ax.yaxis.set_major_formatter("{x:g}")
                ax.yaxis.set_minor_formatter("")
        for ax, name in zip(axes, rows, strict=True):
            discovery = view.discovery
            floor = discovery.prepared.problem.find_noise_floor(discovery.verdict.best) ** 2
            low, high = ax.get_ylim()
            ax.axhline(floor, color=TWIN_COLOUR, ls="--", lw=0.9)
            ax.set_ylim(min(low, 0.08 * floor), max(high, 12 * floor))
            ax.set_ylabel(name)
        axes[-1].set_xlabel("time in s")
        handles = [
            Line2D([], [], color=BEFORE_COLOUR, marker="o", mfc="none", ls="", label="before"),
            Line2D([], [], color=AFTER_COLOUR, marker="o", ls="", label="after"),
            Line2D([], [], color=TWIN_COLOUR, ls="--", label="noise floor"),
        ]
        figure.legend(handles=handles, loc="outside upper center", ncols=3)
        caption = (
            "Mean square of measured minus model over that of the noise, held out, one point per "
            "forcing cycle (per second outside steps). A trend along the test indicates a drift; "
            "a variation with the steps does not."
        )
        title = f"Residual over time{view.title_suffix(number)}"
        yield CaptionedFigure(f"time_{number}", title, caption, figure)


def _block_means(
    residuals: LogResiduals, held_out: Float1D, rows: list[int]
) -> tuple[Float1D, Float1D]:
    """Return (mean time in s, mean square over the noise) of every block with entries in `rows`."""
    in_rows = np.isin(residuals.entry_row, rows)
    blocks = np.unique(residuals.entry_block[in_rows], return_inverse=True)[1]
    count = np.bincount(blocks)
    t = (
        np.bincount(blocks, weights=residuals.signals.time_s[residuals.entry_sample[in_rows]])
        / count
    )
    squares = (residuals.entry_weight * held_out)[in_rows] ** 2
    return t, np.bincount(blocks, weights=squares) / count


def _draw_prediction(decide: DecisiveTest | None) -> CaptionedFigures:
    """Draw the peaks that each rival predicts for the proposed test."""
    rivals = [rival for rival in decide.rivals if rival.peaks] if decide else []
    if decide is None or not rivals:
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 3.2))
    ax = figure.subplots()
    for (colour, style), rival in zip(RIVAL_STYLES, rivals, strict=False):
        peaks = [1e3 * peak.peak_disp_m for peak in rival.peaks]
        ax.plot(np.arange(len(peaks)), peaks, style, color=colour, label=rival.id, ms=4)
    ticks = [
        f"{peak.frequency_hz:g} Hz" if peak.frequency_hz else peak.direction
        for peak in rivals[0].peaks
    ]
    ax.set_xticks(np.arange(len(ticks)), ticks, rotation=60)
    ax.set_xlabel("steps or windows, in the order in which they are played")
    ax.set_ylabel("largest |u|, mm")
    ax.set_ylim(bottom=0)
    ax.legend()
    caption = (
        "Displacement of the mass against the table if each explanation is true, with the "
        "parameters of its fit. The separation is not this difference, which other parameters may "
        "absorb, but what remains of it in the forces after each is fitted again."
    )
    yield CaptionedFigure("decide", f"Expected in: {decide.title}", caption, figure)
