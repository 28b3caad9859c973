"""Close-ups of a few steps: histories, phase portraits, force loops; and the look of every line.

Measured: red forward, blue backward. Twin: black, solid forward, dashed backward. The steps are
those that `evidence.chosen` picks: the middle of a hysteresis interval, the largest excursion, the
most impacts per cycle; at most four, both directions each.
"""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from twin.service.evidence import DIRECTIONS, Motion, Run, chosen, pairs

COLOUR = {"forward": "#c4161c", "backward": "#1559b0"}
DASH: dict[str, Any] = {"forward": "-", "backward": (0, (4, 1.8))}
TWIN, GUIDE = "#111111", "#555555"
AT_REST: dict[str, Any] = {"color": GUIDE, "ls": (0, (5, 3)), "lw": 0.8}
WIDTH, HISTORY_CYCLES = 10.0, 3
Drawn = Iterator[tuple[str, str, str, Figure]]


def key(run: Run, figure: Figure, *more: Line2D | Patch, marker: str = "") -> None:
    """The legend above the panels: who is which line."""
    lines: list[Line2D | Patch] = []
    driven = [one for one in DIRECTIONS if any(step["direction"] == one for step in run.steps)]
    if run.who == "measured":
        lines += [
            Line2D([], [], color=COLOUR[one], marker=marker, label=f"measured {one}")
            for one in driven
        ]
    lines += [Line2D([], [], color=TWIN, ls=DASH[one], label=f"twin {one}") for one in driven]
    figure.legend(handles=[*lines, *more], loc="outside upper center", ncols=6)


def guides(run: Run, draw: Callable[..., Any]) -> None:
    """Dashed lines where the bumpers stand."""
    if run.gaps_m is not None:
        for place in {run.gaps_m[0] * 1e3, -run.gaps_m[1] * 1e3}:
            draw(place, **AT_REST)


def histories(run: Run) -> Drawn:
    """u, a and contact forces over the last cycles, a picture a frequency (Figs. 7 and 12)."""
    for hz, why in chosen(run).items():
        both = pairs(run, hz)
        rows = 3 if run.bumpers else 2
        if not both:
            continue
        figure = Figure(figsize=(WIDTH, 1.75 * rows + 0.5))
        axes = figure.subplots(rows, len(both), sharex=True, sharey="row", squeeze=False)
        for column, (one, measured, twin) in zip(axes.T, both, strict=True):
            column[0].set_title(f"{one}, {hz:g} Hz")
            column[-1].set_xlabel("time in s")
            for data, look in ((measured, _rig(one)), (twin, _twin(one))):
                if data is not None:
                    _history(run, column, data.last(HISTORY_CYCLES), look)
            shown = twin if run.who == "twin" or measured is None else measured
            if shown is not None:
                _bands(run, column, shown.last(HISTORY_CYCLES), COLOUR[one])
            guides(run, column[0].axhline)
        labels = ("$u$ in mm", "$a$ in m/s²", "$F_R$, $F_L$ in kN")
        for ax, label in zip(axes[:, 0], labels, strict=False):
            ax.set_ylabel(label)
        key(run, figure, *_guide_key(run))
        caption = (
            "Last measured cycles. Shaded: contact, dark on the right, light on the left. "
            "The twin runs freely on the measured table acceleration; where the motion is chaotic "
            "it cannot follow sample by sample."
        )
        yield f"histories_{hz:g}hz", f"Histories at {hz:g} Hz: {why}", caption, figure


def _rig(direction: str) -> dict[str, Any]:
    """Wide, so that it shows beside a twin that lies on it."""
    return {"color": COLOUR[direction], "lw": 2.2}


def _twin(direction: str) -> dict[str, Any]:
    return {"color": TWIN, "ls": DASH[direction], "lw": 0.8}


def _guide_key(run: Run) -> list[Line2D | Patch]:
    if run.gaps_m is None:
        return []
    name = "bumper at rest" if min(run.gaps_m) >= 0 else "precompression"
    return [Line2D([], [], **AT_REST, label=name)]


def _history(run: Run, column: Any, data: Motion, look: dict[str, Any]) -> None:
    column[0].plot(data.time, data.u * 1e3, **look)
    column[1].plot(data.time, data.a, **look)
    for force in (data.force_r, data.force_l) if run.bumpers else ():
        column[2].plot(data.time, force / 1e3, **look)


def _bands(run: Run, column: Any, data: Motion, colour: str) -> None:
    """Contact phases behind every row."""
    for touch, alpha in ((data.force_r, 0.22), (-data.force_l, 0.10)):
        for ax in column:
            ax.fill_between(
                data.time, 0, 1, where=touch > run.contact_n, transform=ax.get_xaxis_transform(),
                color=colour, alpha=alpha, lw=0,
            )  # fmt: skip


def cycles(run: Run) -> Drawn:
    """Phase portraits, inertia force loops and bumper loops (Figs. 3, 6, 9 and 11)."""
    mass = run.specimen.mass_kg if run.specimen else None
    columns = {hz: both for hz in chosen(run) if (both := pairs(run, hz))}

    def portrait(ax: Axes, data: Motion, look: dict[str, Any]) -> None:
        ax.plot(data.u * 1e3, data.v * 1e3, **look)

    def inertia(ax: Axes, data: Motion, look: dict[str, Any]) -> None:
        ax.plot(data.u * 1e3, -(mass or np.nan) * data.a / 1e3, **look)

    def bumper(ax: Axes, data: Motion, look: dict[str, Any]) -> None:
        for force in (data.force_r, data.force_l):
            touching = np.abs(force) > run.contact_n
            ax.plot(data.u * 1e3, np.where(touching, force, np.nan) / 1e3, **look)

    yield from _grid(
        run, columns, portrait, ("portraits", "Phase portraits", "$u$ in mm", "$u'$ in mm/s"),
        "Relative displacement and its rate over all measured cycles. The rig does not measure "
        "u'; here it is a Savitzky-Golay derivative of u over 20 ms, for this picture only.",
    )  # fmt: skip
    if mass is not None:
        yield from _grid(
            run, columns, inertia, ("loops", "Inertia force loops", "$u$ in mm", "$F_I$ in kN"),
            "Inertia force F_I = −M a against relative displacement.",
        )  # fmt: skip
    if run.bumpers:
        yield from _grid(
            run, columns, bumper, ("bumpers", "Bumper loops", "$v_j$ in mm", "$F_j$ in kN"),
            "Contact force against bumper position, right positive, left negative. In contact the "
            "bumper stands where the mass does, v_j = u; flight is left out.",
        )  # fmt: skip


def _grid(
    run: Run,
    columns: dict[float, list[tuple[str, Motion | None, Motion | None]]],
    draw: Callable[[Axes, Motion, dict[str, Any]], None],
    names: tuple[str, str, str, str],
    caption: str,
) -> Drawn:
    """One picture: a column a frequency, a row a direction."""
    driven = [one for one in DIRECTIONS if any(one == p[0] for c in columns.values() for p in c)]
    if not driven:
        return
    figure = Figure(figsize=(WIDTH, 2.5 * len(driven) + 0.6))
    axes = figure.subplots(len(driven), max(len(columns), 3), sharex="col", squeeze=False)
    for ax in axes[:, len(columns) :].flat:
        ax.remove()
    for column, (hz, both) in zip(axes.T, columns.items(), strict=False):
        for one, measured, twin in both:
            ax = column[driven.index(one)]
            ax.axhline(0, color=GUIDE, lw=0.5)
            ax.set_title(f"{hz:g} Hz {one}")
            for data, look in ((measured, _rig(one)), (twin, _twin(one))):
                if data is not None:
                    draw(ax, data, look)
            if not any(np.isfinite(line.get_ydata()).any() for line in ax.lines[1:]):
                ax.text(0.5, 0.6, "no contact", transform=ax.transAxes, ha="center", color=GUIDE)
                ax.set_yticks([0])
            guides(run, ax.axvline)
        column[-1].set_xlabel(names[2])
    for ax in axes[:, 0]:
        ax.set_ylabel(names[3])
    key(run, figure, *_guide_key(run))
    yield names[0], names[1], caption, figure
