"""Figures of selected steps: time histories, phase portraits, force loops; and the line styles.

Measured: red forward, blue backward. Twin: black, solid forward, dashed backward. Steps come from
`report_data.select_frequencies`: at most four frequencies, both directions each.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from twin.reports.report_data import (
    DIRECTIONS,
    ReportData,
    StepMotion,
    pair_motions,
    select_frequencies,
)

DIRECTION_COLOURS = {"forward": "#c4161c", "backward": "#1559b0"}
DIRECTION_DASHES: dict[str, Any] = {"forward": "-", "backward": (0, (4, 1.8))}
TWIN_COLOUR, GUIDE_COLOUR = "#111111", "#555555"
REST_LINE_STYLE: dict[str, Any] = {"color": GUIDE_COLOUR, "ls": (0, (5, 3)), "lw": 0.8}
FIGURE_WIDTH_IN, HISTORY_CYCLES = 10.0, 3
CaptionedFigures = Iterator[tuple[str, str, str, Figure]]


def draw_legend(
    run: ReportData, figure: Figure, *handles: Line2D | Patch, marker: str = ""
) -> None:
    """Draw the legend of measured and twin lines above the panels."""
    lines: list[Line2D | Patch] = []
    directions = [
        direction
        for direction in DIRECTIONS
        if any(step["direction"] == direction for step in run.steps)
    ]
    if run.source == "measured":
        lines += [
            Line2D(
                [],
                [],
                color=DIRECTION_COLOURS[direction],
                marker=marker,
                label=f"measured {direction}",
            )
            for direction in directions
        ]
    lines += [
        Line2D([], [], color=TWIN_COLOUR, ls=DIRECTION_DASHES[direction], label=f"twin {direction}")
        for direction in directions
    ]
    figure.legend(handles=[*lines, *handles], loc="outside upper center", ncols=6)


def draw_gap_lines(run: ReportData, draw: Callable[..., Any]) -> None:
    """Draw dashed lines at the positions of the bumpers at rest."""
    if run.gaps_m is not None:
        for position_mm in {run.gaps_m[0] * 1e3, -run.gaps_m[1] * 1e3}:
            draw(position_mm, **REST_LINE_STYLE)


def draw_histories(run: ReportData) -> CaptionedFigures:
    """Draw u, a and contact forces over the last cycles, one figure per frequency (Figs. 7, 12)."""
    for hz, reason in select_frequencies(run).items():
        motions = pair_motions(run, hz)
        rows = 3 if run.has_bumpers else 2
        if not motions:
            continue
        figure = Figure(figsize=(FIGURE_WIDTH_IN, 1.75 * rows + 0.5))
        axes = figure.subplots(rows, len(motions), sharex=True, sharey="row", squeeze=False)
        for column, (direction, measured, twin) in zip(axes.T, motions, strict=True):
            column[0].set_title(f"{direction}, {hz:g} Hz")
            column[-1].set_xlabel("time in s")
            for motion, style in (
                (measured, _measured_style(direction)),
                (twin, _twin_style(direction)),
            ):
                if motion is not None:
                    _plot_history(run, column, motion.select_last(HISTORY_CYCLES), style)
            contact_motion = twin if run.source == "twin" or measured is None else measured
            if contact_motion is not None:
                _shade_contact(
                    run,
                    column,
                    contact_motion.select_last(HISTORY_CYCLES),
                    DIRECTION_COLOURS[direction],
                )
            draw_gap_lines(run, column[0].axhline)
        labels = ("$u$ in mm", "$a$ in m/s²", "$F_R$, $F_L$ in kN")
        for ax, label in zip(axes[:, 0], labels, strict=False):
            ax.set_ylabel(label)
        draw_legend(run, figure, *_gap_line_handles(run))
        caption = (
            "Last measured cycles. Shaded: contact, dark for the right bumper, light for the left. "
            "The twin is free-running on the measured table acceleration; a chaotic motion cannot "
            "be reproduced sample by sample."
        )
        yield f"histories_{hz:g}hz", f"Histories at {hz:g} Hz: {reason}", caption, figure


def _measured_style(direction: str) -> dict[str, Any]:
    """Return a wide line style, visible under a coincident twin line."""
    return {"color": DIRECTION_COLOURS[direction], "lw": 2.2}


def _twin_style(direction: str) -> dict[str, Any]:
    return {"color": TWIN_COLOUR, "ls": DIRECTION_DASHES[direction], "lw": 0.8}


def _gap_line_handles(run: ReportData) -> list[Line2D | Patch]:
    if run.gaps_m is None:
        return []
    name = "bumper at rest" if min(run.gaps_m) >= 0 else "precompression"
    return [Line2D([], [], **REST_LINE_STYLE, label=name)]


def _plot_history(run: ReportData, column: Any, motion: StepMotion, style: dict[str, Any]) -> None:
    column[0].plot(motion.time, motion.u * 1e3, **style)
    column[1].plot(motion.time, motion.a, **style)
    for force in (motion.force_r, motion.force_l) if run.has_bumpers else ():
        column[2].plot(motion.time, force / 1e3, **style)


def _shade_contact(run: ReportData, column: Any, motion: StepMotion, colour: str) -> None:
    """Shade the contact phases in every row."""
    for force, alpha in ((motion.force_r, 0.22), (-motion.force_l, 0.10)):
        for ax in column:
            ax.fill_between(
                motion.time, 0, 1, where=force > run.contact_n, transform=ax.get_xaxis_transform(),
                color=colour, alpha=alpha, lw=0,
            )  # fmt: skip


def draw_loop_figures(run: ReportData) -> CaptionedFigures:
    """Draw phase portraits, inertia force loops and bumper loops (Figs. 3, 6, 9 and 11)."""
    mass = run.specimen.mass_kg if run.specimen else None
    columns = {hz: motions for hz in select_frequencies(run) if (motions := pair_motions(run, hz))}

    def plot_portrait(ax: Axes, motion: StepMotion, style: dict[str, Any]) -> None:
        ax.plot(motion.u * 1e3, motion.v * 1e3, **style)

    def plot_inertia(ax: Axes, motion: StepMotion, style: dict[str, Any]) -> None:
        ax.plot(motion.u * 1e3, -(mass or np.nan) * motion.a / 1e3, **style)

    def plot_bumper(ax: Axes, motion: StepMotion, style: dict[str, Any]) -> None:
        for force in (motion.force_r, motion.force_l):
            touching = np.abs(force) > run.contact_n
            ax.plot(motion.u * 1e3, np.where(touching, force, np.nan) / 1e3, **style)

    yield from _draw_grid(
        run, columns, plot_portrait, ("portraits", "Phase portraits", "$u$ in mm", "$u'$ in mm/s"),
        "Relative velocity u' over relative displacement u, all measured cycles. The measured u' "
        "is a Savitzky-Golay derivative of u over 20 ms, used only in this figure.",
    )  # fmt: skip
    if mass is not None:
        yield from _draw_grid(
            run, columns, plot_inertia,
            ("loops", "Inertia force loops", "$u$ in mm", "$F_I$ in kN"),
            "Inertia force F_I = −M a against relative displacement.",
        )  # fmt: skip
    if run.has_bumpers:
        yield from _draw_grid(
            run, columns, plot_bumper, ("bumpers", "Bumper loops", "$v_j$ in mm", "$F_j$ in kN"),
            "Contact force over bumper position, right positive, left negative. In contact the "
            "bumper moves with the mass, v_j = u; flight is not shown.",
        )  # fmt: skip


def _draw_grid(
    run: ReportData,
    columns: dict[float, list[tuple[str, StepMotion | None, StepMotion | None]]],
    plot: Callable[[Axes, StepMotion, dict[str, Any]], None],
    names: tuple[str, str, str, str],
    caption: str,
) -> CaptionedFigures:
    """Draw one figure with a column per frequency and a row per direction."""
    directions = [
        direction
        for direction in DIRECTIONS
        if any(direction == entry[0] for entries in columns.values() for entry in entries)
    ]
    if not directions:
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 2.5 * len(directions) + 0.6))
    axes = figure.subplots(len(directions), max(len(columns), 3), sharex="col", squeeze=False)
    for ax in axes[:, len(columns) :].flat:
        ax.remove()
    for column, (hz, motions) in zip(axes.T, columns.items(), strict=False):
        for direction, measured, twin in motions:
            ax = column[directions.index(direction)]
            ax.axhline(0, color=GUIDE_COLOUR, lw=0.5)
            ax.set_title(f"{hz:g} Hz {direction}")
            for motion, style in (
                (measured, _measured_style(direction)),
                (twin, _twin_style(direction)),
            ):
                if motion is not None:
                    plot(ax, motion, style)
            if not any(np.isfinite(line.get_ydata()).any() for line in ax.lines[1:]):
                ax.text(
                    0.5, 0.6, "no contact", transform=ax.transAxes, ha="center", color=GUIDE_COLOUR
                )
                ax.set_yticks([0])
            draw_gap_lines(run, ax.axvline)
        column[-1].set_xlabel(names[2])
    for ax in axes[:, 0]:
        ax.set_ylabel(names[3])
    draw_legend(run, figure, *_gap_line_handles(run))
    yield names[0], names[1], caption, figure
