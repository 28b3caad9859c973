"""Secondary resonances of G4 in the low frequency range (Fig. 9)."""

from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.service.paper.cases import Case, curve
from twin.service.paper.look import (
    COLOUR,
    DIRECTIONS,
    GUIDE,
    Drawing,
    Drawings,
    bumper_loops,
    directions_key,
    letter,
    mass_loop,
    obstacles,
    pen,
    portrait,
)
from twin.service.paper.players import Motion
from twin.service.paper.rig import Rig
from twin.service.paper.study import SECONDARY_HZ, Study

SWEEPS = (  # name, from and to in Hz, colour, where the name stands
    ("SS1", 0.5, 0.8, "#cfeccb", 0.65), ("SS2", 0.8, 1.6, "#fde0b5", 1.3),
    ("SS3", 0.5, 5.0, "#d3e9f7", 3.3),
)  # fmt: skip
CYCLES = 3  # measured ones of a step, in portraits and loops
SHOWN = 2  # of them in the histories


def draw(found: Study, rig: Rig | None) -> Drawings:
    """Fig. 9, of the model only."""
    if rig is not None:
        return
    case = found.cases["G4"]
    figure = Figure(figsize=(15.5, 11))
    left, right = figure.subfigures(1, 2, squeeze=False, width_ratios=(1.02, 1))[0]
    grid = left.add_gridspec(4, 3)
    _curve(left.add_subplot(grid[0, :]), case)
    motions = [{one: case.motion(hz, one, CYCLES) for one in DIRECTIONS} for hz in SECONDARY_HZ]
    for column, pair in enumerate(motions):
        rows = [left.add_subplot(grid[1 + row, column]) for row in range(3)]
        _loops(rows, pair, case, column)
    axes = right.subplots(3, 3, sharey="row", sharex="col")
    for column, pair in enumerate(motions):
        _histories(axes[:, column], pair, case, column)
    figure.legend(handles=directions_key(pen), loc="outside upper center", ncols=2)
    yield Drawing(
        "fig09_secondary", "9", "Secondary resonances of G4",
        "a PRC of η_a with the ranges of the three sweeps and the three observed resonances; "
        "b–d phase portraits, e–g inertia force against u, h–j contact force against bumper "
        f"position, over the {CYCLES} measured cycles; k–m u, n–p total acceleration, q–s contact "
        "forces over time. Red bands: the contacts within one forcing cycle of the forward sweep. "
        f"Dashed: the gap. {_chaos(found)}",
        figure,
    )  # fmt: skip


def _chaos(found: Study) -> str:
    chaotic = [f"{hz:g}" for hz in SECONDARY_HZ if found.chaotic(hz)]
    if not chaotic:
        return "The model is chaotic at none of the three."
    where = "all three" if len(chaotic) == len(SECONDARY_HZ) else f"{' and '.join(chaotic)} Hz"
    return f"The model is chaotic at {where}: there cycles differ, and so do directions."


def _curve(ax: Axes, case: Case) -> None:
    for name, low, high, colour, middle in SWEEPS[::-1]:
        ax.axvspan(low, high, color=colour, lw=0, zorder=0.3)
        ax.annotate(
            name, (middle, 0.06), xycoords=("data", "axes fraction"), ha="center", size=9,
            color="#333333",
        )  # fmt: skip
    for one, size in (("forward", 4.2), ("backward", 2.4)):
        f, y = curve(case.points, "twin", one, "eta_a")
        ax.plot(f, y, "o-", color=COLOUR[one], ms=size, lw=size / 3, mew=0)
    for number, hz in enumerate(SECONDARY_HZ, 1):
        ax.axvline(hz, color="#111111", ls=(0, (4, 2)), lw=1)
        ax.annotate(
            f"$f_{number}$", (hz, 0.97), (3, 0), xycoords=("data", "axes fraction"),
            textcoords="offset points", va="top", size=9,
        )  # fmt: skip
    ax.set_xlim(0.4, 5.05)
    ax.set_ylim(bottom=0)
    ax.set_xlabel("$f$ in Hz")
    ax.set_ylabel(r"$\eta_a$")
    letter(ax, "a")


def _loops(rows: list[Axes], pair: dict[str, Motion], case: Case, column: int) -> None:
    p = case.parameters
    for one in DIRECTIONS:
        look = pen(one, 1.0)
        portrait(rows[0], pair[one], **look)
        mass_loop(rows[1], pair[one], p.mass, False, **look)
        bumper_loops(rows[2], pair[one], False, **look)
    names = ("bcd", "efg", "hij")
    labels = (
        ("$u$ in mm", "$u'$ in mm/s"), ("$u$ in mm", "$F_I$ in kN"), ("$v_j$ in mm", "$F_j$ in kN"),
    )  # fmt: skip
    for ax, which, (x, y) in zip(rows, names, labels, strict=True):
        title = f"$f_{column + 1}$ = {SECONDARY_HZ[column]:g} Hz" if which == "bcd" else ""
        letter(ax, which[column], title)
        obstacles(p, ax.axvline)
        ax.axhline(0, color=GUIDE, lw=0.5, zorder=0.6)
        ax.set_xlabel(x)
        ax.set_ylabel(y if column == 0 else "")


def _histories(axes: Any, pair: dict[str, Motion], case: Case, column: int) -> None:
    hz = SECONDARY_HZ[column]
    for one in DIRECTIONS:
        look, motion = pen(one, 1.0), pair[one]
        axes[0].plot(motion.time, motion.u * 1e3, **look)
        axes[1].plot(motion.time, motion.a, **look)
        for force in (motion.force_r, motion.force_l):
            axes[2].plot(motion.time, force / 1e3, **look)
    forward = pair["forward"]
    first = _quiet(forward, hz)
    inside = (forward.time >= first) & (forward.time < first + 1 / hz)
    for ax, which in zip(axes, ("klm", "nop", "qrs"), strict=True):
        for touch in (forward.force_r > 0, forward.force_l < 0):
            ax.fill_between(
                forward.time, 0, 1, where=touch & inside, transform=ax.get_xaxis_transform(),
                color=COLOUR["forward"], alpha=0.20, lw=0,
            )  # fmt: skip
        letter(ax, which[column], f"$f_{column + 1}$ = {hz:g} Hz" if which == "klm" else "")
        ax.set_xlim(0, SHOWN / hz)
    obstacles(case.parameters, axes[0].axhline)
    axes[2].set_xlabel("$t$ in s")
    if column == 0:
        for ax, label in zip(axes, ("$u$ in mm", "$a$ in m/s²", "$F_j$ in kN"), strict=True):
            ax.set_ylabel(label)


def _quiet(motion: Motion, hz: float) -> float:
    """A time in s in the first cycle just before the end of its longest flight."""
    touch = (motion.force_r > 0) | (motion.force_l < 0)
    begins = motion.time[1:][touch[1:] & ~touch[:-1]]
    ends = motion.time[1:][~touch[1:] & touch[:-1]]
    flights = [(b - ends[ends < b].max(), b) for b in begins if (ends < b).any() and b < 1 / hz]
    return float(max(flights)[1] - 0.01 / hz) if flights else 0.3 / hz
