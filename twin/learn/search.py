"""Which effects explain what a guess leaves: all subsets at once, by linear algebra.

About a fitted guess the residual is linear in the base's parameters and in the amplitude of every
candidate. One pass makes the products of all slopes, summed over every unit (a step of the sweep);
after that any subset is fitted on some units and judged on the others without the data.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.learn.fit import slopes, solved
from twin.learn.guess import Free, Guess
from twin.learn.library import Candidate
from twin.learn.sheet import Sheet

FOLDS, NEVER = 3, -1
LEAST_UNITS = 6  # fewer steps than this and blocks are held out instead


@dataclass(frozen=True, slots=True)
class Variant:
    """A candidate at one rung of its ladder, and the place of its slope in the products."""

    candidate: Candidate
    shape: tuple[float, ...]
    place: int
    sign: int  # of the amplitudes allowed: +1, -1, or 0 for both


@dataclass(frozen=True, eq=False)
class Products:
    """Sums over each unit: of slope times slope (unit, p, p), slope times residual (unit, p), and
    residual squared (unit,); the first `base` slopes are those of what is known."""

    hessian: Float2D
    gradient: Float2D
    square: Float1D
    fold: Int1D
    base: int
    variants: tuple[Variant, ...]
    scale: Float1D

    def held_out(self, chosen: Sequence[int]) -> tuple[Float1D, Float1D] | None:
        """((unit,) squares left on units that were not fitted, (p,) mean step of the chosen)."""
        places = [*range(self.base), *chosen]
        hessian = self.hessian[:, places][:, :, places]
        gradient = self.gradient[:, places]
        left, steps = np.empty_like(self.square), []
        for k in range(FOLDS):
            out = self.fold == k
            if not out.any() or out.all():
                continue
            x = -solved(hessian[~out].sum(axis=0), 1e-12, gradient[~out].sum(axis=0))
            left[out] = self.square[out] + 2 * gradient[out] @ x + hessian[out] @ x @ x
            steps.append(x)
        mean = np.mean(steps, axis=0)
        out = self.fold == NEVER
        left[out] = self.square[out] + 2 * gradient[out] @ mean + hessian[out] @ mean @ mean
        return left, mean[self.base :]


def units_of(sheet: Sheet) -> Int1D:
    """(entry,) the unit of each entry: the step it lies in, else its block, in order; last the
    rest."""
    step = sheet.readings.step[sheet.sample_of]
    held = np.unique(step[step >= 0])
    if held.size >= LEAST_UNITS:
        # what belongs to no step counts with the step before it
        whole = sheet.readings.step
        last = np.maximum.accumulate(np.where(whole >= 0, np.arange(whole.size), 0))
        step = whole[last][sheet.sample_of]
    else:
        step = sheet.block_of
    rest = sheet.row_of == len(sheet.rows)
    number = np.unique(step, return_inverse=True)[1]
    return np.where(rest, number.max() + 1, number)


def folds_of(sheet: Sheet) -> Int1D:
    """(entry,) in which of the `FOLDS` folds each entry is held out; what was at rest in none."""
    rest = sheet.row_of == len(sheet.rows)
    return np.where(rest, NEVER, units_of(sheet) % FOLDS)


def products(
    sheets: Sequence[Sheet], guess: Guess, free: Sequence[Free], library: Sequence[Candidate]
) -> Products:
    """The products at a guess, over all logs. What stands at a bound is taken to stay there."""
    free = [one for one in free if one.low < guess.values[one.keys[0]] < one.high]
    before = [sheet.residual(guess) for sheet in sheets]
    columns = [[*slopes(sheets, guess, one, before)] for one in free]
    variants = []
    for candidate in library:
        amplitude = candidate.amplitude
        for shape in candidate.shapes:
            slope = slopes(sheets, candidate.put(guess, shape), amplitude, before)
            vanishing = candidate.vanishing
            sign = int(amplitude.low >= vanishing) - int(amplitude.high <= vanishing)
            variants.append(Variant(candidate, shape, len(columns), sign))
            columns.append(slope)
    hessians, gradients, squares, folds = [], [], [], []
    for k, sheet in enumerate(sheets):
        unit = units_of(sheet)
        order = np.argsort(unit, kind="stable")
        edges = np.searchsorted(unit[order], np.arange(unit.max() + 2))
        rows = np.array([column[k] for column in columns], dtype=np.float32)[:, order]
        left = before[k][order].astype(np.float32)
        rest = bool((sheet.row_of == len(sheet.rows)).any())
        for u, (first, last) in enumerate(pairwise(edges)):
            part, r = rows[:, first:last], left[first:last]
            hessians.append((part @ part.T).astype(np.float64))
            gradients.append((part @ r).astype(np.float64))
            squares.append(float(r @ r))
            folds.append(NEVER if rest and last == unit.size else u % FOLDS)
    hessian = np.array(hessians)
    size = np.sqrt(np.maximum(np.einsum("upp->p", hessian), 1e-300))
    return Products(
        hessian / np.outer(size, size), np.array(gradients) / size, np.array(squares),
        np.array(folds), len(free), tuple(variants), size,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Finding:
    """A subset and what it leaves on the units that were not used to fit it."""

    variants: tuple[Variant, ...]
    left: Float1D  # (unit,) sums of squares
    amplitudes: tuple[float, ...]

    @property
    def cost(self) -> float:
        return float(self.left.sum())

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(one.candidate.name for one in self.variants)

    def put(self, guess: Guess) -> Guess:
        """The guess with these effects at their first estimates."""
        for one, amplitude in zip(self.variants, self.amplitudes, strict=True):
            free = one.candidate.amplitude
            start = one.candidate.vanishing + amplitude
            inside = min(max(start, free.low), free.high)
            guess = one.candidate.put(guess, one.shape, inside)
        return guess


def subsets(found: Products, size: int, most: int) -> tuple[Finding, ...]:
    """The best subsets of so many candidates, the best of each set of names, best first."""
    best: dict[tuple[str, ...], Finding] = {}
    for variants in _sets(found.variants, size):
        one = _tried(found, variants)
        if one is None:
            continue
        names = tuple(sorted(one.names))
        if names not in best or one.cost < best[names].cost:
            best[names] = one
    return tuple(sorted(best.values(), key=lambda one: one.cost)[:most])


def nothing(found: Products) -> Finding:
    """What the base alone leaves."""
    one = _tried(found, ())
    assert one is not None
    return one


def _sets(variants: tuple[Variant, ...], size: int) -> Iterator[tuple[Variant, ...]]:
    for some in combinations(variants, size):
        if len({one.candidate.name for one in some}) == size:
            yield some


def _tried(found: Products, variants: tuple[Variant, ...]) -> Finding | None:
    """None where an amplitude comes out with a sign that it cannot have."""
    places = [one.place for one in variants]
    outcome = found.held_out(places)
    if outcome is None:
        return None
    left, scaled = outcome
    amplitudes = scaled / found.scale[places]
    if any(one.sign * a < 0 for one, a in zip(variants, amplitudes, strict=True)):
        return None
    return Finding(variants, left, tuple(float(a) for a in amplitudes))
