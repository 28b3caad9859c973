"""Finalization of a run: summary, report, optional view file, and exit code."""

from pathlib import Path

from twin.recording.reader import read_recording
from twin.report.report import write_report
from twin.results.contracts import ReplayResult, RunSummary
from twin.results.excitation_verdict import describe_peaks, format_excitation_verdict
from twin.results.rerun import restore_predictions
from twin.results.summary import format_summary, summarise
from twin.results.twin_verdict import format_twin_verdict
from twin.setup.run_config import RunConfig
from twin.setup.unpaced import ShownRun
from twin.system.exit_codes import EXIT_ABORTED, EXIT_GAPS
from twin.system.progress import RunProgress
from twin.system.terminal import VERDICT_COLOURS, console, print_line


def show_progress(run: ShownRun) -> RunProgress:
    """Return the progress of a run on the console, for a task to enter."""
    return RunProgress(console, len(run.config.steps), run.last)


def write_results(
    folder: Path, run_config: RunConfig, view: bool = False, replay: ReplayResult | None = None
) -> RunSummary:
    """Write summary, report and optional view of the run in a folder; return the summary."""
    recording = read_recording(folder / "run.mcap")
    if view or not run_config.steps:  # the viewer and a history show every sample
        recording = restore_predictions(recording, run_config)
    summary = summarise(recording, run_config.parameters)
    if replay is not None:
        summary.replay = replay
    summary.write(folder / "summary.json")
    write_report(folder, recording)
    if view:
        from twin.viewer.view import write_rrd

        write_rrd(recording, folder / "view.rrd")
    return summary


def print_outcome(summary: RunSummary, folder: Path, planned_steps: int) -> int:
    """Print a run's summary in one line, and the verdicts; return the exit code."""
    result = format_summary(summary, planned_steps)
    print_line(f"test {result} -> {folder / 'report.html'}")
    print_twin_verdict(summary, folder)
    if summary.verdict != "complete":
        return EXIT_ABORTED
    return EXIT_GAPS if summary.gaps else 0


def print_twin_verdict(summary: RunSummary, folder: Path) -> None:
    """Print the verdicts on excitation and twin, coloured; nothing without a twin."""
    excitation, verdict = summary.excitation_verdict, summary.twin_verdict
    if verdict is None or not summary.is_twin_judged:
        return
    if excitation is not None:
        _print_coloured(format_excitation_verdict(excitation), excitation.verdict)
        for sentence in describe_peaks(summary.steps):
            print_line(f"  {sentence}")
    first, *lines = format_twin_verdict(verdict, folder)
    _print_coloured(first, verdict.verdict)
    for line in lines:
        print_line(f"  {line}")


def _print_coloured(line: str, verdict: str) -> None:
    colour = VERDICT_COLOURS[verdict]
    console.print(line, style=f"bold {colour}", highlight=False, soft_wrap=True)
