"""What Foxglove gets: read by the library of MCAP, held against the log and Foxglove's schemas."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.exchange.exported import LABEL_FIELDS, exported, measured
from tests.reports.recordings import MEASURED, RATE
from twin.recording.reader import read_recording


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    return exported(tmp_path_factory.mktemp("export"), ("foxglove",))


@pytest.fixture(scope="module")
def log(both: tuple[Path, Path]) -> Path:
    return both[0]


@pytest.fixture(scope="module")
def out(both: tuple[Path, Path]) -> Path:
    """Without its endings."""
    return both[1]


def decoded(path: Path) -> dict[str, list[Any]]:
    """Every message by topic as (log_time, message), by the library's own reader and decoder."""
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_protobuf.decoder")
    found: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        log = reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()])
        for _, channel, message, content in log.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


@pytest.fixture(scope="module")
def found(out: Path) -> dict[str, list[Any]]:
    return decoded(out.with_name("out.foxglove.mcap"))


def test_foxglove_gets_a_message_a_sample_at_its_time(
    log: Path, found: dict[str, list[Any]]
) -> None:
    index, values, *labels = measured(read_recording(log))
    (told,) = read_recording(log).contiguous_blocks("pred")
    times = [round(one * 1e9 / RATE) for one in index.tolist()]
    for topic in ("/measured", "/twin"):
        assert [at for at, _ in found[topic]] == times
        stamps = [one.timestamp.seconds * 10**9 + one.timestamp.nanos for _, one in found[topic]]
        assert stamps == times
    for name, row in zip(MEASURED, values, strict=True):
        got = np.array([getattr(one, name) for _, one in found["/measured"]])
        assert got.tobytes() == row.tobytes()
    for name, true in zip(LABEL_FIELDS, labels, strict=True):
        assert [getattr(one, name) for _, one in found["/measured"]] == true.tolist()
    last = found["/twin"][-1][1]
    assert last.twin_free_rel_disp_m == told.channel("free/rel_disp_m")[-1]
    assert np.isnan(found["/twin"][0][1].twin_free_rel_disp_m)


def test_foxglove_gets_the_events_as_its_own_log_and_the_curves(
    found: dict[str, list[Any]],
) -> None:
    ((at, event),) = found["/events"]
    assert (at, event.message, event.name, event.level) == (0, "running", "state", 2)
    assert event.DESCRIPTOR.full_name == "foxglove.Log"
    ((at, point),) = found["/prc"]
    assert (at, point.frequency_hz, point.eta_d, point.direction) == (3_000_000_000, 1.0, 0.1, 1)
    assert np.isnan(point.r_l)
    assert np.isnan(point.twin_eta_d)


def test_the_layout_shows_only_what_is_in_the_file(out: Path, found: dict[str, list[Any]]) -> None:
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
        path["value"] for one in panels.values() for path in one.get("paths", ()) if path["enabled"]
    ]
    assert {"/measured.mass_disp_m", "/twin.twin_window_mass_disp_m"} <= set(paths)
    for path in [*paths, panels["Plot!curves"]["xAxisPath"]["value"]]:
        topic, name = path.split(".")
        assert name in found[topic][0][1].DESCRIPTOR.fields_by_name
    assert panels["RosOut!events"]["topicToRender"] in found


def test_the_fields_of_the_log_are_foxgloves(found: dict[str, list[Any]]) -> None:
    own = pytest.importorskip("foxglove_schemas_protobuf.Log_pb2").Log.DESCRIPTOR
    ours = found["/events"][0][1].DESCRIPTOR
    for field in ours.fields:
        assert own.fields_by_name[field.name].number == field.number
