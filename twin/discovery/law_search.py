"""Search for a force law where no effect of the library explains a residual.

Terms of `law_terms` compete with each other, and beside the effects that were found, by the
evidence of their sets, as effects do (`selection`): single terms of all classes first, then pairs.
Where they do not suffice, expressions of symbolic regression are judged in the same way. Exponents
that the data allow to be round are rounded.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.errors import InputError
from twin.discovery.candidates import Candidate
from twin.discovery.discover import Discovery
from twin.discovery.law_terms import find_law_class, list_law_candidates, round_exponent
from twin.discovery.parameters import EffectKey, ParameterSet
from twin.discovery.residuals import LogResiduals
from twin.discovery.selection import FittedSet, ProgressCallback, SelectionProblem, select_effects
from twin.discovery.symbolic_regression import list_symbolic_candidates
from twin.discovery.verdict import closed_fraction
from twin.evidence.selection import RoundEffort
from twin.laws.checks import check_effect
from twin.laws.effect import Effect, Place
from twin.model.valid_range import list_inputs

MAX_TERMS = 2  # of a law
FIRST_REFITS, NEXT_REFITS = 8, 6  # sets that are refitted in each round, at most
PROMISE_SHARE = 0.3  # of the best log evidence: sets that promise less than the rest are left out
MIN_CLOSED_SHARE = 0.5  # of the misfit that a law must close to be proposed
MAX_WORSE_SIGMA = 2.0  # standard errors by which a law with a rounded exponent may be worse
MAX_WORSE_SHARE = 1e-4  # of the held-out squares, which no one would miss


@dataclass(frozen=True, eq=False)
class LawProposal:
    """A law for what the library does not explain: the fitted set and how good it is.

    `start` is the set to which its terms were added, `laws` an effect for each term;
    `nearest` the effect of the library that does best alone. `by_class` are the best single terms
    of each class, best first.
    """

    fitted: FittedSet
    start: FittedSet
    laws: tuple[Effect, ...]
    misfit: float  # held out, rms over the noise of the sensors
    is_sufficient: bool  # what it leaves is noise
    nearest: str
    law_class: str
    by_class: tuple[tuple[str, FittedSet], ...]


def is_explained(discovery: Discovery) -> bool:
    """Return whether a discovery leaves nothing for a law to explain."""
    verdict = discovery.verdict
    return verdict.outcome != "unexplained" and not verdict.has_remainder


def propose_law(
    discovery: Discovery, report: ProgressCallback = lambda progress: None
) -> LawProposal | None:
    """Return a law for what a discovery leaves unexplained.

    None if nothing is left unexplained, or no law does better than the effects that are closest.
    """
    if is_explained(discovery):
        return None
    selection, problem = discovery.selection, discovery.prepared.problem
    singles = [fitted for fitted in selection.tried if len(fitted.effects) == 1]
    nearest = min(singles, key=lambda fitted: fitted.cost, default=None)
    null, best = selection.null, discovery.verdict.best
    fitted_sets = search_laws(problem, null, best, report)
    better = [
        each
        for each in fitted_sets
        if problem.is_worthwhile(best, each) and is_playable(problem, each)
    ]
    return select_law(problem, null, better, nearest.names[0] if nearest else "")


def select_law(
    problem: SelectionProblem,
    null: FittedSet,
    fitted_sets: Sequence[FittedSet],
    nearest: str = "",
) -> LawProposal | None:
    """Return the law, among the sets fitted, that explains most of what no effect does.

    None if none helps.
    """
    if not fitted_sets:
        return None
    best = _round_exponents(problem, problem.select_simplest(fitted_sets))
    before, after = problem.measure_misfit(null), problem.measure_misfit(best)
    closed_share = closed_fraction(before, after, problem.find_noise_floor(best))
    start = _drop_laws(problem, null, best)
    if closed_share < MIN_CLOSED_SHARE or not problem.is_worthwhile(start, best):
        return None
    terms = best.effects[len(start.effects) :]
    laws = tuple(_describe_law(problem, best, term, nearest) for term in terms)
    return LawProposal(
        best, start, laws, after, problem.leaves_noise(best), nearest,
        find_law_class(terms[0]), _list_best_by_class(fitted_sets),
    )  # fmt: skip


def is_playable(problem: SelectionProblem, fitted: FittedSet) -> bool:
    """Return whether the solver can integrate the laws of a set with the values fitted."""
    try:
        for term in filter(find_law_class, fitted.effects):
            check_effect(_describe_law(problem, fitted, term, ""))
    except InputError:
        return False
    return True


def _drop_laws(problem: SelectionProblem, null: FittedSet, fitted: FittedSet) -> FittedSet:
    """Return a set refitted without its terms of a law: its effects of the library come first."""
    effects = tuple(effect for effect in fitted.effects if not find_law_class(effect))
    if not effects:
        return null
    parameters = fitted.fit.parameters
    for term in fitted.effects[len(effects) :]:
        parameters = term.remove_from(parameters)
    return problem.fit_effects(parameters, effects)


def search_laws(
    problem: SelectionProblem,
    null: FittedSet,
    best: FittedSet,
    report: ProgressCallback = lambda progress: None,
) -> list[FittedSet]:
    """Return the sets with one or two terms that were fitted, best first.

    Beside them the effects of `best` may stay, or some of them.
    """
    terms = list_new_terms(problem, null)
    fitted_sets = _search_from(problem, null, best, terms, report)
    if not any(map(problem.leaves_noise, fitted_sets[:1])):
        expressions = list_symbolic_candidates(problem.log_residuals, null.fit.parameters)
        if expressions:
            fitted_sets += _search_from(problem, null, best, expressions, report)
    return sorted(fitted_sets, key=lambda fitted: fitted.cost)


def list_new_terms(problem: SelectionProblem, null: FittedSet) -> list[Candidate]:
    """Return the terms of laws that logs may show and that a model does not have already."""
    has_contact = any(log.shows_bumpers for log in problem.log_residuals)
    model = null.fit.parameters.to_model()
    known = {instance.effect.id for instance in model.effects}.union(model.coefficients)
    return [
        term
        for term in list_law_candidates(problem.log_residuals[0].scale, has_contact)
        if known.isdisjoint((term.name, *term.effect.compiled))
    ]


def _search_from(
    problem: SelectionProblem,
    null: FittedSet,
    closest: FittedSet,
    terms: Sequence[Candidate],
    report: ProgressCallback,
) -> list[FittedSet]:
    """Return the sets with a term of a law that were fitted about the closest one, best first."""
    known = len(closest.effects)
    rounds = [
        RoundEffort("a law", count + known, refits, PROMISE_SHARE, if_open=count > 1)
        for count, refits in zip(range(1, MAX_TERMS + 1), (FIRST_REFITS, NEXT_REFITS), strict=True)
    ]
    laws = replace(problem, library=(*closest.effects, *terms))
    first = closest if closest.effects else None
    selection = select_effects(laws, null.fit.parameters, report, first, rounds)
    with_law = [each for each in selection.tried if any(map(find_law_class, each.effects))]
    with_law += _drop_terms(laws, with_law) if with_law else ()
    return sorted(with_law, key=lambda fitted: fitted.cost)


def _drop_terms(problem: SelectionProblem, fitted_sets: Sequence[FittedSet]) -> Iterator[FittedSet]:
    """Yield the best set without each of its terms, where it has several and that is not fitted.

    One may only have stood in for another, which a ladder of shapes did not show.
    """
    best = min(fitted_sets, key=lambda fitted: fitted.cost)
    terms = [term for term in best.effects if find_law_class(term)]
    known = {frozenset(fitted.names) for fitted in fitted_sets}
    for dropped in terms if len(terms) > 1 else ():
        kept = tuple(effect for effect in best.effects if effect is not dropped)
        if frozenset(effect.name for effect in kept) not in known:
            yield problem.fit_effects(dropped.remove_from(best.fit.parameters), kept)


def _round_exponents(problem: SelectionProblem, fitted: FittedSet) -> FittedSet:
    """Return the set with round exponents where held-out steps do not tell the difference."""
    for term in fitted.effects:
        scale = problem.log_residuals[0].scale
        rounded = round_exponent(term, fitted.fit.parameters, scale)
        if rounded is None:
            continue
        candidate, amplitude = rounded
        shape = candidate.shapes[0]
        start = candidate.add_to(term.remove_from(fitted.fit.parameters), shape, amplitude)
        effects = tuple(candidate if effect is term else effect for effect in fitted.effects)
        refitted = problem.fit_effects(start, effects)
        is_as_good = refitted.cost <= (1 + MAX_WORSE_SHARE) * fitted.cost
        if is_as_good or problem.compute_gain(refitted, fitted)[2] < MAX_WORSE_SIGMA:
            fitted = refitted
    return fitted


def _list_best_by_class(fitted_sets: Sequence[FittedSet]) -> tuple[tuple[str, FittedSet], ...]:
    """Return (class, its best single term) of each class that was fitted, best first."""
    best: dict[str, FittedSet] = {}
    for fitted in fitted_sets:
        law_class = find_law_class(fitted.effects[-1])
        if law_class and sum(bool(find_law_class(term)) for term in fitted.effects) == 1:
            best.setdefault(law_class, fitted)
    return tuple(best.items())


def _describe_law(
    problem: SelectionProblem, fitted: FittedSet, term: Candidate, nearest: str
) -> Effect:
    """Return the effect of a fitted term: its values as typical ones, its measured range."""
    law = term.effect
    parameters = []
    for own in law.parameters:
        value = fitted.fit.parameters.values[EffectKey(term.name, own.name)]
        low, high = min(own.low, value), max(own.high, value)
        parameters.append(replace(own, typical=value, low=low, high=high))
    valid_range = measure_range(problem.log_residuals, fitted.fit.parameters, law.place)
    return replace(
        law,
        parameters=tuple(parameters),
        valid_range=tuple(
            (name, *ends)
            for name, ends in valid_range.items()
            if name in law.used_names & law.variables.keys()  # a state may have the same letter
        ),
        confused_with=(nearest,) if nearest else (),
        residual=f"A {law.title or 'law'} found where no effect of the library fits.",
    )


def measure_range(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet, place: Place
) -> Mapping[str, tuple[float, float]]:
    """Return the least and largest value in the logs of each variable of laws at a place, SI."""
    rows: dict[str, list[float]] = {}
    for residuals in log_residuals:
        m = residuals.motion(parameters.assumed_sensors())
        model = parameters.model_for_log(residuals.log_number, m)
        motion = {"u": m.u, "v": m.v, "a": m.table_acc, "t": m.time_s, "y": m.table_disp}
        motion = {name: values[m.moving] for name, values in motion.items()}
        opening_m = model.gap_opening_m(1.0) * motion["t"]
        for inputs in list_inputs(place, model.parameters, opening_m, motion):
            for name, values in inputs.items():
                if np.isfinite(values).any():
                    ends = (float(np.nanmin(values)), float(np.nanmax(values)))
                    rows.setdefault(name, []).extend(ends)
    return {name: (min(ends), max(ends)) for name, ends in rows.items()}
