"""`simulate`: one model on the ideal drive, a batch of models and gaps, or a grid of records."""

from collections.abc import Sequence
from pathlib import Path

from table_io.errors import InputError
from twin.campaign.config import find_campaign
from twin.campaign.simulate_grid import GapOptions, simulate_grid
from twin.report.finalize import print_outcome, show_progress
from twin.simulation.task import simulate
from twin.studies.command import simulate_all
from twin.studies.task import SweepOptions


def simulate_profile(
    profile: Path,
    models: Sequence[str],
    gaps: Sequence[str],
    workers: int | None,
    out: Path | None,
    view: bool,
    scheduler: str = "",
) -> int:
    """Simulate one model, recorded like a run, several models or gaps, or records at gaps."""
    campaign = find_campaign(profile)
    if campaign is not None:
        if gaps or view or workers is not None or scheduler or len(models) > 1:
            raise InputError(
                "a campaign states its gaps and is simulated with one model, in one process",
                where=profile,
                remedy="omit --gap, --view, --workers and --scheduler, and give one --model",
            )
        return simulate_grid(GapOptions(campaign, models[0] if models else None, out))
    if len(models) <= 1 and not gaps:
        if scheduler:
            raise InputError(
                "one sweep is simulated here",
                key="--scheduler",
                value=scheduler,
                remedy="omit it, or give several --model or --gap",
            )
        return _simulate_one(profile, models[0] if models else None, out, view)
    if view:
        raise InputError(
            "shows one run only", where="--view", remedy="omit it, or give one --model and no --gap"
        )
    return simulate_all(SweepOptions(profile, models, gaps, workers, scheduler, out))


def _simulate_one(profile: Path, model: str | None, out: Path | None, view: bool) -> int:
    """Simulate one model at the profile's gap; return the exit code."""
    log = simulate(profile, out, model, view, show_progress)
    return print_outcome(log.summary, log.path.parent, len(log.start.steps))
