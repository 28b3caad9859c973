"""Figures of PRC families: all gaps (Fig. 2) and from positive to negative gaps (Fig. 5)."""

import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from table_io.records import PrcPoint
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import detect_hysteresis
from twin.drawing.panels import CaptionedFigure
from twin.drawing.pictures import direction_handles, label_panel
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    DIRECTION_DASHES,
    FREE_FLIGHT_COLOUR,
    GUIDE_COLOUR,
    HYSTERESIS_COLOURS,
    REST_LINE_STYLE,
    TRANSITION_COLOURS,
    LineStyle,
    format_minus,
    guide_style,
    measured_style,
    twin_style,
)
from twin.drawing.prc_drawing import (
    PrcPanel,
    draw_jumps,
    make_prc_panels,
    plot_prc,
    shade_hysteresis,
    shade_precompression,
)
from twin.results.measured_campaign import MeasuredCampaign
from twin.results.paper_cases import PaperCase
from twin.results.report_data import DIRECTIONS, extract_prc

FREE_FLIGHT = "G∞"
LABEL_OFFSETS_PT = {
    "G∞": (15, -8),
    "G0": (-10, 4),
    "G-1": (4, 10),
    "G-2": (3, 5),
    "G-10": (6, 5),
}  # of the gap's name from the peak
HIGHLIGHTED_GAPS = {
    "G4": "right",
    "G-1": "left",
}  # gaps whose jumps and hysteresis are marked in Fig. 2
DOT_SIZES_PT = (7.6, 6.8, 6.0, 5.3, 4.7, 4.2, 3.7, 3.2, 2.8)  # from G infinite to G-10


def _make_panels(cases: Mapping[str, PaperCase]) -> tuple[Figure, list[PrcPanel]]:
    top_hz = max(test.profile.sweep.stop_hz for case in cases.values() for test in case.tests)
    figure = Figure(figsize=(11, 8.2))
    panels = make_prc_panels(figure.subplots(2, 2, sharex=True))
    for (ax, _), panel_letter in zip(panels, "abcd", strict=True):
        label_panel(ax, panel_letter)
        ax.set_xlim(0, math.ceil(top_hz))
    return figure, panels


def draw_all_gaps(
    cases: Mapping[str, PaperCase], campaign: MeasuredCampaign | None
) -> CaptionedFigure:
    """Draw Fig. 2: PRCs of all gaps, the largest gap first."""
    figure, panels = _make_panels(cases)
    measured = campaign.points if campaign else {}
    sizes = np.interp(np.linspace(0, 8, max(len(cases), 2)), range(9), DOT_SIZES_PT)
    for (name, case), size in zip(cases.items(), sizes, strict=False):
        shown = panels[:2] if name == FREE_FLIGHT else panels
        model = partial(extract_prc, case.points, "twin")
        if campaign is None:
            plot_prc(shown, model, partial(_family_style, name, size))
        else:
            curves = partial(extract_prc, measured.get(name, ()), "measured")
            plot_prc(shown, model, twin_style)
            plot_prc(shown, curves, partial(_dot_style, name, 0.8 * size))
    highlighted = {}
    for name, kind in HIGHLIGHTED_GAPS.items():
        measured_points = measured.get(name)
        points = measured_points or (cases[name].points if name in cases else ())
        if _highlight_hysteresis(panels, points, "measured" if measured_points else "twin", kind):
            highlighted[name] = kind
    if FREE_FLIGHT in cases:
        _mark_unit(panels)
    _label_peaks(cases, panels)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=FREE_FLIGHT_COLOUR if name == FREE_FLIGHT else GUIDE_COLOUR,
               marker="o", ms=size, lw=0.32 * size, label=format_minus(name))
        for name, size in zip(cases, sizes, strict=False)
    ]  # fmt: skip
    handles += direction_handles(measured_style)
    if campaign is not None:
        handles += direction_handles(twin_style, "model, ")
    handles += [
        Patch(color=HYSTERESIS_COLOURS[kind], label=f"{kind} hysteresis, {format_minus(name)}")
        for name, kind in highlighted.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=7)
    return CaptionedFigure(
        "fig02_prc" if campaign is None else "rig_fig02_prc",
        f"Pseudo-resonance curves of {_list_names(cases)}",
        "Forward (red) and backward (blue) PRCs of a η_d, b η_a, c η_j and d r_j"
        + ("; the free flight is green" if FREE_FLIGHT in cases else "")
        + ". The smaller the gap, the smaller the dots and the thinner the lines. "
        + ("Dots: measured; lines: model. " if campaign else "")
        + _describe_highlights(highlighted, bool(campaign))
        + (" Green dashed: 1.0, the peak of G∞ continuous in frequency, by which η is divided; "
           "on the grid G∞ stays below it." if FREE_FLIGHT in cases else ""),
        figure,
        "2",
    )  # fmt: skip


def _list_names(cases: Iterable[str]) -> str:
    """Return the names of the gaps that are drawn."""
    return ", ".join(map(format_minus, cases))


def _describe_highlights(highlighted: Mapping[str, str], is_measured: bool) -> str:
    """Return what the bands and arrows mean; empty without any."""
    if not highlighted:
        return ""
    colours = {"right": "Yellow", "left": "cyan"}
    bands = "; ".join(
        f"{colours[kind]}: the primary {kind} hysteresis of {format_minus(name)}"
        for name, kind in highlighted.items()
    )
    source = ", measured" if is_measured else ""
    return (
        f"{bands[0].upper()}{bands[1:]} (first to last grid frequency at which the directions "
        f"differ{source}); arrows: jumps."
    )


def _mark_unit(panels: list[PrcPanel]) -> None:
    """Mark 1.0 in the panels of eta_d and eta_a: u* and a*, continuous in frequency."""
    for ax, _ in panels[:2]:
        ax.axhline(1.0, color=FREE_FLIGHT_COLOUR, ls=(0, (4, 2)), lw=0.9, zorder=0.6)
        ax.annotate(
            "1.0: u*, a*", (1.0, 1.0), (-2, 2), xycoords=("axes fraction", "data"),
            textcoords="offset points", ha="right", va="bottom", size=8, color=FREE_FLIGHT_COLOUR,
        )  # fmt: skip


def _family_style(name: str, size: float, direction: str) -> LineStyle:
    """Return the style of a model's curve; backward is thinner, so that both are visible."""
    width = size if direction == "forward" else 0.5 * size
    colour = _curve_colour(name, direction)
    return {"color": colour, "lw": 0.3 * width, "marker": "o", "ms": 0.62 * width, "mew": 0}


def _dot_style(name: str, size: float, direction: str) -> LineStyle:
    """Return the style of measured dots; backward is smaller, so that both are visible."""
    size = size if direction == "forward" else 0.6 * size
    colour = _curve_colour(name, direction)
    return {"color": colour, "ls": "", "marker": "o", "ms": size, "mew": 0, "zorder": 3}


def _curve_colour(name: str, direction: str) -> str:
    return FREE_FLIGHT_COLOUR if name == FREE_FLIGHT else DIRECTION_COLOURS[direction]


def _highlight_hysteresis(
    panels: list[PrcPanel], points: Sequence[PrcPoint], source: str, kind: str
) -> bool:
    """Draw the primary hysteresis as a band and its jumps as arrows; False if there is none."""
    jumps, intervals = detect_hysteresis(points, source)
    highlighted = [
        interval for interval in intervals if interval.kind == kind and interval.to_hz > 2
    ]
    shade_hysteresis(panels, highlighted)
    primary_jumps = [jump for jump in jumps if max(jump.from_hz, jump.to_hz) > 2]
    draw_jumps(panels, partial(extract_prc, points, source), primary_jumps)
    return bool(highlighted)


def _label_peaks(cases: Mapping[str, PaperCase], panels: list[PrcPanel]) -> None:
    """Label the primary resonance of each gap with its name."""
    for name, case in cases.items():
        for (ax, _), quantity in zip(panels[:2], ("eta_d", "eta_a"), strict=True):
            curves = [
                extract_prc(case.points, "twin", direction, quantity) for direction in DIRECTIONS
            ]
            f, y = max(curves, key=lambda curve: float(curve[1].max(initial=0.0)))
            ax.annotate(
                format_minus(name), (f[y.argmax()], y.max()), LABEL_OFFSETS_PT.get(name, (0, 5)),
                textcoords="offset points",
                ha="center", va="bottom", size=8, zorder=6,
                bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 0.6},
                color=FREE_FLIGHT_COLOUR if name == FREE_FLIGHT else "#222222",
            )  # fmt: skip
    top_ax = panels[0][0]
    top_ax.set_ylim(0, 1.08 * top_ax.dataLim.y1)


def draw_transition(
    cases: Mapping[str, PaperCase], campaign: MeasuredCampaign | None
) -> CaptionedFigure:
    """Draw Fig. 5: PRCs from positive to negative gaps, those that are among `cases`."""
    figure, panels = _make_panels(cases)
    measured = campaign.points if campaign else {}
    colours = {name: colour for name, colour in TRANSITION_COLOURS.items() if name in cases}
    for name, colour in colours.items():
        case, line_marker = cases[name], "o" if campaign is None else ""
        shade_precompression(panels, _compute_prestress(case), colour, 0.35)
        plot_prc(
            panels,
            partial(extract_prc, case.points, "twin"),
            partial(_transition_style, colour, line_marker),
        )
        plot_prc(
            panels,
            partial(extract_prc, measured.get(name, ()), "measured"),
            partial(_filled_style, colour),
        )
    handles = [
        Line2D([], [], color=colour, lw=1.6, label=format_minus(name))
        for name, colour in colours.items()
    ]
    handles += direction_handles(guide_style)
    handles += [Line2D([], [], **REST_LINE_STYLE, label="pre-strain, pre-stress at rest")]
    figure.legend(handles=handles, loc="outside upper center", ncols=8)
    return CaptionedFigure(
        "fig05_prc" if campaign is None else "rig_fig05_prc",
        f"From {_list_names(list(colours)[:1])} to {_list_names(list(colours)[-1:])}",
        "Forward (solid) and backward (dashed) PRCs of a η_d, b η_a, c η_j and d r_j for "
        f"{_list_names(colours)}. Dashed horizontal lines and grey areas in c and d: deformation "
        "and force of the precompressed bumpers at rest. "
        + ("Dots: measured, filled forward, open backward. " if campaign else "")
        + _compare_g2_g10(cases),
        figure,
        "5",
    )


def _transition_style(colour: str, marker: str, direction: str) -> LineStyle:
    dashes = DIRECTION_DASHES[direction]
    return {"color": colour, "ls": dashes, "lw": 1.3, "marker": marker, "ms": 2.4}


def _filled_style(colour: str, direction: str) -> LineStyle:
    """Return the style of measured dots: filled forward, open backward."""
    face = colour if direction == "forward" else "white"
    return {"ls": "", "marker": "o", "mec": colour, "mfc": face, "ms": 3.6, "mew": 0.9}


def _compare_g2_g10(cases: Mapping[str, PaperCase]) -> str:
    """Format the difference between G-2 and G-10, which almost coincide in the paper."""
    if not {"G-2", "G-10"} <= cases.keys():
        return ""
    (f_g2, eta_g2), (f_g10, eta_g10) = (
        extract_prc(cases[name].points, "twin", "backward", "eta_d") for name in ("G-2", "G-10")
    )
    if f_g2.shape != f_g10.shape:
        return ""
    difference = np.abs(eta_g2 - eta_g10).max() / eta_g10.max()
    kinds = sorted(
        {interval.kind for interval in detect_hysteresis(cases["G-2"].points, "twin")[1]}
    )
    hysteresis_text = f"; G−2 has a {' and a '.join(kinds)} hysteresis" if kinds else ""
    return (
        "In the paper the curves of G−2 and G−10 almost coincide; in the model their η_d differ by "
        f"up to {100 * difference:.0f} % of the peak of G−10{hysteresis_text}."
    )


def _compute_prestress(case: PaperCase) -> dict[str, float]:
    """Return eta_j = u_j / u* and r_j = F_j / (M g) of precompressed bumpers at rest by name."""
    weight, (u_star, _) = case.parameters.mass * GRAVITY_M_S2, case.scale
    preload = case.simulator.bumper_preload()
    prestress = {f"eta_{side}": preload[f"u_{side}"] / u_star for side in "rl"}
    prestress |= {f"r_{side}": preload[f"f_{side}"] / weight for side in "rl"}
    return {name: size for name, size in prestress.items() if size > 0}
