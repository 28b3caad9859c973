"""G4 over frequency (Figs. 11 and 12), its chaos and its impacts: model, or model and rig."""

from functools import partial
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twin.drawing.motion_drawing import (
    draw_rest_lines,
    plot_history,
    plot_inertia_loop,
    plot_phase_portrait,
    shade_contact,
)
from twin.drawing.panels import CaptionedFigure, CaptionedFigures
from twin.drawing.pictures import direction_handles, label_panel
from twin.drawing.plot_style import (
    GUIDE_COLOUR,
    HYSTERESIS_COLOURS,
    REST_LINE_STYLE,
    TWIN_COLOUR,
    LineStyle,
    experiment_style,
    measured_style,
    twin_style,
)
from twin.drawing.prc_drawing import ETA_A, ETA_D, PrcPanel, make_prc_panels, plot_prc
from twin.paper.low_frequency import simulate_secondary_motion
from twin.paper.study import CHAOS_SCAN_HZ, DETAIL_HZ, SECONDARY_HZ, PaperStudy
from twin.results.measured_campaign import MeasuredCampaign
from twin.results.paper_cases import PaperCase
from twin.results.players import SystemMotion
from twin.results.report_data import DIRECTIONS, extract_prc

CASE_NAME, MEASURED_CYCLES = "G4", 3
HISTORIES_HZ = (0.53, 1.4, 3.4)
PANEL_LETTERS = "cdefghijklmnopqrstuv"
MAX_BARS = 6  # impact combinations shown in a panel


def draw_frequency_figures(
    study: PaperStudy, campaign: MeasuredCampaign | None
) -> CaptionedFigures:
    """Draw Figs. 11 and 12; with a campaign, its measurements as well.

    Of the model alone, Fig. 11 also at its own secondary resonances.
    """
    if campaign is not None and CASE_NAME not in campaign.runs:
        return
    yield _draw_frequency_figure(study, campaign)
    if campaign is None and any(study.find_own_hz(hz) for hz in SECONDARY_HZ):
        yield _draw_frequency_figure(study, None, own=True)
    yield _draw_histories(study.cases[CASE_NAME], campaign)


def _make_legend_handles(campaign: MeasuredCampaign | None) -> list[Line2D]:
    handles = direction_handles(partial(twin_style, width=1.1), "model, ")
    if campaign is not None:
        handles = direction_handles(experiment_style, "rig, ") + handles
    return handles


def _draw_frequency_figure(
    study: PaperStudy, campaign: MeasuredCampaign | None, own: bool = False
) -> CaptionedFigure:
    """Draw Fig. 11 at the paper's frequencies, or with the model's own secondary resonances."""
    case, scan = study.cases[CASE_NAME], study.secondary[CASE_NAME]
    detail_hz = [
        (study.find_own_hz(hz) if own and hz in SECONDARY_HZ else None) or hz for hz in DETAIL_HZ
    ]

    def simulate(hz: float, direction: str) -> SystemMotion:
        if hz in DETAIL_HZ:
            return case.simulate_motion(hz, direction, MEASURED_CYCLES)
        return simulate_secondary_motion(case, scan, hz, direction, MEASURED_CYCLES)

    figure = Figure(figsize=(15, 14))
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 3))[:, 0]
    panels = make_prc_panels(top.subplots(1, 2, squeeze=False), (ETA_A, ETA_D))
    _draw_prc(panels, case, campaign, detail_hz)
    for (ax, _), letter in zip(panels, "ab", strict=True):
        label_panel(ax, letter)
    axes = bottom.subplots(4, len(detail_hz))
    for column, hz in zip(axes.T, detail_hz, strict=True):
        for direction in DIRECTIONS:
            motion, recorded = simulate(hz, direction), None
            if campaign is not None:
                recorded = campaign.extract_motion(CASE_NAME, hz, direction, MEASURED_CYCLES)
                if recorded is not None:
                    _plot_motion(column, 0, recorded, case, experiment_style(direction))
                _plot_motion(column, 1, motion, case, twin_style(direction, 1.1))
            else:
                _plot_motion(
                    column, DIRECTIONS.index(direction), motion, case, twin_style(direction, 1.1)
                )
    row_titles = ("rig", "model") if campaign is not None else DIRECTIONS
    for index, ax in enumerate(axes.flat):
        row, column_index = divmod(index, len(detail_hz))
        if not ax.lines:
            ax.text(
                0.5, 0.7, "not measured", transform=ax.transAxes, ha="center", color=GUIDE_COLOUR
            )
        label_panel(
            ax, PANEL_LETTERS[index], f"{detail_hz[column_index]:g} Hz, {row_titles[row % 2]}"
        )
        draw_rest_lines(case.gaps_m, ax.axvline)
        ax.axhline(0, color=GUIDE_COLOUR, lw=0.5, zorder=0.6)
        ax.set_xlabel("$u$ in mm" if row == 3 else "")
        if column_index == 0:
            ax.set_ylabel("$u'$ in mm/s" if row < 2 else "$F_I$ in kN")
    _equalize_scales(axes)
    figure.legend(handles=_make_legend_handles(campaign), loc="outside upper center", ncols=4)
    return CaptionedFigure(
        "fig11_own" if own else "fig11_g4" if campaign is None else "rig_fig11_g4",
        "G4 over frequency" + (", at the model's own secondary resonances" if own else ""),
        f"PRCs of a η_a and b η_d; vertical dashed lines mark {_format_list(detail_hz)} Hz, the "
        "columns below: c–l phase portraits, m–v inertia force against u, over the last three "
        "cycles of the step. "
        + ("Red and blue: rig, forward and backward; black: model. " if campaign else
           "Solid: forward; dashed: backward, in the row below. ")
        + "Vertical dashed lines: the gap. Where the motion is chaotic, compare its type and its "
        "range, not single cycles.",
        figure, "11",
    )  # fmt: skip


def _format_list(frequencies_hz: list[float]) -> str:
    *first, last = (f"{hz:g}" for hz in frequencies_hz)
    return f"{', '.join(first)} and {last}"


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
    column: Any, row: int, motion: SystemMotion, case: PaperCase, style: LineStyle
) -> None:
    plot_phase_portrait(column[row], motion, **style)
    plot_inertia_loop(column[2 + row], motion, case.parameters.mass, **style)


def _draw_prc(
    panels: list[PrcPanel],
    case: PaperCase,
    campaign: MeasuredCampaign | None,
    detail_hz: list[float],
) -> None:
    if campaign is not None:
        plot_prc(panels, partial(extract_prc, campaign.points[CASE_NAME], "measured"), _dot_style)
    plot_prc(panels, partial(extract_prc, case.points, "twin"), partial(twin_style, width=1.3))
    for ax, _ in panels:
        for hz in detail_hz:
            ax.axvline(hz, **REST_LINE_STYLE)
            ax.annotate(
                f"{hz:g} Hz", (hz, 1.0), (2, -2), xycoords=("data", "axes fraction"), size=7.5,
                textcoords="offset points", ha="left", va="top", rotation=90, color=GUIDE_COLOUR,
            )  # fmt: skip
        ax.set_xlim(0.4, 5.05)


def _dot_style(direction: str) -> LineStyle:
    size = 4.6 if direction == "forward" else 2.8
    return {**measured_style(direction), "ls": "", "marker": "o", "ms": size, "mew": 0}


def _draw_histories(case: PaperCase, campaign: MeasuredCampaign | None) -> CaptionedFigure:
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
                plot_history(column, recorded, **experiment_style(direction, 2.0))
            motion = case.simulate_motion(hz, direction, MEASURED_CYCLES)
            plot_history(column, motion, **twin_style(direction, 1.0))
            for ax in column if direction == "forward" else ():
                shade_contact(ax, motion, TWIN_COLOUR, (0.07, 0.07))
        label_panel(column[0], "abc"[index], f"$f$ = {hz:g} Hz")
        draw_rest_lines(case.gaps_m, column[0].axhline)
        column[-1].set_xlabel("$t$ in s")
        column[-1].set_xlim(0, (MEASURED_CYCLES - (campaign is not None)) / hz)
    for ax, label in zip(axes[:, 0], ("$u$ in mm", "$a$ in m/s²", "$F_j$ in kN"), strict=True):
        ax.set_ylabel(label)
    figure.legend(handles=_make_legend_handles(campaign), loc="outside upper center", ncols=4)
    return CaptionedFigure(
        "fig12_histories" if campaign is None else "rig_fig12_histories", "Histories of G4",
        "Relative displacement, total acceleration and contact forces over the last three cycles "
        "of the step at a 0.53 Hz, b 1.4 Hz, c 3.4 Hz, from a zero upcrossing of the table's "
        "acceleration. Black: model"
        + ("; red and blue: rig" if campaign else "")
        + ". Grey bands: contacts of the model, forward. Dashed in the first row: the gap. "
        "In chaos no two records agree cycle by cycle, and at 1.4 Hz the initial conditions decide "
        "which side is hit twice.",
        figure, "12",
    )  # fmt: skip


def draw_chaos_figure(study: PaperStudy, campaign: MeasuredCampaign | None) -> CaptionedFigures:
    """Draw Lyapunov exponents and impact distributions of G4, for the model only."""
    if campaign is not None:
        return
    figure = Figure(figsize=(11, 6.2))
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    ax = top.subplots()
    ax.fill_between(CHAOS_SCAN_HZ, 0, 1, where=study.exponents > 0.05,
                    color=HYSTERESIS_COLOURS["right"], lw=0,
                    transform=ax.get_xaxis_transform())  # fmt: skip
    ax.axhline(0, color="#333333", lw=0.8)
    ax.plot(CHAOS_SCAN_HZ, study.exponents, color="#111111", lw=1.1)
    for hz in DETAIL_HZ[:-1]:
        ax.axvline(hz, color=GUIDE_COLOUR, ls=(0, (4, 2)), lw=0.9)
    ax.set_xlim(CHAOS_SCAN_HZ[0], CHAOS_SCAN_HZ[-1])
    ax.set_ylim(-1.2, 1.2)
    ax.set_xlabel("$f$ in Hz")
    ax.set_ylabel("largest Lyapunov exponent per cycle")
    label_panel(ax, "a", "G4: chaotic where the exponent is positive (yellow)")
    for index, (ax_share, hz) in enumerate(zip(bottom.subplots(1, 4, sharey=True), study.impacts,
                                             strict=True)):  # fmt: skip
        _draw_impact_shares(ax_share, study, hz)
        label_panel(ax_share, "bcde"[index], f"{hz:g} Hz")
        if index == 0:
            ax_share.set_ylabel("share of cycles in %")
    yield CaptionedFigure(
        "beside_chaos", "In addition to the paper: chaos and impacts of G4",
        "a Largest Lyapunov exponent of the model over frequency; dashed: the paper's frequencies. "
        "b–e Impacts right/left per forcing cycle, over 3000 cycles from rest. Two solvers, or a "
        "solver and a rig, can agree here in distribution only.",
        figure,
    )  # fmt: skip


def _draw_impact_shares(ax: Axes, study: PaperStudy, hz: float) -> None:
    shares = study.impacts[hz].shares[:MAX_BARS]
    names = [f"{right}/{left}" for (right, left), _ in shares]
    ax.set_ylim(0, max(92, 115 * shares[0][1]))
    bars = ax.bar(names, [100 * share for _, share in shares], color="#8b929c", width=0.6)
    ax.bar_label(bars, fmt="%.0f", size=8)
    ax.set_xlabel("impacts right/left")
    ax.set_xlim(-0.8, max(len(names), 3) - 0.2)
    ax.grid(False, axis="x")
