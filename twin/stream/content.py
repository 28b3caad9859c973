"""What a log says of itself: its schema version, the hashes of its texts and of its content.

`LOG.md` beside this file is the page of the format.
"""

import hashlib
import json
import math
import tomllib
from collections import Counter
from pathlib import Path

from table_io.card import BadInput
from table_io.records import RunStart
from twin.stream.wire import encode

SCHEMA_VERSION = 2
START_COPY = "start.pb"
Metadata = dict[str, dict[str, str]]  # by the name of its record, by key


class Content:
    """The hash and the counts of a log's messages, in the order in which they are added."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self._counts: Counter[str] = Counter()

    def add(self, topic: str, log_time: int, payload: bytes) -> None:
        """Take in one message; `log_time` in ns."""
        self._hash.update(b"%s %d %d\n" % (topic.encode(), log_time, len(payload)))
        self._hash.update(payload)
        self._counts[topic] += 1

    def record(self) -> dict[str, str]:
        """What stands in the metadata record "content"."""
        counts = {topic: str(self._counts[topic]) for topic in sorted(self._counts)}
        return {
            "sha256": self._hash.hexdigest(),
            "messages": str(self._counts.total()),
            **counts,
        }


def schema_version(path: Path, metadata: Metadata) -> int:
    """The schema version of a log, 1 where it says none; BadInput where it is newer than this."""
    text = metadata.get("run", {}).get("schema", "1")
    version = int(text) if text.isdecimal() and len(text) < 9 else 0
    if not 1 <= version <= SCHEMA_VERSION:
        raise BadInput(
            f"{path}: written in schema version {text}; this shaketwin reads 1 to "
            f"{SCHEMA_VERSION}. Install a newer one (the log names it under `versions`)"
        )
    return version


def attachments(start: RunStart) -> dict[str, bytes]:
    """What a log of this run carries beside its messages, by name.

    START_COPY is the start record once more: it outlives the chunk in which the first one stands.
    """
    return {
        "profile.toml": start.profile_toml.encode(),
        "rig.toml": start.rig_toml.encode(),
        "model.toml": start.model_toml.encode(),
        "calibration.json": calibration(start).encode(),
        START_COPY: encode(start, start.run),
    }


def hashes(texts: dict[str, bytes]) -> dict[str, str]:
    """What stands in the metadata record "attachments": the sha256 of each by name."""
    return {name: hashlib.sha256(data).hexdigest() for name, data in texts.items()}


def altered(metadata: Metadata, texts: dict[str, bytes]) -> list[str]:
    """Names of the attachments that are missing or not what was written; none for version 1."""
    recorded = metadata.get("attachments", {})
    found = hashes(texts)
    return sorted(name for name, digest in recorded.items() if found.get(name) != digest)


def calibration(start: RunStart) -> str:
    """JSON: how each channel came from volts, value = volts / volts_per_unit - tare.

    `tare` is in SI, of the channel's unit; null for a sensor that was lost when it was taken.
    """
    try:
        sensors = tomllib.loads(start.rig_toml).get("sensors", [])
    except tomllib.TOMLDecodeError:
        sensors = []
    known = ("unit", "range", "volts_per_unit", "bits")
    channels: dict[str, dict[str, object]] = {name: {} for name in start.channels}
    for sensor in sensors if isinstance(sensors, list) else []:
        if isinstance(sensor, dict) and sensor.get("channel") in channels:
            channels[sensor["channel"]] = {key: sensor[key] for key in known if key in sensor}
    for name, value in start.tare.items():
        tare = value if math.isfinite(value) else None
        channels.setdefault(name, {})["tare_si"] = tare
    return json.dumps(channels, indent=1, default=str) + "\n"
