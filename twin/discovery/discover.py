"""Discovery of missing effects: from the signals of logs and a model to a verdict."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.records import Step
from twin.discovery.candidates import Candidate, list_candidates
from twin.discovery.least_squares import FitResult, MapFunction, fit_parameters
from twin.discovery.localization import (
    Localization,
    ResidualCell,
    build_cells,
    estimate_repeatability_floor,
    find_pulling_bumpers,
    localize_excess,
)
from twin.discovery.nuisances import (
    TYPICAL_LIMITS,
    linearize_nuisances,
    list_nuisance_parameters,
    sensor_mask,
    widen_intervals,
)
from twin.discovery.parameters import (
    INPUT_GAIN,
    INPUT_OFFSET,
    GapKey,
    ParameterSet,
    TareKey,
    list_base_parameters,
    list_model_effect_parameters,
)
from twin.discovery.residuals import LogResiduals, build_log_residuals
from twin.discovery.selection import (
    MAX_EFFECTS,
    MAX_EXPLAINED_COST,
    FittedSet,
    ProgressCallback,
    SelectionProblem,
    SelectionProgress,
    SelectionResult,
    count_sensor_errors,
    mean_square,
    stepwise_selection,
)
from twin.discovery.sensor_checks import compare_sensors
from twin.discovery.signals import CELL_PAIRS, SENSOR_PAIRS, LogSignals, derives_acc
from twin.discovery.verdict import (
    DiscoveryVerdict,
    judge_selection,
    qualify_none,
    widen_for_form,
)
from twin.model.model import Model

MIN_ENTRIES, MIN_BLOCKS = 1000, 9
MAX_IDEAL_ERRORS = 1  # of sensors: several at once are the small ones that every laboratory has
MAX_NUISANCE_SAMPLES = 60_000  # moving samples of all logs; limits time and memory
# About the nuisances found before: their products matter in a bad laboratory.
LINEARIZATION_COUNT = 2
# Share of the residual with ideal instruments (rms) that the nuisances, which are only so many
# forms of errors, may leave where they explain it; and the most, as mean square over the noise.
INSTRUMENT_MISFIT, MAX_INSTRUMENT_MISFIT = 0.01, 3.0
MODEL_LIMITED_RMS = 50.0  # residual rms over the noise above which model error limits the fit
MAX_PARAMETER_RATIO = 1.5  # ratio to the model's parameter beyond which the specimen is another one


@dataclass(frozen=True, eq=False)
class PreparedLog:
    """Log prepared for identification: signals, least contact threshold in N (or 0), steps."""

    signals: LogSignals
    contact_n: float
    steps: tuple[Step, ...] = ()


@dataclass(frozen=True, eq=False)
class PreparedProblem:
    """Selection problem of a set of logs, fit of the base model, excluded effects, and notes."""

    problem: SelectionProblem
    first_fit: FitResult
    excluded: dict[str, str]
    notes: tuple[str, ...]

    @property
    def parameters(self) -> ParameterSet:
        return self.first_fit.parameters

    @property
    def base_cost(self) -> float:
        """Mean square over the noise that the base leaves, with ideal instruments."""
        # where model error limits the fit, the residual is divided by it
        return self.problem.least_weight**2 * self.first_fit.cost


@dataclass(frozen=True, eq=False)
class Discovery:
    """Result of a discovery. The maps show cross-validation residuals before and after.

    `given` is the model as given, without any fit, with the gaps stated in the logs.
    """

    prepared: PreparedProblem
    given: FittedSet
    selection: SelectionResult
    verdict: DiscoveryVerdict
    localization: Localization
    map_before: tuple[ResidualCell, ...]
    map_after: tuple[ResidualCell, ...]
    notes: tuple[str, ...]
    ideal: "Discovery | None" = None  # the same with ideal instruments, where these were tried too
    # The same with nuisances, where these were tried too and do not explain the recordings either.
    with_nuisances: "Discovery | None" = None

    @property
    def model(self) -> Model:
        """Model with the effects found, without sensor errors."""
        return self.verdict.best.fit.parameters.to_model()


def evaluate_given(problem: SelectionProblem, model: Model) -> FittedSet:
    """Return the model as given as a set without free parameters, with its residuals."""
    parameters = ParameterSet.from_model(model, len(problem.log_residuals))
    entries = tuple(residuals.evaluate(parameters) for residuals in problem.log_residuals)
    fit = FitResult(parameters, {}, {}, np.empty((0, 0)), mean_square(entries), True, (), entries)
    return FittedSet((), fit)


def prepare_problem(
    logs: Sequence[PreparedLog],
    model: Model,
    without: Sequence[str] = (),
    mapper: MapFunction = map,
) -> PreparedProblem:
    """Prepare a selection problem; sensor noise becomes force noise through the fitted stiffness.

    `without` leaves effects out of the library. Raise InputError if there are too few samples.
    """
    if not logs:
        raise InputError("no log is given", remedy="give at least one recording")
    pairs = [(log.signals, log.contact_n) for log in logs]
    log_residuals = build_log_residuals(pairs, model)
    _check_enough_data(log_residuals)
    parameters = initialize_parameters(log_residuals, model)
    first = fit_parameters(log_residuals, parameters, mapper=mapper)
    log_residuals = build_log_residuals(pairs, first.parameters.to_model())
    first = fit_parameters(log_residuals, first.parameters, mapper=mapper)
    rms = [_rms(residuals.evaluate(first.parameters)) for residuals in log_residuals]
    notes = []
    if (thinned := log_residuals[0].thinning) > 1:
        notes.append(
            f"the recordings are long: of the cycles of each step only the last are used, one in "
            f"{thinned} and at least two"
        )
    if min(rms) > MODEL_LIMITED_RMS:
        log_residuals = build_log_residuals(pairs, first.parameters.to_model(), rms)
        notes.append(
            f"the residual is at least {min(rms):.0f} times the noise: model error dominates, so "
            "every log gets the same weight, regardless of its noise"
        )
    library, excluded = list_candidates(log_residuals, parameters, without)
    return PreparedProblem(
        SelectionProblem(log_residuals, library, mapper, MAX_IDEAL_ERRORS),
        first,
        excluded,
        tuple(notes),
    )


def add_nuisances(
    prepared: PreparedProblem, ideal_cost: float, fitted: FittedSet | None = None
) -> PreparedProblem:
    """Return the problem with linear terms for the nuisances of instruments and set-up.

    `ideal_cost` is the mean square over the noise that remains with ideal instruments. Lasers and
    accelerometers are compared first, on the rows that no force law enters: that gives their noise
    in motion, and the nuisances about which the terms are linear. Then the forces have their say,
    with the effects of `fitted` in the model: without one that is there, nuisances would stand in
    for it.
    """
    problem, mapper, first = prepared.problem, prepared.problem.mapper, prepared.parameters
    moving = sum(int(residuals.motion().moving.sum()) for residuals in problem.log_residuals)
    thinning = max(math.ceil(moving / MAX_NUISANCE_SAMPLES), problem.log_residuals[0].thinning)
    # Only the ratio of the weights counts: the priors stand against the noise of the best log.
    log_residuals = tuple(
        linearize_nuisances(
            replace(residuals, thinning=thinning, weight=residuals.weight / problem.least_weight),
            first,
            mapper=mapper,
        )
        for residuals in problem.log_residuals
    )
    fit = fit_parameters(
        log_residuals,
        _start_nuisances(log_residuals, first.with_free(())),
        [sensor_mask(residuals) for residuals in log_residuals],
        mapper=mapper,
    )
    for _ in range(LINEARIZATION_COUNT):
        log_residuals = tuple(
            linearize_nuisances(residuals, fit.parameters, calibrate=True, mapper=mapper)
            for residuals in log_residuals
        )
        start = _start_nuisances(log_residuals, fit.parameters.with_free(first.free))
        if fitted is not None:
            start = fitted.add_to(start)
        fit = fit_parameters(log_residuals, start, mapper=mapper)
    if fitted is not None and fitted.effects:
        start = _start_nuisances(log_residuals, fitted.remove_from(fit.parameters))
        fit = fit_parameters(log_residuals, start, mapper=mapper)
    return replace(
        prepared,
        problem=replace(
            problem,
            log_residuals=log_residuals,
            library=_drop_sound_sensors(problem),
            max_sensor_errors=MAX_EFFECTS,
            instrument_misfit=min(INSTRUMENT_MISFIT**2 * ideal_cost, MAX_INSTRUMENT_MISFIT),
            amplitude_limits=TYPICAL_LIMITS,
        ),
        first_fit=fit,
    )


def _drop_sound_sensors(problem: SelectionProblem) -> tuple[Candidate, ...]:
    """Return the candidates without faults of sensors that agree with another on the same body."""
    sound = set.intersection(
        *(
            {
                f"sensor_{check.kind}.{channel}"
                for check in compare_sensors(residuals.signals)
                if check.kind in ("gain", "lag") and check.is_healthy
                for channel in check.channels
            }
            for residuals in problem.log_residuals
        )
    )
    return tuple(candidate for candidate in problem.library if candidate.name not in sound)


def _start_nuisances(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet
) -> ParameterSet:
    """Return the parameters with the nuisances of the logs at their centre, and free."""
    nuisances = list_nuisance_parameters(log_residuals)
    start = parameters.with_values({nuisance.key: 0.0 for nuisance in nuisances})
    return start.with_free((*parameters.free, *nuisances))


def explain_with_nuisances(prepared: PreparedProblem) -> PreparedProblem:
    """Return the problem with nuisances if they, but not ideal sensors, explain the logs."""
    if prepared.base_cost <= MAX_EXPLAINED_COST:
        return prepared
    imperfect = add_nuisances(prepared, prepared.base_cost)
    is_explained = imperfect.first_fit.cost <= MAX_EXPLAINED_COST * imperfect.problem.noise
    return imperfect if is_explained else prepared


def initialize_parameters(log_residuals: Sequence[LogResiduals], model: Model) -> ParameterSet:
    """Return the start of a fit of the model."""
    has_contact = [bool((residuals.contact_state != 0).any()) for residuals in log_residuals]
    fit_input = any(
        derives_acc(residuals.signals.channels)
        and "damper_force_n" not in residuals.signals.channels
        for residuals in log_residuals
    )
    parameters = ParameterSet.from_model(model, len(log_residuals))
    input_gain = _input_gain(log_residuals[0]) if fit_input else None
    if input_gain is not None:
        parameters = parameters.with_values({INPUT_GAIN: input_gain, INPUT_OFFSET: 0.0})
    tare_sigmas = {
        TareKey(log, quantity): residuals.signals.rest_value(quantity)[1]
        for log, residuals in enumerate(log_residuals)
        for quantity in residuals.signals.zero_channels
    }
    scale = log_residuals[0].scale
    free = (
        *list_base_parameters(has_contact, input_gain, tare_sigmas, scale),
        *list_model_effect_parameters(model, scale),
    )
    return parameters.with_values(dict.fromkeys(tare_sigmas, 0.0)).with_free(free)


def _input_gain(residuals: LogResiduals) -> float:
    """Estimate the gain of the table's acceleration: u'' = -k u - c u' - table_acc / gain."""
    m = residuals.motion()
    columns = np.array([m.u, m.v, m.table_acc])[:, m.moving]
    size = np.abs(columns).max(axis=1, keepdims=True)
    relative_acc = (m.acc - m.table_acc)[m.moving]
    slope = np.linalg.lstsq((columns / size).T, relative_acc, rcond=None)[0][2] / size[2, 0]
    return 1.0 / abs(float(slope)) if slope else 1.0


def _check_enough_data(log_residuals: Sequence[LogResiduals]) -> None:
    """Raise InputError if all logs together hold too few samples or cycles, or one holds none."""
    counts = [
        (residuals.entry_row.size, np.unique(residuals.entry_block).size)
        for residuals in log_residuals
    ]
    entries, blocks = (sum(count) for count in zip(*counts, strict=True))
    names = [residuals.signals.name for residuals in log_residuals]
    empty = [name for name, (own_entries, _) in zip(names, counts, strict=True) if not own_entries]
    if empty or entries < MIN_ENTRIES or blocks < MIN_BLOCKS:
        where = empty or (names if len(names) == 1 else [""])
        raise InputError(
            f"too few usable samples: {0 if empty else entries} in {blocks} cycles",
            where=where[0],
            allowed=f"at least {MIN_ENTRIES} in {MIN_BLOCKS} cycles, in all logs together",
            remedy="record a longer test, every sensor within its range, or give several "
            "recordings of the specimen",
        )


def find_implausible_parameters(model: Model, fit: FitResult) -> list[str]:
    """Return messages on fitted parameters that differ too much for the same specimen."""
    start, notes = ParameterSet.from_model(model, 0).values, []
    for parameter in fit.free:
        expected, value = start.get(parameter.keys[0], 0.0), fit.values[parameter.key]
        differs = (
            expected > 0
            and parameter.unit in ("N/m", "N s/m")
            and not expected / MAX_PARAMETER_RATIO < value < expected * MAX_PARAMETER_RATIO
        )
        if differs and value > 0:
            notes.append(
                f"{parameter.name}: {value:.4g} {parameter.unit} in the recording, "
                f"{expected:.4g} in the model; check that "
                "the model and the mass are those of this specimen"
            )
        if isinstance(parameter.key, GapKey) and abs(value) > 1e-3:
            notes.append(
                f"{parameter.name}: each gap differs by {1e3 * value:+.2f} mm from the stated one"
            )
    return notes


def _rms(residual: Float1D) -> float:
    return math.sqrt(float(residual @ residual) / max(residual.size, 1))


def discover_effects(
    logs: Sequence[PreparedLog],
    model: Model,
    report: ProgressCallback = lambda progress: None,
    without: Sequence[str] = (),
    mapper: MapFunction = map,
) -> Discovery:
    """Find the effects that the model lacks by stepwise selection, and judge them (`verdict`).

    `mapper` may be a parallel map.
    """
    report(SelectionProgress("the model alone"))
    prepared = prepare_problem(logs, model, without, mapper)
    discovery = _select_and_judge(prepared, logs, model, report)
    if not discovery.selection.complete or _is_explained(discovery.verdict, MAX_IDEAL_ERRORS):
        return discovery
    ideal_cost = prepared.problem.least_weight**2 * discovery.verdict.best.cost
    imperfect = add_nuisances(prepared, ideal_cost)
    if not _can_explain(imperfect, discovery):
        return discovery
    with_nuisances = _select_and_judge(imperfect, logs, model, report)
    first = with_nuisances.verdict.best
    if first.effects and with_nuisances.selection.complete:
        imperfect = add_nuisances(prepared, ideal_cost, first)
        with_nuisances = _select_and_judge(imperfect, logs, model, report)
    best = widen_with_ideal(prepared, with_nuisances.verdict.best)
    verdict = replace(with_nuisances.verdict, best=best)
    with_nuisances = replace(with_nuisances, verdict=verdict, ideal=discovery)
    if not with_nuisances.selection.complete:
        return replace(discovery, selection=replace(discovery.selection, complete=False))
    is_ended_early = count_sensor_errors(discovery.selection.best) > MAX_IDEAL_ERRORS
    if is_ended_early or _is_explained(with_nuisances.verdict):
        return with_nuisances
    return replace(discovery, with_nuisances=with_nuisances)


def widen_with_ideal(prepared: PreparedProblem, fitted: FittedSet) -> FittedSet:
    """Return a set fitted with nuisances, its intervals widened by what these leave open.

    `prepared` is the problem with ideal instruments.
    """
    ideal = _fit_with_effects(prepared, fitted)
    return replace(fitted, fit=widen_intervals(fitted.fit, ideal, prepared.problem.log_residuals))


def _can_explain(imperfect: PreparedProblem, ideal: Discovery) -> bool:
    """Return True if nuisances can be what the best set with ideal instruments leaves.

    Either instruments disagree, which no force law makes them do, or nuisances close the gap of
    the base or of the best set. The latter only if no generic term closes it alone with ideal ones:
    one unknown law says more than the best known ones and many errors of instruments.
    """
    best, problem = ideal.verdict.best, ideal.prepared.problem
    max_cost = MAX_EXPLAINED_COST * imperfect.problem.noise
    if sensors_disagree(problem, best) or imperfect.first_fit.cost <= max_cost:
        return True
    if ideal.verdict.outcome == "unexplained" and any(
        len(fitted.effects) == 1 and fitted.cost <= MAX_EXPLAINED_COST * problem.noise
        for fitted in ideal.selection.generic_sets
    ):
        return False
    return _fit_with_effects(imperfect, best).cost <= max_cost


def _fit_with_effects(prepared: PreparedProblem, fitted: FittedSet) -> FitResult:
    """Return the fit of a prepared problem with the effects of a set that was fitted to another."""
    if not fitted.effects:
        return prepared.first_fit
    problem, start = prepared.problem, fitted.add_to(prepared.parameters)
    return fit_parameters(problem.log_residuals, start, mapper=problem.mapper)


def sensors_disagree(problem: SelectionProblem, fitted: FittedSet) -> bool:
    """Return True if sensors of one body or side differ beyond their noise in any log."""
    entries = [
        held_out[residuals.entry_row == row] * residuals.weight
        for residuals, held_out in zip(problem.log_residuals, fitted.held_out, strict=True)
        for row, name in enumerate(residuals.rows)
        if name in SENSOR_PAIRS or name in CELL_PAIRS
    ]
    return any(_rms(values) ** 2 > MAX_EXPLAINED_COST for values in entries)


def _is_explained(verdict: DiscoveryVerdict, max_sensor_errors: int = MAX_EFFECTS) -> bool:
    """Return True if the effects explain the recordings to the noise."""
    return (
        verdict.outcome != "unexplained"
        and not verdict.has_remainder
        and count_sensor_errors(verdict.best) <= max_sensor_errors
    )


def _select_and_judge(
    prepared: PreparedProblem,
    logs: Sequence[PreparedLog],
    model: Model,
    report: ProgressCallback,
) -> Discovery:
    """Return the selection from a prepared problem, judged; see `discover_effects`."""
    problem = prepared.problem
    selection = stepwise_selection(problem, prepared.parameters, report)
    steps = [log.steps for log in logs]
    # a residual below the noise means that the noise was overestimated
    floor = min(
        problem.noise
        * estimate_repeatability_floor(problem.log_residuals, selection.best.held_out),
        selection.best.cost,
    )
    verdict = widen_for_form(judge_selection(problem, selection, floor))
    verdict = qualify_none(problem, verdict)
    # implausible base parameters are reported only if they remain so with the effects added
    pulls = find_pulling_bumpers(problem.log_residuals, verdict.best.held_out)
    notes = (*prepared.notes, *find_implausible_parameters(model, verdict.best.fit), *pulls)
    before = build_cells(problem.log_residuals, selection.null.held_out, floor)
    localization = localize_excess(problem.log_residuals, selection.null.held_out, before, steps)
    after = build_cells(problem.log_residuals, verdict.best.held_out, floor)
    given = evaluate_given(prepared.problem, model)
    return Discovery(prepared, given, selection, verdict, localization, before, after, notes)


def fit_known_effects(
    logs: Sequence[PreparedLog], model: Model, effects: Sequence[str]
) -> FittedSet | None:
    """Fit exactly these effects with the base (oracle result); None if one is not a candidate."""
    prepared = prepare_problem(logs, model)
    candidates = {candidate.name: candidate for candidate in prepared.problem.library}
    if not set(effects) <= candidates.keys():
        return None
    best = None
    effects_fitted: list[Candidate] = [candidates[name] for name in effects]
    for rung in range(max((len(candidate.shapes) for candidate in effects_fitted), default=1)):
        parameters = prepared.parameters
        for candidate in effects_fitted:
            shape = candidate.shapes[min(rung, len(candidate.shapes) - 1)]
            parameters = candidate.add_to(parameters, shape, _small_amplitude(candidate))
        fit = fit_parameters(prepared.problem.log_residuals, parameters)
        if best is None or fit.cost < best.cost:
            best = fit
    return prepared.problem.fit_effects(best.parameters, effects_fitted) if best else None


def _small_amplitude(candidate: Candidate) -> float:
    free = candidate.amplitude
    return min(max(candidate.vanishing + 1e-3 * free.scale, free.low), free.high)
