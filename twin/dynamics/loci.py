"""Loci of bifurcations in two parameters, such as folds and grazings over frequency and gap."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.dynamics.arclength import (
    MAX_TURN_COS,
    MIN_STEP,
    CurvePoint,
    NoConvergence,
    correct,
    correct_at_limit,
    next_step,
    passes,
    unit_axis,
)
from twin.dynamics.bifurcations import (
    Bifurcation,
    BifurcationKind,
    Extended,
    GrazingProblem,
    MultiplierProblem,
    contact_key,
)
from twin.dynamics.continuation import make_problem, orbit_weights
from twin.dynamics.orbits import Orbit
from twin.dynamics.period_map import FREQUENCY, GAP

LocusEndReason = Literal[
    "range end", "closed loop", "meets a grazing", "no convergence", "too many points"
]
Limits = tuple[float, float]
Point = CurvePoint[Extended]

MAX_POINTS = 2000
FIRST_STEP, MAX_STEP = 0.02, 0.2  # weighted: a unit is a tenth of a range, or the orbit's size


@dataclass(frozen=True, slots=True)
class LocusEnd:
    """Why a locus ends, where, and without convergence the residual."""

    reason: LocusEndReason
    values: tuple[float, float]
    residual: float = 0.0


@dataclass(frozen=True, eq=False)
class Locus:
    """Bifurcations of a kind in order along a curve over two parameters.

    values (points, 2): the parameters at each point; `orbits`: the orbit that bifurcates there.
    """

    kind: BifurcationKind
    parameters: tuple[str, str]
    values: Float2D
    orbits: tuple[Orbit, ...]
    ends: tuple[LocusEnd, LocusEnd]


def continue_locus(
    start: Bifurcation,
    parameters: tuple[str, str] = (FREQUENCY, GAP),
    limits: tuple[Limits, Limits] = ((0.5, 5.0), (0.0, 0.03)),
    *,
    max_step: float = MAX_STEP,
) -> Locus:
    """Follow a fold, period doubling, Neimark-Sacker or grazing over two parameters, both ways.

    InputError for a pitchfork, which has a locus only where a symmetry keeps it, and for a start
    outside of the limits. Other arguments as in `continue_branch`.
    """
    if start.kind == "pitchfork":
        raise InputError(
            "no locus of this kind",
            key="kind",
            value=start.kind,
            allowed="fold, period doubling, Neimark-Sacker or grazing",
        )
    values = make_problem(start.orbit, *parameters).start()
    for name, value, (low, high) in zip(parameters, values, limits, strict=True):
        if not low <= value <= high:
            raise InputError(
                "the bifurcation lies outside the range",
                key=name,
                value=float(value),
                allowed=f"{low:.6g} to {high:.6g}",
            )
    ahead = _follow(start, parameters, limits, 1, max_step)
    if ahead[1].reason == "closed loop":
        return _make_locus(start, parameters, ahead[0], (ahead[1], ahead[1]))
    before = _follow(start, parameters, limits, -1, max_step)
    return _make_locus(start, parameters, [*before[0][:0:-1], *ahead[0]], (before[1], ahead[1]))


def _make_locus(
    start: Bifurcation,
    parameters: tuple[str, str],
    points: list[Point],
    ends: tuple[LocusEnd, LocusEnd],
) -> Locus:
    problem = make_problem(start.orbit, *parameters)
    orbits = tuple(problem.make_orbit(p.z, p.linearization.result) for p in points)
    values = np.array([p.z[-2:] for p in points]).reshape(-1, 2)
    return Locus(start.kind, parameters, values, orbits, ends)


def _follow(
    start: Bifurcation,
    parameters: tuple[str, str],
    limits: tuple[Limits, Limits],
    sign: int,
    max_step: float,
) -> tuple[list[Point], LocusEnd]:
    """Return (points, why they end) of a locus that starts with the second parameter's `sign`."""
    problem = make_problem(start.orbit, *parameters)
    z = np.append(start.orbit.x, problem.start())
    bounds = np.array(limits)
    axis, weights = unit_axis(z.size, sign), np.ones(z.size)
    weights[:-2], weights[-2:] = orbit_weights(start.orbit), 10.0 / (bounds[:, 1] - bounds[:, 0])
    system: GrazingProblem | MultiplierProblem
    if start.kind == "grazing":
        system = GrazingProblem(problem)
    else:
        system = MultiplierProblem(problem, start.kind, weights)

    def finish(reason: LocusEndReason, residual: float = 0.0) -> tuple[list[Point], LocusEnd]:
        at = points[-1].z if points else z
        return points, LocusEnd(reason, (float(at[-2]), float(at[-1])), residual)

    points: list[Point] = []
    try:
        points.append(correct(system.evaluate, z, axis / weights, weights))
    except NoConvergence as error:
        return finish("no convergence", error.residual)
    key, step = contact_key(points[0].linearization.result.contacts), FIRST_STEP
    while len(points) < MAX_POINTS:
        last = points[-1]
        guess = _predict(points, step)
        try:
            new = correct(system.evaluate, guess, last.tangent, weights, step)
            turn_cos = float((new.tangent * weights) @ (last.tangent * weights))
            changes = contact_key(new.linearization.result.contacts) != key
            if turn_cos < MAX_TURN_COS or (changes and start.kind != "grazing"):
                raise NoConvergence(0.0)
        except NoConvergence as error:
            step *= 0.4
            if step < max(MIN_STEP, 1e-5):
                met = error.residual == 0.0
                return finish("meets a grazing" if met else "no convergence", error.residual)
            continue
        outside = (new.z[-2:] < bounds[:, 0]) | (new.z[-2:] > bounds[:, 1])
        if outside.any():
            limited = correct_at_limit(system.evaluate, last, new, bounds)
            if limited is not None:
                points.append(limited)
            return finish("range end")
        points.append(new)
        if len(points) > 5 and passes(points[0], last, new, points[0].weights):
            points.append(points[0])
            return finish("closed loop")
        step = next_step(step, turn_cos, new.iterations, max_step)
    return finish("too many points")


def _predict(points: list[Point], step: float) -> Float1D:
    """Return a point a weighted `step` along the last tangent, curved as before."""
    last = points[-1]
    guess = last.z + step * last.tangent
    if len(points) > 1:
        length = last.distance(points[-2].z)
        guess = guess + 0.5 * step * step / length * (last.tangent - points[-2].tangent)
    return guess
