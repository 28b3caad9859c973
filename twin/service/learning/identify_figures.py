"""Pictures of an identification: each law against what was measured, and the estimates apart."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.learn.guess import ZERO
from twin.learn.identify import Identified
from twin.learn.parts import local_gap
from twin.learn.sheet import Sheet
from twin.service.close_ups import COLOUR, GUIDE, TWIN, WIDTH
from twin.service.figures import STYLE
from twin.service.learning.told import SURE

MOST = 6000  # points of a cloud
CLOUD = {"ls": "", "marker": ".", "ms": 1.6, "mew": 0, "alpha": 0.6, "rasterized": True}
SIDE = {"right": COLOUR["forward"], "left": COLOUR["backward"]}


def draw(found: Identified, folder: Path) -> None:
    """laws<log>.png, correlation.png and sources.png in the folder."""
    with mpl.rc_context(STYLE):
        for sheet in found.bench.sheets:
            _laws(found, sheet).savefig(folder / f"laws{sheet.number}.png")
        _correlation(found).savefig(folder / "correlation.png")
        if found.parts:
            _sources(found).savefig(folder / "sources.png")


def _laws(found: Identified, sheet: Sheet) -> Figure:
    """Damper over u and over u', bumpers over depth, onsets against the gap."""
    figure = Figure(figsize=(WIDTH, 7.0))
    figure.suptitle(sheet.readings.name, x=0.01, ha="left", fontsize=10)
    (over_u, over_v), (bumper, places) = figure.subplots(2, 2)
    _damper(found, sheet, over_u, over_v)
    _bumpers(found, sheet, bumper)
    _places(found, sheet, places)
    return figure


def _thin(mask: np.ndarray) -> np.ndarray:
    chosen = np.flatnonzero(mask)
    return chosen[:: max(chosen.size // MOST, 1)]


def _damper(found: Identified, sheet: Sheet, over_u: Axes, over_v: Axes) -> None:
    m = sheet.motion(found.fit.guess.sensors())
    p = found.fit.guess.local(sheet.number, m).parameters
    cells = (m.right - m.left) if m.cells else 0.0
    force = m.damper if m.damper is not None else -m.mass_kg * m.acc - cells
    at = _thin(m.moving & np.isfinite(force))
    u, v = m.u[at], m.v[at]
    for ax, x, rest, slope, label in (
        (over_u, 1e3 * u, force[at] - p.damping * v, 1e-3 * p.stiffness, "K u"),
        (over_v, v, force[at] - p.stiffness * u, p.damping, "C u'"),
    ):
        ax.plot(x, rest, color=COLOUR["backward"], **CLOUD)  # type: ignore[arg-type]
        ends = np.array([x.min(), x.max()])
        ax.plot(ends, slope * ends, color=TWIN, lw=1, label=label)
        ax.legend(loc="upper left")
    over_u.set(xlabel="u in mm", ylabel="D − C u' in N", title="damper: spring")
    over_v.set(xlabel="u' in m/s", ylabel="D − K u in N", title="damper: dashpot")


def _bumpers(found: Identified, sheet: Sheet, ax: Axes) -> None:
    m = sheet.motion(found.fit.guess.sensors())
    p = found.fit.guess.local(sheet.number, m).parameters
    deepest = 0.0
    for side, sign, k, c, force, row in (
        ("right", 1, p.bumper_stiffness_r, p.bumper_damping_r, m.right, 0),
        ("left", -1, p.bumper_stiffness_l, p.bumper_damping_l, m.left, 1),
    ):
        at = _thin(m.moving & (sheet.touched[row] > 0))
        if not at.size:
            continue
        depth = sign * m.u[at] - local_gap(sheet, found.fit, side)
        ax.plot(1e3 * depth, force[at], color=SIDE[side], **CLOUD | {"ms": 3.2})  # type: ignore[arg-type]
        law = k * depth + c * sign * m.v[at]
        ax.plot(1e3 * depth, law, color=TWIN, **CLOUD | {"ms": 0.8})  # type: ignore[arg-type]
        ax.plot([], [], ".", color=SIDE[side], label=f"{side}, measured")
        deepest = max(deepest, float(depth.max()))
    if deepest:
        line = np.array([0.0, deepest])
        ax.plot(
            1e3 * line, p.bumper_stiffness_r * line, color=GUIDE, ls="--", lw=0.9, label="K_j u_j"
        )
        ax.plot([], [], ".", color=TWIN, label="law at the same samples")
        ax.legend(loc="upper left")
    else:
        ax.text(0.5, 0.5, "no contact was measured", ha="center", transform=ax.transAxes)
    ax.set(xlabel="depth in mm", ylabel="F_j in N", title="bumpers")


def _places(found: Identified, sheet: Sheet, ax: Axes) -> None:
    mine = [one for one in found.onsets if one.log == sheet.number]
    for one in mine:
        middle, width = one.value, max(5 * one.scatter, 1e-6)
        near = one.gaps[np.abs(one.gaps - middle) < width]
        onset = one.kind == "onset"
        ax.hist(
            1e3 * near, 30, histtype="stepfilled" if onset else "step", color=SIDE[one.side],
            alpha=0.45 if onset else 1.0, label=f"{one.side} {one.kind}s, {one.gaps.size}",
        )  # fmt: skip
    for side in ("right", "left"):
        gap = 1e3 * local_gap(sheet, found.fit, side)
        if np.isfinite(gap) and mine:
            ax.axvline(gap, color=SIDE[side], ls="--" if side == "left" else "-", lw=1.2)
    if mine:
        ax.legend(loc="upper left", fontsize=7)
    else:
        ax.text(0.5, 0.5, "no onset was measured", ha="center", transform=ax.transAxes)
    ax.set(
        xlabel="gap of a side in mm", ylabel="contacts", title="onsets and releases; lines: the fit"
    )


def _correlation(found: Identified) -> Figure:
    keep = [k for k, one in enumerate(found.fit.free) if not one.name.startswith(ZERO)]
    names = [found.fit.free[k].name for k in keep]
    matrix = found.fit.correlation[np.ix_(keep, keep)]
    figure = Figure(figsize=(0.55 * len(keep) + 3.2, 0.55 * len(keep) + 2.2))
    ax = figure.subplots()
    ax.imshow(matrix, cmap="RdBu_r", vmin=-1, vmax=1)
    ax.grid(False)
    ax.set_xticks(range(len(keep)), names, rotation=45, ha="right")
    ax.set_yticks(range(len(keep)), names)
    for (i, k), value in np.ndenumerate(matrix):
        ax.text(k, i, f"{value:+.2f}", ha="center", va="center", fontsize=7,
                color="white" if abs(value) > 0.6 else TWIN)  # fmt: skip
    ax.set_title("correlation of the estimates")
    return figure


def _sources(found: Identified) -> Figure:
    """Each parameter from each part with its 95 % interval; the band is that of the joint fit."""
    free = [one for one in found.fit.free if any(one.name in p.values for p in found.parts)]
    figure = Figure(figsize=(WIDTH, 0.28 * len(found.parts) + 1.6))
    axes = figure.subplots(1, len(free), sharey=True, squeeze=False)[0]
    for ax, one in zip(axes, free, strict=True):
        scale = 1e3 if one.unit == "m" else 1.0
        value, sd = found.fit.values[one.name], found.fit.spread[one.name]
        ax.axvspan(scale * (value - SURE * sd), scale * (value + SURE * sd), color="#d4d4d4", lw=0)
        ax.axvline(scale * value, color=GUIDE, lw=0.9)
        for row, part in enumerate(found.parts):
            if one.name in part.values:
                x, sx = part.values[one.name]
                ax.errorbar(scale * x, row, xerr=scale * SURE * sx, fmt="o", color=TWIN, ms=3, lw=1)
        ax.set_title(f"{one.name}\nin {'mm' if one.unit == 'm' else one.unit}", fontsize=8)
        ax.tick_params(axis="x", labelrotation=45, labelsize=7)
    axes[0].set_yticks(range(len(found.parts)), [part.source for part in found.parts])
    axes[0].invert_yaxis()
    return figure
