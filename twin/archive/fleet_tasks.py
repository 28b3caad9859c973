"""What a fleet computes of one log: the values of its row, by column. One task a command."""

from collections.abc import Callable
from pathlib import Path

from table_io.errors import InputError
from twin.archive.run_row import Row
from twin.inspection.curves import read_curves
from twin.replay.command import tabulate_replay
from twin.replay.task import RECORDED, open_replay_log, select_span
from twin.replay.verify import verify
from twin.results.contracts import Jump, StepEntry

DEFAULT_MODEL = "snm"  # of `identify` and `discover`, as of the commands


def check_recording(log: Path, model: str | None, folder: Path) -> Row:
    """Return what `verify` says of a log."""
    report = verify(log).report
    return {
        "sound": report.sound,
        "missing_samples": report.samples.missing,
        "gaps": len(report.gaps),
        "damage": len(report.damage),
        "content": report.content,
        "replay_possible": report.replay.possible,
        "replay_identical": report.replay.identical,
        "because": "; ".join(report.replay.because),
    }


def summarise_curves(log: Path, model: str | None, folder: Path) -> Row:
    """Return the largest response, jumps and hysteresis of a log, as `prc` prints them."""
    (run,) = read_curves(log).runs
    if not run.steps:
        raise InputError(f"no step was measured: {run.reason or run.verdict}", where=log)
    row: Row = {
        "ended": run.verdict,
        "u_star_m": run.u_star_m,
        "a_star_m_s2": run.a_star_m_s2,
        "jumps": _format_jumps(run.jumps),
        "hysteresis": "; ".join(f"{h.kind} {h.from_hz:g}-{h.to_hz:g} Hz" for h in run.hysteresis),
    }
    for direction in ("forward", "backward"):
        steps = [step for step in run.steps if step.direction == direction and step.measured]
        if steps:
            peak = max(steps, key=_read_eta_d)
            row[f"{direction}_peak_eta_d"] = _read_eta_d(peak)
            row[f"{direction}_peak_hz"] = peak.frequency_hz
    return row


def _read_eta_d(step: StepEntry) -> float:
    return step.measured.eta_d if step.measured else 0.0


def _format_jumps(jumps: list[Jump]) -> str:
    return "; ".join(f"{j.direction} {j.kind} {j.from_hz:g}-{j.to_hz:g} Hz" for j in jumps)


def replay_log(log: Path, model: str | None, folder: Path) -> Row:
    """Return the errors of a replay with a model, by default the recorded one."""
    recorded = open_replay_log(log)
    if not recorded.recording.contiguous_blocks("meas"):
        raise InputError(
            "no measured samples", where=log, remedy="`shaketwin verify` says what is lost"
        )
    span = select_span(recorded.recording, None)
    row, _ = tabulate_replay(recorded, log.name, model or RECORDED, folder, span)
    cells = dict(row.list_cells())
    del cells["log"], cells["model"]
    values: Row = {name: v for name, v in cells.items() if isinstance(v, str | int | float)}
    return {"intact": recorded.recording.is_intact, **values}


def identify_log(log: Path, model: str | None, folder: Path) -> Row:
    """Return the parameters that one log determines, with 95 % intervals; writes model.toml."""
    from twin.discovery.task import identify  # takes longer to import than a log to verify

    fitted = identify([log], model or DEFAULT_MODEL)
    folder.mkdir()
    fitted.save_model(folder / "model.toml")
    row: Row = {"rms_over_noise": fitted.rms_over_noise, "converged": fitted.converged}
    for name, interval in {**fitted.parameters, **fitted.log_parameters}.items():
        row |= {name: interval.value, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return row


def discover_log(log: Path, model: str | None, folder: Path) -> Row:
    """Return the verdict on what the model lacks in a log; writes verdict.json and model.toml."""
    from twin.discovery.task import discover

    discovered = discover([log], model or DEFAULT_MODEL)
    folder.mkdir()
    discovered.write(folder)
    verdict = discovered.verdict
    row: Row = {
        "verdict": verdict.verdict,
        "effects": " + ".join(effect.name for effect in verdict.effects),
        "misfit_before": verdict.gap.before,
        "misfit_after": verdict.gap.after,
        "closed_fraction": verdict.gap.closed_fraction,
    }
    for effect in verdict.effects:
        for name, interval in effect.parameters.items():
            row[f"{effect.name}.{name}"] = interval.value
    return row


FLEET_TASKS: dict[str, Callable[[Path, str | None, Path], Row]] = {
    "verify": check_recording,
    "prc": summarise_curves,
    "replay": replay_log,
    "identify": identify_log,
    "discover": discover_log,
}
