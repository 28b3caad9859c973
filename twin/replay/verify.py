"""`verify`: check the integrity of a recording, locate damage and gaps, and repair it."""

import hashlib
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rich.table import Table

from table_io.errors import InputError
from table_io.records import Comparison, Event, PredictionHash, SampleGap
from twin.recording.log_metadata import ContentHash, find_altered_attachments, read_schema_version
from twin.recording.mcap_log import LogWriter
from twin.recording.reader import Recording, select_messages
from twin.recording.recovery import Damage, LogMessage, RecoveredLog, recover_log
from twin.recording.run_paths import explain_unmerged_parts as scattered
from twin.results.contract import format_json
from twin.results.recordings import list_parts, read_recorded_config
from twin.results.sensor_table import SensorRow, build_sensor_rows
from twin.system.exit_codes import EXIT_GAPS
from twin.system.terminal import console, print_line, print_table
from twin.system.versions import (
    VersionPairs,
    compare_versions,
    find_version_changes,
    format_version_changes,
)
from twin.transport.codec import Item, encode_item, topic_for

MAX_LISTED = 10  # lines per list
CONTENT_TEXTS = {
    "same": "matches its hash",
    "differs": "differs from its hash",
    "unknown": "without a hash (an unfinished log, or one of version 1)",
}


@dataclass(frozen=True, slots=True)
class TopicCount:
    """Messages of a topic, and those missing by sequence number, from 0."""

    messages: int
    missing: int


@dataclass(frozen=True, slots=True)
class SampleCount:
    """Measured samples of a recording; `stopped` is the verdict, None without an end."""

    rate_hz: float
    acquired: int
    missing: int
    planned: int
    stopped: str | None


@dataclass(frozen=True, slots=True)
class PredictionCount:
    """Samples of the twin's output: recorded, of every n-th block, and hashed."""

    every: int
    recorded: int
    hashed: int


@dataclass(frozen=True, slots=True)
class ListedGap:
    """Samples that are missing or invalid, of one channel or of all ("")."""

    first: int
    count: int
    channel: str
    reason: str


@dataclass(frozen=True, slots=True)
class ListedDamage:
    """Unreadable range of a file: `bytes` from `byte` on."""

    byte: int
    bytes: int
    reason: str


@dataclass(frozen=True, slots=True)
class ReplayOutlook:
    """Whether a log can be replayed, to the bit, and what prevents it."""

    possible: bool
    identical: bool
    because: list[str]


@dataclass(frozen=True, slots=True)
class VerificationReport:
    """Report of `verify`; the fields, in this order, are the keys of `--json`."""

    log: list[str]
    bytes: int
    run: str
    profile: str
    started_at: str
    schema: int | None
    content: str  # a key of CONTENT_TEXTS
    altered: list[str]
    versions: VersionPairs
    sensors: list[SensorRow]
    topics: dict[str, TopicCount]
    samples: SampleCount
    predictions: PredictionCount
    gaps: list[ListedGap]
    damage: list[ListedDamage]
    repaired: dict[str, str]
    apart: list[str]
    sound: bool
    replay: ReplayOutlook


@dataclass(frozen=True, slots=True)
class Verification:
    """Recording, the messages of its items, and the report."""

    recording: Recording
    messages: list[LogMessage]
    report: VerificationReport


def verify_logs(logs: list[Path], as_json: bool, repair: Path | None) -> int:
    """Verify a log or its parts, print the report, repair if asked; return the exit code."""
    verification = verify(*logs)
    if as_json:
        print(format_json(asdict(verification.report)))
    else:
        print_verification(verification.report, advise=repair is None)
    if repair is not None:
        sentence = repair_log(verification, repair)
        if not as_json:
            print_line(f"repaired -> {repair}: {sentence}")
    return 0 if verification.report.sound else EXIT_GAPS


def verify(*logs: str | Path) -> Verification:
    """Verify that a recording, in a log, a run's folder or parts, is whole and can be replayed.

    `repair_log(verification, new)` writes what is left of a damaged one to a new log. InputError if
    no recording can be read.
    """
    folders = [Path(log) for log in logs]
    paths = [part for folder in folders for part in list_parts(folder)]
    return examine_logs(paths, [text for folder in folders if (text := scattered(folder))])


def examine_logs(paths: list[Path], unmerged: Sequence[str] = ()) -> Verification:
    """Examine a log or the parts of one; InputError if no recording can be read.

    `unmerged` has a sentence for each folder whose parts were not merged.
    """
    parts = [recover_log(path) for path in paths]
    recording, messages = select_messages(paths[0], _join_parts(paths, parts))
    start = recording.start
    unrecorded = find_unrecorded_gaps(recording)
    content = _check_content(parts)
    gaps = [ListedGap(*hole, "", "missing in this file") for hole in unrecorded]
    gaps += [ListedGap(*hole, "", "no end was recorded") for hole in find_missing_end(recording)]
    gaps += [
        ListedGap(gap.index, gap.count, gap.channel, gap.reason)
        for gap in recording.records(SampleGap)
    ]
    damage = [ListedDamage(entry.offset, entry.size, entry.reason) for entry in recording.damage]
    if content == "differs":
        damage.append(ListedDamage(0, 0, "the messages are not those that were written"))
    altered = find_altered_attachments(recording.metadata, recording.attachments)
    report = VerificationReport(
        log=[str(path) for path in paths],
        bytes=sum(path.stat().st_size for path in paths),
        run=recording.run,
        profile=start.name,
        started_at=start.started_at,
        schema=_read_schema_version(paths[0], recording),
        content=content,
        altered=altered,
        versions=compare_versions(start.versions),
        sensors=build_sensor_rows(start),
        topics=count_messages(parts),
        samples=SampleCount(
            start.rate_hz,
            sum(map(len, recording.contiguous_blocks("meas"))),
            recording.missing_samples,
            start.planned_samples,
            recording.stop.verdict if recording.stop else None,
        ),
        predictions=PredictionCount(
            max(start.predictions_every, 1),
            sum(map(len, recording.contiguous_blocks("pred"))),
            sum(entry.count for entry in recording.records(PredictionHash)),
        ),
        gaps=gaps,
        damage=damage,
        repaired=recording.metadata.get("repaired", {}),
        apart=list(unmerged),
        sound=not (damage or gaps or altered or unmerged),
        replay=assess_replay(recording),
    )
    return Verification(recording, messages, report)


def find_unrecorded_gaps(recording: Recording) -> list[tuple[int, int]]:
    """Return (first, count) of measured samples that are missing without a recorded gap."""
    gaps = {
        (gap.index, gap.count)
        for gap in recording.records(SampleGap)
        if not gap.channel and gap.count > 0
    }
    pieces = recording.contiguous_blocks("meas")
    last = recording.stop.index if recording.stop else (pieces[-1].end if pieces else 0)
    inner_edges = (edge for piece in pieces for edge in (piece.index, piece.end))
    edges = [recording.start.index, *inner_edges, last]
    holes = [
        (first, end - first) for first, end in zip(edges[::2], edges[1::2], strict=True)
        if end > first
    ]  # fmt: skip
    return [hole for hole in holes if hole not in gaps]


def find_missing_end(recording: Recording) -> list[tuple[int, int]]:
    """Return (first, count) of the planned samples after the end of a log without stop record.

    Such a log is incomplete even if no planned sample is missing: the count may be 0.
    """
    if recording.stop is not None:
        return []
    pieces = recording.contiguous_blocks("meas")
    end = pieces[-1].end if pieces else recording.start.index
    return [(end, max(recording.start.planned_samples - end, 0))]


def count_messages(parts: list[RecoveredLog]) -> dict[str, TopicCount]:
    """Count the messages of each topic, and those missing by sequence number, from 0."""
    count: dict[str, int] = defaultdict(int)
    missing: dict[str, int] = defaultdict(int)
    for part in parts:
        numbers: dict[str, set[int]] = defaultdict(set)
        for message in part.messages:
            numbers[message.topic].add(message.sequence)
            count[message.topic] += 1
        stated = part.metadata.get("content", {})
        for topic in {*numbers, *(name for name in stated if name.startswith("/"))}:
            sequences = numbers[topic]
            text = stated.get(topic, "")
            stated_count = int(text) if text.isdecimal() and len(text) < 16 else 0
            missing[topic] += max(stated_count, max(sequences, default=-1) + 1) - len(sequences)
    return {topic: TopicCount(count[topic], missing[topic]) for topic in sorted({*count, *missing})}


def assess_replay(recording: Recording) -> ReplayOutlook:
    """Assess whether a log can be replayed, and what prevents bitwise identity."""
    reasons = []
    try:
        if "table_acc_m_s2" not in recording.start.channels:
            raise InputError("no channel table_acc_m_s2, which drives the twin")
        if not recording.contiguous_blocks("meas"):
            raise InputError("no measured samples")
        read_recorded_config(recording)
    except InputError as error:
        return ReplayOutlook(False, False, [str(error)])
    if recording.missing_samples:
        reasons.append(f"{recording.missing_samples} samples are missing")
    if log_of_beginning := recording.earlier_run:
        reasons.append(f"its beginning is in {log_of_beginning}")
    if version_changes := format_version_changes(find_version_changes(recording.start.versions)):
        reasons.append(f"versions differ: {version_changes}")
    if not recording.records(Comparison):
        reasons.append("no comparisons were recorded")
    elif not recording.is_intact:
        reasons.append("damaged: comparisons may be missing")
    return ReplayOutlook(True, not reasons, reasons)


def _join_parts(paths: list[Path], parts: list[RecoveredLog]) -> RecoveredLog:
    """Join the parts of a recording without duplicates; each part has its own sequence numbers."""
    if len(parts) == 1:
        return parts[0]
    runs = {part.metadata["run"].get("id", "") for part in parts if "run" in part.metadata}
    if len(runs) > 1:
        raise InputError(
            f"of different runs ({', '.join(sorted(runs)[:5])})",
            where=f"{paths[0]} and {paths[-1]}",
            remedy="give the parts of one run, or verify them one by one",
        )
    joined = RecoveredLog(topics=frozenset().union(*(part.topics for part in parts)))
    messages: dict[tuple[str, bytes], LogMessage] = {}  # without duplicates of two recorders
    for path, part in zip(paths, parts, strict=True):
        for message in part.messages:
            messages.setdefault((message.topic, message.payload), message)
        joined.metadata |= part.metadata
        joined.attachments |= part.attachments
        joined.damage += [
            replace(damage, reason=f"{path.name}: {damage.reason}") for damage in part.damage
        ]
    joined.messages = list(messages.values())
    joined.damage.append(Damage(0, 0, f"{len(parts)} parts that were not put together"))
    return joined


def _read_schema_version(path: Path, recording: Recording) -> int | None:
    try:
        return read_schema_version(path, recording.metadata)
    except InputError:
        return None  # damaged file, reported as damage


def _check_content(parts: list[RecoveredLog]) -> str:
    """Return "same" or "differs" by the content hash, "unknown" if a file has none."""
    state = "same"
    for part in parts:
        stated = part.metadata.get("content")
        if stated is None:
            return "unknown"
        content = ContentHash()
        for message in part.messages:
            content.add(message.topic, message.log_time, message.payload)
        if content.to_metadata() != stated:
            state = "differs"
    return state


def print_verification(report: VerificationReport, advise: bool = True) -> None:
    """Print the report of `verify`, with advice on repair unless `advise` is False."""
    samples, rate_hz = report.samples, report.samples.rate_hz
    seconds = samples.acquired / rate_hz
    end = samples.stopped or "without an end"
    print_line(f"{', '.join(report.log)}: run {report.run} of {report.started_at}")
    print_line(
        f"  {samples.acquired} samples at {rate_hz:g} Hz ({seconds:.1f} s), {end}; "
        f"schema version {report.schema}; content {CONTENT_TEXTS[report.content]}"
    )
    print_line(f"  twin: {_describe_predictions(report.predictions)}")
    table = Table("topic", "messages", "missing", box=None)
    for topic, counts in report.topics.items():
        table.add_row(topic, str(counts.messages), str(counts.missing or ""))
    print_table(console, table)
    for sensor in report.sensors:
        if text := _describe_sensor(sensor):
            print_line(f"sensor {sensor.channel}: {text}")
    for attachment in report.altered:
        print_line(f"altered: attachment {attachment} is not what was written")
    _print_limited("damage", [_describe_damage(damage) for damage in report.damage])
    _print_limited("dropout", [_describe_gap(gap, rate_hz) for gap in report.gaps])
    reasons = report.replay.because
    reason = f": {'; '.join(reasons)}" if reasons else ""
    if not report.replay.possible:
        print_line(f"cannot be replayed{reason}")
    elif report.replay.identical:
        print_line("can be replayed, to the bit")
    else:
        print_line(f"can be replayed, but perhaps not to the bit{reason}")
    if report.repaired:
        names = (name for key, name in report.repaired.items() if key.startswith("from_"))
        print_line(f"repaired: from {', '.join(names)}: {report.repaired.get('damage', '')}")
    if report.apart:
        for sentence in report.apart:
            print_line(sentence)
    elif report.damage or report.altered:
        advice = "; `--repair NEW` writes what is left as a whole file" if advise else ""
        print_line(f"damaged{advice}")
    else:
        print_line("whole" if report.sound else "the file is whole, the recording has dropouts")


def _describe_predictions(predictions: PredictionCount) -> str:
    """Format which predictions are recorded."""
    samples = f"{predictions.recorded} samples of its output"
    if predictions.every <= 1:
        return samples
    return (
        f"{samples}, every {predictions.every}th block, and hashes of "
        f"{predictions.hashed}; a replay recomputes the rest and compares"
    )


def _describe_sensor(sensor: SensorRow) -> str:
    """Format the instrument data of a sensor's config, "" if there is none."""
    due = f"due {sensor.due}{', OVERDUE when the run began' if sensor.overdue else ''}"
    parts = (
        sensor.instrument,
        sensor.serial and f"serial {sensor.serial}",
        sensor.calibrated and f"calibrated {sensor.calibrated}",
        sensor.due and due,
        sensor.certificate and f"certificate {sensor.certificate}",
        sensor.checked and f"checked {sensor.checked}",
    )
    return ", ".join(filter(None, parts))


def _describe_damage(damage: ListedDamage) -> str:
    place = f"bytes {damage.byte} to {damage.byte + damage.bytes}: " if damage.bytes else ""
    return f"{place}{damage.reason}"


def _describe_gap(gap: ListedGap, rate: float) -> str:
    first, count = gap.first, gap.count
    channel = f" of {gap.channel}" if gap.channel else ""
    if not count:
        return f"from sample {first}{channel} (at {first / rate:.3f} s): {gap.reason}"
    return (
        f"samples {first} to {first + count - 1}{channel} (at {first / rate:.3f} s, "
        f"{count / rate:.4g} s): {gap.reason}"
    )


def _print_limited(label: str, lines: list[str]) -> None:
    for line in lines[:MAX_LISTED]:
        print_line(f"{label}: {line}")
    if len(lines) > MAX_LISTED:
        print_line(f"{label}: and {len(lines) - MAX_LISTED} more; see --json")


def repair_log(verification: Verification, new: str | Path) -> str:
    """Write the readable messages of a log to `new`, verify it, and return a summary."""
    new = Path(new)
    recording = verification.recording
    paths = [Path(path) for path in verification.report.log]
    gaps = find_unrecorded_gaps(recording)
    event = Event(
        0,
        "repaired",
        f"from {', '.join(path.name for path in paths)}: {_summarize_damage(verification)}",
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
        if reread.report.damage or len(reread.messages) != len(entries):
            raise InputError(
                "differs from what was read",
                where=new,
                remedy=f"keep {paths[0]} and try another disk",
            )
    except BaseException:
        new.unlink()  # an incomplete file would block the next attempt
        raise
    return f"{len(entries)} messages, {sum(count for _, count in gaps)} samples marked as lost"


def _summarize_damage(verification: Verification) -> str:
    damage = verification.report.damage
    return "; ".join(entry.reason for entry in damage[:5]) or "nothing was damaged"


def _make_provenance(verification: Verification, paths: list[Path]) -> dict[str, str]:
    """Return the metadata of a repair: damage, and names and SHA-256 of the source files."""
    provenance = {
        "lost_samples": str(verification.report.samples.missing),
        "damage": _summarize_damage(verification),
    }
    for number, path in enumerate(paths, 1):
        with path.open("rb") as file:
            provenance[f"from_{number}"] = path.name
            provenance[f"sha256_{number}"] = hashlib.file_digest(file, "sha256").hexdigest()
    return provenance
