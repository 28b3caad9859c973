"""Summary of a campaign: merged runs, normalized by the measured u* and a*."""

from dataclasses import dataclass
from pathlib import Path

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
    renormalize,
)
from twin.campaign.result import CampaignInfo, CampaignSummary, FreeFlight, MergedRun, Peak
from twin.campaign.state import (
    CAMPAIGN_FILE,
    CONFIG_FOLDER,
    CampaignState,
    RunState,
    read_part_summaries,
    read_state,
)
from twin.model.config import ModelConfig
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance

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
