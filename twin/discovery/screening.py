"""Linear screening of candidates: cross-validation of all of them from normal equations.

Around a fitted parameter set the residual is linear in the base parameters and in the amplitude of
every candidate. One pass over the data sums the products of all slopes per unit (a step of the
sweep); any candidate is then fitted to some units and judged on the others from these sums alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D, Int1D
from twin.discovery.candidates import Candidate
from twin.discovery.least_squares import (
    MapFunction,
    compute_slopes,
    solve_damped,
)
from twin.discovery.parameters import FreeParameter, ParameterSet
from twin.discovery.residuals import LogResiduals

Float32Array = npt.NDArray[np.float32]
FOLD_COUNT, NEVER_HELD_OUT = 3, -1
MIN_STEP_UNITS = 6  # with fewer steps, blocks are held out instead


@dataclass(frozen=True, slots=True)
class Variant:
    """Candidate with one of its trial shapes, and the column of its slope in the sums."""

    candidate: Candidate
    shape: tuple[float, ...]
    column: int
    sign: int  # of the amplitudes allowed: +1, -1, or 0 for both

    def add_to(self, parameters: ParameterSet, amplitude: float) -> ParameterSet:
        """Add the candidate to a parameter set with so much more than its vanishing amplitude."""
        free = self.candidate.amplitude
        start = self.candidate.vanishing + amplitude
        return self.candidate.add_to(parameters, self.shape, min(max(start, free.low), free.high))


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """Normal equations per unit: slope products, (unit, p, p), and slope x residual, (unit, p).

    The first `base_count` slopes are those of the parameters already in the fit. Products of two
    candidates are left out, 0: candidates are screened one at a time.
    """

    hessian: Float2D
    gradient: Float2D
    residual_squares: Float1D
    fold: Int1D
    base_count: int
    variants: tuple[Variant, ...]
    scale: Float1D

    @property
    def base_cost(self) -> float:
        """Cross-validation sum of squares without any candidate."""
        return float(self.cross_validate(())[0].sum())

    def cross_validate(self, columns: Sequence[int]) -> tuple[Float1D, Float1D]:
        """Return (held-out residual squares, (unit,); mean step of the given columns, (p,))."""
        indices = [*range(self.base_count), *columns]
        hessian = self.hessian[:, indices][:, :, indices]
        gradient = self.gradient[:, indices]
        squares, steps = np.empty_like(self.residual_squares), []
        for k in range(FOLD_COUNT):
            held_out = self.fold == k
            if not held_out.any() or held_out.all():
                continue
            step = -solve_damped(
                hessian[~held_out].sum(axis=0), 1e-12, gradient[~held_out].sum(axis=0)
            )
            squares[held_out] = (
                self.residual_squares[held_out]
                + 2 * gradient[held_out] @ step
                + hessian[held_out] @ step @ step
            )
            steps.append(step)
        mean = np.mean(steps, axis=0)
        held_out = self.fold == NEVER_HELD_OUT
        squares[held_out] = (
            self.residual_squares[held_out]
            + 2 * gradient[held_out] @ mean
            + hessian[held_out] @ mean @ mean
        )
        return squares, mean[self.base_count :]


def assign_units(residuals: LogResiduals) -> Int1D:
    """Return the unit of each entry, (entry,): its step or its block; the rest row comes last."""
    step = residuals.signals.step[residuals.entry_sample]
    steps = np.unique(step[step >= 0])
    if steps.size >= MIN_STEP_UNITS:
        # samples outside steps belong to the preceding step
        log_step = residuals.signals.step
        last = np.maximum.accumulate(np.where(log_step >= 0, np.arange(log_step.size), 0))
        step = log_step[last][residuals.entry_sample]
    else:
        step = residuals.entry_block
    at_rest = residuals.entry_row == len(residuals.rows)
    number = np.unique(step, return_inverse=True)[1]
    return np.where(at_rest, number.max() + 1, number)


def assign_folds(residuals: LogResiduals) -> Int1D:
    """Return the cross-validation fold of each entry, (entry,); the rest row is never held out."""
    at_rest = residuals.entry_row == len(residuals.rows)
    return np.where(at_rest, NEVER_HELD_OUT, assign_units(residuals) % FOLD_COUNT)


@dataclass(frozen=True, eq=False)
class UnitOrder:
    """Order of the entries of all logs by unit: `edges` (unit + 1,) of the units, their folds."""

    orders: tuple[Int1D, ...]  # of the entries of each log
    edges: Int1D
    fold: Int1D

    @classmethod
    def from_logs(cls, log_residuals: Sequence[LogResiduals]) -> "UnitOrder":
        orders, sizes, folds = [], [], []
        for residuals in log_residuals:
            unit = assign_units(residuals)
            orders.append(np.argsort(unit, kind="stable"))
            sizes.append(np.bincount(unit))
            fold = np.arange(sizes[-1].size) % FOLD_COUNT
            if (residuals.entry_row == len(residuals.rows)).any():
                fold[-1] = NEVER_HELD_OUT  # the unit of the rest row
            folds.append(fold)
        edges = np.cumsum([0, *np.concatenate(sizes)])
        return cls(tuple(orders), edges, np.concatenate(folds))

    def sort(self, entries: Sequence[Float1D]) -> Float32Array:
        """Return the entries of all logs, (entry,) each, in this order."""
        parts = [values[order] for values, order in zip(entries, self.orders, strict=True)]
        return np.concatenate(parts, dtype=np.float32, casting="same_kind")


def build_normal_equations(
    log_residuals: Sequence[LogResiduals],
    parameters: ParameterSet,
    library: Sequence[Candidate],
    mapper: MapFunction = map,
) -> NormalEquations:
    """Build the normal equations at a parameter set; parameters at a bound are held fixed."""
    free = [
        parameter
        for parameter in parameters.free
        if parameter.low < parameters.values[parameter.keys[0]] < parameter.high
    ]
    before = [residuals.evaluate(parameters) for residuals in log_residuals]
    variants: list[Variant] = []
    requests: list[tuple[ParameterSet, FreeParameter, float]] = []
    for candidate in library:
        amplitude, vanishing = candidate.amplitude, candidate.vanishing
        sign = int(amplitude.low >= vanishing) - int(amplitude.high <= vanishing)
        for shape, probe in product(candidate.shapes, candidate.probes):
            variants.append(Variant(candidate, shape, len(free) + len(requests), sign))
            requests.append((candidate.add_to(parameters, shape), amplitude, probe))
    order = UnitOrder.from_logs(log_residuals)
    residual = order.sort(before)

    def sort_slopes(request: tuple[ParameterSet, FreeParameter, float]) -> Float32Array:
        start, parameter, probe = request
        with np.errstate(over="ignore", invalid="ignore"):  # see `finite` below
            return order.sort(compute_slopes(log_residuals, start, parameter, before, probe))

    base = np.empty((len(free), residual.size), dtype=np.float32)
    base_requests = [(parameters, parameter, 0.0) for parameter in free]
    for row, slopes in zip(base, mapper(sort_slopes, base_requests), strict=True):
        row[:] = slopes

    def sum_products(slopes: Float32Array) -> tuple[Float2D, Float1D, Float1D]:
        """Return slopes x (slopes of the base, (unit, base); themselves; residual, (unit,))."""
        parts = [slice(*edges) for edges in pairwise(order.edges)]
        with np.errstate(over="ignore", invalid="ignore"):
            return (
                np.array([base[:, part] @ slopes[part] for part in parts]),
                np.array([np.sum(slopes[part] ** 2, dtype=np.float64) for part in parts]),
                np.array([slopes[part] @ residual[part] for part in parts]),
            )

    # candidates one at a time: all their slopes together would need much memory
    candidate_sums = mapper(lambda request: sum_products(sort_slopes(request)), requests)
    base_count, count = len(free), len(free) + len(requests)
    hessian, gradient = (
        np.zeros((order.fold.size, count, count)),
        np.empty((order.fold.size, count)),
    )
    for k, sums in enumerate((*map(sum_products, base), *candidate_sums)):
        hessian[:, :base_count, k] = hessian[:, k, :base_count] = sums[0]
        hessian[:, k, k], gradient[:, k] = sums[1:]
    # A law can overflow along a motion that it would never cause: it is no candidate.
    finite = np.isfinite(gradient).all(axis=0) & np.isfinite(np.einsum("upp->p", hessian))
    hessian[:, ~finite], hessian[:, :, ~finite], gradient[:, ~finite] = 0.0, 0.0, 0.0
    variants = [variant for variant in variants if finite[variant.column]]
    scale = np.sqrt(np.maximum(np.einsum("upp->p", hessian), 1e-300))
    hessian /= np.outer(scale, scale)
    squares = np.array([float(residual[i:k] @ residual[i:k]) for i, k in pairwise(order.edges)])
    return NormalEquations(
        hessian, gradient / scale, squares, order.fold, base_count, tuple(variants), scale
    )


@dataclass(frozen=True, slots=True, eq=False)
class ScreenedCandidate:
    """Candidate with one trial shape, its held-out residual squares and its amplitude."""

    variant: Variant
    held_out_squares: Float1D  # (unit,) sums of squares
    amplitude: float

    @property
    def candidate(self) -> Candidate:
        return self.variant.candidate

    @property
    def cost(self) -> float:
        return float(self.held_out_squares.sum())

    def add_to(self, parameters: ParameterSet) -> ParameterSet:
        """Add the candidate to a parameter set with the screened amplitude."""
        return self.variant.add_to(parameters, self.amplitude)


def rank_candidates(equations: NormalEquations, max_count: int) -> tuple[ScreenedCandidate, ...]:
    """Return the best candidates, each with its best trial shape, best first."""
    best: dict[str, ScreenedCandidate] = {}
    for variant in equations.variants:
        screened = _screen_variant(equations, variant)
        if screened is not None:
            name = screened.candidate.name
            best[name] = min(best.get(name, screened), screened, key=lambda finding: finding.cost)
    return tuple(sorted(best.values(), key=lambda screened: screened.cost)[:max_count])


def _screen_variant(equations: NormalEquations, variant: Variant) -> ScreenedCandidate | None:
    """Screen one variant; None if its amplitude has a sign that is not allowed."""
    held_out_squares, steps = equations.cross_validate([variant.column])
    amplitude = float(steps[0] / equations.scale[variant.column])
    return (
        ScreenedCandidate(variant, held_out_squares, amplitude)
        if variant.sign * amplitude >= 0
        else None
    )
