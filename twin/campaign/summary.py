"""Summary of a campaign: merged runs, normalized by the measured u* and a*."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path

import numpy as np

from table_io.config.base import load_config, parse_toml
from table_io.config.profile import Profile
from table_io.units import GRAVITY_M_S2
from twin.campaign.config import CampaignConfig
from twin.campaign.gap_comparison import (
    GapComparison,
    compare_gaps,
    describe_comparison,
    list_record_runs,
)
from twin.campaign.result import (
    BranchHistory,
    BranchPiece,
    CampaignInfo,
    CampaignSummary,
    FreeFlight,
    MergedRun,
    MergedStep,
    MostImpacts,
    Peak,
)
from twin.campaign.state import (
    CAMPAIGN_FILE,
    CONFIG_FOLDER,
    CampaignState,
    RunState,
    read_part_summaries,
    read_state,
)
from twin.compare.curves import detect_hysteresis
from twin.model.config import ModelConfig
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.results.contracts import Response, RunSummary
from twin.results.excitation_verdict import judge_excitation, list_level_errors
from twin.results.report_data import step_quantity
from twin.results.summary import prc_points
from twin.results.twin_verdict import judge_twin

VERDICTS_BY_SEVERITY = ("halted", "aborted", "stopped")  # the most severe first


@dataclass(frozen=True)
class CampaignRunData:
    """One run: its configs, its state and its merged summary."""

    state: RunState
    test: str  # name of its profile
    profile: Profile
    model: Model
    summary: MergedRun


@dataclass(frozen=True)
class CampaignData:
    """A campaign as stored in its folder."""

    folder: Path
    config: CampaignConfig
    state: CampaignState
    runs: tuple[CampaignRunData, ...]
    gaps: GapComparison | None  # of the runs of records, if there are several gaps
    summary: CampaignSummary

    @property
    def free_flight(self) -> FreeFlight | None:
        """u* and a* from the free flight."""
        return self.summary.free_flight


def read_campaign(folder: Path) -> CampaignData:
    """Read the folder of a campaign; curves are divided by the measured u* and a*."""
    config, _ = load_config(folder / CAMPAIGN_FILE, CampaignConfig, "campaign")
    state = read_state(folder)
    runs_read = [
        _read_run(folder, run, test) for run, test in zip(state.runs, config.tests, strict=True)
    ]
    free_flight = next((maxima for run in runs_read if (maxima := measured_maxima(run))), None)
    stars = free_flight.stars if free_flight else None
    runs = tuple(
        CampaignRunData(
            run.state, run.test, run.profile, run.model, renormalize(run.summary, stars)
        )
        for run in runs_read
    )
    listed = [(run.state.label, run.profile, run.summary) for run in runs]
    gaps = compare_gaps(list_record_runs(listed, config.record_names))
    summary = _summarize_campaign(config, state, runs, free_flight, gaps)
    return CampaignData(folder, config, state, runs, gaps, summary)


def _read_run(folder: Path, run: RunState, test: str) -> CampaignRunData:
    place = folder / CONFIG_FOLDER / run.name
    profile, _ = load_config(place / "profile.toml", Profile, "test profile")
    model_toml = (place / "model.toml").read_text(encoding="utf-8")
    model = parse_toml(model_toml, ModelConfig, str(place / "model.toml")).build_model(
        profile.specimen
    )
    merged = merge_summaries(run, profile, read_part_summaries(folder, run))
    return CampaignRunData(run, test, profile, model, merged)


def measured_maxima(run: CampaignRunData) -> FreeFlight | None:
    """Return the measured and modelled u* and a* of a complete free-flight run; else None.

    Maxima over the grid of the run, as the laboratory reports them: (u_max - u_min)/2 of the
    relative displacement and (a_max - a_min)/2 of the total acceleration of the mass.
    """
    in_free_flight = run.profile.specimen.gap_mm == float("inf") and run.profile.steps
    stars, sweep = run.summary.stars, run.profile.sweep
    if not in_free_flight or run.state.status != "complete" or stars is None:
        return None
    u_best, a_best = (find_peak(run.summary, "measured", name) for name in ("eta_d", "eta_a"))
    u_twin, a_twin = (find_peak(run.summary, "twin", name) for name in ("eta_d", "eta_a"))
    if u_best is None or a_best is None:
        return None
    level = sweep.one_level_g * GRAVITY_M_S2
    u, a, hz = free_flight_resonance(run.model.parameters, level)
    return FreeFlight(
        run=run.state.label,
        step_hz=sweep.step_hz,
        u_star_m=u_best.value * stars[0],
        u_star_m_at=u_best.place,
        twin_u_star_m=u_twin.value * stars[0] if u_twin else None,
        twin_u_star_m_at=u_twin.place if u_twin else None,
        a_star_m_s2=a_best.value * stars[1],
        a_star_m_s2_at=a_best.place,
        twin_a_star_m_s2=a_twin.value * stars[1] if a_twin else None,
        twin_a_star_m_s2_at=a_twin.place if a_twin else None,
        model_u_star_m=u,
        model_a_star_m_s2=a,
        model_at_hz=hz,
    )


def describe_normalization(free_flight: FreeFlight | None) -> str:
    """Return a sentence that states the normalization of the curves."""
    if free_flight is None:
        return (
            "u* and a* are the maxima of each run's model in free flight, continuous in frequency: "
            "this campaign has no complete run in free flight"
        )
    return (
        f"every eta, measured and model's, is divided by the u* and a* that {free_flight.run} "
        f"measured in free flight, maxima on its grid of {free_flight.step_hz:g} Hz"
    )


def _summarize_campaign(
    config: CampaignConfig,
    state: CampaignState,
    runs: tuple[CampaignRunData, ...],
    free_flight: FreeFlight | None,
    gaps: GapComparison | None,
) -> CampaignSummary:
    complete_runs = [run_state for run_state in state.runs if run_state.status == "complete"]
    verdicts = [run.summary.verdict for run in runs if run.state.parts]
    worst_verdict = next(
        (verdict for verdict in VERDICTS_BY_SEVERITY if verdict in verdicts), "stopped"
    )
    skipped = [run_state.label for run_state in state.runs if run_state.status == "skipped"]
    reason = f"{len(complete_runs)} of {len(runs)} runs complete"
    if skipped:
        reason += f", skipped by the operator: {', '.join(skipped)}"
    for run in runs:
        run.summary.gap_mm = run.profile.specimen.gap_mm
        run.summary.peak = _find_peaks(run.summary)
        run.summary.most_impacts = find_most_impacts(run.summary)
        run.summary.set_up = list(run.state.set_up)
    return CampaignSummary(
        campaign=CampaignInfo(
            title=config.title,
            citation=config.citation,
            notes=config.notes,
            began=state.began,
            resume=config.resume,
            normalisation=describe_normalization(free_flight),
        ),
        verdict="complete" if len(complete_runs) == len(runs) else worst_verdict,
        reason=reason,
        u_star_m=free_flight.u_star_m if free_flight else None,
        a_star_m_s2=free_flight.a_star_m_s2 if free_flight else None,
        free_flight=free_flight,
        gap_comparison=None if gaps is None else describe_comparison(gaps),
        runs=[run.summary for run in runs],
    )


def _find_peaks(run: MergedRun) -> dict[str, Peak]:
    peaks = {name: find_peak(run, "measured", name) for name in ("eta_d", "eta_a", "r_r", "r_l")}
    return {name: peak for name, peak in peaks.items() if peak is not None}


# Quantities divided by u* and by a*.
NORMALIZED_BY_U_STAR = ("eta_d", "eta_r", "eta_l")
NORMALIZED_BY_A_STAR = ("eta_a",)


def merge_summaries(
    run: RunState, profile: Profile, summaries: Sequence[RunSummary | None]
) -> MergedRun:
    """Merge the summaries of a run's parts, in order, into one; None of a part without one yet.

    Each step comes from the last recording that measured it. Each branch lists its recordings and
    its history: whether it was measured without interruption from the beginning of its direction.
    """
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
