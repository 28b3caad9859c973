"""What is in a log: schema version, attachments, hashes, and which of the twin's blocks.

`LOG.md` in this folder specifies the format.
"""

import hashlib
import json
import math
import tomllib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from table_io.block import Block
from table_io.errors import InputError
from table_io.records import RunStart
from twin.transport.codec import encode_item

SCHEMA_VERSION = 4
START_COPY_NAME = "start.pb"
RECORDED_EVERY = 10  # blocks, where not all are recorded
Metadata = dict[str, dict[str, str]]  # metadata record by name, its values by key


class ContentHash:
    """Content hash (sha256) and message counts of a log, over messages in file order."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._counts: Counter[str] = Counter()

    def add(self, topic: str, log_time: int, payload: bytes) -> None:
        """Add one message; `log_time` in ns."""
        self.add_all(topic, [log_time], [payload])

    def add_all(self, topic: str, log_times: Sequence[int], payloads: Sequence[bytes]) -> int:
        """Add messages of one topic; return how many of it came before."""
        name, before = topic.encode(), self._counts[topic]
        lines = [
            b"%s %d %d\n%s" % (name, log_time, len(payload), payload)
            for log_time, payload in zip(log_times, payloads, strict=True)
        ]
        self._hash.update(b"".join(lines))
        self._counts[topic] += len(lines)
        return before

    def to_metadata(self) -> dict[str, str]:
        """Return the values of the metadata record "content"."""
        counts = {topic: str(self._counts[topic]) for topic in sorted(self._counts)}
        return {
            "sha256": self._hash.hexdigest(),
            "messages": str(self._counts.total()),
            **counts,
        }


def read_schema_version(path: Path, metadata: Metadata) -> int:
    """Return the schema version of a log, 1 if not stated; raise InputError if unsupported."""
    text = metadata.get("run", {}).get("schema", "1")
    version = int(text) if text.isdecimal() and len(text) < 9 else 0
    if not 1 <= version <= SCHEMA_VERSION:
        raise InputError(
            f"written in schema version {text}",
            where=path,
            allowed=f"1 to {SCHEMA_VERSION}",
            remedy="install a newer shaketwin (the log states its version under `versions`)",
        )
    return version


def build_attachments(start: RunStart) -> dict[str, bytes]:
    """Return the attachments of a run's log by name.

    `start.pb` is a copy of the start record, in case the chunk that holds the record is lost.
    """
    return {
        "profile.toml": start.profile_toml.encode(),
        "rig.toml": start.rig_toml.encode(),
        "model.toml": start.model_toml.encode(),
        "calibration.json": build_calibration_json(start).encode(),
        START_COPY_NAME: encode_item(start, start.run),
    }


def hash_attachments(texts: dict[str, bytes]) -> dict[str, str]:
    """Return the values of the metadata record "attachments": sha256 of each by name."""
    return {name: hashlib.sha256(data).hexdigest() for name, data in texts.items()}


def find_altered_attachments(metadata: Metadata, texts: dict[str, bytes]) -> list[str]:
    """Return the names of missing or altered attachments; none for schema version 1."""
    recorded = metadata.get("attachments", {})
    actual = hash_attachments(texts)
    return sorted(name for name, digest in recorded.items() if actual.get(name) != digest)


def build_calibration_json(start: RunStart) -> str:
    """Return the calibration of each channel as JSON: value = volts / volts_per_unit - tare.

    `tare_si` is in the channel's SI unit, null for a sensor without a signal during the tare.
    """
    try:
        sensors = tomllib.loads(start.rig_toml).get("sensors", [])
    except tomllib.TOMLDecodeError:
        sensors = []
    kept_keys = ("unit", "range", "volts_per_unit", "bits")
    channels: dict[str, dict[str, object]] = {name: {} for name in start.channels}
    for sensor in sensors if isinstance(sensors, list) else []:
        if isinstance(sensor, dict) and sensor.get("channel") in channels:
            channels[sensor["channel"]] = {key: sensor[key] for key in kept_keys if key in sensor}
    for name, value in start.tare.items():
        tare = value if math.isfinite(value) else None
        channels.setdefault(name, {})["tare_si"] = tare
    return json.dumps(channels, indent=1, default=str) + "\n"


def select_recorded(block: Block, start: RunStart) -> list[Block]:
    """Return the parts of a block that are recorded, of the twin's output every n-th block.

    Blocks are counted by sample index, so that the selection does not depend on their boundaries.
    A block that is recorded whole is returned itself.
    """
    every, size = start.predictions_every, start.block_samples
    if block.stream != "pred" or start.has_all_predictions:
        return [block]
    period = every * size
    begins = range(block.index - block.index % period, block.end, period)
    inside = ((max(begin, block.index), min(begin + size, block.end)) for begin in begins)
    parts = [(first, end) for first, end in inside if first < end]
    if parts == [(block.index, block.end)]:
        return [block]
    return [block.cut(first, end) for first, end in parts]
