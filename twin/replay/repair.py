"""Repair of a damaged recording: a new log of its readable messages, with gaps marked."""

import hashlib
from pathlib import Path

from table_io.errors import InputError
from table_io.records import Event, SampleGap
from twin.recording.mcap_log import LogWriter
from twin.replay.verify import Verification, examine_logs, find_unrecorded_gaps
from twin.transport.codec import Item, encode_item, topic_for


def write_repaired(verification: Verification, paths: list[Path], new: Path) -> str:
    """Write the readable messages of a log to `new`, verify it, and return a summary."""
    recording = verification.recording
    gaps = find_unrecorded_gaps(recording)
    event = Event(
        0,
        "repaired",
        f"from {', '.join(path.name for path in paths)}: {_describe_damage(verification)}",
    )
    added: list[Item] = [event, *(SampleGap(first, count, "", "lost") for first, count in gaps)]
    entries = [
        (item.index, message.topic, message.payload, message.publish_time)
        for item, message in zip(recording.items, verification.messages, strict=True)
    ]
    entries += [
        (item.index, topic_for(item), encode_item(item, recording.run), 0) for item in added
    ]
    writer = LogWriter(new, recording.start.rate_hz)
    try:
        writer.write_run_description(recording.start)
        writer.write_metadata("repaired", _make_provenance(verification, paths))
        for index, name, payload, time_ns in sorted(entries, key=lambda entry: entry[0]):
            writer.write(name, payload, index, time_ns or None)
        writer.close()
        reread = examine_logs([new])
        if reread.report["damage"] or len(reread.messages) != len(entries):
            raise InputError(
                "differs from what was read",
                where=new,
                remedy=f"keep {paths[0]} and try another disk",
            )
    except BaseException:
        new.unlink()  # an incomplete file would block the next attempt
        raise
    return f"{len(entries)} messages, {sum(count for _, count in gaps)} samples marked as lost"


def _describe_damage(verification: Verification) -> str:
    damage = verification.report["damage"]
    return "; ".join(entry["reason"] for entry in damage[:5]) or "nothing was damaged"


def _make_provenance(verification: Verification, paths: list[Path]) -> dict[str, str]:
    """Return the metadata of a repair: damage, and names and SHA-256 of the source files."""
    provenance = {
        "lost_samples": str(verification.report["samples"]["missing"]),
        "damage": _describe_damage(verification),
    }
    for number, path in enumerate(paths, 1):
        with path.open("rb") as file:
            provenance[f"from_{number}"] = path.name
            provenance[f"sha256_{number}"] = hashlib.file_digest(file, "sha256").hexdigest()
    return provenance
