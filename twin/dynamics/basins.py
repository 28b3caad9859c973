"""What a model does from many starts: basins of attraction, and brute-force diagrams.

By simulation, so only what is stable is seen: the attractors that a grid of starts reaches, or the
one at each value of a parameter, with the state carried from value to value. A start is (u, v) at
phase 0 of A = a sin(2 pi f t), with all memory relaxed: bumpers, and states that effects bring.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from table_io.errors import InputError
from twin.dynamics.attractors import Attractor, AttractorSearch, LyapunovExponent
from twin.dynamics.capture import UNDECIDED
from twin.dynamics.period_map import PeriodMap

ParallelMap = Callable[..., Iterable["Basins"]]  # as `map`: a thread pool's uses all cores

DIAGRAM_CHAOS_CYCLES = 2000  # of a chaotic motion at one value of a diagram
TRANSIENT_CYCLES = 1000  # before a section


@dataclass(frozen=True, slots=True, eq=False)
class StartGrid:
    """Grid of initial u in m, (n,), and v in m/s, (m,)."""

    u: Float1D
    v: Float1D

    @classmethod
    def from_limits(cls, u_limit: float, v_limit: float, u_count: int, v_count: int) -> "StartGrid":
        """Return a grid of +-u_limit m and +-v_limit m/s, limits included."""
        for key, limit in (("u_limit", u_limit), ("v_limit", v_limit)):
            if not (np.isfinite(limit) and limit > 0):
                raise InputError(
                    "not a limit of initial states", key=key, value=limit, allowed="above 0, finite"
                )
        for key, count in (("u_count", u_count), ("v_count", v_count)):
            if count < 1:
                raise InputError("too few starts", key=key, value=count, allowed="1 or more")
        return cls(np.linspace(-u_limit, u_limit, u_count), np.linspace(-v_limit, v_limit, v_count))

    @property
    def shape(self) -> tuple[int, int]:
        return self.u.size, self.v.size

    def list_starts(self, period_map: PeriodMap) -> Float2D:
        """Return the coordinates of each start, (u_count v_count, n), v fastest."""
        return np.array([period_map.start(u, v) for u in self.u for v in self.v])


@dataclass(frozen=True, slots=True, eq=False)
class Basins:
    """Basins of attraction of a map.

    labels: index into `attractors` of each start, (u_count, v_count), `UNDECIDED` where no
    attractor was reached. cycles: from the start to its capture, same shape.
    """

    period_map: PeriodMap
    grid: StartGrid
    attractors: tuple[Attractor, ...]
    labels: Int1D
    cycles: Int1D

    @property
    def fractions(self) -> Float1D:
        """Share of the starts that each attractor attracts, (attractors,)."""
        return np.array([float((self.labels == i).mean()) for i in range(len(self.attractors))])

    @property
    def undecided_share(self) -> float:
        """Share of the starts that reached no attractor."""
        return float((self.labels == UNDECIDED).mean())


def compute_basins(period_map: PeriodMap, grid: StartGrid) -> Basins:
    """Compute the basin of every attractor that the starts of a grid reach.

    Starts are followed until an attractor captures them, see `AttractorSearch`.
    """
    search = AttractorSearch(period_map)
    labels, cycles = search.classify(grid.list_starts(period_map))
    shape = grid.shape
    return Basins(period_map, grid, search.attractors, labels.reshape(shape), cycles.reshape(shape))


def compute_basins_over(
    period_map: PeriodMap,
    parameter: str,
    values: Sequence[float] | Float1D,
    grid: StartGrid,
    map_jobs: ParallelMap = map,
) -> list[Basins]:
    """Compute the basins at each value of a parameter, see `PeriodMap`.

    The kernels release the GIL: with the `map` of a thread pool all cores are used. The results do
    not depend on it.
    """
    maps = [period_map.with_parameter(parameter, float(value)) for value in values]
    return list(map_jobs(lambda each: compute_basins(each, grid), maps))


@dataclass(frozen=True, slots=True, eq=False)
class BifurcationDiagram:
    """Attractors at each value of a parameter; an empty tuple where a motion did not settle."""

    period_map: PeriodMap
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


def record_section(period_map: PeriodMap, u: float, v: float, cycles: int) -> Float2D:
    """Return the Poincare section at phase 0 of the motion from (u, v): u in m, v in m/s, (n, 2).

    The first `TRANSIENT_CYCLES` are left out.
    """
    start = period_map.iterate(period_map.start(u, v), TRANSIENT_CYCLES)
    return period_map.record(start, cycles)[:, :2]


def follow_attractor(
    period_map: PeriodMap,
    parameter: str,
    values: Sequence[float] | Float1D,
    chaos_cycles: int = DIAGRAM_CHAOS_CYCLES,
) -> BifurcationDiagram:
    """Return the attractor at each value in the order given, the state carried on between them.

    The first motion starts from u = v = 0, relaxed.
    """
    columns: list[tuple[Attractor, ...]] = []
    for value in values:
        at_value = period_map.with_parameter(parameter, float(value))
        settled = columns[-1] if columns else ()
        start = settled[0].points[-1] if settled else at_value.start(0.0, 0.0)
        columns.append(_settle_from(at_value, start, chaos_cycles))
    values = np.asarray(values, dtype=float)
    return BifurcationDiagram(period_map, parameter, values, tuple(columns))


def _settle_from(period_map: PeriodMap, start: Float1D, chaos_cycles: int) -> tuple[Attractor, ...]:
    """Return the attractor to which a start settles; none if it does not."""
    search = AttractorSearch(period_map, chaos_cycles)
    labels, _ = search.classify(start[None].copy())
    return () if labels[0] == UNDECIDED else (search.attractors[labels[0]],)


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
        at_middle = diagram.period_map.with_parameter(diagram.parameter, middle)
        reached = _settle_from(at_middle, chaos.points[-1], DIAGRAM_CHAOS_CYCLES)
        if reached and reached[0].kind == "chaotic":
            inner, chaos = middle, reached[0]
        else:
            outer = middle
    return inner
