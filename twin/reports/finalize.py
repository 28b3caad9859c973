"""Finalization of a run: summary, report, optional view file, and exit code."""

from pathlib import Path

from twin.recording.reader import read_recording
from twin.reports import summary as summaries
from twin.run.run_config import RunConfig
from twin.run.terminal import print_line

EXIT_ABORTED, EXIT_GAPS, EXIT_NOT_IDENTICAL, EXIT_INTERRUPTED = 3, 4, 5, 130


def finalize_run(
    folder: Path, run_config: RunConfig, view: bool = False, extra: summaries.Json | None = None
) -> int:
    """Write summary, report and optional view, print a one-line summary; return the exit code."""
    from twin.reports.report import write_report

    recording = read_recording(folder / "run.mcap")
    summary = summaries.summarise(recording, run_config.parameters)
    summary |= extra or {}
    summaries.write_summary(summary, folder / "summary.json")
    write_report(folder, recording)
    if view:
        from twin.viewer.view import write_rrd

        write_rrd(recording, folder / "view.rrd")
    message = f"{summaries.format_summary(summary)} -> {folder / 'report.html'}"
    print_line(message)
    if summary["verdict"] != "complete":
        return EXIT_ABORTED
    return EXIT_GAPS if summary["gaps"] else 0
