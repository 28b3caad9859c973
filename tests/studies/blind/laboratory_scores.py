"""Scores of verdicts in an imperfect laboratory. No I/O.

Everything that a verdict names is one of

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

from twin.discovery.parameters import GAP_PREFIX

Json = dict[str, Any]
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


def score_laboratory(row: Json, verdict: Json, about: Json) -> Json:
    """Return what the row of a case in a laboratory has in addition; `row` by `score_verdict`."""
    laboratory, gap = about["laboratory"], verdict.get("gap") or {}
    is_named = row["said"] == "named"
    effects = {_effect_name(effect): effect for effect in verdict.get("effects", [])}
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


def _effect_name(effect: Mapping[str, Any]) -> str:
    channel = effect.get("channel")
    return f"{effect['id']}.{channel}" if channel and "." not in effect["id"] else effect["id"]


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


def _score_estimate(name: str, estimate: Mapping[str, Any], true: float, scale: float) -> Json:
    low, high = estimate.get("low"), estimate.get("high")
    return {
        "name": name,
        "error": abs(estimate["value"] - true) / abs(scale) if scale else math.inf,
        "covered": None if low is None or high is None else bool(low <= true <= high),
    }


def score_identification(identified: Json, about: Json) -> Json:
    """Return the row of an identification: error and coverage of each parameter."""
    true = about["base"]
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
    return {
        "estimates": rows,
        "right": bool(rows) and all(row["error"] <= 0.01 for row in rows),
        "rms_over_noise": identified.get("rms_over_noise"),
        "warnings": len(identified.get("warnings", ())),
    }
