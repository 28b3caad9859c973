"""Attractors of a model under A = a sin(2 pi f t), found by simulation from many starts.

Periodic orbits of any period that are stable, chaotic and quasi-periodic sets. A start is followed
until it is captured: by a periodic orbit once its point at phase 0 lies in an ellipsoid that the
map contracts, by a chaotic set once it visits the cells of that set several cycles in a row.
"""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.linalg import cholesky, solve_discrete_lyapunov

from table_io.block import Bool1D, Bool2D, Float1D, Float2D, Int1D
from twin.dynamics.capture import UNDECIDED, CaptureRegions, capturing_region
from twin.dynamics.orbits import find_attracting_orbit
from twin.dynamics.period_map import PeriodMap
from twin.model.contact_regime import CONTACT_R, U, V
from twin.model.stepped_sine import EXTREME_NAMES

AttractorKind = Literal["periodic", "chaotic", "quasi-periodic"]

MAX_PERIOD = 64  # cycles: a longer period counts as not periodic
SETTLING_CYCLES = 100  # before the first look for a period; doubled after every look
MAX_SETTLING_CYCLES = 3000  # then a motion that has no period is judged by its exponent
CHAOS_CYCLES = 5000  # of the motion that represents a chaotic attractor
# The first start that takes longer is settled on its own, as it may lead to a new attractor;
CAPTURE_CYCLES = 16  # doubled for the others after every attempt, up to the maximum
MAX_CAPTURE_CYCLES = 256
MAX_ATTEMPTS = 200  # starts that are settled on their own
UNSETTLED = -2  # label of a start that has been given up
RECURRENCE_TOL = 1e-3  # of the motion's size: a point that returns so near is tried as periodic
RECORD_RATIO = 0.5  # by which a longer recurrence must be nearer to count
SAME_POINT_TOL = 1e-6  # of the motion's size: two orbits with points this near are one
DIRECTION_COUNT = 32  # points at which the boundary of an ellipsoid is tested
LINEAR_SLACK, ALLOWED_SLACK = 0.8, 0.4  # share of 1 - |multiplier| by which
MAX_RADIUS = 2.0  # of an ellipsoid, in sizes of the motion
MAX_HALVINGS = 30  # of that radius
MIN_SIZE_M = 1e-9  # m: of a motion, and of a coordinate in its unit
NESTED_RADII = 3  # consecutive radii that must contract
MEASURED_CYCLES = 200  # cycles whose extremes represent a motion without period
CELL_COUNT = 256  # cells per axis of a chaotic attractor
MIN_COMMON_POINTS = 0.5  # share of common points from which on two motions are one attractor
MIRROR_POINTS = 200  # points by which a mirror image is recognized
MIN_EXPONENT_SIGMA = 3.0  # standard errors by which a chaotic exponent is positive
BATCH_COUNT = 50  # of consecutive cycles, for the standard error of an exponent


@dataclass(frozen=True, slots=True)
class LyapunovExponent:
    """Largest Lyapunov exponent per cycle of the drive, with its standard error."""

    value: float
    standard_error: float

    @property
    def is_positive(self) -> bool:
        return self.value > MIN_EXPONENT_SIGMA * self.standard_error

    @property
    def is_negative(self) -> bool:
        return self.value < -MIN_EXPONENT_SIGMA * self.standard_error


def estimate_exponent(period_map: PeriodMap, x: Float1D, cycles: int) -> LyapunovExponent:
    """Estimate the largest Lyapunov exponent from settled coordinates.

    Standard error from the means of `BATCH_COUNT` batches, which allows for the correlation of
    consecutive cycles.
    """
    growth, _ = period_map.measure_growth(x, cycles)
    batches = np.array([batch.mean() for batch in np.array_split(growth, BATCH_COUNT)])
    return LyapunovExponent(
        float(growth.mean()), float(batches.std(ddof=1) / math.sqrt(BATCH_COUNT))
    )


@dataclass(frozen=True, eq=False)
class Attractor:
    """An attractor: its points at phase 0 in order of visit, coordinates (n, size).

    scale: size of the motion in u and v, m and m/s, (2,). extremes: `EXTREME_NAMES` of the cycles
    that begin at the last point, (cycles, 8): of a period, else of `MEASURED_CYCLES`.
    Periodic: n is the period in cycles, `multipliers` largest first, exponent from them without
    error. Else n points of a long motion. `mirror`: index of its mirror image among the attractors
    found with it (its own where it is symmetric), None if that is not among them.
    """

    kind: AttractorKind
    points: Float2D
    scale: Float1D
    extremes: Float2D
    exponent: LyapunovExponent
    multipliers: tuple[complex, ...] = ()
    mirror: int | None = None

    @property
    def period(self) -> int | None:
        """Period in cycles of the drive; None if it has none."""
        return len(self.points) if self.kind == "periodic" else None

    @property
    def is_periodic(self) -> bool:
        return self.kind == "periodic"

    @property
    def u_max(self) -> float:
        """Greatest displacement in m."""
        return float(self.extremes[:, EXTREME_NAMES.index("u_max")].max())

    @property
    def has_contact(self) -> bool:
        forces = self.extremes[:, EXTREME_NAMES.index("f_r_max") : EXTREME_NAMES.index("onsets_r")]
        return bool((forces != 0).any())

    @cached_property
    def cells(self) -> "VisitedCells":
        """Cells of (u, v) that a motion without period visits."""
        return VisitedCells.from_points(self.points)

    def contains_most(self, points: Float2D) -> bool:
        """Return whether most points (n, size) are on the orbit, or in cells that it visits."""
        if not self.is_periodic:
            return bool(self.cells.contain(points).mean() > MIN_COMMON_POINTS)
        distance = np.abs(points[:, None, [U, V]] - self.points[None, :, [U, V]])
        nearest = (distance / self.scale).max(axis=2).min(axis=1)
        return bool((nearest < SAME_POINT_TOL).mean() > MIN_COMMON_POINTS)


@dataclass(frozen=True, slots=True, eq=False)
class VisitedCells:
    """Cells of the (u, v) plane, (n, n), and their box: see `CaptureRegions`."""

    cells: Bool2D
    box: Float1D

    @classmethod
    def from_points(cls, points: Float2D) -> "VisitedCells":
        low, high = points[:, [U, V]].min(axis=0), points[:, [U, V]].max(axis=0)
        margin = 0.01 * (high - low) + 1e-12
        per_unit = CELL_COUNT / (high - low + 2 * margin)
        low = low - margin
        index = ((points[:, [U, V]] - low) * per_unit).astype(np.int64)
        cells = np.zeros((CELL_COUNT, CELL_COUNT), dtype=np.bool_)
        cells[index[:, 0], index[:, 1]] = True
        return cls(cells, np.array([low[0], per_unit[0], low[1], per_unit[1]]))

    def contain(self, points: Float2D) -> Bool1D:
        """Return which of the points (n, size) lie in these cells, (n,)."""
        index = np.floor((points[:, [U, V]] - self.box[0::2]) * self.box[1::2]).astype(np.int64)
        inside = np.all(index >= 0, axis=1) & np.all(index < CELL_COUNT, axis=1)
        row, column = np.where(inside[:, None], index, 0).T
        return inside & self.cells[row, column]


def motion_scale(points: Float2D, frequency_hz: float) -> Float1D:
    """Return the size of a motion in u and v from its points at phase 0: m and m/s, (2,)."""
    w = 2 * math.pi * frequency_hz
    size = max(float(np.hypot(points[:, U], points[:, V] / w).max()), MIN_SIZE_M)
    return np.array([size, w * size])


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoid:
    """Points |factor (x - center)| <= 1 around a point of a stable orbit: see `CaptureRegions`."""

    center: Float1D
    factor: Float2D
    extent: Float1D
    contacts: Float1D


class AttractorSearch:
    """Attractors of a period map, found as undecided starts are followed to their ends."""

    def __init__(self, period_map: PeriodMap, chaos_cycles: int = CHAOS_CYCLES) -> None:
        self._map = period_map
        self._chaos_cycles = chaos_cycles
        self._attractors: list[Attractor] = []
        self._ellipsoids: list[tuple[Ellipsoid, ...]] = []  # of each attractor

    def classify(self, starts: Float2D) -> tuple[Int1D, Int1D]:
        """Return (index of the attractor of each start or `UNDECIDED`, cycles to capture), (n,).

        Starts (n, size) are advanced in place. An attractor that is met for the first time is
        added, and its mirror image is searched.
        """
        labels = np.full(len(starts), UNDECIDED)
        cycles = np.zeros(len(starts), dtype=np.int64)
        for attempt in range(MAX_ATTEMPTS):
            if self._attractors:
                max_cycles = min(CAPTURE_CYCLES << attempt, MAX_CAPTURE_CYCLES)
                self._map.capture(starts, self._regions, max_cycles, labels, cycles)
            undecided = np.flatnonzero(labels == UNDECIDED)
            if not undecided.size:
                break
            labels[undecided[0]] = self._settle(starts[undecided[0]])
        return np.maximum(labels, UNDECIDED), cycles

    @property
    def attractors(self) -> tuple[Attractor, ...]:
        """Attractors found so far, each with its mirror image."""
        return tuple(
            replace(attractor, mirror=self._find_mirror(attractor))
            for attractor in self._attractors
        )

    def _find_mirror(self, attractor: Attractor) -> int | None:
        points = np.array([self._map.mirror(point) for point in attractor.points[:MIRROR_POINTS]])
        return next(
            (i for i, other in enumerate(self._attractors) if other.contains_most(points)), None
        )

    @property
    def _regions(self) -> CaptureRegions:
        pairs = [(owner, e) for owner, group in enumerate(self._ellipsoids) for e in group]
        visitors = [(i, a.cells) for i, a in enumerate(self._attractors) if not a.is_periodic]
        size, count = self._map.size, CELL_COUNT
        return CaptureRegions(
            np.array([e.center for _, e in pairs]).reshape(-1, size),
            np.array([e.factor for _, e in pairs]).reshape(-1, size, size),
            np.array([e.extent for _, e in pairs]).reshape(-1, 2),
            np.array([e.contacts for _, e in pairs]).reshape(-1, 2),
            np.array([owner for owner, _ in pairs], dtype=np.int64),
            np.array([c.cells for _, c in visitors], dtype=np.bool_).reshape(-1, count, count),
            np.array([c.box for _, c in visitors]).reshape(-1, 4),
            np.array([owner for owner, _ in visitors], dtype=np.int64),
        )

    def _settle(self, x: Float1D) -> int:
        """Follow a start to its attractor, adding what is new; return its index, or `UNSETTLED`."""
        labels = np.array([UNDECIDED])
        if self._attractors:
            start = x[None].copy()
            self._map.capture(
                start, self._regions, CAPTURE_CYCLES, labels, np.zeros(1, dtype=np.int64)
            )
            x = start[0]
        if labels[0] != UNDECIDED:
            return int(labels[0])
        total, count = 0, SETTLING_CYCLES
        while total < MAX_SETTLING_CYCLES:
            points = self._map.record(x, count)
            x = points[-1]
            label = self._recognize(points)
            if label != UNDECIDED:
                return label
            total, count = total + count, 2 * count
        return self._settle_without_period(x)

    def _recognize(self, points: Float2D) -> int:
        """Return the periodic attractor that has captured the last of points."""
        x, scale = points[-1], motion_scale(points, self._map.frequency_hz)
        label = self._find_capture(x)
        if label == UNDECIDED:
            for period in find_recurrences(points, scale):
                orbit = find_stable_orbit(self._map, x, period, float(scale[0]))
                if orbit is not None:
                    self._add(orbit)
                    return self._find_capture(x)
        return label

    def _find_capture(self, x: Float1D) -> int:
        if not self._attractors:
            return UNDECIDED
        contact_r, contact_l = self._map.to_state(x)[CONTACT_R : CONTACT_R + 2]
        return int(capturing_region(x, contact_r, contact_l, self._regions))

    def _settle_without_period(self, x: Float1D) -> int:
        points = self._map.record(x, self._chaos_cycles)
        label = self._recognize(points)
        if label != UNDECIDED:
            return label  # the chaos was a transient
        exponent = estimate_exponent(self._map, x, self._chaos_cycles)
        if exponent.is_negative:
            return UNSETTLED
        kind: AttractorKind = "chaotic" if exponent.is_positive else "quasi-periodic"
        scale = motion_scale(points, self._map.frequency_hz)
        extremes = self._map.measure_periods(points[-1], MEASURED_CYCLES)
        return self._add(Attractor(kind, points, scale, extremes, exponent))

    def _add(self, attractor: Attractor) -> int:
        """Add an attractor unless it is known, search its mirror image, and return its index."""
        for index, known in enumerate(self._attractors):
            if known.kind == attractor.kind and known.contains_most(attractor.points):
                if not known.is_periodic:
                    points = np.concatenate([known.points, attractor.points])
                    self._attractors[index] = replace(known, points=points)
                return index
        self._attractors.append(attractor)
        self._ellipsoids.append(
            find_ellipsoids(self._map, attractor) if attractor.is_periodic else ()
        )
        index = len(self._attractors) - 1
        self._settle(self._map.mirror(attractor.points[-1]))
        return index


def find_recurrences(points: Float2D, scale: Float1D) -> list[int]:
    """Return after how many cycles the last of points (n, size) was near itself, ascending.

    Only those that were nearer than every shorter one: a period that has doubled recurs at both.
    """
    recent = points[-1 - MAX_PERIOD :, [U, V]]
    distance = (np.abs(recent[-2::-1] - recent[-1]) / scale).max(axis=1)
    records = np.minimum.accumulate(np.concatenate([[RECURRENCE_TOL], distance[:-1]]))
    return (np.flatnonzero(distance < RECORD_RATIO * records) + 1).tolist()


def find_stable_orbit(
    period_map: PeriodMap, x: Float1D, period: int, size_m: float
) -> Attractor | None:
    """Return the periodic attractor of a motion of this size that recurs at x, or None."""
    orbit = find_attracting_orbit(period_map, x, period, size_m)
    if orbit is None:
        return None
    points = period_map.record(orbit.x, orbit.periods)
    largest = max(float(abs(orbit.multipliers[0])), math.ulp(0.0))
    exponent = LyapunovExponent(math.log(largest) / orbit.periods, 0.0)
    return Attractor(
        "periodic",
        points,
        motion_scale(points, period_map.frequency_hz),
        period_map.measure_periods(orbit.x, orbit.periods),
        exponent,
        tuple(orbit.multipliers.tolist()),
    )


def find_ellipsoids(period_map: PeriodMap, orbit: Attractor) -> tuple[Ellipsoid, ...]:
    """Return an ellipsoid around each point of a stable orbit into which the map contracts it.

    In the norm of the Lyapunov equation J' P J - P = -Q of the linear map over a period, and with
    the largest radius, of those halved from the size of the motion, at which points all over the
    boundary come nearer by at least half of what the linear map brings; so must they at the next
    smaller radii. Nothing that enters leaves: in the plane the image of a disk is what the image of
    its boundary encloses.
    """
    return tuple(_find_ellipsoid(period_map, orbit, point) for point in orbit.points)


def _find_ellipsoid(period_map: PeriodMap, orbit: Attractor, point: Float1D) -> Ellipsoid:
    period, (free, directions) = len(orbit.points), period_map.free_directions(point)
    contacts = period_map.to_state(point)[CONTACT_R : CONTACT_R + 2]
    scale = np.abs(orbit.points).max(axis=0)
    scale[: V + 1] = orbit.scale
    scale[[column for column, _ in period_map.faces]] = orbit.scale[U]
    scale = scale[free]
    jacobian = (period_map.evaluate(point, period).jacobian @ directions)[free]
    largest = abs(orbit.multipliers[0])
    linear, allowed = 1 - LINEAR_SLACK * (1 - largest), 1 - ALLOWED_SLACK * (1 - largest)
    norm = solve_discrete_lyapunov(
        jacobian.T / linear, np.diag(1 / np.maximum(scale, MIN_SIZE_M) ** 2)
    )
    factor = cholesky(norm)
    inverse = np.linalg.inv(factor)
    offsets = boundary_directions(len(free)) @ inverse.T @ directions.T

    def contracts(radius: float) -> bool:
        for offset in offsets:
            end = period_map.iterate(point + radius * offset, period)
            distance = np.linalg.norm(factor @ (end - point)[free])
            end_contacts = period_map.to_state(end)[CONTACT_R : CONTACT_R + 2]
            if not (distance <= allowed * radius and (end_contacts == contacts).all()):
                return False
        return True

    radius, passed = MAX_RADIUS, 0
    for _ in range(MAX_HALVINGS):
        passed = passed + 1 if contracts(radius) else 0
        if passed == NESTED_RADII:
            break
        radius /= 2
    radius *= 2.0 ** max(passed - 1, 0)
    whole = np.zeros((point.size, point.size))
    whole[np.ix_(range(len(free)), free)] = factor / radius
    extent = radius * np.linalg.norm(inverse, axis=1)[:2]
    return Ellipsoid(point, whole, extent, contacts)


def boundary_directions(dimension: int) -> Float2D:
    """Return unit vectors all over the sphere, (n, dimension): evenly spaced in the plane."""
    if dimension == 2:
        angle = 2 * math.pi * np.arange(DIRECTION_COUNT) / DIRECTION_COUNT
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    vectors = np.random.default_rng(0).normal(size=(DIRECTION_COUNT * dimension, dimension))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
