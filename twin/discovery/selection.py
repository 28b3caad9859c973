"""Selection problem of a specimen: residuals of its logs, and sets of effects fitted to them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Int1D
from twin.discovery.candidates import Candidate
from twin.discovery.evidence import build_evidence
from twin.discovery.least_squares import FitResult, MapFunction, fit_with_misfit
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import LogResiduals, measure_level
from twin.discovery.units import assign_folds
from twin.evidence import selection
from twin.evidence.linear import LinearEvidence, Variant
from twin.evidence.selection import MAX_ROUNDS, RoundEffort, search_sets
from twin.evidence.verdict import MAX_LEVEL

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

    @property
    def squares(self) -> float:
        """Sum of the squares of the residual over the noise of the data that were fitted."""
        return self.fit.cost * sum(values.size for values in self.held_out)

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

    def linearize(
        self, current: FittedSet, tried: Sequence[FittedSet]
    ) -> LinearEvidence[Candidate]:
        """Return the linear model about a set without its effects, with the shapes tried."""
        known_shapes = {
            effect.name: fitted.find_shape(effect) for fitted in tried for effect in fitted.effects
        }
        rich = tuple((effect.name, known_shapes[effect.name]) for effect in current.effects)
        base = current.remove_from(current.fit.parameters)
        return build_evidence(
            self.log_residuals, base, self.library, known_shapes, rich, self.mapper
        )

    def refit(
        self, current: FittedSet, chosen: Sequence[tuple[Variant[Candidate], float]]
    ) -> FittedSet:
        """Return a fit with variants in place of a set's effects, from these amplitudes."""
        parameters = current.remove_from(current.fit.parameters)
        for variant, amplitude in chosen:
            parameters = variant.candidate.start_in(parameters, variant.shape, amplitude)
        return self.fit_effects(parameters, [variant.candidate for variant, _ in chosen])

    @property
    def limits(self) -> dict[str, tuple[str, ...]]:
        """Names of the effects of which each candidate has others as limits, by its name."""
        return {each.name: tuple(each.effect.limits) for each in self.library}

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


SelectionProgress = selection.SelectionProgress[FittedSet]
SelectionResult = selection.Selection[FittedSet, Candidate]
ProgressCallback = Callable[[SelectionProgress], None]


def select_effects(
    problem: SelectionProblem,
    start: ParameterSet,
    report: ProgressCallback = lambda progress: None,
    first: FittedSet | None = None,
    rounds: Sequence[RoundEffort] = (RoundEffort(),) * MAX_ROUNDS,
) -> SelectionResult:
    """Select the most probable set of effects; see `selection.search_sets`.

    `first` is a set to begin with, fitted to another problem.
    """
    null = problem.fit_effects(start, ())
    if first is not None:
        first = problem.fit_effects(first.add_to(start), first.effects)
    return search_sets(problem, null, report, first, rounds)
