"""Figures of attractors: basins of attraction, Poincare sections, brute-force diagrams.

Colors are mid-tones that show on a light and on a dark ground; text and axes follow the style.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import matplotlib as mpl
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from table_io.block import Float1D, Float2D
from twin.drawing.panels import CaptionedFigure, CaptionedFigures
from twin.dynamics.attractors import Attractor
from twin.dynamics.basins import (
    Basins,
    BifurcationDiagram,
    ChaosRange,
    ParallelMap,
    StartGrid,
    compute_basins,
    compute_basins_over,
    find_chaotic_bands,
    follow_attractor,
    record_section,
)
from twin.dynamics.orbits import Orbit
from twin.dynamics.period_map import FREQUENCY, PeriodMap
from twin.model.contact_regime import U, V

PARAMETER_LABELS = {
    "frequency": "$f$ in Hz", "level": "peak table acceleration in m/s²",
    "gap": "total gap $G$ in mm", "gap_r": "right gap in mm", "gap_l": "left gap in mm",
}  # fmt: skip
MILLI = frozenset({"gap", "gap_r", "gap_l"})  # parameters drawn in thousandths of their unit
KIND_COLOURS = {
    "no contact": "#4f8fd0", "period 1": "#d9822b", "period 1, mirror pair": "#e3b94f",
    "period 2 or more": "#5aa469", "quasi-periodic": "#9a7f5f", "chaotic": "#8e5bb5",
    "undecided": "#8a8a8a",
}  # fmt: skip
# Towards white, or towards black where negative: of the attractors of one kind in a map.
SHADES = (0.0, 0.55, -0.45, 0.82, -0.75)
CHAOS_COLOUR = KIND_COLOURS["chaotic"]
UP_COLOUR, DOWN_COLOUR = "#d8434a", "#3f7fce"
MAX_DRAWN_POINTS = 400  # points of a motion without period at one value of a diagram


def describe_kind(attractors: Sequence[Attractor], index: int) -> str:
    """Return the class of one of the attractors at a point, a key of `KIND_COLOURS`."""
    attractor = attractors[index]
    if not attractor.is_periodic:
        return attractor.kind
    if not attractor.has_contact:
        return "no contact"
    if attractor.period != 1:
        return "period 2 or more"
    return "period 1" if attractor.mirror in (None, index) else "period 1, mirror pair"


def draw_basin_map(basins: Basins, unstable: Float2D | None = None) -> CaptionedFigure:
    """Draw the basins with the attractors; `unstable` (n, 2): u in m, v in m/s of saddle orbits."""
    figure = Figure(figsize=(8.6, 5.6))
    ax = figure.subplots()
    colours = _attractor_colours(basins.attractors)
    palette = ListedColormap([to_rgb(KIND_COLOURS["undecided"]), *colours])
    ax.pcolormesh(
        1e3 * basins.grid.u, 1e3 * basins.grid.v, basins.labels.T, cmap=palette, vmin=-1.5,
        vmax=len(colours) - 0.5, shading="nearest", rasterized=True,
    )  # fmt: skip
    handles: list[Artist] = []
    for index, (attractor, colour, share) in enumerate(
        zip(basins.attractors, colours, basins.fractions, strict=True)
    ):
        _plot_attractor(ax, attractor)
        kind = describe_kind(basins.attractors, index)
        text = f"{kind}, {1e3 * attractor.u_max:.3f} mm: {share:.1%}"
        handles.append(Patch(color=colour, label=text))
    if basins.undecided_share:
        text = f"undecided: {basins.undecided_share:.1%}"
        handles.append(Patch(color=KIND_COLOURS["undecided"], label=text))
    handles.append(_marker("o", "attractor at phase 0"))
    if unstable is not None:
        u, v = 1e3 * unstable.T
        ax.plot(u, v, "D", mfc="#ffffff", mec="#111111", ms=7, ls="none", zorder=6)
        handles.append(_marker("D", "unstable orbit at phase 0"))
    ax.grid(visible=False)
    ax.set_xlabel("initial $u$ in mm")
    ax.set_ylabel("initial $u'$ in mm/s")
    period_map = basins.period_map
    ax.set_title(f"$f$ = {period_map.frequency_hz:.4g} Hz, {_format_gap(basins)}")
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    return CaptionedFigure(
        "basin_map",
        "Basins of attraction",
        f"Attractor to which each of {basins.labels.size} starts settles, at a peak table "
        f"acceleration of {period_map.acceleration_m_s2:.4g} m/s², phase 0, memory relaxed. "
        "Percentages: share of the starts; mm: greatest displacement of the attractor.",
        figure,
    )


def _format_gap(basins: Basins) -> str:
    base = basins.period_map.model.base
    return f"$G$ = {1e3 * (base.gap_r + base.gap_l):.4g} mm"


def _attractor_colours(attractors: Sequence[Attractor]) -> list[tuple[float, float, float]]:
    """Return a color per attractor: that of its kind, in another shade for each of a kind."""
    counts: dict[str, int] = {}
    colours = []
    for index in range(len(attractors)):
        kind = describe_kind(attractors, index)
        shade = SHADES[counts.get(kind, 0) % len(SHADES)]
        counts[kind] = counts.get(kind, 0) + 1
        ground = 1.0 if shade > 0 else 0.0
        red, green, blue = (c + abs(shade) * (ground - c) for c in to_rgb(KIND_COLOURS[kind]))
        colours.append((red, green, blue))
    return colours


def _plot_attractor(ax: Axes, attractor: Attractor) -> None:
    u, v = 1e3 * attractor.points[:, U], 1e3 * attractor.points[:, V]
    if attractor.is_periodic:
        ax.plot(u, v, "o", mfc="#111111", mec="#ffffff", mew=1.1, ms=7, zorder=5)
    else:
        ax.plot(u, v, ".", color="#111111", ms=1.2, mew=0, zorder=5)


def _marker(marker: str, label: str) -> Line2D:
    text_colour = mpl.rcParams["text.color"]
    return Line2D([], [], marker=marker, ls="none", mfc="none", mec=text_colour, ms=6, label=label)


def draw_basin_fractions(
    results: Sequence[Basins], parameter: str, values: Float1D
) -> CaptionedFigure:
    """Draw the share of the starts that ends in each kind of attractor, over a parameter."""
    figure = Figure(figsize=(10, 3.8))
    ax = figure.subplots()
    shares = {kind: np.zeros(len(results)) for kind in KIND_COLOURS}
    for i, basins in enumerate(results):
        for index, share in enumerate(basins.fractions.tolist()):
            shares[describe_kind(basins.attractors, index)][i] += share
        shares["undecided"][i] = basins.undecided_share
    present = {kind: share for kind, share in shares.items() if share.any()}
    x = _scale_values(parameter, values)
    middles = (x[1:] + x[:-1]) / 2
    edges = np.concatenate([[x[0]], middles, [x[-1]]])
    low = np.zeros(len(results))
    for kind, share in present.items():
        ax.stairs(
            100 * (low + share), edges, baseline=100 * low, fill=True, lw=0,
            color=KIND_COLOURS[kind], label=kind,
        )  # fmt: skip
        low = low + share
    ax.set_xlim(edges[0], edges[-1])
    ax.set_ylim(0, 100)
    ax.set_xlabel(PARAMETER_LABELS.get(parameter, parameter))
    ax.set_ylabel("share of the starts in %")
    figure.legend(loc="outside upper center", ncols=len(present))
    return CaptionedFigure(
        "basin_fractions", "Sizes of the basins",
        f"Share of {results[0].labels.size} starts that settle to each kind of attractor.", figure,
    )  # fmt: skip


def draw_section(points: Float2D, title: str) -> CaptionedFigure:
    """Draw a Poincare section; points (n, 2): u in m, v in m/s at phase 0."""
    figure = Figure(figsize=(6.4, 5))
    ax = figure.subplots()
    ax.plot(1e3 * points[:, 0], 1e3 * points[:, 1], ".", color=CHAOS_COLOUR, ms=1.6, mew=0)
    ax.set_xlabel("$u$ in mm")
    ax.set_ylabel("$u'$ in mm/s")
    ax.set_title(title)
    return CaptionedFigure(
        "poincare_section", "Poincaré section",
        f"State at the zero upcrossings of the table acceleration, {len(points)} cycles.", figure,
    )  # fmt: skip


def draw_bifurcation_diagram(
    up: BifurcationDiagram, down: BifurcationDiagram, bands: Sequence[ChaosRange] = ()
) -> CaptionedFigure:
    """Draw u at phase 0 and the largest exponent over a parameter, with the chaotic bands."""
    figure = Figure(figsize=(10, 6.2))
    section, exponents = figure.subplots(2, 1, sharex=True, height_ratios=(2.6, 1))
    layers = [(up, UP_COLOUR, "increasing", 1.5), (down, DOWN_COLOUR, "decreasing", 0.9)]
    for diagram, colour, _, size in layers:
        for is_periodic, factor in ((False, 1.0), (True, 2.2)):
            x, u = _collect_points(diagram, is_periodic)
            section.plot(x, u, ".", color=colour, ms=factor * size, mew=0, rasterized=True)
        x, exponent = _collect_exponents(diagram)
        exponents.plot(x, exponent, ".", color=colour, ms=3 * size, mew=0)
    exponents.axhline(0, color=mpl.rcParams["text.color"], lw=0.8)
    exponents.set_ylim(bottom=-1.0)
    for band in bands:
        low, high = _scale_values(up.parameter, np.array([band.low, band.high]))
        for ax in (section, exponents):
            ax.axvspan(low, high, color=CHAOS_COLOUR, alpha=0.16, lw=0, zorder=0.4)
    section.set_ylabel("$u$ at phase 0 in mm")
    exponents.set_ylabel("exponent per cycle")
    exponents.set_xlabel(PARAMETER_LABELS.get(up.parameter, up.parameter))
    handles: list[Artist] = [
        Line2D([], [], marker="o", ls="none", color=colour, ms=4, label=label)
        for _, colour, label, _ in layers
    ]
    if bands:
        handles.append(Patch(color=CHAOS_COLOUR, alpha=0.3, label="chaotic band"))
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles))
    return CaptionedFigure(
        "bifurcation_diagram", "Brute-force bifurcation diagram",
        "Above: displacement at the zero upcrossings of the table acceleration, the state carried "
        "from value to value. Below: largest Lyapunov exponent per cycle. "
        + _describe_bands(bands, up.parameter), figure,
    )  # fmt: skip


def _describe_bands(bands: Sequence[ChaosRange], parameter: str) -> str:
    if not bands:
        return "No chaos."
    ranges = (_scale_values(parameter, np.array([band.low, band.high])) for band in bands)
    return "Chaotic: " + ", ".join(f"{low:.4g} to {high:.4g}" for low, high in ranges) + "."


def _collect_points(diagram: BifurcationDiagram, is_periodic: bool) -> tuple[Float1D, Float1D]:
    """Return (value as drawn, u in mm at phase 0) of each point of the attractors of one sort."""
    values = _scale_values(diagram.parameter, diagram.values)
    pairs = [
        (value, 1e3 * u)
        for value, attractors in zip(values.tolist(), diagram.attractors, strict=True)
        for attractor in attractors
        if attractor.is_periodic == is_periodic
        for u in attractor.points[:MAX_DRAWN_POINTS, U].tolist()
    ]
    x, y = np.array(pairs).reshape(-1, 2).T
    return x, y


def _collect_exponents(diagram: BifurcationDiagram) -> tuple[Float1D, Float1D]:
    """Return (value as drawn, largest Lyapunov exponent per cycle) of each attractor."""
    values = _scale_values(diagram.parameter, diagram.values)
    pairs = [
        (value, attractor.exponent.value)
        for value, attractors in zip(values.tolist(), diagram.attractors, strict=True)
        for attractor in attractors
    ]
    x, y = np.array(pairs).reshape(-1, 2).T
    return x, y


def _scale_values(parameter: str, values: Float1D) -> Float1D:
    """Return values of a parameter in the unit in which they are drawn."""
    return values * 1e3 if parameter in MILLI else values


if TYPE_CHECKING:
    from twin.drawing.branch_curves import BranchSet

VALUE_COUNT = 91  # of the parameter
STARTS_EACH_WAY, MAP_STARTS = 31, 161  # in u and in v
SECTION_CYCLES = 4000
BAND_TOLERANCE_SHARE = 2e-4  # of the range: of the ends of a chaotic band
START_RANGE = 1.5  # of the largest motion: range of the starts


@dataclass(frozen=True, eq=False)
class AttractorStudy:
    """Attractors at `values` of a parameter, and basins at one frequency if asked for."""

    parameter: str
    values: Float1D
    up: BifurcationDiagram
    down: BifurcationDiagram
    bands: tuple[ChaosRange, ...]
    fractions: tuple[Basins, ...]
    basins: Basins | None = None


def study_attractors(
    period_map: PeriodMap,
    parameter: str,
    limits: tuple[float, float],
    basins_hz: float | None,
    map_jobs: ParallelMap = map,
) -> AttractorStudy:
    """Follow the attractor over `limits` both ways and measure the basins on the way.

    With `basins_hz` also the basins at this frequency in Hz, at the parameters of `period_map`.
    With the `map` of a thread pool all cores are used.
    """
    values = np.linspace(*limits, VALUE_COUNT)
    up = follow_attractor(period_map, parameter, values)
    down = follow_attractor(period_map, parameter, values[::-1])
    bands = find_chaotic_bands((up, down), BAND_TOLERANCE_SHARE * (limits[1] - limits[0]))
    grid = make_start_grid(period_map, up, STARTS_EACH_WAY)
    fractions = compute_basins_over(period_map, parameter, values, grid, map_jobs)
    basins = None
    if basins_hz is not None:
        own = period_map.with_parameter(FREQUENCY, basins_hz)
        basins = compute_basins(own, make_start_grid(own, up, MAP_STARTS))
    return AttractorStudy(parameter, values, up, down, bands, tuple(fractions), basins)


def make_start_grid(period_map: PeriodMap, diagram: BifurcationDiagram, count: int) -> StartGrid:
    """Return a grid of starts around all motions of a diagram, `count` in u and in v."""
    sizes = [attractor.u_max for column in diagram.attractors for attractor in column]
    u_limit = START_RANGE * max((abs(size) for size in sizes), default=1e-3)
    return StartGrid.from_limits(
        u_limit, u_limit * 2 * math.pi * period_map.frequency_hz, count, count
    )


def draw_attractor_figures(study: AttractorStudy, branches: "BranchSet") -> CaptionedFigures:
    """Draw the brute-force diagram, the sizes of the basins, and the basins at one frequency."""
    yield draw_bifurcation_diagram(study.up, study.down, bands=study.bands)
    yield draw_basin_fractions(study.fractions, study.parameter, study.values)
    if study.basins is None:
        return
    hz = study.basins.period_map.frequency_hz
    yield draw_basin_map(study.basins, find_saddles(branches, hz))
    for attractor in study.basins.attractors:
        if not attractor.is_periodic:
            u, v = attractor.points[-1, :2].tolist()
            points = record_section(study.basins.period_map, u, v, SECTION_CYCLES)
            yield draw_section(points, f"Chaotic motion at {hz:g} Hz")
            break


def find_saddles(branches: "BranchSet", frequency_hz: float) -> Float2D | None:
    """Return (u, v) of the unstable orbits of the branches at a frequency, (n, 2); None without."""
    saddles = [
        orbit.x[:2]
        for branch in branches.branches
        if branch.parameter == "frequency"
        for orbit in branch.orbits_at(frequency_hz)
        if is_saddle(orbit)
    ]
    return np.array(saddles) if saddles else None


def is_saddle(orbit: Orbit) -> bool:
    """Return whether one multiplier of an orbit lies outside the unit circle, the others inside."""
    return int((np.abs(orbit.multipliers) > 1).sum()) == 1
