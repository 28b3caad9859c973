"""Figures of PRC families: all gaps (Fig. 2) and from positive to negative gaps (Fig. 5)."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from table_io.block import Float1D
from table_io.records import PrcPoint
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import PrcJump, detect_hysteresis
from twin.reports.figures import PRECOMPRESSION_COLOUR
from twin.reports.measured_campaign import MeasuredCampaign
from twin.reports.paper_cases import PaperCase, extract_prc
from twin.reports.plot_style import (
    DIRECTION_COLOURS,
    DIRECTION_DASHES,
    DIRECTIONS,
    GAP_COLOURS,
    GUIDE_COLOUR,
    HYSTERESIS_COLOURS,
    REST_LINE_STYLE,
    TRANSITION_COLOURS,
    TWIN_COLOUR,
    PaperFigure,
    format_minus,
    label_panel,
)

PANELS = (
    ("a", r"$\eta_d$", {"eta_d": 1}),
    ("b", r"$\eta_a$", {"eta_a": 1}),
    ("c", r"$\eta_j$  ($j = R, L$)", {"eta_r": 1, "eta_l": -1}),
    ("d", r"$r_j$  ($j = R, L$)", {"r_r": 1, "r_l": -1}),
)
LABEL_OFFSETS_PT = {
    "G∞": (13, 0),
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


def _make_axes(cases: Mapping[str, PaperCase]) -> tuple[Figure, list[Axes]]:
    top_hz = max(test.profile.sweep.stop_hz for case in cases.values() for test in case.tests)
    figure = Figure(figsize=(11, 8.2))
    axes = list(figure.subplots(2, 2, sharex=True).flat)
    for ax, (panel_letter, label, names) in zip(axes, PANELS, strict=True):
        label_panel(ax, panel_letter)
        ax.set_ylabel(label)
        if len(names) == 2:
            ax.axhline(0, color="#333333", lw=0.8)
            ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
            for y, va, text in ((0.98, "top", r"$B_R$"), (0.02, "bottom", r"$B_L$")):
                ax.text(
                    0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE_COLOUR
                )
    for ax in axes[2:]:
        ax.set_xlabel("$f$ in Hz")
        ax.set_xlim(0, math.ceil(top_hz))
    return figure, axes


def draw_all_gaps(cases: Mapping[str, PaperCase], campaign: MeasuredCampaign | None) -> PaperFigure:
    """Draw Fig. 2: PRCs of all gaps, the largest gap first."""
    figure, axes = _make_axes(cases)
    measured = campaign.points if campaign else {}
    sizes = np.interp(np.linspace(0, 8, max(len(cases), 2)), range(9), DOT_SIZES_PT)
    for (name, case), size in zip(cases.items(), sizes, strict=False):
        for ax, (_, _, names) in zip(axes, PANELS, strict=True):
            if name == "G∞" and len(names) == 2:
                continue
            for quantity, sign in names.items():
                if campaign is None:
                    _plot_family(ax, name, case.points, quantity, sign, size)
                else:
                    _plot_model(ax, case.points, quantity, sign)
                    _plot_measured(ax, name, measured.get(name, ()), quantity, sign, 0.8 * size)
    highlighted = {}
    for name, kind in HIGHLIGHTED_GAPS.items():
        measured_points = measured.get(name)
        points = measured_points or (cases[name].points if name in cases else ())
        if _highlight_hysteresis(axes, points, "measured" if measured_points else "twin", kind):
            highlighted[name] = kind
    _label_peaks(cases, axes)
    axes[0].set_ylim(0, 1.08 * axes[0].dataLim.y1)
    axes[1].set_ylim(bottom=0)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=GAP_COLOURS["G∞"] if name == "G∞" else "#555555", marker="o",
               ms=size, lw=0.32 * size, label=format_minus(name))
        for name, size in zip(cases, sizes, strict=False)
    ]  # fmt: skip
    handles += [
        Line2D([], [], color=DIRECTION_COLOURS[direction], lw=2, label=direction)
        for direction in DIRECTIONS
    ]
    if campaign is not None:
        handles += [
            Line2D(
                [],
                [],
                color=TWIN_COLOUR,
                ls=DIRECTION_DASHES[direction],
                lw=0.8,
                label=f"model, {direction}",
            )
            for direction in DIRECTIONS
        ]
    handles += [
        Patch(color=HYSTERESIS_COLOURS[kind], label=f"{kind} hysteresis, {format_minus(name)}")
        for name, kind in highlighted.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=7)
    return PaperFigure(
        "fig02_prc" if campaign is None else "rig_fig02_prc", "2",
        "Pseudo-resonance curves of all gaps",
        "Forward (red) and backward (blue) PRCs of a η_d, b η_a, c η_j and d r_j; the free flight "
        "is green. The smaller the gap, the smaller the dots and the thinner the lines. "
        + ("Dots: measured; lines: model. " if campaign else "")
        + "Yellow: the primary right hysteresis of G4; cyan: the left hysteresis of G−1 "
        "(first to last grid frequency at which the directions differ"
        + (", measured" if campaign else "")
        + "); arrows: their jumps.",
        figure,
    )  # fmt: skip


def _plot_family(
    ax: Axes, name: str, points: Sequence[PrcPoint], quantity: str, sign: int, size: float
) -> None:
    """Plot both directions, backward thinner so that both are visible where they coincide."""
    for direction, width_ratio in (("forward", 1.0), ("backward", 0.5)):
        f, y = extract_prc(points, "twin", direction, quantity)
        ax.plot(
            f, sign * y, "o-", color=_curve_colour(name, direction), lw=0.3 * size * width_ratio,
            ms=0.62 * size * width_ratio, mew=0,
        )  # fmt: skip


def _plot_model(ax: Axes, points: Sequence[PrcPoint], quantity: str, sign: int) -> None:
    """Plot both directions of the model as thin lines under measured dots."""
    for direction in DIRECTIONS:
        f, y = extract_prc(points, "twin", direction, quantity)
        ax.plot(f, sign * y, color=TWIN_COLOUR, ls=DIRECTION_DASHES[direction], lw=0.8)


def _plot_measured(
    ax: Axes, name: str, points: Sequence[PrcPoint], quantity: str, sign: int, size: float
) -> None:
    for direction, size_ratio in (("forward", 1.0), ("backward", 0.6)):
        f, y = extract_prc(points, "measured", direction, quantity)
        ax.plot(
            f,
            sign * y,
            "o",
            color=_curve_colour(name, direction),
            ms=size * size_ratio,
            mew=0,
            zorder=3,
        )


def _curve_colour(name: str, direction: str) -> str:
    return GAP_COLOURS[name] if name == "G∞" else DIRECTION_COLOURS[direction]


def _highlight_hysteresis(
    axes: list[Axes], points: Sequence[PrcPoint], source: str, kind: str
) -> bool:
    """Draw the primary hysteresis as a band and its jumps as arrows; False if there is none."""
    jumps, intervals = detect_hysteresis(points, source)
    highlighted = [
        interval for interval in intervals if interval.kind == kind and interval.to_hz > 2
    ]
    for ax, (_, _, names) in zip(axes, PANELS, strict=True):
        for interval in highlighted:
            ax.axvspan(
                interval.from_hz, interval.to_hz, color=HYSTERESIS_COLOURS[kind], lw=0, zorder=0.4
            )
        for jump in jumps:
            if max(jump.from_hz, jump.to_hz) > 2:
                for quantity, sign in names.items():
                    _draw_jump(
                        ax, jump, *extract_prc(points, source, jump.direction, quantity), sign
                    )
    return bool(highlighted)


def _draw_jump(ax: Axes, jump: PrcJump, f: Float1D, y: Float1D, sign: int) -> None:
    start, stop = (sign * float(y[np.isclose(f, hz)][0]) for hz in (jump.from_hz, jump.to_hz))
    x = (jump.from_hz + jump.to_hz) / 2
    style = {"arrowstyle": "-|>", "color": DIRECTION_COLOURS[jump.direction], "lw": 1.7,
             "shrinkA": 0, "shrinkB": 0}  # fmt: skip
    ax.annotate("", (x, stop), (x, start), arrowprops=style, zorder=4)


def _label_peaks(cases: Mapping[str, PaperCase], axes: list[Axes]) -> None:
    """Label the primary resonance of each gap with its name."""
    for name, case in cases.items():
        for ax, quantity in zip(axes[:2], ("eta_d", "eta_a"), strict=True):
            curves = [
                extract_prc(case.points, "twin", direction, quantity) for direction in DIRECTIONS
            ]
            f, y = max(curves, key=lambda curve: float(curve[1].max(initial=0.0)))
            ax.annotate(
                format_minus(name), (f[y.argmax()], y.max()), LABEL_OFFSETS_PT.get(name, (0, 5)),
                textcoords="offset points",
                ha="center", va="bottom", size=8, zorder=6,
                bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 0.6},
                color=GAP_COLOURS["G∞"] if name == "G∞" else "#222222",
            )  # fmt: skip


def draw_transition(
    cases: Mapping[str, PaperCase], campaign: MeasuredCampaign | None
) -> PaperFigure:
    """Draw Fig. 5: PRCs from positive to negative gaps, those that are among `cases`."""
    figure, axes = _make_axes(cases)
    measured = campaign.points if campaign else {}
    colours = {name: colour for name, colour in TRANSITION_COLOURS.items() if name in cases}
    for name, colour in colours.items():
        case = cases[name]
        for ax, (_, _, names) in zip(axes, PANELS, strict=True):
            for quantity, sign in names.items():
                rest_value = sign * _compute_prestress(case).get(quantity, 0.0)
                if rest_value:
                    ax.axhspan(
                        0, rest_value, color=PRECOMPRESSION_COLOUR, alpha=0.35, lw=0, zorder=0.3
                    )
                    ax.axhline(rest_value, **{**REST_LINE_STYLE, "color": colour})
                for direction in DIRECTIONS:
                    f, y = extract_prc(case.points, "twin", direction, quantity)
                    marker = "o" if campaign is None else ""
                    ax.plot(
                        f,
                        sign * y,
                        color=colour,
                        ls=DIRECTION_DASHES[direction],
                        lw=1.3,
                        marker=marker,
                        ms=2.4,
                    )
                    f, y = extract_prc(measured.get(name, ()), "measured", direction, quantity)
                    face = colour if direction == "forward" else "white"
                    ax.plot(f, sign * y, "o", mec=colour, mfc=face, ms=3.6, mew=0.9)
    for ax in axes[:2]:
        ax.set_ylim(bottom=0)
    handles = [
        Line2D([], [], color=colour, lw=1.6, label=format_minus(name))
        for name, colour in colours.items()
    ]
    handles += [
        Line2D([], [], color=GUIDE_COLOUR, ls=DIRECTION_DASHES[direction], label=direction)
        for direction in DIRECTIONS
    ]
    handles += [Line2D([], [], **REST_LINE_STYLE, label="pre-strain, pre-stress at rest")]
    figure.legend(handles=handles, loc="outside upper center", ncols=8)
    return PaperFigure(
        "fig05_prc" if campaign is None else "rig_fig05_prc", "5", "From positive to negative gaps",
        "Forward (solid) and backward (dashed) PRCs of a η_d, b η_a, c η_j and d r_j for G4, G0, "
        "G−1, G−2 and G−10. Dashed horizontal lines and grey areas in c and d: deformation and "
        "force of the precompressed bumpers at rest. "
        + ("Dots: measured, filled forward, open backward. " if campaign else "")
        + _compare_g2_g10(cases),
        figure,
    )  # fmt: skip


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
