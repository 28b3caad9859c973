"""Levenberg-Marquardt fit to several logs, with standard errors robust to colored residuals."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol, TypeVar

import numpy as np
from scipy.special import stdtrit

from table_io.block import Bool1D, Bool2D, Float1D, Float2D, Int1D
from twin.discovery.learned_noise import weigh_misfit
from twin.discovery.parameters import (
    FreeParameter,
    NuisanceKey,
    ParameterKey,
    ParameterSet,
    get_log,
)
from twin.discovery.residuals import LogResiduals

MAX_ITERATIONS = 40
MIN_INTERVAL_BLOCKS = 3.0  # effective blocks (cycles, contacts) below which there is no interval
MIN_COST_GAIN = 1e-6  # relative cost decrease below which the iteration stops
SLOPE_STEP = 1e-4  # finite-difference step, relative to the scale of a parameter
HELD_OUT_DAMPINGS = (1e-9, 1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4)  # tried for the step of a fold's refit
MIN_SCATTER_BLOCKS = 10.0  # with fewer, their scatter alone may be too small by chance
COLOUR_FACTOR = 1.5  # of the error within a contact: noise of the fused motion is not white there
MAX_DEPARTURE_SHARE = 0.1  # of the squares of a step: with more the model is not linear there
MAX_NOISE_SHARE = 0.9  # of the information on a parameter that is noise of the readings
# of a parameter's curvature: with less in the training folds, they do not determine it
MIN_CURVATURE_SHARE = 1e-3
MIN_INFORMATION = 1e-9  # of that on the best combination of parameters: less is rounding

Argument = TypeVar("Argument")
Result = TypeVar("Result")


class MapFunction(Protocol):
    """Same interface as `map`; a caller may supply a parallel one."""

    def __call__(
        self, function: Callable[[Argument], Result], values: Iterable[Argument], /
    ) -> Iterable[Result]: ...


@dataclass(frozen=True, eq=False)
class FitResult:
    """Fitted parameters with standard errors, correlation and held-out residuals."""

    parameters: ParameterSet
    values: Mapping[ParameterKey, float]  # of the free parameters
    std_errors: Mapping[ParameterKey, float]  # standard deviations, robust to colored residuals
    correlation: Float2D
    cost: float  # mean square of the residual over its noise, on the training samples
    converged: bool
    at_bound: tuple[ParameterKey, ...]
    held_out: tuple[Float1D, ...] = ()  # per log, cross-validation residual, (entry,)
    # blocks (cycles, contacts) that determine each parameter; inf where readings at rest do
    block_counts: Mapping[ParameterKey, float] = field(default_factory=dict)
    # standard deviations if the residual were white noise, of 1 over the assumed one
    white_errors: Mapping[ParameterKey, float] = field(default_factory=dict)

    @property
    def free(self) -> tuple[FreeParameter, ...]:
        """The fitted parameters, in the order of the correlation."""
        return self.parameters.free

    def interval_error(self, key: ParameterKey) -> float:
        """Return the standard error of a parameter; inf if too few blocks determine it.

        The scatter between so few cycles says nothing about their mean.
        """
        is_known = self.block_counts.get(key, math.inf) >= MIN_INTERVAL_BLOCKS
        return self.std_errors[key] if is_known else math.inf


def fit_parameters(
    log_residuals: Sequence[LogResiduals],
    start: ParameterSet,
    train: Sequence[Bool2D] | None = None,
    folds: Sequence[Int1D] = (),
    mapper: MapFunction = map,
    without_noise: bool = False,
) -> FitResult:
    """Fit the free parameters of `start` by least squares.

    Use the entries where `train`, (entry,), is True; all without it. `without_noise` corrects for
    the errors of the readings in the slopes, which make a parameter too small: their products, as
    a copy with more noise shows them, are taken off the normal equations (bias-compensated least
    squares; Soderstrom, Errors-in-variables methods in system identification, 2018).

    With `folds`, (entry,) per log, also compute the cross-validation residual: that of each fold
    after refitting to the others, by one step from the full fit. Folds below zero are never held
    out.
    """
    return _LevenbergMarquardt(log_residuals, start, train, folds, mapper).run(without_noise)


def fit_with_misfit(
    log_residuals: Sequence[LogResiduals],
    start: ParameterSet,
    folds: Sequence[Int1D] = (),
    mapper: MapFunction = map,
) -> FitResult:
    """Fit without noise; what the model leaves beyond noise counts as noise too.

    Else nuisances would run as far as lowers it, whatever their priors. Where they do not explain
    all of it, it is measured while they stay where they were, and again after they have explained
    of that what they can as if it were noise. The cost and the cross-validation residual of the
    result are over the noise alone nevertheless.
    """
    parameters = fit_parameters(log_residuals, start, mapper=mapper).parameters
    weighted = _weigh_all(log_residuals, parameters)
    if any(
        (new.entry_weight > old.entry_weight).any()
        for new, old in zip(weighted, log_residuals, strict=True)
    ):
        specimen = [free for free in start.free if not isinstance(free.key, NuisanceKey)]
        held = fit_parameters(log_residuals, start.with_free(specimen), mapper=mapper).parameters
        parameters = fit_parameters(
            _weigh_all(log_residuals, held), held.with_free(start.free), mapper=mapper
        ).parameters
        weighted = _weigh_all(log_residuals, parameters)
    ratios = [
        new.entry_weight / old.entry_weight
        for new, old in zip(weighted, log_residuals, strict=True)
    ]
    fit = fit_parameters(weighted, parameters, folds=folds, mapper=mapper, without_noise=True)
    entries = [residuals.evaluate(fit.parameters) for residuals in log_residuals]
    held_out = tuple(
        np.where(residuals.entry_row < len(residuals.rows), ratio, 1.0) * values
        for values, residuals, ratio in zip(fit.held_out, log_residuals, ratios, strict=False)
    )
    white = min(float(ratio.min()) for ratio in ratios)
    return replace(
        fit,
        cost=sum(float(values @ values) for values in entries) / sum(map(len, entries)),
        held_out=held_out,
        white_errors={key: error / white for key, error in fit.white_errors.items()},
    )


def _weigh_all(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet
) -> list[LogResiduals]:
    return [weigh_misfit(residuals, parameters) for residuals in log_residuals]


def compute_slopes(
    log_residuals: Sequence[LogResiduals],
    parameters: ParameterSet,
    free: FreeParameter,
    before: Sequence[Float1D],
    probe: float = 0.0,
) -> list[Float1D]:
    """Return d residual / d parameter (internal value) by finite difference, (entry,) per log.

    Over a change of `probe`, if given, else over one that is small.
    """
    if isinstance(free.key, NuisanceKey):
        return [residuals.nuisance_slope(free.key) for residuals in log_residuals]
    x = free.to_internal(parameters.values[free.keys[0]])
    step = probe or SLOPE_STEP * (1.0 if free.logarithmic else free.scale)
    if (math.exp(x + step) if free.logarithmic else x + step) > free.high:
        step = -step
    moved = parameters.with_values(dict.fromkeys(free.keys, free.to_external(x + step)))
    log_number = get_log(free.key)
    slopes = []
    for residuals, old in zip(log_residuals, before, strict=True):
        if log_number in (None, residuals.log_number):
            slope = residuals.evaluate(moved)
            slope -= old
            slope /= step
        else:
            slope = np.zeros(old.size)  # a parameter of another log
        slopes.append(slope)
    return slopes


def fill_jacobian(
    log_residuals: Sequence[LogResiduals],
    parameters: ParameterSet,
    before: Sequence[Float1D],
    train: Sequence[Bool2D] | None,
    mapper: MapFunction,
    jacobian: Float2D,
) -> None:
    """Fill `jacobian`, (free, entry), with the slopes of the free parameters.

    It has the training entries alone, and is filled again in each iteration: it is large.
    """
    columns = mapper(
        lambda free: compute_slopes(log_residuals, parameters, free, before), parameters.free
    )
    for row, slopes in zip(jacobian, columns, strict=True):
        row[:] = select_entries(slopes, train)
        # A law may overflow a step further than where it is: no step in this direction.
        row[~np.isfinite(row)] = 0.0


def select_entries(entries: Sequence[Float1D], train: Sequence[Bool2D] | None) -> Float1D:
    """Return the training entries of all logs, (entry,); all entries without `train`."""
    if train is not None:
        entries = [values[mask] for values, mask in zip(entries, train, strict=True)]
    return entries[0] if len(entries) == 1 else np.concatenate(entries)


@dataclass(frozen=True, eq=False)
class _NoiseProducts:
    """Products of the noise of readings in slopes, (free, free), and residual, (free,), about x."""

    x: Float1D
    of_slopes: Float2D
    with_residual: Float1D

    def measure_gradient(self, x: Float1D) -> Float1D:
        """Return half the slope at x of the residual squares that are noise, (free,)."""
        return self.with_residual + self.of_slopes @ (x - self.x)

    def take_off(self, information: Float2D, share: float = 1.0) -> Float2D:
        """Return information on the parameters, (free, free), without this share of the noise."""
        return information - _limit_noise(share * self.of_slopes, information)


class _LevenbergMarquardt:
    """One Levenberg-Marquardt fit; x are the internal values of the free parameters."""

    def __init__(
        self,
        log_residuals: Sequence[LogResiduals],
        start: ParameterSet,
        train: Sequence[Bool2D] | None,
        folds: Sequence[Int1D],
        mapper: MapFunction,
    ) -> None:
        self.log_residuals, self.start, self.free = log_residuals, start, start.free
        self.folds, self.mapper = folds, mapper
        self.train = train
        self.noise: _NoiseProducts | None = None
        self.count = sum(
            residuals.entry_row.size if train is None else int(train[log].sum())
            for log, residuals in enumerate(log_residuals)
        )
        low = [-math.inf if f.low == -math.inf else f.to_internal(f.low) for f in self.free]
        self.low = np.array(low)
        self.high = np.array(
            [math.inf if f.high == math.inf else f.to_internal(f.high) for f in self.free]
        )

    def evaluate(self, x: Float1D) -> list[Float1D]:
        parameters = self.start.with_vector(x)
        return [residuals.evaluate(parameters) for residuals in self.log_residuals]

    def fill_jacobian(self, jacobian: Float2D, x: Float1D, current: list[Float1D]) -> None:
        parameters = self.start.with_vector(x)
        fill_jacobian(self.log_residuals, parameters, current, self.train, self.mapper, jacobian)

    def take_step(self, x: Float1D, hessian: Float2D, gradient: Float1D, damping: float) -> Float1D:
        """Return x after a damped Gauss-Newton step; a parameter that would leave a bound stays."""
        outward = ((x <= self.low) & (gradient > 0)) | ((x >= self.high) & (gradient < 0))
        inside, step = np.flatnonzero(~outward), np.zeros_like(x)
        if inside.size:
            step[inside] = solve_damped(hessian[np.ix_(inside, inside)], damping, gradient[inside])
        return np.clip(x - step, self.low, self.high)

    def run(self, without_noise: bool) -> FitResult:
        x = np.clip(self.start.to_vector(), self.low, self.high)
        current = self.evaluate(x)
        r = select_entries(current, self.train)
        cost, damping, converged = float(r @ r), 1e-4, not self.free
        jacobian = np.empty((x.size, r.size))
        self.fill_jacobian(jacobian, x, current)
        for _ in range(0 if converged else MAX_ITERATIONS):
            hessian, gradient = jacobian @ jacobian.T, jacobian @ r
            gain = 0.0
            for _ in range(8):
                trial_x = self.take_step(x, hessian, gradient, damping)
                if np.array_equal(trial_x, x):
                    break
                trial_values = self.evaluate(trial_x)
                trial_chosen = select_entries(trial_values, self.train)
                trial_cost = float(trial_chosen @ trial_chosen)
                if trial_cost < cost:
                    gain = (cost - trial_cost) / max(cost, 1e-300)
                    x, current, r, cost = trial_x, trial_values, trial_chosen, trial_cost
                    damping = max(damping / 10, 1e-9)
                    break
                damping *= 10
            if gain < MIN_COST_GAIN:  # the slopes are those of the result, too
                converged = True
                break
            self.fill_jacobian(jacobian, x, current)
        if without_noise and x.size:
            x, current = self._take_off_noise(x, current, jacobian)
        return self._build_result(x, current, jacobian, converged)

    def _take_off_noise(
        self, x: Float1D, current: list[Float1D], jacobian: Float2D
    ) -> tuple[Float1D, list[Float1D]]:
        """Return (parameters, residuals) after the step that noise in the slopes has held back.

        It is a step of the linear model: shorter where the residuals do not follow that.
        """
        self.noise = noise = self._measure_noise(x, current, jacobian)
        r = select_entries(current, self.train)
        hessian = noise.take_off(jacobian @ jacobian.T)
        gradient = jacobian @ r - noise.with_residual
        for damping in HELD_OUT_DAMPINGS:
            trial_x = self.take_step(x, hessian, gradient, damping)
            trial = self.evaluate(trial_x)
            if _is_linear(r, (trial_x - x) @ jacobian, select_entries(trial, self.train)):
                self.fill_jacobian(jacobian, trial_x, trial)
                return trial_x, trial
        return x, current

    def _measure_noise(
        self, x: Float1D, current: Sequence[Float1D], jacobian: Float2D
    ) -> _NoiseProducts:
        """Return the products of the noise of the readings, from a copy that has it once more."""
        copies = [residuals.noise_copy for residuals in self.log_residuals]
        parameters = self.start.with_vector(x)
        noisy_values = [residuals.evaluate(parameters) for residuals in copies]
        slopes = np.empty_like(jacobian)
        fill_jacobian(copies, parameters, noisy_values, self.train, self.mapper, slopes)
        slopes -= jacobian
        r = select_entries(noisy_values, self.train) - select_entries(current, self.train)
        products = _limit_noise(slopes @ slopes.T, jacobian @ jacobian.T)
        return _NoiseProducts(x, products, slopes @ r)

    def _build_result(
        self, x: Float1D, current: list[Float1D], jacobian: Float2D, converged: bool
    ) -> FitResult:
        """Return the fit with standard errors from a sandwich estimator clustered by block."""
        parameters = self.start.with_vector(x)
        products = jacobian @ jacobian.T
        hessian = self.noise.take_off(products) if self.noise else products
        # parameters at a bound are fixed there
        inverse, is_open = _invert_information(hessian, (self.low < x) & (x < self.high))
        r = select_entries(current, self.train)
        cost = float(r @ r)
        first, count = 0, 0
        scatter, rest_scatter = np.zeros_like(inverse), np.zeros_like(inverse)
        information = []  # of each block, (free, block)
        for log, residuals in enumerate(self.log_residuals):
            blocks, at_rest = (
                residuals.entry_contact_block,
                residuals.entry_row == len(residuals.rows),
            )
            if self.train is not None:
                blocks, at_rest = blocks[self.train[log]], at_rest[self.train[log]]
            last = first + blocks.size
            moving = slice(first, last - np.count_nonzero(at_rest))  # the rest row is the last one
            blocks = blocks[~at_rest]
            block_gradients = np.array(
                [np.bincount(blocks, weights=row[moving] * r[moving]) for row in jacobian]
            )
            # A rest row has a single entry: its variance is that of the noise, of a prior 1.
            weight = residuals.entry_weight
            if self.train is not None:
                weight = weight[self.train[log]]
            rest_slopes = jacobian[:, moving.stop : last] / weight[moving.stop - first :]
            information.append(
                [np.bincount(blocks, row[moving] ** 2).astype(np.float64) for row in jacobian]
            )
            scatter += block_gradients @ block_gradients.T
            rest_scatter += rest_slopes @ rest_slopes.T
            first = last
            count += np.unique(blocks).size
        # small-sample correction: each fitted parameter costs one degree of freedom
        scatter *= count / max(count - len(self.free), 1)
        covariance = inverse @ (scatter + rest_scatter) @ inverse
        sd = np.where(is_open, math.inf, np.sqrt(np.maximum(np.diag(covariance), 0.0)))
        block_counts = _count_effective_blocks(information, np.diag(products))
        unit_sd = np.where(is_open, math.inf, np.sqrt(np.maximum(np.diag(inverse), 0.0)))
        white_sd = unit_sd * math.sqrt(max(cost / max(self.count, 1), 1.0))
        divisor = np.where(sd > 0, sd, 1.0)  # before they are widened, which correlates nothing
        sd = _widen_for_few_blocks(sd, white_sd, block_counts)
        values, std_errors, white_errors, at_bound = {}, {}, {}, []
        for i, free in enumerate(self.free):
            key = free.key
            values[key] = free.to_external(float(x[i]))
            slope = values[key] if free.logarithmic else 1.0
            std_errors[key] = float(sd[i] * slope)
            white_errors[key] = float(unit_sd[i] * slope)
            if x[i] in (self.low[i], self.high[i]):
                at_bound.append(key)
        correlation = covariance / np.outer(divisor, divisor)
        np.fill_diagonal(correlation, 1.0)
        return FitResult(
            parameters, values, std_errors, correlation, cost / max(self.count, 1),
            converged,
            tuple(at_bound), self._compute_held_out(x, current, jacobian),
            {free.key: float(n) for free, n in zip(self.free, block_counts, strict=True)},
            white_errors,
        )  # fmt: skip

    def _compute_held_out(
        self, x: Float1D, current: list[Float1D], jacobian: Float2D
    ) -> tuple[Float1D, ...]:
        """Return the cross-validation residual of each log, (entry,); empty without folds."""
        if not self.folds:
            return ()
        fold = np.concatenate(self.folds)
        held_out = [values.copy() for values in current]
        hessian = jacobian @ jacobian.T
        numbers = np.unique(fold[fold >= 0])
        fits = self.mapper(
            lambda k: self._refit_without(x, current, jacobian, hessian, fold != k), numbers
        )
        for k, refitted in zip(numbers, fits, strict=True):
            for target, source, log_fold in zip(held_out, refitted, self.folds, strict=True):
                target[log_fold == k] = source[log_fold == k]
        return tuple(held_out)

    def _refit_without(
        self,
        x: Float1D,
        current: list[Float1D],
        jacobian: Float2D,
        all_products: Float2D,
        training: Bool2D,
    ) -> list[Float1D]:
        """Return the residual of each log, (entry,), after one step towards the training-fold fit.

        The step is damped until the training cost does not increase. A parameter that the training
        folds do not determine keeps its value; an amplitude among them is set to its vanishing
        value, because otherwise the held-out fold would judge a value fitted to itself.
        """
        held_out = jacobian[:, ~training]  # the smaller part
        hessian = all_products - held_out @ held_out.T
        undetermined = np.diag(hessian) < MIN_CURVATURE_SHARE * np.diag(all_products)
        vanishing = np.array([math.nan if f.vanishing is None else f.vanishing for f in self.free])
        dropped = undetermined & np.isfinite(vanishing)
        if dropped.any():
            x = np.where(dropped, vanishing, x)
            current = self.evaluate(x)
        r = np.concatenate(current)
        gradient = jacobian @ np.where(training, r, 0.0)
        if self.noise:
            share = float(training.mean())
            gradient -= share * self.noise.measure_gradient(x)
            hessian = self.noise.take_off(hessian, share)
        cost = float(r[training] @ r[training])
        gradient[undetermined], hessian[undetermined], hessian[:, undetermined] = 0.0, 0.0, 0.0
        for damping in HELD_OUT_DAMPINGS:
            trial_x = self.take_step(x, hessian, gradient, damping)
            trial = self.evaluate(trial_x)
            trial_r = np.concatenate(trial)[training]
            moved = ((trial_x - x) @ jacobian)[training]
            is_fit = float(trial_r @ trial_r) <= cost
            if is_fit or (self.noise and _is_linear(r[training], moved, trial_r)):
                return trial
        return current  # no step improves the training folds


def _is_linear(r: Float1D, moved: Float1D, trial: Float1D) -> bool:
    """Return True if a residual r changes to `trial` nearly as the linear model has `moved` it."""
    departure = trial - r - moved
    return float(departure @ departure) <= MAX_DEPARTURE_SHARE * float(moved @ moved)


def _limit_noise(products: Float2D, information: Float2D) -> Float2D:
    """Return the products of noise, at most `MAX_NOISE_SHARE` of the information everywhere.

    In a direction that holds hardly more than noise a correction would be as uncertain.
    """
    scale = _curvature_scale(information)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    size = np.sqrt(np.maximum(values, 1e-12 * values[-1]))
    whitened = vectors / size / scale[:, None]
    shares, axes = np.linalg.eigh(whitened.T @ products @ whitened)
    back = scale[:, None] * (vectors * size @ axes)
    limited: Float2D = back * np.minimum(shares, MAX_NOISE_SHARE) @ back.T
    return limited


def _count_effective_blocks(information: Sequence[list[Float1D]], total: Float1D) -> Float1D:
    """Return how many equally informative blocks would determine each parameter as well, (free,).

    `information` has the sums of squared slopes by block of each log; `total` (free,) includes
    readings at rest and priors, with most of which a parameter needs no blocks: inf.
    """
    counts = np.full(total.size, math.inf)
    for i in range(total.size):
        blocks = np.concatenate([log_blocks[i] for log_blocks in information])
        if blocks.sum() > 0.5 * total[i]:
            counts[i] = blocks.sum() ** 2 / (blocks @ blocks)
    return counts


def _invert_information(information: Float2D, inner: Bool1D) -> tuple[Float2D, Bool1D]:
    """Return (inverse on the inner parameters, (p, p), 0 elsewhere; which are left open, (p,)).

    Where parameters replace each other, rounding is all that tells them apart.
    """
    scale, chosen = _curvature_scale(information), np.flatnonzero(inner)
    block = np.ix_(chosen, chosen)
    values, vectors = np.linalg.eigh((information / np.outer(scale, scale))[block])
    is_known = values > MIN_INFORMATION * values.max(initial=0.0)
    inverse, is_open = np.zeros_like(information), np.zeros(scale.size, dtype=bool)
    inverse[block] = (vectors[:, is_known] / values[is_known]) @ vectors[:, is_known].T
    is_open[chosen] = (vectors[:, ~is_known] ** 2).sum(axis=1) > MIN_INFORMATION
    return inverse / np.outer(scale, scale), is_open


def _widen_for_few_blocks(sd: Float1D, white_sd: Float1D, block_counts: Float1D) -> Float1D:
    """Return standard deviations, (free,), of which 1.96 are the 95 % interval.

    The scatter between few blocks has few degrees of freedom (Student's t), and that between as
    few as the parameters vanishes, however uncertain they are. The interval is then at least that
    of noise alone, from `white_sd` (free,).
    """
    widened = sd.copy()
    for i in np.flatnonzero((sd > 0) & np.isfinite(block_counts)):
        widened[i] *= stdtrit(max(block_counts[i] - 1.0, 1.0), 0.975) / 1.96
        if block_counts[i] < MIN_SCATTER_BLOCKS:
            widened[i] = max(widened[i], COLOUR_FACTOR * white_sd[i])
    return widened


def _curvature_scale(hessian: Float2D) -> Float1D:
    """Return the root of the diagonal of the Hessian, (p,), used for scaling."""
    curvature = np.sqrt(np.maximum(np.diag(hessian), 0.0))  # rounding may be negative
    return np.where(curvature > 0, curvature, 1.0)


def solve_damped(hessian: Float2D, damping: float, gradient: Float1D) -> Float1D:
    """Solve for the damped Gauss-Newton step, (p,), after diagonal scaling."""
    scale = _curvature_scale(hessian)
    scaled = hessian / np.outer(scale, scale) + damping * np.eye(scale.size)
    step: Float1D = np.linalg.lstsq(scaled, gradient / scale, rcond=1e-14)[0] / scale
    return step
