"""What was learned as `verdict.json` and as a model card."""

import math
from collections.abc import Sequence
from typing import Any

from twin.learn.discover import Discovery
from twin.learn.fit import Fit
from twin.learn.guess import GAP, SENSOR, SLIP, ZERO, Free, log_of
from twin.learn.library import Candidate
from twin.learn.naming import Explained
from twin.learn.verdict import closed_fraction, next_run
from twin.model.effects import find_effect
from twin.model.model import CHANNELS

Json = dict[str, Any]
LEAST_GAP_M = 1e-6  # by which a gap may be off without a word
METRIC = (
    "rms of measured minus model forces along the measured motion, over the noise of the sensors, "
    "on steps that were not fitted"
)
STOPPED = "stopped before the end: not everything was tried, so other names may do better"
REFITTED = ", with other parameters than the model has: see the notes"
SURE = 1.96  # standard deviations either side: 95 %


def verdict_json(found: Discovery, seconds: float = 0.0, notes: Sequence[str] = ()) -> Json:
    """The keys of the contract, and what more there is to say."""
    v, named = found.verdict, found.named
    best, null = v.best, named.null
    where = found.where
    names, others = best.names, [one.names for one in v.others]
    return {
        "verdict": v.word,
        "why": _why(found),
        "effects": [effect_json(one, best.fit, v.confidence) for one in best.effects],
        "ambiguous": [[*names], *([*one] for one in others)] if others else [],
        "candidates": candidates_json(named.null, (*named.tried, *named.outside)),
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
            "noise_floor": math.sqrt(v.floor),
            "held_out_before": math.sqrt(null.cost),
            "held_out_after": math.sqrt(best.cost),
            "closed_fraction": closed_fraction(null.cost, best.cost, v.floor),
        },
        "remainder": {
            "unexplained": v.remainder,
            "evidence": evidence(v.general),
        },
        "base": base_json(best),
        "fell_away": dict(found.prepared.away),
        "notes": [
            *notes,
            *found.notes,
            *suspicious(best),
            *([] if named.whole else [STOPPED]),
        ],
        "next_run": next_run(v.word, names, others),
        "seconds": seconds,
    }


def effect_json(one: Candidate, fit: Fit, confidence: float) -> Json:
    """An effect with its parameters, each with its 95 % interval."""
    return {
        "id": one.effect.id if one.effect else one.name,
        **({"channel": one.channel} if one.channel else {}),
        "confidence": confidence,
        "parameters": {
            free.name.rsplit(".", 1)[1]: number(fit, free.name, free.unit)
            for free in one.free
            if "." in free.name
        },
        **({"slip_speed": number(fit, SLIP, "m/s")} if one.name == "coulomb_friction" else {}),
    }


def number(fit: Fit, name: str, unit: str) -> Json:
    """A fitted number with its 95 % interval."""
    value, sd = fit.values[name], fit.spread[name]
    return {"value": value, "low": value - SURE * sd, "high": value + SURE * sd, "unit": unit}


def base_json(one: Explained) -> Json:
    """The model's own parameters, refitted, and by how much the gaps of each log are off."""
    fit = one.fit
    return {free.name: number(fit, free.name, free.unit) for free in _own(one)}


def _own(one: Explained) -> list[Free]:
    """What was fitted beside the effects that were found, less zeros and gains of the input."""
    added = {free.name for effect in one.effects for free in effect.free}
    return [
        free
        for free in one.fit.free
        if free.name not in added and not free.name.startswith((ZERO, SENSOR))
    ]


def suspicious(one: Explained) -> list[str]:
    """What speaks against a fit: numbers at their bounds, effects of the model that vanish."""
    fit, notes = one.fit, []
    stuck = [name for name in fit.at_bound if not name.startswith((ZERO, SLIP))]
    notes += [
        f"{name} = {fit.values[name]:.4g} stands at its bound: do not trust it" for name in stuck
    ]
    for free in _own(one):
        identity, _, parameter = free.name.rpartition(".")
        if not identity:
            continue
        vanishing = next(
            p for p in find_effect(identity).parameters if p.name == parameter
        ).vanishing
        off = math.inf if vanishing is None else abs(fit.values[free.name] - vanishing)
        if off < SURE * fit.spread[free.name]:
            notes.append(f"{identity} of the model vanishes in these recordings; leave it out")
    return notes


def _why(found: Discovery) -> str:
    """The reason of the verdict; that a model only agrees with other numbers is no agreement."""
    other = found.verdict.word == "none" and found.notes
    return f"{found.verdict.why}{REFITTED if other else ''}"


def candidates_json(null: Explained, tried: Sequence[Explained]) -> list[Json]:
    """Every set that was refitted, the best first."""
    best: dict[frozenset[str], Explained] = {}
    for one in (null, *tried):
        key = frozenset(one.names)
        if key not in best or one.cost < best[key].cost:
            best[key] = one
    return [
        {
            "id": " + ".join(one.names) or "nothing added",
            "held_out_error": math.sqrt(one.cost),
            "converged": one.fit.converged,
            **({"at_bound": list(one.fit.at_bound)} if one.fit.at_bound else {}),
        }
        for one in sorted(best.values(), key=lambda one: one.cost)
    ]


def evidence(general: Explained | None) -> Json | None:
    """The general term that does better than any name, and its size."""
    if general is None:
        return None
    term = general.effects[-1]
    return {
        "term": term.name.split(".", 1)[1],
        "meaning": "u, v, d over the largest measured, w in parts of those (resonator: Hz)",
        "held_out_error": math.sqrt(general.cost),
        "parameters": {
            free.name.rsplit(".", 1)[1]: number(general.fit, free.name, free.unit)
            for free in term.free
        },
    }


def model_toml(fit: Fit, title: str, citation: str, fitted_on: str) -> tuple[str, list[str]]:
    """(a model card, what it could not take): gaps belong to the specimen of each test."""
    flat = fit.guess.model().flat()
    lines = [
        f"title = {_text(title)}",
        f"citation = {_text(citation)}",
        f"fitted_on = {_text(fitted_on)}",
        "[base]",
        f"stiffness_n_m = {flat['stiffness']!r}",
        f"damping_n_s_m = {flat['damping']!r}",
        f"bumper_stiffness_n_m = {flat['bumper_stiffness_r']!r}",
        f"bumper_damping_n_s_m = {flat['bumper_damping_r']!r}",
    ]
    left_out = []
    effects: dict[str, dict[str, float]] = {}
    for name, value in fit.guess.values.items():
        if "." in name and not name.startswith(("general.", ZERO)):
            effect, parameter = name.rsplit(".", 1)
            effects.setdefault(effect, {})[parameter] = value
    for effect, values in effects.items():
        identity, _, channel = effect.partition(".")
        if channel and channel not in CHANNELS:
            left_out.append(
                f"{effect}: the twin is driven by this channel and does not predict it; mend or "
                "calibrate the sensor"
            )
            continue
        numbers = [f"{key} = {value!r}" for key, value in values.items()]
        numbers += [f"channel = {_text(channel)}"] if channel else []
        lines += [
            "[[effects]]",
            f"id = {_text(identity)}",
            f"parameters = {{ {', '.join(numbers)} }}",
        ]
    lines += ["[intervals]  # 95 %"]
    for name in fit.values:
        known = fit.spread.get(name, 0.0) > 0 and not name.startswith((ZERO, "general."))
        if known and log_of(name) is None:
            low, high = (number(fit, name, "")[key] for key in ("low", "high"))
            lines.append(f"{_text(name)} = [{low!r}, {high!r}]")
    gaps = {k: v for k, v in fit.values.items() if k.startswith(GAP) and log_of(k) is not None}
    if any(abs(v) > max(SURE * fit.spread[k], LEAST_GAP_M) for k, v in gaps.items()):
        told = ", ".join(f"{1e3 * v:+.3f} mm" for v in gaps.values())
        left_out.append(f"gaps stand in the test profile: each side is {told} off what it says")
    return "\n".join(lines) + "\n", left_out


def _text(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ")
    return f'"{escaped}"'
