"""The summary of a whole campaign: every run joined, divided by the measured u* and a*."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from table_io.card import load, parse
from table_io.profile import Profile
from table_io.units import GRAVITY_M_S2
from twin.model.card import ModelCard
from twin.model.model import Model
from twin.model.parameters import resonance
from twin.service.campaign.card import CampaignCard
from twin.service.campaign.joined import joined, most_impacts, peak, read_summary, scaled
from twin.service.campaign.state import CARDS, COPY, RunState, State, read_state
from twin.service.summary import Json

ORDER = ("halted", "aborted", "stopped")  # the gravest first


@dataclass(frozen=True)
class Told:
    """One run: its cards, how far it is, and its joined summary."""

    state: RunState
    test: str  # name of its profile
    profile: Profile
    model: Model
    summary: Json


@dataclass(frozen=True)
class Whole:
    """A campaign as its folder tells it."""

    folder: Path
    card: CampaignCard
    state: State
    runs: tuple[Told, ...]
    stars: Json | None  # what the free flight gave
    summary: Json


def read_whole(folder: Path) -> Whole:
    """All that the folder of a campaign tells; curves divided by the measured u* and a*."""
    card, _ = load(folder / COPY, CampaignCard, "campaign")
    state = read_state(folder)
    tests = [Path(run.profile).stem for run in card.runs for _ in run.labels]
    told = [_told(folder, run, test) for run, test in zip(state.runs, tests, strict=True)]
    stars = next((found for one in told if (found := measured_stars(one))), None)
    divide = (stars["u_star_m"], stars["a_star_m_s2"]) if stars else None
    runs = tuple(
        Told(one.state, one.test, one.profile, one.model, scaled(one.summary, divide))
        for one in told
    )
    return Whole(folder, card, state, runs, stars, _summary(card, state, runs, stars))


def _told(folder: Path, run: RunState, test: str) -> Told:
    place = folder / CARDS / run.name
    profile, _ = load(place / "profile.toml", Profile, "test profile")
    model_toml = (place / "model.toml").read_text(encoding="utf-8")
    model = parse(model_toml, ModelCard, str(place / "model.toml")).model(profile.specimen)
    found = [read_summary(folder / part.folder) for part in run.parts]
    return Told(run, test, profile, model, joined(run, profile, found))


def measured_stars(run: Told) -> Json | None:
    """u* and a* as a run in free flight measured them, beside the model's; None for any other.

    Maxima over the grid of the run, as the laboratory reports them: (u_max - u_min)/2 of the
    relative displacement and (a_max - a_min)/2 of the total acceleration of the mass.
    """
    if run.profile.specimen.gap_mm != float("inf") or run.state.status != "complete":
        return None
    found, sweep = run.summary, run.profile.sweep
    stars: dict[str, Any] = {"run": run.state.label, "step_hz": sweep.step_hz}
    for key, quantity in (("u_star_m", "eta_d"), ("a_star_m_s2", "eta_a")):
        best, twin = peak(found, "measured", quantity), peak(found, "twin", quantity)
        if best is None:
            return None
        stars[key] = best[0] * found[key]
        stars[f"{key}_at"] = [best[1]["frequency_hz"], best[1]["direction"]]
        stars[f"twin_{key}"] = twin[0] * found[key] if twin else None
        stars[f"twin_{key}_at"] = [twin[1]["frequency_hz"], twin[1]["direction"]] if twin else None
    level = sweep.acceleration_g * GRAVITY_M_S2
    u, a, hz = resonance(run.model.parameters, level)
    return stars | {"model_u_star_m": u, "model_a_star_m_s2": a, "model_at_hz": hz}


def normalisation(stars: Json | None) -> str:
    """By what every curve is divided, in a sentence."""
    if stars is None:
        return (
            "u* and a* are the maxima of each run's model in free flight, continuous in frequency: "
            "this campaign has no complete run in free flight"
        )
    return (
        f"every eta, measured and model's, is divided by the u* and a* that {stars['run']} "
        f"measured in free flight, maxima on its grid of {stars['step_hz']:g} Hz"
    )


def _summary(card: CampaignCard, state: State, runs: tuple[Told, ...], stars: Json | None) -> Json:
    done = [one for one in state.runs if one.status == "complete"]
    verdicts = [one.summary["verdict"] for one in runs if one.state.parts]
    ended = next((one for one in ORDER if one in verdicts), "stopped")
    skipped = [one.label for one in state.runs if one.status == "skipped"]
    reason = f"{len(done)} of {len(runs)} runs complete"
    if skipped:
        reason += f", skipped by the operator: {', '.join(skipped)}"
    return {
        "campaign": {
            "title": card.title,
            "citation": card.citation,
            "notes": card.notes,
            "began": state.began,
            "resume": card.resume,
            "normalisation": normalisation(stars),
        },
        "verdict": "complete" if len(done) == len(runs) else ended,
        "reason": reason,
        "u_star_m": stars["u_star_m"] if stars else None,
        "a_star_m_s2": stars["a_star_m_s2"] if stars else None,
        "free_flight": stars,
        "runs": [
            {
                **one.summary,
                "gap_mm": one.profile.specimen.gap_mm,
                "peak": _peaks(one.summary),
                "most_impacts": most_impacts(one.summary),
                "set_up": [answer.model_dump() for answer in one.state.set_up],
            }
            for one in runs
        ],
    }


def _peaks(run: Json) -> Json:
    found = {}
    for name in ("eta_d", "eta_a", "r_r", "r_l"):
        best = peak(run, "measured", name)
        if best is not None:
            found[name] = {
                "value": best[0],
                "frequency_hz": best[1]["frequency_hz"],
                "direction": best[1]["direction"],
            }
    return found
