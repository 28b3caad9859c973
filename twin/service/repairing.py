"""A damaged recording as a new whole file: all that is left, and a Gap for what is not."""

import hashlib
from pathlib import Path

from table_io.card import BadInput
from table_io.records import Event, Gap
from twin.service.verifying import Verified, examine, holes
from twin.stream.mcap_log import LogWriter
from twin.stream.wire import Item, encode, topic


def repaired(verified: Verified, paths: list[Path], new: Path) -> str:
    """Write what is left of a log to `new` and read it back; a sentence about it."""
    recording = verified.recording
    lost = holes(recording)
    told = Event(0, "repaired", f"from {', '.join(path.name for path in paths)}: {_told(verified)}")
    added: list[Item] = [told, *(Gap(first, count, "", "lost") for first, count in lost)]
    entries = [
        (item.index, one.topic, one.payload, one.publish_time)
        for item, one in zip(recording.items, verified.messages, strict=True)
    ]
    entries += [(item.index, topic(item), encode(item, recording.run), 0) for item in added]
    writer = LogWriter(new, recording.start.rate_hz)
    try:
        writer.describe(recording.start)
        writer.note("repaired", _origin(verified, paths))
        for index, name, payload, at in sorted(entries, key=lambda entry: entry[0]):
            writer.write(name, payload, index, at or None)
        writer.close()
        again = examine([new])
        if again.found["damage"] or len(again.messages) != len(entries):
            raise BadInput(
                f"{new}: differs from what was read; keep {paths[0]} and try another disk"
            )
    except BaseException:
        new.unlink()  # this call made it; half a file would refuse the next try
        raise
    return f"{len(entries)} messages, {sum(count for _, count in lost)} samples marked as lost"


def _told(verified: Verified) -> str:
    damage = verified.found["damage"]
    return "; ".join(one["reason"] for one in damage[:5]) or "nothing was damaged"


def _origin(verified: Verified, paths: list[Path]) -> dict[str, str]:
    """What the metadata record says of the files that were repaired."""
    about = {"lost_samples": str(verified.found["samples"]["missing"]), "damage": _told(verified)}
    for number, path in enumerate(paths, 1):
        with path.open("rb") as file:
            about[f"from_{number}"] = path.name
            about[f"sha256_{number}"] = hashlib.file_digest(file, "sha256").hexdigest()
    return about
