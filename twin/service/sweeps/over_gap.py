"""What resonance, hysteresis and jumps of a model do over the gap."""

from collections.abc import Iterator
from itertools import pairwise

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from twin.service.close_ups import COLOUR
from twin.service.figures import BAND
from twin.service.summary import Json

LEAST = 3  # finite gaps from which on there is something to see
MARK = {"up": "^", "down": "v"}
CAPTION = (
    "Above: the largest η_d of a sweep. Below: bars from the first to the last grid frequency at "
    "which the directions differ; triangles: the jumps, between two grid frequencies, pointing to "
    "where η_d goes; black: where η_d is largest."
)


def draw(label: str, told: list[Json]) -> Iterator[tuple[str, str, str, Figure]]:
    """One picture, of the cases of one model as the summary tells them."""
    cases = sorted((one for one in told if one["gap_mm"] != "inf" and one["peak"]),
                   key=lambda one: float(one["gap_mm"]))  # fmt: skip
    if len(cases) < LEAST:
        return
    figure = Figure(figsize=(11, 6.4))
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(1, 2))
    gaps = [one["gap_mm"] for one in cases]
    top.plot(gaps, [one["peak"]["eta_d"] for one in cases], "o-", color="#111111")
    top.set_ylabel(r"largest $\eta_d$")
    top.set_ylim(bottom=0)
    width = 0.7 * min(b - a for a, b in pairwise(gaps))
    for one in cases:
        _branches(bottom, one, width)
    bottom.plot(gaps, [one["peak"]["frequency_hz"] for one in cases], "o-", ms=3, lw=0.8,
                color="#111111", zorder=3)  # fmt: skip
    bottom.set_ylabel("frequency in Hz")
    bottom.set_xlabel("total gap in mm")
    figure.legend(handles=_key(cases), loc="outside upper center", ncols=4)
    yield f"gaps_{label}", f"{label} over the gap", CAPTION, figure


def _branches(ax: Axes, case: Json, width: float) -> None:
    gap = case["gap_mm"]
    for one in case["hysteresis"]:
        high = max(one["to_hz"] - one["from_hz"], 0.02)  # a single grid frequency is seen too
        ax.bar(gap, high, width, one["from_hz"], color=BAND[one["kind"]], lw=0.6, ec="#b0b0b0")
    for jump in case["jumps"]:
        middle = (jump["from_hz"] + jump["to_hz"]) / 2
        ax.plot(gap, middle, MARK[jump["kind"]], color=COLOUR[jump["direction"]], ms=6, zorder=4)


def _key(cases: list[Json]) -> list[Line2D | Patch]:
    """What is in the picture, and nothing else."""
    handles: list[Line2D | Patch] = [
        Line2D([], [], color="#111111", marker="o", ms=3, label=r"largest $\eta_d$")
    ]
    kinds = sorted({one["kind"] for case in cases for one in case["hysteresis"]})
    handles += [Patch(fc=BAND[kind], ec="#b0b0b0", label=f"{kind} hysteresis") for kind in kinds]
    jumps = sorted({(one["direction"], one["kind"]) for case in cases for one in case["jumps"]})
    return handles + [
        Line2D([], [], color=COLOUR[way], marker=MARK[kind], ls="", label=f"jump {kind}, {way}")
        for way, kind in jumps
    ]
