"""Search for a force law where no effect of the library explains a residual.

Terms of `law_terms` are screened, refitted with the base in the same likelihood and judged on
held-out steps, as effects are: forward selection with a small beam, over all classes at once. Where
they do not suffice, expressions of symbolic regression are judged in the same way.
Exponents that the data allow to be round are rounded.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.discovery.candidates import Candidate
from twin.discovery.discover import Discovery
from twin.discovery.law_terms import (
    find_law_class,
    list_law_candidates,
    round_exponent,
)
from twin.discovery.parameters import EffectKey, ParameterSet
from twin.discovery.residuals import LogResiduals
from twin.discovery.screening import build_normal_equations
from twin.discovery.selection import (
    FittedSet,
    ProgressCallback,
    SelectionProblem,
    SelectionProgress,
    fit_without,
    select_promising,
)
from twin.discovery.symbolic_regression import list_symbolic_candidates
from twin.discovery.verdict import closed_fraction
from twin.laws.effect import Effect, Place
from twin.model.valid_range import list_inputs

FIRST_REFITS, NEXT_REFITS, BEAM_WIDTH = 8, 4, 3
MAX_EXPLAINED_RATIO = 1.05  # of the mean square to the noise: with less no second term is tried
MIN_FIRST_GAIN = 0.3  # of the excess over the noise: a term that gains less is given no second one
MIN_CLOSED_SHARE = 0.5  # of the misfit that a law must close to be proposed
SUFFICIENT_RATIO = 1.1  # times the noise, held out: with less, the law explains the record
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
    nearest: str
    law_class: str
    by_class: tuple[tuple[str, FittedSet], ...]

    @property
    def is_sufficient(self) -> bool:
        """True if the law leaves at most `SUFFICIENT_RATIO` times the noise."""
        return self.misfit <= SUFFICIENT_RATIO


def is_explained(discovery: Discovery) -> bool:
    """Return whether a discovery leaves nothing for a law to explain."""
    verdict = discovery.verdict
    return verdict.outcome != "unexplained" and not verdict.has_remainder


def propose_law(
    discovery: Discovery, report: ProgressCallback = lambda progress: None
) -> LawProposal | None:
    """Return a law for what a discovery leaves unexplained.

    None if nothing is left unexplained, or no law helps.
    """
    if is_explained(discovery):
        return None
    verdict, selection = discovery.verdict, discovery.selection
    starts = [selection.null, *([verdict.best] if verdict.best.effects else [])]
    singles = [fitted for fitted in selection.tried if len(fitted.effects) == 1]
    nearest = min(singles, key=lambda fitted: fitted.cost, default=None)
    nearest_name = nearest.names[0] if nearest else ""
    problem = discovery.prepared.problem
    return select_law(problem, starts, search_laws(problem, starts, report), nearest_name)


def select_law(
    problem: SelectionProblem,
    starts: Sequence[FittedSet],
    fitted_sets: Sequence[FittedSet],
    nearest: str = "",
) -> LawProposal | None:
    """Return the law, among the sets fitted, that explains most of what the first start leaves.

    None if none helps.
    """
    if not fitted_sets:
        return None
    best = _round_exponents(problem, _select_simplest(problem, fitted_sets))
    start = max(
        (start for start in starts if start.effects == best.effects[: len(start.effects)]),
        key=lambda start: len(start.effects),
    )
    before, after = problem.measure_misfit(starts[0]), problem.measure_misfit(best)
    closed_share = closed_fraction(before, after, problem.find_noise_floor(best))
    if closed_share < MIN_CLOSED_SHARE or not problem.is_worthwhile(start, best):
        return None
    terms = best.effects[len(start.effects) :]
    laws = tuple(_describe_law(problem, best, term, nearest) for term in terms)
    law_class = find_law_class(terms[0])
    return LawProposal(
        best, start, laws, after, nearest, law_class, _list_best_by_class(fitted_sets)
    )


def search_laws(
    problem: SelectionProblem,
    starts: Sequence[FittedSet],
    report: ProgressCallback = lambda progress: None,
) -> list[FittedSet]:
    """Return the sets of a start and one or two terms that were fitted, best first.

    Later starts are tried only if the earlier ones lead to no explanation, and to none as good.
    """
    # without load cells contact is unknown, not absent
    has_contact = any((log.contact_state != 0).any() for log in problem.log_residuals)
    known = [str(key) for key in starts[0].fit.parameters.values]
    library = [
        term
        for term in list_law_candidates(problem.log_residuals[0].scale, has_contact)
        if not any(name.startswith(f"{term.name}.") for name in known)  # of the model already
    ]
    fitted_sets: list[FittedSet] = []
    for start in starts:
        reached = min((fitted.cost for fitted in fitted_sets), default=math.inf)
        if not _explains(problem, fitted_sets) and start.cost < reached:
            fitted_sets += _search_from(problem, start, library, report)
    if not _explains(problem, [*starts, *fitted_sets]):
        expressions = list_symbolic_candidates(problem.log_residuals, starts[0].fit.parameters)
        if expressions:
            fitted_sets += _extend(problem, starts[0], expressions, NEXT_REFITS, report)
    return sorted(fitted_sets, key=lambda fitted: fitted.cost)


def _search_from(
    problem: SelectionProblem,
    start: FittedSet,
    library: Sequence[Candidate],
    report: ProgressCallback,
) -> list[FittedSet]:
    """Return the sets of `start` and one or two terms that were fitted."""
    fitted_sets = _extend(problem, start, library, FIRST_REFITS, report)
    for current in fitted_sets[:BEAM_WIDTH]:
        excess = start.cost - problem.expected_square
        if _explains(problem, fitted_sets) or start.cost - current.cost < MIN_FIRST_GAIN * excess:
            break
        further = [term for term in library if term.name not in current.names]
        reached = min(fitted.cost for fitted in fitted_sets)
        fitted_sets += _extend(problem, current, further, NEXT_REFITS, report, reached)
    best = min(fitted_sets, key=lambda fitted: fitted.cost, default=start)
    names = (*start.names, *best.names[-1:])
    if len(best.effects) == len(start.effects) + 2 and all(
        fitted.names != names for fitted in fitted_sets
    ):
        # the first term may only have stood in for the second, which screening alone did not show
        report(SelectionProgress("a law", names, 1, 1, best))
        fitted_sets.append(fit_without(problem, best, best.effects[-2]))
    return fitted_sets


def _explains(problem: SelectionProblem, fitted_sets: Sequence[FittedSet]) -> bool:
    """Return whether one of the sets leaves hardly more than noise."""
    return any(fitted.cost <= MAX_EXPLAINED_RATIO * problem.noise for fitted in fitted_sets)


def _extend(
    problem: SelectionProblem,
    current: FittedSet,
    library: Sequence[Candidate],
    max_refits: int,
    report: ProgressCallback,
    reached: float = math.inf,
) -> list[FittedSet]:
    """Return the sets of `current` and the best screened terms, each refitted, best first.

    Terms that promise far less than another set has `reached` are left out.
    """
    parameters = current.fit.parameters
    equations = build_normal_equations(problem.log_residuals, parameters, library, problem.mapper)
    fitted_sets: list[FittedSet] = []
    screened_terms = select_promising(equations, max_refits, reached / max(current.cost, 1e-300))
    for index, screened in enumerate(screened_terms, 1):
        effects = (*current.effects, screened.candidate)
        names = tuple(effect.name for effect in effects)
        best = min((current, *fitted_sets), key=lambda fitted: fitted.cost)
        report(SelectionProgress("a law", names, index, len(screened_terms), best))
        fitted_sets.append(problem.fit_effects(screened.add_to(parameters), effects))
    return sorted(fitted_sets, key=lambda fitted: fitted.cost)


def _select_simplest(problem: SelectionProblem, fitted_sets: Sequence[FittedSet]) -> FittedSet:
    """Return the set with the fewest parameters than which the best is not worth more."""
    best = min(fitted_sets, key=lambda fitted: fitted.cost)
    as_good = [
        fitted
        for fitted in fitted_sets
        if fitted is best or not problem.is_worthwhile(fitted, best)
    ]

    def complexity(fitted: FittedSet) -> tuple[int, float]:
        return sum(len(effect.free) for effect in fitted.effects), fitted.cost

    return min(as_good, key=complexity)


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
    assert law is not None
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
