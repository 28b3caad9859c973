"""Pictures of a run, arranged and coloured as in Stefani, De Angelis, Andreaus, Figs. 2 to 12.

Only this file and `close_ups` draw the report with matplotlib, which is slow to import: they are
imported when somebody wants pictures, not before.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from table_io.block import Block
from twin.service.close_ups import (
    AT_REST,
    COLOUR,
    DASH,
    GUIDE,
    TWIN,
    WIDTH,
    Drawn,
    cycles,
    guides,
    histories,
    key,
)
from twin.service.evidence import DIRECTIONS, SIDES, Run, curve, envelopes, prestress, step_errors
from twin.service.level_figure import levels

MARKER = {"forward": 4.6, "backward": 2.6}  # both show where they coincide
BAND = {"right": "#fff0a8", "left": "#b9f0f4"}
OFFSET = "#d4d4d4"
LABELLED_JUMPS = 4
STYLE: dict[Any, Any] = {
    "font.size": 9, "axes.titlesize": 9.5, "axes.titlelocation": "left", "axes.linewidth": 0.7,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True,
    "grid.color": "#e4e4e4", "grid.linewidth": 0.6, "axes.axisbelow": True, "savefig.dpi": 150,
    "legend.frameon": False, "lines.linewidth": 1.1, "lines.markersize": 3.6,
    "figure.constrained_layout.use": True, "figure.constrained_layout.hspace": 0.06,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Picture:
    """A PNG file, its title and the caption that belongs under it."""

    path: Path
    title: str
    caption: str


def draw_all(run: Run, folder: Path) -> list[Picture]:
    """The pictures that this run can give, as PNG files in `folder`, in the order of the report."""
    folder.mkdir(parents=True, exist_ok=True)
    for stale in folder.glob("histories_*hz.png"):
        stale.unlink()
    pictures = []
    with mpl.rc_context(STYLE):
        for draw in (_curves, _impacts, histories, cycles, _errors, _overview, levels):
            for name, title, caption, figure in draw(run):
                figure.savefig(folder / f"{name}.png")
                pictures.append(Picture(folder / f"{name}.png", title, caption))
    return pictures


def _mirrored(ax: Axes) -> None:
    """Right above the axis, left below it, both read as positive numbers."""
    ax.axhline(0, color="#333333", lw=0.7)
    ax.yaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")
    for y, va, text in ((0.98, "top", "right"), (0.02, "bottom", "left")):
        ax.text(0.99, y, text, transform=ax.transAxes, ha="right", va=va, color=GUIDE)


def _curves(run: Run) -> Drawn:
    """Pseudo-resonance curves (Figs. 2 and 11)."""
    panels = [
        (r"$\eta_d$, relative displacement", {"eta_d": 1}),
        (r"$\eta_a$, total acceleration", {"eta_a": 1}),
    ]
    if run.bumpers:
        panels += [
            (r"$\eta_j$, bumper deformation", {"eta_r": 1, "eta_l": -1}),
            (r"$r_j$, contact force over weight", {"r_r": 1, "r_l": -1}),
        ]
    if not any(np.isfinite(curve(run, run.who, one, "eta_d")[1]).any() for one in DIRECTIONS):
        return
    figure = Figure(figsize=(WIDTH, 3.6 * len(panels) / 2 + 0.3))
    axes = figure.subplots(len(panels) // 2, 2, sharex=True, squeeze=False)
    intervals = run.summary.get("hysteresis") or []
    at_rest = prestress(run)
    for ax, (label, names) in zip(axes.flat, panels, strict=True):
        for one in intervals:
            ax.axvspan(one["from_hz"], one["to_hz"], color=BAND[one["kind"]], lw=0)
        for name, sign in names.items():
            _offset(ax, sign * at_rest.get(name, 0.0))
            _prc_lines(run, ax, name, sign)
            _jumps(run, ax, name, sign)
        ax.set_ylabel(label)
        if len(names) == 2:
            _mirrored(ax)
        else:
            ax.set_ylim(bottom=0)
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    kinds = sorted({one["kind"] for one in intervals})
    patches = [Patch(color=BAND[kind], label=f"{kind} hysteresis") for kind in kinds]
    if at_rest:
        patches.append(Patch(fc=OFFSET, ec=GUIDE, ls="--", lw=0.8, label="precompression"))
    key(run, figure, *patches, marker="o")
    caption = (
        "Per frequency step, on its steady cycles. Arrows mark jumps, between the two grid "
        "frequencies they lie between. Displacement, deformation and acceleration are divided by "
        "the free-flight maxima u*, a*; forces by the weight."
    )
    if at_rest:
        caption += " Grey: deformation and force of a precompressed bumper at rest, by the model."
    yield "prc", "Pseudo-resonance curves", caption, figure


def _offset(ax: Axes, y: float) -> None:
    """Grey from the frequency axis to what a precompressed bumper carries at rest (Fig. 5)."""
    if y:
        ax.axhspan(0, y, color=OFFSET, lw=0)
        ax.axhline(y, **AT_REST)


def _prc_lines(run: Run, ax: Axes, name: str, sign: int) -> None:
    for one in DIRECTIONS:
        f, y = curve(run, "measured", one, name)
        ax.plot(f, sign * y, "o-", color=COLOUR[one], ms=MARKER[one], lw=2.2)
    for one in DIRECTIONS:
        f, y = curve(run, "twin", one, name)
        ax.plot(f, sign * y, color=TWIN, ls=DASH[one], lw=0.8, marker="." if f.size == 1 else "")


def _jumps(run: Run, ax: Axes, name: str, sign: int) -> None:
    jumps = run.summary.get("jumps") or []
    for number, jump in enumerate(jumps, 1):
        f, y = curve(run, run.who, jump["direction"], name)
        ends = [y[np.isclose(f, jump[end])] for end in ("from_hz", "to_hz")]
        if not all(end.size and np.isfinite(end[0]) for end in ends):
            continue
        x, (start, stop) = (jump["from_hz"] + jump["to_hz"]) / 2, (sign * end[0] for end in ends)
        colour = COLOUR[jump["direction"]]
        style = {"arrowstyle": "-|>", "color": colour, "lw": 1.6, "shrinkA": 0, "shrinkB": 0}
        ax.annotate("", (x, stop), (x, start), arrowprops=style)
        if name == "eta_d":
            few = len(jumps) <= LABELLED_JUMPS
            low, high = sorted((jump["from_hz"], jump["to_hz"]))
            text = f"{low:g}–{high:g} Hz" if few else f"{number}"
            right = jump["to_hz"] >= jump["from_hz"] and x < f[0] + 0.85 * (f[-1] - f[0])
            ax.annotate(
                text, (x, (start + stop) / 2), (5 if right else -5, 0), color=colour, size=8,
                textcoords="offset points", ha="left" if right else "right", va="center",
                bbox={"facecolor": "white", "alpha": 0.85, "lw": 0, "pad": 1}, zorder=5,
            )  # fmt: skip


def _impacts(run: Run) -> Drawn:
    """Impacts per forcing cycle of both sides, one row a direction."""
    driven = [one for one in DIRECTIONS if curve(run, run.who, one, SIDES[0])[0].size]
    found = [curve(run, run.who, one, side)[1] for one in driven for side in SIDES]
    if not run.bumpers or not any(np.isfinite(one).any() for one in found):
        return
    figure = Figure(figsize=(WIDTH, 2.3 * len(driven) + 0.4))
    rows = figure.subplots(len(driven), 1, sharex=True, sharey=True, squeeze=False)[:, 0]
    for ax, one in zip(rows, driven, strict=True):
        for side, sign in zip(SIDES, (1, -1), strict=True):
            f, y = curve(run, "measured", one, side)
            ax.vlines(f, 0, sign * y, color=COLOUR[one], lw=3, alpha=0.35)
            ax.plot(f, sign * y, "o", color=COLOUR[one])
            f, y = curve(run, "twin", one, side)
            ax.plot(f, sign * y, "o", ms=6.5, mfc="none", mec=TWIN, mew=0.8)
        ax.set_ylabel("impacts per cycle")
        ax.set_title(one)
        ax.yaxis.set_major_locator(MaxNLocator(integer=True))
        _mirrored(ax)
    rows[-1].set_xlabel("frequency in Hz")
    handles = [Line2D([], [], color=TWIN, marker="o", ms=6.5, mfc="none", ls="", label="twin")]
    if run.who == "measured":
        handles += [
            Line2D([], [], color=COLOUR[one], marker="o", label=f"measured {one}") for one in driven
        ]
    figure.legend(handles=handles, loc="outside upper center", ncols=3)
    caption = (
        "Mean over the steady cycles of a step; between whole numbers the count changes from cycle "
        "to cycle."
    )
    yield "impacts", "Impacts per forcing cycle", caption, figure


def _errors(run: Run) -> Drawn:
    """NRMSE of the free-running and of the restarted twin over frequency."""
    errors = {
        part: found
        for part, found in step_errors(run).items()
        if np.isfinite(list(found.values())).any()
    }
    if not errors:
        return
    figure = Figure(figsize=(WIDTH, 2.5 * ((len(errors) + 1) // 2) + 0.4))
    axes = figure.subplots((len(errors) + 1) // 2, 2, sharex=True, sharey=True, squeeze=False)
    for ax, (part, found) in zip(axes.flat, errors.items(), strict=False):
        for one in DIRECTIONS:
            steps = [s for s in run.steps if s["direction"] == one and s["index"] in found]
            f = [step["frequency_hz"] for step in steps]
            both = np.array([found[step["index"]] for step in steps]).reshape(-1, 2)
            ax.semilogy(f, both[:, 0], "o-", color=COLOUR[one], lw=0.9)
            ax.semilogy(f, both[:, 1], "o:", color=COLOUR[one], lw=0.9, mfc="white")
        ax.set_title(f"${part}$")
    for ax in axes[:, 0]:
        ax.set_ylabel("NRMSE")
    for ax in axes[-1]:
        ax.set_xlabel("frequency in Hz")
    handles = [
        Line2D([], [], color=COLOUR[one], marker="o", ls=ls, mfc=face, label=f"{who}, {one}")
        for one in DIRECTIONS
        for who, ls, face in (("free-running", "-", COLOUR[one]), ("restarted", ":", "white"))
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    caption = (
        "Root mean square error over root mean square measurement, on the measured cycles of each "
        "step; 1 is as bad as predicting nothing. The restarted twin begins anew from the measured "
        "state every window. Contact forces only where there was contact."
    )
    yield "comparison", "Twin against measurement", caption, figure


def _overview(run: Run) -> Drawn:
    """Envelopes of table and mass over the whole run, the steps shaded."""
    pieces, drawn = envelopes(run)
    if not drawn:
        return
    figure = Figure(figsize=(WIDTH, 1.7 * len(drawn) + 0.4))
    axes = figure.subplots(len(drawn), 1, sharex=True, squeeze=False)[:, 0]
    peaks = {step.acceleration_m_s2 for step in run.recording.start.steps}
    for ax, (label, found) in zip(axes, drawn.items(), strict=True):
        for time, low, high in found:
            ax.fill_between(time, low, high, color="#8b929c", lw=0)
        ax.set_ylabel(label)
        _shade_steps(run, ax, pieces, ax is axes[0])
        if label.startswith("$u$"):
            guides(run, ax.axhline)
        for peak in peaks if label == "table in m/s²" else ():
            ax.axhline(peak, color="#111111", ls="--", lw=0.9)
            ax.axhline(-peak, color="#111111", ls="--", lw=0.9)
    axes[-1].set_xlabel("time in s")
    axes[-1].set_xlim(pieces[0].time_s[0], pieces[-1].time_s[-1])
    caption = (
        "Envelopes. The steps are shaded in turn, red forward, blue backward; numbers on top are "
        "their frequencies in Hz. Dashed: demanded peak acceleration, and the bumpers at rest."
    )
    yield "overview", "The drive and the answer", caption, figure


def _shade_steps(run: Run, ax: Axes, pieces: tuple[Block, ...], numbered: bool) -> None:
    visits = run.summary.get("visits") or []
    direction = {step["index"]: step for step in (*run.steps, *visits)}
    total = pieces[-1].time_s[-1] - pieces[0].time_s[0]
    free_from = 0.0
    for piece in pieces:
        cuts = np.flatnonzero(np.diff(piece.step)) + 1
        for first, last in zip([0, *cuts], [*cuts, len(piece)], strict=True):
            step = direction.get(int(piece.step[first]))
            if step is None:
                continue
            start, stop = piece.time_s[first], piece.time_s[last - 1]
            shade = 0.20 if step["index"] % 2 else 0.09
            ax.axvspan(start, stop, color=COLOUR[step["direction"]], alpha=shade, lw=0, zorder=0)
            if numbered and start >= free_from:
                middle = (start + stop) / 2
                ax.annotate(
                    f"{step['frequency_hz']:g}", (middle, 1.02), xycoords=("data", "axes fraction"),
                    ha="center", size=8, color=GUIDE,
                )  # fmt: skip
                free_from = start + total / 22
