"""`verify`: whether a recording is whole, and what of it is lost, and where."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from table_io.card import BadInput
from table_io.records import Comparison, Gap
from twin.service.origin import beginning
from twin.service.outcome import EXIT_GAPS
from twin.service.recordings import parts_of, recorded_bundle
from twin.service.sensor_rows import sensor_rows
from twin.service.versions import beside_installed, changes, differing
from twin.stream.content import Content, altered, schema_version
from twin.stream.folder import apart as scattered
from twin.stream.recording import Recording, understood
from twin.stream.salvage import Damage, Message, Salvaged, salvage

Json = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Verified:
    """A recording, the messages of its items, and what was found about it, as `--json` has it."""

    recording: Recording
    messages: list[Message]
    found: Json


def verify(logs: list[Path], as_json: bool, repair: Path | None) -> int:
    """Say what is in a log, or in the parts of one; the exit code."""
    from twin.service.summary import dumps
    from twin.service.terminal import say
    from twin.service.verified_table import print_verified

    paths = [part for log in logs for part in parts_of(log)]
    verified = examine(paths, [why for log in logs if (why := scattered(log))])
    if as_json:
        print(dumps(verified.found))
    else:
        print_verified(verified.found, advise=repair is None)
    if repair is not None:
        from twin.service.repairing import repaired

        again = repaired(verified, paths, repair)
        if not as_json:
            say(f"repaired -> {repair}: {again}")
    return 0 if verified.found["sound"] else EXIT_GAPS


def examine(paths: list[Path], apart: Sequence[str] = ()) -> Verified:
    """What is in a log, or in several parts of one; BadInput where there is none.

    `apart`: a sentence for each folder whose parts were not put together.
    """
    parts = [salvage(path) for path in paths]
    recording, messages = understood(paths[0], _joined(paths, parts))
    start = recording.start
    lost = holes(recording)
    found: Json = {
        "log": [str(path) for path in paths],
        "bytes": sum(path.stat().st_size for path in paths),
        "run": recording.run,
        "profile": start.name,
        "started_at": start.started_at,
        "schema": _schema(paths[0], recording),
        "content": _content(parts),
        "altered": altered(recording.metadata, recording.attachments),
        "versions": beside_installed(start.versions),
        "sensors": [asdict(one) for one in sensor_rows(start)],
        "topics": topics(parts),
        "samples": {
            "rate_hz": start.rate_hz,
            "acquired": sum(map(len, recording.pieces("meas"))),
            "missing": recording.missing_samples,
            "planned": start.planned_samples,
            "stopped": recording.stop.verdict if recording.stop else None,
        },
        "gaps": [
            *({"first": first, "count": count, "channel": "", "reason": "missing in this file"}
              for first, count in lost),
            *({"first": first, "count": count, "channel": "", "reason": "no end was recorded"}
              for first, count in endless(recording)),
            *({"first": gap.index, "count": gap.count, "channel": gap.channel,
               "reason": gap.reason} for gap in recording.of(Gap)),
        ],
        "damage": [
            {"byte": one.at, "bytes": one.size, "reason": one.reason} for one in recording.damage
        ],
        "repaired": recording.metadata.get("repaired", {}),
        "apart": list(apart),
    }  # fmt: skip
    if found["content"] == "differs":
        found["damage"].append(
            {"byte": 0, "bytes": 0, "reason": "the messages are not those that were written"}
        )
    found["sound"] = not any(found[what] for what in ("damage", "gaps", "altered", "apart"))
    found["replay"] = replayable(recording)
    return Verified(recording, messages, found)


def holes(recording: Recording) -> list[tuple[int, int]]:
    """(first, count) of the measured samples that are neither there nor recorded as a gap."""
    gaps = {
        (gap.index, gap.count) for gap in recording.of(Gap) if not gap.channel and gap.count > 0
    }
    pieces = recording.pieces("meas")
    last = recording.stop.index if recording.stop else (pieces[-1].end if pieces else 0)
    inside = (edge for piece in pieces for edge in (piece.index, piece.end))
    edges = [recording.start.index, *inside, last]
    found = [
        (first, end - first) for first, end in zip(edges[::2], edges[1::2], strict=True)
        if end > first
    ]  # fmt: skip
    return [hole for hole in found if hole not in gaps]


def endless(recording: Recording) -> list[tuple[int, int]]:
    """(first, count) of the planned samples that may be lost: a log that has no end was longer.

    Without a stop record nobody knows whether the test was; so it is a gap even of no samples.
    """
    if recording.stop is not None:
        return []
    pieces = recording.pieces("meas")
    end = pieces[-1].end if pieces else recording.start.index
    return [(end, max(recording.start.planned_samples - end, 0))]


def topics(parts: list[Salvaged]) -> Json:
    """Messages of each topic, and how many are missing by their numbers, which count from 0."""
    count: dict[str, int] = defaultdict(int)
    missing: dict[str, int] = defaultdict(int)
    for part in parts:
        numbers: dict[str, set[int]] = defaultdict(set)
        for one in part.messages:
            numbers[one.topic].add(one.sequence)
            count[one.topic] += 1
        stated = part.metadata.get("content", {})
        for topic in {*numbers, *(name for name in stated if name.startswith("/"))}:
            there = numbers[topic]
            text = stated.get(topic, "")
            least = int(text) if text.isdecimal() and len(text) < 16 else 0
            missing[topic] += max(least, max(there, default=-1) + 1) - len(there)
    return {
        topic: {"messages": count[topic], "missing": missing[topic]}
        for topic in sorted({*count, *missing})
    }


def replayable(recording: Recording) -> Json:
    """Whether the log can be replayed, and what keeps that from giving the same to the bit."""
    but = []
    try:
        if "table_acc_m_s2" not in recording.start.channels:
            raise BadInput("no channel table_acc_m_s2, which drives the twin")
        if not recording.blocks("meas"):
            raise BadInput("no measured samples")
        recorded_bundle(recording)
    except BadInput as error:
        return {"possible": False, "identical": False, "because": [str(error)]}
    if recording.missing_samples:
        but.append(f"{recording.missing_samples} samples are missing")
    if before := beginning(recording):
        but.append(f"its beginning is in {before}")
    if changed := changes(differing(recording.start.versions)):
        but.append(f"versions differ: {changed}")
    if not recording.of(Comparison):
        but.append("no comparisons were recorded")
    elif not recording.whole:
        but.append("damaged: comparisons may be missing")
    return {"possible": True, "identical": not but, "because": but}


def _joined(paths: list[Path], parts: list[Salvaged]) -> Salvaged:
    """What several parts of a recording hold together; each has numbers of its own."""
    if len(parts) == 1:
        return parts[0]
    runs = {part.metadata["run"].get("id", "") for part in parts if "run" in part.metadata}
    if len(runs) > 1:
        raise BadInput(
            f"{paths[0]} and {paths[-1]}: of different runs ({', '.join(sorted(runs)[:5])}); give "
            "the parts of one run, or verify them one by one"
        )
    joined = Salvaged(topics=frozenset().union(*(part.topics for part in parts)))
    messages: dict[tuple[str, bytes], Message] = {}  # what two recorders wrote, once
    for path, part in zip(paths, parts, strict=True):
        for one in part.messages:
            messages.setdefault((one.topic, one.payload), one)
        joined.metadata |= part.metadata
        joined.attachments |= part.attachments
        joined.damage += [replace(one, reason=f"{path.name}: {one.reason}") for one in part.damage]
    joined.messages = list(messages.values())
    joined.damage.append(Damage(0, 0, f"{len(parts)} parts that were not put together"))
    return joined


def _schema(path: Path, recording: Recording) -> int | None:
    try:
        return schema_version(path, recording.metadata)
    except BadInput:
        return None  # of a damaged file: it was said


def _content(parts: list[Salvaged]) -> str:
    """ "same", "differs" or, where a file states no hash, "unknown"."""
    told = "same"
    for part in parts:
        stated = part.metadata.get("content")
        if stated is None:
            return "unknown"
        content = Content()
        for one in part.messages:
            content.add(one.topic, one.log_time, one.payload)
        if content.record() != stated:
            told = "differs"
    return told
