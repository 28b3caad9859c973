"""Periodic orbits of the model, stable or not: Newton's method on the stroboscopic map.

An orbit is a zero of P^n(x; parameters) - x. `OrbitProblem` is that equation for all continuation.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.linalg.lapack import dgeev

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.dynamics.period_map import FREQUENCY, GAP, LEVEL, MapResult, PeriodMap
from twin.model.stepped_sine import EXTREME_NAMES

Complex1D = npt.NDArray[np.complex128]

SETTLING_PERIODS = 400  # periods to settle on a stable orbit
MAX_NEWTON_STEPS = 40
RESIDUAL_TOL = 1e-10  # of the orbit's size; a last Newton step then leaves rounding errors only
DIFFERENCE_STEP = 1e-6  # relative step of central differences by other parameters
MIN_FREQUENCY_RATIO = 0.02  # of an iterate to the start: a long period costs much time
SAME_ORBIT = 1e-5  # of the size: distance of two orbits that are the same
MAX_ORBIT_DISTANCE = 0.1  # of the size: from a motion to the orbit that attracts it


@dataclass(frozen=True, eq=False)
class Orbit:
    """A periodic orbit: coordinates x at a zero upcrossing of A and the map's Jacobian there.

    It repeats after `periods` periods of the drive. multipliers (n,): the Floquet multipliers over
    all of them, largest magnitude first. `contacts` as in `MapResult`.
    """

    period_map: PeriodMap
    periods: int
    x: Float1D
    jacobian: Float2D
    multipliers: Complex1D
    contacts: tuple[int, ...]

    @property
    def frequency_hz(self) -> float:
        return self.period_map.frequency_hz

    @property
    def acceleration_m_s2(self) -> float:
        return self.period_map.acceleration_m_s2

    @property
    def stable(self) -> bool:
        return bool(abs(self.multipliers[0]) < 1)

    @property
    def size_m(self) -> float:
        """Largest coordinate in m, at least 1e-12 m."""
        return max(motion_size(self.x, self.period_map.scales), 1e-12)

    @cached_property
    def extremes(self) -> Float1D:
        """Extremes over the orbit, (8,), `stepped_sine.EXTREME_NAMES`; sums of the onsets."""
        return self.period_map.find_extremes(self.x, self.periods)

    def extreme(self, name: str) -> float:
        """Return one of `EXTREME_NAMES`."""
        return float(self.extremes[EXTREME_NAMES.index(name)])

    @property
    def u_max(self) -> float:
        return self.extreme("u_max")

    @property
    def u_min(self) -> float:
        return self.extreme("u_min")

    @cached_property
    def phases(self) -> Float2D:
        """Coordinates at each period of the drive, from x on, (periods, n)."""
        return np.array([self.x, *self.period_map.record(self.x, self.periods)[:-1]])

    def sample_motion(self, count: int) -> Float2D:
        """Return (7, count) samples of the orbit, `closed_form.OUTPUT_NAMES`."""
        return self.period_map.sample_motion(self.x, self.periods, count)

    def is_same(self, other: "Orbit") -> bool:
        """Return whether an orbit at the same parameters is this one, up to whole periods."""
        limit = SAME_ORBIT * max(self.size_m, other.size_m)
        return self.periods == other.periods and self.passes(other.x, limit)

    def passes(self, x: Float1D, limit_m: float) -> bool:
        """Return whether a phase of the orbit lies within `limit_m` of x."""
        return self.distance(x) < limit_m

    def distance(self, x: Float1D) -> float:
        """Return the distance in m of x from the nearest phase."""
        return float((np.abs(self.phases - x) / self.period_map.scales).max(axis=1).min())


def floquet_multipliers(jacobian: Float2D) -> Complex1D:
    """Return the eigenvalues in order of falling magnitude, NaN without convergence, (n,)."""
    real, imaginary, _, _, info = dgeev(jacobian, compute_vl=0, compute_vr=0)
    values = real + 1j * imaginary if not info else np.full(real.size, math.nan + 0j)
    return values[np.argsort(-np.abs(values), kind="stable")]


class Evaluation(NamedTuple):
    """Residual (n,) of the orbit equation, its Jacobian (n, n + k) by x and k parameters."""

    residual: Float1D
    jacobian: Float2D
    result: MapResult


class OrbitProblem:
    """The equation P^n(x; p) - x = 0 in z = (x, p), for k named parameters p.

    Names as in `PeriodMap`. Derivatives by parameters are those of the map, otherwise central
    differences.
    """

    def __init__(self, period_map: PeriodMap, periods: int, *names: str) -> None:
        self.names, self.periods, self.size = names, periods, period_map.size
        self.scales, self._identity = period_map.scales, np.eye(self.size)
        self._map = period_map
        self._varied: tuple[tuple[float, ...], PeriodMap] = ((), period_map)
        self.start()  # refuses unknown names
        self._columns = [find_columns(period_map, name) for name in names]

    def start(self) -> Float1D:
        """Return the values of the parameters as given."""
        return np.array([self._map.parameter(name) for name in self.names])

    def at(self, *values: float) -> PeriodMap:
        """Return the map at these values of the parameters."""
        named = dict(zip(self.names, values, strict=True))
        drive = {name: named.pop(name) for name in (FREQUENCY, LEVEL) if name in named}
        period_map = self._map
        if named:
            key = tuple(named.values())
            if self._varied[0] != key:
                for name, value in named.items():
                    period_map = period_map.with_parameter(name, value)
                self._varied = key, period_map
            period_map = self._varied[1]
        for name, value in drive.items():
            period_map = period_map.with_parameter(name, value)
        return period_map

    def map_result(self, z: Float1D) -> MapResult:
        """Return the map's result at z; NaN where the parameters are out of range."""
        n = self.size
        try:
            period_map = self.at(*z[n:].tolist())
        except InputError:
            return _undefined_result(n)
        least_hz = MIN_FREQUENCY_RATIO * self._map.frequency_hz
        if not least_hz < period_map.frequency_hz < math.inf or period_map.size != n:
            return _undefined_result(n)
        return period_map.evaluate(z[:n], self.periods)

    def evaluate(self, z: Float1D) -> Evaluation:
        """Return residual and Jacobian at z."""
        n, result = self.size, self.map_result(z)
        jacobian = np.empty((n, z.size))
        jacobian[:, :n] = result.jacobian - self._identity
        for index, columns in enumerate(self._columns):
            if columns:
                total = result.d_parameters[:, columns[0]]
                for column in columns[1:]:
                    total = (total + result.d_parameters[:, column]) / 2
                jacobian[:, n + index] = total
            else:
                jacobian[:, n + index] = self._difference(z, n + index)
        return Evaluation(result.end - z[:n], jacobian, result)

    def vary_minimum(self, z: Float1D, evaluation: Evaluation, row: int) -> Float1D:
        """Return the derivatives by z, (n + k,), of the value of a row of `MapResult.minima`."""
        n, minimum = self.size, evaluation.result.minima[row]
        gradient = np.empty(z.size)
        gradient[:n] = minimum[3 : 3 + n]
        for index, columns in enumerate(self._columns):
            if columns:
                gradient[n + index] = sum(minimum[3 + n + c] for c in columns) / len(columns)
                continue
            step = np.zeros(z.size)
            step[n + index] = difference_step(z[n + index])
            ends = []
            for sign in (1, -1):
                minima = self.map_result(z + sign * step).minima
                near = find_minimum(minima, minimum)
                ends.append(math.nan if near is None else minima[near, 2])
            gradient[n + index] = (ends[0] - ends[1]) / (2 * step[n + index])
        return gradient

    def _difference(self, z: Float1D, index: int) -> Float1D:
        step = np.zeros(z.size)
        step[index] = difference_step(z[index])
        ends = [self.map_result(z + sign * step).end for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * step[index])

    def make_orbit(
        self, z: Float1D, result: MapResult, multipliers: Complex1D | None = None
    ) -> Orbit:
        """Return the orbit at a zero z of the equation."""
        if multipliers is None:
            multipliers = floquet_multipliers(result.jacobian)
        period_map, x = self.at(*z[self.size :].tolist()), z[: self.size]
        return Orbit(period_map, self.periods, x, result.jacobian, multipliers, result.contacts)


def difference_step(value: float) -> float:
    """Return the step of a central difference by a parameter."""
    return DIFFERENCE_STEP * max(abs(value), 1e-3)


def find_columns(period_map: PeriodMap, name: str) -> list[int]:
    """Return the columns of `d_parameters` whose mean is the derivative by a parameter."""
    names = period_map.derivatives
    if name == GAP and "gap_r" in names and "gap_l" in names:
        return [names.index("gap_r"), names.index("gap_l")]
    return [names.index(name)] if name in names else []


def find_minimum(minima: Float2D, like: Float1D) -> int | None:
    """Return the row of `MapResult.minima` of the same guard, nearest in time to another row."""
    candidates = np.flatnonzero(minima[:, 1] == like[1])
    if not candidates.size:
        return None
    return int(candidates[np.abs(minima[candidates, 0] - like[0]).argmin()])


def _undefined_result(n: int) -> MapResult:
    nan = np.full((n, n), math.nan)
    return MapResult(nan[0], nan, np.full((n, 4), math.nan), (0,), np.empty((0, n + 7)))


def find_orbit(period_map: PeriodMap, guess: Float1D, periods: int = 1) -> Orbit | None:
    """Return the orbit, stable or not, to which Newton's method leads from x = guess, or None."""
    problem, x = OrbitProblem(period_map, periods), guess
    for _ in range(MAX_NEWTON_STEPS):
        residual, jacobian, result = problem.evaluate(x)
        if not np.isfinite(residual).all():
            return None
        try:
            step = np.linalg.solve(jacobian, residual)
        except np.linalg.LinAlgError:
            return None
        x = x - step
        size = motion_size(x, period_map.scales)
        if motion_size(residual, period_map.scales) < RESIDUAL_TOL * size:
            return problem.make_orbit(x, result)
    return None


def motion_size(x: Float1D, scales: Float1D) -> float:
    """Return the largest coordinate in m."""
    return float(np.abs(x / scales).max())


def reduce_period(orbit: Orbit) -> Orbit:
    """Return an orbit with its least period; itself if that is what it has."""
    scales = orbit.period_map.scales
    limit = SAME_ORBIT * motion_size(orbit.x, orbit.period_map.scales)
    for periods in range(1, orbit.periods // 2 + 1):
        returned = motion_size(orbit.phases[periods] - orbit.x, scales)
        if orbit.periods % periods == 0 and returned < limit:
            return find_orbit(orbit.period_map, orbit.x, periods) or orbit
    return orbit


def find_attracting_orbit(
    period_map: PeriodMap, x: Float1D, periods: int, size_m: float
) -> Orbit | None:
    """Return the stable orbit near x of a motion of this size, with its least period, or None."""
    orbit = find_orbit(period_map, x, periods)
    if orbit is None or not orbit.stable:
        return None
    is_near = motion_size(orbit.x - x, period_map.scales) < MAX_ORBIT_DISTANCE * size_m
    return reduce_period(orbit) if is_near else None


def settle_to_orbit(period_map: PeriodMap, start: Float1D | None = None) -> Orbit | None:
    """Return the stable orbit to which x = start (or rest) settles, or None."""
    x = period_map.iterate(period_map.rest() if start is None else start, SETTLING_PERIODS)
    orbit = find_orbit(period_map, x)
    return orbit if orbit is not None and orbit.stable else None
