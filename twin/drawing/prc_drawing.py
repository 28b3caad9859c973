"""Pseudo-resonance curves (PRC): panels, curves, hysteresis, jumps and precompression.

Every figure of PRCs is drawn here: report, campaign, paper, sweeps and discovery differ in their
curves and line styles only.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np

from twin.compare.curves import Hysteresis, PrcJump
from twin.drawing.panels import Canvas, FigurePanel
from twin.drawing.plot_style import (
    DIRECTION_COLOURS,
    GUIDE_COLOUR,
    HYSTERESIS_COLOURS,
    PRECOMPRESSION_COLOUR,
    REST_LINE_STYLE,
    ZERO_COLOUR,
    DirectionStyle,
    LineStyle,
)
from twin.results.contracts import HysteresisInterval, Jump
from twin.results.report_data import DIRECTIONS, Curve

Curves = Callable[[str, str], Curve]  # of a direction and a quantity
Quantities = Mapping[str, int]  # quantities of a panel, each with the sign it is drawn with
PrcPanel = tuple[Canvas, Quantities]

ETA_D = (r"$\eta_d$, relative displacement over $u^*$", {"eta_d": 1})
ETA_A = (r"$\eta_a$, total acceleration over $a^*$", {"eta_a": 1})
FREE_PANELS = (ETA_D, ETA_A)
PRC_PANELS = (
    *FREE_PANELS,
    (r"$\eta_j$, bumper deformation over $u^*$", {"eta_r": 1, "eta_l": -1}),
    (r"$r_j$, contact force over weight", {"r_r": 1, "r_l": -1}),
)
IMPACT_PANELS = (
    ("right impacts per cycle", {"impacts_right": 1}),
    ("left impacts per cycle", {"impacts_left": 1}),
)
MAX_LABELLED_JUMPS = 4


def make_prc_panels(
    axes: np.ndarray, contents: Iterable[tuple[str, Quantities]] = PRC_PANELS
) -> list[PrcPanel]:
    """Label a 2D array of axes, one panel per entry of `contents`; return the panels."""
    panels = []
    for ax, (label, quantities) in zip(axes.flat, contents, strict=True):
        ax.set_ylabel(label)
        if len(quantities) == 2:
            format_mirrored_axis(ax)
        panels.append((ax, quantities))
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    return panels


def format_mirrored_axis(ax: Canvas) -> None:
    """Format a mirrored axis: right side above zero, left below, both labelled positive."""
    ax.axhline(0, color=ZERO_COLOUR, lw=0.7)
    if isinstance(ax, FigurePanel):
        ax.set_absolute_labels()
    else:
        ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
    for y, va, text in ((0.98, "top", "right"), (0.02, "bottom", "left")):
        ax.text(
            0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE_COLOUR, zorder=5,
            bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 1},
        )  # fmt: skip


def plot_prc(panels: Iterable[PrcPanel], curves: Curves, make_style: DirectionStyle) -> None:
    """Draw the curves of both directions in every panel; a curve of one point gets a marker.

    Axes that are not mirrored start at zero.
    """
    for ax, quantities in panels:
        for name, sign in quantities.items():
            for direction in DIRECTIONS:
                f, y = curves(direction, name)
                marker: LineStyle = {"marker": "o" if f.size == 1 else ""}
                ax.plot(f, sign * y, **(marker | make_style(direction)))
        if len(quantities) == 1:
            ax.autoscale(axis="y")
            ax.set_ylim(bottom=0)


def break_at_jumps(curves: Curves, jumps: Sequence[PrcJump | Jump]) -> Curves:
    """Return the curves with a NaN between the two points of each jump of their direction."""

    def broken(direction: str, name: str) -> Curve:
        f, y = curves(direction, name)
        middles = [
            0.5 * (jump.from_hz + jump.to_hz) for jump in jumps if jump.direction == direction
        ]
        places = np.searchsorted(f, middles)
        return np.insert(f, places, middles), np.insert(y, places, np.nan)

    return broken


def shade_hysteresis(
    panels: Iterable[PrcPanel], intervals: Iterable[Hysteresis | HysteresisInterval]
) -> None:
    """Shade hysteresis intervals, yellow right and cyan left."""
    for ax, _ in panels:
        for interval in intervals:
            ax.axvspan(
                interval.from_hz, interval.to_hz, color=HYSTERESIS_COLOURS[interval.kind], lw=0,
                zorder=0.4,
            )  # fmt: skip


def shade_precompression(
    panels: Iterable[PrcPanel],
    prestress: Mapping[str, float],
    colour: str = GUIDE_COLOUR,
    alpha: float = 1.0,
) -> None:
    """Shade from zero to the value of each precompressed bumper at rest (Fig. 5)."""
    for ax, quantities in panels:
        for name, sign in quantities.items():
            if name in prestress:
                rest_value = sign * prestress[name]
                ax.axhspan(
                    0, rest_value, color=PRECOMPRESSION_COLOUR, alpha=alpha, lw=0, zorder=0.3
                )
                ax.axhline(rest_value, **{**REST_LINE_STYLE, "color": colour})


def draw_jumps(
    panels: Iterable[PrcPanel], curves: Curves, jumps: Sequence[PrcJump | Jump], label_in: str = ""
) -> None:
    """Draw an arrow per jump in every panel; label them in the panel of the quantity `label_in`.

    The label is the pair of grid frequencies, or the number of the jump if there are many.
    """
    for ax, quantities in panels:
        for name, sign in quantities.items():
            for number, jump in enumerate(jumps, 1):
                f, y = curves(jump.direction, name)
                ends = [y[np.isclose(f, hz)] for hz in (jump.from_hz, jump.to_hz)]
                if not all(end.size and np.isfinite(end[0]) for end in ends):
                    continue
                x, (start, stop) = (jump.from_hz + jump.to_hz) / 2, (sign * end[0] for end in ends)
                colour = DIRECTION_COLOURS[jump.direction]
                style: LineStyle = {"arrowstyle": "-|>", "color": colour, "lw": 1.6}
                style |= {"shrinkA": 0, "shrinkB": 0}
                ax.annotate("", (x, stop), (x, start), arrowprops=style, zorder=4)
                if name == label_in:
                    text = _format_jump(jump) if len(jumps) <= MAX_LABELLED_JUMPS else f"{number}"
                    right = jump.to_hz >= jump.from_hz and x < f[0] + 0.85 * (f[-1] - f[0])
                    ax.annotate(
                        text, (x, (start + stop) / 2), (5 if right else -5, 0), color=colour,
                        size=8, textcoords="offset points", ha="left" if right else "right",
                        va="center", zorder=5,
                        bbox={"facecolor": "white", "alpha": 0.85, "lw": 0, "pad": 1},
                    )  # fmt: skip


def _format_jump(jump: PrcJump | Jump) -> str:
    low, high = sorted((jump.from_hz, jump.to_hz))
    return f"{low:g}–{high:g} Hz"
