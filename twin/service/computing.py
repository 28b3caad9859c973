"""`simulate`: the model alone on the ideal drive, or many models and gaps at once."""

from collections.abc import Sequence
from pathlib import Path

from table_io.card import BadInput
from twin.service.bundle import read_bundle
from twin.service.folders import new_run
from twin.service.kernels import ready
from twin.service.outcome import close
from twin.service.progress import RunProgress
from twin.service.terminal import console


def simulate(
    profile: Path,
    models: Sequence[str],
    gaps: Sequence[str],
    workers: int | None,
    out: Path | None,
    view: bool,
) -> int:
    """One model at the profile's gap is played and recorded like a run; more are a batch."""
    if len(models) <= 1 and not gaps:
        return _one(profile, models[0] if models else None, out, view)
    if view:
        raise BadInput("--view shows one run; leave it away, or give one --model and no --gap")
    from twin.service.sweeps.command import simulate_all

    return simulate_all(profile, models, gaps, workers, out)


def _one(profile: Path, model: str | None, out: Path | None, view: bool) -> int:
    """The model alone; the exit code."""
    from twin.service.runs import simulate as play

    bundle = read_bundle(profile, None, model)
    ready(bundle)
    folder, run = new_run(out, f"{bundle.name}-model")
    with RunProgress(console, len(bundle.steps), bundle.drive.planned_end) as progress:
        play(bundle, run, folder / "run.mcap", progress)
    return close(folder, bundle, view)
