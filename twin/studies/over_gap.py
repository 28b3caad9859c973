"""Figure of resonance, hysteresis and jumps of a model over the gap."""

from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from twin.reports.plot_style import (
    DIRECTION_COLOURS,
    HYSTERESIS_COLOURS,
    TWIN_COLOUR,
    CaptionedFigure,
    CaptionedFigures,
)
from twin.reports.summary import Json

MIN_GAPS = 3  # fewest finite gaps for which the figure is drawn
JUMP_MARKERS = {"up": "^", "down": "v"}
CAPTION = (
    "Top: largest η_d of each sweep. Bottom: bars, hysteresis from the first to the last grid "
    "frequency at which the directions differ; triangles, jumps between two grid frequencies, "
    "pointing in the direction of the change of η_d; black, frequency of the largest η_d."
)


def draw_gap_figure(label: str, entries: list[Json]) -> CaptionedFigures:
    """Draw one figure from the summary entries of the cases of one model."""
    cases = sorted((entry for entry in entries if entry["gap_mm"] != "inf" and entry["peak"]),
                   key=lambda entry: float(entry["gap_mm"]))  # fmt: skip
    if len(cases) < MIN_GAPS:
        return
    figure = Figure(figsize=(11, 6.4))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    gaps = [case["gap_mm"] for case in cases]
    top.plot(gaps, [case["peak"]["eta_d"] for case in cases], "o-", color=TWIN_COLOUR)
    top.set_ylabel(r"largest $\eta_d$")
    top.set_ylim(bottom=0)
    width = 0.7 * min(b - a for a, b in pairwise(gaps))
    for case in cases:
        _plot_branches(bottom, case, width)
    bottom.plot(gaps, [case["peak"]["frequency_hz"] for case in cases], "o-", ms=3, lw=0.8,
                color=TWIN_COLOUR, zorder=3)  # fmt: skip
    bottom.set_ylabel("frequency in Hz")
    bottom.set_xlabel("total gap in mm")
    figure.legend(handles=_legend_handles(cases), loc="outside upper center", ncols=4)
    yield CaptionedFigure(f"gaps_{label}", f"{label} over the gap", CAPTION, figure)


def _plot_branches(ax: Axes, case: Json, width: float) -> None:
    gap = case["gap_mm"]
    for interval in case["hysteresis"]:
        height_hz = max(
            interval["to_hz"] - interval["from_hz"], 0.02
        )  # keeps an interval of a single grid frequency visible
        ax.bar(
            gap,
            height_hz,
            width,
            interval["from_hz"],
            color=HYSTERESIS_COLOURS[interval["kind"]],
            lw=0.6,
            ec="#b0b0b0",
        )
    for jump in case["jumps"]:
        middle_hz = (jump["from_hz"] + jump["to_hz"]) / 2
        ax.plot(
            gap,
            middle_hz,
            JUMP_MARKERS[jump["kind"]],
            color=DIRECTION_COLOURS[jump["direction"]],
            ms=6,
            zorder=4,
        )


def _legend_handles(cases: list[Json]) -> list[Line2D | Patch]:
    """Return legend handles of the plotted kinds only."""
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=TWIN_COLOUR, marker="o", ms=3, label=r"largest $\eta_d$")
    ]
    kinds = sorted({interval["kind"] for case in cases for interval in case["hysteresis"]})
    handles += [
        Patch(fc=HYSTERESIS_COLOURS[kind], ec="#b0b0b0", label=f"{kind} hysteresis")
        for kind in kinds
    ]
    jumps = sorted({(jump["direction"], jump["kind"]) for case in cases for jump in case["jumps"]})
    return handles + [
        Line2D(
            [],
            [],
            color=DIRECTION_COLOURS[direction],
            marker=JUMP_MARKERS[kind],
            ls="",
            label=f"jump {kind}, {direction}",
        )
        for direction, kind in jumps
    ]
