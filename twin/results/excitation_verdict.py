"""The verdict on the excitation of a run, said once: did the table play the test?

A stepped sine is reached if the fundamental of the table acceleration is within the profile's
`protection.alarm` of the demanded level at every step; a record if its peak is within
`tracking.required_lower` to `required_upper` of the target's, its rms error is small enough, and a
required spectrum is met.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any

from table_io.config.profile import Profile

Json = dict[str, Any]
# Of the rms of the target's acceleration, in the band that is judged: beyond it the table has
# played another record, whatever its peak.
MAX_RECORD_ERROR = 0.3


def judge_excitation(summary: Mapping[str, Any], profile: Profile) -> Json:
    """Return the entry `excitation_verdict` of a summary, from its other entries."""
    if (summary.get("run") or {}).get("source") == "model":
        return _state("not judged", "no table was driven")
    if summary.get("tracking"):
        return _judge_record(summary["tracking"], profile)
    known = list_level_errors(summary["steps"])
    if not known:
        return _state("not judged", "the level of no step is known")
    tolerance = profile.protection.alarm
    error, step = max(known, key=lambda entry: abs(entry[0]))
    outside = sum(abs(error) > tolerance for error, _ in known)
    place = f"{100 * error:+.2g} % at {step['frequency_hz']:g} Hz {step['direction']}"
    reason = f"level within {100 * tolerance:g} % at every step, worst {place}"
    if outside:
        reason = f"level off by more than {100 * tolerance:g} % at {outside} of {len(known)} steps"
        reason += f", worst {place}"
    return _state("missed" if outside else "reached", reason, outside, error)


def list_level_errors(steps: Iterable[Json]) -> list[tuple[float, Json]]:
    """Return the relative error of the level with each step of a summary where it is known."""
    errors = [
        (step["table_acc_fundamental_m_s2"] / step["demanded_m_s2"] - 1.0, step)
        for step in steps
        if step.get("demanded_m_s2") and step.get("table_acc_fundamental_m_s2") is not None
    ]
    return [(error, step) for error, step in errors if math.isfinite(error)]


def _judge_record(tracking: Mapping[str, Any], profile: Profile) -> Json:
    """Return the verdict on a record from its tracking error."""
    peak, error = tracking["pga_ratio_band"], tracking["acc_rms_error_band"]
    if peak is None or error is None or not math.isfinite(peak + error):
        return _state("not judged", "samples of the acceleration of the table are missing")
    low, high = profile.tracking.required_lower, profile.tracking.required_upper
    required = tracking["required_spectrum"]
    faults = []
    if not low <= peak <= high:
        allowed = f"{100 * low:g} to {100 * high:g} %"
        faults.append(f"PGA {100 * peak:.0f} % of the target, allowed {allowed}")
    if error > MAX_RECORD_ERROR:
        allowed = f"{100 * MAX_RECORD_ERROR:g} %"
        faults.append(f"acceleration {100 * error:.3g} % RMS off its target, allowed {allowed}")
    if required is not None and required["outside"]:
        faults.append(f"required spectrum missed at {required['outside']} ordinates")
    text = f"PGA {100 * peak:.0f} % of the target, acceleration {100 * error:.2g} % RMS off it"
    return _state("missed" if faults else "reached", ", ".join(faults) or text, len(faults), error)


def _state(verdict: str, reason: str, outside: int = 0, error: float | None = None) -> Json:
    return {"verdict": verdict, "reason": reason, "outside": outside, "worst_error": error}


def format_excitation_verdict(verdict: Mapping[str, Any]) -> str:
    """Return the line of a verdict for the console."""
    return f"excitation {verdict['verdict']}: {verdict['reason']}"
