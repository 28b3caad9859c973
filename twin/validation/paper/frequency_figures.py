"""G4 over frequency (Fig. 11) and its time histories (Fig. 12): model, or model and rig."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twin.reports.measured_campaign import MeasuredCampaign
from twin.reports.paper_cases import PaperCase, extract_prc
from twin.reports.players import SystemMotion
from twin.reports.plot_style import (
    DIRECTION_COLOURS,
    DIRECTIONS,
    GUIDE_COLOUR,
    REST_LINE_STYLE,
    TWIN_COLOUR,
    PaperFigure,
    PaperFigures,
    direction_handles,
    draw_obstacles,
    experiment_style,
    label_panel,
    model_style,
    plot_inertia_loop,
    plot_phase_portrait,
    shade_contact,
)
from twin.validation.paper.study import DETAIL_HZ, PaperStudy

CASE_NAME, MEASURED_CYCLES = "G4", 3
HISTORIES_HZ = (0.53, 1.4, 3.4)
PANEL_LETTERS = "cdefghijklmnopqrstuv"


def draw_frequency_figures(study: PaperStudy, campaign: MeasuredCampaign | None) -> PaperFigures:
    """Draw Figs. 11 and 12; with a campaign, its measurements as well."""
    if campaign is not None and CASE_NAME not in campaign.runs:
        return
    yield _draw_frequency_figure(study.cases[CASE_NAME], campaign)
    yield _draw_histories(study.cases[CASE_NAME], campaign)


def _make_legend_handles(campaign: MeasuredCampaign | None) -> list[Line2D]:
    handles = direction_handles(model_style, "model, ")
    if campaign is not None:
        handles = direction_handles(experiment_style, "rig, ") + handles
    return handles


def _draw_frequency_figure(case: PaperCase, campaign: MeasuredCampaign | None) -> PaperFigure:
    figure = Figure(figsize=(15, 14))
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 3))[:, 0]
    for ax, letter, name in zip(top.subplots(1, 2), "ab", ("eta_a", "eta_d"), strict=True):
        _draw_prc(ax, case, campaign, name)
        label_panel(ax, letter)
    axes = bottom.subplots(4, len(DETAIL_HZ))
    for column, hz in zip(axes.T, DETAIL_HZ, strict=True):
        for direction in DIRECTIONS:
            motion, recorded = case.simulate_motion(hz, direction, MEASURED_CYCLES), None
            if campaign is not None:
                recorded = campaign.extract_motion(CASE_NAME, hz, direction, MEASURED_CYCLES)
                if recorded is not None:
                    _plot_motion(column, 0, recorded[0], case, experiment_style(direction))
                _plot_motion(column, 1, motion, case, model_style(direction))
            else:
                _plot_motion(
                    column, DIRECTIONS.index(direction), motion, case, model_style(direction)
                )
    row_titles = ("rig", "model") if campaign is not None else DIRECTIONS
    for index, ax in enumerate(axes.flat):
        row, column_index = divmod(index, len(DETAIL_HZ))
        if not ax.lines:
            ax.text(
                0.5, 0.7, "not measured", transform=ax.transAxes, ha="center", color=GUIDE_COLOUR
            )
        label_panel(
            ax, PANEL_LETTERS[index], f"{DETAIL_HZ[column_index]:g} Hz, {row_titles[row % 2]}"
        )
        draw_obstacles(case.parameters, ax.axvline)
        ax.axhline(0, color=GUIDE_COLOUR, lw=0.5, zorder=0.6)
        ax.set_xlabel("$u$ in mm" if row == 3 else "")
        if column_index == 0:
            ax.set_ylabel("$u'$ in mm/s" if row < 2 else "$F_I$ in kN")
    _equalize_scales(axes)
    figure.legend(handles=_make_legend_handles(campaign), loc="outside upper center", ncols=4)
    return PaperFigure(
        "fig11_g4" if campaign is None else "rig_fig11_g4", "11", "G4 over frequency",
        "PRCs of a η_a and b η_d; vertical dashed lines mark 0.53, 0.71, 1.1, 1.4 and 3.4 Hz, the "
        "columns below: c–l phase portraits, m–v inertia force against u, over the last three "
        "cycles of the step. "
        + ("Red and blue: rig, forward and backward; black: model. " if campaign else
           "Solid: forward; dashed: backward, in the row below. ")
        + "Vertical dashed lines: the gap. Where the motion is chaotic, compare its type and its "
        "range, not single cycles.",
        figure,
    )  # fmt: skip


def _equalize_scales(axes: Any) -> None:
    """Give both rows of the same quantity the same axis limits."""
    for upper, lower in ((0, 1), (2, 3)):
        for upper_ax, lower_ax in zip(axes[upper], axes[lower], strict=True):
            for getter, setter in (("get_xlim", "set_xlim"), ("get_ylim", "set_ylim")):
                (a, b), (c, d) = getattr(upper_ax, getter)(), getattr(lower_ax, getter)()
                if upper_ax.lines and lower_ax.lines:
                    getattr(upper_ax, setter)(min(a, c), max(b, d))
                    getattr(lower_ax, setter)(min(a, c), max(b, d))


def _plot_motion(
    column: Any, row: int, motion: SystemMotion, case: PaperCase, style: dict[str, Any]
) -> None:
    plot_phase_portrait(column[row], motion, **style)
    plot_inertia_loop(column[2 + row], motion, case.parameters.mass, False, **style)


def _draw_prc(ax: Axes, case: PaperCase, campaign: MeasuredCampaign | None, name: str) -> None:
    for direction in DIRECTIONS:
        if campaign is not None:
            frequencies, values = extract_prc(
                campaign.points[CASE_NAME], "measured", direction, name
            )
            ax.plot(
                frequencies,
                values,
                "o",
                color=DIRECTION_COLOURS[direction],
                ms=4.6 if direction == "forward" else 2.8,
                mew=0,
            )
        frequencies, values = extract_prc(case.points, "twin", direction, name)
        ax.plot(frequencies, values, **model_style(direction, 1.3))
    for hz in DETAIL_HZ:
        ax.axvline(hz, **REST_LINE_STYLE)
        ax.annotate(
            f"{hz:g} Hz", (hz, 1.0), (2, -2), xycoords=("data", "axes fraction"), size=7.5,
            textcoords="offset points", ha="left", va="top", rotation=90, color=GUIDE_COLOUR,
        )  # fmt: skip
    ax.set_xlim(0.4, 5.05)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("$f$ in Hz")
    ax.set_ylabel(rf"$\eta_{name[-1]}$")


def _draw_histories(case: PaperCase, campaign: MeasuredCampaign | None) -> PaperFigure:
    figure = Figure(figsize=(15, 8.6))
    axes = figure.subplots(3, len(HISTORIES_HZ), sharex="col", sharey="row")
    for index, (column, hz) in enumerate(zip(axes.T, HISTORIES_HZ, strict=True)):
        for direction in DIRECTIONS:
            recorded = (
                campaign.extract_motion(CASE_NAME, hz, direction, MEASURED_CYCLES)
                if campaign is not None
                else None
            )
            if recorded is not None:
                _plot_history(column, recorded[0], experiment_style(direction, 2.0))
            motion = case.simulate_motion(hz, direction, MEASURED_CYCLES)
            _plot_history(column, motion, model_style(direction, 1.0))
            for ax in column if direction == "forward" else ():
                shade_contact(ax, motion, TWIN_COLOUR, alpha=0.07)
        label_panel(column[0], "abc"[index], f"$f$ = {hz:g} Hz")
        draw_obstacles(case.parameters, column[0].axhline)
        column[-1].set_xlabel("$t$ in s")
        column[-1].set_xlim(0, (MEASURED_CYCLES - (campaign is not None)) / hz)
    for ax, label in zip(axes[:, 0], ("$u$ in mm", "$a$ in m/s²", "$F_j$ in kN"), strict=True):
        ax.set_ylabel(label)
    figure.legend(handles=_make_legend_handles(campaign), loc="outside upper center", ncols=4)
    return PaperFigure(
        "fig12_histories" if campaign is None else "rig_fig12_histories", "12", "Histories of G4",
        "Relative displacement, total acceleration and contact forces over the last three cycles "
        "of the step at a 0.53 Hz, b 1.4 Hz, c 3.4 Hz, from a zero upcrossing of the table's "
        "acceleration. Black: model"
        + ("; red and blue: rig" if campaign else "")
        + ". Grey bands: contacts of the model, forward. Dashed in the first row: the gap. "
        "In chaos no two records agree cycle by cycle, and at 1.4 Hz the initial conditions decide "
        "which side is hit twice.",
        figure,
    )  # fmt: skip


def _plot_history(column: Any, motion: SystemMotion, style: dict[str, Any]) -> None:
    column[0].plot(motion.time, motion.u * 1e3, **style)
    column[1].plot(motion.time, motion.a, **style)
    for force in (motion.force_r, motion.force_l):
        column[2].plot(motion.time, force / 1e3, **style)
