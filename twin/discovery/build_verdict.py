"""The content of verdict.json, from a discovery and the law that was proposed after it."""

from collections.abc import Sequence

from twin.discovery.candidates import Candidate
from twin.discovery.discover import Discovery, PreparedLog
from twin.discovery.held_out import compute_force_error
from twin.discovery.hidden_effects import bound_effects
from twin.discovery.law_search import LawProposal
from twin.discovery.least_squares import FitResult
from twin.discovery.nuisances import list_sizes
from twin.discovery.parameters import (
    SLIP_SPEED,
    EffectKey,
    FreeParameter,
    ParameterSet,
    SlipKey,
    TareKey,
    is_correction,
    is_sensor_error,
)
from twin.discovery.result import (
    CandidateResult,
    EffectResult,
    ExcludedSet,
    ExcludedSize,
    ExplanationResult,
    FittedNuisance,
    Gap,
    HeldOutLog,
    Interval,
    LawClass,
    LawTerm,
    Location,
    MisfitStep,
    ProposedLaw,
    Remainder,
    SensorCheckResult,
    Sensors,
    Verdict,
)
from twin.discovery.selection import FittedSet, SelectionProblem
from twin.discovery.sensor_checks import SensorCheck, check_sensors
from twin.discovery.verdict import closed_fraction, suggest_next_run
from twin.evidence.linear import INTERVAL_SIGMA
from twin.evidence.verdict import EXCLUDED_PROBABILITY, sum_by_set
from twin.model.model import Model

METRIC = (
    "rms of measured minus modelled forces on the measured motion, over the sensor noise, on "
    "held-out steps"
)
STOPPED_NOTE = "stopped early: not every effect was tested, so other effects may fit better"
REFITTED_SUFFIX = ", but with other parameters than the model has: see the notes"


def build_verdict(
    discovery: Discovery,
    seconds: float = 0.0,
    notes: Sequence[str] = (),
    held_out_logs: Sequence[PreparedLog] = (),
    given: Model | None = None,
    proposal: LawProposal | None = None,
) -> Verdict:
    """Return the content of verdict.json.

    `given` is the model as given, before any fit, for comparison on the held-out logs.
    """
    verdict, selection = discovery.verdict, discovery.selection
    best, null = verdict.best, selection.null
    where = discovery.localization
    problem = discovery.prepared.problem
    before, after = problem.measure_misfit(null), problem.measure_misfit(best)
    floor = problem.find_noise_floor(best)
    names = best.names
    alternatives = [fitted.names for fitted in verdict.alternatives]
    blind_to = [effect.candidate.name for effect in verdict.blind_to]
    return Verdict(
        verdict=verdict.outcome,
        why=format_reason(discovery),
        confidence=verdict.confidence,
        effects=[
            _build_effect(effect, best.fit, verdict.effects_confidence) for effect in best.effects
        ],
        ambiguous=[[*names], *([*ids] for ids in alternatives)] if alternatives else [],
        candidates=_list_candidates(selection.null, selection.tried, problem),
        where=Location(
            frequency_hz=list(where.frequency_hz) if where.frequency_hz else None,
            direction=where.direction,
            phase=where.phase,
            channels=list(where.channels),
            harmonics=list(where.harmonics),
        ),
        gap=Gap(
            metric=METRIC,
            given=problem.measure_misfit(discovery.given),
            before=problem.measure_fitted_misfit(null.fit),
            after=problem.measure_fitted_misfit(best.fit),
            noise_floor=floor,
            held_out_before=before,
            held_out_after=after,
            closed_fraction=closed_fraction(before, after, floor),
        ),
        staircase=_build_staircase(discovery, proposal),
        probability=[
            ExplanationResult(
                effects=[*each.names], stranger=each.place, probability=each.probability
            )
            for each in selection.explanations
        ],
        excludes=_list_excluded_sizes(discovery),
        nuisances=_list_nuisances(discovery),
        excluded=_list_excluded(discovery),
        remainder=Remainder(unexplained=verdict.has_remainder),
        law=_build_law(proposal, problem) if proposal else None,
        sensors=build_sensors(_check_discovery_sensors(discovery)),
        base=_build_base(best),
        fell_away=dict(discovery.prepared.excluded),
        notes=[
            *notes,
            *discovery.notes,
            *_find_suspicious_parameters(best),
            *([] if selection.complete else [STOPPED_NOTE]),
        ],
        blind_to=blind_to,
        form_errors={
            str(key): INTERVAL_SIGMA * error for key, error in verdict.form_errors.items()
        },
        next_run=suggest_next_run(verdict.outcome, names, alternatives, blind_to),
        seconds=seconds,
        held_out_logs=[_judge_held_out(log, discovery, given, proposal) for log in held_out_logs],
    )


def _build_staircase(discovery: Discovery, proposal: LawProposal | None) -> list[MisfitStep]:
    """Return the misfit step by step: as given, refitted, + each effect, noise floor.

    The effects are in the order in which each removes most; a set that was not fitted is left out.
    """
    selection, verdict = discovery.selection, discovery.verdict
    steps = [("model as given", discovery.given), ("refitted, no effect", selection.null)]
    sets = {frozenset(fitted.names): fitted for fitted in selection.tried}
    sets[frozenset(verdict.best.names)] = verdict.best
    if proposal is not None:
        sets[frozenset(proposal.start.names)] = proposal.start
    added: frozenset[str] = frozenset()
    best = frozenset(proposal.start.names if proposal else verdict.best.names)
    while added != best:
        larger = [names for names in sets if added < names <= best]
        smallest = min(map(len, larger))
        names = min((n for n in larger if len(n) == smallest), key=lambda n: sets[n].cost)
        steps.append((f"+ {' + '.join(sorted(names - added))}", sets[names]))
        added = names
    if proposal is not None:
        steps.append(("with the proposed law", proposal.fitted))
    problem = discovery.prepared.problem
    return [
        *(MisfitStep(label=label, misfit=problem.measure_misfit(each)) for label, each in steps),
        MisfitStep(label="noise floor", misfit=problem.find_noise_floor(verdict.best)),
    ]


def _list_excluded(discovery: Discovery) -> list[ExcludedSet]:
    """Return the sets of as many other effects as the best, best first, and how much worse."""
    best, problem = discovery.verdict.best, discovery.prepared.problem
    probabilities = sum_by_set(discovery.selection.explanations)
    rivals: dict[frozenset[str], FittedSet] = {}
    for fitted in sorted(discovery.selection.tried, key=lambda fitted: fitted.cost):
        names = frozenset(fitted.names)
        if best.effects and len(names) == len(best.effects) and names != frozenset(best.names):
            rivals.setdefault(names, fitted)
    return [
        ExcludedSet(
            id=" + ".join(rival.names),
            held_out_error=problem.measure_misfit(rival),
            sigma=problem.compute_gain(rival, best)[2],
        )
        for names, rival in rivals.items()
        if probabilities.get(names, 0.0) < EXCLUDED_PROBABILITY
    ]


def _list_excluded_sizes(discovery: Discovery) -> list[ExcludedSize]:
    """Return the largest size of each effect that is not in the best set."""
    effects = bound_effects(discovery.selection.evidence, discovery.verdict.best)
    largest = sorted((forms[-1] for forms in effects), key=lambda effect: effect.share)
    return [
        ExcludedSize(
            id=effect.candidate.name,
            parameter=str(effect.candidate.amplitude.key).rsplit(".", 1)[-1],
            value=abs(effect.deviation),
            unit=effect.candidate.amplitude.unit,
            force_share=effect.share,
        )
        for effect in largest
    ]


def _list_nuisances(discovery: Discovery) -> list[FittedNuisance]:
    """Return the fitted nuisances that exceed their usual size, the largest first."""
    values = discovery.verdict.best.fit.parameters
    fitted = [
        FittedNuisance(
            log=residuals.signals.name, kind=nuisance.kind, place=nuisance.place,
            value=z * nuisance.size, unit=nuisance.unit,
            typical=abs(z) * nuisance.size / (nuisance.usual or nuisance.size),
        )
        for residuals in discovery.prepared.problem.log_residuals
        for nuisance, z in list_sizes(residuals, values)
    ]  # fmt: skip
    large = [nuisance for nuisance in fitted if nuisance.typical > 1.0]
    return sorted(large, key=lambda nuisance: -nuisance.typical)


def _judge_held_out(
    log: PreparedLog, discovery: Discovery, given: Model | None, proposal: LawProposal | None
) -> HeldOutLog:
    """Return the errors of the damper force on a held-out log of every model, and the noise.

    The last one is that of model.toml: with the proposed law, if there is one.
    """
    null, best = discovery.selection.null.fit, discovery.verdict.best
    after = compute_force_error(log, (proposal.fitted if proposal else best).fit.parameters)
    as_given = given and compute_force_error(log, ParameterSet.from_model(given, 1))
    return HeldOutLog(
        log=log.signals.name,
        nrmse_given=as_given.nrmse if as_given else None,
        nrmse_before=compute_force_error(log, null.parameters).nrmse,
        nrmse_after=after.nrmse,
        noise_floor=after.noise_floor,
    )


def _check_discovery_sensors(discovery: Discovery) -> tuple[SensorCheck, ...]:
    """Return the checks of the instruments, and the sensor errors that the verdict names."""
    best, verdict = discovery.verdict.best, discovery.verdict
    log_residuals = discovery.prepared.problem.log_residuals
    checks = check_sensors(log_residuals, best.fit, not verdict.has_remainder)
    if verdict.outcome != "named":
        return checks
    logs = ", ".join(residuals.signals.name for residuals in log_residuals)
    named = []
    for effect in best.effects:
        free = effect.amplitude
        if effect.channel and isinstance(free.key, EffectKey):
            size = best.fit.values[free.key] - effect.vanishing
            half = INTERVAL_SIGMA * best.fit.std_errors[free.key]
            named.append(
                SensorCheck(
                    logs, free.key.name, (effect.channel,), size, size - half, size + half, 0.0,
                    free.unit,
                )
            )  # fmt: skip
    return (*checks, *named)


def build_sensors(checks: Sequence[SensorCheck]) -> Sensors:
    """Return the verdict on the instruments."""
    rows = [
        SensorCheckResult(
            log=check.log, kind=check.kind, channels=[*check.channels],
            value=check.value, low=check.low, high=check.high, unit=check.unit,
            limit=check.limit, healthy=check.is_healthy,
        )
        for check in checks
    ]  # fmt: skip
    is_healthy = all(check.is_healthy for check in checks)
    return Sensors(state="healthy" if is_healthy else "to be mended", checks=rows)


def _build_effect(candidate: Candidate, fit: FitResult, confidence: float) -> EffectResult:
    """Return an effect with its confidence and its parameters, each with its 95 % interval."""
    effect = EffectResult(
        id=candidate.effect.id,
        confidence=confidence,
        parameters=_build_parameters(candidate, fit),
    )
    # absent for other effects
    if candidate.channel:
        effect.channel = candidate.channel
    if slip := next((free for free in candidate.free if free.key == SLIP_SPEED), None):
        effect.slip_speed = build_parameter(fit, slip)
    return effect


def _build_parameters(candidate: Candidate, fit: FitResult) -> dict[str, Interval]:
    return {
        free.key.name: build_parameter(fit, free)
        for free in candidate.free
        if isinstance(free.key, EffectKey)
    }


def build_parameter(fit: FitResult, free: FreeParameter) -> Interval:
    """Return a fitted value with its 95 % interval, None for too few cycles, and unit."""
    return build_interval(fit.values[free.key], fit.interval_error(free.key), free.unit)


def build_interval(value: float, sd: float, unit: str) -> Interval:
    """Return a value with its 95 % interval and unit."""
    half = INTERVAL_SIGMA * sd
    return Interval(value=value, low=value - half, high=value + half, unit=unit)


def _build_base(fitted: FittedSet) -> dict[str, Interval]:
    """Return the refitted base parameters and the gap corrections of each log."""
    fit = fitted.fit
    return {free.name: build_parameter(fit, free) for free in _base_parameters(fitted)}


def _base_parameters(fitted: FittedSet) -> list[FreeParameter]:
    """Return the free parameters without added effects, tare errors and sensor corrections."""
    added = {free.key for effect in fitted.effects for free in effect.free}
    return [
        free
        for free in fitted.fit.free
        if free.key not in added and not is_correction(free.key) and not is_sensor_error(free.key)
    ]


def _find_suspicious_parameters(fitted: FittedSet) -> list[str]:
    """Return notes on parameters at a bound and on effects of the model that vanish."""
    fit, notes = fitted.fit, []
    notes += [
        f"{key} = {fit.values[key]:.4g} is at its bound: do not trust it"
        for key in fit.at_bound
        if not isinstance(key, TareKey | SlipKey)
    ]
    for free in _base_parameters(fitted):
        key, vanishing = free.key, free.vanishing
        if not isinstance(key, EffectKey) or vanishing is None:
            continue
        if abs(fit.values[key] - vanishing) < INTERVAL_SIGMA * fit.std_errors[key]:
            notes.append(
                f"{key.effect} of the model vanishes in these recordings; remove it from the model"
            )
    return notes


def format_reason(discovery: Discovery) -> str:
    """Return the reason of the verdict, and mention if agreement required other parameters."""
    has_notes = discovery.verdict.outcome == "none" and discovery.notes
    return f"{discovery.verdict.reason}{REFITTED_SUFFIX if has_notes else ''}"


def _list_candidates(
    null: FittedSet, tried: Sequence[FittedSet], problem: SelectionProblem
) -> list[CandidateResult]:
    """Return every refitted set with its cross-validation error, best first."""
    best: dict[frozenset[str], FittedSet] = {}
    for fitted in (null, *tried):
        key = frozenset(fitted.names)
        if key not in best or fitted.cost < best[key].cost:
            best[key] = fitted
    candidates = []
    for fitted in sorted(best.values(), key=problem.measure_misfit):
        candidate = CandidateResult(
            id=" + ".join(fitted.names) or "nothing added",
            held_out_error=problem.measure_misfit(fitted),
            converged=fitted.fit.converged,
        )
        if fitted.fit.at_bound:
            candidate.at_bound = [*map(str, fitted.fit.at_bound)]
        candidates.append(candidate)
    return candidates


def _build_law(proposal: LawProposal, problem: SelectionProblem) -> ProposedLaw:
    before, after = problem.measure_misfit(proposal.start), proposal.misfit
    floor = problem.find_noise_floor(proposal.fitted)
    fitted = proposal.fitted
    terms = fitted.effects[len(proposal.start.effects) :]
    return ProposedLaw(
        terms=[
            LawTerm(
                id=law.id,
                title=law.title,
                place=law.place,
                force=law.force,
                states={name: state.rate for name, state in law.states.items()},
                parameters=_build_parameters(term, fitted.fit)
                | {
                    key.name: build_interval(value, 0.0, law.parameter(key.name).unit)
                    for key, value in term.constants.items()
                    if isinstance(key, EffectKey)
                },
                range={name: (low, high) for name, low, high in law.valid_range},
            )
            for law, term in zip(proposal.laws, terms, strict=True)
        ],
        with_effects=[*proposal.start.names],
        base=_build_base(fitted),
        law_class=proposal.law_class,
        held_out_before=before,
        held_out_after=after,
        noise_floor=floor,
        closed_fraction=closed_fraction(before, after, floor),
        sufficient=proposal.is_sufficient,
        nearest=proposal.nearest,
        classes=[
            LawClass(
                law_class=name,
                id=best.names[-1],
                held_out_error=problem.measure_misfit(best),
            )
            for name, best in proposal.by_class
        ],
    )
