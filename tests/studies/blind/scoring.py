"""Scores of verdicts against the sealed truth: from verdict.json and about.json to a row. No I/O.

A verdict is right about an effect if it names its id, and for a sensor effect its channel.

In an imperfect laboratory everything that a verdict names is one of

    effect        hidden in the specimen, or a planted error of a sensor
    instrument    a true instrument finding: an error of a sensor or of the set-up that the
                  laboratory has, of the true kind, on the true channel, and of the true size. The
                  size is true if it is within the stated interval, or within a factor of two of the
                  error measured on a noise-free recording (`laboratory_truth`)
    false         an error of a sensor or of the set-up that the laboratory does not have, or of
                  another sign or size
    physics       an effect of the specimen that is not there

A verdict is healthy if it is `none`, or names true instrument findings only. What it lists without
naming it (`unexplained`) is no finding. In a typical laboratory, whose instruments are sound, it
must not call them to be mended either; in a bad one that is a finding on the channels it states.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from tests.studies.blind.metrics import MAX_PARAMETER_ERROR
from twin.discovery.parameters import GAP_PREFIX

Json = dict[str, Any]
UNNAMED_CANDIDATES = ("nothing", "general")  # candidates: base model alone, generic term
SET_SEPARATOR = " + "  # between the names of a candidate with several effects
# Forms of the simulated machine with the same law as the library: only these can be fitted exactly.
LIBRARY_FORMS = frozenset({
    "ode", "stiffness", "shift", "linear", "sine", "mass", "gain", "delay", "after_tare",
})  # fmt: skip
SIZE_RATIO = 2.0  # of an instrument error named to the true one, either way
VANISHING = {"gain": 1.0, "ratio": 1.0}  # values of parameters without an error; others: 0
# Parameters in about.json, by their names in a verdict.
BASE_KEYS = {
    "stiffness": "damper_stiffness_n_m",
    "damping": "damper_damping_n_s_m",
    "bumper_stiffness": "bumper_stiffness_n_m",
    "bumper_damping": "bumper_damping_n_s_m",
}
GAP_KEYS = {"right": "gap_right_m", "left": "gap_left_m"}
CASE_KEYS = ("number", "cell", "kind", "noise", "size", "reached", "ended", "sized")


def select_case_facts(about: Json) -> Json:
    """Return what a row says of its case, whatever is judged."""
    return {key: about[key] for key in CASE_KEYS}


def format_effect_name(effect: Mapping[str, Any]) -> str:
    """Return `id` or `id.channel` of an effect; the channel may be a field or a parameter."""
    name, channel = str(effect["id"]), effect.get("channel")
    if channel is None:
        channel = effect.get("parameters", {}).get("channel")
    if isinstance(channel, Mapping):
        channel = channel.get("value")
    return f"{name}.{channel}" if channel and "." not in name else name


def score_verdict(verdict: Json, about: Json, oracle: float | None = None) -> Json:
    """Return the row of a case: truth, verdict, and the quantities that the metrics count.

    A quantity that does not apply to the case is None. `oracle` is the held-out error of the true
    structure with fitted parameters.
    """
    word, truth = verdict["verdict"], [effect["name"] for effect in about["effects"]]
    named, gap = _select_named(verdict), verdict.get("gap") or {}
    row = select_case_facts(about) | {
        "truth": truth, "said": word, "named": named,
        "ambiguous": verdict.get("ambiguous", []),
        "confidence": _top_confidence(verdict), "seconds": verdict.get("seconds"),
    }  # fmt: skip
    kind = about["kind"]
    match kind:
        case "none":
            row["false_alarm"] = word != "none"
            row["right"] = not row["false_alarm"]
        case "unknown":
            row |= {"unexplained": word == "unexplained", "wrong_name": word == "named"}
            row["right"] = row["unexplained"]
        case "pair":
            hits = {*truth} & {*named}
            row |= {"both": hits == {*truth}, "one": bool(hits), "extra": not {*named} <= {*truth}}
            row["right"] = row["both"]
        case _:  # top1: named first; exact: named alone; two: among the first two
            row["top1"] = row["right"] = word == "named" and named[:1] == truth
            row["exact"] = word == "named" and named == truth
            row["two"] = truth[0] in _select_two(word, named, verdict)
    row["region"] = _is_region_right(verdict, about) if kind in ("single", "unknown") else None
    row |= _score_gap(gap, oracle)
    row["parameters"] = _score_parameters(verdict, about) if row["right"] and truth else []
    return row | {"held_out": gap.get("held_out_after")}


def _select_named(verdict: Json) -> list[str]:
    """Return the effects named by a verdict; of an ambiguous one those common to all its sets."""
    if verdict["verdict"] == "ambiguous":
        first, *other_sets = verdict.get("ambiguous") or [[]]
        return [
            name
            for name in first
            if other_sets and all(name in effect_set for effect_set in other_sets)
        ]
    if verdict["verdict"] in ("named", "unexplained"):
        return [format_effect_name(effect) for effect in verdict.get("effects", [])]
    return []


def _select_two(word: str, named: list[str], verdict: Json) -> list[str]:
    """Return the first two effects of a verdict.

    Named: the named ones, followed by the best other candidates on held-out data.
    Ambiguous: the first two that the verdict cannot separate.
    """
    names: list[str] = []
    if word == "ambiguous":
        names = [str(name) for effect_set in verdict.get("ambiguous", []) for name in effect_set]
    elif word == "named":
        candidates = [
            candidate for candidate in verdict.get("candidates", [])
            if candidate.get("converged", True) and candidate.get("held_out_error") is not None
        ]  # fmt: skip
        candidates = sorted(candidates, key=lambda candidate: float(candidate["held_out_error"]))
        single = [
            name
            for name in map(format_effect_name, candidates)
            if not name.startswith(UNNAMED_CANDIDATES)
        ]
        names = [*named, *(name for name in single if SET_SEPARATOR not in name)]
    return list(dict.fromkeys(names))[:2]


def _top_confidence(verdict: Json) -> float | None:
    """Return the confidence of the effect named first; None if no effect is named."""
    effects = verdict.get("effects") or []
    return float(effects[0]["confidence"]) if verdict["verdict"] == "named" and effects else None


def _is_region_right(verdict: Json, about: Json) -> bool | None:
    """Return whether band and phase overlap those of the true residual.

    "all" is right only if the residual is prominent in flight and in contact.
    """
    where, true = verdict.get("where") or {}, about["region"]
    if verdict["verdict"] == "none" or not where.get("frequency_hz") or not true:
        return False
    (low, high), (a, b) = where["frequency_hz"], true["frequency_hz"]
    phases = set(true["phase"])
    sides = {"contact_right", "contact_left"}
    allowed = {*phases} | ({"contact_both"} if sides <= phases else set())
    if "flight" in phases and phases & sides:
        allowed.add("all")
    return bool(low <= b and a <= high and where["phase"] in allowed)


def _score_gap(gap: Json, oracle: float | None) -> Json:
    """Return after / floor, after / oracle and the closed share of the gap, on held-out data."""
    before, after = gap.get("held_out_before"), gap.get("held_out_after")
    floor = gap.get("noise_floor")
    nothing = {"after_floor": None, "after_oracle": None, "closed": None}
    if before is None or after is None or not floor:
        return nothing
    closed = (before - after) / (before - floor) if before > floor else None
    return {
        "after_floor": after / floor,
        "after_oracle": after / oracle if oracle else None,
        "closed": closed,
    }


def _score_parameters(verdict: Json, about: Json) -> list[Json]:
    """Return relative error and interval coverage of each true parameter given by the verdict.

    Errors are relative to the distance between the true value and the vanishing value.
    """
    estimates_by_effect = {
        format_effect_name(entry): entry.get("parameters", {}) for entry in verdict["effects"]
    }
    errors = []
    for effect in about["effects"]:
        for name, true in effect["parameters"].items():
            estimate = estimates_by_effect.get(effect["name"], {}).get(name)
            if not isinstance(estimate, Mapping) or estimate.get("value") is None:
                continue
            scale = true - (effect["vanishing"].get(name) or 0.0)
            score = _score_estimate(f"{effect['name']}.{name}", estimate, true, scale)
            errors.append(score | {"alike": effect.get("form") in LIBRARY_FORMS})
    return errors


def _score_estimate(name: str, estimate: Mapping[str, Any], true: float, scale: float) -> Json:
    """Return the error of an estimate relative to a scale, and whether its interval holds."""
    low, high = estimate.get("low"), estimate.get("high")
    return {
        "name": name,
        "error": abs(estimate["value"] - true) / abs(scale) if scale else math.inf,
        "covered": None if low is None or high is None else bool(low <= true <= high),
    }


def select_worst_misses(rows: Sequence[Json], count: int = 30) -> list[Json]:
    """Return the worst misses: highest confidence first, then the largest effect."""
    missed = [row for row in rows if not row["right"]]
    return sorted(
        missed, key=lambda row: (-(row["confidence"] or 0.0), -row["size"], row["noise"])
    )[:count]


def score_laboratory(row: Json, verdict: Json, about: Json) -> Json:
    """Return what the row of a case in a laboratory has in addition; `row` by `score_verdict`."""
    laboratory, gap = about["laboratory"], verdict.get("gap") or {}
    is_named = row["said"] == "named"
    effects = {format_effect_name(effect): effect for effect in verdict.get("effects", [])}
    findings = [
        {"name": name, "class": classify_finding(name, effects.get(name, {}), about)}
        for name in (row["named"] if row["said"] in ("named", "ambiguous") else [])
    ]
    classes = [finding["class"] for finding in findings]
    named_classes = classes if is_named else []
    affected = {
        name for name in row["named"] if is_named and _channel(name) in laboratory["channels"]
    }
    faults = [
        check for check in verdict.get("sensors", {}).get("checks", ()) if not check["healthy"]
    ]
    is_sound = row["said"] == "none" or (is_named and all(c == "instrument" for c in classes))
    is_on_channel = "instrument" in named_classes or _is_on_channel(faults, laboratory)
    scores: Json = {
        "healthy": is_sound and not (faults and laboratory["level"] == "typical"),
        "instrument": "instrument" in named_classes,
        "on_channel": bool(affected) or is_on_channel,
        "sensor_faults": [f"{check['kind']}.{','.join(check['channels'])}" for check in faults],
        "physics": "physics" in named_classes,
        "wrong_name": bool({"physics", "false"} & {*named_classes}),
        "hit": is_named and {*row["truth"]} <= {*row["named"]},
    }
    return {
        "laboratory": laboratory["level"],
        "imperfection": laboratory["imperfection"],
        "imperfection_size": laboratory["size"],
        "findings": findings,
        **scores,
        "right": _is_right(row, laboratory["level"], scores),
        "base": score_base(verdict.get("base", {}), about["base"]),
        "before": gap.get("held_out_before"), "after": gap.get("held_out_after"),
        "why": verdict.get("why", verdict.get("reason", "")),
    }  # fmt: skip


def _is_on_channel(faults: Sequence[Json], laboratory: Json) -> bool:
    """Return whether the instruments called to be mended are those that err."""
    wrong_gaps = "gap_offset" in laboratory["errors"]
    return any(
        {*check["channels"]} & {*laboratory["channels"]} or (check["kind"] == "gap" and wrong_gaps)
        for check in faults
    )


def _is_right(row: Json, level: str, scores: Json) -> bool:
    """Return whether the case is a hit: for the table of misses."""
    match row["kind"]:
        case "none" if level == "bad":
            return bool(scores["on_channel"] and not scores["physics"])
        case "none":
            return bool(scores["healthy"])
        case "unknown":
            return bool(row["unexplained"])
        case _:
            return bool(scores["hit"] and not scores["wrong_name"])


def classify_finding(name: str, effect: Mapping[str, Any], about: Json) -> str:
    """Return the class of a named effect, see the module."""
    if name in [hidden["name"] for hidden in about["effects"]]:
        return "effect"
    true = about["laboratory"]["errors"].get(name)
    if true is None:
        return "false" if _is_instrument_error(name) else "physics"
    estimates = effect.get("parameters", {})
    agrees = any(
        _agrees(estimates[key], value, VANISHING.get(key, 0.0))
        for key, values in true.items()
        if isinstance(estimates.get(key), Mapping)
        for value in values
    )
    return "instrument" if agrees else "false"


def _agrees(estimate: Mapping[str, Any], true: float, vanishing: float) -> bool:
    """Return whether a named error is the true one: in the interval, or of about its size."""
    low, high = estimate.get("low"), estimate.get("high")
    error, true_error = estimate["value"] - vanishing, true - vanishing
    is_like = true_error * error > 0 and 1 / SIZE_RATIO <= error / true_error <= SIZE_RATIO
    is_inside = low is not None and high is not None and low <= true <= high
    return bool(is_like or is_inside)


def _is_instrument_error(name: str) -> bool:
    return name.startswith("sensor_") or name in ("gap_offset", "mass_error", "table_tilt")


def _channel(name: str) -> str:
    return name.partition(".")[2]


def score_base(estimates: Mapping[str, Any], true_base: Mapping[str, float]) -> list[Json]:
    """Return relative error and interval coverage of each base parameter of a verdict.

    The gap is that of a side, averaged over both: a verdict states its correction.
    """
    rows = []
    for name, key in BASE_KEYS.items():
        if name in estimates:
            rows.append(_score_estimate(name, estimates[name], true_base[key], true_base[key]))
    for name, estimate in estimates.items():
        if name.startswith(GAP_PREFIX):
            true_gap = 0.5 * sum(true_base[key] for key in GAP_KEYS.values())
            stated = true_base["stated_gap_m"]
            rows.append(_score_estimate("gap", estimate, true_gap - stated, true_gap))
    return rows


def score_identification(identified: Json, about: Json) -> Json:
    """Return the row of an identification: error and coverage of each parameter."""
    laboratory, true = about["laboratory"], about["base"]
    gaps = {side: true[key] for side, key in GAP_KEYS.items()}
    estimates = identified.get("parameters", {})  # none where it failed
    rows = [
        _score_estimate(name, estimates[name], true[key], true[key])
        for name, key in BASE_KEYS.items()
        if name in estimates
    ]
    for name, value in (("gap", sum(gaps.values())), *((f"gap_{k}", v) for k, v in gaps.items())):
        if name in estimates:
            rows.append(_score_estimate(name, estimates[name], value, value))
    return select_case_facts(about) | {
        "laboratory": laboratory["level"],
        "imperfection": laboratory["imperfection"],
        "truth": [],
        "named": [],
        "said": identified["verdict"],
        "confidence": None,
        "estimates": rows,
        "right": bool(rows) and all(row["error"] <= MAX_PARAMETER_ERROR for row in rows),
        "rms_over_noise": identified.get("rms_over_noise"),
        "warnings": len(identified.get("warnings", ())),
    }
