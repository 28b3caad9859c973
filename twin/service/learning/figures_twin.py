"""The twin running free before and after, beside the measurement: PRCs and impacts per cycle."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from table_io.block import Float1D
from table_io.records import Point
from twin.service.close_ups import COLOUR, DASH, TWIN, WIDTH, Drawn
from twin.service.evidence import DIRECTIONS
from twin.service.learning.figures_evidence import Shown
from twin.service.learning.running_free import Runs

LABELS = {
    "eta_d": r"$\eta_d$, displacement", "eta_a": r"$\eta_a$, acceleration",
    "impacts_right": "impacts right", "impacts_left": "impacts left",
}  # fmt: skip


def curves(shown: Shown, runs: dict[int, Runs], chosen: Sequence[int]) -> Drawn:
    """PRCs and impacts of the chosen logs, before left, after right."""
    for number in chosen:
        if number in runs:
            yield from _of_log(shown, runs[number], number)


def _of_log(shown: Shown, runs: Runs, number: int) -> Drawn:
    name = shown.of_log(number)
    stem = f"_{number}" if name else ""
    caption = (
        "Per step, on its steady cycles. The twin runs freely from the first sample on, on the "
        "measured table acceleration, with the parameters fitted on all steps. In chaotic bands "
        "neither can follow the other's trajectory; sizes compare, samples do not."
    )
    figure = _figure(runs, ["eta_d", "eta_a"])
    yield f"prc{stem}", f"Pseudo-resonance curves, measured and by the twin{name}", caption, figure
    sides = ["impacts_right", "impacts_left"]
    if any(_curve(runs[0], "measured", way, one)[1].any() for way in DIRECTIONS for one in sides):
        caption = "Mean over the steady cycles of a step, from the load cells, and by the twin."
        title = f"Impacts per forcing cycle{name}"
        yield f"impacts{stem}", title, caption, _figure(runs, sides)


def _curve(points: Sequence[Point], who: str, direction: str, name: str) -> tuple[Float1D, Float1D]:
    """(frequency in Hz, quantity) of one direction, upwards."""
    found = []
    for one in points:
        known = getattr(one, who)
        value = getattr(known, name) if known is not None else np.nan
        if one.direction == direction:
            found.append((one.frequency_hz, float(np.mean(value)) if np.size(value) else np.nan))
    table = np.array(sorted(found), dtype=np.float64).reshape(-1, 2)
    return table[:, 0], np.nan_to_num(table[:, 1]) if "impacts" in name else table[:, 1]


def _figure(runs: Runs, names: list[str]) -> Figure:
    figure = Figure(figsize=(WIDTH, 2.6 * len(names) + 0.6))
    axes = figure.subplots(len(names), 2, sharex=True, sharey="row", squeeze=False)
    for column, (points, title) in enumerate(zip(runs, ("before", "after"), strict=True)):
        for ax, name in zip(axes[:, column], names, strict=True):
            _lines(ax, points, name)
            ax.set_ylabel(LABELS[name] if column == 0 else "")
        axes[0, column].set_title(title)
        axes[-1, column].set_xlabel("frequency in Hz")
    for ax in axes[:, 0]:
        ax.set_ylim(0, 1.06 * ax.get_ylim()[1])
    driven = [one for one in DIRECTIONS if any(p.direction == one for p in runs[0])]
    handles = [
        Line2D([], [], color=COLOUR[one], marker="o", lw=2.2, label=f"measured {one}")
        for one in driven
    ]
    handles += [
        Line2D([], [], color=TWIN, ls=DASH[one], marker="o", mfc="none", ms=6, lw=0.8,
               label=f"twin {one}")
        for one in driven
    ]  # fmt: skip
    figure.legend(handles=handles, loc="outside upper center", ncols=4)
    return figure


def _lines(ax: Axes, points: Sequence[Point], name: str) -> None:
    for one in DIRECTIONS:
        look: dict[str, Any] = {"color": COLOUR[one], "lw": 2.2, "ms": 4}
        ax.plot(*_curve(points, "measured", one, name), "o-", **look)
    for one in DIRECTIONS:
        twin: dict[str, Any] = {"color": TWIN, "ls": DASH[one], "lw": 0.8, "ms": 6, "mfc": "none"}
        ax.plot(*_curve(points, "twin", one, name), marker="o", **twin)
