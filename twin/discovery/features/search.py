"""Search for the missing effects that explain the most features: base, effects, then pairs.

Jobs are independent, so that a caller runs those of a stage in processes; each is a function of its
number (`run_effect_job`, `run_pair_job`).
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from twin.discovery.features.fit import (
    FeatureFit,
    FeatureProblem,
    TrialGroup,
    extend_fit,
    fit_base,
    fit_effects,
    judge_model,
    list_trials,
)
from twin.discovery.parameters import ParameterSet
from twin.laws.effect import Effect
from twin.laws.library import EFFECTS, find_effect, load_plugins

PAIRED_EFFECTS = 4  # of the best, tried in pairs
REFITTED_WINNERS = 3  # from which the base is refitted once more

NOT_TESTED = {
    "mass_error": "one factor on all forces: where only motion is known, the refit has it",
    "gap_drift": "a gap that drifts has no steady response",
}


@dataclass(frozen=True, eq=False)
class BaseFits:
    """The base model as given and refitted, without any added effect."""

    given: FeatureFit
    refitted: FeatureFit


@dataclass(frozen=True, eq=False)
class FeatureDiscovery:
    """Result of a search: fits of the base, and of effects and pairs, best first."""

    problem: FeatureProblem
    base: BaseFits
    ranked: tuple[FeatureFit, ...]
    excluded: dict[str, str]  # effects that were not tested, and why

    @property
    def best(self) -> FeatureFit:
        """The best fit; the refitted base, if no effect explains more features than it."""
        refitted = self.base.refitted
        if not self.ranked or self.ranked[0].score <= refitted.score:
            return refitted
        return self.ranked[0]

    @property
    def runner_up(self) -> FeatureFit | None:
        """The best fit that shares no effect with the best one: the refitted base at worst."""
        own = set(self.best.names)
        others = [fit for fit in (*self.ranked, self.base.refitted) if not own & set(fit.names)]
        return next((fit for fit in others if fit is not self.best), None)


def list_feature_effects(
    problem: FeatureProblem, without: Sequence[str] = ()
) -> tuple[list[str], dict[str, str]]:
    """Return (ids of the effects to test, reason for each that is not)."""
    tested, excluded = [], {}
    for effect in (*EFFECTS, *load_plugins()):
        reason = _find_exclusion(effect, problem, without)
        if reason:
            excluded[effect.id] = reason
        else:
            tested.append(effect.id)
    return tested, excluded


def _find_exclusion(effect: Effect, problem: FeatureProblem, without: Sequence[str]) -> str:
    if effect.id in without:
        return "left out of the library"
    if effect.acts == "sensor":
        return "an error of a sensor, which published features do not show"
    if any(instance.effect.id == effect.id for instance in problem.model.effects):
        return "the model has it"
    if effect.is_in_bumpers and not any(gap < float("inf") for gap in problem.features.gaps_mm):
        return "there was no contact with a bumper"
    return NOT_TESTED.get(effect.id, "")


def run_base_job(problem: FeatureProblem) -> BaseFits:
    """Return the fits of the base."""
    given = ParameterSet.from_model(problem.model, 0)
    judged = judge_model(problem, given)
    return BaseFits(judged, fit_base(problem, judged))


def run_effect_job(
    problem: FeatureProblem, base: BaseFits, effects: Sequence[str], number: int
) -> FeatureFit:
    """Return the fit of the effect of a number, from the base as given and as refitted."""
    name = effects[number]
    free = problem.list_base_factors()
    groups = [
        TrialGroup(fit, list_trials(problem, name, fit.parameters.with_free(free)))
        for fit in (base.given, base.refitted)
    ]
    return fit_effects(problem, (name,), groups)


def run_pair_job(
    problem: FeatureProblem, base: BaseFits, pairs: Sequence[tuple[FeatureFit, FeatureFit]],
    number: int,
) -> FeatureFit:  # fmt: skip
    """Return the fit of the pair of a number, from the fits of both single effects."""
    first, second = pairs[number]
    groups = [
        TrialGroup(
            start,
            [
                *list_trials(problem, added.names[0], start.parameters),
                _join_fits(start, added),
            ],
        )
        for start, added in ((first, second), (second, first))
    ]
    return fit_effects(problem, first.names + second.names, groups)


def _join_fits(start: FeatureFit, added: FeatureFit) -> ParameterSet:
    """Return the parameters of a fit with the effect of another one."""
    own = {free.key for free in start.parameters.free}
    free = [parameter for parameter in added.parameters.free if parameter.key not in own]
    values = {parameter.key: added.parameters.values[parameter.key] for parameter in free}
    return start.parameters.with_values(values).with_free((*start.parameters.free, *free))


def refit_base(problem: FeatureProblem, base: BaseFits, fits: Sequence[FeatureFit]) -> BaseFits:
    """Return the fits of the base, refitted also from those of the best effects and pairs."""
    winners = sorted(fits, key=lambda fit: fit.rank_key)[:REFITTED_WINNERS]
    if not winners:
        return base
    again = fit_base(problem, base.given, winners)
    return BaseFits(base.given, min(base.refitted, again, key=lambda fit: fit.rank_key))


def choose_pairs(singles: Sequence[FeatureFit]) -> list[tuple[FeatureFit, FeatureFit]]:
    """Return the pairs of the best single effects."""
    best = sorted(singles, key=lambda fit: fit.rank_key)[:PAIRED_EFFECTS]
    return list(itertools.combinations(best, 2))


def rank_fits(
    problem: FeatureProblem, base: BaseFits, fits: Sequence[FeatureFit], excluded: dict[str, str]
) -> FeatureDiscovery:
    """Return the discovery: most features explained first, then the smaller misfit.

    A pair that explains no more features than one of its effects comes after it. An effect that was
    not fitted as well as the base without it vanishes.
    """
    fits = [
        min(fit, extend_fit(base.refitted, fit), key=lambda each: each.rank_key) for fit in fits
    ]
    singles = {fit.names[0]: fit for fit in fits if len(fit.names) == 1}

    def order(fit: FeatureFit) -> tuple[int, int, float]:
        parts = [singles[name].score for name in fit.names if name in singles]
        is_idle_pair = len(fit.names) > 1 and max(parts, default=0) >= fit.score
        return -fit.score, int(is_idle_pair), fit.misfit

    return FeatureDiscovery(problem, base, tuple(sorted(fits, key=order)), excluded)


def describe_effects(names: Sequence[str]) -> str:
    """Return the terms that effects add to the equation of motion."""
    return "; ".join(find_effect(name).term for name in names)
