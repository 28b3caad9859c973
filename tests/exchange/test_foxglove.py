"""What Foxglove gets: read by the library of MCAP, held against the log and Foxglove's schemas."""

import json
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.exchange.exported import LABEL_FIELDS, export_formats, join_measured_blocks
from tests.reports.recordings import MEASURED, RATE
from twin.recording.reader import read_recording


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return export_formats(tmp_path_factory.mktemp("export"), ("foxglove",))


@pytest.fixture(scope="module")
def log(both: tuple[Path, Path]) -> Path:
    return both[0]


@pytest.fixture(scope="module")
def out(both: tuple[Path, Path]) -> Path:
    """Without its endings."""
    return both[1]


# The run started in local time: its record states no zone.
STARTED_NS = round(datetime(2025, 1, 1).timestamp() * 1e9)


def decode_messages(path: Path) -> dict[str, list[Any]]:
    """Every message by topic as (log_time, message), by the library's own reader and decoder."""
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    messages: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        log = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, message, content in log.iter_decoded_messages():
            messages.setdefault(channel.topic, []).append((message.log_time, content))
    return messages


@pytest.fixture(scope="module")
def messages(out: Path) -> dict[str, list[Any]]:
    return decode_messages(out.with_name("out.foxglove.mcap"))


def test_foxglove_gets_a_message_a_sample_at_its_time(
    log: Path, messages: dict[str, list[Any]]
) -> None:
    index, values, *labels = join_measured_blocks(read_recording(log))
    (predicted,) = read_recording(log).contiguous_blocks("pred")
    times = [STARTED_NS + round(sample * 1e9 / RATE) for sample in index.tolist()]
    for topic in ("/measured", "/twin"):
        assert [at for at, _ in messages[topic]] == times
        stamps = [
            content.timestamp.seconds * 10**9 + content.timestamp.nanos
            for _, content in messages[topic]
        ]
        assert stamps == times
    for name, row in zip(MEASURED, values, strict=True):
        got = np.array([getattr(content, name) for _, content in messages["/measured"]])
        assert got.tobytes() == row.tobytes()
    for name, true in zip(LABEL_FIELDS, labels, strict=True):
        assert [getattr(content, name) for _, content in messages["/measured"]] == true.tolist()
    last = messages["/twin"][-1][1]
    assert last.twin_free_rel_disp_m == predicted.channel("free/rel_disp_m")[-1]
    assert np.isnan(messages["/twin"][0][1].twin_free_rel_disp_m)


def test_foxglove_gets_the_events_as_its_own_log_and_the_curves(
    messages: dict[str, list[Any]],
) -> None:
    ((at, event),) = messages["/events"]
    assert (at, event.message, event.name, event.level) == (STARTED_NS, "running", "state", 2)
    assert event.DESCRIPTOR.full_name == "foxglove.Log"
    ((at, point),) = messages["/prc"]
    assert at == STARTED_NS + 3_000_000_000
    assert (point.frequency_hz, point.eta_d, point.direction) == (1.0, 0.1, 1)
    assert np.isnan(point.r_l)
    assert np.isnan(point.twin_eta_d)


def test_the_layout_shows_only_what_is_in_the_file(
    out: Path, messages: dict[str, list[Any]]
) -> None:
    layout = json.loads(out.with_name("out.foxglove.layout.json").read_text())
    panels = layout["configById"]
    leaves: list[str] = []

    def walk(node: Any) -> None:
        if isinstance(node, str):
            leaves.append(node)
        else:
            assert node["direction"] in ("row", "column")
            assert 0 < node["splitPercentage"] < 100
            walk(node["first"])
            walk(node["second"])

    walk(layout["layout"])
    assert sorted(leaves) == sorted(panels)
    assert {name.split("!")[0] for name in panels} == {"Plot", "RosOut"}
    paths = [
        path["value"]
        for panel in panels.values()
        for path in panel.get("paths", ())
        if path["enabled"]
    ]
    assert {"/measured.mass_disp_m", "/twin.twin_window_mass_disp_m"} <= set(paths)
    for path in [*paths, panels["Plot!curves"]["xAxisPath"]["value"]]:
        topic, name = path.split(".")
        assert name in messages[topic][0][1].DESCRIPTOR.fields_by_name
    assert panels["RosOut!events"]["topicToRender"] in messages


def test_the_fields_of_the_log_are_foxgloves(messages: dict[str, list[Any]]) -> None:
    own = pytest.importorskip("foxglove_schemas_protobuf.Log_pb2").Log.DESCRIPTOR
    ours = messages["/events"][0][1].DESCRIPTOR
    for field in ours.fields:
        assert own.fields_by_name[field.name].number == field.number
