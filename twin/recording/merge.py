"""Merge of the parts of a recording into one log: external sort with bounded memory."""

import contextlib
import heapq
import os
import shutil
from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory

from table_io.errors import InputError
from table_io.records import RunStart
from twin.recording.columns import TOPIC_ORDER
from twin.recording.log_metadata import START_COPY_NAME, ContentHash, read_schema_version
from twin.recording.mcap_log import LogWriter, iter_messages, read_leading_metadata, read_metadata
from twin.recording.reader import START_TOPIC
from twin.recording.recovery import UNFINISHED_REASON, LogMessage, ends_whole, recover_log
from twin.recording.run_paths import PARTS_FOLDER
from twin.system.files import lock_file
from twin.system.terminal import print_line
from twin.transport.codec import WireError, decode_item

SORTED_RUN_BYTES = 32 * 2**20  # sorted in memory at once
CHUNK_BYTES = 2**16  # in memory of each sorted run while they are merged
MESSAGE_OVERHEAD_BYTES = 250  # memory of a message in addition to its payload


def merge(parts: list[Path], out: Path, run_bytes: int = SORTED_RUN_BYTES) -> int:
    """Merge the messages of all parts into `out` by sample index, without duplicates.

    Returns the number of messages; the parts are not changed. Data beyond `run_bytes` are sorted
    in temporary files next to `out`. Raises InputError if `out` exists or a part has a newer schema
    version than `out` would state.
    """
    for part in parts:
        read_schema_version(part, read_leading_metadata(part))
    start = _find_start(parts)
    writer = LogWriter(out, start.rate_hz)
    try:
        writer.write_run_description(start)
        with TemporaryDirectory(prefix=".merging-", dir=out.parent) as folder:
            runs = list(_iter_sorted_runs(parts, Path(folder), start.rate_hz, run_bytes))
            count = _write_messages(
                writer, _drop_duplicates(heapq.merge(*runs, key=_sort_key)), start.rate_hz
            )
        writer.close()
    except BaseException:
        out.unlink()  # this call made it
        raise
    return count


def verify_log(path: Path) -> bool:
    """Verify a log: True if it is finished and its messages match its content hash."""
    content = ContentHash()
    try:
        for message in iter_messages(path):
            content.add(message.topic, message.log_time, message.payload)
        return ends_whole(path) and read_metadata(path).get("content") == content.to_metadata()
    except InputError:
        return False  # not a log


def _find_start(parts: list[Path]) -> RunStart:
    for payload in chain.from_iterable(map(_iter_start_payloads, parts)):
        with contextlib.suppress(WireError):
            start = decode_item(START_TOPIC, payload)[1]
            assert isinstance(start, RunStart)
            return start
    raise InputError(
        "holds no start record",
        where=parts[0],
        remedy="the parts are kept; see what they hold with "
        f"`shaketwin verify {parts[0].parent.parent}`",
    )


def _iter_start_payloads(part: Path) -> Iterator[bytes]:
    """Yield the start records of a part, then its attached copy, in case their chunk was lost."""
    yield from (message.payload for message in iter_messages(part) if message.topic == START_TOPIC)
    yield from filter(
        None, [recover_log(part, frozenset({START_TOPIC})).attachments.get(START_COPY_NAME)]
    )


def _sort_key(message: LogMessage) -> tuple[int, int, bytes]:
    return message.log_time, TOPIC_ORDER[message.topic], message.payload


def _iter_sorted_runs(
    parts: list[Path], folder: Path, rate_hz: float, run_bytes: int
) -> Iterator[Iterable[LogMessage]]:
    """Yield the messages of all parts as sorted runs: the last in memory, the others in files."""
    pending: list[LogMessage] = []
    size = 0
    for message in chain.from_iterable(map(iter_messages, parts)):
        if message.topic not in TOPIC_ORDER:
            continue
        pending.append(message)
        size += len(message.payload) + MESSAGE_OVERHEAD_BYTES
        if size > run_bytes:
            path = folder / f"{len(list(folder.iterdir())):06d}.mcap"
            writer = LogWriter(path, rate_hz, CHUNK_BYTES)
            _write_messages(writer, sorted(pending, key=_sort_key), rate_hz)
            writer.close()
            yield iter_messages(path)
            pending, size = [], 0
    yield sorted(pending, key=_sort_key)


def _drop_duplicates(messages: Iterable[LogMessage]) -> Iterator[LogMessage]:
    """Yield sorted messages without duplicates; copies of two recorders differ in publish_time."""
    previous = None
    for message in messages:
        if previous is None or _sort_key(message) != _sort_key(previous):
            yield message
        previous = message


def _write_messages(writer: LogWriter, messages: Iterable[LogMessage], rate_hz: float) -> int:
    count = 0
    for message in messages:
        index = round(message.log_time * rate_hz / 1e9)
        writer.write(message.topic, message.payload, index, message.publish_time)
        count += 1
    return count


LOCK_FILE = "lock"  # held shared by supervisor and recorder while they run


def merge_run_parts(folder: Path) -> Path:
    """Merge the parts of a recording into run.mcap and return its path.

    The parts are kept until the log is verified and synced to the disk.
    """
    parts_folder = folder / PARTS_FOLDER
    out = folder / "run.mcap"
    try:
        with (parts_folder / LOCK_FILE).open("a") as lock:
            lock_file(lock, exclusive=True)
            parts = sorted(parts_folder.glob("part-*.mcap"))
            if out.exists():  # an earlier call ended before it deleted the parts
                if not verify_log(out):
                    raise InputError(
                        f"not a complete log; its parts are in {parts_folder}",
                        where=out,
                        remedy=f"move it to another folder, then: shaketwin report {folder}",
                    )
            elif not parts:
                raise InputError("the recorder wrote nothing", where=folder)
            else:
                _merge_verified(parts, parts_folder / "run.mcap", folder).rename(out)
                _sync(folder)
            shutil.rmtree(parts_folder)
    except BlockingIOError:
        raise InputError(
            "a run is still recording into this folder", where=folder, remedy="wait until it ends"
        ) from None
    except OSError as error:
        raise InputError(
            f"{error.strerror}; the recording is kept in {parts_folder} and readable",
            where=error.filename or folder,
            remedy=f"correct the cause, then: shaketwin report {folder}",
        ) from None
    return out


def _merge_verified(parts: list[Path], new: Path, folder: Path) -> Path:
    """Merge the parts into one log, verified by its content hash and synced to the disk."""
    intact = [part for part in parts if verify_log(part)]
    if len(parts) == 1 and intact:
        new = parts[0]
    else:
        new.unlink(missing_ok=True)  # left by an interrupted attempt
        merge(parts, new)
        if not verify_log(new):
            raise InputError(
                "the merged log differs from what was written; its parts are kept next to it",
                where=new,
                remedy=f"check the disk, then: shaketwin report {folder}",
            )
        # Before the log is renamed: once run.mcap exists, the parts are deleted.
        _keep_damaged(
            [part for part in parts if part not in intact and _has_inner_damage(part)],
            folder / "damaged",
        )
    _sync(new)
    return new


def _has_inner_damage(part: Path) -> bool:
    """Return True if a part is damaged before its end, as by a disk error."""
    size = part.stat().st_size
    return any(
        damage.reason != UNFINISHED_REASON
        if damage.size == 0
        else damage.offset + damage.size < size
        for damage in recover_log(part).damage
    )


def _keep_damaged(parts: list[Path], folder: Path) -> None:
    """Copy damaged parts to `folder`: another tool may recover more of them."""
    if not parts:
        return
    folder.mkdir(exist_ok=True)  # may be left by an interrupted attempt
    for part in parts:
        shutil.copy2(part, folder)
        _sync(folder / part.name)
    print_line(
        f"{len(parts)} parts of the recording are damaged; they are kept in {folder}: see verify"
    )


def _sync(path: Path) -> None:
    """Sync a file or a folder's directory entries to the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
