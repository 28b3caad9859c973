"""Stepwise selection of missing effects by cross-validation: addition, elimination, exchange.

Each round screens all candidates by linear least squares around the current fit (`screening`),
refits the best few on all data, and judges each by three-fold cross-validation over the steps.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import takewhile

import numpy as np

from table_io.block import Float1D, Int1D
from twin.discovery.candidates import Candidate, list_generic_candidates
from twin.discovery.least_squares import FitResult, MapFunction, fit_parameters
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import CONTACT_ROWS, LogResiduals
from twin.discovery.screening import (
    NormalEquations,
    ScreenedCandidate,
    assign_folds,
    build_normal_equations,
    rank_candidates,
)

MAX_EFFECTS = 3
MAX_EXPLAINED_COST = 1.1  # mean square over the noise: with less, nothing is left to explain
MAX_REFITS, MAX_GENERIC_REFITS = 5, 2  # candidates refitted in a round
MIN_REFITS, MAX_COST_RATIO = 2, 1.5  # beyond the first two, skip costs above this ratio to the best
MIN_PROMISED_GAIN = 0.003  # of the residual squares: candidates that promise less are not refitted
MIN_VISIBLE_EXCESS = 0.05  # of the floor: excess below which there is no gap
NOISE_UNCERTAINTY = 0.15  # of its mean square, which a rest of some seconds shows to 7 % in rms
MIN_GAP_SHARE = 0.02  # of the initial gap that a second or third effect must close
OFFSETS = ("gap_offset", "sensor_offset")  # a constant has no form that could be inexact
MIN_GAIN_SIGMA = 4.0  # standard errors by which a gain must exceed zero
MIN_GAIN_SHARE = 0.03  # of the residual squares, overall or in one row, that an effect must remove
MIN_ROW_SHARE = 0.01  # of all entries: a smaller row is not judged by itself


@dataclass(frozen=True, eq=False)
class FittedSet:
    """Set of effects with its fitted parameters and cross-validation residuals."""

    effects: tuple[Candidate, ...]
    fit: FitResult

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(effect.name for effect in self.effects)

    @property
    def held_out(self) -> tuple[Float1D, ...]:
        """Cross-validation residual over the noise of each log, (entry,)."""
        return self.fit.held_out

    @property
    def cost(self) -> float:
        """Mean square of the cross-validation residual over the noise."""
        return mean_square(self.held_out)

    def add_to(self, parameters: ParameterSet) -> ParameterSet:
        """Add the effects, free, to a parameter set at their fitted values."""
        values = self.fit.parameters.values
        for effect in self.effects:
            shape = [values[free.key] for free in effect.free if free is not effect.amplitude]
            parameters = effect.add_to(parameters, shape, values[effect.amplitude.key])
        return parameters

    def remove_from(self, parameters: ParameterSet) -> ParameterSet:
        """Return a parameter set without the parameters of the effects."""
        for effect in self.effects:
            parameters = effect.remove_from(parameters)
        return parameters


@dataclass(frozen=True, slots=True)
class SelectionProgress:
    """Progress of a selection: set being fitted, `index` of `count` of a stage, and best so far.

    `index` is 0 at the start of a stage, before its first fit.
    """

    stage: str
    names: tuple[str, ...] = ()
    index: int = 0
    count: int = 0
    best: FittedSet | None = None


ProgressCallback = Callable[[SelectionProgress], None]


def mean_square(held_out: Sequence[Float1D]) -> float:
    """Return the mean square over the entries of all logs."""
    return float(
        sum(values @ values for values in held_out)
        / max(sum(values.size for values in held_out), 1)
    )


@dataclass(frozen=True, eq=False)
class SelectionProblem:
    """Selection problem: residuals of the logs and library of candidates."""

    log_residuals: tuple[LogResiduals, ...]
    library: tuple[Candidate, ...]
    mapper: MapFunction = map
    # Ideal instruments are no explanation with more errors of sensors: they end the selection.
    max_sensor_errors: int = MAX_EFFECTS
    # Mean square over the noise of what instruments leave that err in other ways than assumed.
    instrument_misfit: float = 0.0
    # Smallest deviation of the amplitude from its vanishing value, by effect.
    amplitude_limits: Mapping[str, float] = field(default_factory=dict)

    def fit_effects(self, start: ParameterSet, effects: Sequence[Candidate]) -> FittedSet:
        """Fit `start`, with these effects added, to all data, with cross-validation residuals."""
        result = fit_parameters(self.log_residuals, start, folds=self.folds, mapper=self.mapper)
        return FittedSet(tuple(effects), result)

    def is_admissible(self, fitted: FittedSet) -> bool:
        """Return True if every effect exceeds the limit of its amplitude."""
        return all(
            abs(fitted.fit.values[effect.amplitude.key] - effect.vanishing)
            > self.amplitude_limits[effect.effect.id]
            for effect in fitted.effects
            if effect.effect is not None and self.is_limited(effect)
        )

    def is_limited(self, candidate: Candidate) -> bool:
        """Return True for a fault of an instrument or of the set-up whose amplitude has a limit.

        Where the residual is noise such a fault has nothing to explain.
        """
        return candidate.effect is not None and candidate.effect.id in self.amplitude_limits

    @property
    def least_weight(self) -> float:
        """Weight of the log whose residual is closest to its noise."""
        return min(residuals.weight for residuals in self.log_residuals)

    @property
    def noise(self) -> float:
        """Mean square of what instruments alone leave: below it no effect is named."""
        return (1.0 + self.instrument_misfit) * self.least_weight**-2

    def is_noise(self, null: FittedSet, best: FittedSet) -> bool:
        """Return True if the base alone leaves hardly more than noise, and the best set as much.

        In every row: a bumper that is touched for moments leaves its mark in a small one.
        """
        limit = 1 + NOISE_UNCERTAINTY
        before, after = self.mean_squares(null), self.mean_squares(best)
        return null.cost < limit * min(self.noise, best.cost) and all(
            before[name] < limit * max(self.noise, after[name]) for name in before
        )

    @cached_property
    def folds(self) -> tuple[Int1D, ...]:
        """Cross-validation fold of each entry, (entry,) per log."""
        return tuple(assign_folds(residuals) for residuals in self.log_residuals)

    def mean_squares(self, fitted: FittedSet) -> dict[str, float]:
        """Return the mean square of the cross-validation residual by row; without small rows."""
        rows: dict[str, list[Float1D]] = {}
        for held_out, residuals in zip(fitted.held_out, self.log_residuals, strict=True):
            for index, name in enumerate((*residuals.rows, "rest")):
                mask = residuals.entry_row == index
                if mask.sum() > MIN_ROW_SHARE * mask.size:
                    rows.setdefault(name, []).append(held_out[mask])
        return {name: mean_square(values) for name, values in rows.items()}

    def compute_gain(self, before: FittedSet, after: FittedSet) -> tuple[float, float, float]:
        """Return (share of the residual squares removed, largest share in one row, significance).

        With b the residual of `after` and d the difference of the two residuals, the gain is the
        sum of d^2 + 2 d b. Its standard error is that of the second term, from the scatter over
        the blocks; the significance is the gain in standard errors.
        """
        gain, chance = 0.0, 0.0
        for old, new, residuals in zip(
            before.held_out, after.held_out, self.log_residuals, strict=True
        ):
            gain += float(old @ old - new @ new)
            chance += float(
                (np.bincount(residuals.entry_block, weights=2 * (old - new) * new) ** 2).sum()
            )
        total = before.cost * sum(a.size for a in before.held_out)
        share = gain / max(total, 1e-300)
        rows_before, rows_after = self.mean_squares(before), self.mean_squares(after)
        largest = max(
            (1 - rows_after[name] / square for name, square in rows_before.items() if square > 0),
            default=share,
        )
        return share, max(largest, share), gain / max(math.sqrt(chance), 1e-300)

    def is_worthwhile(self, before: FittedSet, after: FittedSet) -> bool:
        """Return True if `after` is better than `before`, significantly and by enough to matter."""
        share, row, errors = self.compute_gain(before, after)
        return share > 0 and row > MIN_GAIN_SHARE and errors > MIN_GAIN_SIGMA


@dataclass(frozen=True, eq=False)
class SelectionResult:
    """Outcome of a selection: the null (base alone), the best set, and every set refitted."""

    null: FittedSet
    best: FittedSet
    tried: tuple[FittedSet, ...] = field(default=())
    generic_sets: tuple[FittedSet, ...] = field(default=())  # sets with a generic term
    complete: bool = True  # False after a cancellation

    def find_gap_start(self, fitted: FittedSet) -> FittedSet:
        """Return the set from which the gap that a set closes is counted.

        The null; with its offsets alone, if the set has such and more: a channel that was not tared
        or a gap that was read wrongly may dwarf every law.
        """
        offsets = {effect.name for effect in fitted.effects if is_offset(effect)}
        if not offsets or len(offsets) == len(fitted.effects):
            return self.null
        starts = [tried for tried in self.tried if {*tried.names} == offsets]
        return min(starts, key=lambda tried: tried.cost, default=self.null)


class Cancelled(Exception):
    """Exception for a progress callback to stop the selection and keep the best set so far."""

    fitted: tuple[FittedSet, ...] = ()  # sets completed in the cancelled round


def stepwise_selection(
    problem: SelectionProblem, start: ParameterSet, report: ProgressCallback = lambda progress: None
) -> SelectionResult:
    """Select effects stepwise from the base alone; each addition puts the earlier ones in doubt."""
    null = problem.fit_effects(start, ())
    state = SelectionResult(null, null)
    try:
        while len(state.best.effects) < MAX_EFFECTS:
            previous, state = state.best, _forward_step(problem, state, report)
            if state.best is previous:  # it was revised when it was accepted
                break
            if problem.is_noise(state.null, state.best):  # a second effect would fit noise, too
                return replace(state, best=state.null)
            state = revise_step(problem, state, report)
            if count_sensor_errors(state.best) > problem.max_sensor_errors:
                return state
            state = replace(state, null=_refit_null(problem, state.null, state.best))
        return replace(state, generic_sets=_fit_generic_terms(problem, state, report))
    except Cancelled as cancelled:
        return replace(_accept_best(problem, state, cancelled.fitted), complete=False)


def is_offset(effect: Candidate) -> bool:
    """Return whether an effect is a constant error of an instrument or of the set-up."""
    return effect.effect is not None and effect.effect.id in OFFSETS


def count_sensor_errors(fitted: FittedSet) -> int:
    """Return the number of errors of sensors in a set of effects."""
    return sum(bool(effect.channel) for effect in fitted.effects)


def _forward_step(
    problem: SelectionProblem, state: SelectionResult, report: ProgressCallback
) -> SelectionResult:
    """Add the best further effect, if it is worthwhile."""
    return _accept_best(problem, state, _refit_candidates(problem, state.best, state.best, report))


def _accept_best(
    problem: SelectionProblem, state: SelectionResult, fitted_sets: Sequence[FittedSet]
) -> SelectionResult:
    """Accept the best set of a round, if it is worthwhile."""
    current, tried = state.best, (*state.tried, *fitted_sets)
    best = min(fitted_sets, key=lambda fitted: fitted.cost, default=current)
    state = replace(state, tried=tried)
    return replace(state, best=best) if _is_needed(problem, state, current, best) else state


def _is_needed(
    problem: SelectionProblem, state: SelectionResult, without: FittedSet, with_effect: FittedSet
) -> bool:
    """Return True if an effect is worthwhile and, beside others, closes enough of the gap.

    Of all rows, or of a contact row if it acts in the bumpers: there an inexact form of a law of
    the damper leaves nothing.
    """
    if not problem.is_worthwhile(without, with_effect):
        return False
    if not without.effects:
        return True
    start = state.find_gap_start(with_effect)
    if without.cost - with_effect.cost >= MIN_GAP_SHARE * (start.cost - with_effect.cost):
        return True
    (added,) = (effect for effect in with_effect.effects if effect.name not in without.names)
    if added.effect is None or not added.effect.is_in_bumpers:
        return False
    initial, before, after = map(problem.mean_squares, (start, without, with_effect))
    return any(
        before[row] - after[row]
        > max(MIN_GAIN_SHARE * before[row], MIN_GAP_SHARE * (initial[row] - after[row]))
        for row in CONTACT_ROWS
        if row in before
    )


def revise_step(
    problem: SelectionProblem, state: SelectionResult, report: ProgressCallback
) -> SelectionResult:
    """Drop each earlier effect that is not needed beside the last, or replace it by a better one.

    What was the best first effect may only have stood in for a later one. `state` is that after the
    last effect was added, with every set refitted until then.
    """
    for earlier in state.best.effects[:-1]:
        reduced = fit_without(problem, state.best, earlier)
        costs = [each.cost for each in state.tried if len(each.effects) == len(reduced.effects)]
        state = replace(state, tried=(*state.tried, reduced))
        if reduced.cost < min(costs) and not _is_needed(problem, state, reduced, state.best):
            state = replace(state, best=reduced)
            continue
        fitted_sets = _refit_candidates(problem, state.best, reduced, report)
        state = replace(state, tried=(*state.tried, *fitted_sets))
        best = min(fitted_sets, key=lambda fitted: fitted.cost, default=state.best)
        if problem.is_worthwhile(state.best, best):
            state = replace(state, best=best)
    return state


def fit_without(problem: SelectionProblem, fitted: FittedSet, dropped: Candidate) -> FittedSet:
    """Return a set refitted without one of its effects."""
    kept = tuple(effect for effect in fitted.effects if effect is not dropped)
    return problem.fit_effects(dropped.remove_from(fitted.fit.parameters), kept)


def _fit_generic_terms(
    problem: SelectionProblem, state: SelectionResult, report: ProgressCallback
) -> tuple[FittedSet, ...]:
    """Fit generic terms alone, in addition to the best effects, and in place of each of them."""
    best = state.best
    library = list_generic_candidates(problem.log_residuals)

    def report_best(progress: SelectionProgress) -> None:
        # a generic term is never reported as the best set
        report(replace(progress, best=best))

    starts = [state.null]
    if best.effects:
        starts.append(best)
    if len(best.effects) > 1:
        starts += [fit_without(problem, best, replaced) for replaced in best.effects]
    return tuple(
        fitted
        for start in starts
        for fitted in _refit_candidates(
            problem, best if start.effects else start, start, report_best, library
        )
    )


def _refit_null(problem: SelectionProblem, null: FittedSet, best: FittedSet) -> FittedSet:
    """Refit the null from the best set's parameters; an unconverged null causes false alarms."""
    refitted = problem.fit_effects(best.remove_from(best.fit.parameters), ())
    return refitted if refitted.cost < null.cost else null


def _refit_candidates(
    problem: SelectionProblem,
    current: FittedSet,
    start: FittedSet,
    report: ProgressCallback,
    library: Sequence[Candidate] | None = None,
) -> list[FittedSet]:
    """Screen the candidates, then refit the best additions to a start set on all data.

    The start is `current`, or the same without an effect that is to be replaced.
    """
    kept, parameters, generic = start.effects, start.fit.parameters, library is not None
    replaced_names = {*current.names} - {*start.names}
    count = len(kept) + 1
    stage = "generic terms" if generic else f"{count} effect{'s' if count > 1 else ''}"
    stage += "".join(f", replacing {name}" for name in replaced_names)
    report(SelectionProgress(stage, best=current))
    kept_keys = {free.key for effect in kept for free in effect.free}
    max_refits = MAX_GENERIC_REFITS if generic else MAX_REFITS
    if library is None:
        library = [
            candidate
            for candidate in problem.library
            if candidate.name not in start.names
            and kept_keys.isdisjoint(free.key for free in candidate.free)
            and candidate.name not in replaced_names
            and not (current.cost < problem.noise and problem.is_limited(candidate))
        ]
    if not library:
        return []
    fitted_sets: list[FittedSet] = []
    promising = select_promising(
        build_normal_equations(problem.log_residuals, parameters, library, problem.mapper),
        max_refits,
    )
    for index, screened in enumerate(promising, 1):
        effects = (*kept, screened.candidate)
        completed = () if generic else tuple(fitted_sets)
        best = min((current, *completed), key=lambda fitted: fitted.cost)
        try:
            report(
                SelectionProgress(
                    stage, tuple(effect.name for effect in effects), index, len(promising), best
                )
            )
        except Cancelled as cancelled:
            cancelled.fitted = completed
            raise
        fitted = problem.fit_effects(screened.add_to(parameters), effects)
        if problem.is_admissible(fitted):
            fitted_sets.append(fitted)
    return fitted_sets


def select_promising(equations: NormalEquations, max_count: int) -> list[ScreenedCandidate]:
    """Return the best candidates, without those far worse than the first or with little gain."""
    ranked = rank_candidates(equations, max_count)

    def is_promising(indexed: tuple[int, ScreenedCandidate]) -> bool:
        index, screened = indexed
        hopeless = index >= MIN_REFITS and screened.cost > MAX_COST_RATIO * ranked[0].cost
        return not hopeless and screened.cost <= (1.0 - MIN_PROMISED_GAIN) * equations.base_cost

    return [screened for _, screened in takewhile(is_promising, enumerate(ranked))]
