"""What the paper could not draw: the impacts as distributions, and where G4 is chaotic."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.service.paper.look import BAND, GUIDE, Drawing, Drawings, letter
from twin.service.paper.rig import Rig
from twin.service.paper.study import CHAOS_HZ, CLOSE_HZ, Study

MOST = 6  # kinds of cycles that a panel names


def draw(found: Study, rig: Rig | None) -> Drawings:
    """One picture beside the paper's, of the model only."""
    if rig is not None:
        return
    figure = Figure(figsize=(11, 6.2))
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    ax = top.subplots()
    ax.fill_between(CHAOS_HZ, 0, 1, where=found.exponents > 0.05, color=BAND["right"], lw=0,
                    transform=ax.get_xaxis_transform())  # fmt: skip
    ax.axhline(0, color="#333333", lw=0.8)
    ax.plot(CHAOS_HZ, found.exponents, color="#111111", lw=1.1)
    for hz in CLOSE_HZ[:-1]:
        ax.axvline(hz, color=GUIDE, ls=(0, (4, 2)), lw=0.9)
    ax.set_xlim(CHAOS_HZ[0], CHAOS_HZ[-1])
    ax.set_ylim(-1.2, 1.2)
    ax.set_xlabel("$f$ in Hz")
    ax.set_ylabel("largest Lyapunov exponent a cycle")
    letter(ax, "a", "G4: chaotic where the exponent is positive (yellow)")
    for number, (panel, hz) in enumerate(zip(bottom.subplots(1, 4, sharey=True), found.impacts,
                                             strict=True)):  # fmt: skip
        _shares(panel, found, hz)
        letter(panel, "bcde"[number], f"{hz:g} Hz")
        if number == 0:
            panel.set_ylabel("share of cycles in %")
    yield Drawing(
        "beside_chaos", "", "Beside the paper: chaos and impacts of G4",
        "a Largest Lyapunov exponent of the model over frequency; dashed: the paper's frequencies. "
        "b–e How many impacts right/left a forcing cycle has, over 3000 cycles from rest. Two "
        "solvers, or a solver and a rig, agree here on distributions only.",
        figure,
    )  # fmt: skip


def _shares(ax: Axes, found: Study, hz: float) -> None:
    shares = found.impacts[hz].shares[:MOST]
    names = [f"{right}/{left}" for (right, left), _ in shares]
    ax.set_ylim(0, max(92, 115 * shares[0][1]))
    bars = ax.bar(names, [100 * share for _, share in shares], color="#8b929c", width=0.6)
    ax.bar_label(bars, fmt="%.0f", size=8)
    ax.set_xlabel("impacts right/left")
    ax.set_xlim(-0.8, max(len(names), 3) - 0.2)
    ax.grid(False, axis="x")
