"""Design of the next test: which of some tests would separate the explanations of the recordings.

Explanations that the recordings do not separate, the rivals, are fitted sets of effects. A test is
simulated as if one of them were true, with the noise of the instruments, and every rival is
refitted to that and the recordings at hand: parameters and errors of instruments that absorb the
difference, and trajectories that only chaos takes apart, separate nothing. With d the difference of
the residuals of two rivals, over the noise and the unknown errors of instruments, the new test is
expected to add the sum of d^2 / 2 to the logarithm of the likelihood ratio.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from scipy.special import ndtr

from table_io.block import Block, Float1D, Float2D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from table_io.errors import InputError
from twin.compare.sensors import apply_sensors, lag_samples
from twin.discovery.hidden_effects import UndetectedEffect, find_hidden_effects
from twin.discovery.learned_noise import learn_noise
from twin.discovery.least_squares import fill_jacobian, solve_damped
from twin.discovery.nuisances import linearize_nuisances, list_nuisance_parameters
from twin.discovery.parameters import (
    BUMPER_DAMPING,
    BUMPER_STIFFNESS,
    EffectKey,
    GapKey,
    ParameterKey,
    ParameterSet,
    TareKey,
    get_log,
    list_base_parameters,
)
from twin.discovery.residuals import LogResiduals
from twin.discovery.selection import (
    FittedSet,
    SelectionProblem,
    SelectionResult,
    mean_square,
)
from twin.discovery.signals import LogSignals, build_signals
from twin.discovery.verdict import DiscoveryVerdict
from twin.evidence.linear import INTERVAL_SIGMA
from twin.evidence.verdict import EXCLUDED_PROBABILITY
from twin.model.model import Model
from twin.model.prepare import prepare_solver
from twin.model.solver import OUTPUT_COUNT

MAX_RIVALS = 3  # limits the simulations, which grow with its square
MAX_REFITTED_TESTS = 4  # of the best tests by one linear step, refitted in full
# Half of a 95 % interval over its value, beyond which a named effect calls for a better test.
MAX_INTERVAL_SHARE = 0.25
CLEAR_PROBABILITY = 0.9  # from which more separation would decide no better
REST_S = 2.0  # simulated before a test, from which the noise is measured
NOISE_SEED = 0


@dataclass(frozen=True, eq=False)
class IdealTableMotion:
    """Ideal motion of the table in a test, for simulations: drive, set-up and duration.

    `block` has table_disp_m and table_acc_m_s2, and labels; it begins and ends at rest.
    `allowed_peaks` are the largest readings by channel that the sensors are meant for, SI.
    """

    name: str
    block: Block
    mass_kg: float
    gaps_m: tuple[float, float]
    minutes: float
    allowed_peaks: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Rival:
    """Explanation of the recordings: a set of effects with its fit, and the name to show.

    With `is_held` a parameter is held at a value, which data may exclude: it is not free.
    """

    name: str
    fitted: FittedSet
    is_held: bool = False


@dataclass(frozen=True, eq=False)
class PairSeparation:
    """Expected separation of two rivals by a test, if the one of index `truth` is true.

    `sigma` is the significance with the recordings at hand in standard errors: the logarithm of the
    likelihood ratio is 2 sigma^2, with a standard deviation of 2 sigma. From `threshold` on, as
    much, it excludes the other; `misfit` is what that leaves in the new test, rms over the noise.
    """

    truth: int
    other: int
    sigma: float
    misfit: float
    threshold: float

    @property
    def probability(self) -> float:
        """Probability that the other is excluded."""
        return float(ndtr(self.sigma - self.threshold**2 / self.sigma)) if self.sigma > 0 else 0.0


@dataclass(frozen=True, eq=False)
class TestPrediction:
    """Predicted outcome of a test for some rivals; `simulated` are the motions by rival index.

    In a confirmation all but the first are effects that the noise may hide: the test is to show or
    exclude as many of them as possible, each by itself.
    """

    __test__ = False  # no test of pytest

    motion: IdealTableMotion
    rivals: tuple[Rival, ...]
    pairs: tuple[PairSeparation, ...]
    simulated: dict[int, Block]

    @property
    def is_confirmation(self) -> bool:
        """True if nothing is open, and the test is to show effects that the noise may hide."""
        return is_confirmation(self.rivals)

    @property
    def is_within_ranges(self) -> bool:
        """False if a sensor would leave its range under one of the rivals."""
        return all(
            np.abs(values).max() <= self.motion.allowed_peaks.get(channel, math.inf)
            for block in self.simulated.values()
            for channel, values in zip(block.channels, block.values, strict=True)
        )

    @property
    def sigma(self) -> float:
        """Expected significance in standard errors: the least of a rival, mean over the truths."""
        return _mean([min(pair.sigma for pair in pairs) for pairs in self._by_truth])

    @property
    def separation_per_minute(self) -> float:
        """Expected logarithm of the likelihood ratio a minute, the least of a rival as `sigma`.

        Of white noise it is 2 sigma^2. Of effects that the noise may hide none counts for more than
        it takes to show it.
        """
        least = np.array([min(pair.sigma for pair in pairs) for pairs in self._by_truth])
        if self.is_confirmation:
            least = np.minimum(least, max(pair.threshold for pair in self.pairs))
        return _mean(2.0 * least * np.abs(least)) / self.motion.minutes

    @property
    def probability(self) -> float:
        """Probability that the test excludes all rivals but the true one, whichever that is."""
        return _mean([min(pair.probability for pair in pairs) for pairs in self._by_truth])

    @property
    def best_probability(self) -> float:
        """Probability for the rival that is excluded most probably if it is false."""
        return max((pair.probability for pair in self.pairs), default=0.0)

    @cached_property
    def _by_truth(self) -> list[list[PairSeparation]]:
        if self.is_confirmation:
            return [[pair] for pair in self.pairs]
        truths = dict.fromkeys(pair.truth for pair in self.pairs)
        return [[pair for pair in self.pairs if pair.truth == truth] for truth in truths]


def is_confirmation(rivals: Sequence[Rival]) -> bool:
    """Return True if nothing is open: all rivals but the first are effects that may be hidden."""
    return not rivals[0].is_held and all(rival.is_held for rival in rivals[1:])


def _mean(values: Sequence[float] | Float1D) -> float:
    """Return the mean; 0 of nothing."""
    return float(np.mean(values)) if len(values) else 0.0


def list_rivals(
    selection: SelectionResult,
    verdict: DiscoveryVerdict,
    law: FittedSet | None = None,
) -> tuple[Rival, ...]:
    """Return the explanations that the recordings leave open, the best first.

    Besides the best set: that with a proposed `law`, the sets as good as it, the sets with one
    effect more that fit a remainder, and where nothing is explained the next best.
    Where nothing is open, the ends of the widest interval; where all are narrow, the effects to
    which the recordings are blind, or without such those that the noise may hide.
    """
    best = verdict.best
    names = frozenset(best.names)
    larger = {
        frozenset(fitted.names): fitted
        for fitted in sorted(selection.tried, key=lambda fitted: -fitted.cost)
        if verdict.has_remainder
        and names < frozenset(fitted.names)
        and len(fitted.effects) == len(best.effects) + 1
        and fitted.cost < best.cost
    }
    competing = [
        fitted
        for fitted in sorted(selection.tried, key=lambda fitted: fitted.cost)
        if verdict.outcome == "unexplained" and 0 < len(fitted.effects) <= len(best.effects)
    ]
    others = [
        *([law] if law is not None else []),
        *verdict.alternatives,
        *sorted(larger.values(), key=lambda fitted: fitted.cost),
        *competing,
    ]
    distinct = {frozenset(fitted.names): fitted for fitted in reversed(others)}
    distinct.pop(names, None)
    others = [*reversed(distinct.values())][: MAX_RIVALS - 1]
    if others:
        return tuple(Rival(name_set(fitted), fitted) for fitted in (best, *others))
    hidden = verdict.blind_to or find_hidden_effects(selection.evidence, best)
    return find_interval_ends(best) or (
        Rival(name_set(best), best),
        *add_hidden_effects(best, hidden),
    )


def add_hidden_effects(best: FittedSet, hidden: Sequence[UndetectedEffect]) -> list[Rival]:
    """Return the best set with each further force law, held as large as the recordings hide it."""
    parameters, rivals = best.fit.parameters, []
    for effect in hidden:
        added = effect.candidate.add_to(parameters, effect.shape, effect.amplitude)
        fit = replace(best.fit, parameters=added.with_free(parameters.free))
        fitted = FittedSet((*best.effects, effect.candidate), fit)
        rivals.append(Rival(name_set(fitted), fitted, True))
    return rivals


def name_set(fitted: FittedSet) -> str:
    """Return the name of a set of effects."""
    return " + ".join(fitted.names) or "nothing added"


def find_interval_ends(fitted: FittedSet) -> tuple[Rival, ...]:
    """Return the ends of the 95 % interval of the effect known worst; none if all are narrow.

    The other parameters are those that the recordings allow best with it there.
    """
    fit = fitted.fit
    widths = {
        index: INTERVAL_SIGMA * fit.std_errors[free.key] / abs(fit.values[free.key] or 1.0)
        for index, free in enumerate(fit.free)
        if isinstance(free.key, EffectKey) and math.isfinite(fit.std_errors[free.key])
    }
    worst = max(widths, key=lambda index: widths[index], default=-1)
    if worst < 0 or widths[worst] <= MAX_INTERVAL_SHARE:
        return ()
    ends = [_move_along(fitted, worst, sign * INTERVAL_SIGMA) for sign in (-1.0, 1.0)]
    key = fit.free[worst].key
    return tuple(
        Rival(
            f"{key} = {end.fit.parameters.values[key]:.3g} {fit.free[worst].unit}".strip(),
            end,
            True,
        )
        for end in ends
    )


def _move_along(fitted: FittedSet, index: int, sigma: float) -> FittedSet:
    """Return the set with one parameter held `sigma` standard errors off, the others as correlated.

    Parameters with a logarithm move in it.
    """
    fit = fitted.fit
    values = dict(fit.parameters.values)
    correlation = fit.correlation[index]
    for other, free in enumerate(fit.free):
        shift = sigma * correlation[other] * fit.std_errors[free.key]
        value = fit.values[free.key]
        x = free.to_internal(value) + shift / (value if free.logarithmic else 1.0)
        values |= dict.fromkeys(free.keys, free.to_external(x))
    held = fit.free[index]
    still_free = tuple(free for free in fit.free if free is not held)
    parameters = replace(fit.parameters, values=values, free=still_free)
    return FittedSet(fitted.effects, replace(fit, parameters=parameters))


def predict_separation(
    problem: SelectionProblem, rivals: Sequence[Rival], motion: IdealTableMotion
) -> TestPrediction:
    """Return the expected separation of rivals, each refitted, by a test after the recordings."""
    return _predict_pairs(problem, rivals, motion, None)


def rank_tests(
    problem: SelectionProblem,
    rivals: Sequence[Rival],
    motions: Sequence[IdealTableMotion],
    report: Callable[[str], None] = lambda name: None,
) -> list[TestPrediction]:
    """Return the predictions of the tests, the best first; only the most promising are refitted.

    The best excludes rivals most probably; of several that surely do, it separates most a minute.
    Tests that lead a sensor out of its range are left out.
    """
    if len(rivals) < 2:
        return []
    linear = tuple(LinearizedRival.from_rival(problem, rival) for rival in rivals)
    screened = []
    for motion in motions:
        report(motion.name)
        screened.append(_predict_pairs(problem, rivals, motion, linear))
    useful = [test for test in screened if test.pairs and test.is_within_ranges]
    ranked = sorted(useful, key=_merit, reverse=True)
    if is_confirmation(rivals):  # of small effects that the noise hides one step is exact
        return ranked
    refitted = []
    for test in ranked[:MAX_REFITTED_TESTS]:
        report(test.motion.name)
        refitted.append(predict_separation(problem, rivals, test.motion))
    return sorted(refitted, key=_merit, reverse=True)


def _predict_pairs(
    problem: SelectionProblem,
    rivals: Sequence[Rival],
    motion: IdealTableMotion,
    linear: "Sequence[LinearizedRival] | None",
) -> TestPrediction:
    """Return the prediction of a test; with linearized rivals by one step of each."""
    pairs, simulated = [], {}
    for truth, rival in enumerate(rivals):
        others = [index for index, other in enumerate(rivals) if _is_separable(rival, other)]
        if not others or (truth and is_confirmation(rivals)):
            continue
        last = problem.log_residuals[-1]
        try:
            simulated[truth] = simulate_motion(rival.fitted.fit.parameters, motion, last)
        except (InputError, ArithmeticError):  # fitted too fast for the sampling rate, or to a pole
            continue
        residuals = make_residuals(rival.fitted, motion, problem, simulated[truth])
        joint = replace(problem, log_residuals=(*problem.log_residuals, residuals))
        # what the noise may hide hardly changes the slopes of the set that it is added to
        slopes = linear[truth].compute_new_slopes(joint) if linear else None
        shared = slopes if is_confirmation(rivals) else None
        true_entries = (
            linear[truth].take_step(joint, slopes) if linear else _refit_rival(joint, rival.fitted)
        )
        for other in others:
            entries = (
                linear[other].take_step(joint, shared)
                if linear
                else _refit_rival(joint, rivals[other].fitted)
            )
            pairs.append(_compare_entries(joint, truth, other, true_entries, entries))
    return TestPrediction(motion, tuple(rivals), tuple(pairs), simulated)


def _is_separable(true: Rival, other: Rival) -> bool:
    """Return True if data can exclude the other: not if it can become the true one."""
    can_become = {*true.fitted.names} <= {*other.fitted.names} and not other.is_held
    return true is not other and not can_become


def _merit(test: TestPrediction) -> tuple[float, float]:
    return min(test.probability, CLEAR_PROBABILITY), test.separation_per_minute


def make_residuals(
    fitted: FittedSet, motion: IdealTableMotion, problem: SelectionProblem, truth: Block
) -> LogResiduals:
    """Return the residuals of noisy readings of a test whose true motion, of a fit, is `truth`.

    The channels, their noise, the corrections of the gaps and the nuisances that may be fitted are
    those of the last recording.
    """
    last = problem.log_residuals[-1]
    readings = _add_noise(truth, last.signals.with_louder_channels(last.noise_scale))
    number = last.log_number + 1
    signals = build_signals((readings,), motion.name, motion.mass_kg, motion.gaps_m)
    residuals = LogResiduals(
        number, signals, last.contact_n, last.reference, last.scale, last.weights, last.thinning,
    )  # fmt: skip
    if last.nuisances is None:
        return residuals
    start = _start_rival(fitted, *problem.log_residuals, residuals)
    residuals = linearize_nuisances(residuals, start, mapper=problem.mapper)
    return learn_noise(residuals, start)


def simulate_motion(
    parameters: ParameterSet, motion: IdealTableMotion, like: LogResiduals
) -> Block:
    """Return the readings without noise of the channels of a log, from rest, as of a fit."""
    drive = motion.block
    rest = round(REST_S * drive.rate_hz)
    table_disp, table_acc = (
        np.pad(drive.channel(name), (rest, 0)) for name in ("table_disp_m", "table_acc_m_s2")
    )
    correction = parameters.values.get(GapKey(like.log_number), 0.0)
    model = parameters.to_model()
    right, left = (gap + correction for gap in motion.gaps_m)
    base = replace(model.base, mass=motion.mass_kg, gap_r=right, gap_l=left)
    solver = prepare_solver(Model(base, model.effects), drive.rate_hz)
    state, out = solver.rest_state(-1), np.empty((OUTPUT_COUNT, table_acc.size))
    solver.advance(state, table_acc, table_disp, out)
    u, _, acc, force_right, force_left = out[:5]
    channels = like.signals.channels
    columns = {
        "rel_disp_m": u, "mass_disp_m": table_disp + u, "table_disp_m": table_disp,
        "mass_acc_m_s2": acc, "table_acc_m_s2": table_acc,
        "damper_force_n": -motion.mass_kg * acc - force_right - force_left,
    }  # fmt: skip
    for cells, force in ((RIGHT_CELLS, force_right), (LEFT_CELLS, -force_left)):
        present = [cell for cell in cells if cell in channels]
        columns |= {cell: force / len(present) for cell in present}
    values = np.array([columns[name] for name in channels])
    sensors = parameters.assumed_sensors()
    past = np.repeat(values[:, :1], lag_samples(sensors, drive.rate_hz), axis=1)
    values = apply_sensors(sensors, drive.rate_hz, channels, values, past)
    step, cycle = (np.pad(row, (rest, 0), constant_values=-1) for row in (drive.step, drive.cycle))
    label = np.pad(drive.label, (rest, 0), constant_values=int(Label.REST))
    return Block("meas", 0, drive.rate_hz, channels, values, step, label, cycle)


def _add_noise(block: Block, like: LogSignals) -> Block:
    """Return the readings with white noise as loud as that of a log."""
    rms = np.array([math.sqrt(float(np.mean(like.noise[name] ** 2))) for name in block.channels])
    noise = np.random.default_rng(NOISE_SEED).standard_normal(block.values.shape)
    return replace(block, values=block.values + rms[:, None] * noise)


def _start_rival(fitted: FittedSet, *log_residuals: LogResiduals) -> ParameterSet:
    """Return the parameters of a rival, free, with those of the new log, which is the last.

    The bumpers, which no recording without contact determines, are free if the new test has some.
    """
    new = log_residuals[-1]
    parameters = fitted.fit.parameters
    last = GapKey(new.log_number - 1)
    tares = {
        TareKey(new.log_number, quantity): new.signals.rest_value(quantity)[1]
        for quantity in new.signals.zero_channels
    }
    nuisances = list_nuisance_parameters((new,))
    values: dict[ParameterKey, float] = dict.fromkeys(tares, 0.0)
    values |= dict.fromkeys((nuisance.key for nuisance in nuisances), 0.0)
    values[GapKey(new.log_number)] = parameters.values.get(last, 0.0)
    contacts = [log.shows_bumpers for log in log_residuals]
    base = () if any(contacts[:-1]) else (BUMPER_STIFFNESS, BUMPER_DAMPING)
    added = [
        free
        for free in list_base_parameters(contacts, None, tares, new.scale)
        if free.key in base or get_log(free.key) == new.log_number
    ]
    return parameters.with_values(values).with_free((*parameters.free, *added, *nuisances))


def _refit_rival(joint: SelectionProblem, fitted: FittedSet) -> tuple[Float1D, ...]:
    """Return the cross-validation residual of a rival refitted to all logs, (entry,) each."""
    return joint.fit_effects(_start_rival(fitted, *joint.log_residuals), fitted.effects).held_out


@dataclass(frozen=True, eq=False)
class LinearizedRival:
    """Rival linearized about its fit: residuals of the recordings and their slopes."""

    fitted: FittedSet
    before: tuple[Float1D, ...]  # of each log, (entry,)
    jacobian: Float2D  # (free, entry)
    hessian: Float2D
    gradient: Float1D

    @classmethod
    def from_rival(cls, problem: SelectionProblem, rival: Rival) -> "LinearizedRival":
        """Linearize a rival about its fit to the recordings."""
        parameters = rival.fitted.fit.parameters
        before = tuple(residuals.evaluate(parameters) for residuals in problem.log_residuals)
        entries = np.concatenate(before)
        jacobian = np.empty((len(parameters.free), entries.size))
        fill_jacobian(problem.log_residuals, parameters, before, None, problem.mapper, jacobian)
        return cls(rival.fitted, before, jacobian, jacobian @ jacobian.T, jacobian @ entries)

    def compute_new_slopes(self, joint: SelectionProblem) -> Float2D:
        """Return the slopes of its residual of the new log, the last one, (free, entry)."""
        new = joint.log_residuals[-1]
        start = _start_rival(self.fitted, *joint.log_residuals)
        entries = new.evaluate(start)
        slopes = np.empty((len(start.free), entries.size))
        fill_jacobian((new,), start, (entries,), None, joint.mapper, slopes)
        return slopes

    def take_step(
        self, joint: SelectionProblem, slopes: Float2D | None = None
    ) -> tuple[Float1D, ...]:
        """Return its residual after one step to all logs, the last of them new, (entry,) each.

        `slopes` of the new log may be those of a rival that hardly differs.
        """
        if slopes is None:
            slopes = self.compute_new_slopes(joint)
        start = _start_rival(self.fitted, *joint.log_residuals)
        entries = joint.log_residuals[-1].evaluate(start)
        known = len(self.fitted.fit.parameters.free)
        hessian, gradient = slopes @ slopes.T, slopes @ entries
        hessian[:known, :known] += self.hessian
        gradient[:known] += self.gradient
        step = -solve_damped(hessian, 1e-12, gradient)
        edges = np.cumsum([values.size for values in self.before])[:-1]
        recorded = np.split(np.concatenate(self.before) + step[:known] @ self.jacobian, edges)
        return (*recorded, entries + step @ slopes)


def _compare_entries(
    joint: SelectionProblem,
    truth: int,
    other: int,
    true_entries: Sequence[Float1D],
    entries: Sequence[Float1D],
) -> PairSeparation:
    """Return the separation from the residuals of the true rival and of another, (entry,) each."""
    gain = sum(
        float(old @ old - new @ new)
        for old, new in zip(entries[:-1], true_entries[:-1], strict=True)
    )
    # what chance adds to the new test is not expected of another run of it
    difference = entries[-1] - true_entries[-1]
    gain += float(difference @ difference)
    sigma = math.copysign(math.sqrt(0.25 * abs(gain)), gain)
    misfit = math.sqrt(mean_square([entries[-1] * joint.log_residuals[-1].entry_weight]))
    return PairSeparation(truth, other, sigma, misfit, _find_threshold(joint))


def _find_threshold(problem: SelectionProblem) -> float:
    """Return the standard errors that exclude one explanation of as many as the library has."""
    return math.sqrt(0.5 * math.log(max(len(problem.library), 1) / EXCLUDED_PROBABILITY))
