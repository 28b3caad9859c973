"""Score of a verdict against the sealed truth: from verdict.json and about.json to a row. No I/O.

A verdict is right about an effect if it names its id, and for a sensor effect its channel.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

Json = dict[str, Any]
UNNAMED_CANDIDATES = (
    "nothing",
    "general",
)  # candidates: base model alone, generic term
SET_SEPARATOR = " + "  # between the names of a candidate with several effects
# Forms of the simulated machine with the same law as the library: only these can be fitted exactly.
LIBRARY_FORMS = frozenset({
    "ode", "stiffness", "shift", "linear", "sine", "mass", "gain", "delay", "after_tare",
})  # fmt: skip


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
    named = _select_named(verdict)
    row: Json = {
        "number": about["number"], "cell": about["cell"], "kind": about["kind"],
        "truth": truth, "noise": about["noise"], "size": about["size"],
        "reached": about["reached"], "ended": about["ended"],
        "sized": about["sized"], "said": word, "named": named,
        "ambiguous": verdict.get("ambiguous", []),
        "confidence": _top_confidence(verdict), "seconds": verdict.get("seconds"),
    }  # fmt: skip
    row |= _SCORERS[about["kind"]](word, named, truth, verdict)
    row["right"] = _is_right(row)
    row["region"] = (
        _is_region_right(verdict, about) if about["kind"] in ("single", "unknown") else None
    )
    row |= _score_gap(verdict.get("gap") or {}, oracle)
    row["parameters"] = _score_parameters(verdict, about) if row["right"] and truth else []
    return row


def _score_single(word: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    """Score a single effect: `top1` named first, `exact` named alone, `two` among the first two."""
    top1 = word == "named" and named[:1] == truth
    return {
        "top1": top1,
        "exact": word == "named" and named == truth,
        "two": truth[0] in _select_two(word, named, verdict),
    }


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


def _score_none(word: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    return {"false_alarm": word != "none"}


def _score_unknown(word: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    return {"unexplained": word == "unexplained", "wrong_name": word == "named"}


def _score_pair(word: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    hits = set(truth) & set(named)
    return {"both": len(hits) == len(truth), "one": bool(hits), "extra": not {*named} <= {*truth}}


_SCORERS = {
    "single": _score_single,
    "sensor": _score_single,
    "none": _score_none,
    "unknown": _score_unknown,
    "pair": _score_pair,
}


def _is_right(row: Json) -> bool:
    """Return whether the case is a hit, for the confusion matrix and the worst misses."""
    key = {"none": "false_alarm", "unknown": "unexplained", "pair": "both"}.get(row["kind"], "top1")
    return bool(row[key]) != (key == "false_alarm")


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
            scale = abs(true - (effect["vanishing"].get(name) or 0.0))
            errors.append({
                "name": f"{effect['name']}.{name}",
                "error": abs(estimate["value"] - true) / scale if scale else math.inf,
                "covered": _interval_covers(estimate, true),
                "alike": effect.get("form") in LIBRARY_FORMS,
            })  # fmt: skip
    return errors


def _interval_covers(estimate: Mapping[str, Any], true: float) -> bool | None:
    low, high = estimate.get("low"), estimate.get("high")
    return None if low is None or high is None else bool(low <= true <= high)


def select_worst_misses(rows: Sequence[Json], count: int = 30) -> list[Json]:
    """Return the worst misses: highest confidence first, then the largest effect."""
    missed = [row for row in rows if not row["right"]]
    return sorted(
        missed, key=lambda row: (-(row["confidence"] or 0.0), -row["size"], row["noise"])
    )[:count]
