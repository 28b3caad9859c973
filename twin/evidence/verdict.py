"""Verdict on a selection, read off the probabilities of its explanations.

none         no effect and no stranger is most probable, and the residual is noise
named        these effects are in nearly every probable explanation
ambiguous    other effects are about as probable: the data cannot distinguish them
unexplained  a stranger is more probable than every effect, or the residual is no noise
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol

from twin.evidence.linear import C
from twin.evidence.selection import Explanation, F, Problem, Selection

CERTAIN_PROBABILITY = 0.95  # of a set of effects that is named; with less, others are told too
MAX_LEVEL = 1.5  # mean square over the noise that may remain where a residual is said to be noise
EXCLUDED_PROBABILITY = 0.01  # of an explanation: with less it is excluded


@dataclass(frozen=True, eq=False)
class SelectionVerdict(Generic[F]):
    """Verdict with the sets of effects behind it."""

    outcome: str
    best: F
    confidence: float  # probability of the verdict
    effects_confidence: float  # probability that the effects are all that the model lacks
    alternatives: tuple[F, ...]  # about as probable as the best, if ambiguous
    has_remainder: bool  # a stranger is probable beside the effects, or more than noise remains
    reason: str
    place: str  # of the stranger, if one is probable


class JudgedProblem(Problem[F, C], Protocol[F, C]):
    """What a verdict asks of a problem beside its selection."""

    @property
    def limits(self) -> Mapping[str, Sequence[str]]:
        """Names of the effects of which each candidate has others as limits, by its name."""
        ...

    def select_simplest(self, fitted_sets: Sequence[F]) -> F:
        """Return the simplest set than which the best on held-out data is not worth more."""
        ...


def judge_selection(
    problem: JudgedProblem[F, C], selection: Selection[F, C]
) -> SelectionVerdict[F]:
    """Judge the outcome of a selection."""
    best, null = selection.best, selection.null
    by_set = sum_by_set(selection.explanations)
    probability = by_set.get(frozenset(best.names), 0.0)
    place, beside = find_stranger(selection.explanations, frozenset(best.names))
    remains = not problem.leaves_noise(best)
    has_remainder = beside > 0.5 or remains
    if remains:  # of the sets that do not explain it, that which predicts held-out steps best
        sets = [each for each in (*selection.tried, null) if not problem.leaves_noise(each)]
        best = problem.select_simplest((best, *sets))

    def conclude(
        outcome: str, fitted: F, probability: float, reason: str,
        alternatives: tuple[F, ...] = (), effects_confidence: float | None = None,
    ) -> SelectionVerdict[F]:  # fmt: skip
        of_effects = probability if effects_confidence is None else effects_confidence
        return SelectionVerdict(
            outcome, fitted, probability, of_effects, alternatives, has_remainder, reason,
            place if has_remainder else "",
        )  # fmt: skip

    where = f" in the {place}" if beside > 0.5 else ""
    alone = probability * (1.0 - beside)
    # a name needs an absolute fit: what it leaves must be noise
    unknown = 1.0 - EXCLUDED_PROBABILITY if remains else beside
    if not best.names:
        if has_remainder:
            reason = f"the residual exceeds the noise, by an unknown force{where}"
            return conclude("unexplained", null, unknown, reason)
        return conclude("none", null, alone, "the residual is noise")
    if has_remainder:
        names = " + ".join(best.names)
        verb = "leaves" if len(best.names) == 1 else "leave"
        reason = f"{names} {verb} a part of the misfit that is no noise, an unknown force{where}"
        return conclude(
            "unexplained", best, unknown, reason, effects_confidence=0.0 if remains else alone
        )
    limits = problem.limits
    none = by_set.get(frozenset(), 0.0)
    containing = [p for names, p in by_set.items() if _holds_effects(names, best, limits)]
    probability = sum(containing)
    rivals = tuple(
        fitted
        for fitted in selection.tried
        if by_set.get(frozenset(fitted.names), 0.0) > EXCLUDED_PROBABILITY
        and not _holds_effects(frozenset(fitted.names), best, limits)
    )
    if none > EXCLUDED_PROBABILITY or probability < CERTAIN_PROBABILITY:
        common = frozenset(best.names).intersection(*(fitted.names for fitted in rivals))
        core = next((each for each in selection.tried if {*each.names} == common), None)
        if none > EXCLUDED_PROBABILITY or core is None or not rivals:
            others = sorted(
                (-p, " + ".join(sorted(names)) or "no effect")
                for names, p in by_set.items()
                if p > EXCLUDED_PROBABILITY and not _holds_effects(names, best, limits)
            )
            listed = "; ".join(name for _, name in others)
            reason = f"not separated from {' + '.join(best.names)}: {listed}"
            named = min(sum(by_set.values()), 1.0)
            return conclude("ambiguous", best, named, reason, rivals, probability)
        probability = sum(p for names, p in by_set.items() if common <= names)
        return conclude("named", core, probability, "every probable explanation has it")
    return conclude("named", best, probability, "the residual is noise")


def _holds_effects(names: frozenset[str], best: F, limits: Mapping[str, Sequence[str]]) -> bool:
    """Return True if a set has the effects of the best, or laws of which these are limits."""
    general = names - {*best.names}
    return all(
        name in names or any(name in limits.get(other, ()) for other in general)
        for name in best.names
    )


def sum_by_set(explanations: Sequence[Explanation]) -> dict[frozenset[str], float]:
    """Return the probability of each set of effects, with and without a stranger."""
    sums: dict[frozenset[str], float] = {}
    for each in explanations:
        names = frozenset(each.names)
        sums[names] = sums.get(names, 0.0) + each.probability
    return sums


def find_stranger(explanations: Sequence[Explanation], names: frozenset[str]) -> tuple[str, float]:
    """Return (most probable place of a stranger beside a set, probability of any beside it)."""
    own = [each for each in explanations if frozenset(each.names) == names]
    total = sum(each.probability for each in own)
    strangers = [each for each in own if each.place]
    if not strangers or not total:
        return "", 0.0
    place = max(strangers, key=lambda each: each.probability).place
    return place, sum(each.probability for each in strangers) / total
