"""Basins of attraction on a grid of initial states, and their sizes over a parameter.

A start is (u, v) at phase 0 of A = a sin(2 pi f t), with all memory relaxed: bumpers, and states
that effects bring.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Int1D
from table_io.errors import InputError
from twin.dynamics.attractors import Attractor, AttractorSearch
from twin.dynamics.stroboscopic import OperatingPoint, StroboscopicMap, make_stroboscopic_map
from twin.dynamics.stroboscopic_kernel import UNDECIDED

ParallelMap = Callable[..., Iterable["Basins"]]  # as `map`: a thread pool's uses all cores


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

    def make_states(self, stroboscopic: StroboscopicMap) -> Float1D:
        """Return the state of each start, (u_count v_count, size), v fastest."""
        return np.array([stroboscopic.make_state(u, v) for u in self.u for v in self.v])


@dataclass(frozen=True, slots=True, eq=False)
class Basins:
    """Basins of attraction at an operating point.

    labels: index into `attractors` of each start, (u_count, v_count), `UNDECIDED` where no
    attractor was reached. cycles: from the start to its capture, same shape.
    """

    point: OperatingPoint
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


def compute_basins(point: OperatingPoint, grid: StartGrid) -> Basins:
    """Compute the basin of every attractor that the starts of a grid reach.

    Starts are followed until an attractor captures them, see `AttractorSearch`.
    """
    stroboscopic = make_stroboscopic_map(point)
    search = AttractorSearch(stroboscopic)
    labels, cycles = search.classify(grid.make_states(stroboscopic))
    shape = grid.shape
    return Basins(point, grid, search.attractors, labels.reshape(shape), cycles.reshape(shape))


def compute_basins_over(
    point: OperatingPoint,
    parameter: str,
    values: Sequence[float] | Float1D,
    grid: StartGrid,
    map_jobs: ParallelMap = map,
) -> list[Basins]:
    """Compute the basins at each value of a parameter, see `OperatingPoint.with_parameter`.

    The kernels release the GIL: with the `map` of a thread pool all cores are used. The results do
    not depend on it.
    """
    points = [point.with_parameter(parameter, float(value)) for value in values]
    return list(map_jobs(lambda each: compute_basins(each, grid), points))
