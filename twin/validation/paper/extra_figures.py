"""Figure in addition to the paper's: impact distributions and chaotic ranges of G4."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.reports.measured_campaign import MeasuredCampaign
from twin.reports.plot_style import (
    GUIDE_COLOUR,
    HYSTERESIS_COLOURS,
    CaptionedFigure,
    CaptionedFigures,
    label_panel,
)
from twin.validation.paper.study import CHAOS_SCAN_HZ, DETAIL_HZ, PaperStudy

MAX_BARS = 6  # impact combinations shown in a panel


def draw_chaos_figure(study: PaperStudy, campaign: MeasuredCampaign | None) -> CaptionedFigures:
    """Draw Lyapunov exponents and impact distributions of G4, for the model only."""
    if campaign is not None:
        return
    figure = Figure(figsize=(11, 6.2))
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=(1.1, 1))[:, 0]
    ax = top.subplots()
    ax.fill_between(CHAOS_SCAN_HZ, 0, 1, where=study.exponents > 0.05,
                    color=HYSTERESIS_COLOURS["right"], lw=0,
                    transform=ax.get_xaxis_transform())  # fmt: skip
    ax.axhline(0, color="#333333", lw=0.8)
    ax.plot(CHAOS_SCAN_HZ, study.exponents, color="#111111", lw=1.1)
    for hz in DETAIL_HZ[:-1]:
        ax.axvline(hz, color=GUIDE_COLOUR, ls=(0, (4, 2)), lw=0.9)
    ax.set_xlim(CHAOS_SCAN_HZ[0], CHAOS_SCAN_HZ[-1])
    ax.set_ylim(-1.2, 1.2)
    ax.set_xlabel("$f$ in Hz")
    ax.set_ylabel("largest Lyapunov exponent per cycle")
    label_panel(ax, "a", "G4: chaotic where the exponent is positive (yellow)")
    for index, (ax_share, hz) in enumerate(zip(bottom.subplots(1, 4, sharey=True), study.impacts,
                                             strict=True)):  # fmt: skip
        _draw_impact_shares(ax_share, study, hz)
        label_panel(ax_share, "bcde"[index], f"{hz:g} Hz")
        if index == 0:
            ax_share.set_ylabel("share of cycles in %")
    yield CaptionedFigure(
        "beside_chaos", "In addition to the paper: chaos and impacts of G4",
        "a Largest Lyapunov exponent of the model over frequency; dashed: the paper's frequencies. "
        "b–e Impacts right/left per forcing cycle, over 3000 cycles from rest. Two solvers, or a "
        "solver and a rig, can agree here in distribution only.",
        figure,
    )  # fmt: skip


def _draw_impact_shares(ax: Axes, study: PaperStudy, hz: float) -> None:
    shares = study.impacts[hz].shares[:MAX_BARS]
    names = [f"{right}/{left}" for (right, left), _ in shares]
    ax.set_ylim(0, max(92, 115 * shares[0][1]))
    bars = ax.bar(names, [100 * share for _, share in shares], color="#8b929c", width=0.6)
    ax.bar_label(bars, fmt="%.0f", size=8)
    ax.set_xlabel("impacts right/left")
    ax.set_xlim(-0.8, max(len(names), 3) - 0.2)
    ax.grid(False, axis="x")
