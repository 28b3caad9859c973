"""Reading of a run into its row and the rows of its steps; what is damaged is stated in the row."""

import math
import statistics
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

from table_io.config.base import parse_toml
from table_io.config.profile import Specimen
from table_io.errors import InputError
from table_io.records import RESPONSE_RATIOS
from table_io.units import GRAVITY_M_S2
from twin.archive.notes import NOTES_FILE, read_notes
from twin.archive.run_row import Row, RunRow
from twin.model.config import ModelConfig
from twin.recording.reader import read_start
from twin.recording.recovery import ends_whole
from twin.recording.run_paths import explain_unmerged_parts
from twin.report.run_index import LOG_NAME
from twin.results.contracts import ChannelError, Response, RunSummary, StepEntry
from twin.results.summary import parse_toml_tables
from twin.system.files import hash_file

HALF_WIDTH_SIGMA = 1.96  # of a 95 % interval, in standard deviations
SIDES = (*RESPONSE_RATIOS, "drift", "spread")  # of a response


def read_run(folder: Path, name: str, before: Row | None = None) -> tuple[RunRow, list[Row] | None]:
    """Return the row of the run in a folder, or of a single log, and the rows of its steps.

    `name`: of the run in its row. A single log, as of an import, has no summary and no notes.
    What is missing, damaged or of another version is stated in `problem`. `before` is its row in a
    catalogue, {} if it is new there: the files are hashed, and if they hold what they held, only
    the notes are read and the steps are None.
    """
    problems: list[str] = []
    is_single = folder.suffix == ".mcap" and folder.is_file()
    log = folder if is_single else folder / LOG_NAME
    row = RunRow(name) if is_single else _add_notes(RunRow(name), folder, problems)
    if before is not None:
        hashes = (hash_file(log), hash_file(folder / "summary.json"))
        row = replace(row, sha256=hashes[0] or None, summary_sha256=hashes[1] or None)
        held = (before.get("sha256"), before.get("summary_sha256"))
        has_faulty_notes = bool(problems) or NOTES_FILE in str(before.get("problem"))
        if row.sha256 and not has_faulty_notes and held == (row.sha256, row.summary_sha256):
            return RunRow.from_columns(before | {"note": row.note, "tags": [*row.tags]}), None
    row = _add_start(row, log, problems)
    row, steps = (row, []) if is_single else _add_summary(row, folder, problems)
    return replace(row, problem="; ".join(problems) or None), steps


def _add_notes(row: RunRow, folder: Path, problems: list[str]) -> RunRow:
    try:
        notes = read_notes(folder)
    except InputError as error:
        problems.append(str(error))
        return row
    return replace(row, note=notes.note or None, tags=notes.tags)


def _add_start(row: RunRow, log: Path, problems: list[str]) -> RunRow:
    """Return the row with what the start record of the recording states."""
    if reason := explain_unmerged_parts(log.parent):
        problems.append(reason)
        return row
    try:
        start = read_start(log)
    except (InputError, OSError) as error:
        problems.append(f"no start of the recording: {error}")
        return row
    if not ends_whole(log):
        problems.append(f"{log.name} is cut off: `shaketwin verify` lists what is lost")
    try:
        parameters = _list_model_values(start.model_toml, start.profile_toml)
    except InputError as error:
        problems.append(f"model: {error}")
        parameters = {}
    profile, rig = parse_toml_tables(start.profile_toml), parse_toml_tables(start.rig_toml)
    specimen = profile.get("specimen", {})
    gap_mm = specimen.get("gap_mm")
    levels = [step.acceleration_m_s2 for step in start.steps]
    return replace(
        row,
        run=start.run,
        test=start.name or None,
        title=profile.get("title"),
        source=start.source,
        started_at=start.started_at or None,
        host=start.host or None,
        rate_hz=start.rate_hz,
        code_version=start.versions.get("shaketwin"),
        recorded_notes=profile.get("notes") or None,
        rig=rig.get("name"),
        mass_kg=specimen.get("mass_kg"),
        temperature_c=specimen.get("temperature_c"),
        gap_m=gap_mm / 1e3 if gap_mm is not None and math.isfinite(gap_mm) else None,
        gap_mm=gap_mm if gap_mm is not None and math.isfinite(gap_mm) else None,
        level_g=round(max(levels) / GRAVITY_M_S2, 9) if levels else None,
        steps=len(start.steps),
        values=parameters,
    )


@lru_cache(maxsize=256)
def _list_model_values(model_toml: str, profile_toml: str) -> Mapping[str, float | None]:
    """Return the parameters of a model in SI by column, with the intervals that its file states."""
    specimen = parse_toml_tables(profile_toml).get("specimen", {})
    config = parse_toml(model_toml, ModelConfig, "model of the recording")
    model = config.build_model(Specimen.model_validate(specimen))
    values: dict[str, float | None] = {}
    for name, value in model.flatten().items():
        column = f"model_{name.replace('.', '_')}"
        values[column] = value
        if name in config.intervals:
            values[f"{column}_low"], values[f"{column}_high"] = config.intervals[name]
    return values


def _add_summary(row: RunRow, folder: Path, problems: list[str]) -> tuple[RunRow, list[Row]]:
    """Return the row with what summary.json states, and the rows of the steps."""
    remedy = f"`shaketwin report {folder}` writes it again"
    try:
        summary = RunSummary.read(folder / "summary.json", remedy)
    except InputError as error:
        problems.append(str(error))
        return row, []
    info, twin, excitation = summary.run, summary.twin_verdict, summary.excitation_verdict
    stated = summary.model_fields_set
    row = replace(
        row,
        run=info.id or row.run,
        started_at=info.started_at or None,
        test=info.name or None,
        title=info.title or None,
        source=info.source or None,
        host=info.host or row.host,
        rate_hz=info.rate_hz if info.rate_hz > 0 else row.rate_hz,
        duration_s=info.duration_s,
        gap_m=info.gap_m,
        gap_mm=None if info.gap_m is None else round(1e3 * info.gap_m, 9),
        model=info.model,
        verdict=summary.verdict,
        reason=summary.reason or None,
        steps=len(summary.steps),
        jumps=len(summary.jumps),
        twin_jumps=len(summary.twin_jumps),
        hysteresis=len(summary.hysteresis),
        warnings=len(summary.warnings + summary.alarms) if "warnings" in stated else None,
        dropouts=summary.gaps if "gaps" in stated else None,
        lost_samples=summary.lost_samples,
        faults=len(summary.faults),
        trips=len(summary.trips),
        u_star_m=summary.u_star_m,
        a_star_m_s2=summary.a_star_m_s2,
        level_g=_find_level_g(summary) or row.level_g,
        nrmse=summary.comparison.get("rel_disp_m", ChannelError()).nrmse,
        values=dict(row.values or {}) | _list_estimates(summary) | _list_errors(summary),
    )
    if twin is not None:
        row = replace(
            row,
            twin_verdict=twin.verdict,
            twin_reason=twin.reason or None,
            misfit=twin.misfit,
            misfit_worst=twin.misfit_worst,
            steps_outside=twin.steps_outside,
            steps_apart=twin.steps_apart,
        )
    if excitation is not None:
        row = replace(
            row,
            excitation_verdict=excitation.verdict,
            excitation_error=excitation.worst_error,
        )
    return row, [_make_step_row(row, step) for step in summary.steps]


def _find_level_g(summary: RunSummary) -> float | None:
    """Return the largest level of a swept sine in g; None for other tests."""
    if summary.swept_sine is None:
        return None
    levels = [point.reference_m_s2 for point in summary.swept_sine.points]
    return round(max(levels) / GRAVITY_M_S2, 9)


def _list_estimates(summary: RunSummary) -> dict[str, float | None]:
    """Return the estimates of the condition monitoring in SI by column, with 95 % intervals."""
    values: dict[str, float | None] = {}
    for name, estimate in summary.estimates.items():
        half = HALF_WIDTH_SIGMA * estimate.sd
        column = name.replace(".", "_")
        values[column] = estimate.value
        values[f"{column}_low"] = estimate.value - half
        values[f"{column}_high"] = estimate.value + half
    return values


def _list_errors(summary: RunSummary) -> dict[str, float | None]:
    """Return the errors of the twin by column, of each channel."""
    return {
        f"{kind}_{channel}": getattr(error, kind)
        for channel, error in summary.comparison.items()
        for kind in ("nrmse", "free_nrmse", "noise_floor")
    }


def _make_step_row(run: RunRow, step: StepEntry) -> Row:
    row: Row = {
        "folder": run.folder,
        "run": run.run,
        "step": step.index,
        "direction": step.direction,
        "frequency_hz": step.frequency_hz,
        "demanded_m_s2": step.demanded_m_s2,
        "table_acc_peak_m_s2": step.table_acc_peak_m_s2,
        "table_acc_fundamental_m_s2": step.table_acc_fundamental_m_s2,
        "thd": step.thd,
        "same_branch": step.branch.is_same if step.branch else None,
    }
    for prefix, response in (("", step.measured), ("twin_", step.twin)):
        row |= {f"{prefix}{name}": value for name, value in _list_response(response)}
    for channel, misfit in step.agreement.items():
        row |= {f"error_{channel}": misfit.error, f"band_{channel}": misfit.band}
        row |= {f"misfit_{channel}": misfit.misfit}
    return row


def _list_response(response: Response | None) -> Iterator[tuple[str, float | None]]:
    """Yield (column, value) of a response; impacts are means per cycle."""
    for name in SIDES:
        yield name, getattr(response, name, None)
    for name in ("impacts_right", "impacts_left"):
        counts = getattr(response, name, None)
        yield name, statistics.fmean(counts) if counts else None
