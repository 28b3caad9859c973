"""Discovery of missing effects: from the signals of logs and a model to a verdict."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.records import Step
from twin.discovery.candidates import list_candidates
from twin.discovery.learned_noise import learn_noise, limit_bumper_bands
from twin.discovery.least_squares import FitResult, MapFunction, fit_parameters, fit_with_misfit
from twin.discovery.localization import (
    Localization,
    ResidualCell,
    build_cells,
    find_pulling_bumpers,
    localize_excess,
)
from twin.discovery.nuisances import (
    linearize_nuisances,
    list_nuisance_parameters,
    resolve_samples,
    sensor_mask,
    widen_intervals,
)
from twin.discovery.parameters import (
    INPUT_GAIN,
    INPUT_OFFSET,
    GapKey,
    NuisanceKey,
    ParameterSet,
    TareKey,
    list_base_parameters,
    list_model_effect_parameters,
)
from twin.discovery.residuals import MAX_GAP_ERROR_M, LogResiduals, build_log_residuals
from twin.discovery.selection import (
    FittedSet,
    ProgressCallback,
    SelectionProblem,
    SelectionProgress,
    SelectionResult,
    mean_square,
    select_effects,
)
from twin.discovery.signals import (
    SINGLE_LINE_WIDTH,
    LogSignals,
    derives_acc,
    find_single_frequency,
)
from twin.discovery.starting_values import choose_start, solve_columns
from twin.discovery.verdict import DiscoveryVerdict, qualify_none, widen_for_form
from twin.evidence.selection import RoundEffort
from twin.evidence.verdict import judge_selection
from twin.model.model import Model

MIN_ENTRIES, MIN_BLOCKS = 1000, 9
# About the nuisances found before: their products matter in a bad laboratory.
LINEARIZATION_COUNT = 2
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

    The nuisances of instruments and set-up are always in it. `without` leaves effects out of the
    library. Raise InputError if there are too few samples.
    """
    if not logs:
        raise InputError("no log is given", remedy="give at least one recording")
    pairs = [(log.signals, log.contact_n) for log in logs]
    log_residuals = build_log_residuals(pairs, model)
    _check_enough_data(log_residuals)
    given = initialize_parameters(log_residuals, model)
    parameters = choose_start(log_residuals, given)
    if parameters is not given:
        log_residuals = tuple(
            replace(residuals, reference=parameters.to_model()) for residuals in log_residuals
        )
    first = fit_parameters(log_residuals, parameters, mapper=mapper)
    fitted = first.parameters
    log_residuals = tuple(
        limit_bumper_bands(residuals, fitted)
        for residuals in build_log_residuals(pairs, fitted.to_model())
    )
    notes = []
    if (thinned := log_residuals[0].thinning) > 1:
        notes.append(
            f"the recordings are long: of the cycles of each step only the last are used, one in "
            f"{thinned} and at least two"
        )
    notes += [
        f"{residuals.signals.name}: no rest and no repeated cycle shows the noise; it is taken "
        "from redundant sensors and from quiet bands, and may be louder"
        for residuals in log_residuals
        if not residuals.knows_noise
    ]
    notes += [
        f"{residuals.signals.name}: {reason}; the bumpers are not judged"
        for residuals in log_residuals
        if (reason := residuals.explain_hidden_bumpers()) and residuals.contact_state.any()
    ]
    if has_single_frequency([log.signals for log in logs]):
        notes.append(
            "only one frequency: damping, lag, relaxation and hysteresis cannot be distinguished"
        )
    log_residuals, first = add_nuisances(log_residuals, first.parameters, mapper)
    library, excluded = list_candidates(log_residuals, parameters, without)
    return PreparedProblem(
        SelectionProblem(log_residuals, library, mapper), first, excluded, tuple(notes)
    )


def has_single_frequency(signals: Sequence[LogSignals]) -> bool:
    """Return True if the drives of all logs together have one frequency."""
    frequencies = np.array([find_single_frequency(each) or np.nan for each in signals])
    return bool(frequencies.max() <= (1.0 + SINGLE_LINE_WIDTH) * frequencies.min())


def add_nuisances(
    log_residuals: Sequence[LogResiduals], first: ParameterSet, mapper: MapFunction = map
) -> tuple[tuple[LogResiduals, ...], FitResult]:
    """Return the residuals with linear terms for the nuisances, and the fit of the base with them.

    Lasers and accelerometers are compared first, on the rows that no force law enters: that gives
    their noise in motion, and the nuisances about which the terms are linear. Then the forces have
    their say.
    """
    start = first
    with_terms = tuple(
        linearize_nuisances(residuals, first, mapper=mapper) for residuals in log_residuals
    )
    fit = fit_parameters(
        with_terms,
        _start_nuisances(with_terms, first.with_free(())),
        [sensor_mask(residuals) for residuals in with_terms],
        mapper=mapper,
    )
    for _ in range(LINEARIZATION_COUNT):
        with_terms, fit = _fit_nuisances(with_terms, fit.parameters.with_free(start.free), mapper)
        with_terms = tuple(learn_noise(residuals, fit.parameters) for residuals in with_terms)
    fit = fit_with_misfit(with_terms, fit.parameters, mapper=mapper)
    return with_terms, fit


def _fit_nuisances(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet, mapper: MapFunction
) -> tuple[tuple[LogResiduals, ...], FitResult]:
    """Return residuals with nuisances linear about the parameters, and the fit with them."""
    with_terms = tuple(
        linearize_nuisances(residuals, parameters, calibrate=True, mapper=mapper)
        for residuals in log_residuals
    )
    start = _start_nuisances(with_terms, parameters)
    return with_terms, fit_with_misfit(with_terms, start, mapper=mapper)


def _start_nuisances(
    log_residuals: Sequence[LogResiduals], parameters: ParameterSet
) -> ParameterSet:
    """Return the parameters with the nuisances of the logs at their centre, and free."""
    nuisances = list_nuisance_parameters(log_residuals)
    start = parameters.with_values({nuisance.key: 0.0 for nuisance in nuisances})
    return start.with_free((*parameters.free, *nuisances))


def initialize_parameters(log_residuals: Sequence[LogResiduals], model: Model) -> ParameterSet:
    """Return the start of a fit of the model."""
    has_contact = [residuals.shows_bumpers for residuals in log_residuals]
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
    solution = solve_columns(columns, (m.acc - m.table_acc)[m.moving])
    slope = 0.0 if solution is None else float(solution[2])
    return 1.0 / abs(slope) if slope else 1.0


def _check_enough_data(log_residuals: Sequence[LogResiduals]) -> None:
    """Raise InputError if all logs together hold too few samples or cycles, or one holds none."""
    counts = [
        (int(residuals.row_mask.sum()), np.unique(residuals.entry_block).size)
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
        if isinstance(parameter.key, GapKey) and abs(value) > MAX_GAP_ERROR_M:
            notes.append(
                f"{parameter.name}: each gap differs by {1e3 * value:+.2f} mm from the stated one"
            )
    return notes


def discover_effects(
    logs: Sequence[PreparedLog],
    model: Model,
    report: ProgressCallback = lambda progress: None,
    without: Sequence[str] = (),
    mapper: MapFunction = map,
) -> Discovery:
    """Find the effects that the model lacks by their evidence (`selection`, `verdict`).

    `mapper` may be a parallel map.
    """
    report(SelectionProgress("the model alone"))
    prepared = prepare_problem(logs, model, without, mapper)
    once = (RoundEffort(),)
    selection = select_effects(prepared.problem, prepared.parameters, report, rounds=once)
    if selection.best.effects and selection.complete:
        # the errors of instruments were linear about a model without these effects
        prepared = _linearize_about(prepared, selection.best)
        selection = select_effects(prepared.problem, prepared.parameters, report, selection.best)
    return _judge(prepared, selection, logs, model)


def _linearize_about(prepared: PreparedProblem, fitted: FittedSet) -> PreparedProblem:
    """Return the problem with nuisances, and noise, about a model with effects."""
    problem, parameters = prepared.problem, fitted.fit.parameters
    log_residuals = tuple(replace(residuals, noise_scale={}) for residuals in problem.log_residuals)
    own = [free for free in parameters.free if not isinstance(free.key, NuisanceKey)]
    for _ in range(LINEARIZATION_COUNT):
        log_residuals, fit = _fit_nuisances(
            log_residuals, parameters.with_free(own), problem.mapper
        )
        parameters = fit.parameters
    base = fitted.remove_from(parameters)
    log_residuals = tuple(learn_noise(residuals, parameters, base) for residuals in log_residuals)
    first = fit_with_misfit(log_residuals, base, mapper=problem.mapper)
    return replace(prepared, problem=replace(problem, log_residuals=log_residuals), first_fit=first)


def _judge(
    prepared: PreparedProblem,
    selection: SelectionResult,
    logs: Sequence[PreparedLog],
    model: Model,
) -> Discovery:
    """Return a selection, judged; see `discover_effects`."""
    problem = prepared.problem
    steps = [log.steps for log in logs]
    # a residual below the noise means that the noise was overestimated
    floor = min(problem.noise, selection.best.cost)
    verdict = DiscoveryVerdict.of(judge_selection(problem, selection), floor)
    verdict = widen_for_form(verdict)
    widened = widen_intervals(verdict.best.fit, problem.log_residuals)
    verdict = replace(verdict, best=replace(verdict.best, fit=widened))
    verdict = qualify_none(selection, verdict)
    # implausible base parameters are reported only if they remain so with the effects added
    pulls = find_pulling_bumpers(problem.log_residuals, verdict.best.held_out)
    notes = (*prepared.notes, *find_implausible_parameters(model, verdict.best.fit), *pulls)
    noise = problem.find_noise_floor(verdict.best) ** 2
    null_samples, of_null = _evaluate_samples(problem, selection.null)
    before = build_cells(null_samples, of_null, noise)
    localization = localize_excess(null_samples, of_null, before, steps)
    after = build_cells(*_evaluate_samples(problem, verdict.best), noise)
    given = evaluate_given(prepared.problem, model)
    return Discovery(prepared, given, selection, verdict, localization, before, after, notes)


def _evaluate_samples(
    problem: SelectionProblem, fitted: FittedSet
) -> tuple[tuple[LogResiduals, ...], tuple[Float1D, ...]]:
    """Return (residuals at the samples, a set's values over the noise of sensors, (entry,))."""
    parameters = fitted.fit.parameters
    sampled = tuple(resolve_samples(each, parameters) for each in problem.log_residuals)
    return sampled, tuple(each.evaluate(parameters) * each.entry_weight for each in sampled)
