"""Attractors over the parameter of the branches: basins, their sizes, and brute-force diagram."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from table_io.block import Float1D, Float2D
from twin.drawing.basin_figures import (
    draw_basin_fractions,
    draw_basin_map,
    draw_bifurcation_diagram,
    draw_section,
)
from twin.drawing.panels import CaptionedFigures
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
