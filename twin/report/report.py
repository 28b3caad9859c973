"""HTML report of a run: one self-contained file.

Values from the summary are shown unchanged; the page loads nothing from outside.
"""

from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path

import numpy as np

from table_io.records import (
    Agreement,
    Check,
    Event,
    Fault,
    FrequencyResponse,
    Level,
    Params,
    SampleGap,
    Timing,
    Trip,
    format_kind,
)
from twin.compare.pipeline import EVENT_KINDS
from twin.drawing.charts import make_chart_script
from twin.drawing.page import format_significant, render_page
from twin.drawing.panels import CaptionedFigure
from twin.drawing.table_motion_figures import MOTION_FIGURES
from twin.recording.reader import Recording, read_recording
from twin.report.figures import draw_figures
from twin.results.contracts import LevelResult, MeasuredFold, OrbitResult, RunSummary
from twin.results.excitation_verdict import describe_peaks, list_level_errors
from twin.results.report_data import (
    ReportData,
    build_report_data,
    step_quantity,
)
from twin.results.sensor_table import build_sensor_rows
from twin.results.summary import parse_toml_tables
from twin.results.swept_sine import format_swept_sine
from twin.results.table_motion import format_required, format_tracking
from twin.results.twin_verdict import (
    describe_worst,
    format_jump,
    format_misfit,
    name_command,
)

MAX_ROWS = 200
MAX_TEXT_LENGTH = 20_000  # of a configuration as recorded


def write_report(folder: Path, recording: Recording | None = None) -> Path:
    """Write folder/report.html from run.mcap and summary.json; return the path.

    A `recording` already in memory is not read again.
    """
    run = load_report_data(folder, recording)
    path = folder / "report.html"
    path.write_text(render_report(run, list(draw_figures(run))), encoding="utf-8")
    return path


def load_report_data(folder: Path, recording: Recording | None = None) -> ReportData:
    """Return the report data of a run's folder, from run.mcap and summary.json."""
    remedy = "give a folder written by run, replay or simulate"
    summary = RunSummary.read(folder / "summary.json", remedy)
    return build_report_data(recording or read_recording(folder / "run.mcap"), summary)


def render_report(run: ReportData, figures: Sequence[CaptionedFigure]) -> str:
    """Render the report page as HTML text with the data of every figure."""
    start, recording = run.recording.start, run.recording
    verdict = run.summary.twin_verdict if run.summary.is_twin_judged else None
    texts = {name: getattr(start, f"{name}_toml") for name in ("profile", "rig", "model")}
    demand = {step.index: step.acceleration_m_s2 for step in start.steps}
    # Summaries of older versions do not state the demand.
    steps = [
        step
        if np.isfinite(step.demanded_m_s2)
        else step.model_copy(update={"demanded_m_s2": demand.get(step.index, np.nan)})
        for step in run.steps
    ]
    return render_page(
        Path(__file__).with_name("report.html"),
        run=run,
        summary=run.summary,
        start=start,
        headline=format_headline(run),
        twin_verdict=verdict,
        misfit=format_misfit(verdict),
        describe_worst=describe_worst,
        next_command=name_command(verdict, recording.path.parent) if verdict else "",
        format_jump=format_jump,
        configs={name: parse_toml_tables(text) for name, text in texts.items()},
        charts=[figure for figure in figures if figure.name not in MOTION_FIGURES],
        motion_charts=[figure for figure in figures if figure.name in MOTION_FIGURES],
        script=make_chart_script(figures),
        format_required=format_required,
        demand=demand,
        peaks=describe_peaks(steps),
        level_errors={step.index: error for error, step in list_level_errors(steps)},
        texts=[
            (name, sha256(text.encode()).hexdigest(), _shorten(text))
            for name, text in texts.items()
        ],
        timings={timing.component: timing for timing in recording.records(Timing)},
        gaps=recording.records(SampleGap),
        faults=recording.records(Fault),
        events=[
            event for event in recording.records(Event) if event.kind not in ("state", *EVENT_KINDS)
        ],
        monitor_events=[event for event in recording.records(Event) if event.kind in EVENT_KINDS],
        format_kind=format_kind,
        compared=any(
            np.isfinite(agreement.error).any() for agreement in recording.records(Agreement)
        ),
        sensors=build_sensor_rows(start),
        states=recording.stop.states if recording.stop else (),
        checks=recording.records(Check),
        trips=recording.records(Trip),
        response=next(iter(recording.records(FrequencyResponse)), None),
        level=worst_level(run),
        parameters=recording.records(Params),
        max_rows=MAX_ROWS,
        quantity=step_quantity,
    )


def _shorten(text: str) -> str:
    """Return the beginning of a long text: a profile may hold a file of its excitation."""
    if len(text) <= MAX_TEXT_LENGTH:
        return text
    rest = len(text) - MAX_TEXT_LENGTH
    return f"{text[:MAX_TEXT_LENGTH]}\n... {rest} more characters, see the recording"


def worst_level(run: ReportData) -> dict[str, float] | None:
    """Return the largest level errors (relative) with and without control, and most updates.

    None if no step has level records.
    """
    levels: list[LevelResult] = [step.level for step in run.steps if step.level]
    if not levels:
        return None
    return {
        "controlled": max(abs(level.error) for level in levels),
        "uncontrolled": max(abs(level.error_uncorrected) for level in levels),
        "updates": max(record.update for record in run.recording.records(Level)),
        "steps": len(levels),
    }


def format_orbit_headline(
    orbits: list[OrbitResult],
    planned: int,
    is_backbone: bool,
    folds: Sequence[MeasuredFold] = (),
) -> str:
    """Format the headline of a continuation: orbits accepted, range, feedback and folds."""
    accepted = [orbit for orbit in orbits if orbit.accepted]
    if not accepted:
        return f"none of {planned} orbits measured."
    unstable = [orbit for orbit in accepted if not orbit.stable] or accepted
    frequencies = [orbit.frequency_hz for orbit in unstable]
    share = max(orbit.feedback_share for orbit in accepted)
    if is_backbone:
        return (
            f"{len(accepted)} of {planned} points of the backbone measured, "
            f"{min(frequencies):.4g} to {max(frequencies):.4g} Hz; feedback at most "
            f"{100 * share:.2g} % of the command."
        )
    turns = [f"; {fold.kind} fold at {fold.frequency_hz:.4f} Hz" for fold in folds]
    return (
        f"{len(accepted)} of {planned} orbits measured, {len(unstable)} of them unstable from "
        f"{min(frequencies):.4g} to {max(frequencies):.4g} Hz; feedback at most "
        f"{100 * share:.2g} % of the command{''.join(turns)}."
    )


def format_headline(run: ReportData) -> str:
    """Format the headline: steps completed, hysteresis, findings and largest excursion."""
    if run.summary.swept_sine is not None:
        return f"{format_swept_sine(run.summary.swept_sine)}."
    if run.windows:
        planned = parse_toml_tables(run.recording.start.profile_toml).get("excitation") or {}
        kind = planned.get("kind", "history")
        headline = f"{len(run.windows)} windows of a displacement history ({kind}), open loop"
        tracking = run.summary.tracking
        return f"{headline}; {format_tracking(tracking)}." if tracking else f"{headline}."
    if run.orbits:
        excitation = parse_toml_tables(run.recording.start.profile_toml).get("excitation") or {}
        return format_orbit_headline(
            run.orbits,
            len(run.recording.start.steps),
            excitation.get("kind") == "backbone",
            run.summary.folds,
        )
    done_count = sum(1 for step in run.steps if step.measured or step.twin)
    parts = [f"{done_count} of {len(run.recording.start.steps) or len(run.steps)} steps"]
    parts += [
        f"{interval.kind} hysteresis {interval.from_hz:g} to {interval.to_hz:g} Hz"
        for interval in run.summary.hysteresis
    ] or ["no hysteresis"]
    parts += run.summary.findings
    eta_d = np.nan_to_num([step_quantity(step, run.source, "eta_d") for step in run.steps])
    if eta_d.any():
        peak_step = run.steps[int(np.argmax(eta_d))]
        location = f"{peak_step.frequency_hz:g} Hz {peak_step.direction}"
        parts.append(
            f"largest normalized excursion {format_significant(eta_d.max())} at {location}"
        )
    return "; ".join(parts) + "."
