"""What a replay's log says of where it comes from: the recording, and whose beginning it lacks."""

import platform
import re
from collections.abc import Iterator
from dataclasses import replace

from table_io.clock import today
from table_io.records import Event, RunStart
from twin.service.versions import installed
from twin.stream.recording import Recording

CUT = "cut"


def begun(
    recording: Recording, run: str, model_toml: str, first: int
) -> Iterator[RunStart | Event]:
    """The start of the replay `run` from sample `first` on, made here and now, and of what it is.

    The versions are those that make it: the recorded ones stand in the recording.
    """
    yield replace(
        recording.start,
        index=first,
        run=run,
        model_toml=model_toml,
        versions=dict(installed()),
        host=platform.node(),
        started_at=today().isoformat(timespec="seconds"),
    )
    content = recording.metadata.get("content", {}).get("sha256")
    told = f"sha256 of its content {content}" if content else "which was never finished"
    yield Event(first, "replay", f"replay of {recording.run}, {told}")
    if first > recording.start.index:
        yield Event(first, CUT, f"from {recording.run} at sample {first}")


def beginning(recording: Recording) -> str:
    """The run that holds what came before a recording of some steps of it; else nothing.

    The twin of such a log began earlier, so that a replay of it alone comes to another state.
    """
    for one in recording.of(Event):
        known = re.fullmatch(r"from (.*) at sample \d+", one.text)
        if one.kind == CUT and one.index == recording.start.index and known:
            return known[1]
    return ""
