"""G4 against frequency (Fig. 11) and its histories (Fig. 12): model, or model and rig."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twin.service.paper.cases import Case, curve
from twin.service.paper.look import (
    AT_REST,
    COLOUR,
    DIRECTIONS,
    GUIDE,
    TWIN,
    Drawing,
    Drawings,
    contact_bands,
    directions_key,
    ink,
    letter,
    mass_loop,
    obstacles,
    pen,
    portrait,
)
from twin.service.paper.players import Motion
from twin.service.paper.rig import Rig
from twin.service.paper.study import CLOSE_HZ, Study

NAME, CYCLES = "G4", 3
HISTORIES_HZ = (0.53, 1.4, 3.4)
LETTERS = "cdefghijklmnopqrstuv"


def draw(found: Study, rig: Rig | None) -> Drawings:
    """Figs. 11 and 12."""
    if rig is not None and NAME not in rig.runs:
        return
    yield _frequencies(found.cases[NAME], rig)
    yield _histories(found.cases[NAME], rig)


def _key(rig: Rig | None) -> list[Line2D]:
    lines = directions_key(ink, "model, ")
    if rig is not None:
        lines = directions_key(pen, "rig, ") + lines
    return lines


def _frequencies(case: Case, rig: Rig | None) -> Drawing:
    figure = Figure(figsize=(15, 14))
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1, 3))[:, 0]
    for ax, which, name in zip(top.subplots(1, 2), "ab", ("eta_a", "eta_d"), strict=True):
        _curve(ax, case, rig, name)
        letter(ax, which)
    axes = bottom.subplots(4, len(CLOSE_HZ))
    for column, hz in zip(axes.T, CLOSE_HZ, strict=True):
        for one in DIRECTIONS:
            motion, seen = case.motion(hz, one, CYCLES), None
            if rig is not None:
                seen = rig.motion(NAME, hz, one, CYCLES)
                if seen is not None:
                    _pair(column, 0, seen[0], case, pen(one))
                _pair(column, 1, motion, case, ink(one))
            else:
                _pair(column, DIRECTIONS.index(one), motion, case, ink(one))
    who = ("rig", "model") if rig is not None else DIRECTIONS
    for place, ax in enumerate(axes.flat):
        row, column_ = divmod(place, len(CLOSE_HZ))
        if not ax.lines:
            ax.text(0.5, 0.7, "not measured", transform=ax.transAxes, ha="center", color=GUIDE)
        letter(ax, LETTERS[place], f"{CLOSE_HZ[column_]:g} Hz, {who[row % 2]}")
        obstacles(case.parameters, ax.axvline)
        ax.axhline(0, color=GUIDE, lw=0.5, zorder=0.6)
        ax.set_xlabel("$u$ in mm" if row == 3 else "")
        if column_ == 0:
            ax.set_ylabel("$u'$ in mm/s" if row < 2 else "$F_I$ in kN")
    _alike(axes)
    figure.legend(handles=_key(rig), loc="outside upper center", ncols=4)
    return Drawing(
        "fig11_g4" if rig is None else "rig_fig11_g4", "11", "G4 against frequency",
        "PRCs of a η_a and b η_d; vertical dashed lines mark 0.53, 0.71, 1.1, 1.4 and 3.4 Hz, the "
        "columns below: c–l phase portraits, m–v inertia force against u, over the last three "
        "cycles of the step. "
        + ("Red and blue: rig, forward and backward; black: model. " if rig else
           "Solid: forward; dashed: backward, in the row below. ")
        + "Vertical dashed lines: the gap. Where the motion is chaotic, its kind and its extent "
        "compare, not the single cycle.",
        figure,
    )  # fmt: skip


def _alike(axes: Any) -> None:
    """The two rows that show the same have the same scales."""
    for upper, lower in ((0, 1), (2, 3)):
        for one, other in zip(axes[upper], axes[lower], strict=True):
            for get, put in (("get_xlim", "set_xlim"), ("get_ylim", "set_ylim")):
                (a, b), (c, d) = getattr(one, get)(), getattr(other, get)()
                if one.lines and other.lines:
                    getattr(one, put)(min(a, c), max(b, d))
                    getattr(other, put)(min(a, c), max(b, d))


def _pair(column: Any, row: int, motion: Motion, case: Case, look: dict[str, Any]) -> None:
    portrait(column[row], motion, **look)
    mass_loop(column[2 + row], motion, case.parameters.mass, False, **look)


def _curve(ax: Axes, case: Case, rig: Rig | None, name: str) -> None:
    for one in DIRECTIONS:
        if rig is not None:
            f, y = curve(rig.points[NAME], "measured", one, name)
            ax.plot(f, y, "o", color=COLOUR[one], ms=4.6 if one == "forward" else 2.8, mew=0)
        f, y = curve(case.points, "twin", one, name)
        ax.plot(f, y, **ink(one, 1.3))
    for hz in CLOSE_HZ:
        ax.axvline(hz, **AT_REST)
        ax.annotate(
            f"{hz:g} Hz", (hz, 1.0), (2, -2), xycoords=("data", "axes fraction"), size=7.5,
            textcoords="offset points", ha="left", va="top", rotation=90, color=GUIDE,
        )  # fmt: skip
    ax.set_xlim(0.4, 5.05)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("$f$ in Hz")
    ax.set_ylabel(rf"$\eta_{name[-1]}$")


def _histories(case: Case, rig: Rig | None) -> Drawing:
    figure = Figure(figsize=(15, 8.6))
    axes = figure.subplots(3, len(HISTORIES_HZ), sharex="col", sharey="row")
    for number, (column, hz) in enumerate(zip(axes.T, HISTORIES_HZ, strict=True)):
        for one in DIRECTIONS:
            seen = rig.motion(NAME, hz, one, CYCLES) if rig is not None else None
            if seen is not None:
                _history(column, seen[0], pen(one, 2.0))
            motion = case.motion(hz, one, CYCLES)
            _history(column, motion, ink(one, 1.0))
            for ax in column if one == "forward" else ():
                contact_bands(ax, motion, TWIN, alpha=0.07)
        letter(column[0], "abc"[number], f"$f$ = {hz:g} Hz")
        obstacles(case.parameters, column[0].axhline)
        column[-1].set_xlabel("$t$ in s")
        column[-1].set_xlim(0, (CYCLES - (rig is not None)) / hz)
    for ax, label in zip(axes[:, 0], ("$u$ in mm", "$a$ in m/s²", "$F_j$ in kN"), strict=True):
        ax.set_ylabel(label)
    figure.legend(handles=_key(rig), loc="outside upper center", ncols=4)
    return Drawing(
        "fig12_histories" if rig is None else "rig_fig12_histories", "12", "Histories of G4",
        "Relative displacement, total acceleration and contact forces over the last three cycles "
        "of the step at a 0.53 Hz, b 1.4 Hz, c 3.4 Hz, from a zero upcrossing of the table's "
        "acceleration. Black: model" + ("; red and blue: rig" if rig else "") + ". Grey bands: "
        "contacts of the model, forward. Dashed in the first row: the gap. In chaos no two records "
        "agree cycle by cycle, and at 1.4 Hz history picks the side that is hit twice.",
        figure,
    )  # fmt: skip


def _history(column: Any, motion: Motion, look: dict[str, Any]) -> None:
    column[0].plot(motion.time, motion.u * 1e3, **look)
    column[1].plot(motion.time, motion.a, **look)
    for force in (motion.force_r, motion.force_l):
        column[2].plot(motion.time, force / 1e3, **look)
