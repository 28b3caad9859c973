"""Figures of a run, arranged and colored as in Stefani, De Angelis, Andreaus, Figs. 2 to 12."""

from collections.abc import Sequence
from functools import partial

import numpy as np

from table_io.units import GRAVITY_M_S2
from twin.drawing.branch_curves import (
    FREE_QUANTITIES,
    BranchSet,
    list_branch_keys,
    plot_branches,
)
from twin.drawing.motion_drawing import draw_rest_lines
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, FigurePanel, Key, PanelFigure
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    FIGURE_WIDTH_IN,
    GUIDE_COLOUR,
    HYSTERESIS_COLOURS,
    PRECOMPRESSION_COLOUR,
    TWIN_COLOUR,
    LineStyle,
    measured_style,
    twin_style,
)
from twin.drawing.prc_drawing import (
    FREE_PANELS,
    PRC_PANELS,
    break_at_jumps,
    draw_jumps,
    format_mirrored_axis,
    make_prc_panels,
    plot_prc,
    shade_hysteresis,
    shade_precompression,
)
from twin.drawing.run_figures import (
    draw_best_linear,
    draw_histories,
    draw_legend,
    draw_loop_figures,
    draw_orbits,
    draw_swept_sine,
    draw_window_histories,
)
from twin.drawing.table_motion_figures import draw_table_motion
from twin.dynamics.main_branches import follow_sweep_branches
from twin.results.report_data import (
    DIRECTIONS,
    IMPACT_KEYS,
    ReportData,
    compute_envelopes,
    compute_prestress,
    compute_step_errors,
    extract_prc,
    read_initial_model,
)

MARKER_SIZES = {"forward": 4.6, "backward": 2.6}  # both show where they coincide


def draw_figures(run: ReportData) -> CaptionedFigures:
    """Yield all figures for which the run has data, in report order."""
    for draw in (
        draw_swept_sine,
        draw_best_linear,
        draw_orbits,
        _draw_prc,
        _draw_model_branches,
        _draw_impacts,
        draw_histories,
        draw_window_histories,
        draw_loop_figures,
        _draw_errors,
        _draw_overview,
        _draw_level,
        draw_table_motion,
    ):
        yield from draw(run)


def _draw_prc(run: ReportData) -> CaptionedFigures:
    """Draw the pseudo-resonance curves (Figs. 2 and 11)."""
    measured, twin = (partial(extract_prc, run.steps, source) for source in ("measured", "twin"))
    curves = measured if run.source == "measured" else twin
    if not any(np.isfinite(curves(direction, "eta_d")[1]).any() for direction in DIRECTIONS):
        return
    contents = PRC_PANELS if run.has_bumpers else FREE_PANELS
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.6 * len(contents) / 2 + 0.3), len(contents) // 2, 2)
    panels = make_prc_panels(figure.panels, contents)
    intervals = run.summary.hysteresis
    prestress = compute_prestress(run)
    shade_hysteresis(panels, intervals)
    shade_precompression(panels, prestress)
    jumps, twin_jumps = run.summary.jumps, run.summary.twin_jumps
    measured_jumps = jumps if run.source == "measured" else []
    plot_prc(panels, break_at_jumps(measured, measured_jumps), _dotted_style)
    plot_prc(panels, break_at_jumps(twin, twin_jumps), twin_style)
    draw_jumps(panels, curves, jumps, label_in="eta_d")
    kinds = sorted({interval.kind for interval in intervals})
    patches = {f"{kind} hysteresis": HYSTERESIS_COLOURS[kind] for kind in kinds}
    if prestress:
        patches["precompression"] = PRECOMPRESSION_COLOUR
    keys = [Key(label, {"color": colour}, is_patch=True) for label, colour in patches.items()]
    draw_legend(run, figure, *keys, marker="o")
    caption = (
        "One point per frequency step, averaged over its measured cycles; measured wide and pale, "
        "twin thin. Curves are broken where they jump; arrows: jumps between two grid frequencies. "
        "Displacement and deformation are divided by the free-flight maximum "
        "u*, acceleration by a*, forces by the weight."
    )
    if prestress:
        caption += " Grey: deformation and force of a precompressed bumper at rest, from the model."
    yield CaptionedFigure("prc", "Pseudo-resonance curves", caption, figure)


def _draw_model_branches(run: ReportData) -> CaptionedFigures:
    """Draw the points over the model's branches, stable and unstable, between the jumps."""
    branches, stars = _follow_model_branches(run), run.summary.stars
    if branches is None or stars is None:
        return
    scales = dict(zip(("eta_d", "eta_a"), stars, strict=True))
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.9), 1, 2)
    styles = {direction: {**_dotted_style(direction), "ls": ""} for direction in DIRECTIONS}
    panels = make_prc_panels(figure.panels, FREE_PANELS)
    for (ax, quantities), (label, _), quantity in zip(
        panels, FREE_PANELS, FREE_QUANTITIES, strict=True
    ):
        (name,) = quantities
        plot_branches(ax, branches, quantity, scale=quantity.si / scales[name])
        ax.set_ylabel(label)
        for direction, style in styles.items():
            f, y = extract_prc(run.steps, run.source, direction, name)
            ax.plot(f, y, zorder=1.5, **style)
    keys = [Key(f"{run.source} {direction}", style) for direction, style in styles.items()]
    figure.legend([*keys, *list_branch_keys(branches)], columns=7)
    yield CaptionedFigure(
        "model_branches",
        "Branches of the model",
        "Periodic motions of the model at the nominal level: solid stable, dashed unstable. The "
        "sweep can follow a stable motion up to a fold, where it must jump. An unstable motion "
        "separates the starts that lead to the one and to the other stable motion.",
        figure,
    )


def _follow_model_branches(run: ReportData) -> BranchSet | None:
    """Follow the main branches of the model over the steps of a run; None without any."""
    model, steps = read_initial_model(run), run.recording.start.steps
    if model is None or run.summary.stars is None:
        return None
    branches = follow_sweep_branches(
        model,
        (step.frequency_hz for step in steps),
        (step.acceleration_m_s2 for step in steps),
    )
    return BranchSet(branches) if branches else None


def _dotted_style(direction: str) -> LineStyle:
    return {**measured_style(direction), "marker": "o", "ms": MARKER_SIZES[direction]}


def _draw_impacts(run: ReportData) -> CaptionedFigures:
    """Draw the impacts per forcing cycle of both sides, one row per direction."""
    directions = [
        direction
        for direction in DIRECTIONS
        if extract_prc(run.steps, run.source, direction, IMPACT_KEYS[0])[0].size
    ]
    counts = [
        extract_prc(run.steps, run.source, direction, side)[1]
        for direction in directions
        for side in IMPACT_KEYS
    ]
    if not run.has_bumpers or not any(np.isfinite(count).any() for count in counts):
        return
    size_in = FIGURE_WIDTH_IN, 2.3 * len(directions) + 0.4
    figure = PanelFigure(size_in, len(directions), sharey="all")
    twin_dots = {"marker": "o", "ms": 6.5, "mfc": "none", "mec": TWIN_COLOUR, "mew": 0.8, "ls": ""}
    measured_dots = {
        direction: {"color": DIRECTION_COLOURS[direction], "marker": "o", "ls": ""}
        for direction in directions
    }
    rows = figure.panels[:, 0]
    for ax, direction in zip(rows, directions, strict=True):
        for side, sign in zip(IMPACT_KEYS, (1, -1), strict=True):
            f, y = extract_prc(run.steps, "measured", direction, side)
            ax.vlines(f, 0, sign * y, color=DIRECTION_COLOURS[direction], lw=3, alpha=0.35)
            ax.plot(f, sign * y, **measured_dots[direction])
            f, y = extract_prc(run.steps, "twin", direction, side)
            ax.plot(f, sign * y, **twin_dots)
        ax.set_ylabel("impacts per cycle")
        ax.set_title(direction)
        format_mirrored_axis(ax)
    rows[-1].set_xlabel("frequency in Hz")
    keys = [Key("twin", twin_dots)]
    if run.source == "measured":
        keys += [Key(f"measured {name}", style) for name, style in measured_dots.items()]
    figure.legend(keys, columns=3)
    caption = (
        "Mean over the measured cycles of a step; a fractional value means that the count varies "
        "from cycle to cycle."
    )
    yield CaptionedFigure("impacts", "Impacts per forcing cycle", caption, figure)


def _draw_errors(run: ReportData) -> CaptionedFigures:
    """Draw the NRMSE of the free-running and the restarted twin over frequency."""
    errors = {
        part: step_nrmse
        for part, step_nrmse in compute_step_errors(run).items()
        if np.isfinite(list(step_nrmse.values())).any()
    }
    if not errors or run.windows:
        return
    rows = (len(errors) + 1) // 2
    figure = PanelFigure((FIGURE_WIDTH_IN, 2.5 * rows + 0.4), rows, 2, sharey="all")
    styles = {
        (kind, direction): {
            "color": DIRECTION_COLOURS[direction], "ls": dash, "marker": "o", "lw": 0.9,
            "mfc": DIRECTION_COLOURS[direction] if dash == "-" else "white",
        }
        for direction in DIRECTIONS
        for kind, dash in (("free-running", "-"), ("restarted", ":"))
    }  # fmt: skip
    axes = figure.panels
    for ax, (part, step_nrmse) in zip(axes.flat, errors.items(), strict=False):
        ax.set_yscale("log")
        for direction in DIRECTIONS:
            steps = [
                step
                for step in run.steps
                if step.direction == direction and step.index in step_nrmse
            ]
            f = [step.frequency_hz for step in steps]
            nrmse = np.array([step_nrmse[step.index] for step in steps]).reshape(-1, 2)
            for column, kind in enumerate(("free-running", "restarted")):
                ax.plot(f, nrmse[:, column], **styles[kind, direction])
        ax.set_title(f"${part}$")
    for ax in axes[:, 0]:
        ax.set_ylabel("NRMSE")
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    keys = [Key(f"{kind}, {direction}", style) for (kind, direction), style in styles.items()]
    figure.legend(keys, columns=4)
    caption = (
        "NRMSE: RMS error divided by RMS measurement over the measured cycles of each step; a "
        "constant zero would give 1. The restarted twin starts every window from the measured "
        "state. Contact forces only with contact."
    )
    yield CaptionedFigure("comparison", "Error of the twin", caption, figure)


def _draw_overview(run: ReportData) -> CaptionedFigures:
    """Draw envelopes of table and mass motion over the whole run, with the steps shaded."""
    rows, spans = compute_envelopes(run), run.list_step_spans()
    if not rows:
        return
    figure = PanelFigure((FIGURE_WIDTH_IN, 1.7 * len(rows) + 0.4), len(rows))
    axes = figure.panels[:, 0]
    peaks = {step.acceleration_m_s2 for step in run.recording.start.steps}
    for ax, (label, envelopes) in zip(axes, rows.items(), strict=True):
        for time, low, high in envelopes:
            ax.fill_between(time, low, high, color="#8b929c", lw=0)
        ax.set_ylabel(label)
        _shade_steps(run, ax, spans, ax is axes[0])
        if label.startswith("$u$") and run.gaps_m is not None:
            draw_rest_lines(run.gaps_m, ax.axhline)
        for peak in peaks if label == "table in m/s²" else ():
            ax.axhline(peak, color="#111111", ls="--", lw=0.9)
            ax.axhline(-peak, color="#111111", ls="--", lw=0.9)
    axes[-1].set_xlabel("time in s")
    axes[-1].set_xlim(spans[0][1], spans[-1][2])
    caption = (
        "Envelopes. Shading: steps, red forward, blue backward, with their frequencies in Hz on "
        "top. Dashed: demanded peak acceleration and positions of the bumpers at rest."
    )
    yield CaptionedFigure("overview", "Drive and response over the run", caption, figure)


def _shade_steps(
    run: ReportData,
    ax: FigurePanel,
    spans: Sequence[tuple[int, float, float]],
    show_labels: bool,
) -> None:
    steps_by_index = {step.index: step for step in (*run.steps, *run.summary.visits)}
    duration_s = spans[-1][2] - spans[0][1]
    next_label_s = 0.0
    for number, start, stop in spans:
        step = steps_by_index.get(number)
        if step is None:
            continue
        shade = 0.20 if step.index % 2 else 0.09
        ax.axvspan(
            start, stop, color=DIRECTION_COLOURS[step.direction], alpha=shade, lw=0, zorder=0
        )
        if show_labels and start >= next_label_s:
            middle = (start + stop) / 2
            ax.annotate(
                f"{step.frequency_hz:g}", (middle, 1.02), xycoords=("data", "axes fraction"),
                ha="center", size=8, color=GUIDE_COLOUR,
            )  # fmt: skip
            next_label_s = start + duration_s / 22


def _draw_level(run: ReportData) -> CaptionedFigures:
    """Draw the level error of the measured cycles, the error without control, and the correction.

    The uncorrected level is the measured level divided by the correction.
    """
    levels = [(step, step.level) for step in run.steps if step.level and step.level.accepted]
    if not levels:
        return
    figure = PanelFigure((9.5, 4.6), 2, heights=(2, 1))
    upper, lower = figure.panels[:, 0]
    keys: list[Key] = []
    for direction in DIRECTIONS:
        own = sorted(
            (step.frequency_hz, level.error, level.error_uncorrected, level.correction)
            for step, level in levels
            if step.direction == direction
        )
        if not own:
            continue
        f, errors, uncorrected, corrections = np.array(own).T
        colour = DIRECTION_COLOURS[direction]
        dotted = {"marker": "o", "ms": 3, "color": colour}
        dashed = {"ls": ":", "lw": 1.2, "color": colour}
        upper.plot(f, 100 * errors, **dotted)
        upper.plot(f, 100 * uncorrected, **dashed)
        lower.plot(f, corrections, **dotted)
        keys += [Key(direction, dotted), Key(f"{direction}, uncorrected", dashed)]
    for tolerance_percent in (-2, 2):
        upper.axhline(tolerance_percent, color="#777777", lw=0.8, ls="--")
    upper.set_ylabel("level error in %")
    figure.legend(keys, columns=4)
    lower.set_ylabel("correction")
    lower.set_xlabel("frequency in Hz")
    yield CaptionedFigure(
        "level",
        "Level of the table",
        f"Error of the fundamental of the measured table acceleration relative to the demanded "
        f"{levels[0][1].demanded_m_s2 / GRAVITY_M_S2:.3g} g over the measured cycles of "
        "each step (dashed: ±2 %), the same without correction of the command (dotted), and the "
        "correction factor.",
        figure,
    )
