"""Levenberg-Marquardt on the sheets of several logs, with spreads that coloured residuals bear."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from table_io.block import Bool2D, Float1D, Float2D, Int1D
from twin.learn.guess import Free, Guess, log_of
from twin.learn.sheet import Sheet

MOST_STEPS = 40
CLOSE = 1e-6  # of the cost: what an iteration must gain to be followed by another
STEP = 1e-4  # of a parameter's scale, for slopes
HELD_OUT_DAMPING = (1e-9, 1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4)  # of a step to a fold's own fit
UNSAID = 1e-3  # of a number's curvature: where the others of a fold have less, they do not say it

# As `map`; whoever has more cores gives one that uses them.
Mapped = Callable[
    [Callable[[tuple[Guess, Free]], list[Float1D]], Iterable[tuple[Guess, Free]]],
    Iterable[list[Float1D]],
]


@dataclass(frozen=True, eq=False)
class Fit:
    """The best parameters of a guess on some samples, and how well they are known."""

    guess: Guess
    free: tuple[Free, ...]
    values: Mapping[str, float]
    spread: Mapping[str, float]  # standard deviation, robust against coloured residuals
    correlation: Float2D
    cost: float  # mean square of the residual over its noise, on the samples fitted
    converged: bool
    at_bound: tuple[str, ...]
    left: tuple[Float1D, ...] = ()  # per log, (entry,) residual where it was held out


def fit(
    sheets: Sequence[Sheet],
    guess: Guess,
    free: Sequence[Free],
    train: Sequence[Bool2D] | None = None,
    folds: Sequence[Int1D] = (),
    each: Mapped = map,
) -> Fit:
    """The guess moved to least squares over the entries where `train`, (entry,) each, is True.

    With `folds`, (entry,) a log: what is left in each fold by a fit to all the others, one step of
    this search away from the whole one. Below zero: never held out.
    """
    return _Search(sheets, guess, tuple(free), train, folds, each).run()


def slopes(
    sheets: Sequence[Sheet], guess: Guess, one: Free, before: Sequence[Float1D]
) -> list[Float1D]:
    """d residual / d parameter, (entry,) of each sheet, in the fit's own measure of it."""
    x = one.inside(guess.values[one.keys[0]])
    step = STEP * (1.0 if one.logarithmic else one.scale)
    if (math.exp(x + step) if one.logarithmic else x + step) > one.high:
        step = -step
    moved = guess.moved(dict.fromkeys(one.keys, one.outside(x + step)))
    own = log_of(one.name)
    return [
        (sheet.residual(moved) - was) / step
        if own in (None, sheet.number)
        else np.zeros(was.size)  # a number of another log
        for sheet, was in zip(sheets, before, strict=True)
    ]


def columns(
    sheets: Sequence[Sheet],
    asked: Sequence[tuple[Guess, Free]],
    before: Sequence[Float1D],
    each: Mapped = map,
) -> list[list[Float1D]]:
    """The slopes of several numbers, each about a guess."""
    return [*each(lambda pair: slopes(sheets, *pair, before), asked)]


class _Search:
    """One search; x are the free values, logarithms where they are shapes."""

    def __init__(
        self,
        sheets: Sequence[Sheet],
        guess: Guess,
        free: tuple[Free, ...],
        train: Sequence[Bool2D] | None,
        folds: Sequence[Int1D],
        each: Mapped,
    ) -> None:
        self.sheets, self.guess, self.free, self.folds = sheets, guess, free, folds
        self.each = each
        self.train = train or [np.ones(sheet.row_of.size, dtype=bool) for sheet in sheets]
        self.count = max(sum(int(one.sum()) for one in self.train), 1)
        low = [-math.inf if f.low == -math.inf else f.inside(f.low) for f in free]
        self.low = np.array(low)
        self.high = np.array([math.inf if f.high == math.inf else f.inside(f.high) for f in free])

    def at(self, x: Float1D) -> Guess:
        values: dict[str, float] = {}
        for one, value in zip(self.free, x, strict=True):
            values |= dict.fromkeys(one.keys, one.outside(float(value)))
        return self.guess.moved(values)

    def residuals(self, guess: Guess) -> list[Float1D]:
        return [sheet.residual(guess) for sheet in self.sheets]

    def chosen(self, entries: Sequence[Float1D]) -> Float1D:
        return np.concatenate([row[mask] for row, mask in zip(entries, self.train, strict=True)])

    def jacobian(self, guess: Guess, whole: list[Float1D]) -> Float2D:
        found = columns(self.sheets, [(guess, one) for one in self.free], whole, self.each)
        entries = sum(int(one.sum()) for one in self.train)
        return np.array([*map(self.chosen, found)]).reshape(len(self.free), entries)

    def stepped(self, x: Float1D, hessian: Float2D, gradient: Float1D, damping: float) -> Float1D:
        """x a damped Newton step on; what stands at a bound and would leave it stays there."""
        outward = ((x <= self.low) & (gradient > 0)) | ((x >= self.high) & (gradient < 0))
        inside, step = np.flatnonzero(~outward), np.zeros_like(x)
        if inside.size:
            step[inside] = solved(hessian[np.ix_(inside, inside)], damping, gradient[inside])
        return np.clip(x - step, self.low, self.high)

    def run(self) -> Fit:
        x = np.array([f.inside(self.guess.values[f.keys[0]]) for f in self.free])
        x = np.clip(x, self.low, self.high)
        whole = self.residuals(self.at(x))
        r = self.chosen(whole)
        cost, damping, converged = float(r @ r), 1e-4, not self.free
        for _ in range(0 if converged else MOST_STEPS):
            jacobian = self.jacobian(self.at(x), whole)
            hessian, gradient = jacobian @ jacobian.T, jacobian @ r
            gained = 0.0
            for _ in range(8):
                trial = self.stepped(x, hessian, gradient, damping)
                if np.array_equal(trial, x):
                    break
                after = self.residuals(self.at(trial))
                there = self.chosen(after)
                new = float(there @ there)
                if new < cost:
                    gained = (cost - new) / max(cost, 1e-300)
                    x, whole, r, cost = trial, after, there, new
                    damping = max(damping / 10, 1e-9)
                    break
                damping *= 10
            if gained < CLOSE:
                converged = True
                break
        return self._fit(x, whole, cost, converged)

    def _fit(self, x: Float1D, whole: list[Float1D], cost: float, converged: bool) -> Fit:
        """Values, and spreads from the scatter of the blocks' gradients (a sandwich)."""
        guess = self.at(x)
        jacobian = self.jacobian(guess, whole)
        hessian = jacobian @ jacobian.T
        size = _sizes(hessian)
        known = np.flatnonzero(
            (self.low < x) & (x < self.high)
        )  # the others are where they must be
        inner = np.ix_(known, known)
        inverse = np.zeros_like(hessian)
        inverse[inner] = np.linalg.pinv((hessian / np.outer(size, size))[inner], hermitian=True)
        inverse /= np.outer(size, size)
        gradients = jacobian * self.chosen(whole)
        first, count = 0, 0
        scatter, tared = np.zeros_like(inverse), np.zeros_like(inverse)
        for sheet, mask in zip(self.sheets, self.train, strict=True):
            blocks = sheet.whole_contacts[mask]
            here = slice(first, first + blocks.size)
            rest = (sheet.row_of == len(sheet.rows))[mask]
            moving = np.array(
                [np.bincount(blocks[~rest], weights=row[here][~rest]) for row in gradients]
            )
            # of what was read at rest there is one number each: its deviation is what is known
            still = jacobian[:, here][:, rest] / sheet.weight
            scatter += moving @ moving.T
            tared += still @ still.T
            first += blocks.size
            count += np.unique(blocks[~rest]).size
        # the fit has taken part of the scatter away: a block's worth for each number it found
        scatter *= count / max(count - len(self.free), 1)
        covariance = inverse @ (scatter + tared) @ inverse
        sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        scale = np.where(sd > 0, sd, 1.0)
        values, spread, stuck = {}, {}, []
        for i, free in enumerate(self.free):
            values[free.name] = free.outside(float(x[i]))
            spread[free.name] = float(sd[i] * (values[free.name] if free.logarithmic else 1.0))
            if x[i] in (self.low[i], self.high[i]):
                stuck.append(free.name)
        correlation = covariance / np.outer(scale, scale)
        return Fit(
            guess, self.free, values, spread, correlation, cost / self.count, converged,
            tuple(stuck), self._held_out(x, whole, jacobian),
        )  # fmt: skip

    def _held_out(self, x: Float1D, whole: list[Float1D], jacobian: Float2D) -> tuple[Float1D, ...]:
        """(entry,) a log, what fits without each fold leave in it; nothing without folds."""
        if not self.folds:
            return ()
        fold = np.concatenate(self.folds)
        left = [one.copy() for one in whole]
        for k in np.unique(fold[fold >= 0]):
            there = self._without(x, whole, jacobian, fold != k)
            for mine, one, own in zip(left, there, self.folds, strict=True):
                mine[own == k] = one[own == k]
        return tuple(left)

    def _without(
        self, x: Float1D, whole: list[Float1D], jacobian: Float2D, others: Bool2D
    ) -> list[Float1D]:
        """(entry,) a log, after one step towards the fit on the others alone.

        The step is damped until it does what it is for: undamped it may be a leap. A number that
        the others do not say stays, and an amplitude vanishes: it would else be judged by itself.
        """
        part = jacobian[:, others]
        hessian = part @ part.T
        unsaid = np.diag(hessian) < UNSAID * np.einsum("ij,ij->i", jacobian, jacobian)
        absent = np.array([math.nan if f.vanishing is None else f.vanishing for f in self.free])
        gone = unsaid & np.isfinite(absent)
        if gone.any():
            x = np.where(gone, absent, x)
            whole = self.residuals(self.at(x))
        r = np.concatenate(whole)[others]
        gradient, before = part @ r, float(r @ r)
        gradient[unsaid], hessian[unsaid], hessian[:, unsaid] = 0.0, 0.0, 0.0
        for damping in HELD_OUT_DAMPING:
            there = self.residuals(self.at(self.stepped(x, hessian, gradient, damping)))
            left = np.concatenate(there)[others]
            if float(left @ left) <= before:
                return there
        return whole  # the others are as good as they get


def _sizes(hessian: Float2D) -> Float1D:
    """What makes the parameters comparable: the root of their own curvature."""
    curvature = np.sqrt(np.diag(hessian))
    return np.where(curvature > 0, curvature, 1.0)


def solved(hessian: Float2D, damping: float, gradient: Float1D) -> Float1D:
    """The damped Newton step, well scaled."""
    size = _sizes(hessian)
    scaled = hessian / np.outer(size, size) + damping * np.eye(size.size)
    step: Float1D = np.linalg.lstsq(scaled, gradient / size, rcond=1e-14)[0] / size
    return step
