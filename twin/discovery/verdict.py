"""Verdict on a selection, read off the probabilities of its explanations.

none         no effect and no stranger is most probable, and the residual is noise
named        these effects are in nearly every probable explanation
ambiguous    other effects are about as probable: the data cannot distinguish them
unexplained  a stranger is more probable than every effect, or the residual is no noise
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from twin.discovery.cross_checks import is_of_contact
from twin.discovery.hidden_effects import (
    FORCE_LAWS,
    MAX_HIDDEN_SHARE,
    UndetectedEffect,
    find_blind_spots,
)
from twin.discovery.parameters import (
    ParameterKey,
    is_correction,
)
from twin.discovery.selection import (
    MIN_VISIBLE_EXCESS,
    Explanation,
    FittedSet,
    SelectionProblem,
    SelectionResult,
)
from twin.laws.library import EFFECTS, load_plugins

CERTAIN_PROBABILITY = 0.95  # of a set of effects that is named; with less, others are told too
EXCLUDED_PROBABILITY = 0.01  # of an explanation: with less it is excluded


@dataclass(frozen=True, eq=False)
class DiscoveryVerdict:
    """Verdict with the sets of effects and the numbers behind it (mean squares over the noise)."""

    outcome: str
    best: FittedSet
    confidence: float  # probability of the verdict
    effects_confidence: float  # probability that the effects are all that the model lacks
    alternatives: tuple[FittedSet, ...]  # about as probable as the best, if ambiguous
    floor: float
    has_remainder: bool  # a stranger is probable beside the effects, or more than noise remains
    reason: str
    # force laws that could be there without a trace, where nothing is named
    blind_to: tuple[UndetectedEffect, ...] = ()
    # standard deviations that an inexact form of the named laws may cause unseen
    form_errors: Mapping[ParameterKey, float] = field(default_factory=dict)
    place: str = ""  # of the stranger, if one is probable

    @property
    def is_decided(self) -> bool:
        """True if the effects are named, or none, and nothing remains or could hide at its size."""
        is_closed = self.outcome in ("none", "named") and not self.has_remainder
        return is_closed and not self.blind_to


def judge_selection(
    problem: SelectionProblem, selection: SelectionResult, floor: float
) -> DiscoveryVerdict:
    """Judge the outcome of a selection; `floor` is a mean square over the noise."""
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
        outcome: str, fitted: FittedSet, probability: float, reason: str,
        alternatives: tuple[FittedSet, ...] = (), effects_confidence: float | None = None,
    ) -> DiscoveryVerdict:  # fmt: skip
        of_effects = probability if effects_confidence is None else effects_confidence
        return DiscoveryVerdict(
            outcome, fitted, probability, of_effects, alternatives, floor, has_remainder, reason,
            place=place if has_remainder else "",
        )  # fmt: skip

    where = f" in the {place}" if beside > 0.5 else ""
    alone = probability * (1.0 - beside)
    # a name needs an absolute fit: what it leaves must be noise
    unknown = 1.0 - EXCLUDED_PROBABILITY if remains else beside
    if not best.effects:
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
    limits = {c.name: c.effect.limits for c in problem.library}
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


def _holds_effects(
    names: frozenset[str], best: FittedSet, limits: Mapping[str, Sequence[str]]
) -> bool:
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


def widen_for_form(verdict: DiscoveryVerdict) -> DiscoveryVerdict:
    """Return a verdict with the error of an inexact form of the named force laws.

    What such a form leaves of the residual squares it has also put into the parameters of the same
    place, damper or bumpers: as much, in equal parts in each direction. The intervals hold it where
    it is visible; what is too little to be seen is stated, but widens nothing.
    """
    best = verdict.best
    laws = [each.effect for each in best.effects if each.effect.acts in FORCE_LAWS]
    is_bumper = {law.is_in_bumpers for law in laws}
    if verdict.outcome != "named" or not is_bumper:
        return verdict
    fit = best.fit
    keys = [
        free.key
        for free in fit.free
        if not is_correction(free.key) and is_of_contact(free.key, fit.parameters) in is_bumper
    ]
    per_direction = sum(values.size for values in best.held_out) / len(keys)
    visible = max(best.cost - (1 + MIN_VISIBLE_EXCESS) * verdict.floor, 0.0)
    hidden = max(best.cost / verdict.floor - 1, MIN_VISIBLE_EXCESS) * verdict.floor
    std_errors = dict(fit.std_errors)
    for key in keys:
        form_error = math.sqrt(visible * per_direction) * fit.white_errors[key]
        std_errors[key] = math.hypot(std_errors[key], form_error)
    form_errors = {key: math.sqrt(hidden * per_direction) * fit.white_errors[key] for key in keys}
    widened = replace(best, fit=replace(fit, std_errors=std_errors))
    return replace(verdict, best=widened, form_errors=form_errors)


def qualify_none(selection: SelectionResult, verdict: DiscoveryVerdict) -> DiscoveryVerdict:
    """Return a verdict "none" with the force laws to which the recordings are blind, if any.

    They do not exclude these, so its confidence is at most that of a guess.
    """
    if verdict.outcome != "none":
        return verdict
    blind = find_blind_spots(selection.evidence, verdict.best)
    if not blind:
        return verdict
    names = ", ".join(effect.candidate.name for effect in blind)
    reason = (
        f"{verdict.reason}, but the recordings cannot show {names}: other parameters imitate "
        f"{'them' if len(blind) > 1 else 'it'}, even as large as {100 * MAX_HIDDEN_SHARE:.0f} % of "
        "the measured force"
    )
    return replace(verdict, reason=reason, blind_to=blind)


def closed_fraction(before: float, after: float, floor: float) -> float:
    """Return the share of a misfit over its floor that is closed; rms values."""
    return (before - after) / (before - floor) if before > floor else 0.0


def suggest_next_run(
    outcome: str,
    best: Sequence[str],
    alternatives: Sequence[Sequence[str]],
    blind_to: Sequence[str] = (),
) -> str:
    """Suggest the test that would distinguish, confirm or show the effects."""
    if blind_to:
        return f"a sweep over other frequencies and levels, to show {', '.join(blind_to)}"
    names = {name.split(".")[0] for names in (best, *alternatives) for name in names}
    if outcome == "none":
        return "no further test is needed; a sweep at another amplitude would confirm the result"
    effects = [effect for effect in (*EFFECTS, *load_plugins()) if effect.id in names]
    in_damper = [effect for effect in effects if effect.place == "damper"]
    if any(effect.dissipates and not effect.has_resonance for effect in in_damper):
        return (
            "the same sweep at half and at twice the amplitude: hysteresis and friction change "
            "with amplitude, relaxation only with frequency"
        )
    if any(effect.acts == "sensor" for effect in effects):
        return "a calibration of the channels named, then the same sweep"
    in_bumpers = [effect for effect in effects if effect.is_in_bumpers]
    if any(effect.changes or effect.gap_rate for effect in in_bumpers):
        return "the same sweep again with the set-up unchanged, then with another gap"
    if in_bumpers:
        return "a sweep at twice the amplitude: deeper contact at higher speed"
    return "the same sweep at another amplitude and, where there are bumpers, another gap"
