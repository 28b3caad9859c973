"""Which effects explain what a guess leaves: all candidates at once, by linear algebra.

About a fitted guess the residual is linear in the base's parameters and in the amplitude of every
candidate. One pass makes the products of all slopes, summed over every unit (a step of the sweep);
after that any candidate is fitted on some units and judged on the others without the data.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.learn.fit import Mapped, columns, solved
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

    @property
    def without(self) -> float:
        """Squares that the base alone leaves where it was not fitted."""
        return float(self.held_out(())[0].sum())

    def held_out(self, chosen: Sequence[int]) -> tuple[Float1D, Float1D]:
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
    sheets: Sequence[Sheet],
    guess: Guess,
    free: Sequence[Free],
    library: Sequence[Candidate],
    each: Mapped = map,
) -> Products:
    """The products at a guess, over all logs. What stands at a bound is taken to stay there."""
    free = [one for one in free if one.low < guess.values[one.keys[0]] < one.high]
    before = [sheet.residual(guess) for sheet in sheets]
    asked = [(guess, one) for one in free]
    variants = []
    for candidate in library:
        amplitude, vanishing = candidate.amplitude, candidate.vanishing
        sign = int(amplitude.low >= vanishing) - int(amplitude.high <= vanishing)
        for shape in candidate.shapes:
            variants.append(Variant(candidate, shape, len(asked), sign))
            asked.append((candidate.put(guess, shape), amplitude))
    found = columns(sheets, asked, before, each)
    hessians, gradients, squares, folds = [], [], [], []
    for k, sheet in enumerate(sheets):
        unit = units_of(sheet)
        order = np.argsort(unit, kind="stable")
        edges = np.searchsorted(unit[order], np.arange(unit.max() + 2))
        rows = np.array([column[k] for column in found], dtype=np.float32)[:, order]
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
    """A candidate at one rung, and what it leaves on the units that were not used to fit it."""

    variant: Variant
    left: Float1D  # (unit,) sums of squares
    amplitude: float

    @property
    def candidate(self) -> Candidate:
        return self.variant.candidate

    @property
    def cost(self) -> float:
        return float(self.left.sum())

    def put(self, guess: Guess) -> Guess:
        """The guess with this candidate at its first estimate."""
        free = self.candidate.amplitude
        start = self.candidate.vanishing + self.amplitude
        return self.candidate.put(guess, self.variant.shape, min(max(start, free.low), free.high))


def ranked(found: Products, most: int) -> tuple[Finding, ...]:
    """The best candidates, each at its best rung, best first."""
    best: dict[str, Finding] = {}
    for variant in found.variants:
        one = _tried(found, variant)
        if one is not None:
            name = one.candidate.name
            best[name] = min(best.get(name, one), one, key=lambda finding: finding.cost)
    return tuple(sorted(best.values(), key=lambda one: one.cost)[:most])


def _tried(found: Products, variant: Variant) -> Finding | None:
    """None where the amplitude comes out with a sign that it cannot have."""
    left, scaled = found.held_out([variant.place])
    amplitude = float(scaled[0] / found.scale[variant.place])
    return Finding(variant, left, amplitude) if variant.sign * amplitude >= 0 else None
