"""The recordings of a run as one: each step from the last recording that measured it.

A branch says from which recordings it comes, and whether its history was broken: whether it was
measured in one go from the beginning of its direction.
"""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Any

from table_io.profile import Profile
from table_io.records import Point, Quantities
from table_io.units import GRAVITY_M_S2
from twin.compare.curves import branches
from twin.service.campaign.state import RunState
from twin.service.summary import Json

OF_U, OF_A = ("eta_d", "eta_r", "eta_l"), ("eta_a",)  # what is divided by u* and by a*
WHO = ("measured", "twin")


def read_summary(folder: Path) -> Json:
    """The summary in a run's folder; an empty one where there is none yet."""
    try:
        return dict(json.loads((folder / "summary.json").read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def joined(run: RunState, profile: Profile, found: Sequence[Json]) -> Json:
    """The summary of a run from the summaries of its parts, in their order; as a run's summary."""
    steps: dict[int, Json] = {}
    for part, one in zip(run.parts, found, strict=True):
        for step in one.get("steps") or ():
            steps[step["index"]] = {**step, "part": part.folder}
    ordered = [steps[index] for index in sorted(steps)]
    marks = {}
    for prefix, who in (("", "measured"), ("twin_", "twin")):
        jumps, intervals = branches(points(ordered), who)
        marks[f"{prefix}jumps"] = [asdict(one) for one in jumps]
        marks[f"{prefix}hysteresis"] = [asdict(one) for one in intervals]
    last = found[-1] if found else {}
    return {
        **last,
        "run": (last.get("run") or {})
        | {"name": run.name, "label": run.label, "title": profile.title},
        "status": run.status,
        "verdict": "complete" if run.status == "complete" else _verdict(run),
        "reason": "" if run.status == "complete" or not run.parts else run.parts[-1].reason,
        "parts": [part.model_dump(exclude={"measured"}) for part in run.parts],
        "branches": [_branch(run, profile, ordered, one) for one in profile.sweep.directions],
        "planned_steps": len(profile.sweep.steps),
        "u_star_m": last.get("u_star_m"),
        "a_star_m_s2": last.get("a_star_m_s2"),
        "steps": ordered,
        **marks,
        **_quality(profile, ordered, found),
    }


def _verdict(run: RunState) -> str:
    """How an unfinished run ended: as its last recording did."""
    ended = run.parts[-1].verdict or "halted" if run.parts else run.status
    return "halted" if ended == "complete" else ended


def points(steps: Iterable[Json]) -> list[Point]:
    """The PRC points of a summary's steps."""
    return [
        Point(
            0, step["index"], step["direction"], step["frequency_hz"],
            _quantities(step["measured"]), _quantities(step["twin"]),
            _number(step["table_acc_peak_m_s2"]), _number(step["table_acc_fundamental_m_s2"]),
            _number(step["thd"]),
        )
        for step in steps
    ]  # fmt: skip


def _quantities(values: Json | None) -> Quantities | None:
    if values is None:
        return None
    known: Json = {
        name: tuple(one) if isinstance(one, list) else _number(one) for name, one in values.items()
    }
    return Quantities(**known)


def _number(value: Any) -> float:
    return math.nan if value is None else value


def _branch(run: RunState, profile: Profile, steps: list[Json], direction: str) -> Json:
    """Where a branch comes from: its recordings with what each gave, and its history."""
    begins = {part.folder: part.first_step for part in run.parts}
    mine = [step for step in steps if step["direction"] == direction]
    pieces = []
    for folder, group in groupby(mine, key=lambda step: step["part"]):
        several = list(group)
        ends = several[0]["frequency_hz"], several[-1]["frequency_hz"]
        pieces.append({"part": folder, "from_hz": ends[0], "to_hz": ends[1]})
    first = next(one.index for one in profile.sweep.steps if one.direction == direction)
    broken = [piece["from_hz"] for piece in pieces[1:]]
    if pieces and begins[pieces[0]["part"]] > first:
        broken.insert(0, pieces[0]["from_hz"])
    anew = bool(pieces) and begins[pieces[0]["part"]] == first > 0
    history = "broken" if broken else "begun anew from rest" if anew else "whole"
    return {"direction": direction, "history": history, "broken_at_hz": broken, "pieces": pieces}


def _quality(profile: Profile, steps: list[Json], found: Sequence[Json]) -> Json:
    """What a laboratory asks of a run before it believes it."""
    demanded = profile.sweep.acceleration_g * GRAVITY_M_S2
    errors = [_number(one["table_acc_fundamental_m_s2"]) / demanded - 1 for one in steps]
    worst = max(range(len(steps)), key=lambda k: abs(errors[k]), default=None)
    levels = [one["level"] for one in steps if one.get("level")]
    latencies = [(one.get("timing") or {}).get("latency_ms") or {} for one in found]
    return {
        "level_error": None if worst is None else errors[worst],
        "level_error_hz": None if worst is None else steps[worst]["frequency_hz"],
        "level_error_direction": None if worst is None else steps[worst]["direction"],
        "level_error_uncorrected": max(
            (one["error_uncorrected"] for one in levels), key=abs, default=None
        ),
        "updates": max((one["updates"] for one in levels), default=0),
        **{
            name: [one for several in found for one in several.get(name, ())]
            for name in ("checks", "trips", "faults")
        },
        "latency_p99_ms": max((one["p99"] for one in latencies if one.get("p99")), default=None),
        "gaps": sum(one.get("gaps", 0) for one in found),
    }


def scaled(run: Json, stars: tuple[float, float] | None) -> Json:
    """A run's summary with its curves divided by other u* in m and a* in m/s2."""
    if stars is None or not run["u_star_m"]:
        return run
    by = dict.fromkeys(OF_U, run["u_star_m"] / stars[0])
    by |= dict.fromkeys(OF_A, run["a_star_m_s2"] / stars[1])
    steps = [{**step, **{who: _scaled(step[who], by) for who in WHO}} for step in run["steps"]]
    return {**run, "steps": steps, "u_star_m": stars[0], "a_star_m_s2": stars[1]}


def _scaled(values: Json | None, by: dict[str, float]) -> Json | None:
    if values is None:
        return None
    return {
        name: value * by[name] if name in by and value is not None else value
        for name, value in values.items()
    }


def peak(run: Json, who: str, name: str) -> tuple[float, Json] | None:
    """(the largest value of a quantity, its step), None where there is none."""
    values = [
        (one[who][name], one)
        for one in run["steps"]
        if one.get(who) and one[who].get(name) is not None
    ]
    return max(values, key=lambda one: one[0]) if values else None


def most_impacts(run: Json) -> Json | None:
    """Mean impacts a cycle, right and left, of the step that has most of them."""

    def mean(step: Json, side: str) -> float:
        counts = (step["measured"] or {}).get(f"impacts_{side}") or [0]
        return sum(counts) / len(counts)

    best = max(run["steps"], key=lambda one: mean(one, "right") + mean(one, "left"), default=None)
    if best is None or not mean(best, "right") + mean(best, "left"):
        return None
    return {
        "right": mean(best, "right"), "left": mean(best, "left"),
        "frequency_hz": best["frequency_hz"], "direction": best["direction"],
    }  # fmt: skip
