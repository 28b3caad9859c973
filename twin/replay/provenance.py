"""Provenance of a replay: source recording, content hash, and the run with the earlier samples."""

import platform
import re
from collections.abc import Iterator
from dataclasses import replace

from table_io.clock import local_datetime
from table_io.records import Event, RunStart
from twin.recording.reader import Recording
from twin.run.versions import read_installed_versions

CUT_EVENT_KIND = "cut"


def iter_start_records(
    recording: Recording, run: str, model_toml: str, first: int, predictions_every: int
) -> Iterator[RunStart | Event]:
    """Yield the start record of a replay from sample `first`, and its provenance events.

    Host, time and versions are those of the replay; the recording keeps its own.
    """
    yield replace(
        recording.start,
        index=first,
        run=run,
        model_toml=model_toml,
        versions=dict(read_installed_versions()),
        host=platform.node(),
        started_at=local_datetime().isoformat(timespec="seconds"),
        predictions_every=predictions_every,
    )
    content = recording.metadata.get("content", {}).get("sha256")
    description = f"sha256 of its content {content}" if content else "which was never finished"
    yield Event(first, "replay", f"replay of {recording.run}, {description}")
    if first > recording.start.index:
        yield Event(first, CUT_EVENT_KIND, f"from {recording.run} at sample {first}")


def find_earlier_run(recording: Recording) -> str:
    """Return the run with the samples before a recording of some steps, "" for a full recording.

    The twin of such a log started earlier, so a replay of the log alone has another state.
    """
    for event in recording.records(Event):
        match = re.fullmatch(r"from (.*) at sample \d+", event.text)
        if event.kind == CUT_EVENT_KIND and event.index == recording.start.index and match:
            return match[1]
    return ""
