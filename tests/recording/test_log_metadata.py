"""What a log says of itself: its hash depends on everything, its calibration can be read by all."""

import json
from dataclasses import replace
from hashlib import sha256
from itertools import permutations

import pytest

from tests.builders.rigs import RIG_TEXT
from tests.recording.example_run import START
from twin.recording.log_metadata import (
    ContentHash,
    build_attachments,
    build_calibration_json,
    find_altered_attachments,
    hash_attachments,
)

MESSAGES = [("/rig/meas", 0, b"one"), ("/rig/meas", 10, b"two"), ("/run/event", 10, b"")]


def record(messages: list[tuple[str, int, bytes]]) -> dict[str, str]:
    content = ContentHash()
    for message in messages:
        content.add(*message)
    return content.to_metadata()


def test_content_hash_is_that_of_log_md() -> None:
    text = b"/rig/meas 0 3\none/rig/meas 10 3\ntwo/run/event 10 0\n"
    assert record(MESSAGES) == {
        "sha256": sha256(text).hexdigest(), "messages": "3", "/rig/meas": "2", "/run/event": "1",
    }  # fmt: skip


def test_the_hash_depends_on_order_time_topic_and_bytes() -> None:
    changed = [list(permutation) for permutation in permutations(MESSAGES)]
    changed += [
        [("/rig/meas", 1, b"one"), *MESSAGES[1:]],
        [("/rig/gap", 0, b"one"), *MESSAGES[1:]],
        [("/rig/meas", 0, b"onE"), *MESSAGES[1:]],
        MESSAGES[:2],
        [*MESSAGES, MESSAGES[0]],
        [("/rig/meas", 0, b"one/rig/meas 10 3\ntwo"), MESSAGES[2]],  # nothing runs together
    ]
    assert len({record(messages)["sha256"] for messages in changed}) == len(changed)


@pytest.mark.parametrize("name", sorted(build_attachments(START)))
def test_altered_attachment_is_named(name: str) -> None:
    texts = build_attachments(START)
    metadata = {"attachments": hash_attachments(texts)}
    assert find_altered_attachments(metadata, texts) == []
    assert find_altered_attachments(metadata, texts | {name: texts[name] + b" "}) == [name]
    assert find_altered_attachments(
        metadata, {name_: data for name_, data in texts.items() if name_ != name}
    ) == [name]
    assert find_altered_attachments({}, texts) == []  # version 1 recorded none


def test_the_calibration_names_each_channel() -> None:
    card = RIG_TEXT
    lost = {"table_disp_m": 1e-4, "mass_disp_m": float("nan")}
    channels = ("drive_disp_m", "table_disp_m", "mass_disp_m")
    calibration = json.loads(
        build_calibration_json(replace(START, rig_toml=card, channels=channels, tare=lost))
    )
    assert list(calibration) == list(channels)
    assert calibration["table_disp_m"] == {
        "unit": "mm", "range": 75.0, "volts_per_unit": pytest.approx(10 / 75), "bits": 24,
        "tare_si": 1e-4,
    }  # fmt: skip
    assert calibration["mass_disp_m"]["tare_si"] is None
    assert "tare_si" not in calibration["drive_disp_m"]


@pytest.mark.parametrize("card", ["", "r = 1", "sensors = 3", "sensors = [1, 2]", "not toml ["])
def test_a_recording_without_a_machine_card_has_its_tare(card: str) -> None:
    calibration = json.loads(build_calibration_json(replace(START, rig_toml=card)))
    assert calibration == {"drive_disp_m": {}, "table_disp_m": {"tare_si": 1e-4}}
