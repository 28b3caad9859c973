"""Summary of a campaign: merged runs, normalized by the measured u* and a*."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

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
from twin.campaign.merge import (
    find_most_impacts,
    find_peak,
    merge_summaries,
    read_summary,
    renormalize,
)
from twin.campaign.state import CAMPAIGN_FILE, CONFIG_FOLDER, CampaignState, RunState, read_state
from twin.model.config import ModelConfig
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.results.summary import Json

VERDICTS_BY_SEVERITY = ("halted", "aborted", "stopped")  # the most severe first


@dataclass(frozen=True)
class CampaignRunData:
    """One run: its configs, its state and its merged summary."""

    state: RunState
    test: str  # name of its profile
    profile: Profile
    model: Model
    summary: Json


@dataclass(frozen=True)
class CampaignData:
    """A campaign as stored in its folder."""

    folder: Path
    config: CampaignConfig
    state: CampaignState
    runs: tuple[CampaignRunData, ...]
    stars: Json | None  # u* and a* from the free flight
    gaps: GapComparison | None  # of the runs of records, if there are several gaps
    summary: Json


def read_campaign(folder: Path) -> CampaignData:
    """Read the folder of a campaign; curves are divided by the measured u* and a*."""
    config, _ = load_config(folder / CAMPAIGN_FILE, CampaignConfig, "campaign")
    state = read_state(folder)
    runs_read = [
        _read_run(folder, run, test) for run, test in zip(state.runs, config.tests, strict=True)
    ]
    stars = next((maxima for run in runs_read if (maxima := measured_maxima(run))), None)
    divide = (stars["u_star_m"], stars["a_star_m_s2"]) if stars else None
    runs = tuple(
        CampaignRunData(
            run.state, run.test, run.profile, run.model, renormalize(run.summary, divide)
        )
        for run in runs_read
    )
    listed = [(run.state.label, run.profile, run.summary) for run in runs]
    gaps = compare_gaps(list_record_runs(listed, config.record_names))
    summary = _summarize_campaign(config, state, runs, stars, gaps)
    return CampaignData(folder, config, state, runs, stars, gaps, summary)


def _read_run(folder: Path, run: RunState, test: str) -> CampaignRunData:
    place = folder / CONFIG_FOLDER / run.name
    profile, _ = load_config(place / "profile.toml", Profile, "test profile")
    model_toml = (place / "model.toml").read_text(encoding="utf-8")
    model = parse_toml(model_toml, ModelConfig, str(place / "model.toml")).build_model(
        profile.specimen
    )
    summaries = [read_summary(folder / part.folder) for part in run.parts]
    return CampaignRunData(run, test, profile, model, merge_summaries(run, profile, summaries))


def measured_maxima(run: CampaignRunData) -> Json | None:
    """Return the measured and modelled u* and a* of a complete free-flight run; else None.

    Maxima over the grid of the run, as the laboratory reports them: (u_max - u_min)/2 of the
    relative displacement and (a_max - a_min)/2 of the total acceleration of the mass.
    """
    in_free_flight = run.profile.specimen.gap_mm == float("inf") and run.profile.steps
    if not in_free_flight or run.state.status != "complete":
        return None
    summary, sweep = run.summary, run.profile.sweep
    stars: dict[str, Any] = {"run": run.state.label, "step_hz": sweep.step_hz}
    for key, quantity in (("u_star_m", "eta_d"), ("a_star_m_s2", "eta_a")):
        best, twin = find_peak(summary, "measured", quantity), find_peak(summary, "twin", quantity)
        if best is None:
            return None
        stars[key] = best[0] * summary[key]
        stars[f"{key}_at"] = [best[1]["frequency_hz"], best[1]["direction"]]
        stars[f"twin_{key}"] = twin[0] * summary[key] if twin else None
        stars[f"twin_{key}_at"] = [twin[1]["frequency_hz"], twin[1]["direction"]] if twin else None
    level = sweep.one_level_g * GRAVITY_M_S2
    u, a, hz = free_flight_resonance(run.model.parameters, level)
    return stars | {"model_u_star_m": u, "model_a_star_m_s2": a, "model_at_hz": hz}


def describe_normalization(stars: Json | None) -> str:
    """Return a sentence that states the normalization of the curves."""
    if stars is None:
        return (
            "u* and a* are the maxima of each run's model in free flight, continuous in frequency: "
            "this campaign has no complete run in free flight"
        )
    return (
        f"every eta, measured and model's, is divided by the u* and a* that {stars['run']} "
        f"measured in free flight, maxima on its grid of {stars['step_hz']:g} Hz"
    )


def _summarize_campaign(
    config: CampaignConfig,
    state: CampaignState,
    runs: tuple[CampaignRunData, ...],
    stars: Json | None,
    gaps: GapComparison | None,
) -> Json:
    complete_runs = [run_state for run_state in state.runs if run_state.status == "complete"]
    verdicts = [run.summary["verdict"] for run in runs if run.state.parts]
    worst_verdict = next(
        (verdict for verdict in VERDICTS_BY_SEVERITY if verdict in verdicts), "stopped"
    )
    skipped = [run_state.label for run_state in state.runs if run_state.status == "skipped"]
    reason = f"{len(complete_runs)} of {len(runs)} runs complete"
    if skipped:
        reason += f", skipped by the operator: {', '.join(skipped)}"
    return {
        "campaign": {
            "title": config.title,
            "citation": config.citation,
            "notes": config.notes,
            "began": state.began,
            "resume": config.resume,
            "normalisation": describe_normalization(stars),
        },
        "verdict": "complete" if len(complete_runs) == len(runs) else worst_verdict,
        "reason": reason,
        "u_star_m": stars["u_star_m"] if stars else None,
        "a_star_m_s2": stars["a_star_m_s2"] if stars else None,
        "free_flight": stars,
        "gap_comparison": None if gaps is None else describe_comparison(gaps),
        "runs": [
            {
                **run.summary,
                "gap_mm": run.profile.specimen.gap_mm,
                "peak": _find_peaks(run.summary),
                "most_impacts": find_most_impacts(run.summary),
                "set_up": [answer.model_dump() for answer in run.state.set_up],
            }
            for run in runs
        ],
    }


def _find_peaks(run: Json) -> Json:
    peaks = {}
    for name in ("eta_d", "eta_a", "r_r", "r_l"):
        best = find_peak(run, "measured", name)
        if best is not None:
            peaks[name] = {
                "value": best[0],
                "frequency_hz": best[1]["frequency_hz"],
                "direction": best[1]["direction"],
            }
    return peaks
