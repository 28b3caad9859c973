"""Selection of what a model lacks by its evidence: rank all sets, refit the best, rank again.

Each round ranks all sets of candidates in the linear model about the best fit so far (`linear`) and
refits the most probable ones to all data, with cross-validation residuals over the units. What is
fitted, a specimen or a table, is the problem's.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from typing import Generic, Protocol, TypeVar

from twin.evidence.linear import C, Hypothesis, LinearEvidence, Variant, softmax

MAX_EFFECTS = 3
MAX_ROUNDS = 3  # of rankings, each about the best fit of the one before
REFIT_NATS, MAX_REFITS = 5.0, 4  # below the best log evidence; sets refitted in a round
MIN_PROBABILITY = 1e-3  # of an explanation that is reported


class NamedSet(Protocol):
    """Set of candidates, fitted to all data."""

    @property
    def names(self) -> tuple[str, ...]: ...

    @property
    def cost(self) -> float:
        """Mean square of the cross-validation residual over the noise."""
        ...

    @property
    def squares(self) -> float:
        """Sum of the squares of the residual over the noise of the data that were fitted."""
        ...


F = TypeVar("F", bound=NamedSet)


class Problem(Protocol[F, C]):
    """Data, a model and what it may lack: what a selection asks of them."""

    def linearize(self, current: F, tried: Sequence[F]) -> LinearEvidence[C]:
        """Return the linear model about a set without its effects, with the shapes tried."""
        ...

    def refit(self, current: F, chosen: Sequence[tuple[Variant[C], float]]) -> F:
        """Return a fit with variants in place of a set's effects, from these amplitudes."""
        ...

    def leaves_noise(self, fitted: F) -> bool:
        """Return True if what a set leaves is noise."""
        ...


@dataclass(frozen=True)
class SelectionProgress(Generic[F]):
    """Progress of a selection: set being fitted, `index` of `count` of a stage, and best so far.

    `index` is 0 at the start of a stage, before its first fit.
    """

    stage: str
    names: tuple[str, ...] = ()
    index: int = 0
    count: int = 0
    best: F | None = None


@dataclass(frozen=True, slots=True)
class Explanation:
    """Names of effects, the place of a stranger beside them or "", and their probability."""

    names: tuple[str, ...]
    place: str
    probability: float


@dataclass(frozen=True, eq=False)
class Selection(Generic[F, C]):
    """Outcome of a selection: the null (base alone), the best set, and every set refitted.

    `explanations` are the most probable first. `evidence` is the linear model about the best set.
    """

    null: F
    best: F
    tried: tuple[F, ...] = field(default=())
    complete: bool = True  # False after a cancellation
    explanations: tuple[Explanation, ...] = ()
    evidence: LinearEvidence[C] | None = None


@dataclass(frozen=True, slots=True)
class RoundEffort:
    """How far a round of a search goes: sets of so many effects, and which of them are refitted.

    Those within so many nats of the most probable, and no more than `max_refits`. With a `share`
    within that of its log evidence, and without a stranger, until one leaves noise alone: where
    shapes are free, as those of laws are, a ladder of them promises little. With `if_open` a round
    is left out where a set of those before leaves noise alone.
    """

    stage: str = "the most probable sets"
    max_effects: int = MAX_EFFECTS
    max_refits: int = MAX_REFITS
    share: float = 0.0
    if_open: bool = False


class Cancelled(Exception):
    """Exception for a progress callback to stop the selection and keep the best set so far."""


def search_sets(
    problem: Problem[F, C],
    null: F,
    report: Callable[[SelectionProgress[F]], None] = lambda progress: None,
    first: F | None = None,
    rounds: Sequence[RoundEffort] = (RoundEffort(),) * MAX_ROUNDS,
) -> Selection[F, C]:
    """Select the most probable set of effects; see `linear`.

    The linear model about a fit ranks all sets; the best are refitted, and ranked again about the
    best of them, until no other set is more probable and no larger one is to be tried, or all
    `rounds` are over. `first` is a set to begin with.
    """
    state = Selection[F, C](null, null)
    refitted = {frozenset[str](): null}
    if first is not None:
        state = replace(state, best=first)
        refitted[frozenset(first.names)] = first
    try:
        for effort, following in zip_longest(rounds, rounds[1:]):
            before = state.best
            closest = min(refitted.values(), key=lambda fitted: fitted.cost)
            if effort.if_open and problem.leaves_noise(closest):
                break
            state = _advance(problem, state, refitted, report, effort)
            goes_on = following is not None and following.max_effects > effort.max_effects
            if {*state.best.names} == {*before.names} and not goes_on:
                break
        return state
    except Cancelled:
        tried = tuple(fitted for names, fitted in refitted.items() if names)
        best = min((state.best, *tried), key=lambda fitted: fitted.cost)
        return replace(state, best=best, tried=tried, complete=False)


def _advance(
    problem: Problem[F, C],
    state: Selection[F, C],
    refitted: dict[frozenset[str], F],
    report: Callable[[SelectionProgress[F]], None],
    effort: RoundEffort,
) -> Selection[F, C]:
    """Rank all sets about the base of the best fit so far, and refit the most probable ones."""
    current = state.best
    report(SelectionProgress("all effects", best=current))
    linear = problem.linearize(current, [*refitted.values(), current])
    promised, share = linear.rank_states(effort.max_effects), effort.share
    for index in range(1, effort.max_refits + 1):
        states = _correct_by_refits(linear, promised, refitted, state.null)
        each = _find_open(linear, states, refitted, share)
        if each is None:
            break
        variants = [linear.variants[c] for c in each.columns]
        names = tuple(variant.candidate.name for variant in variants)
        report(SelectionProgress(effort.stage, names, index, effort.max_refits, current))
        amplitudes = linear.estimate(each.columns)[0].tolist()
        fitted = problem.refit(current, [*zip(variants, amplitudes, strict=True)])
        refitted[frozenset(names)] = fitted
        if share and problem.leaves_noise(fitted):
            share = 0.0
    states = _correct_by_refits(linear, promised, refitted, state.null)
    best = next(refitted[linear.names(each)] for each in states if linear.names(each) in refitted)
    explanations = tuple(
        Explanation(tuple(sorted(linear.names(each))), each.place, float(p))
        for each, p in zip(states, softmax(states), strict=True)
        if p > MIN_PROBABILITY
    )
    tried = tuple(fitted for names, fitted in refitted.items() if names)
    return replace(state, best=best, tried=tried, explanations=explanations, evidence=linear)


def _find_open(
    linear: LinearEvidence[C],
    states: Sequence[Hypothesis],
    refitted: Mapping[frozenset[str], F],
    share: float,
) -> Hypothesis | None:
    """Return the most probable state whose set has not been refitted; None if all near ones have.

    More effects that are less probable only add noise to what the best says.
    """
    best = states[0]
    least = best.log_evidence - max(REFIT_NATS, share * abs(best.log_evidence))
    for each in states:
        names = linear.names(each)
        if each.log_evidence < least:
            break
        if share and each.place:
            continue
        if names not in refitted and not linear.names(best) < names:
            return each
    return None


def _correct_by_refits(
    linear: LinearEvidence[C],
    states: Sequence[Hypothesis],
    refitted: Mapping[frozenset[str], F],
    null: F,
) -> list[Hypothesis]:
    """Return the states, the most probable first, less what a refit has not kept of its promise.

    What the linear model promises of a set, its refit may not find: an effect vanishes, or removes
    less. The set then counts by what was found, and so does each larger one that was not refitted.
    """
    lost: dict[frozenset[str], float] = {}
    for state in states:
        names = linear.names(state)
        if state.columns and names in refitted and names not in lost:
            promised = linear.measure_gain(state.columns)
            kept = (null.squares - refitted[names].squares) / linear.inflation
            lost[names] = 0.5 * promised * min(max(1.0 - kept / max(promised, 1e-300), 0.0), 1.0)

    def correct(state: Hypothesis) -> Hypothesis:
        names = linear.names(state)
        own = lost.get(names)
        if own is None:
            own = max((loss for smaller, loss in lost.items() if smaller <= names), default=0.0)
        return replace(state, log_evidence=state.log_evidence - own)

    return sorted(map(correct, states), key=lambda state: -state.log_evidence)
