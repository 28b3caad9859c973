"""Brute-force bifurcation diagrams, Poincare sections and chaotic bands of a model, by simulation.

Only what is stable is seen: the attractor at each value of a parameter, with the state carried from
value to value, up and down, or all attractors that many starts reach.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.dynamics.attractors import (
    Attractor,
    AttractorSearch,
    LyapunovExponent,
    estimate_exponent,
    find_attractors,
)
from twin.dynamics.basins import StartGrid
from twin.dynamics.stroboscopic import OperatingPoint, make_stroboscopic_map
from twin.dynamics.stroboscopic_kernel import UNDECIDED
from twin.model.contact_regime import U, V

DIAGRAM_CHAOS_CYCLES = 2000  # of a chaotic motion at one value of a diagram
TRANSIENT_CYCLES = 1000  # before a section or an exponent


@dataclass(frozen=True, slots=True, eq=False)
class BifurcationDiagram:
    """Attractors at each value of a parameter; an empty tuple where a motion did not settle."""

    point: OperatingPoint
    parameter: str
    values: Float1D
    attractors: tuple[tuple[Attractor, ...], ...]


@dataclass(frozen=True, slots=True)
class ChaosRange:
    """Range of a parameter, ends included, in which a chaotic attractor is found at every value.

    exponent: the largest in the band. The band ends within `tolerance` beyond `low` and `high`, or
    with the diagram.
    """

    low: float
    high: float
    tolerance: float
    exponent: LyapunovExponent


def record_section(point: OperatingPoint, u: float, v: float, cycles: int) -> Float2D:
    """Return the Poincare section at phase 0 of the motion from (u, v): u in m, v in m/s, (n, 2).

    The first `TRANSIENT_CYCLES` are left out.
    """
    stroboscopic = make_stroboscopic_map(point)
    state = stroboscopic.make_state(u, v)
    stroboscopic.advance(state, TRANSIENT_CYCLES)
    return stroboscopic.advance(state, cycles)[:, [U, V]]


def compute_exponent(point: OperatingPoint, u: float, v: float, cycles: int) -> LyapunovExponent:
    """Return the largest Lyapunov exponent per cycle of the motion to which (u, v) settles.

    Over `cycles` after `TRANSIENT_CYCLES`.
    """
    stroboscopic = make_stroboscopic_map(point)
    state = stroboscopic.make_state(u, v)
    stroboscopic.advance(state, TRANSIENT_CYCLES)
    return estimate_exponent(stroboscopic, state, cycles)


def follow_attractor(
    point: OperatingPoint,
    parameter: str,
    values: Sequence[float] | Float1D,
    chaos_cycles: int = DIAGRAM_CHAOS_CYCLES,
) -> BifurcationDiagram:
    """Return the attractor at each value in the order given, the state carried on between them.

    The first motion starts from u = v = 0, relaxed.
    """
    columns: list[tuple[Attractor, ...]] = []
    state = None
    for value in values:
        each = point.with_parameter(parameter, float(value))
        columns.append(_settle_from(each, state, chaos_cycles))
        state = columns[-1][0].points[-1] if columns[-1] else None
    return BifurcationDiagram(point, parameter, np.asarray(values, dtype=float), tuple(columns))


def _settle_from(
    point: OperatingPoint, state: Float1D | None, chaos_cycles: int
) -> tuple[Attractor, ...]:
    """Return the attractor to which a state of a neighboring point settles; none if it does not."""
    stroboscopic = make_stroboscopic_map(point)
    start = stroboscopic.make_state(0.0, 0.0) if state is None else stroboscopic.adopt(state)
    search = AttractorSearch(stroboscopic, chaos_cycles)
    labels, _ = search.classify(start[None])
    return () if labels[0] == UNDECIDED else (search.attractors[labels[0]],)


def scan_attractors(
    point: OperatingPoint,
    parameter: str,
    values: Sequence[float] | Float1D,
    grid: StartGrid,
    map_jobs: Callable[..., Iterable[Any]] = map,
    chaos_cycles: int = DIAGRAM_CHAOS_CYCLES,
) -> BifurcationDiagram:
    """Return all attractors that the starts of a grid reach at each value, and mirror images.

    With the `map` of a thread pool all cores are used.
    """

    def find(value: float) -> tuple[Attractor, ...]:
        stroboscopic = make_stroboscopic_map(point.with_parameter(parameter, value))
        return find_attractors(stroboscopic, grid.make_states(stroboscopic), chaos_cycles)

    values = np.asarray(values, dtype=float)
    return BifurcationDiagram(point, parameter, values, tuple(map_jobs(find, values.tolist())))


def find_chaotic_bands(
    diagrams: Sequence[BifurcationDiagram], tolerance: float
) -> tuple[ChaosRange, ...]:
    """Return the bands of consecutive values at which any of the diagrams shows chaos, ascending.

    The diagrams have the same values, in any order. Each end is refined by bisection to
    `tolerance`, in the parameter's unit, with the state carried from the chaotic side.
    """
    values = np.sort(diagrams[0].values)
    chaotic: dict[float, Attractor] = {}
    for diagram in diagrams:
        if not np.array_equal(np.sort(diagram.values), values):
            raise InputError("diagrams over different values", key="diagrams")
        for value, attractors in zip(diagram.values.tolist(), diagram.attractors, strict=True):
            for attractor in attractors:
                if attractor.kind == "chaotic":
                    chaotic.setdefault(value, attractor)
    runs: list[list[int]] = []
    for index in (i for i, value in enumerate(values.tolist()) if value in chaotic):
        if runs and runs[-1][-1] == index - 1:
            runs[-1].append(index)
        else:
            runs.append([index])
    bands = []
    for run in runs:
        ends = []
        for inner, outer in ((run[0], run[0] - 1), (run[-1], run[-1] + 1)):
            end = float(values[inner])
            if 0 <= outer < values.size:
                end = _refine_end(diagrams[0], end, float(values[outer]), chaotic[end], tolerance)
            ends.append(end)
        exponents = [chaotic[float(values[index])].exponent for index in run]
        largest = max(exponents, key=lambda exponent: exponent.value)
        bands.append(ChaosRange(ends[0], ends[1], tolerance, largest))
    return tuple(bands)


def _refine_end(
    diagram: BifurcationDiagram, inner: float, outer: float, chaos: Attractor, tolerance: float
) -> float:
    """Return the last value with chaos between a chaotic value and a regular one, by bisection."""
    while abs(outer - inner) > tolerance:
        middle = (inner + outer) / 2
        point = diagram.point.with_parameter(diagram.parameter, middle)
        reached = _settle_from(point, chaos.points[-1], DIAGRAM_CHAOS_CYCLES)
        if reached and reached[0].kind == "chaotic":
            inner, chaos = middle, reached[0]
        else:
            outer = middle
    return inner
