"""Page and tables of periodic branches; the page is self-contained and can be explored."""

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twin.branches.result import BranchDiagram, OrbitEntry
from twin.drawing.basin_figures import AttractorStudy, draw_attractor_figures
from twin.drawing.branch_curves import (
    BIFURCATION_MARKERS,
    BranchSet,
    count_impacts,
    describe_bifurcation,
    format_multiplier,
    list_branch_keys,
    period_colour,
    plot_branches,
    round_to,
)
from twin.drawing.page import embed_images, write_page
from twin.drawing.panels import CaptionedFigure, CaptionedFigures, PanelFigure, Picture
from twin.drawing.pictures import save_figures
from twin.drawing.plot_style import FIGURE_WIDTH_IN, GUIDE_COLOUR, LineStyle
from twin.dynamics.continuation import Branch, BranchEnd, split_by_stability
from twin.dynamics.orbits import Orbit

PORTRAIT_SAMPLES = 96  # per period, of the motion that the page shows
MAX_PORTRAIT_SAMPLES = 384


def write_branch_report(
    folder: Path,
    branches: BranchSet,
    title: str,
    subtitle: str,
    model_toml: str,
    attractors: AttractorStudy | None = None,
) -> Path:
    """Write report.html, branches.json, branches.csv and figures/*.png to `folder`.

    Return the path of the page.
    """
    pictures = draw_branch_figures(branches, folder / "figures", attractors)
    diagram = BranchDiagram.from_branches(branches, title)
    diagram.write(folder / "branches.json")
    write_table(diagram, folder / "branches.csv")
    data = make_page_data(branches)
    return write_page(
        folder,
        Path(__file__).with_name("page.html"),
        title=title,
        subtitle=subtitle,
        headline=format_branch_headline(branches),
        parameter=branches.axis.label,
        bifurcations=list_bifurcations(branches),
        branches=[_make_row(branches, branch) for branch in branches.branches],
        images=embed_images(pictures),
        model=model_toml,
        data=json.dumps(data, separators=(",", ":")).replace("</", "<\\/"),
    )


def write_table(diagram: BranchDiagram, path: Path) -> None:
    """Write one row per point as CSV, in SI, without loss of precision."""
    names = [name for name in OrbitEntry.model_fields if name not in ("value", "multipliers")]
    multiplier = ("largest_multiplier_real", "largest_multiplier_imag")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["branch", "periods", diagram.parameter, *names, *multiplier])
        for number, branch in enumerate(diagram.branches, 1):
            for point in branch.points:
                values = [getattr(point, name) for name in names[:-1]]
                writer.writerow(
                    [number, branch.periods, point.value, *values, int(point.stable),
                     *point.multipliers[0]]
                )  # fmt: skip


def format_branch_headline(branches: BranchSet) -> str:
    """Summarize jumps, stable motions at once and chaos in one or two sentences."""
    factor, unit = branches.axis.factor, branches.axis.label.rsplit(" in ", 1)[-1]
    jumps = sorted(
        {
            round(factor * item.value, 4)
            for branch, item in branches.bifurcations
            if item.turns_back and branch.points[0].orbit.periods == 1
        }
    )
    count = len(branches.branches)
    parts = [f"{count} branch{'es' if count != 1 else ''}"]
    if jumps:
        listed = ", ".join(f"{value:.5g}" for value in jumps[:6])
        more = f" and {len(jumps) - 6} more" if len(jumps) > 6 else ""
        parts.append(f"the motion can jump at {listed}{more} {unit}")
    else:
        parts.append("no fold in this range")
    if branches.chaotic:
        bands = ", ".join(
            f"{factor * low:.4g} to {factor * high:.4g}" for low, high in branches.chaotic
        )
        parts.append(f"chaotic at {bands} {unit}")
    return "; ".join(parts) + "."


@dataclass(frozen=True, slots=True)
class BifurcationRow:
    """Row of the table of bifurcations, as text in displayed units."""

    kind: str
    x: str
    u: str
    period: int
    meaning: str


def list_bifurcations(branches: BranchSet) -> list[BifurcationRow]:
    """Return a row per bifurcation, in order of the parameter."""
    factor = branches.axis.factor
    quantity = branches.quantities[0]
    return [
        BifurcationRow(
            item.kind,
            f"{factor * item.value:.6g}",
            f"{quantity.of(item.orbit):.4g}",
            item.orbit.periods,
            describe_bifurcation(item),
        )
        for _, item in branches.bifurcations
    ]


@dataclass(frozen=True, slots=True)
class BranchRow:
    """Row of the table of branches, as text in displayed units."""

    period: int
    points: int
    stable: str
    low: str
    high: str
    begins: str
    ends: str


def _make_row(branches: BranchSet, branch: Branch) -> BranchRow:
    x = branches.x(branch)
    return BranchRow(
        branch.points[0].orbit.periods,
        len(branch.points),
        f"{100 * np.mean(branch.stable):.0f} %",
        f"{x.min():.5g}",
        f"{x.max():.5g}",
        format_end(branches, branch.ends[0]),
        format_end(branches, branch.ends[1]),
    )


def format_end(branches: BranchSet, end: BranchEnd) -> str:
    """Format why a branch ends, and where."""
    text = f"{end.reason} at {branches.axis.factor * end.value:.6g}"
    return f"{text}, residual {end.residual:.1e}" if end.residual else text


def make_page_data(branches: BranchSet) -> Mapping[str, object]:
    """Return what the page's script draws, in displayed units."""
    factor, quantities = branches.axis.factor, branches.quantities
    return {
        "parameter": {"label": branches.axis.label},
        "quantities": [{"key": quantity.key, "label": quantity.label} for quantity in quantities],
        "branches": [_make_line(branches, branch) for branch in branches.branches],
        "bifurcations": [
            {
                "x": factor * item.value,
                "values": {quantity.key: quantity.of(item.orbit) for quantity in quantities},
                "colour": _marker_colour(item.kind),
                "text": f"{item.kind} at {factor * item.value:.6g}: {describe_bifurcation(item)}",
            }
            for _, item in branches.bifurcations
        ],
        "bands": [[factor * low, factor * high] for low, high in branches.chaotic],
        "measured": [
            {
                "x": round_to(curve.x),
                "values": {key: round_to(values) for key, values in curve.values.items()},
                "colour": curve.colour,
                "label": curve.label,
            }
            for curve in branches.measured
        ],
    }


def _marker_colour(kind: str) -> str:
    colour = str(BIFURCATION_MARKERS[kind]["mfc"])
    return "#8a929c" if colour == "white" else colour


def _make_line(branches: BranchSet, branch: Branch) -> Mapping[str, object]:
    orbits = [point.orbit for point in branch.points]
    return {
        "period": orbits[0].periods,
        "colour": period_colour(orbits[0].periods),
        "x": round_to(branches.x(branch), 7),
        "stable": [int(stable) for stable in branch.stable],
        "values": {
            quantity.key: round_to(branches.y(branch, quantity)) for quantity in branches.quantities
        },
        "multipliers": [
            [format_multiplier(value) for value in orbit.multipliers[:2].tolist()]
            for orbit in orbits
        ],
        "impacts": [count_impacts(orbit) for orbit in orbits],
        "orbits": [_portrait(orbit) for orbit in orbits],
        "walls": [_walls_mm(orbit) for orbit in orbits],
    }


def _portrait(orbit: Orbit) -> list[list[float | None]]:
    """Return u in mm and u' in mm/s of a motion, for its phase portrait."""
    count = min(PORTRAIT_SAMPLES * orbit.periods, MAX_PORTRAIT_SAMPLES)
    u, v = orbit.sample_motion(count)[:2]
    return [round_to(1e3 * u, 4), round_to(1e3 * v, 4)]


def _walls_mm(orbit: Orbit) -> list[float]:
    """Return the positions of the bumpers at rest in mm."""
    parameters = orbit.period_map.model.parameters
    walls = np.array([1e3 * parameters.gap_r, -1e3 * parameters.gap_l])
    return [float(wall) for wall in walls[np.isfinite(walls)]]


def draw_branch_figures(
    branches: BranchSet, folder: Path, attractors: AttractorStudy | None = None
) -> list[Picture]:
    """Draw branches, multipliers and what is known of attractors into PNG files, in this order."""

    def draw() -> CaptionedFigures:
        yield from _draw_branches(branches)
        yield from _draw_multipliers(branches)
        if attractors is not None:
            yield from draw_attractor_figures(attractors, branches)

    return save_figures(draw(), folder)


def _draw_branches(branches: BranchSet) -> CaptionedFigures:
    """Draw every quantity over the parameter."""
    quantities = branches.quantities
    rows = len(quantities) // 2
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.4 * rows + 0.5), rows, 2)
    axes = figure.panels
    for ax, quantity in zip(axes.flat, quantities, strict=True):
        plot_branches(ax, branches, quantity)
    for ax in axes[-1]:
        ax.set_xlabel(branches.axis.label)
    figure.legend(list_branch_keys(branches), columns=6)
    caption = (
        "Periodic motions of the model: half of the swing of u and of the total acceleration, and "
        "the largest contact force of each side. A stable motion is one that the table shows; an "
        "unstable one separates the basins of two stable ones."
    )
    if branches.chaotic:
        caption += " In the shaded ranges the motion is chaotic."
    yield CaptionedFigure("branches", "Branches of periodic motions", caption, figure)


def _draw_multipliers(branches: BranchSet) -> CaptionedFigures:
    """Draw the magnitude of the largest Floquet multiplier."""
    if not branches.branches:
        return
    figure = PanelFigure((FIGURE_WIDTH_IN, 3.4))
    ax = figure.panels[0, 0]
    ax.set_yscale("log")
    ax.axhline(1.0, color=GUIDE_COLOUR, lw=0.8)
    for branch in branches.branches:
        x = branches.x(branch)
        y = np.array([abs(point.orbit.multipliers[0]) for point in branch.points])
        colour = period_colour(branch.points[0].orbit.periods)
        for first, last, stable in split_by_stability(branch.stable.tolist()):
            style: LineStyle = {"ls": "-", "lw": 1.5} if stable else {"ls": (0, (4, 2.2))}
            ax.plot(x[first : last + 1], y[first : last + 1], color=colour, **style)
    ax.set_xlabel(branches.axis.label)
    ax.set_ylabel("largest Floquet multiplier")
    figure.legend(list_branch_keys(branches)[:2], columns=2)
    yield CaptionedFigure(
        "multipliers",
        "Floquet multipliers",
        "Factor by which the largest deviation from the motion grows over one repetition of it: "
        "below 1 it dies out. It jumps where a contact begins to graze.",
        figure,
    )
