"""Which effects are missing: forward selection with swaps, judged on what was held out.

Each round is: all candidates by linear algebra about what is known so far (`search`), the best few
refitted whole on everything, and judged on each third of the steps by a fit to the other two
that is one step away.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile

import numpy as np

from table_io.block import Float1D, Int1D
from twin.learn.fit import Fit, Mapped, fit
from twin.learn.guess import Free, Guess
from twin.learn.library import Candidate, general
from twin.learn.search import Finding, Products, folds_of, products, ranked
from twin.learn.sheet import Sheet

MOST_EFFECTS = 3
REFITTED, REFITTED_GENERAL = 5, 2  # of the candidates of a round
LEAST_REFITTED, HOPELESS = 2, 1.5  # a cost so many times that of the best is not refitted
WORTH_A_FIT = 0.003  # of what is left: candidates that promise less are not refitted
MINOR = 0.02  # of the first gap: what a second or third effect must close at least
SIGNIFICANT = 4.0  # standard errors that a gain must have
PRACTICAL = 0.03  # of what is left, over all or in one row: less is not worth a name
LEAST_ROW = 0.01  # of all entries: a row with fewer does not speak for itself


@dataclass(frozen=True, eq=False)
class Explained:
    """A set of effects with its best parameters, and what it leaves where it was not fitted."""

    effects: tuple[Candidate, ...]
    fit: Fit

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(one.name for one in self.effects)

    @property
    def left(self) -> tuple[Float1D, ...]:
        """Per log, (entry,) residual over the noise where it was held out."""
        return self.fit.left

    @property
    def cost(self) -> float:
        """Mean square of what is left, over the noise."""
        return mean_square(self.left)


@dataclass(frozen=True, slots=True)
class Trying:
    """What a search is at: a set that it fits, the `place`-th `of` so many of a stage, and the best
    until then; nothing is fitted yet where `place` is 0."""

    stage: str
    names: tuple[str, ...] = ()
    place: int = 0
    of: int = 0
    best: Explained | None = None


Tell = Callable[[Trying], None]


def mean_square(left: Sequence[Float1D]) -> float:
    """Of the entries of all logs."""
    return float(sum(one @ one for one in left) / max(sum(one.size for one in left), 1))


@dataclass(frozen=True, eq=False)
class Bench:
    """The logs, and what is fitted whatever the effects."""

    sheets: tuple[Sheet, ...]
    base: tuple[Free, ...]
    library: tuple[Candidate, ...]
    each: Mapped = map

    def explain(self, guess: Guess, effects: Sequence[Candidate]) -> Explained:
        """The effects with the base, fitted on everything and held out fold by fold."""
        found = fit(self.sheets, guess, self.free(effects), folds=self.folds, each=self.each)
        return Explained(tuple(effects), found)

    def free(self, effects: Sequence[Candidate]) -> tuple[Free, ...]:
        """What a fit moves: the base and the effects' own."""
        return (*self.base, *(one for effect in effects for one in effect.free))

    @cached_property
    def folds(self) -> tuple[Int1D, ...]:
        """Per log, (entry,) in which fold each entry is held out."""
        return tuple(folds_of(one) for one in self.sheets)

    def gain(self, before: Explained, after: Explained) -> tuple[float, float, float]:
        """(share of the squares that is gained, the most in one row, standard errors of it).

        With d what the second takes from the residual and b what it leaves, the gain is the sum of
        d^2 + 2 d b; chance is in the second term, and blocks know how much.
        """
        gained, chance = 0.0, 0.0
        rows: dict[str, list[float]] = {}
        for a, b, sheet in zip(before.left, after.left, self.sheets, strict=True):
            gained += float(a @ a - b @ b)
            chance += float((np.bincount(sheet.block_of, weights=2 * (a - b) * b) ** 2).sum())
            for number, name in enumerate((*sheet.rows, "rest")):
                mine = sheet.row_of == number
                if mine.sum() > LEAST_ROW * mine.size:
                    row = rows.setdefault(name, [0.0, 0.0])
                    row[0] += float(a[mine] @ a[mine] - b[mine] @ b[mine])
                    row[1] += float(a[mine] @ a[mine])
        total = before.cost * sum(a.size for a in before.left)
        share = gained / max(total, 1e-300)
        most = max((part / whole for part, whole in rows.values() if whole > 0), default=share)
        return share, max(most, share), gained / max(math.sqrt(chance), 1e-300)

    def worth(self, before: Explained, after: Explained) -> bool:
        """True where the second is better by more than chance, and by enough to matter."""
        share, row, errors = self.gain(before, after)
        return share > 0 and row > PRACTICAL and errors > SIGNIFICANT


@dataclass(frozen=True, eq=False)
class Named:
    """The outcome of a selection: the null, what was found, and every set that was refitted."""

    null: Explained
    best: Explained
    tried: tuple[Explained, ...] = field(default=())
    outside: tuple[Explained, ...] = field(default=())  # with a general term in it
    whole: bool = True  # False where somebody had enough before the end


class Enough(Exception):
    """Raised by whoever is told, to end the search with what was found."""

    fitted: tuple[Explained, ...] = ()  # in the round that it ended


def named(bench: Bench, guess: Guess, tell: Tell = lambda now: None) -> Named:
    """Forward selection from the base alone, with swaps of what was taken before."""
    null = bench.explain(guess, ())
    state = Named(null, null)
    try:
        while len(state.best.effects) < MOST_EFFECTS:
            added = _added(bench, state, tell)
            if added.best is state.best:  # its swaps were tried when it was taken
                state = added
                break
            state = added
            state = _swapped(bench, state, tell)
            state = replace(state, null=_null_again(bench, state.null, state.best))
        return replace(state, outside=_outside(bench, state, tell))
    except Enough as enough:
        return replace(_taken(bench, state, enough.fitted), whole=False)


def _added(bench: Bench, state: Named, tell: Tell) -> Named:
    """With the best further effect, if one is worth it."""
    return _taken(bench, state, _refitted(bench, state.best, state.best.effects, tell))


def _taken(bench: Bench, state: Named, round_: Sequence[Explained]) -> Named:
    """With the best of a round, if it is worth it."""
    current, tried = state.best, (*state.tried, *round_)
    best = min(round_, key=lambda one: one.cost, default=current)
    minor = current.effects and current.cost - best.cost < MINOR * (state.null.cost - best.cost)
    if minor or not bench.worth(current, best):
        best = current
    return replace(state, best=best, tried=tried)


def _swapped(bench: Bench, state: Named, tell: Tell) -> Named:
    """With each earlier effect replaced by a better one, if there is one."""
    for member in state.best.effects[:-1]:
        others = tuple(one for one in state.best.effects if one is not member)
        found = _refitted(bench, state.best, others, tell, member)
        state = replace(state, tried=(*state.tried, *found))
        best = min(found, key=lambda one: one.cost, default=state.best)
        if bench.worth(state.best, best):
            state = replace(state, best=best)
    return state


def _outside(bench: Bench, state: Named, tell: Tell) -> tuple[Explained, ...]:
    """What general terms do: alone, beside what was found, and in the place of each of it."""
    best = state.best
    library = general(any((sheet.touched > 0).any() for sheet in bench.sheets))

    def still(now: Trying) -> None:
        tell(replace(now, best=best))  # whatever a round starts from, no term is a better name

    found = _refitted(bench, state.null, (), still, None, library)
    if best.effects:
        found += _refitted(bench, best, best.effects, still, None, library)
    if len(best.effects) > 1:
        for member in best.effects:
            others = tuple(one for one in best.effects if one is not member)
            found += _refitted(bench, best, others, still, member, library)
    return tuple(found)


def _null_again(bench: Bench, null: Explained, winner: Explained) -> Explained:
    """The null from the winner's parameters too: one that has not converged raises false alarms."""
    guess = winner.fit.guess
    for effect in winner.effects:
        guess = guess.without(effect.name)
    again = bench.explain(guess, ())
    return again if again.cost < null.cost else null


def _refitted(
    bench: Bench,
    current: Explained,
    kept: tuple[Candidate, ...],
    tell: Tell,
    dropped: Candidate | None = None,
    library: Sequence[Candidate] | None = None,
) -> list[Explained]:
    """The best additions to the kept effects, refitted whole."""
    guess, unnamed = current.fit.guess, library is not None
    count = len(kept) + 1
    stage = "terms without a name" if unnamed else f"{count} effect{'s' if count > 1 else ''}"
    if dropped is not None:
        stage += f", in the place of {dropped.name}"
    tell(Trying(stage, best=current))
    if dropped is not None:
        guess = guess.without(dropped.name)
        guess = bench.explain(guess, kept).fit.guess
    taken = {one.name for one in kept}
    most = REFITTED_GENERAL if unnamed else REFITTED
    if library is None:
        library = [one for one in bench.library if one.name not in taken and one is not dropped]
    if not library:
        return []
    outcome: list[Explained] = []
    promising = _promising(
        products(bench.sheets, guess, bench.free(kept), library, bench.each), most
    )
    for place, one in enumerate(promising, 1):
        effects = (*kept, one.candidate)
        fitted = () if unnamed else tuple(outcome)
        best = min((current, *fitted), key=lambda one: one.cost)
        try:
            tell(Trying(stage, tuple(k.name for k in effects), place, len(promising), best))
        except Enough as enough:
            enough.fitted = fitted
            raise
        outcome.append(bench.explain(one.put(guess), effects))
    return outcome


def _promising(found: Products, most: int) -> list[Finding]:
    """The best, less those that are hopeless beside the first or promise too little."""
    best = ranked(found, most)

    def good(pair: tuple[int, Finding]) -> bool:
        place, one = pair
        hopeless = place >= LEAST_REFITTED and one.cost > HOPELESS * best[0].cost
        return not hopeless and one.cost <= (1.0 - WORTH_A_FIT) * found.without

    return [one for _, one in takewhile(good, enumerate(best))]
