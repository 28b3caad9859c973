"""One verdict against the sealed truth: pure, from verdict.json and about.json to a row.

A verdict is right about an effect when it names its id, and its channel where it is a sensor's.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

Json = dict[str, Any]
NO_NAME = ("nothing", "general")  # candidates that are the base alone, or a term without a name
SET = " + "  # between the names of a candidate that is several effects
# Forms of the simulated machine that are the library's own law: there a truth can be met exactly.
ALIKE = frozenset({
    "ode", "stiffness", "shift", "linear", "sine", "mass", "gain", "delay", "after_tare",
})  # fmt: skip


def name_of(effect: Mapping[str, Any]) -> str:
    """`id` or `id.channel` of an entry of a verdict's effects, however it gives the channel."""
    name, channel = str(effect["id"]), effect.get("channel")
    if channel is None:
        channel = effect.get("parameters", {}).get("channel")
    if isinstance(channel, Mapping):
        channel = channel.get("value")
    return f"{name}.{channel}" if channel and "." not in name else name


def score(verdict: Json, about: Json, oracle: float | None = None) -> Json:
    """The row of a case: what was hidden, what was said, and each figure of the study.

    A figure that this case says nothing about is None. `oracle` is the held-out error of the true
    structure with fitted parameters.
    """
    told, truth = verdict["verdict"], [one["name"] for one in about["effects"]]
    named = _named(verdict)
    row: Json = {
        "number": about["number"], "cell": about["cell"], "kind": about["kind"],
        "truth": truth, "noise": about["noise"], "size": about["size"],
        "reached": about["reached"], "ended": about["ended"],
        "sized": about["sized"], "said": told, "named": named,
        "ambiguous": verdict.get("ambiguous", []),
        "confidence": _confidence(verdict), "seconds": verdict.get("seconds"),
    }  # fmt: skip
    row |= _KINDS[about["kind"]](told, named, truth, verdict)
    row["right"] = _right(row)
    row["region"] = _region(verdict, about) if about["kind"] in ("single", "unknown") else None
    row |= _gap(verdict.get("gap") or {}, oracle)
    row["parameters"] = _parameters(verdict, about) if row["right"] and truth else []
    return row


def _single(told: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    """`top1`: named, and it comes first; `exact`: and nothing beside it; `two`: among two."""
    top1 = told == "named" and named[:1] == truth
    return {
        "top1": top1,
        "exact": told == "named" and named == truth,
        "two": truth[0] in _two(told, named, verdict),
    }


def _named(verdict: Json) -> list[str]:
    """The effects that a verdict stands by; of an ambiguous one those that all its sets have."""
    if verdict["verdict"] == "ambiguous":
        first, *others = verdict.get("ambiguous") or [[]]
        return [name for name in first if others and all(name in one for one in others)]
    if verdict["verdict"] in ("named", "unexplained"):
        return [name_of(one) for one in verdict.get("effects", [])]
    return []


def _two(told: str, named: list[str], verdict: Json) -> list[str]:
    """The two effects that a verdict comes down to.

    Named: those named, and with one alone the candidate that is next best on held-out data.
    Ambiguous: the first two that it cannot separate.
    """
    found: list[str] = []
    if told == "ambiguous":
        found = [str(name) for some in verdict.get("ambiguous", []) for name in some]
    elif told == "named":
        tried = [
            one for one in verdict.get("candidates", [])
            if one.get("converged", True) and one.get("held_out_error") is not None
        ]  # fmt: skip
        tried = sorted(tried, key=lambda one: float(one["held_out_error"]))
        single = [name for name in map(name_of, tried) if not name.startswith(NO_NAME)]
        found = [*named, *(name for name in single if SET not in name)]
    return list(dict.fromkeys(found))[:2]


def _none(told: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    return {"false_alarm": told != "none"}


def _unknown(told: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    return {"unexplained": told == "unexplained", "wrong_name": told == "named"}


def _pair(told: str, named: list[str], truth: list[str], verdict: Json) -> Json:
    found = set(truth) & set(named)
    return {"both": len(found) == len(truth), "one": bool(found), "extra": not {*named} <= {*truth}}


_KINDS = {"single": _single, "sensor": _single, "none": _none, "unknown": _unknown, "pair": _pair}


def _right(row: Json) -> bool:
    """Whether the case is a hit, for the confusion and the worst misses."""
    key = {"none": "false_alarm", "unknown": "unexplained", "pair": "both"}.get(row["kind"], "top1")
    return bool(row[key]) != (key == "false_alarm")


def _confidence(verdict: Json) -> float | None:
    """Of the effect that is named first; None where none is."""
    effects = verdict.get("effects") or []
    return float(effects[0]["confidence"]) if verdict["verdict"] == "named" and effects else None


def _region(verdict: Json, about: Json) -> bool | None:
    """Whether band and phase overlap those of the true residual; None where nothing is claimed.

    "all" is right only where the residual stands out in flight and in contact.
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


def _gap(gap: Json, oracle: float | None) -> Json:
    """after / floor, after / oracle and the share of the gap that is closed, on held-out data."""
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


def _parameters(verdict: Json, about: Json) -> list[Json]:
    """Of each true parameter that a verdict gives: relative error, and whether its interval covers.

    Errors are relative to how far a parameter is from where its effect vanishes.
    """
    given = {name_of(one): one.get("parameters", {}) for one in verdict["effects"]}
    found = []
    for effect in about["effects"]:
        for name, true in effect["parameters"].items():
            told = given.get(effect["name"], {}).get(name)
            if not isinstance(told, Mapping) or told.get("value") is None:
                continue
            scale = abs(true - (effect["vanishing"].get(name) or 0.0))
            found.append({
                "name": f"{effect['name']}.{name}",
                "error": abs(told["value"] - true) / scale if scale else math.inf,
                "covered": _covers(told, true),
                "alike": effect.get("form") in ALIKE,
            })  # fmt: skip
    return found


def _covers(told: Mapping[str, Any], true: float) -> bool | None:
    low, high = told.get("low"), told.get("high")
    return None if low is None or high is None else bool(low <= true <= high)


def worst(rows: Sequence[Json], count: int = 30) -> list[Json]:
    """The misses that weigh most: said with most confidence, then with the largest effect."""
    missed = [one for one in rows if not one["right"]]
    return sorted(
        missed, key=lambda one: (-(one["confidence"] or 0.0), -one["size"], one["noise"])
    )[:count]
