"""Selection of missing effects by their evidence: rank all sets, refit the best, rank again.

Each round ranks all sets of effects in the linear model about the best fit so far (`evidence`) and
refits the most probable ones to all data, with cross-validation residuals over the steps.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import zip_longest

import numpy as np

from table_io.block import Float1D, Int1D
from twin.discovery.candidates import Candidate
from twin.discovery.evidence import Hypothesis, LinearEvidence, build_evidence, softmax
from twin.discovery.least_squares import FitResult, MapFunction, fit_with_misfit
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import MAX_LEVEL, LogResiduals, measure_level
from twin.discovery.units import assign_folds

MAX_EFFECTS = 3
MAX_ROUNDS = 3  # of rankings, each about the best fit of the one before
REFIT_NATS, MAX_REFITS = 5.0, 4  # below the best log evidence; sets refitted in a round
MIN_PROBABILITY = 1e-3  # of an explanation that is reported
MIN_VISIBLE_EXCESS = 0.05  # of the floor: excess below which there is no gap
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

    def find_shape(self, effect: Candidate) -> tuple[float, ...]:
        """Return the fitted shape of one of the effects, in the order of its trial shapes."""
        values = self.fit.parameters.values
        return tuple(values[free.key] for free in effect.free if free is not effect.amplitude)

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

    def fit_effects(self, start: ParameterSet, effects: Sequence[Candidate]) -> FittedSet:
        """Fit `start`, with these effects added, to all data, with cross-validation residuals."""
        result = fit_with_misfit(self.log_residuals, start, self.folds, self.mapper)
        return FittedSet(tuple(effects), result)

    @property
    def noise(self) -> float:
        """Mean square of the noise of sensors alone, of the log that shows it best."""
        return max(residuals.sensor_square for residuals in self.log_residuals)

    @property
    def expected_square(self) -> float:
        """Mean square of the entries where the model is right: noise, and unknown errors."""
        return float(np.concatenate([r.expected_entries for r in self.log_residuals]).mean())

    @cached_property
    def folds(self) -> tuple[Int1D, ...]:
        """Cross-validation fold of each entry, (entry,) per log."""
        return tuple(assign_folds(residuals) for residuals in self.log_residuals)

    def measure_misfit(self, fitted: FittedSet) -> float:
        """Return the rms over the noise of the sensors of the cross-validation residual."""
        return self._measure_rms(fitted.held_out)

    def measure_fitted_misfit(self, fit: FitResult) -> float:
        """Return the same of the data that were fitted."""
        return self._measure_rms([each.evaluate(fit.parameters) for each in self.log_residuals])

    def find_noise_floor(self, fitted: FittedSet) -> float:
        """Return the misfit that noise alone leaves, below 1 where a set shows that it is less."""
        return min(1.0, self.measure_misfit(fitted))

    def _measure_rms(self, entries: Sequence[Float1D]) -> float:
        """Return the rms over the noise of the sensors of residuals in motion, (entry,) each."""
        squares, count = 0.0, 0
        for values, residuals in zip(entries, self.log_residuals, strict=True):
            moving = residuals.entry_row < len(residuals.rows)
            r = (values * residuals.entry_weight)[moving]
            squares, count = squares + float(r @ r), count + r.size
        return math.sqrt(squares / max(count, 1))

    def measure_level(self, fitted: FittedSet) -> float:
        """Return the level of the forces left; 1 if they are noise and unknown errors."""
        return measure_level(self.log_residuals, fitted.held_out, forces_only=True)

    def measure_noise(self, fitted: FittedSet) -> float:
        """Return the level of forces that the noise of the readings leaves of a model.

        It is that of the model itself: where a law is steep, as friction at the reversal of a
        motion, the noise of the motion is louder than in any other model.
        """
        parameters = fitted.fit.parameters
        noise = [
            each.noise_copy.evaluate(parameters) - each.evaluate(parameters)
            for each in self.log_residuals
        ]
        return measure_level(self.log_residuals, noise, forces_only=True)

    def leaves_noise(self, fitted: FittedSet) -> bool:
        """Return True if what a set leaves of the forces is noise, its own included."""
        return self.measure_level(fitted) <= MAX_LEVEL * max(1.0, self.measure_noise(fitted))

    def is_explained_by(self, fit: FitResult) -> bool:
        """Return True if a fit leaves no more than noise of the forces, on the data fitted."""
        entries = [each.evaluate(fit.parameters) for each in self.log_residuals]
        return measure_level(self.log_residuals, entries, forces_only=True) <= MAX_LEVEL

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

    def select_simplest(self, fitted_sets: Sequence[FittedSet]) -> FittedSet:
        """Return the set with the fewest parameters than which the best is not worth more."""
        best = min(fitted_sets, key=lambda fitted: fitted.cost)
        as_good = [
            each for each in fitted_sets if each is best or not self.is_worthwhile(each, best)
        ]

        def complexity(fitted: FittedSet) -> tuple[int, float]:
            return sum(len(effect.free) for effect in fitted.effects), fitted.cost

        return min(as_good, key=complexity)


@dataclass(frozen=True, slots=True)
class Explanation:
    """Names of effects, the place of a stranger beside them or "", and their probability."""

    names: tuple[str, ...]
    place: str
    probability: float


@dataclass(frozen=True, eq=False)
class SelectionResult:
    """Outcome of a selection: the null (base alone), the best set, and every set refitted.

    `explanations` are the most probable first. `evidence` is the linear model about the best set.
    """

    null: FittedSet
    best: FittedSet
    tried: tuple[FittedSet, ...] = field(default=())
    complete: bool = True  # False after a cancellation
    explanations: tuple[Explanation, ...] = ()
    evidence: LinearEvidence | None = None


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


def select_effects(
    problem: SelectionProblem,
    start: ParameterSet,
    report: ProgressCallback = lambda progress: None,
    first: FittedSet | None = None,
    rounds: Sequence[RoundEffort] = (RoundEffort(),) * MAX_ROUNDS,
) -> SelectionResult:
    """Select the most probable set of effects; see `evidence`.

    The linear model about a fit ranks all sets; the best are refitted, and ranked again about the
    best of them, until no other set is more probable and no larger one is to be tried, or all
    `rounds` are over. `first` is a set to begin with, fitted to another problem.
    """
    null = problem.fit_effects(start, ())
    state, refitted = SelectionResult(null, null), {frozenset[str](): null}
    if first is not None:
        state = replace(state, best=problem.fit_effects(first.add_to(start), first.effects))
        refitted[frozenset(first.names)] = state.best
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
    problem: SelectionProblem,
    state: SelectionResult,
    refitted: dict[frozenset[str], FittedSet],
    report: ProgressCallback,
    effort: RoundEffort,
) -> SelectionResult:
    """Rank all sets about the base of the best fit so far, and refit the most probable ones."""
    current = state.best
    base = current.remove_from(current.fit.parameters)
    known_shapes = {
        effect.name: fitted.find_shape(effect)
        for fitted in (*refitted.values(), current)
        for effect in fitted.effects
    }
    report(SelectionProgress("all effects", best=current))
    rich = tuple((effect.name, known_shapes[effect.name]) for effect in current.effects)
    linear = build_evidence(
        problem.log_residuals, base, problem.library, known_shapes, rich, problem.mapper
    )
    promised, share = linear.rank_states(effort.max_effects), effort.share
    for index in range(1, effort.max_refits + 1):
        states = _correct_by_refits(linear, promised, refitted, state.null)
        each = _find_open(linear, states, refitted, share)
        if each is None:
            break
        variants = [linear.variants[c] for c in each.columns]
        names = tuple(variant.candidate.name for variant in variants)
        report(SelectionProgress(effort.stage, names, index, effort.max_refits, current))
        parameters = base
        for variant, amplitude in zip(variants, linear.estimate(each.columns)[0], strict=True):
            parameters = variant.add_to(parameters, float(amplitude))
        effects = tuple(variant.candidate for variant in variants)
        refitted[frozenset(names)] = fitted = problem.fit_effects(parameters, effects)
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
    linear: LinearEvidence,
    states: Sequence[Hypothesis],
    refitted: Mapping[frozenset[str], FittedSet],
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
    linear: LinearEvidence,
    states: Sequence[Hypothesis],
    refitted: Mapping[frozenset[str], FittedSet],
    null: FittedSet,
) -> list[Hypothesis]:
    """Return the states, the most probable first, less what a refit has not kept of its promise.

    What the linear model promises of a set, its refit may not find: an effect vanishes, or removes
    less. The set then counts by what was found, and so does each larger one that was not refitted.
    """
    count = sum(values.size for values in null.held_out)
    lost: dict[frozenset[str], float] = {}
    for state in states:
        names = linear.names(state)
        if state.columns and names in refitted and names not in lost:
            promised = linear.measure_gain(state.columns)
            kept = (null.fit.cost - refitted[names].fit.cost) * count / linear.inflation
            lost[names] = 0.5 * promised * min(max(1.0 - kept / max(promised, 1e-300), 0.0), 1.0)

    def correct(state: Hypothesis) -> Hypothesis:
        names = linear.names(state)
        own = lost.get(names)
        if own is None:
            own = max((loss for smaller, loss in lost.items() if smaller <= names), default=0.0)
        return replace(state, log_evidence=state.log_evidence - own)

    return sorted(map(correct, states), key=lambda state: -state.log_evidence)
