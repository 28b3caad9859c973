"""PRC families of all gaps (Fig. 2) and from positive to negative gaps (Fig. 5)."""

import math
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from table_io.block import Float1D
from table_io.records import Point
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import Jump, branches
from twin.service.figures import OFFSET
from twin.service.paper.cases import Case, curve
from twin.service.paper.look import (
    AT_REST,
    BAND,
    COLOUR,
    DASH,
    DIRECTIONS,
    GUIDE,
    OF_GAP,
    TRANSITION,
    TWIN,
    Drawing,
    Drawings,
    letter,
    minus,
)
from twin.service.paper.rig import Rig
from twin.service.paper.study import Study

PANELS = (
    ("a", r"$\eta_d$", {"eta_d": 1}),
    ("b", r"$\eta_a$", {"eta_a": 1}),
    ("c", r"$\eta_j$  ($j = R, L$)", {"eta_r": 1, "eta_l": -1}),
    ("d", r"$r_j$  ($j = R, L$)", {"r_r": 1, "r_l": -1}),
)
LABEL_AT = {
    "G∞": (13, 0),
    "G0": (-10, 4),
    "G-1": (4, 10),
    "G-2": (3, 5),
    "G-10": (6, 5),
}  # pt off the peak
HIGHLIGHTED = {"G4": "right", "G-1": "left"}  # the gaps whose jumps and hysteresis Fig. 2 marks
SIZES = (7.6, 6.8, 6.0, 5.3, 4.7, 4.2, 3.7, 3.2, 2.8)  # of the dots, G infinite to G-10


def draw(found: Study, rig: Rig | None) -> Drawings:
    """Figs. 2 and 5; with a rig its measured points on the model's lines."""
    yield all_gaps(found.cases, rig)
    yield transition(found.cases, rig)


def _frame(cases: Mapping[str, Case]) -> tuple[Figure, list[Axes]]:
    top_hz = max(one.profile.sweep.stop_hz for case in cases.values() for one in case.tests)
    figure = Figure(figsize=(11, 8.2))
    axes = list(figure.subplots(2, 2, sharex=True).flat)
    for ax, (which, label, names) in zip(axes, PANELS, strict=True):
        letter(ax, which)
        ax.set_ylabel(label)
        if len(names) == 2:
            ax.axhline(0, color="#333333", lw=0.8)
            ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
            for y, va, text in ((0.98, "top", r"$B_R$"), (0.02, "bottom", r"$B_L$")):
                ax.text(0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE)
    for ax in axes[2:]:
        ax.set_xlabel("$f$ in Hz")
        ax.set_xlim(0, math.ceil(top_hz))
    return figure, axes


def all_gaps(cases: Mapping[str, Case], rig: Rig | None) -> Drawing:
    """Fig. 2: every gap by its name, the largest first."""
    figure, axes = _frame(cases)
    measured = rig.points if rig else {}
    sizes = np.interp(np.linspace(0, 8, max(len(cases), 2)), range(9), SIZES)
    for (name, case), size in zip(cases.items(), sizes, strict=False):
        for ax, (_, _, names) in zip(axes, PANELS, strict=True):
            if name == "G∞" and len(names) == 2:
                continue
            for quantity, sign in names.items():
                if rig is None:
                    _family_line(ax, name, case.points, quantity, sign, size)
                else:
                    _model_line(ax, case.points, quantity, sign)
                    _dots(ax, name, measured.get(name, ()), quantity, sign, 0.8 * size)
    highlighted = {}
    for name, kind in HIGHLIGHTED.items():
        seen = measured.get(name)
        points = seen or (cases[name].points if name in cases else ())
        if _highlight(axes, points, "measured" if seen else "twin", kind):
            highlighted[name] = kind
    _peaks(cases, axes)
    axes[0].set_ylim(0, 1.08 * axes[0].dataLim.y1)
    axes[1].set_ylim(bottom=0)
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=OF_GAP["G∞"] if name == "G∞" else "#555555", marker="o",
               ms=size, lw=0.32 * size, label=minus(name))
        for name, size in zip(cases, sizes, strict=False)
    ]  # fmt: skip
    handles += [Line2D([], [], color=COLOUR[one], lw=2, label=one) for one in DIRECTIONS]
    if rig is not None:
        handles += [
            Line2D([], [], color=TWIN, ls=DASH[one], lw=0.8, label=f"model, {one}")
            for one in DIRECTIONS
        ]
    handles += [
        Patch(color=BAND[kind], label=f"{kind} hysteresis, {minus(name)}")
        for name, kind in highlighted.items()
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=7)
    return Drawing(
        "fig02_prc" if rig is None else "rig_fig02_prc", "2", "Pseudo-resonance curves of all gaps",
        "Forward (red) and backward (blue) PRCs of a η_d, b η_a, c η_j and d r_j; the free flight "
        "is green. Dots and lines grow smaller with the gap. "
        + ("Dots: measured; lines: model. " if rig else "")
        + "Yellow: the primary right hysteresis of G4; cyan: the left hysteresis of G−1 "
        "(first to last grid frequency at which the directions differ"
        + (", measured" if rig else "")
        + "); arrows: their jumps.",
        figure,
    )  # fmt: skip


def _family_line(
    ax: Axes, name: str, points: Sequence[Point], quantity: str, sign: int, size: float
) -> None:
    """Both directions; the backward one slimmer, so that both are seen where they coincide."""
    for one, share in (("forward", 1.0), ("backward", 0.5)):
        f, y = curve(points, "twin", one, quantity)
        ax.plot(
            f, sign * y, "o-", color=_colour(name, one), lw=0.3 * size * share,
            ms=0.62 * size * share, mew=0,
        )  # fmt: skip


def _model_line(ax: Axes, points: Sequence[Point], quantity: str, sign: int) -> None:
    """Both directions, in the ink of a model beside measured dots."""
    for one in DIRECTIONS:
        f, y = curve(points, "twin", one, quantity)
        ax.plot(f, sign * y, color=TWIN, ls=DASH[one], lw=0.8)


def _dots(
    ax: Axes, name: str, points: Sequence[Point], quantity: str, sign: int, size: float
) -> None:
    for one, share in (("forward", 1.0), ("backward", 0.6)):
        f, y = curve(points, "measured", one, quantity)
        ax.plot(f, sign * y, "o", color=_colour(name, one), ms=size * share, mew=0, zorder=3)


def _colour(name: str, direction: str) -> str:
    return OF_GAP[name] if name == "G∞" else COLOUR[direction]


def _highlight(axes: list[Axes], points: Sequence[Point], who: str, kind: str) -> bool:
    """The primary hysteresis as a band, its jumps as arrows; False where there is none."""
    jumps, intervals = branches(points, who)
    found = [one for one in intervals if one.kind == kind and one.to_hz > 2]
    for ax, (_, _, names) in zip(axes, PANELS, strict=True):
        for one in found:
            ax.axvspan(one.from_hz, one.to_hz, color=BAND[kind], lw=0, zorder=0.4)
        for jump in jumps:
            if max(jump.from_hz, jump.to_hz) > 2:
                for quantity, sign in names.items():
                    _arrow(ax, jump, *curve(points, who, jump.direction, quantity), sign)
    return bool(found)


def _arrow(ax: Axes, jump: Jump, f: Float1D, y: Float1D, sign: int) -> None:
    start, stop = (sign * float(y[np.isclose(f, hz)][0]) for hz in (jump.from_hz, jump.to_hz))
    x = (jump.from_hz + jump.to_hz) / 2
    style = {"arrowstyle": "-|>", "color": COLOUR[jump.direction], "lw": 1.7,
             "shrinkA": 0, "shrinkB": 0}  # fmt: skip
    ax.annotate("", (x, stop), (x, start), arrowprops=style, zorder=4)


def _peaks(cases: Mapping[str, Case], axes: list[Axes]) -> None:
    """Each gap's name at its primary resonance."""
    for name, case in cases.items():
        for ax, quantity in zip(axes[:2], ("eta_d", "eta_a"), strict=True):
            curves = [curve(case.points, "twin", one, quantity) for one in DIRECTIONS]
            f, y = max(curves, key=lambda one: float(one[1].max(initial=0.0)))
            ax.annotate(
                minus(name), (f[y.argmax()], y.max()), LABEL_AT.get(name, (0, 5)),
                textcoords="offset points",
                ha="center", va="bottom", size=8, zorder=6,
                bbox={"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 0.6},
                color=OF_GAP["G∞"] if name == "G∞" else "#222222",
            )  # fmt: skip


def transition(cases: Mapping[str, Case], rig: Rig | None) -> Drawing:
    """Fig. 5: those of its gaps that are among `cases`."""
    figure, axes = _frame(cases)
    measured = rig.points if rig else {}
    colours = {name: colour for name, colour in TRANSITION.items() if name in cases}
    for name, colour in colours.items():
        case = cases[name]
        for ax, (_, _, names) in zip(axes, PANELS, strict=True):
            for quantity, sign in names.items():
                at_rest = sign * _prestress(case).get(quantity, 0.0)
                if at_rest:
                    ax.axhspan(0, at_rest, color=OFFSET, alpha=0.35, lw=0, zorder=0.3)
                    ax.axhline(at_rest, **{**AT_REST, "color": colour})
                for one in DIRECTIONS:
                    f, y = curve(case.points, "twin", one, quantity)
                    marker = "o" if rig is None else ""
                    ax.plot(f, sign * y, color=colour, ls=DASH[one], lw=1.3, marker=marker, ms=2.4)
                    f, y = curve(measured.get(name, ()), "measured", one, quantity)
                    face = colour if one == "forward" else "white"
                    ax.plot(f, sign * y, "o", mec=colour, mfc=face, ms=3.6, mew=0.9)
    for ax in axes[:2]:
        ax.set_ylim(bottom=0)
    handles = [Line2D([], [], color=c, lw=1.6, label=minus(n)) for n, c in colours.items()]
    handles += [Line2D([], [], color=GUIDE, ls=DASH[one], label=one) for one in DIRECTIONS]
    handles += [Line2D([], [], **AT_REST, label="pre-strain, pre-stress at rest")]
    figure.legend(handles=handles, loc="outside upper center", ncols=8)
    return Drawing(
        "fig05_prc" if rig is None else "rig_fig05_prc", "5", "From positive to negative gaps",
        "Forward (solid) and backward (dashed) PRCs of a η_d, b η_a, c η_j and d r_j for G4, G0, "
        "G−1, G−2 and G−10. In c and d dashed horizontal lines and grey areas show what the "
        "precompressed bumpers carry at rest. "
        + ("Dots: measured, full forward, open backward. " if rig else "")
        + _apart(cases),
        figure,
    )  # fmt: skip


def _apart(cases: Mapping[str, Case]) -> str:
    """How far G-2 and G-10 are apart, which in the paper almost coincide."""
    if not {"G-2", "G-10"} <= cases.keys():
        return ""
    (f, one), (g, other) = (
        curve(cases[name].points, "twin", "backward", "eta_d") for name in ("G-2", "G-10")
    )
    if f.shape != g.shape:
        return ""
    most = np.abs(one - other).max() / other.max()
    kinds = sorted({interval.kind for interval in branches(cases["G-2"].points, "twin")[1]})
    kept = f"; G−2 has a {' and a '.join(kinds)} hysteresis" if kinds else ""
    return (
        "In the paper the curves of G−2 and G−10 almost coincide; in the model their η_d differ by "
        f"up to {100 * most:.0f} % of the peak of G−10{kept}."
    )


def _prestress(case: Case) -> dict[str, float]:
    """eta and r of precompressed bumpers at rest: u_j / u*, F_j / (M g)."""
    weight, (u_star, _) = case.parameters.mass * GRAVITY_M_S2, case.scale
    still = case.player.at_rest()
    found = {f"eta_{side}": still[f"u_{side}"] / u_star for side in "rl"}
    found |= {f"r_{side}": still[f"f_{side}"] / weight for side in "rl"}
    return {name: size for name, size in found.items() if size > 0}
