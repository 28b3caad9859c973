"""Close-ups of forces: what the model lacks as loops over u, u' and depth, and histories.

Measured in the colour of the direction, the law or the model in black.
"""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from twin.learn.guess import Guess
from twin.learn.sheet import Sheet
from twin.service.close_ups import COLOUR, GUIDE, TWIN, WIDTH, Drawn
from twin.service.learning.figures_evidence import (
    Look,
    Shown,
    is_force,
    looks,
    measured_forces,
    spread,
)

LEFT_SIDE = "#1559b0"  # of a bumper loop; the right side is red
Curve = tuple[Float1D, Float1D]


def forces(shown: Shown) -> Drawn:
    """Residual damper force over u and u', residual bumper forces over depth, before and after."""
    sheet, steps = shown.sheets[shown.worst], shown.steps(shown.worst)
    damper = _damper(shown, sheet, looks(sheet, steps, 0))
    sides = [row for row in (1, 2) if (sheet.row_of == row).any()]
    stretches = {one.title: one for row in sides for one in looks(sheet, steps, row)}
    bumpers = _bumpers(shown, sheet, sides, list(stretches.values())[:4])
    missing = np.nan_to_num(_entries(shown)[1]) ** 2
    there = missing[sheet.row_of == 0].sum() < missing[np.isin(sheet.row_of, sides)].sum()
    for drawn in (bumpers, damper) if there else (damper, bumpers):
        yield from drawn


def _entries(shown: Shown) -> tuple[Float1D, Float1D, Float1D]:
    """(measured less the model without what was found, the law, what is left), (entry,).

    Where nothing was found the first is that of the model alone, and the law is NaN.
    """
    if shown.delivered is not None:
        return shown.delivered
    before, after = (one.left[shown.worst] for one in shown.pair)
    return before, np.full_like(before, np.nan), after


def _guess(shown: Shown) -> Guess:
    """The one that the entries are of."""
    return (shown.law or shown.pair[0]).fit.guess


def _caption(shown: Shown) -> str:
    if shown.law is None:
        return "What the model leaves of the measured force: nothing was found to put in its place."
    return (
        f"Left of each pair: measured force less that of the model without {shown.law_name}, and "
        f"in black the law that was fitted. Right: what is left with it, on the same scale."
    )


def _damper(shown: Shown, sheet: Sheet, stretches: list[Look]) -> Drawn:
    if not stretches:
        return
    m, no_law = sheet.motion(), np.full(sheet.readings.time_s.size, np.nan)
    wanted, law, left = (spread(sheet, 0, one, _guess(shown)) for one in _entries(shown))
    u, v = ("$u$ in mm", 1e3 * m.u), ("$u'$ in mm/s", 1e3 * m.v)
    columns = [(*u, wanted, law), (*u, left, no_law), (*v, wanted, law), (*v, left, no_law)]
    figure = Figure(figsize=(WIDTH, 2.2 * len(stretches) + 0.6))
    axes = figure.subplots(len(stretches), 4, sharey="row", squeeze=False)
    for line, look in zip(axes, stretches, strict=True):
        for ax, (_, x, y, drawn) in zip(line, columns, strict=True):
            _loop(ax, (x[look.samples], y[look.samples]), COLOUR[look.direction])
            ax.plot(x[look.samples], drawn[look.samples], color=TWIN, lw=0.8)
        line[0].set_title(look.title)
        line[0].set_ylabel(_unit(sheet, "damper"))
    for ax, text in zip(axes[0], ("before", "after", "before", "after"), strict=True):
        ax.set_title(text, loc="right", color=GUIDE)
    for ax, (label, *_) in zip(axes[-1], columns, strict=True):
        ax.set_xlabel(label)
    _legend(figure, shown, [("measured less model", COLOUR["forward"])])
    yield "damper_force", "Damper force, measured less model", _caption(shown), figure


def _bumpers(shown: Shown, sheet: Sheet, sides: list[int], stretches: list[Look]) -> Drawn:
    if not stretches:
        return
    m, entries, guess = sheet.motion(), _entries(shown), _guess(shown)
    figure = Figure(figsize=(WIDTH, 2.2 * (2 if len(stretches) > 2 else 1) + 0.6))
    axes = figure.subplots(-(-len(stretches) // 2), 4, sharey="row", squeeze=False)
    pairs = axes.reshape(-1, 2)
    for ax in pairs[len(stretches) :].flat:
        ax.remove()
    for pair, look in zip(pairs, stretches, strict=False):
        for row in sides:
            depth = 1e3 * ((m.u, -m.u)[row - 1] - m.gaps_m[row - 1])
            wanted, law, left = (spread(sheet, row, one, guess)[look.samples] for one in entries)
            colour = (COLOUR["forward"], LEFT_SIDE)[row - 1]
            x = depth[look.samples]
            for ax, y in zip(pair, (wanted, left), strict=True):
                _loop(ax, (x, y), colour)
            pair[0].plot(x, law, color=TWIN, lw=0.8, ls="-" if row == 1 else "--")
        pair[0].set_title(look.title)
        pair[0].set_ylabel("force in N")
        for ax, text in zip(pair, ("before", "after"), strict=True):
            ax.set_title(text, loc="right", color=GUIDE)
            ax.set_xlabel("depth in mm")
    names = [("right bumper", COLOUR["forward"]), ("left bumper", LEFT_SIDE)]
    _legend(figure, shown, [names[row - 1] for row in sides])
    caption = f"{_caption(shown)} Depth: u beyond the gap that the log states."
    yield "bumper_force", "Bumper forces, measured less model", caption, figure


def _loop(ax: Axes, curve: Curve, colour: str) -> None:
    ax.axhline(0, color=GUIDE, lw=0.6)
    ax.plot(*curve, ".", color=colour, ms=3.2, alpha=0.6, mew=0)


def _unit(sheet: Sheet, row: str) -> str:
    return "force in N" if is_force(sheet, 0) else f"{row} force over its noise"


def _legend(figure: Figure, shown: Shown, dots: list[tuple[str, str]]) -> None:
    handles = [
        Line2D([], [], color=colour, marker=".", ls="", ms=7, label=text) for text, colour in dots
    ]
    if shown.law is not None:
        handles.append(Line2D([], [], color=TWIN, label=shown.law_name.removeprefix("general.")))
    figure.legend(handles=handles, loc="outside upper center", ncols=4)


def histories(shown: Shown) -> Drawn:
    """Forces over two cycles at the step with most to gain, measured and model, held out."""
    sheet = shown.sheets[shown.worst]
    picked = _worst_look(shown, sheet)
    if picked is None or not is_force(sheet, 0):
        return
    there = sheet.row_of[np.isin(sheet.sample_of, picked.samples)]
    rows = [row for row in range(3) if (there == row).any()]
    m, k = sheet.motion(), picked.samples
    t = m.time_s[k] - m.time_s[k[0]]
    figure = Figure(figsize=(WIDTH, 1.8 * len(rows) + 0.6))
    axes = figure.subplots(len(rows), 2, sharex=True, sharey="row", squeeze=False)
    names = ("damper", "right bumper", "left bumper")
    for column, (one, title) in enumerate(zip(shown.pair, ("before", "after"), strict=True)):
        for ax, row in zip(axes[:, column], rows, strict=True):
            measured = measured_forces(sheet, one.fit.guess)
            away = spread(sheet, row, one.left[shown.worst], one.fit.guess)
            ax.plot(t, measured[row][k], color=COLOUR[picked.direction], lw=2.2)
            model: dict[str, Any] = {"color": TWIN, "lw": 0.9}
            ax.plot(t, (measured[row] - away)[k], **model)
            ax.set_ylabel(f"{names[row]} in N" if column == 0 else "")
        axes[0, column].set_title(f"{title}, {picked.title}")
        axes[-1, column].set_xlabel("time in s")
    handles = [
        Line2D([], [], color=COLOUR[picked.direction], lw=2.2, label="measured"),
        Line2D([], [], color=TWIN, lw=0.9, label="model along the measured motion"),
    ]
    figure.legend(handles=handles, loc="outside upper center", ncols=2)
    caption = (
        "Where most was to be gained. The model's parameters are those of the fit in which these "
        "samples were left out. No line where a sample does not count: at touch and release, and "
        "where nothing was touched."
    )
    yield "histories", "Forces in time, held out", caption, figure


def _worst_look(shown: Shown, sheet: Sheet) -> Look | None:
    """Of the close-ups of all force rows the one with the largest gain, else the largest rest."""
    steps = shown.steps(shown.worst)
    every = [look for row in range(3) if sheet.used[row].any() for look in looks(sheet, steps, row)]
    before, after = (one.left[shown.worst] for one in shown.pair)
    gain = before**2 - after**2 if shown.pair[1].effects else before**2

    def gained(look: Look) -> float:
        return float(gain[np.isin(sheet.sample_of, look.samples)].sum()) / look.samples.size

    return max(every, key=gained, default=None)
