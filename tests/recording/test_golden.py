"""Logs of every schema version stay readable to the bit; a newer one is refused by its number.

`golden/vN.mcap` was written by the code of version N: three steps of a sweep, 0.1 MB. A golden file
is never renewed; a new version adds its own.
"""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from table_io.records import PrcPoint
from tests.input_errors import raises_input_error
from tests.recording.example_run import START, run
from twin.log import open_log
from twin.recording import mcap_log
from twin.recording.log_metadata import (
    SCHEMA_VERSION,
    ContentHash,
    find_altered_attachments,
    read_schema_version,
)
from twin.recording.mcap_log import iter_messages, write_items
from twin.recording.merge import merge, verify_log
from twin.recording.reader import read_recording
from twin.recording.recovery import recover_log
from twin.recording.tabular import read_log_table

GOLDEN = Path(__file__).parent / "golden"
WRITTEN = {  # version: (sha256 of the content, messages, measured eta_d of each step)
    1: (
        "70ddf2c37d0a880db963d2f8aab209570f5333f5126c8bf431f5744aa9656648",
        129,
        (0.10615427913608139, 0.0819036788347143, 0.09453897270552923),
    ),
    2: (
        "4a1f4de8363cdc392e72b809a3de64bfc9bed7b66b659ad69224f525696b4725",
        129,
        (0.10615427913608139, 0.0819036788347143, 0.09453897270552923),
    ),
    3: (
        "02b81ec808ca97a864cf3b7fb903590f3eaac7daacf9e28104c4af8b55e97ac2",
        129,
        (0.10615427913608139, 0.0819036788347143, 0.09453897270552923),
    ),
    4: (
        "d50393099ebeadd4d75b22f3cf149e254aeb88baf68bd1b0d2d03f340f25d91f",
        107,
        (0.10615427913608139, 0.0819036788347143, 0.09453897270552923),
    ),
}


def content(path: Path) -> dict[str, str]:
    """The hash and the counts of what a log holds."""
    content_hash = ContentHash()
    for message in iter_messages(path):
        content_hash.add(message.topic, message.log_time, message.payload)
    return content_hash.to_metadata()


def test_every_version_has_its_golden_file() -> None:
    assert set(WRITTEN) == set(range(1, SCHEMA_VERSION + 1))
    assert {path.name for path in GOLDEN.iterdir()} == {f"v{number}.mcap" for number in WRITTEN}


@pytest.mark.parametrize("version", WRITTEN)
def test_a_log_of_any_version_is_read_to_the_bit(version: int) -> None:
    path = GOLDEN / f"v{version}.mcap"
    digest, messages, eta_d = WRITTEN[version]
    recovered, recording = recover_log(path), read_recording(path)
    assert recovered.is_intact
    assert read_schema_version(path, recovered.metadata) == version
    assert (content(path)["sha256"], len(recording.items)) == (digest, messages)
    points = [point.measured.eta_d for point in recording.records(PrcPoint) if point.measured]
    assert tuple(points) == eta_d
    assert recording.is_intact
    assert recording.missing_samples == 0
    assert [step.frequency_hz for step in recording.start.steps] == pytest.approx([3.8, 3.9, 4.0])
    assert find_altered_attachments(recovered.metadata, recovered.attachments) == []


@pytest.mark.parametrize("version", WRITTEN)
def test_log_states_its_hash_since_version_2(version: int) -> None:
    path = GOLDEN / f"v{version}.mcap"
    assert verify_log(path) is (version >= 2)
    assert recover_log(path).metadata.get("content") == (content(path) if version >= 2 else None)


@pytest.mark.parametrize("version", WRITTEN)
def test_merging_brings_a_log_to_the_newest_version(version: int, tmp_path: Path) -> None:
    part, out = tmp_path / "part.mcap", tmp_path / "out.mcap"
    shutil.copy(GOLDEN / f"v{version}.mcap", part)
    merge([part], out)
    assert read_schema_version(out, recover_log(out).metadata) == SCHEMA_VERSION
    assert verify_log(out)
    assert [item.index for item in read_recording(out).items] == [
        item.index for item in read_recording(part).items
    ]
    assert sorted(message.payload for message in iter_messages(out)) == sorted(
        message.payload for message in iter_messages(part)
    )


def merge_alone(path: Path) -> None:
    merge([path], path.with_name("out.mcap"))


def merged_of_a_killed_recorder(path: Path) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    merge_alone(path)


@pytest.mark.parametrize(
    "reader",
    [
        read_recording,
        read_log_table,
        open_log,
        merge_alone,
        merged_of_a_killed_recorder,
    ],
    ids=["read", "gather", "open_log", "merge", "merge_killed"],
)
def test_a_newer_version_is_refused_by_its_number(
    reader: Callable[[Path], object], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as newer:
        newer.setattr(mcap_log, "SCHEMA_VERSION", SCHEMA_VERSION + 1)
        write_items(tmp_path / "new.mcap", run(), START)
    with raises_input_error(
        where=tmp_path / "new.mcap", problem=SCHEMA_VERSION + 1, allowed=f"1 to {SCHEMA_VERSION}"
    ):
        reader(tmp_path / "new.mcap")
    assert not (tmp_path / "out.mcap").exists()


@pytest.mark.parametrize("text", ["0", "-1", "two", "9" * 5000, "1.0", ""])
def test_malformed_version_is_refused(text: str) -> None:
    with raises_input_error(where="a.mcap", problem=text, allowed=f"1 to {SCHEMA_VERSION}"):
        read_schema_version(Path("a.mcap"), {"run": {"schema": text}})
