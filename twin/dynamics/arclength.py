"""Pseudo-arclength: the next point of a curve F(z) = 0, F: R^(m + 1) -> R^m, and its tangent.

Lengths are measured with a weight for each coordinate of z, so that a unit of the parameter and a
unit of the state count alike. The only continuation of this package: branches of orbits and loci of
bifurcations are curves of different F.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from scipy.linalg.lapack import dgesv

from table_io.block import Float1D, Float2D

MAX_ITERATIONS = 8
SOLVE_TOL = 1e-9  # weighted last Newton step of a square system
STEP_TOL = 1e-7  # weighted last Newton step; its square is a rounding error
MIN_STEP = 1e-7  # weighted length below which a step is not halved again
MAX_TURN_COS = 0.94  # cosine of the largest angle between the tangents of neighbors
SMALL_TURN_COS = 0.995  # of an angle after which the step may grow
LOCATION_TOL = 1e-11  # weighted length within which a point of a curve is located


class Linearization(Protocol):
    """Residual (m,) and Jacobian (m, m + 1) of F at a point."""

    @property
    def residual(self) -> Float1D: ...

    @property
    def jacobian(self) -> Float2D: ...


L = TypeVar("L", bound=Linearization)


@dataclass(frozen=True, slots=True, eq=False)
class CurvePoint(Generic[L]):
    """A point z of a curve and its tangent, a unit vector by `weights`.

    orientation: sign of the determinant of the Jacobian bordered by the tangent; it changes where
    two curves cross. `linearization`: F near z, within the last Newton step.
    """

    z: Float1D
    tangent: Float1D
    weights: Float1D
    orientation: float
    linearization: L
    iterations: int

    def distance(self, z: Float1D) -> float:
        """Return the weighted distance to z."""
        return weighted_length(z - self.z, self.weights)


class NoConvergence(Exception):
    """The corrector failed; `residual` is the last one, weighted by nothing."""

    def __init__(self, residual: float) -> None:
        super().__init__(f"residual {residual:.3g}")
        self.residual = residual


def weighted_length(dz: Float1D, weights: Float1D) -> float:
    """Return the weighted length of a difference."""
    scaled = dz * weights
    return math.sqrt(scaled.dot(scaled))


def correct(
    evaluate: Callable[[Float1D], L],
    guess: Float1D,
    direction: Float1D,
    weights: Float1D,
    max_distance: float = math.inf,
    tolerance: float = STEP_TOL,
) -> CurvePoint[L]:
    """Return the point of the curve in the plane through `guess` normal to `direction`.

    Newton's method; the tangent points to the side of `direction`. Raises NoConvergence, also for
    a point farther than the weighted `max_distance` from the guess.
    """
    m = guess.size - 1
    normal = direction * weights * weights
    matrix, right = np.empty((m + 1, m + 1), order="F"), np.zeros((m + 1, 2), order="F")
    right[m, 1] = 1.0
    z, residual = guess, math.inf
    for iteration in range(1, MAX_ITERATIONS + 1):
        linearization = evaluate(z)
        matrix[:m], matrix[m] = linearization.jacobian, normal
        right[:m, 0], right[m, 0] = linearization.residual, normal @ (z - guess)
        residual = math.sqrt(right[:m, 0] @ right[:m, 0])
        if not math.isfinite(residual):
            break
        lu, pivots, solution, info = dgesv(matrix, right)
        if info:
            break
        step = solution[:, 0]
        z = z - step
        length = weighted_length(step, weights)
        if not length < 10.0 * max_distance:
            break
        if length < tolerance:
            if weighted_length(z - guess, weights) > max_distance:
                break
            tangent = solution[:, 1] / weighted_length(solution[:, 1], weights)
            sign = _determinant_sign(lu.diagonal().tolist(), pivots.tolist())
            return CurvePoint(z, tangent, weights, sign, linearization, iteration)
    raise NoConvergence(residual)


def _determinant_sign(diagonal: list[float], pivots: list[int]) -> float:
    """Return the sign of a determinant from its LU decomposition."""
    negative = sum(value < 0 for value in diagonal)
    swaps = sum(row != pivot for row, pivot in enumerate(pivots))
    return -1.0 if (negative + swaps) % 2 else 1.0


def solve_square(
    evaluate: Callable[[Float1D], L], guess: Float1D, weights: Float1D
) -> tuple[Float1D, L]:
    """Return (z, linearization there) with F(z) = 0 for a square F; raises NoConvergence."""
    z, residual = guess, math.inf
    for _ in range(2 * MAX_ITERATIONS):
        linearization = evaluate(z)
        residual = math.sqrt(linearization.residual @ linearization.residual)
        if not math.isfinite(residual):
            break
        *_, step, info = dgesv(linearization.jacobian, linearization.residual)
        if info or not np.isfinite(step).all():
            break
        z = z - step
        if weighted_length(step, weights) < SOLVE_TOL:
            return z, linearization
    raise NoConvergence(residual)


def next_step(step: float, turn_cos: float, iterations: int, max_step: float) -> float:
    """Return the next weighted step from the turn and the Newton steps of the last."""
    if turn_cos > SMALL_TURN_COS and iterations <= 3:
        return min(2.0 * step, max_step)
    if turn_cos > 0.98 and iterations <= 4:
        return min(1.3 * step, max_step)
    return 0.8 * step if iterations > 4 else step


def unit_axis(size: int, value: float) -> Float1D:
    """Return the direction of the last coordinate, the parameter, with this length and sign."""
    axis = np.zeros(size)
    axis[-1] = value
    return axis


def correct_at_limit(
    evaluate: Callable[[Float1D], L], last: CurvePoint[L], new: CurvePoint[L], bounds: Float2D
) -> CurvePoint[L] | None:
    """Return the point at the first limit between two points; None without convergence.

    bounds (k, 2): limits of the last k coordinates.
    """
    first, which, limit = math.inf, 0, 0.0
    for index, (low, high) in enumerate(bounds.tolist()):
        k = index - len(bounds)
        edge = low if new.z[k] < low else high
        fraction = (edge - last.z[k]) / (new.z[k] - last.z[k]) if new.z[k] != last.z[k] else 2.0
        if 0.0 <= fraction < first:
            first, which, limit = fraction, k, edge
    guess = last.z + first * (new.z - last.z)
    guess[which] = limit
    axis = np.zeros(guess.size)
    axis[which] = math.copysign(1.0, new.z[which] - last.z[which]) / last.weights[which]
    try:
        return correct(evaluate, guess, axis, last.weights)
    except NoConvergence:
        return None


def passes(start: CurvePoint[L], last: CurvePoint[L], new: CurvePoint[L], weights: Float1D) -> bool:
    """Return whether a curve passes its start between two points, in the same direction."""
    chord, offset = (new.z - last.z) * weights, (start.z - last.z) * weights
    length = weighted_length(new.z - last.z, weights)
    along = float(offset @ chord) / length
    across = math.sqrt(max(float(offset @ offset) - along * along, 0.0))
    same_way = float((start.tangent * weights) @ chord) > 0.8 * length * weighted_length(
        start.tangent, weights
    )
    return 0 < along <= length and across < 0.1 * length and same_way


def null_direction(jacobian: Float2D, ahead: Float1D, weights: Float1D) -> Float1D:
    """Return the unit vector of the null space of a Jacobian (m, m + 1), towards `ahead`."""
    vector = np.linalg.svd(jacobian / weights)[2][-1] / weights
    return vector if (vector * weights) @ (ahead * weights) > 0 else -vector


def border_sign(jacobian: Float2D, tangent: Float1D, weights: Float1D) -> float:
    """Return the sign of the determinant of a Jacobian bordered by a tangent."""
    return float(np.sign(np.linalg.det(np.vstack([jacobian, tangent * weights * weights]))))


def locate_on_arc(
    evaluate: Callable[[Float1D], L],
    first: CurvePoint[L],
    second: CurvePoint[L],
    value: Callable[[CurvePoint[L]], float],
) -> CurvePoint[L]:
    """Return the point of a branch between two others at which a function of it is zero.

    Each iterate is a point of the branch, in a plane normal to the chord; bracketed secants
    (Illinois) choose the plane.
    """
    chord, weights = second.z - first.z, first.weights
    length = weighted_length(chord, weights)
    low, high, low_value, high_value = 0.0, 1.0, value(first), value(second)
    point, side = second, 0
    for _ in range(60):
        if (high - low) * length < LOCATION_TOL or low_value == high_value:
            break
        position = low - low_value * (high - low) / (high_value - low_value)
        if not low < position < high:
            position = (low + high) / 2
        near = first if position < 0.5 else second
        base = near.z + (position - (0.0 if near is first else 1.0)) * chord
        previous = point
        try:
            point = correct(
                evaluate, base if previous is second else _shift(previous, first, chord, position),
                chord / length, weights, tolerance=1e-9,
            )  # fmt: skip
        except NoConvergence:
            break
        here = value(point)
        if here == 0.0 or point.distance(previous.z) < LOCATION_TOL:
            break
        if here * low_value > 0:
            low, low_value = position, here
            high_value *= 0.5 if side == -1 else 1.0
            side = -1
        else:
            high, high_value = position, here
            low_value *= 0.5 if side == 1 else 1.0
            side = 1
    return point


def _shift(point: CurvePoint[L], first: CurvePoint[L], chord: Float1D, position: float) -> Float1D:
    """Return the point on a tangent in the plane at `position` of a chord."""
    normal = chord * first.weights * first.weights
    distance = position * (normal @ chord) - normal @ (point.z - first.z)
    return point.z + distance / (normal @ point.tangent) * point.tangent
