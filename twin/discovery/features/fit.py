"""Fit of a base model with effects to features, in stages of rising cost.

1. A ladder of trial amplitudes and shapes of the effects, by describing functions.
2. Least squares from the best of them; a feature out of reach loses its pull (Cauchy loss).
3. Continuation at the result; its difference from the describing functions is added to them and
   the fit repeated. The same difference at the model without the effects is there from the
   beginning. The best model of all rounds and starts, judged by continuation, stays.

Models in closed form are then fitted by continuation itself, from there. Parameters of the base
have a prior: their range in the features file is 95 % of it, and a bound.
"""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.optimize import least_squares

from table_io.block import Float1D, Float2D
from table_io.errors import InputError
from twin.discovery.features.config import FeatureSet
from twin.discovery.features.continued_curve import compute_curve
from twin.discovery.features.curve import ResponseCurve
from twin.discovery.features.prediction import (
    Measurement,
    PredictedFeature,
    Quantities,
    approximate_quantities,
    compute_residuals,
    continue_features,
    judge_feature,
    predict_features,
)
from twin.discovery.motion import RecordScale
from twin.discovery.parameters import (
    BASE_PARAMETERS,
    FreeParameter,
    ParameterKey,
    ParameterSet,
    list_effect_parameters,
)
from twin.dynamics.period_map import set_total_gap
from twin.laws.library import find_effect
from twin.model.model import Model

# Trial values of a fit. Amplitudes are multiples of the size at which an effect is as large as the
# largest motion itself, shapes are spread over their bounds.
TRIAL_SHARES = (3e-3, 1e-2, 3e-2, 0.1, 0.3, 1.0)
TRIAL_SHAPES = 7
MAX_EVALUATIONS = 14  # of least squares, each with its derivatives
POLISHING_EVALUATIONS = 6  # the same by continuation, which is ten times slower
CORRECTION_ROUNDS = 2  # of each start
DERIVATIVE_STEP = 3e-3  # of a parameter's unit: its logarithm, or its trial amplitude
MIN_FACTOR_STEP = 1e-3  # of a bound: a start lies this far inside
# They bound relaxation times, as the samples and the length of a recording do: from a tenth of a
# radian of the highest resonance, below which a branch is a dashpot, to ten of the longest periods.
RADIANS_PER_SAMPLE, PERIODS = 5.0, 10
PRIOR_SIGMAS = 4.0  # width of a range in standard deviations of the prior

QuantitiesOf = Callable[[Model], list[Quantities]]


@dataclass(frozen=True, eq=False)
class FeatureProblem:
    """Features to explain, and the model to begin with; its mass is that of the features."""

    features: FeatureSet
    model: Model
    scale: RecordScale

    @classmethod
    def create(cls, features: FeatureSet, model: Model) -> "FeatureProblem":
        """Return the problem; InputError if the model has no resonance to begin with."""
        level = features.test.acceleration_m_s2
        curves = [
            curve
            for gap in features.gaps_mm
            if (curve := compute_curve(set_total_gap(model, gap / 1e3), features.test)) is not None
        ]
        peaks = [peak for curve in curves if math.isfinite((peak := curve.find_peak())[0])]
        if not peaks:
            raise InputError(
                "no resonance of the model at any gap of the features",
                key="test",
                remedy="check specimen, acceleration_g and the frequency range",
            )
        u = max(amplitude for _, amplitude in peaks)
        w, w_max = (2 * math.pi * edge(hz for hz, _ in peaks) for edge in (min, max))
        depths = [curve.largest_excess_m for curve in curves]
        depth = max([d for d in depths if math.isfinite(d) and d > 0], default=u)
        acc = max(level + (2 * math.pi * hz) ** 2 * amplitude for hz, amplitude in peaks)
        test = features.test
        scale = RecordScale(
            u, u * w, acc, depth, features.specimen.mass_kg * acc,
            level / (2 * math.pi * test.start_hz) ** 2,
            RADIANS_PER_SAMPLE / w_max, PERIODS / test.start_hz, {},
        )  # fmt: skip
        return cls(features, model, scale)

    def list_base_factors(self) -> tuple[FreeParameter, ...]:
        """Return the base's parameters with their ranges, fitted as logarithms."""
        free = []
        values = ParameterSet.from_model(self.model, 0).values
        for key, unit, tied in BASE_PARAMETERS:
            low, high = getattr(self.features.refit, key.name)
            value = values[(tied or (key,))[0]]
            if value > 0:
                free.append(
                    FreeParameter(key, low * value, high * value, 1.0, unit, True, tied=tied)
                )
        return tuple(free)


@dataclass(frozen=True, eq=False)
class FeatureFit:
    """A fitted model with its added effects, and what it predicts for each feature."""

    names: tuple[str, ...]  # of the added effects
    parameters: ParameterSet
    predicted: tuple[PredictedFeature, ...]
    curves: dict[float, ResponseCurve | None]  # by total gap in mm
    rounds: int  # of correction by continuation; 0: fitted by continuation itself at last, or not
    intervals: dict[ParameterKey, tuple[float, float]]  # 95 %, of the free parameters

    @property
    def model(self) -> Model:
        return self.parameters.to_model()

    @property
    def score(self) -> int:
        """Number of features that the model explains."""
        return sum(feature.is_explained for feature in self.predicted)

    @property
    def misfit(self) -> float:
        """Sum of log(1 + squared distance) over the features: how far off they are, robustly."""
        return float(sum(math.log1p(min(f.distance, 1e3) ** 2) for f in self.predicted))

    @property
    def rank_key(self) -> tuple[int, float]:
        return -self.score, self.misfit


def judge_model(problem: FeatureProblem, parameters: ParameterSet) -> FeatureFit:
    """Return the fit of a model as it is, without any effect added."""
    measurement = continue_features(problem.features, parameters.to_model())
    return _complete_fit(problem, (), parameters, measurement, 0, {})


def _complete_fit(
    problem: FeatureProblem,
    names: tuple[str, ...],
    parameters: ParameterSet,
    measurement: Measurement,
    rounds: int,
    intervals: dict[ParameterKey, tuple[float, float]],
) -> FeatureFit:
    predicted = predict_features(problem.features, parameters.to_model(), measurement)
    return FeatureFit(names, parameters, predicted, measurement.curves, rounds, intervals)


@dataclass(frozen=True, eq=False)
class TrialGroup:
    """Trial values of a fit, and the fit with fewer effects from which they start."""

    reference: FeatureFit
    trials: Sequence[ParameterSet]


def fit_base(
    problem: FeatureProblem, given: FeatureFit, winners: Sequence[FeatureFit] = ()
) -> FeatureFit:
    """Return the refitted base: K, C, K_j and C_j only.

    From the base as given, from others within its range, and from the bases of the winners of a
    search: where the base has not converged, every effect seems to gain.
    """
    free = problem.list_base_factors()
    start = given.parameters.with_free(free)
    starts = [start]
    for fit in winners:
        values = {key: fit.parameters.values[key] for p in free for key in p.keys}
        starts.append(start.with_values(values))
    if not winners:
        centre = start.to_vector()
        for end in ("low", "high"):
            # Halfway to one end of every range, in logarithms; the damper's and the bumpers' apart.
            for is_bumper in (False, True):
                limits = [p.to_internal(getattr(p, end)) for p in free]
                moves = [str(p.key).startswith("bumper") == is_bumper for p in free]
                halfway = np.where(moves, (centre + np.array(limits)) / 2, centre)
                starts.append(start.with_vector(halfway))
    return fit_effects(problem, (), [TrialGroup(given, [each]) for each in starts])


def extend_fit(fit: FeatureFit, other: FeatureFit) -> FeatureFit:
    """Return a fit with the further effects of another one at their vanishing values."""
    return _add_vanishing(fit, other.names, other.parameters)


def list_trials(problem: FeatureProblem, effect_id: str, start: ParameterSet) -> list[ParameterSet]:
    """Return trial values of an effect added to a parameter set, all free."""
    effect = find_effect(effect_id)
    free = list_effect_parameters(effect, problem.scale)
    ladders = [_list_trial_values(parameter) for parameter in free]
    with_free = start.with_free((*start.free, *free))
    return [
        with_free.with_values(dict(zip((p.key for p in free), values, strict=True)))
        for values in itertools.product(*ladders)
    ]


def _list_trial_values(free: FreeParameter) -> list[float]:
    if free.vanishing is None:
        inside = np.linspace(free.to_internal(free.low), free.to_internal(free.high), TRIAL_SHAPES)
        return [free.to_external(float(x)) for x in inside[1:-1]]
    signs = (1, -1) if free.low < free.vanishing else (1,)
    values = [
        free.vanishing + sign * share * free.scale for share in TRIAL_SHARES for sign in signs
    ]
    return [value for value in values if free.low <= value <= free.high]


def fit_effects(
    problem: FeatureProblem, names: tuple[str, ...], groups: Sequence[TrialGroup]
) -> FeatureFit:
    """Return the best fit from trial values of the same free parameters, in groups by their start.

    No fit is worse than the references with fewer effects: at worst the further ones vanish.
    """
    features = problem.features
    approximate = partial(approximate_quantities, features)
    fits: list[_JudgedFit] = []
    for group in groups:
        reference = group.reference
        exact = [feature.quantities for feature in reference.predicted]
        best: ParameterSet | None = None
        for _ in range(CORRECTION_ROUNDS):
            near = approximate((best or reference.parameters).to_model())
            objective = _Objective(problem, _correct(approximate, near, exact))
            best = objective.minimize(best or min(group.trials, key=objective.measure_cost))
            fits.append(_judge_fit(problem, objective, best))
            exact = fits[-1].measurement.quantities
    result = min(fits, key=lambda fit: fit.rank_key)
    is_exact = result.parameters.to_model().changes_only_parameters
    if is_exact:
        objective = _Objective(problem, partial(_continue_quantities, features))
        polished_at = objective.minimize(result.parameters, POLISHING_EVALUATIONS)
        polished = _judge_fit(problem, objective, polished_at)
        # its own objective, whose derivatives the intervals need
        result = min(polished, replace(result, objective=objective), key=lambda fit: fit.rank_key)
    parameters, measurement, objective = result.parameters, result.measurement, result.objective
    intervals = objective.estimate_intervals(parameters)
    rounds = 0 if is_exact else CORRECTION_ROUNDS
    fit = _complete_fit(problem, names, parameters, measurement, rounds, intervals)
    extended = [_add_vanishing(group.reference, names, group.trials[0]) for group in groups]
    return min([fit, *extended], key=lambda each: each.rank_key)


@dataclass(frozen=True, eq=False)
class _JudgedFit:
    """Parameters at the end of a minimization, judged by continuation."""

    parameters: ParameterSet
    measurement: Measurement
    objective: "_Objective"  # that was minimized
    rank_key: tuple[int, float]  # the smaller, the better


def _judge_fit(
    problem: FeatureProblem, objective: "_Objective", parameters: ParameterSet
) -> _JudgedFit:
    measurement = continue_features(problem.features, parameters.to_model())
    judged = _Objective(problem, partial(_repeat_quantities, measurement.quantities))
    rank_key = -judged.count_explained(parameters), judged.measure_cost(parameters)
    return _JudgedFit(parameters, measurement, objective, rank_key)


def _continue_quantities(features: FeatureSet, model: Model) -> list[Quantities]:
    return continue_features(features, model).quantities


def _add_vanishing(fit: FeatureFit, names: tuple[str, ...], trial: ParameterSet) -> FeatureFit:
    """Return a fit with further effects at their vanishing values; shapes are those of a trial."""
    values = {
        key: trial.values[key] if free.vanishing is None else free.vanishing
        for free in trial.free
        for key in free.keys
        if key not in fit.parameters.values
    }
    parameters = fit.parameters.with_values(values).with_free(trial.free)
    return replace(fit, names=names, parameters=parameters)


def _repeat_quantities(quantities: list[Quantities], _: Model) -> list[Quantities]:
    return quantities


def _correct(
    approximate: QuantitiesOf, near: Sequence[Quantities], exact: Sequence[Quantities]
) -> QuantitiesOf:
    """Return the approximation plus its error at one model; where it has no value, the exact."""

    def correct_quantities(model: Model) -> list[Quantities]:
        return [
            tuple(
                e + (value - n) if math.isfinite(e + value - n) else e
                for value, n, e in zip(own, at, true, strict=True)
            )
            if len(own) == len(at) == len(true)
            else true
            for own, at, true in zip(approximate(model), near, exact, strict=True)
        ]

    return correct_quantities


class _Objective:
    """Residuals of the features and of the prior, by the internal values of the free parameters."""

    def __init__(self, problem: FeatureProblem, quantities_of: QuantitiesOf) -> None:
        self._problem, self._quantities_of = problem, quantities_of
        self._last: tuple[ParameterSet, bytes, Float1D] | None = None
        values = ParameterSet.from_model(problem.model, 0).values
        self._priors = {  # (mean, standard deviation) of the logarithm
            free.key: (
                math.log(values[free.keys[0]]), math.log(free.high / free.low) / PRIOR_SIGMAS
            )
            for free in problem.list_base_factors()
        }  # fmt: skip

    def compute(self, parameters: ParameterSet) -> Float1D:
        """Return the residuals, those of a feature times the root of its weight, (n,)."""
        features = self._problem.features
        residuals: list[float] = []
        quantities = self._quantities_of(parameters.to_model())
        for feature, own in zip(features.features, quantities, strict=True):
            if feature.kind == "impacts":
                continue
            weight = math.sqrt(feature.weight)
            residuals += [
                weight * r for r in compute_residuals(feature, own, features.test.step_hz)
            ]
        for free in parameters.free:
            if free.key in self._priors:
                mean, sigma = self._priors[free.key]
                residuals.append((math.log(parameters.values[free.keys[0]]) - mean) / sigma)
        return np.array(residuals)

    def count_explained(self, parameters: ParameterSet) -> int:
        """Return how many features other than impacts are explained."""
        features = self._problem.features
        quantities = self._quantities_of(parameters.to_model())
        return sum(
            judge_feature(feature, own, features.test.step_hz, "").is_explained
            for feature, own in zip(features.features, quantities, strict=True)
            if feature.kind != "impacts"
        )

    def measure_cost(self, parameters: ParameterSet) -> float:
        """Return the sum of log(1 + squared residual)."""
        return float(np.log1p(self.compute(parameters) ** 2).sum())

    def minimize(self, start: ParameterSet, max_evaluations: int = MAX_EVALUATIONS) -> ParameterSet:
        """Return the parameters of least Cauchy loss within their bounds."""
        units, low, high = _scale_bounds(start)
        margin = MIN_FACTOR_STEP * np.minimum(1.0, high - low)
        result = least_squares(
            lambda x: self._compute_once(start, x, units),
            np.clip(start.to_vector() / units, low + margin, high - margin),
            lambda x: self._differentiate(start, x, units, high),
            (low, high), loss="cauchy", max_nfev=max_evaluations,
        )  # fmt: skip
        return start.with_vector(np.asarray(result.x) * units)

    def _compute_once(self, start: ParameterSet, x: Float1D, units: Float1D) -> Float1D:
        """Return the residuals, which least squares and its derivatives want of the same x."""
        values = x.tobytes()
        if self._last is None or self._last[0] is not start or self._last[1] != values:
            self._last = start, values, self.compute(start.with_vector(x * units))
        return self._last[2]

    def _differentiate(
        self, start: ParameterSet, x: Float1D, units: Float1D, high: Float1D
    ) -> Float2D:
        """Return the derivatives of the residuals by x, (residual, free)."""
        centre, columns = self._compute_once(start, x, units), []
        for j in range(x.size):
            moved = x.copy()
            step = DERIVATIVE_STEP if x[j] + DERIVATIVE_STEP <= high[j] else -DERIVATIVE_STEP
            moved[j] += step
            columns.append((self.compute(start.with_vector(moved * units)) - centre) / step)
        return np.array(columns).T

    def estimate_intervals(self, at: ParameterSet) -> dict[ParameterKey, tuple[float, float]]:
        """Return 95 % intervals by linearization, a tolerance read as two standard deviations.

        Without those that the features do not bound within the parameter's range.
        """
        units, low, high = _scale_bounds(at)
        x = at.to_vector() / units
        jacobian = self._differentiate(at, x, units, high)
        variances = np.diag(np.linalg.pinv(jacobian.T @ jacobian, hermitian=True))
        intervals: dict[ParameterKey, tuple[float, float]] = {}
        for free, value, variance, unit, least, most, column in zip(
            at.free, x, variances, units, low, high, jacobian.T, strict=True
        ):
            half = math.sqrt(max(float(variance), 0.0))
            if np.any(column != 0) and least <= value - half and value + half <= most:
                ends = float((value - half) * unit), float((value + half) * unit)
                intervals[free.key] = free.to_external(ends[0]), free.to_external(ends[1])
        return intervals


def _scale_bounds(start: ParameterSet) -> tuple[Float1D, Float1D, Float1D]:
    """Return (units, lower, upper bounds in units) of the internal values, (free,)."""
    free = start.free
    units = np.array([1.0 if p.logarithmic else _amplitude_unit(p, start) for p in free])
    low = np.array([p.to_internal(p.low) for p in free]) / units
    high = np.array([p.to_internal(p.high) for p in free]) / units
    return units, low, high


def _amplitude_unit(free: FreeParameter, start: ParameterSet) -> float:
    """Return the distance of an amplitude from its vanishing value, or its scale there."""
    return abs(start.values[free.key] - (free.vanishing or 0.0)) or free.scale
