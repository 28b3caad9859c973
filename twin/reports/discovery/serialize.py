"""Serialization of a verdict to `verdict.json` and of a fitted model to a model file."""

import math
from collections.abc import Sequence
from typing import Any

from twin.identification.candidates import Candidate
from twin.identification.discover import Discovery
from twin.identification.least_squares import FitResult
from twin.identification.parameters import (
    GAP_PREFIX,
    SENSOR_PREFIX,
    SLIP_SPEED,
    ZERO_PREFIX,
    FreeParameter,
    parse_log_number,
)
from twin.identification.selection import FittedSet
from twin.identification.verdict import closed_fraction, suggest_next_run
from twin.model.effects import find_effect
from twin.model.model import SENSOR_CHANNELS

Json = dict[str, Any]
MIN_GAP_ERROR_M = 1e-6  # smaller gap corrections are not reported
METRIC = (
    "rms of measured minus modelled forces on the measured motion, over the sensor noise, on "
    "held-out steps"
)
STOPPED_NOTE = "stopped early: not every effect was tested, so other effects may fit better"
REFITTED_SUFFIX = ", but with other parameters than the model has: see the notes"
INTERVAL_SIGMA = 1.96  # standard deviations either side: 95 %


def verdict_to_json(discovery: Discovery, seconds: float = 0.0, notes: Sequence[str] = ()) -> Json:
    """Return the content of verdict.json: the keys of the documented format and further details."""
    verdict, selection = discovery.verdict, discovery.selection
    best, null = verdict.best, selection.null
    where = discovery.localization
    names, alternatives = best.names, [fitted.names for fitted in verdict.alternatives]
    return {
        "verdict": verdict.outcome,
        "why": _format_reason(discovery),
        "effects": [
            effect_to_json(effect, best.fit, verdict.confidence) for effect in best.effects
        ],
        "ambiguous": [[*names], *([*ids] for ids in alternatives)] if alternatives else [],
        "candidates": candidates_to_json(
            selection.null, (*selection.tried, *selection.generic_sets)
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
            "before": math.sqrt(null.fit.cost),
            "after": math.sqrt(best.fit.cost),
            "noise_floor": math.sqrt(verdict.floor),
            "held_out_before": math.sqrt(null.cost),
            "held_out_after": math.sqrt(best.cost),
            "closed_fraction": closed_fraction(null.cost, best.cost, verdict.floor),
        },
        "remainder": {
            "unexplained": verdict.has_remainder,
            "evidence": generic_term_to_json(verdict.generic),
        },
        "base": base_to_json(best),
        "fell_away": dict(discovery.prepared.excluded),
        "notes": [
            *notes,
            *discovery.notes,
            *find_suspicious_parameters(best),
            *([] if selection.complete else [STOPPED_NOTE]),
        ],
        "next_run": suggest_next_run(verdict.outcome, names, alternatives),
        "seconds": seconds,
    }


def effect_to_json(candidate: Candidate, fit: FitResult, confidence: float) -> Json:
    """Return an effect with its confidence and its parameters, each with its 95 % interval."""
    return {
        "id": candidate.effect.id if candidate.effect else candidate.name,
        **({"channel": candidate.channel} if candidate.channel else {}),
        "confidence": confidence,
        "parameters": {
            free.name.rsplit(".", 1)[1]: parameter_to_json(fit, free.name, free.unit)
            for free in candidate.free
            if "." in free.name
        },
        **(
            {"slip_speed": parameter_to_json(fit, SLIP_SPEED, "m/s")}
            if candidate.name == "coulomb_friction"
            else {}
        ),
    }


def parameter_to_json(fit: FitResult, name: str, unit: str) -> Json:
    """Return a fitted value with its 95 % interval and unit."""
    return interval_to_json(fit.values[name], fit.std_errors[name], unit)


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
    return {
        free.name: parameter_to_json(fit, free.name, free.unit) for free in _base_parameters(fitted)
    }


def _base_parameters(fitted: FittedSet) -> list[FreeParameter]:
    """Return the free parameters without added effects, tare errors and sensor corrections."""
    added = {free.name for effect in fitted.effects for free in effect.free}
    return [
        free
        for free in fitted.fit.free
        if free.name not in added and not free.name.startswith((ZERO_PREFIX, SENSOR_PREFIX))
    ]


def find_suspicious_parameters(fitted: FittedSet) -> list[str]:
    """Return notes on parameters at a bound and on effects of the model that vanish."""
    fit, notes = fitted.fit, []
    at_bound = [name for name in fit.at_bound if not name.startswith((ZERO_PREFIX, SLIP_SPEED))]
    notes += [
        f"{name} = {fit.values[name]:.4g} is at its bound: do not trust it" for name in at_bound
    ]
    for free in _base_parameters(fitted):
        identity, _, parameter = free.name.rpartition(".")
        if not identity:
            continue
        vanishing = next(
            p for p in find_effect(identity).parameters if p.name == parameter
        ).vanishing
        deviation = math.inf if vanishing is None else abs(fit.values[free.name] - vanishing)
        if deviation < INTERVAL_SIGMA * fit.std_errors[free.name]:
            notes.append(
                f"{identity} of the model vanishes in these recordings; remove it from the model"
            )
    return notes


def _format_reason(discovery: Discovery) -> str:
    """Return the reason of the verdict, and mention if agreement required other parameters."""
    has_notes = discovery.verdict.outcome == "none" and discovery.notes
    return f"{discovery.verdict.reason}{REFITTED_SUFFIX if has_notes else ''}"


def candidates_to_json(null: FittedSet, tried: Sequence[FittedSet]) -> list[Json]:
    """Return every refitted set with its cross-validation error, best first."""
    best: dict[frozenset[str], FittedSet] = {}
    for fitted in (null, *tried):
        key = frozenset(fitted.names)
        if key not in best or fitted.cost < best[key].cost:
            best[key] = fitted
    return [
        {
            "id": " + ".join(fitted.names) or "nothing added",
            "held_out_error": math.sqrt(fitted.cost),
            "converged": fitted.fit.converged,
            **({"at_bound": list(fitted.fit.at_bound)} if fitted.fit.at_bound else {}),
        }
        for fitted in sorted(best.values(), key=lambda fitted: fitted.cost)
    ]


def generic_term_to_json(general: FittedSet | None) -> Json | None:
    """Return the generic term that fits better than every library effect; None without one."""
    if general is None:
        return None
    term = general.effects[-1]
    return {
        "term": term.name.split(".", 1)[1],
        "meaning": "u, v, d relative to their largest measured values, w likewise (resonator: Hz)",
        "held_out_error": math.sqrt(general.cost),
        "parameters": {
            free.name.rsplit(".", 1)[1]: parameter_to_json(general.fit, free.name, free.unit)
            for free in term.free
        },
    }


def model_to_toml(
    fit: FitResult, title: str, citation: str, fitted_on: str
) -> tuple[str, list[str]]:
    """Return (text of a model file, notes on what it omits); gaps belong to the test profiles."""
    flat = fit.parameters.to_model().flatten()
    lines = [
        f"title = {_quote_toml(title)}",
        f"citation = {_quote_toml(citation)}",
        f"fitted_on = {_quote_toml(fitted_on)}",
        "[base]",
        f"stiffness_n_m = {flat['stiffness']!r}",
        f"damping_n_s_m = {flat['damping']!r}",
        f"bumper_stiffness_n_m = {flat['bumper_stiffness_r']!r}",
        f"bumper_damping_n_s_m = {flat['bumper_damping_r']!r}",
    ]
    omitted = []
    effects: dict[str, dict[str, float]] = {}
    for name, value in fit.parameters.values.items():
        if "." in name and not name.startswith(("general.", ZERO_PREFIX)):
            effect, parameter = name.rsplit(".", 1)
            effects.setdefault(effect, {})[parameter] = value
    for effect, values in effects.items():
        identity, _, channel = effect.partition(".")
        if channel and channel not in SENSOR_CHANNELS:
            omitted.append(
                f"{effect}: not in the model file, because the twin is driven by this channel and "
                "does not predict it; repair or calibrate the sensor"
            )
            continue
        numbers = [f"{key} = {value!r}" for key, value in values.items()]
        numbers += [f"channel = {_quote_toml(channel)}"] if channel else []
        lines += [
            "[[effects]]",
            f"id = {_quote_toml(identity)}",
            f"parameters = {{ {', '.join(numbers)} }}",
        ]
    lines += ["[intervals]  # 95 %"]
    for name in fit.values:
        is_reported = fit.std_errors.get(name, 0.0) > 0 and not name.startswith(
            (ZERO_PREFIX, "general.")
        )
        if is_reported and parse_log_number(name) is None:
            low, high = (parameter_to_json(fit, name, "")[key] for key in ("low", "high"))
            lines.append(f"{_quote_toml(name)} = [{low!r}, {high!r}]")
    gaps = {
        k: v
        for k, v in fit.values.items()
        if k.startswith(GAP_PREFIX) and parse_log_number(k) is not None
    }
    if any(
        abs(v) > max(INTERVAL_SIGMA * fit.std_errors[k], MIN_GAP_ERROR_M) for k, v in gaps.items()
    ):
        differences = ", ".join(f"{1e3 * v:+.3f} mm" for v in gaps.values())
        omitted.append(
            f"correct the gaps in the test profile of each log: each side differs by {differences}"
        )
    return "\n".join(lines) + "\n", omitted


def _quote_toml(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
