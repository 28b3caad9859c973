"""Merge the recordings of a run: each step comes from the last recording that measured it.

Each branch lists its recordings and its history: whether it was measured without interruption from
the beginning of its direction.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path

from table_io.config.profile import Profile
from twin.campaign.state import RunState
from twin.compare.curves import detect_hysteresis
from twin.results.excitation_verdict import judge_excitation, list_level_errors
from twin.results.summary import Json, prc_points
from twin.results.twin_verdict import judge_twin

NORMALIZED_BY_U_STAR, NORMALIZED_BY_A_STAR = (
    ("eta_d", "eta_r", "eta_l"),
    ("eta_a",),
)  # quantities divided by u* and by a*
SOURCES = ("measured", "twin")


def read_summary(folder: Path) -> Json:
    """Return the summary in a run's folder; empty if there is none yet."""
    try:
        return dict(json.loads((folder / "summary.json").read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def merge_summaries(run: RunState, profile: Profile, summaries: Sequence[Json]) -> Json:
    """Merge the summaries of a run's parts, in order, into one run summary."""
    steps: dict[int, Json] = {}
    for part, summary in zip(run.parts, summaries, strict=True):
        for step in summary.get("steps") or ():
            steps[step["index"]] = {**step, "part": part.folder}
    # Recordings of older versions do not state the demand.
    level = {"demanded_m_s2": profile.plan.level_m_s2} if profile.steps else {}
    ordered = [{**level, **steps[index]} for index in sorted(steps)]
    marks = {}
    for prefix, who in (("", "measured"), ("twin_", "twin")):
        jumps, intervals = detect_hysteresis(prc_points(ordered), who)
        marks[f"{prefix}jumps"] = [asdict(jump) for jump in jumps]
        marks[f"{prefix}hysteresis"] = [asdict(interval) for interval in intervals]
    last = summaries[-1] if summaries else {}
    merged = {
        **last,
        "run": (last.get("run") or {})
        | {"name": run.name, "label": run.label, "title": profile.title},
        "status": run.status,
        "verdict": "complete" if run.status == "complete" else _merged_verdict(run),
        "reason": "" if run.status == "complete" or not run.parts else run.parts[-1].reason,
        "parts": [part.model_dump(exclude={"measured"}) for part in run.parts],
        "branches": [
            _describe_branch(run, profile, ordered, direction)
            for direction in (profile.sweep.directions if profile.steps else ())
        ],
        "planned_steps": len(profile.steps),
        "u_star_m": last.get("u_star_m"),
        "a_star_m_s2": last.get("a_star_m_s2"),
        "steps": ordered,
        **marks,
        **_summarize_quality(ordered, summaries),
        "warnings": [warning for summary in summaries for warning in summary.get("warnings", ())],
    }
    merged["excitation_verdict"] = judge_excitation(merged, profile)
    return merged | {"twin_verdict": judge_twin(merged)}


def _merged_verdict(run: RunState) -> str:
    """Return the verdict of an unfinished run: that of its last recording."""
    ended = run.parts[-1].verdict or "halted" if run.parts else run.status
    return "halted" if ended == "complete" else ended


def _describe_branch(run: RunState, profile: Profile, steps: list[Json], direction: str) -> Json:
    """Return the recordings of a branch with their frequency ranges in Hz, and its history."""
    begins = {part.folder: part.first_step for part in run.parts}
    mine = [step for step in steps if step["direction"] == direction]
    pieces = []
    for folder, group in groupby(mine, key=lambda step: step["part"]):
        several = list(group)
        ends = several[0]["frequency_hz"], several[-1]["frequency_hz"]
        pieces.append({"part": folder, "from_hz": ends[0], "to_hz": ends[1]})
    first = next(step.index for step in profile.steps if step.direction == direction)
    broken = [piece["from_hz"] for piece in pieces[1:]]
    if pieces and begins[pieces[0]["part"]] > first:
        broken.insert(0, pieces[0]["from_hz"])
    anew = bool(pieces) and begins[pieces[0]["part"]] == first > 0
    history = "broken" if broken else "restarted from rest" if anew else "whole"
    return {"direction": direction, "history": history, "broken_at_hz": broken, "pieces": pieces}


def _summarize_quality(steps: list[Json], summaries: Sequence[Json]) -> Json:
    """Return quality figures of a run: level errors, checks, trips, faults, latency, gaps."""
    worst_error, worst = max(
        list_level_errors(steps), key=lambda entry: abs(entry[0]), default=(None, None)
    )
    levels = [step["level"] for step in steps if step.get("level")]
    latencies = [(summary.get("timing") or {}).get("latency_ms") or {} for summary in summaries]
    return {
        "level_error": worst_error,
        "level_error_hz": None if worst is None else worst["frequency_hz"],
        "level_error_direction": None if worst is None else worst["direction"],
        "level_error_uncorrected": max(
            (level["error_uncorrected"] for level in levels), key=abs, default=None
        ),
        "updates": max((finding["updates"] for finding in levels), default=0),
        **{
            name: [latency for several in summaries for latency in several.get(name, ())]
            for name in ("checks", "trips", "faults")
        },
        "latency_p99_ms": max(
            (latency["p99"] for latency in latencies if latency.get("p99")), default=None
        ),
        "gaps": sum(summary.get("gaps", 0) for summary in summaries),
    }


def renormalize(run: Json, stars: tuple[float, float] | None) -> Json:
    """Return a run's summary with its curves divided by other u* in m and a* in m/s2."""
    if stars is None or not run["u_star_m"]:
        return run
    by = dict.fromkeys(NORMALIZED_BY_U_STAR, run["u_star_m"] / stars[0])
    by |= dict.fromkeys(NORMALIZED_BY_A_STAR, run["a_star_m_s2"] / stars[1])
    steps = [
        {**step, **{who: _scale_response(step[who], by) for who in SOURCES}}
        for step in run["steps"]
    ]
    return {**run, "steps": steps, "u_star_m": stars[0], "a_star_m_s2": stars[1]}


def _scale_response(values: Json | None, by: dict[str, float]) -> Json | None:
    if values is None:
        return None
    return {
        name: value * by[name] if name in by and value is not None else value
        for name, value in values.items()
    }


def find_peak(run: Json, who: str, name: str) -> tuple[float, Json] | None:
    """Return the largest value of a quantity and its step, or None."""
    values = [
        (step[who][name], step)
        for step in run["steps"]
        if step.get(who) and step[who].get(name) is not None
    ]
    return max(values, key=lambda pair: pair[0]) if values else None


def find_most_impacts(run: Json) -> Json | None:
    """Return mean impacts per cycle, right and left, at the step with the most impacts."""

    def mean(step: Json, side: str) -> float:
        counts = (step["measured"] or {}).get(f"impacts_{side}") or [0]
        return sum(counts) / len(counts)

    best = max(
        run["steps"], key=lambda step: mean(step, "right") + mean(step, "left"), default=None
    )
    if best is None or not mean(best, "right") + mean(best, "left"):
        return None
    return {
        "right": mean(best, "right"), "left": mean(best, "left"),
        "frequency_hz": best["frequency_hz"], "direction": best["direction"],
    }  # fmt: skip
