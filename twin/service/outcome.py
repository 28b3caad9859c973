"""What a run leaves in its folder, and the exit code that says how it ended."""

from pathlib import Path

from twin.service import summary as summaries
from twin.service.bundle import Bundle
from twin.service.terminal import say
from twin.stream.recording import read

EXIT_ABORTED, EXIT_GAPS, EXIT_NOT_IDENTICAL, EXIT_INTERRUPTED = 3, 4, 5, 130


def close(
    folder: Path, bundle: Bundle, view: bool = False, extra: summaries.Json | None = None
) -> int:
    """Summary, report, view, and the one line that says what happened; the exit code."""
    from twin.service.report import write_report

    recording = read(folder / "run.mcap")
    found = summaries.summarise(recording, bundle.parameters)
    found |= extra or {}
    summaries.write(found, folder / "summary.json")
    write_report(folder, recording)
    if view:
        from twin.stream.rerun.view import write_rrd

        write_rrd(recording, folder / "view.rrd")
    what = f"{summaries.sentence(found)} -> {folder / 'report.html'}"
    say(what)
    if found["verdict"] != "complete":
        return EXIT_ABORTED
    return EXIT_GAPS if found["gaps"] else 0
