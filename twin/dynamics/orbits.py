"""Periodic orbits of the model, stable or not: Newton's method on the stroboscopic map.

An orbit is a zero of P^n(x; parameters) - x. `OrbitProblem` is that equation for all continuation.
"""

import math
from collections.abc import Sequence
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
PENETRATION_TOL_M = 1e-7  # m: of sampled motion, whose drive is linear between samples
RETURN_TOL = 1e-3  # of the travel: error of the same sampled motion after an orbit
SAMPLES_PER_PERIOD = 2000


@dataclass(frozen=True, eq=False)
class Orbit:
    """A periodic orbit: coordinates x at a zero upcrossing of A and the map's Jacobian there.

    It repeats after `periods` periods of the drive. multipliers (n,): the Floquet multipliers over
    all of them, largest magnitude first. `contacts` as in `MapResult`.
    """

    period_map: PeriodMap
    frequency_hz: float
    acceleration_m_s2: float
    periods: int
    x: Float1D
    jacobian: Float2D
    multipliers: Complex1D
    contacts: tuple[int, ...]

    @property
    def stable(self) -> bool:
        return bool(abs(self.multipliers[0]) < 1)

    @cached_property
    def extremes(self) -> Float1D:
        """Extremes over the orbit, (8,), `stepped_sine.EXTREME_NAMES`; sums of the onsets."""
        return self.period_map.find_extremes(
            self.x, self.frequency_hz, self.acceleration_m_s2, self.periods
        )

    def extreme(self, name: str) -> float:
        """Return one of `EXTREME_NAMES`."""
        return float(self.extremes[EXTREME_NAMES.index(name)])

    @property
    def u_max(self) -> float:
        return self.extreme("u_max")

    @property
    def u_min(self) -> float:
        return self.extreme("u_min")

    def sample_motion(self, count: int) -> Float2D:
        """Return (7, count) samples of the orbit, `closed_form.OUTPUT_NAMES`."""
        return self.period_map.sample_motion(
            self.x, self.frequency_hz, self.acceleration_m_s2, self.periods, count
        )

    def is_admissible(self) -> bool:
        """Check densely sampled motion: it returns, no mass inside a bumper, no bumper pulls."""
        parameters = self.period_map.model.parameters
        u, _, _, f_r, f_l, u_r, u_l = self.sample_motion(SAMPLES_PER_PERIOD * self.periods)
        clearance = min((parameters.gap_r + u_r - u).min(), (u - u_l + parameters.gap_l).min())
        start = self.x[0]
        tolerance = PENETRATION_TOL_M + RETURN_TOL * float(np.ptp(u))
        returns = abs(u[-1] - start) < tolerance * max(1.0, abs(self.multipliers[0]))
        return bool(
            returns and clearance > -PENETRATION_TOL_M and f_r.min() >= 0 and f_l.max() <= 0
        )


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

    def __init__(
        self,
        period_map: PeriodMap,
        frequency_hz: float,
        acceleration_m_s2: float,
        periods: int,
        names: Sequence[str],
    ) -> None:
        self.names, self.periods, self.size = tuple(names), periods, period_map.size
        self.scales, self._identity = period_map.scales, np.eye(self.size)
        self._frequency_hz, self._level = frequency_hz, acceleration_m_s2
        self._map, self._maps = period_map, (tuple[float, ...](), period_map)
        self._columns = [find_columns(period_map, name) for name in self.names]
        for name in self.names:
            if name not in (FREQUENCY, LEVEL):
                period_map.parameter(name)  # refuses unknown names

    def start(self) -> Float1D:
        """Return the values of the parameters as given."""
        return np.array([
            {FREQUENCY: self._frequency_hz, LEVEL: self._level}[name]
            if name in (FREQUENCY, LEVEL)
            else self._map.parameter(name)
            for name in self.names
        ])  # fmt: skip

    def at(self, values: Sequence[float]) -> tuple[PeriodMap, float, float]:
        """Return (map, frequency in Hz, level in m/s2) at these values of the parameters."""
        frequency_hz, level = self._frequency_hz, self._level
        key: tuple[float, ...] = ()
        period_map = self._map
        for name, value in zip(self.names, values, strict=True):
            if name == FREQUENCY:
                frequency_hz = value
            elif name == LEVEL:
                level = value
            else:
                key = (*key, value)
        if key:
            if self._maps[0] != key:
                for name, value in zip(self.names, values, strict=True):
                    if name not in (FREQUENCY, LEVEL):
                        period_map = period_map.with_parameter(name, value)
                self._maps = key, period_map
            period_map = self._maps[1]
        return period_map, frequency_hz, level

    def map_result(self, z: Float1D) -> MapResult:
        """Return the map's result at z; NaN where the parameters are out of range."""
        n = self.size
        values = z[n:].tolist()
        try:
            period_map, frequency_hz, level = self.at(values)
        except InputError:
            frequency_hz = math.nan
        least_hz = MIN_FREQUENCY_RATIO * self._frequency_hz
        if not least_hz < frequency_hz < math.inf or period_map.size != n:
            return _undefined_result(n)
        return period_map.evaluate(z[:n], frequency_hz, level, self.periods)

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
        period_map, frequency_hz, level = self.at(z[self.size :].tolist())
        return Orbit(
            period_map, frequency_hz, level, self.periods, z[: self.size], result.jacobian,
            multipliers, result.contacts,
        )  # fmt: skip


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


def find_orbit(
    period_map: PeriodMap,
    frequency_hz: float,
    acceleration_m_s2: float,
    guess: Float1D,
    periods: int = 1,
) -> Orbit | None:
    """Return the orbit, stable or not, to which Newton's method leads from x = guess, or None."""
    problem = OrbitProblem(period_map, frequency_hz, acceleration_m_s2, periods, ())
    x = guess
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


def settle_to_orbit(
    period_map: PeriodMap,
    frequency_hz: float,
    acceleration_m_s2: float,
    start: Float1D | None = None,
    periods: int = 1,
) -> Orbit | None:
    """Return the stable orbit to which x = start (or rest) settles, or None."""
    x = period_map.rest() if start is None else start
    x = period_map.iterate(x, frequency_hz, acceleration_m_s2, SETTLING_PERIODS)
    orbit = find_orbit(period_map, frequency_hz, acceleration_m_s2, x, periods)
    return orbit if orbit is not None and orbit.stable else None
