"""Branches of periodic orbits over frequency, level, gap or any parameter of a model.

A branch is followed by pseudo-arclength through folds. Its step adapts: it falls towards a grazing
orbit, where the Jacobian jumps, starts small behind it, where the Jacobian changes with the square
root of the depth, and grows again. Every bifurcation is located on the branch itself, and each end
of a branch states its reason.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.dynamics.arclength import (
    MAX_TURN_COS,
    MIN_STEP,
    CurvePoint,
    NoConvergence,
    border_sign,
    correct,
    correct_at_limit,
    locate_on_arc,
    next_step,
    null_direction,
    passes,
    solve_square,
    unit_axis,
    weighted_length,
)
from twin.dynamics.bifurcations import (
    Bifurcation,
    BifurcationKind,
    ContactKey,
    CrossingProblem,
    GrazingProblem,
    contact_key,
    detect_bifurcations,
    evaluate_criterion,
)
from twin.dynamics.orbits import (
    SAME_ORBIT,
    Complex1D,
    Evaluation,
    Orbit,
    OrbitProblem,
    find_orbit,
    floquet_multipliers,
    motion_size,
)

EndReason = Literal[
    "start", "range end", "closed loop", "meets another branch", "no convergence",
    "too many points",
]  # fmt: skip
Point = CurvePoint[Evaluation]

MAX_POINTS = 3000
SIZE_MEMORY = 0.9  # by which the size that distances are relative to may fall in a step
FIRST_STEP, MAX_STEP = 0.02, 0.3  # weighted: a unit is a tenth of the range, or the orbit's size
GRAZING_STEP = 0.02  # weighted: a larger step over a change of contacts is repeated
STEP_BEYOND_GRAZING = 2e-3
PROBE_DISTANCES = (1e-6, 1e-5, 1e-4)  # beyond a grazing orbit, for the Jacobian there
# x bends where an event passes through the start of the period, even back: at this step a turn is
# accepted, and a point so many steps, or so far, from its prediction.
BEND_STEP, MAX_BEND, BEND_REACH = 1e-4, 30.0, 5e-3
SIMULTANEOUS_TOL = 1e-8  # of the size: guards this near to zero touch in the same orbit
SAME_GRAZING = 1e-9  # weighted distance of one grazing orbit from itself
SWITCH_STEP = 0.02  # weighted amplitude of the first orbit of a branch that bifurcates
CROSSING_TOL = 1e-8  # weighted residual of the orbit equation where two branches cross
CROSSING_STEP = 0.02  # weighted: a larger step over a crossing is repeated
NEAR_ORBIT = 0.5  # of the size: distance of interpolated orbits that are worth refining
MAX_SLOPE_RATIO = 1.5  # of a tangent over a chord, 1 on a straight branch and 2 on a parabola


@dataclass(frozen=True, slots=True, eq=False)
class BranchPoint:
    """An orbit of a branch, at `value` of the branch's parameter."""

    value: float
    orbit: Orbit


@dataclass(frozen=True, slots=True)
class BranchEnd:
    """Why a branch ends: `value` of its parameter there and, without convergence, the residual."""

    reason: EndReason
    value: float
    residual: float = 0.0


@dataclass(frozen=True, eq=False)
class Branch:
    """Orbits in order along a branch, its bifurcations in the same order, and why it ends.

    Located bifurcations are among the points.
    """

    parameter: str
    points: tuple[BranchPoint, ...]
    bifurcations: tuple[Bifurcation, ...]
    ends: tuple[BranchEnd, BranchEnd]

    @property
    def values(self) -> Float1D:
        """Parameter at the points, (points,)."""
        return np.array([point.value for point in self.points])

    @property
    def stable(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Stability of the points, (points,)."""
        return np.array([point.orbit.stable for point in self.points])

    def extreme(self, name: str) -> Float1D:
        """Return one of `stepped_sine.EXTREME_NAMES` at the points, (points,)."""
        return np.array([point.orbit.extreme(name) for point in self.points])

    @property
    def folds(self) -> tuple[Bifurcation, ...]:
        """Folds, and grazings at which the branch turns back."""
        return tuple(b for b in self.bifurcations if b.turns_back)

    def of_kind(self, *kinds: BifurcationKind) -> tuple[Bifurcation, ...]:
        """Return the bifurcations of these kinds."""
        return tuple(b for b in self.bifurcations if b.kind in kinds)

    def orbits_at(self, value: float) -> list[Orbit]:
        """Return the orbit at this value on each pass of the branch, by Newton's method."""
        orbits = []
        for first, second in zip(self.points, self.points[1:], strict=False):
            if (first.value - value) * (second.value - value) <= 0 and first.value != second.value:
                orbit = self._interpolate(first, second, value)
                if orbit is not None:
                    orbits.append(orbit)
        return orbits

    def contains(self, orbit: Orbit) -> bool:
        """Return whether an orbit is one of this branch, at any of its phases."""
        if self.points[0].orbit.periods != orbit.periods:
            return False
        value, scales = orbit.period_map.parameter(self.parameter), orbit.period_map.scales
        size = max(motion_size(x, scales) for x in orbit.phases)
        limit = SAME_ORBIT * size
        for first, second in zip(self.points, self.points[1:], strict=False):
            if (first.value - value) * (second.value - value) > 0:
                continue
            span = second.value - first.value
            fraction = (value - first.value) / span if span else 0.0
            chord = second.orbit.x - first.orbit.x
            guess = first.orbit.x + fraction * chord
            distance = orbit.distance(guess)
            if distance > NEAR_ORBIT * size + motion_size(chord, scales):
                continue
            if distance < limit:
                return True
            refined = find_orbit(orbit.period_map, guess, orbit.periods)
            if refined is not None and orbit.passes(refined.x, limit):
                return True
        return False

    def _interpolate(self, first: BranchPoint, second: BranchPoint, value: float) -> Orbit | None:
        fraction = (value - first.value) / (second.value - first.value)
        if fraction == 0.0:
            return None if first is not self.points[0] else first.orbit
        problem = make_problem(first.orbit, self.parameter)
        z0, z1 = (np.append(p.orbit.x, p.value) for p in (first, second))
        axis, weights = unit_axis(z0.size, 1.0), np.ones(z0.size)
        weights[:-1] = orbit_weights(first.orbit)
        guess = z0 + fraction * (z1 - z0)
        guess[-1] = value
        try:
            point = correct(problem.evaluate, guess, axis, weights)
        except NoConvergence:
            return None
        return problem.make_orbit(point.z, point.linearization.result)


def split_by_stability(stable: Sequence[bool]) -> list[tuple[int, int, bool]]:
    """Return (first, last, stable) of the pieces of a curve; neighbors share a point.

    The segment between two points is stable if both are: a bifurcation point ends a piece.
    """
    pieces: list[tuple[int, int, bool]] = []
    for index in range(len(stable) - 1):
        is_stable = bool(stable[index] and stable[index + 1])
        if pieces and pieces[-1][2] == is_stable:
            pieces[-1] = (pieces[-1][0], index + 1, is_stable)
        else:
            pieces.append((index, index + 1, is_stable))
    return pieces


def make_problem(orbit: Orbit, *names: str) -> OrbitProblem:
    """Return the equation of an orbit's continuation over these parameters."""
    return OrbitProblem(orbit.period_map, orbit.periods, *names)


def orbit_weights(orbit: Orbit) -> Float1D:
    """Return the weights of x, (n,), by which its largest coordinate is about 1."""
    return 1.0 / (orbit.period_map.scales * orbit.size_m)


def continue_branch(
    start: Orbit,
    parameter: str,
    limits: tuple[float, float],
    direction: int = 0,
    *,
    max_points: int = MAX_POINTS,
) -> Branch:
    """Follow the branch of an orbit over a parameter within limits; InputError outside of them.

    parameter: "frequency" in Hz, "level" in m/s2, "gap" (total) in m or a name of `Model.flatten`.
    direction: +1 starts towards larger values, -1 towards smaller ones; 0 follows both ways.
    """
    problem = make_problem(start, parameter)
    value = float(problem.start()[0])
    if not limits[0] <= value <= limits[1]:
        raise InputError(
            "the orbit lies outside the range",
            key=parameter,
            value=value,
            allowed=f"{limits[0]:.6g} to {limits[1]:.6g}",
        )

    def trace(sign: int) -> _Trace:
        tracer = _Trace(problem, limits, max_points)
        return tracer.follow(np.append(start.x, value), unit_axis(start.x.size + 1, sign))

    if direction:
        return trace(direction).branch(parameter)
    ahead = trace(+1)
    if ahead.end.reason == "closed loop":
        return ahead.branch(parameter)
    return ahead.branch(parameter, trace(-1))


def switch_branch(
    bifurcation: Bifurcation,
    parameter: str,
    limits: tuple[float, float],
    *,
    side: int = 1,
    max_points: int = MAX_POINTS,
) -> Branch:
    """Follow the branch that leaves at a period doubling or pitchfork, InputError elsewhere.

    `side` -1 leaves the other way: the mirrored orbits at a pitchfork of a symmetric model, the
    same ones one period later at a period doubling. Other arguments as in `continue_branch`.
    """
    orbit = bifurcation.orbit
    if bifurcation.kind not in ("period doubling", "pitchfork"):
        raise InputError(
            "no branch leaves here",
            key="kind",
            value=bifurcation.kind,
            allowed="period doubling or pitchfork",
        )
    doubles = bifurcation.kind == "period doubling"
    values, vectors = np.linalg.eig(orbit.jacobian)
    vector = vectors[:, np.abs(values - (-1.0 if doubles else 1.0)).argmin()].real
    problem = OrbitProblem(orbit.period_map, orbit.periods * (2 if doubles else 1), parameter)
    tracer = _Trace(problem, limits, max_points)
    start = np.append(orbit.x, problem.start())
    return tracer.follow(start, side * np.append(vector, 0.0), leaves=True).branch(parameter)


class _Trace:
    """A branch while it is followed in one direction."""

    def __init__(
        self,
        problem: OrbitProblem,
        limits: tuple[float, float],
        max_points: int,
    ) -> None:
        self._problem, self._limits = problem, limits
        self._max_points = max_points
        self._range = max(limits[1] - limits[0], 1e-12)
        self.points: list[BranchPoint] = []
        self.bifurcations: list[Bifurcation] = []
        self.end = BranchEnd("too many points", math.nan)
        self._finished = False
        self._size = 1e-12

    def branch(self, parameter: str, before: "_Trace | None" = None) -> Branch:
        """Return the branch; `before` was followed from the same start the other way."""
        if before is None:
            closes = self.end.reason == "closed loop"
            start = self.end if closes else BranchEnd("start", self.points[0].value)
            return Branch(
                parameter, tuple(self.points), tuple(self.bifurcations), (start, self.end)
            )
        shift = len(before.points) - 1
        points = (*before.points[:0:-1], *self.points)
        bifurcations = (
            *(replace(b, index=shift - b.index) for b in before.bifurcations[::-1]),
            *(replace(b, index=shift + b.index) for b in self.bifurcations),
        )
        return Branch(parameter, points, bifurcations, (before.end, self.end))

    def follow(self, start: Float1D, direction: Float1D, leaves: bool = False) -> "_Trace":
        """Follow the branch from z = start until it ends; return this.

        `leaves`: another branch passes through the start, so the direction is its tangent.
        """
        weights = self._weights(start)
        direction = direction / weighted_length(direction, weights)
        try:
            first = correct(self._problem.evaluate, start, direction, weights)
        except NoConvergence as error:
            if not leaves:
                self._finish("no convergence", start[-1], error.residual)
                return self
            # Singular, as two curves cross there.
            evaluation = self._problem.evaluate(start)
            first = CurvePoint(start, direction, weights, 0.0, evaluation, 0)
        if leaves:
            first = CurvePoint(start, direction, weights, 0.0, first.linearization, 0)
        self._start = self._point = first
        self._step = SWITCH_STEP if leaves else FIRST_STEP
        self._key = contact_key(first.linearization.result.contacts)
        self._multipliers = floquet_multipliers(first.linearization.result.jacobian)
        self._curvature = np.zeros(start.size)
        self._key_before: ContactKey | None = None  # contacts before the last grazing orbit
        self._grazing: Float1D | None = None
        self._append(first)
        while not self._finished:
            if len(self.points) >= self._max_points:
                self._finish("too many points", self._point.z[-1])
                break
            self._advance()
        return self

    def _weights(self, z: Float1D) -> Float1D:
        """Return the weights of z, by the size of the orbit; it may pass through zero."""
        scales, weights = self._problem.scales, np.empty(z.size)
        self._size = max(motion_size(z[:-1], scales), SIZE_MEMORY * self._size)
        weights[:-1], weights[-1] = 1.0 / (scales * self._size), 10.0 / self._range
        return weights

    def _finish(self, reason: EndReason, value: float, residual: float = 0.0) -> None:
        self.end, self._finished = BranchEnd(reason, float(value), residual), True

    def _append(self, point: Point, multipliers: Complex1D | None = None) -> Orbit:
        orbit = self._problem.make_orbit(point.z, point.linearization.result, multipliers)
        self.points.append(BranchPoint(float(point.z[-1]), orbit))
        return orbit

    def _reject(self, factor: float, error: NoConvergence | None = None) -> None:
        """Repeat with a smaller step; the branch ends where that is too small."""
        self._step *= factor
        if self._step < MIN_STEP:
            residual = error.residual if error else 0.0
            self._finish("no convergence", self._point.z[-1], residual)

    def _advance(self) -> None:
        """Take a step, or reject it and reduce the next."""
        last, step = self._point, self._step
        weights = self._weights(last.z)
        tangent = last.tangent / weighted_length(last.tangent, weights)
        guess = last.z + step * tangent + 0.5 * step * step * self._curvature
        try:
            new = self._correct(guess, tangent, weights)
        except NoConvergence as error:
            self._retry(last, tangent, error)
            return
        turn_cos = float((new.tangent * weights) @ (tangent * weights))
        if not self._limits[0] <= new.z[-1] <= self._limits[1]:
            limited = self._at_limit(last, new)
            if limited is not None:
                new = limited
                self._finish("range end", new.z[-1])
        key = contact_key(new.linearization.result.contacts)
        if key == self._key_before and last.z is self._grazing:
            self._key_before = (
                None  # not through the grazing orbit: the other way along the tangent
            )
            self._point = replace(last, tangent=-last.tangent, orientation=-last.orientation)
            grazing = self.bifurcations[-1]
            self.bifurcations[-1] = replace(grazing, turns_back=not grazing.turns_back)
            return
        if key != self._key:
            if step > GRAZING_STEP:
                self._reject(max(0.3, 0.9 * GRAZING_STEP / step))
            else:
                self._pass_grazing(last, new, key)
            return
        is_outside = not self._limits[0] <= new.z[-1] <= self._limits[1]
        if is_outside or (turn_cos < MAX_TURN_COS and step > BEND_STEP):
            self._finished = False
            self._reject(0.5)
            return
        if not self._finished and len(self.points) >= 5 and passes(self._start, last, new, weights):
            new = self._start
            self._finish("closed loop", new.z[-1])
        try:
            self._accept(last, new)
        except NoConvergence:  # too long, or on another branch that comes near but does not cross
            self._finished = False
            self._reject(0.3)
            return
        bends = turn_cos < MAX_TURN_COS
        self._curvature = np.zeros(guess.size) if bends else (new.tangent - tangent) / step
        self._step = next_step(step, turn_cos, new.iterations, MAX_STEP)

    def _correct(self, guess: Float1D, tangent: Float1D, weights: Float1D) -> Point:
        """Return the branch's point near a guess; where it bends, at the parameter's value there.

        Raises NoConvergence.
        """
        step = self._step
        reach = max(step, min(MAX_BEND * step, BEND_REACH))
        try:
            return correct(self._problem.evaluate, guess, tangent, weights, reach)
        except NoConvergence:
            if step > BEND_STEP:
                raise
        axis = unit_axis(guess.size, math.copysign(1.0 / weights[-1], tangent[-1]))
        return correct(self._problem.evaluate, guess, axis, weights, reach)

    def _accept(self, last: Point, new: Point) -> None:
        multipliers = floquet_multipliers(new.linearization.result.jacobian)
        if last.orientation:
            kinds = detect_bifurcations(last, new, (self._multipliers, multipliers))
            if "pitchfork" in kinds and self._step > CROSSING_STEP:
                raise NoConvergence(0.0)
            located = [(kind, self._locate(kind, last, new)) for kind in kinds]
            located.sort(key=lambda item: last.distance(item[1].z))
            crossing = dict(located).get("pitchfork")
            if crossing and self._leaves(last, crossing, "fold" in kinds):
                self._append(crossing)
                self._finish("meets another branch", crossing.z[-1])
                return
            for kind, point in located:
                orbit, turns_back = self._append(point), kind == "fold"
                self.bifurcations.append(
                    Bifurcation(
                        kind, float(point.z[-1]), orbit, len(self.points) - 1, turns_back=turns_back
                    )
                )
        self._append(new, multipliers)
        self._point, self._multipliers = new, multipliers

    def _leaves(self, last: Point, crossing: Point, folds: bool) -> bool:
        """Return whether this branch is the one that leaves another at a pitchfork ahead.

        Its parameter changes there with the square of the distance, so twice as fast along the
        tangent as along the chord.
        """
        chord = crossing.z - last.z
        along = float((last.tangent * last.weights) @ (chord * last.weights))
        return folds or abs(last.tangent[-1] * along) > MAX_SLOPE_RATIO * abs(chord[-1])

    def _locate(self, kind: BifurcationKind, last: Point, new: Point) -> Point:
        """Return the point between two neighbors at which the branch bifurcates."""
        if kind == "pitchfork":
            return self._locate_crossing(last, new)

        def value(point: Point) -> float:
            if kind == "fold":
                ahead = (point.tangent * last.weights) @ ((new.z - last.z) * last.weights)
                return math.copysign(1.0, ahead) * float(point.tangent[-1])
            return evaluate_criterion(kind, point.linearization.result.jacobian)

        return locate_on_arc(self._problem.evaluate, last, new, value)

    def _locate_crossing(self, last: Point, new: Point) -> Point:
        """Return the point between two others where another branch crosses.

        Raises NoConvergence if none does: then the two points lie on different branches.
        """
        guess = (last.z + new.z) / 2
        crossing = CrossingProblem(self._problem, guess, last.weights)
        z, _ = solve_square(
            crossing.evaluate, np.append(guess, 0.0), np.append(last.weights, last.weights[0])
        )
        evaluation = self._problem.evaluate(z[:-1])
        residual = weighted_length(evaluation.residual, last.weights[:-1])
        if residual > CROSSING_TOL or last.distance(z[:-1]) > 2 * last.distance(new.z):
            raise NoConvergence(residual)
        return CurvePoint(z[:-1], last.tangent, last.weights, 0.0, evaluation, 0)

    def _at_limit(self, last: Point, new: Point) -> Point | None:
        """Return the point at the limit of the range between two points, None if it fails."""
        point = correct_at_limit(self._problem.evaluate, last, new, np.array([self._limits]))
        is_regular = point and contact_key(point.linearization.result.contacts) == self._key
        return point if is_regular else None

    def _pass_grazing(self, last: Point, new: Point, key: ContactKey) -> None:
        """Locate the grazing orbit between two points and go on behind it."""
        try:
            located = self._locate_grazing(last, last.z + 0.5 * (new.z - last.z))
            is_near = last.distance(located[0]) <= 1.5 * last.distance(new.z)
            beyond = self._probe_beyond(located[0], new.z - last.z)
            if not is_near or beyond is None:
                raise NoConvergence(math.nan)
        except NoConvergence:
            if self._step > 1e-6:
                self._reject(0.3)
                return
            beyond = None
        if beyond is None or last.distance(located[0]) < SAME_GRAZING:
            self._key = key
            self._accept_beyond(new)
            return
        self._turn_grazing(last, *located, beyond, new.z - last.z)

    def _retry(self, last: Point, tangent: Float1D, error: NoConvergence) -> None:
        """Reduce the step; where it is small, pass a grazing orbit at which the branch turns."""
        if self._step < BEND_STEP:
            try:
                located = self._locate_grazing(last, last.z)
            except NoConvergence:
                located = None
            if located and SAME_GRAZING < last.distance(located[0]) < 10 * self._step:
                beyond = self._probe_beyond(located[0], tangent)
                if beyond is not None:
                    self._turn_grazing(last, *located, beyond, tangent)
                    return
        self._reject(0.4, error)

    def _locate_grazing(self, last: Point, guess: Float1D) -> tuple[Float1D, GrazingProblem]:
        grazing = GrazingProblem(self._problem)
        z, _ = solve_square(grazing.evaluate, guess, last.weights)
        return z, grazing

    def _probe_beyond(self, z: Float1D, ahead: Float1D) -> tuple[Float1D, Evaluation] | None:
        """Return a point with other contacts just behind a grazing orbit z, and its residual.

        None if the contacts stay the same: another guard touches zero there, not on this branch.
        """
        ahead = ahead / weighted_length(ahead, self._weights(z))
        for distance in PROBE_DISTANCES:
            probe = z + distance * ahead
            beyond = self._problem.evaluate(probe)
            if contact_key(beyond.result.contacts) != self._key:
                return probe, beyond
        return None

    def _turn_grazing(
        self,
        last: Point,
        z: Float1D,
        grazing: GrazingProblem,
        probed: tuple[Float1D, Evaluation],
        ahead: Float1D,
    ) -> None:
        """Add the grazing orbit z and leave it along the tangent on its other side.

        `probed`: a point there, as `_probe_beyond` returns it.
        """
        probe, beyond = probed
        key = contact_key(beyond.result.contacts)
        assert grazing.minimum is not None
        evaluation = self._problem.evaluate(z)
        weights = self._weights(z)
        approach = z - last.z
        here = CurvePoint(z, last.tangent, weights, last.orientation, evaluation, 0)
        self._accept(last, here)
        if self._finished:
            return
        ahead = ahead / weighted_length(ahead, weights)
        gradient = grazing.evaluate(probe).jacobian[-1]
        tangent = null_direction(beyond.jacobian, ahead, weights)
        if (gradient @ tangent) * (gradient @ approach) < 0:
            tangent = -tangent
        self._add_grazing(last, tangent, evaluation.result.minima)
        self._key_before, self._key, self._grazing = self._key, key, z
        self._step, self._curvature = STEP_BEYOND_GRAZING, np.zeros(z.size)
        self._multipliers = floquet_multipliers(beyond.result.jacobian)
        orientation = border_sign(beyond.jacobian, tangent, weights)
        self._point = CurvePoint(z, tangent, weights, orientation, beyond, 0)

    def _add_grazing(self, last: Point, tangent: Float1D, minima: Float2D) -> None:
        """Record the grazing orbit that is the last point; it is left along `tangent`."""
        point, index = self.points[-1], len(self.points) - 1
        nearest = minima[np.abs(minima[:, 2]).argmin()]
        limit = abs(nearest[2]) + SIMULTANEOUS_TOL * point.orbit.size_m
        sides = {int(code) % 2 for code in minima[np.abs(minima[:, 2]) <= limit, 1]}
        self.bifurcations.append(
            Bifurcation(
                "grazing", point.value, point.orbit, index,
                "both" if len(sides) > 1 else "left" if 1 in sides else "right",
                "push" if nearest[1] >= 2 else "clearance",
                turns_back=bool(tangent[-1] * last.tangent[-1] < 0),
            )
        )  # fmt: skip

    def _accept_beyond(self, new: Point) -> None:
        """Accept a point behind a change of contacts that was not located."""
        self._append(new)
        self._multipliers = floquet_multipliers(new.linearization.result.jacobian)
        self._point, self._step, self._curvature = new, STEP_BEYOND_GRAZING, np.zeros(new.z.size)
