"""Secondary resonances of G4 in the low frequency range (Fig. 9)."""

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.drawing.motion_drawing import (
    draw_rest_lines,
    plot_bumper_loops,
    plot_history,
    plot_inertia_loop,
    plot_phase_portrait,
    shade_contact,
)
from twin.drawing.panels import CaptionedFigure, CaptionedFigures
from twin.drawing.pictures import direction_handles, label_panel
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    GUIDE_COLOUR,
    LineStyle,
    experiment_style,
    measured_style,
)
from twin.drawing.prc_drawing import ETA_A, make_prc_panels, plot_prc
from twin.paper.low_frequency import simulate_secondary_motion
from twin.paper.study import SECONDARY_HZ, PaperStudy
from twin.results.measured_campaign import MeasuredCampaign
from twin.results.paper_cases import PaperCase
from twin.results.players import SystemMotion
from twin.results.report_data import DIRECTIONS, extract_prc

SWEEP_RANGES = (  # name, start and stop in Hz, colour, position of the label in Hz
    ("SS1", 0.5, 0.8, "#cfeccb", 0.65), ("SS2", 0.8, 1.6, "#fde0b5", 1.3),
    ("SS3", 0.5, 5.0, "#d3e9f7", 3.3),
)  # fmt: skip
MEASURED_CYCLES = 3  # measured cycles of a step, in portraits and loops
SHOWN_CYCLES = 2  # cycles shown in the histories


def draw_secondary_resonance_figure(
    study: PaperStudy, campaign: MeasuredCampaign | None
) -> CaptionedFigures:
    """Draw Fig. 9 at the paper's frequencies and at the model's own, for the model only."""
    if campaign is not None:
        return
    case = study.cases["G4"]
    motions = [
        {
            direction: case.simulate_motion(hz, direction, MEASURED_CYCLES)
            for direction in DIRECTIONS
        }
        for hz in SECONDARY_HZ
    ]
    figure = _draw_figure(case, SECONDARY_HZ, motions)
    yield CaptionedFigure(
        "fig09_secondary", "Secondary resonances of G4, at the paper's frequencies",
        f"{_describe_panels('the three observed resonances')} {_describe_chaos(study)}",
        figure, "9",
    )  # fmt: skip
    own_hz = [hz for paper_hz in SECONDARY_HZ if (hz := study.find_own_hz(paper_hz)) is not None]
    if not own_hz:
        return
    scan = study.secondary["G4"]
    motions = [
        {
            direction: simulate_secondary_motion(case, scan, hz, direction, MEASURED_CYCLES)
            for direction in DIRECTIONS
        }
        for hz in own_hz
    ]
    listed = ", ".join(f"{hz:g}" for hz in own_hz)
    yield CaptionedFigure(
        "fig09_own", "Secondary resonances of G4, at the model's own frequencies",
        f"{_describe_panels('the resonances of the model')} The model's resonances lie at {listed} "
        "Hz, the ends of left hystereses: the forward motion still has the impact that it is about "
        "to lose, the backward motion has lost it.",
        _draw_figure(case, own_hz, motions), "9",
    )  # fmt: skip


def _describe_panels(resonances: str) -> str:
    return (
        f"a PRC of η_a with the ranges of the three sweeps and {resonances}; b–d phase portraits, "
        "e–g inertia force against u, h–j contact force against bumper position, over "
        f"{MEASURED_CYCLES} cycles; k–m u, n–p total acceleration, q–s contact forces over time. "
        "Red bands: the contacts within one forcing cycle of the forward sweep. Dashed: the gap."
    )


def _draw_figure(
    case: PaperCase, frequencies_hz: Sequence[float], motions: list[dict[str, SystemMotion]]
) -> Figure:
    """Draw the PRC and, a column per frequency, portraits, loops and histories."""
    count = len(frequencies_hz)
    figure = Figure(figsize=(15.5, 11))
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.02, 1))[0]
    grid = left.add_gridspec(4, count)
    _draw_prc(left.add_subplot(grid[0, :]), case, frequencies_hz)
    axes = right.subplots(3, count, sharey="row", sharex="col", squeeze=False)
    for column, (hz, pair) in enumerate(zip(frequencies_hz, motions, strict=True)):
        rows = [left.add_subplot(grid[1 + row, column]) for row in range(3)]
        _draw_loops(rows, pair, case, column, hz)
        _draw_histories(axes[:, column], pair, case, column, hz)
    figure.legend(handles=direction_handles(experiment_style), loc="outside upper center", ncols=2)
    return figure


def _describe_chaos(study: PaperStudy) -> str:
    chaotic = [f"{hz:g}" for hz in SECONDARY_HZ if study.is_chaotic(hz)]
    if not chaotic:
        return "The model is chaotic at none of the three."
    where = "all three" if len(chaotic) == len(SECONDARY_HZ) else f"{' and '.join(chaotic)} Hz"
    return f"The model is chaotic at {where}: cycles and directions differ there."


def _draw_prc(ax: Axes, case: PaperCase, frequencies_hz: Sequence[float]) -> None:
    for name, low, high, colour, label_hz in SWEEP_RANGES[::-1]:
        ax.axvspan(low, high, color=colour, lw=0, zorder=0.3)
        ax.annotate(
            name, (label_hz, 0.06), xycoords=("data", "axes fraction"), ha="center", size=9,
            color="#333333", bbox={"facecolor": colour, "lw": 0, "pad": 1},
        )  # fmt: skip
    panels = make_prc_panels(np.array([[ax]]), (ETA_A,))
    plot_prc(panels, partial(extract_prc, case.points, "twin"), _dotted_style)
    for number, hz in enumerate(frequencies_hz, 1):
        ax.axvline(hz, color="#111111", ls=(0, (4, 2)), lw=1)
        ax.annotate(
            f"$f_{number}$", (hz, 0.97), (3, 0), xycoords=("data", "axes fraction"),
            textcoords="offset points", va="top", size=9,
        )  # fmt: skip
    ax.set_xlim(0.4, 5.05)
    label_panel(ax, "a")


def _dotted_style(direction: str) -> LineStyle:
    size = 4.2 if direction == "forward" else 2.4
    return {**measured_style(direction, size / 3), "marker": "o", "ms": size, "mew": 0}


def _draw_loops(
    rows: list[Axes], pair: dict[str, SystemMotion], case: PaperCase, column: int, hz: float
) -> None:
    for direction in DIRECTIONS:
        style = experiment_style(direction, 1.0)
        plot_phase_portrait(rows[0], pair[direction], **style)
        plot_inertia_loop(rows[1], pair[direction], case.parameters.mass, **style)
        plot_bumper_loops(rows[2], pair[direction], **style)
    names = ("bcd", "efg", "hij")
    labels = (
        ("$u$ in mm", "$u'$ in mm/s"), ("$u$ in mm", "$F_I$ in kN"), ("$v_j$ in mm", "$F_j$ in kN"),
    )  # fmt: skip
    for ax, letters, (x_label, y_label) in zip(rows, names, labels, strict=True):
        title = f"$f_{column + 1}$ = {hz:g} Hz" if letters == "bcd" else ""
        label_panel(ax, letters[column], title)
        draw_rest_lines(case.gaps_m, ax.axvline)
        ax.axhline(0, color=GUIDE_COLOUR, lw=0.5, zorder=0.6)
        ax.set_xlabel(x_label)
        ax.set_ylabel(y_label if column == 0 else "")


def _draw_histories(
    axes: Any, pair: dict[str, SystemMotion], case: PaperCase, column: int, hz: float
) -> None:
    for direction in DIRECTIONS:
        plot_history(axes, pair[direction], **experiment_style(direction, 1.0))
    forward = pair["forward"]
    start_s = _find_longest_flight_end(forward, hz)
    inside = (forward.time >= start_s) & (forward.time < start_s + 1 / hz)
    for ax, letters in zip(axes, ("klm", "nop", "qrs"), strict=True):
        shade_contact(ax, forward, DIRECTION_COLOURS["forward"], (0.2, 0.2), within=inside)
        label_panel(
            ax, letters[column], f"$f_{column + 1}$ = {hz:g} Hz" if letters == "klm" else ""
        )
        ax.set_xlim(0, SHOWN_CYCLES / hz)
    draw_rest_lines(case.gaps_m, axes[0].axhline)
    axes[2].set_xlabel("$t$ in s")
    if column == 0:
        for ax, label in zip(axes, ("$u$ in mm", "$a$ in m/s²", "$F_j$ in kN"), strict=True):
            ax.set_ylabel(label)


def _find_longest_flight_end(motion: SystemMotion, hz: float) -> float:
    """Return the time in s just before the end of the longest flight in the first cycle."""
    in_contact = (motion.force_r > 0) | (motion.force_l < 0)
    starts = motion.time[1:][in_contact[1:] & ~in_contact[:-1]]
    ends = motion.time[1:][~in_contact[1:] & in_contact[:-1]]
    flights = [(b - ends[ends < b].max(), b) for b in starts if (ends < b).any() and b < 1 / hz]
    return float(max(flights)[1] - 0.01 / hz) if flights else 0.3 / hz
