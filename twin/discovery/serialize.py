"""Serialization of a verdict to `verdict.json` and of a fitted model to a model file."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from twin.discovery.candidates import Candidate
from twin.discovery.discover import Discovery, PreparedLog
from twin.discovery.held_out import compute_force_error
from twin.discovery.law_search import LawProposal
from twin.discovery.least_squares import INTERVAL_SIGMA, FitResult
from twin.discovery.nuisances import TYPICAL_LIMITS
from twin.discovery.parameters import (
    INPUT_GAIN,
    SLIP_SPEED,
    BaseKey,
    EffectKey,
    FreeParameter,
    GapKey,
    ParameterSet,
    SlipKey,
    TareKey,
    TermKey,
    is_correction,
    is_sensor_error,
)
from twin.discovery.selection import FittedSet
from twin.discovery.sensor_checks import SensorCheck, check_sensors
from twin.discovery.verdict import closed_fraction, suggest_next_run
from twin.laws.effect import Effect
from twin.laws.effect_file import format_effect_file
from twin.model.model import SENSOR_CHANNELS, Model
from twin.model.parameters import Parameters

Json = dict[str, Any]
MIN_GAP_ERROR_M = 1e-6  # smaller gap corrections are not reported
METRIC = (
    "rms of measured minus modelled forces on the measured motion, over the sensor noise, on "
    "held-out steps"
)
STOPPED_NOTE = "stopped early: not every effect was tested, so other effects may fit better"
REFITTED_SUFFIX = ", but with other parameters than the model has: see the notes"


def verdict_to_json(
    discovery: Discovery,
    seconds: float = 0.0,
    notes: Sequence[str] = (),
    held_out_logs: Sequence[PreparedLog] = (),
    given: Model | None = None,
    proposal: LawProposal | None = None,
) -> Json:
    """Return the content of verdict.json, see `twin.results.contracts.Verdict`.

    `given` is the model as given, before any fit, for comparison on the held-out logs.
    """
    verdict, selection = discovery.verdict, discovery.selection
    best, null = verdict.best, selection.null
    where = discovery.localization
    factor = noise_factor(discovery)
    names, alternatives = best.names, [fitted.names for fitted in verdict.alternatives]
    blind_to = [effect.candidate.name for effect in verdict.blind_to]
    return {
        "verdict": verdict.outcome,
        "why": _format_reason(discovery),
        "effects": [
            effect_to_json(effect, best.fit, verdict.confidence) for effect in best.effects
        ],
        "ambiguous": [[*names], *([*ids] for ids in alternatives)] if alternatives else [],
        "candidates": candidates_to_json(
            selection.null, (*selection.tried, *selection.generic_sets), factor
        ),
        "where": {
            "frequency_hz": list(where.frequency_hz) if where.frequency_hz else None,
            "direction": where.direction,
            "phase": where.phase,
            "channels": list(where.channels),
            "harmonics": list(where.harmonics),
        },
        "gap": {
            "metric": METRIC,
            "given": factor * math.sqrt(discovery.given.cost),
            "before": factor * math.sqrt(null.fit.cost),
            "after": factor * math.sqrt(best.fit.cost),
            "noise_floor": factor * math.sqrt(verdict.floor),
            "held_out_before": factor * math.sqrt(null.cost),
            "held_out_after": factor * math.sqrt(best.cost),
            "closed_fraction": closed_fraction(null.cost, best.cost, verdict.floor),
        },
        "staircase": staircase_to_json(discovery, factor, proposal),
        "excluded": excluded_to_json(discovery, factor),
        "remainder": {
            "unexplained": verdict.has_remainder,
            "evidence": generic_term_to_json(verdict.generic, factor),
        },
        "law": law_to_json(proposal, factor) if proposal else None,
        "sensors": sensors_to_json(check_discovery_sensors(discovery)),
        "base": base_to_json(best),
        "fell_away": dict(discovery.prepared.excluded),
        "notes": [
            *notes,
            *discovery.notes,
            *find_suspicious_parameters(best),
            *([] if selection.complete else [STOPPED_NOTE]),
        ],
        "blind_to": blind_to,
        "form_errors": {
            str(key): INTERVAL_SIGMA * error for key, error in verdict.form_errors.items()
        },
        "next_run": suggest_next_run(verdict.outcome, names, alternatives, blind_to),
        "seconds": seconds,
        "held_out_logs": [_held_out_to_json(log, discovery, given) for log in held_out_logs],
    }


def staircase_to_json(
    discovery: Discovery, factor: float, proposal: LawProposal | None = None
) -> list[Json]:
    """Return the misfit step by step: as given, refitted, + each effect, noise floor.

    The effects are in the order in which each removes most; a set that was not fitted is left out.
    """
    selection, verdict = discovery.selection, discovery.verdict
    steps = [
        ("model as given", discovery.given.cost),
        ("refitted, no effect", selection.null.cost),
    ]
    costs = {frozenset(fitted.names): fitted.cost for fitted in selection.tried}
    costs[frozenset(verdict.best.names)] = verdict.best.cost
    if proposal is not None:
        costs[frozenset(proposal.start.names)] = proposal.start.cost
    added: frozenset[str] = frozenset()
    best = frozenset(proposal.start.names if proposal else verdict.best.names)
    while added != best:
        larger = [names for names in costs if added < names <= best]
        smallest = min(map(len, larger))
        names = min((n for n in larger if len(n) == smallest), key=lambda n: costs[n])
        steps.append((f"+ {' + '.join(sorted(names - added))}", costs[names]))
        added = names
    generic = verdict.generic if proposal is None else None
    if proposal is not None:
        steps.append(("with the proposed law", proposal.fitted.cost))
    if generic is not None and verdict.outcome == "unexplained":
        term = generic.names[-1].split(".", 1)[1]
        steps.append((f"with the general law {term}", generic.cost))
    steps.append(("noise floor", verdict.floor))
    return [{"label": label, "misfit": factor * math.sqrt(max(c, 0.0))} for label, c in steps]


def excluded_to_json(discovery: Discovery, factor: float) -> list[Json]:
    """Return the sets of as many other effects as the best, best first, and how much worse."""
    best, problem = discovery.verdict.best, discovery.prepared.problem
    rivals: dict[frozenset[str], FittedSet] = {}
    for fitted in sorted(discovery.selection.tried, key=lambda fitted: fitted.cost):
        names = frozenset(fitted.names)
        if best.effects and len(names) == len(best.effects) and names != frozenset(best.names):
            rivals.setdefault(names, fitted)
    return [
        {
            "id": " + ".join(rival.names),
            "held_out_error": factor * math.sqrt(rival.cost),
            "sigma": problem.compute_gain(rival, best)[2],
        }
        for rival in rivals.values()
    ]


def _held_out_to_json(log: PreparedLog, discovery: Discovery, given: Model | None) -> Json:
    """Return the errors of the damper force on a held-out log of every model, and the noise."""
    null, best = discovery.selection.null.fit, discovery.verdict.best.fit
    after = compute_force_error(log, best.parameters)
    as_given = given and compute_force_error(log, ParameterSet.from_model(given, 1))
    return {
        "log": log.signals.name,
        "nrmse_given": as_given.nrmse if as_given else None,
        "nrmse_before": compute_force_error(log, null.parameters).nrmse,
        "nrmse_after": after.nrmse,
        "noise_floor": after.noise_floor,
    }


def check_discovery_sensors(discovery: Discovery) -> tuple[SensorCheck, ...]:
    """Return the checks of the instruments, and the sensor errors that the verdict names."""
    best, verdict = discovery.verdict.best, discovery.verdict
    log_residuals = discovery.prepared.problem.log_residuals
    checks = check_sensors(log_residuals, best.fit)
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


def sensors_to_json(checks: Sequence[SensorCheck]) -> Json:
    """Return the verdict on the instruments."""
    rows = [
        {
            "log": check.log, "kind": check.kind, "channels": [*check.channels],
            "value": check.value, "low": check.low, "high": check.high, "unit": check.unit,
            "limit": check.limit, "healthy": check.is_healthy,
        }
        for check in checks
    ]  # fmt: skip
    is_healthy = all(check.is_healthy for check in checks)
    return {"state": "healthy" if is_healthy else "to be mended", "checks": rows}


def noise_factor(discovery: Discovery) -> float:
    """Return the factor from weighted residuals to multiples of the sensor noise.

    Where model error rules, residuals are divided by it in place of the noise, log by log.
    """
    log_residuals = discovery.prepared.problem.log_residuals
    counts = [residuals.entry_row.size for residuals in log_residuals]
    squares = [residuals.weight**2 for residuals in log_residuals]
    return math.sqrt(sum(n * w for n, w in zip(counts, squares, strict=True)) / sum(counts))


def effect_to_json(candidate: Candidate, fit: FitResult, confidence: float) -> Json:
    """Return an effect with its confidence and its parameters, each with its 95 % interval."""
    slip = next((free for free in candidate.free if free.key == SLIP_SPEED), None)
    return {
        "id": candidate.effect.id if candidate.effect else candidate.name,
        **({"channel": candidate.channel} if candidate.channel else {}),
        "confidence": confidence,
        "parameters": {
            free.key.name: parameter_to_json(fit, free)
            for free in candidate.free
            if isinstance(free.key, EffectKey | TermKey)
        },
        **({"slip_speed": parameter_to_json(fit, slip)} if slip else {}),
    }


def parameter_to_json(fit: FitResult, free: FreeParameter) -> Json:
    """Return a fitted value with its 95 % interval, infinite for too few cycles, and unit."""
    return interval_to_json(fit.values[free.key], fit.interval_error(free.key), free.unit)


def interval_to_json(value: float, sd: float, unit: str) -> Json:
    """Return a value with its 95 % interval and unit."""
    return {
        "value": value,
        "low": value - INTERVAL_SIGMA * sd,
        "high": value + INTERVAL_SIGMA * sd,
        "unit": unit,
    }


def base_to_json(fitted: FittedSet) -> Json:
    """Return the refitted base parameters and the gap corrections of each log."""
    fit = fitted.fit
    return {free.name: parameter_to_json(fit, free) for free in _base_parameters(fitted)}


def _base_parameters(fitted: FittedSet) -> list[FreeParameter]:
    """Return the free parameters without added effects, tare errors and sensor corrections."""
    added = {free.key for effect in fitted.effects for free in effect.free}
    return [
        free
        for free in fitted.fit.free
        if free.key not in added and not is_correction(free.key) and not is_sensor_error(free.key)
    ]


def find_suspicious_parameters(fitted: FittedSet) -> list[str]:
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


def _format_reason(discovery: Discovery) -> str:
    """Return the reason of the verdict, and mention if agreement required other parameters."""
    has_notes = discovery.verdict.outcome == "none" and discovery.notes
    return f"{discovery.verdict.reason}{REFITTED_SUFFIX if has_notes else ''}"


def candidates_to_json(
    null: FittedSet, tried: Sequence[FittedSet], factor: float = 1.0
) -> list[Json]:
    """Return every refitted set with its cross-validation error, times a factor, best first."""
    best: dict[frozenset[str], FittedSet] = {}
    for fitted in (null, *tried):
        key = frozenset(fitted.names)
        if key not in best or fitted.cost < best[key].cost:
            best[key] = fitted
    return [
        {
            "id": " + ".join(fitted.names) or "nothing added",
            "held_out_error": factor * math.sqrt(fitted.cost),
            "converged": fitted.fit.converged,
            **({"at_bound": [*map(str, fitted.fit.at_bound)]} if fitted.fit.at_bound else {}),
        }
        for fitted in sorted(best.values(), key=lambda fitted: fitted.cost)
    ]


def generic_term_to_json(general: FittedSet | None, factor: float = 1.0) -> Json | None:
    """Return the generic term that fits better than every library effect; None without one."""
    if general is None:
        return None
    term = general.effects[-1]
    return {
        "term": term.name.split(".", 1)[1],
        "meaning": "u, v, d relative to their largest measured values, w likewise (resonator: Hz)",
        "held_out_error": factor * math.sqrt(general.cost),
        "parameters": {
            free.key.name: parameter_to_json(general.fit, free)
            for free in term.free
            if isinstance(free.key, TermKey)
        },
    }


def _is_input_gain_off(fit: FitResult) -> bool:
    """Return True if the whole interval of the gain of the table's sensor is off by too much."""
    half = INTERVAL_SIGMA * fit.interval_error(INPUT_GAIN)
    return abs(fit.parameters.values[INPUT_GAIN] - 1.0) - half > TYPICAL_LIMITS[INPUT_GAIN.effect]


def model_to_toml(
    fit: FitResult,
    title: str,
    citation: str,
    fitted_on: str,
    provisional: str = "",
    named: Sequence[str] = (),
) -> tuple[str, list[str]]:
    """Return (text of a model file, notes on what it omits); gaps belong to the test profiles.

    `provisional` is the reason why the model is not to be trusted yet, if there is one, `named` are
    the effects that were added.
    """
    omitted = []
    kept: dict[tuple[str, str], dict[str, float]] = {}
    effects: dict[tuple[str, str], dict[str, float]] = {}
    for key, value in fit.parameters.values.items():
        if isinstance(key, EffectKey):
            effects.setdefault((key.effect, key.channel), {})[key.name] = value
    for (effect, channel), values in effects.items():
        if channel and channel not in SENSOR_CHANNELS:
            # gain and offset of an input are fitted in every log without another accelerometer
            is_off = EffectKey(effect, "gain", channel) == INPUT_GAIN and _is_input_gain_off(fit)
            if is_off or f"{effect}.{channel}" in named:
                omitted.append(
                    f"{effect}.{channel}: not in the model file, because the twin is driven by "
                    "this channel and does not predict it; repair or calibrate the sensor"
                )
            continue
        kept[effect, channel] = values
    intervals: dict[str, tuple[float, float]] = {}
    for free in fit.free:
        if (
            isinstance(free.key, BaseKey | EffectKey | SlipKey)
            and 0 < fit.interval_error(free.key) < math.inf
        ):
            interval = parameter_to_json(fit, free)
            intervals[free.name] = interval["low"], interval["high"]
    gaps = {key: value for key, value in fit.values.items() if isinstance(key, GapKey)}
    if any(
        abs(v) > max(INTERVAL_SIGMA * fit.std_errors[k], MIN_GAP_ERROR_M) for k, v in gaps.items()
    ):
        differences = ", ".join(f"{1e3 * v:+.3f} mm" for v in gaps.values())
        omitted.append(
            f"correct the gaps in the test profile of each log: each side differs by {differences}"
        )
    texts = {
        "title": title,
        "citation": citation,
        "fitted_on": fitted_on,
        "provisional": provisional,
    }
    files = {
        effect.id: effect_file_name(effect)
        for effect in fit.parameters.effects.values()
        if effect.is_of_file
    }
    base = fit.parameters.to_model().base
    return format_model_toml(texts, base, kept, intervals, files), omitted


def format_model_toml(
    texts: Mapping[str, str],
    base: Parameters,
    effects: Mapping[tuple[str, str], Mapping[str, float]],
    intervals: Mapping[str, tuple[float, float]],
    files: Mapping[str, str] | None = None,
) -> str:
    """Return the text of a model file: `texts` by key, those that are empty left out.

    `effects` are values by (effect, channel), `intervals` by parameter, `files` the names of the
    effect files by effect.
    """
    sources = {effect: f"file = {_quote_toml(name)}" for effect, name in (files or {}).items()}
    lines = [
        f"{key} = {_quote_toml(text)}"
        for key, text in texts.items()
        if text or key != "provisional"
    ]
    lines += [
        "[base]",
        f"stiffness_n_m = {base.stiffness!r}",
        f"damping_n_s_m = {base.damping!r}",
        f"bumper_stiffness_n_m = {base.bumper_stiffness_r!r}",
        f"bumper_damping_n_s_m = {base.bumper_damping_r!r}",
    ]
    for (effect, channel), values in effects.items():
        numbers = [f"{name} = {value!r}" for name, value in values.items()]
        numbers += [f"channel = {_quote_toml(channel)}"] if channel else []
        lines += [
            "[[effects]]",
            sources.get(effect, f"id = {_quote_toml(effect)}"),
            f"parameters = {{ {', '.join(numbers)} }}",
        ]
    lines += ["[intervals]  # 95 %"]
    lines += [
        f"{_quote_toml(name)} = [{low!r}, {high!r}]" for name, (low, high) in intervals.items()
    ]
    return "\n".join(lines) + "\n"


def effect_file_name(effect: Effect) -> str:
    """Return the name of the effect file that a model file refers to."""
    return f"{effect.id}.toml"


def list_effect_files(fit: FitResult, laws: Sequence[Effect] = ()) -> dict[str, str]:
    """Return the texts by name of the effect files of a fitted model; `laws` describe new ones."""
    described = {law.id: law for law in laws}
    return {
        effect_file_name(effect): format_effect_file(described.get(effect.id, effect))
        for effect in fit.parameters.effects.values()
        if effect.is_of_file
        and any(
            isinstance(key, EffectKey) and key.effect == effect.id for key in fit.parameters.values
        )
    }


def law_to_json(proposal: LawProposal, factor: float) -> Json:
    """Return a proposed law, see `twin.results.contracts.ProposedLaw`."""
    fitted = proposal.fitted
    terms = fitted.effects[len(proposal.start.effects) :]
    return {
        "terms": [
            {
                "id": law.id,
                "title": law.title,
                "place": law.place,
                "force": law.force,
                "states": {name: state.rate for name, state in law.states.items()},
                "parameters": effect_to_json(term, fitted.fit, 1.0)["parameters"]
                | {
                    key.name: interval_to_json(value, 0.0, law.parameter(key.name).unit)
                    for key, value in term.constants.items()
                    if isinstance(key, EffectKey)
                },
                "range": {name: [low, high] for name, low, high in law.valid_range},
            }
            for law, term in zip(proposal.laws, terms, strict=True)
        ],
        "with_effects": [*proposal.start.names],
        "base": base_to_json(fitted),
        "law_class": proposal.law_class,
        "held_out_before": factor * math.sqrt(proposal.start.cost),
        "held_out_after": factor * math.sqrt(fitted.cost),
        "noise_floor": factor * math.sqrt(proposal.floor),
        "closed_fraction": proposal.closed_share,
        "sufficient": proposal.is_sufficient,
        "nearest": proposal.nearest,
        "classes": [
            {
                "law_class": name,
                "id": best.names[-1],
                "held_out_error": factor * math.sqrt(best.cost),
            }
            for name, best in proposal.by_class
        ],
    }


def _quote_toml(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
