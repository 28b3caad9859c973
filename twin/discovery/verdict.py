"""Verdict on a selection: none, named, ambiguous or unexplained, with a confidence.

The gap's excess is the mean square of the cross-validation residual over the noise, less the floor.
    none         the residual of the base model is noise
    named        the effects close the gap, no other effects and no generic term do so better
    ambiguous    other effects fit as well: the data cannot distinguish them
    unexplained  a residual remains, or a generic term fits much better than any library effect
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
    BUMPER_STIFFNESS,
    DAMPING,
    GENERIC_PREFIX,
    STIFFNESS,
    NuisanceKey,
    ParameterKey,
    TareKey,
    is_correction,
)
from twin.discovery.selection import (
    MIN_VISIBLE_EXCESS,
    FittedSet,
    SelectionProblem,
    SelectionResult,
)
from twin.laws.library import EFFECTS, load_plugins

# standard errors by which a rival set must be worse to be excluded
MIN_SEPARATION_SIGMA = 3.5
# of the gap closed by the best set: a set that closes less is no rival, however few the data
MIN_RIVAL_GAP_SHARE = 0.8
MAX_REMAINDER_SHARE = 0.06  # of the gap's excess: a larger remainder is reported as unexplained
# of the gap's excess: gain that makes a generic term better than a library effect in its place
MIN_GENERIC_GAIN_SHARE = 0.012
# of the gap's excess: the same where it replaces one of several effects
MIN_REPLACEMENT_GAIN_SHARE = 0.001
NEVER_AT_BOUND = (STIFFNESS, DAMPING, BUMPER_STIFFNESS)  # positive in a real specimen
BLIND_CONFIDENCE = 0.5  # of "none", where an effect could be there without a trace
MIN_NAMED_GAP_SHARE = 0.5  # of the gap's excess that the named effects must close


@dataclass(frozen=True, eq=False)
class DiscoveryVerdict:
    """Verdict with the sets of effects and the numbers behind it (mean squares over the noise)."""

    outcome: str
    best: FittedSet
    confidence: float
    alternatives: tuple[FittedSet, ...]  # as good as the best, if ambiguous
    generic: FittedSet | None  # set with a generic term that fits better, or improves the null
    floor: float
    has_remainder: bool  # the residual exceeds the floor by more than an inexact force law explains
    reason: str
    # force laws that could be there without a trace, where nothing is named
    blind_to: tuple[UndetectedEffect, ...] = ()
    # standard deviations that an inexact form of the named laws may cause unseen
    form_errors: Mapping[ParameterKey, float] = field(default_factory=dict)

    @property
    def is_decided(self) -> bool:
        """True if the effects are named, or none, and nothing remains or could hide at its size."""
        is_closed = self.outcome in ("none", "named") and not self.has_remainder
        return is_closed and not self.blind_to


def judge_selection(
    problem: SelectionProblem,
    selection: SelectionResult,
    floor: float,
) -> DiscoveryVerdict:
    """Judge the outcome of a selection; `floor` is a mean square over the noise.

    The parameters of the given model do not count: it may be rough, and every one of them is
    fitted.
    """
    null, best = selection.null, selection.best
    gap = _measure_gap(selection, floor)
    generic = _find_better_generic(problem, selection, floor)
    is_additional = generic is not None and _needs_named_effects(selection, generic, gap)
    if problem.is_noise(null, best):
        reason = "the residual of the model is below the noise of the sensors"
        return DiscoveryVerdict("none", null, 0.9, (), None, floor, False, reason)
    if not best.effects:
        return _judge_unnamed(problem, selection, floor, generic)
    remaining = max(best.cost - floor, 0.0)
    rivals = _find_rivals(problem, selection)
    as_good = [
        fitted
        for fitted, errors in rivals
        if fitted.cost <= best.cost or errors < MIN_SEPARATION_SIGMA
    ]
    if unstrained := [
        fitted for fitted in as_good if _tares_at_bound(fitted) < _tares_at_bound(best)
    ]:
        alternative = min(unstrained, key=lambda fitted: fitted.cost)
        return judge_selection(problem, replace(selection, best=alternative), floor)
    if simpler := [fitted for fitted in as_good if _is_limit_case(best, fitted)]:
        # a law contains its limit, and fits the noise a little better
        return judge_selection(problem, replace(selection, best=simpler[0]), floor)
    alternatives = tuple({frozenset(fitted.names): fitted for fitted in reversed(as_good)}.values())
    # the form of a force law may be inexact, that of an error of a sensor is not
    is_exact = all(name.startswith("sensor_") for name in best.names)
    allowed = 0.0 if is_exact else MAX_REMAINDER_SHARE * gap
    has_remainder = remaining > max(allowed, MIN_VISIBLE_EXCESS * floor)
    confidence = _confidence(selection, rivals, remaining / gap)
    if doubt := _find_doubt(selection, None if is_additional else generic, has_remainder, gap):
        return DiscoveryVerdict(
            "unexplained", best, min(confidence, 0.3), (), generic, floor, True, doubt
        )
    if alternatives and (core := _judge_common_core(problem, selection, alternatives, floor)):
        return core
    if alternatives:
        names = "; ".join(" + ".join(fitted.names) for fitted in alternatives)
        reason = f"as good as {' + '.join(best.names)}: {names}"
        share = confidence / (1 + len(alternatives))
        return DiscoveryVerdict(
            "ambiguous", best, share, alternatives, generic, floor, has_remainder, reason
        )
    reason = "the residual is noise"
    if remaining > MIN_VISIBLE_EXCESS * floor:
        percent = 100 * math.sqrt(remaining / gap)
        reason = (
            f"{percent:.2g} % of the misfit remains, as an inexact form of the force law may leave"
        )
    if generic is not None:
        reason = f"part of the misfit remains unexplained; it resembles {_format_generic(generic)}"
        confidence, has_remainder = 0.8 * confidence, True
    elif has_remainder:
        reason = "part of the misfit remains unexplained"
    return DiscoveryVerdict("named", best, confidence, (), generic, floor, has_remainder, reason)


def _measure_gap(selection: SelectionResult, floor: float) -> float:
    """Return the misfit, a mean square over the noise, that the best set may close."""
    return max(selection.find_gap_start(selection.best).cost - floor, 1e-9)


def widen_for_form(verdict: DiscoveryVerdict) -> DiscoveryVerdict:
    """Return a verdict with the error of an inexact form of the named force laws.

    What such a form leaves of the residual squares it has also put into the parameters of the same
    place, damper or bumpers: as much, in equal parts in each direction. The intervals hold it where
    it is visible; what is too little to be seen is stated, but widens nothing.
    """
    best = verdict.best
    laws = [each.effect for each in best.effects if each.effect and each.effect.acts in FORCE_LAWS]
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


def qualify_none(problem: SelectionProblem, verdict: DiscoveryVerdict) -> DiscoveryVerdict:
    """Return a verdict "none" with the force laws to which the recordings are blind, if any.

    They do not exclude these, so its confidence is at most that of a guess.
    """
    if verdict.outcome != "none":
        return verdict
    blind = find_blind_spots(problem, verdict.best)
    if not blind:
        return verdict
    names = ", ".join(effect.candidate.name for effect in blind)
    reason = (
        f"{verdict.reason}, but the recordings cannot show {names}: other parameters imitate "
        f"{'them' if len(blind) > 1 else 'it'}, even as large as {100 * MAX_HIDDEN_SHARE:.0f} % of "
        "the spring of the damper"
    )
    confidence = min(verdict.confidence, BLIND_CONFIDENCE)
    return replace(verdict, confidence=confidence, reason=reason, blind_to=blind)


def _judge_common_core(
    problem: SelectionProblem,
    selection: SelectionResult,
    alternatives: Sequence[FittedSet],
    floor: float,
) -> DiscoveryVerdict | None:
    """Return the verdict on the effects common to all equally good sets, if it is "named"."""
    sets = [set(fitted.names) for fitted in (selection.best, *alternatives)]
    common = set.intersection(*sets)
    candidates = [fitted for fitted in selection.tried if common and set(fitted.names) == common]
    if not candidates:
        return None
    core = min(candidates, key=lambda fitted: fitted.cost)
    # a generic term that replaces the common effects is no evidence on them
    generic_sets = [
        fitted
        for fitted in selection.generic_sets
        if len(fitted.effects) == 1 or common < set(fitted.names)
    ]
    of_core = replace(selection, best=core, generic_sets=tuple(generic_sets))
    verdict = judge_selection(problem, of_core, floor)
    if verdict.outcome != "named":
        return None
    alternatives_text = " or ".join(
        dict.fromkeys(" + ".join(sorted(names - common)) for names in sets)
    )
    reason = (
        f"part of the misfit remains, to which {alternatives_text} may contribute: the data cannot "
        "distinguish them"
    )
    return replace(verdict, has_remainder=True, reason=reason)


def _find_doubt(
    selection: SelectionResult,
    generic: FittedSet | None,
    has_remainder: bool,
    gap: float,
) -> str:
    """Return the reason why the best effects must not be named; empty if there is none."""
    best = selection.best
    names = " + ".join(best.names)
    if generic is not None:
        return f"{_format_generic(generic)} explains what {names} cannot"
    closed = selection.find_gap_start(best).cost - best.cost
    if has_remainder and closed < MIN_NAMED_GAP_SHARE * gap:
        return "the best effects remove less than half of the misfit"
    at_bound = [
        effect.amplitude.name
        for effect in best.effects
        if effect.amplitude.key in best.fit.at_bound
    ]
    return (
        f"{', '.join(at_bound)} is at its bound, and part of the misfit remains"
        if has_remainder and at_bound
        else ""
    )


def _judge_unnamed(
    problem: SelectionProblem, selection: SelectionResult, floor: float, generic: FittedSet | None
) -> DiscoveryVerdict:
    null = selection.null
    is_visible = null.cost > (1 + MIN_VISIBLE_EXCESS) * floor
    if generic is not None and is_visible and problem.is_worthwhile(null, generic):
        reason = (
            f"no effect of the library, but {_format_generic(generic)} explains part of the misfit"
        )
        return DiscoveryVerdict("unexplained", null, 0.9, (), generic, floor, True, reason)
    if null.cost > (1 + 2 * MIN_VISIBLE_EXCESS) * floor:
        reason = "the residual exceeds the noise, and no effect of the library explains it"
        return DiscoveryVerdict("unexplained", null, 0.8, (), None, floor, True, reason)
    if at_bound := [str(key) for key in NEVER_AT_BOUND if key in null.fit.at_bound]:
        reason = (
            f"the residual is noise only with {', '.join(at_bound)} at its bound, which is not "
            "physical"
        )
        return DiscoveryVerdict("unexplained", null, 0.8, (), None, floor, True, reason)
    return DiscoveryVerdict("none", null, 0.95, (), None, floor, False, "the residual is noise")


def _format_generic(fitted: FittedSet) -> str:
    return f"the generic term {fitted.names[-1].removeprefix(f'{GENERIC_PREFIX}.')}"


def _find_better_generic(
    problem: SelectionProblem, selection: SelectionResult, floor: float
) -> FittedSet | None:
    """Return the set with a generic term that fits much better than the best set without."""
    best, gap = selection.best, _measure_gap(selection, floor)
    leaves_more = best.cost > (1 + 2 * MIN_VISIBLE_EXCESS) * floor
    for fitted in sorted(selection.generic_sets, key=lambda fitted: fitted.cost):
        gain = best.cost - fitted.cost
        if len(fitted.effects) < len(best.effects) and gain > -MIN_GENERIC_GAIN_SHARE * gap:
            return fitted  # one generic term fits as well as several effects
        if len(fitted.effects) > len(best.effects) > 0:
            least_share = MAX_REMAINDER_SHARE
        elif len(fitted.effects) == len(best.effects) > 1:
            least_share = MIN_REPLACEMENT_GAIN_SHARE
        else:
            least_share = MIN_GENERIC_GAIN_SHARE
        # what the best effects leave, however little, is then no inexact form of them
        explains_elsewhere = (
            leaves_more
            and fitted.cost <= (1 + MIN_VISIBLE_EXCESS) * floor
            and _acts_elsewhere(fitted, best)
        )
        is_better = gain > least_share * gap or explains_elsewhere
        if is_better and problem.compute_gain(best, fitted)[2] > MIN_SEPARATION_SIGMA:
            return fitted
    return None


def _acts_elsewhere(generic: FittedSet, best: FittedSet) -> bool:
    """Return True for one generic term, of damper or bumpers, where no best effect acts there."""
    if len(generic.effects) != 1 or not best.effects:
        return False
    in_bumpers = generic.names[0].startswith(f"{GENERIC_PREFIX}.bumper ")
    return not any(
        each.effect is not None and each.effect.is_in_bumpers == in_bumpers for each in best.effects
    )


def _needs_named_effects(selection: SelectionResult, generic: FittedSet, gap: float) -> bool:
    """Return True if the generic term alone fits much worse than together with the effects."""
    if len(generic.effects) <= len(selection.best.effects):
        return False
    costs = [fitted.cost for fitted in selection.generic_sets if len(fitted.effects) == 1]
    return min(costs, default=math.inf) - generic.cost > MAX_REMAINDER_SHARE * gap


def _find_rivals(
    problem: SelectionProblem, selection: SelectionResult
) -> list[tuple[FittedSet, float]]:
    """Return (set, standard errors by which it is worse) of each rival.

    A rival has as many effects as the best set, but others, and closes nearly as much of the gap.
    """
    best = selection.best
    start = selection.find_gap_start(best)
    return [
        (rival, problem.compute_gain(rival, best)[2])
        for rival in selection.tried
        if len(rival.effects) == len(best.effects)
        and frozenset(rival.names) != frozenset(best.names)
        and start.cost - rival.cost >= MIN_RIVAL_GAP_SHARE * (start.cost - best.cost)
        and not _is_limit_case(rival, best)
        and not _tares_at_bound(rival) - _tares_at_bound(best)
    ]


def _tares_at_bound(fitted: FittedSet) -> set[ParameterKey]:
    """Return the tare errors at their bound: a fit that needs them is implausible."""
    return {key for key in fitted.fit.at_bound if isinstance(key, TareKey)}


def _is_limit_case(richer: FittedSet, simpler: FittedSet) -> bool:
    """Return True if the sets differ in one law, and that of the second is a limit of the first."""
    own = [effect for effect in richer.effects if effect.name not in simpler.names]
    others = [name for name in simpler.names if name not in richer.names]
    return (
        len(own) == len(others) == 1
        and own[0].effect is not None
        and others[0] in own[0].effect.limits
    )


def _confidence(
    selection: SelectionResult, rivals: Sequence[tuple[FittedSet, float]], remaining_share: float
) -> float:
    """Return the confidence, 0 to 1, from the separation from rivals and the remaining gap."""
    best = selection.best
    margin = min((errors for _, errors in rivals), default=10.0)
    separation = 1.0 / (1.0 + math.exp(-(margin - 2.0)))
    # of the gap's rms: an inexact form of the right law may leave a sixth, a wrong law leaves half
    completeness = 0.4 + 0.6 / (
        1.0 + math.exp((math.sqrt(max(remaining_share, 0.0)) - 0.27) / 0.04)
    )
    # an instrument as bad as one can be, or its tare beside its drift, says nothing about the law
    has_nuisances = any(isinstance(key, NuisanceKey) for key in best.fit.values)
    harmless = (NuisanceKey, TareKey) if has_nuisances else ()
    is_at_bound = any(not isinstance(key, harmless) for key in best.fit.at_bound)
    validity = 1.0 if best.fit.converged and not is_at_bound else 0.6
    return 0.98 * separation * completeness * validity


def closed_fraction(before: float, after: float, floor: float) -> float:
    """Return (before - after) / (before - floor) of the roots of the given mean squares."""
    b, a, f = (math.sqrt(max(x, 0.0)) for x in (before, after, floor))
    return (b - a) / (b - f) if b > f else 0.0


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
