"""Bifurcations of periodic orbits: what detects each kind, and the equations that locate it.

fold, pitchfork     a multiplier +1     det(J - I) = 0; at a pitchfork two curves cross
period doubling     a multiplier -1     det(J + I) = 0
Neimark-Sacker      a pair on the unit circle
grazing             a contact appears or vanishes: the minimum of a contact guard is zero
"""

import math
from dataclasses import dataclass
from itertools import combinations
from typing import Literal, NamedTuple

import numpy as np

from table_io.block import Float1D, Float2D
from twin.dynamics.arclength import CurvePoint
from twin.dynamics.orbits import (
    Complex1D,
    Evaluation,
    Orbit,
    OrbitProblem,
    find_minimum,
    floquet_multipliers,
)
from twin.dynamics.period_map import MapResult

BifurcationKind = Literal["fold", "period doubling", "pitchfork", "Neimark-Sacker", "grazing"]
Guard = Literal["clearance", "push"]
ContactKey = tuple[int, ...]

GRADIENT_STEP = 1e-6  # of the weighted unit: central differences of a test function


@dataclass(frozen=True, eq=False)
class Bifurcation:
    """A bifurcation at `value` of the branch's parameter, at the point `index` of the branch.

    At a grazing: `side`, "both" at once where the orbit is symmetric, and the `guard` that touches
    zero: the clearance of a flight (a contact appears or vanishes) or the push of a contact (it
    parts in two). `turns_back`: the parameter reverses there, as at a fold.
    """

    kind: BifurcationKind
    value: float
    orbit: Orbit
    index: int
    side: Literal["right", "left", "both", ""] = ""
    guard: Guard | Literal[""] = ""
    turns_back: bool = False


def contact_key(contacts: tuple[int, ...]) -> ContactKey:
    """Return what changes at a grazing only: the events of a period, or the regime without any."""
    return tuple(sorted(contacts[1:])) or contacts


def count_unstable(multipliers: Complex1D) -> tuple[int, int]:
    """Return the number of multipliers below -1, and of those in pairs outside the unit circle."""
    below = pairs = 0
    for multiplier in multipliers.tolist():
        if multiplier.imag:
            pairs += abs(multiplier) > 1
        else:
            below += multiplier.real < -1
    return below, pairs


def evaluate_criterion(kind: BifurcationKind, jacobian: Float2D) -> float:
    """Return a function of the map's Jacobian that changes sign at a bifurcation of this kind."""
    if kind == "Neimark-Sacker":
        multipliers = floquet_multipliers(jacobian).tolist()
        return math.prod(((a * b - 1) for a, b in combinations(multipliers, 2)), start=1 + 0j).real
    shift = 1.0 if kind == "period doubling" else -1.0
    return float(np.linalg.det(jacobian + shift * np.eye(len(jacobian))))


def detect_bifurcations(
    first: CurvePoint[Evaluation],
    second: CurvePoint[Evaluation],
    multipliers: tuple[Complex1D, Complex1D],
) -> list[BifurcationKind]:
    """Return the kinds of bifurcation between two neighbors on a branch with the same contacts."""
    kinds: list[BifurcationKind] = []
    if first.tangent[-1] * second.tangent[-1] < 0:
        kinds.append("fold")
    if first.orientation * second.orientation < 0:
        kinds.append("pitchfork")
    (below, pairs), (new_below, new_pairs) = map(count_unstable, multipliers)
    if (below - new_below) % 2:
        kinds.append("period doubling")
    values = (
        [
            evaluate_criterion("Neimark-Sacker", p.linearization.result.jacobian)
            for p in (first, second)
        ]
        if pairs != new_pairs
        else [1.0, 1.0]
    )
    if values[0] * values[1] < 0 and all(np.iscomplex(m[0]) for m in multipliers):
        kinds.append("Neimark-Sacker")
    return kinds


class Extended(NamedTuple):
    """Residual (n + 1,) and Jacobian (n + 1, n + k) of an orbit that bifurcates."""

    residual: Float1D
    jacobian: Float2D
    result: MapResult


class GrazingProblem:
    """The equations of a grazing orbit: P^n(x; p) - x = 0 and the minimum of a guard is zero.

    One-sided derivatives, of the side on which z lies; Newton's method converges from either. The
    guard is the one nearest to zero at the first evaluation, then the one nearest in time.
    """

    def __init__(self, problem: OrbitProblem) -> None:
        self.orbits = problem
        self.minimum: Float1D | None = None

    def evaluate(self, z: Float1D) -> Extended:
        """Return residual and Jacobian at z; NaN if the guard has no minimum any more."""
        evaluation = self.orbits.evaluate(z)
        n, minima = self.orbits.size, evaluation.result.minima
        row = None
        if self.minimum is not None:
            row = find_minimum(minima, self.minimum)
        elif len(minima):
            row = int(np.abs(minima[:, 2]).argmin())
        residual, jacobian = np.full(n + 1, math.nan), np.empty((n + 1, z.size))
        residual[:n], jacobian[:n] = evaluation.residual, evaluation.jacobian
        if row is not None:
            self.minimum = minima[row].copy()
            residual[n] = minima[row, 2]
            jacobian[n] = self.orbits.vary_minimum(z, evaluation, row)
        return Extended(residual, jacobian, evaluation.result)


class CrossingProblem:
    """The equations of a branch point in (z, g), z = (x, p): two curves of orbits cross there.

    P^n(x; p) - x + g b = 0 and the Jacobian [J - I, dP/dp] loses rank: its bordering by b and by
    two rows c gives two scalars that vanish. b and c span the null spaces at the first z, and the
    unfolding g is zero at the solution.
    """

    def __init__(self, problem: OrbitProblem, z: Float1D, weights: Float1D) -> None:
        self.orbits, self._weights = problem, weights
        left, _, right = np.linalg.svd(problem.evaluate(z).jacobian / weights)
        self._b, self._c = left[:, -1], right[-2:] * weights
        self._gradient: Float2D | None = None  # of the first z, near enough to the solution

    def evaluate(self, z: Float1D) -> Extended:
        """Return residual and Jacobian at (z, g), (n + 2,)."""
        n = self.orbits.size
        evaluation = self.orbits.evaluate(z[:-1])
        residual, jacobian = np.empty(n + 2), np.zeros((n + 2, n + 2))
        residual[:n] = evaluation.residual + z[-1] * self._b
        residual[n:] = self._measure_rank(evaluation.jacobian)
        jacobian[:n, :-1], jacobian[:n, -1] = evaluation.jacobian, self._b
        if self._gradient is None:
            self._gradient = self._differentiate_rank(z[:-1])
        jacobian[n:, :-1] = self._gradient
        return Extended(residual, jacobian, evaluation.result)

    def _differentiate_rank(self, z: Float1D) -> Float2D:
        """Return the derivatives of `_measure_rank` by z, (2, n + 1)."""
        gradient = np.empty((2, z.size))
        for index in range(z.size):
            step = np.zeros(z.size)
            step[index] = GRADIENT_STEP / self._weights[index]
            ends = [
                self._measure_rank(self.orbits.evaluate(z + sign * step).jacobian)
                for sign in (1, -1)
            ]
            gradient[:, index] = (ends[0] - ends[1]) / (2 * step[index])
        return gradient

    def _measure_rank(self, jacobian: Float2D) -> Float1D:
        """Return the two scalars that vanish where the Jacobian (n, n + 1) has rank n - 1."""
        n = len(jacobian)
        bordered, right = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
        bordered[:n, :-1], bordered[:n, -1], bordered[n:, :-1] = jacobian, self._b, self._c
        right[-1] = 1.0
        if not np.isfinite(jacobian).all():
            return np.full(2, math.nan)
        return np.asarray(np.linalg.solve(bordered.T, right)[n:], dtype=np.float64)


class MultiplierProblem:
    """The equations of a fold, period doubling or Neimark-Sacker bifurcation of an orbit.

    P^n(x; p) - x = 0 and `evaluate_criterion` = 0, whose gradient is taken by central differences.
    """

    def __init__(self, problem: OrbitProblem, kind: BifurcationKind, weights: Float1D) -> None:
        self.orbits, self.kind, self.weights = problem, kind, weights

    def evaluate(self, z: Float1D) -> Extended:
        """Return residual and Jacobian at z."""
        n, evaluation = self.orbits.size, self.orbits.evaluate(z)
        residual, jacobian = np.empty(n + 1), np.empty((n + 1, z.size))
        residual[:n], jacobian[:n] = evaluation.residual, evaluation.jacobian
        residual[n] = evaluate_criterion(self.kind, evaluation.result.jacobian)
        for index in range(z.size):
            step = np.zeros(z.size)
            step[index] = GRADIENT_STEP / self.weights[index]
            ends = [
                evaluate_criterion(self.kind, self.orbits.map_result(z + sign * step).jacobian)
                for sign in (1, -1)
            ]
            jacobian[n, index] = (ends[0] - ends[1]) / (2 * step[index])
        return Extended(residual, jacobian, evaluation.result)
