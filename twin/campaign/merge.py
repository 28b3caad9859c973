"""Merge the recordings of a run: each step comes from the last recording that measured it.

Each branch lists its recordings and its history: whether it was measured without interruption from
the beginning of its direction.
"""

import math
from collections.abc import Sequence
from dataclasses import asdict
from itertools import groupby

import numpy as np

from table_io.config.profile import Profile
from twin.campaign.result import (
    BranchHistory,
    BranchPiece,
    MergedRun,
    MergedStep,
    MostImpacts,
    Peak,
)
from twin.campaign.state import RunState
from twin.compare.curves import detect_hysteresis
from twin.results.contracts import Response, RunSummary
from twin.results.excitation_verdict import judge_excitation, list_level_errors
from twin.results.report_data import step_quantity
from twin.results.summary import prc_points
from twin.results.twin_verdict import judge_twin

NORMALIZED_BY_U_STAR, NORMALIZED_BY_A_STAR = (
    ("eta_d", "eta_r", "eta_l"),
    ("eta_a",),
)  # quantities divided by u* and by a*


def merge_summaries(
    run: RunState, profile: Profile, summaries: Sequence[RunSummary | None]
) -> MergedRun:
    """Merge the summaries of a run's parts, in order, into one; None of a part without one yet."""
    # Recordings of older versions do not state the demand.
    level = {"demanded_m_s2": profile.plan.level_m_s2} if profile.steps else {}
    known = [summary for summary in summaries if summary is not None]
    steps = {
        step.index: MergedStep.model_validate({**level, **step.to_plain(), "part": part.folder})
        for part, summary in zip(run.parts, summaries, strict=True)
        for step in (summary.steps if summary else ())
    }
    ordered = [steps[index] for index in sorted(steps)]
    last = summaries[-1] if summaries else None
    info = last.run.to_plain() if last else {}
    ended = "" if run.status == "complete" or not run.parts else run.parts[-1].reason
    points = prc_points(ordered)
    jumps, intervals = detect_hysteresis(points, "measured")
    twin_jumps, twin_intervals = detect_hysteresis(points, "twin")
    worst_error, worst = max(
        list_level_errors(ordered), key=lambda entry: abs(entry[0]), default=(None, None)
    )
    levels = [step.level for step in ordered if step.level]
    latencies = [summary.timing.latency_ms.p99 for summary in known]
    merged = MergedRun.model_validate(
        (last.to_plain() if last else {})
        | {
            "run": info | {"name": run.name, "label": run.label, "title": profile.title},
            "status": run.status,
            "verdict": "complete" if run.status == "complete" else _merged_verdict(run),
            "reason": ended,
            "parts": run.parts,
            "branches": [
                _describe_branch(run, profile, ordered, direction)
                for direction in (profile.sweep.directions if profile.steps else ())
            ],
            "planned_steps": len(profile.steps),
            "u_star_m": last.u_star_m if last else None,
            "a_star_m_s2": last.a_star_m_s2 if last else None,
            "steps": ordered,
            "jumps": [asdict(jump) for jump in jumps],
            "hysteresis": [asdict(interval) for interval in intervals],
            "twin_jumps": [asdict(jump) for jump in twin_jumps],
            "twin_hysteresis": [asdict(interval) for interval in twin_intervals],
            "level_error": worst_error,
            "level_error_hz": worst.frequency_hz if worst else None,
            "level_error_direction": worst.direction if worst else None,
            "level_error_uncorrected": max(
                (level.error_uncorrected for level in levels), key=abs, default=None
            ),
            "updates": max((level.updates for level in levels), default=0),
            # Each part begins with all checks: those of the last part that came so far.
            "checks": next((each.checks for each in reversed(known) if each.checks), []),
            "trips": [trip for summary in known for trip in summary.trips],
            "faults": [fault for summary in known for fault in summary.faults],
            "latency_p99_ms": max((p99 for p99 in latencies if p99), default=None),
            "gaps": sum(summary.gaps for summary in known),
            "warnings": [warning for summary in known for warning in summary.warnings],
        }
    )
    merged.excitation_verdict = judge_excitation(merged, profile)
    merged.twin_verdict = judge_twin(merged)
    return merged


def _merged_verdict(run: RunState) -> str:
    """Return the verdict of an unfinished run: that of its last recording."""
    ended = run.parts[-1].verdict or "halted" if run.parts else run.status
    return "halted" if ended == "complete" else ended


def _describe_branch(
    run: RunState, profile: Profile, steps: list[MergedStep], direction: str
) -> BranchHistory:
    """Return the recordings of a branch with their frequency ranges in Hz, and its history."""
    begins = {part.folder: part.first_step for part in run.parts}
    mine = [step for step in steps if step.direction == direction]
    pieces = []
    for folder, group in groupby(mine, key=lambda step: step.part):
        several = list(group)
        ends = several[0].frequency_hz, several[-1].frequency_hz
        pieces.append(BranchPiece(part=folder, from_hz=ends[0], to_hz=ends[1]))
    first = next(step.index for step in profile.steps if step.direction == direction)
    broken = [piece.from_hz for piece in pieces[1:]]
    if pieces and begins[pieces[0].part] > first:
        broken.insert(0, pieces[0].from_hz)
    anew = bool(pieces) and begins[pieces[0].part] == first > 0
    history = "broken" if broken else "restarted from rest" if anew else "whole"
    return BranchHistory(direction=direction, history=history, broken_at_hz=broken, pieces=pieces)


def renormalize(run: MergedRun, stars: tuple[float, float] | None) -> MergedRun:
    """Return a run's summary with its curves divided by other u* in m and a* in m/s2."""
    if stars is None or run.stars is None:
        return run
    by = dict.fromkeys(NORMALIZED_BY_U_STAR, run.stars[0] / stars[0])
    by |= dict.fromkeys(NORMALIZED_BY_A_STAR, run.stars[1] / stars[1])
    steps = [
        step.model_copy(
            update={
                "measured": _scale_response(step.measured, by),
                "twin": _scale_response(step.twin, by),
            }
        )
        for step in run.steps
    ]
    return run.model_copy(update={"steps": steps, "u_star_m": stars[0], "a_star_m_s2": stars[1]})


def _scale_response(response: Response | None, by: dict[str, float]) -> Response | None:
    if response is None:
        return None
    stated = by.keys() & response.model_fields_set
    return response.model_copy(update={name: getattr(response, name) * by[name] for name in stated})


def find_peak(run: RunSummary, source: str, name: str) -> Peak | None:
    """Return the largest value of a quantity and its place, or None."""
    values = [(step_quantity(step, source, name), step) for step in run.steps]
    known = [(value, step) for value, step in values if math.isfinite(value)]
    if not known:
        return None
    value, step = max(known, key=lambda pair: pair[0])
    return Peak(value=value, frequency_hz=step.frequency_hz, direction=step.direction)


def find_most_impacts(run: RunSummary) -> MostImpacts | None:
    """Return mean impacts per cycle, right and left, at the step with the most impacts."""
    means = [
        [
            np.nan_to_num(step_quantity(step, "measured", name))
            for name in ("impacts_right", "impacts_left")
        ]
        for step in run.steps
    ]
    best = max(range(len(means)), key=lambda number: sum(means[number]), default=None)
    if best is None or not sum(means[best]):
        return None
    step, (right, left) = run.steps[best], means[best]
    return MostImpacts(
        right=right, left=left, frequency_hz=step.frequency_hz, direction=step.direction
    )
