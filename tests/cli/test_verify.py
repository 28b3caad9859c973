"""`verify` and `--repair`: what is whole, what is lost and where, and what is left as a new log."""

import errno
import json
import os
import random
from contextlib import closing, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.acquisition.session import run_session
from table_io.backends import open_backend
from table_io.block import Block
from table_io.clock import ManualClock
from table_io.errors import InputError
from table_io.records import RunStart, RunStop, SampleGap
from tests.cli.test_cli import SHORT
from tests.command_line import invoke
from tests.input_errors import raises_input_error
from tests.recording.example_run import BLOCK_SAMPLES, START, block, run, write
from tests.recording.mutants import damage, spans, whole
from twin.exchange.export import ExportOptions, export_log
from twin.log import open_log
from twin.recording.mcap_log import LogWriter, write_items
from twin.recording.reader import Recording, read_recording
from twin.recording.recovery import ATTACHMENT, CHUNK, recover_log
from twin.recording.run_paths import PARTS_FOLDER, resolve_log_path
from twin.replay.verify import examine_logs, find_missing_end
from twin.setup.run_config import read_run_config
from twin.setup.unpaced import add_twin_items
from twin.transport.codec import encode_item, topic_for


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """The first half second of a real run as one that was stopped, in many chunks."""
    folder = tmp_path_factory.mktemp("verified")
    (folder / "short.toml").write_text(SHORT)
    bundle, clock = read_run_config(folder / "short.toml"), ManualClock()
    backend = open_backend(bundle.rig, bundle.profile, clock)
    source = run_session(
        bundle.session_setup, backend, clock, bundle.make_start_factory("r", "table"), lambda: None
    )
    with closing(source):
        items = list(islice(add_twin_items(source, bundle.prepare_twin()), 170))
    items = [item for item in items if item.index < 1000]
    items.append(RunStop(1000, "stopped", "it was enough", ("idle", "at rest")))
    assert isinstance(items[0], RunStart)
    return read_recording(whole(folder / "run.mcap", items, items[0]))


@pytest.fixture
def log(recording: Recording, tmp_path: Path) -> Path:
    path = tmp_path / "run.mcap"
    path.write_bytes(recording.path.read_bytes())
    return path


def verify(*words: object) -> tuple[int, dict[str, Any]]:
    """(exit code, what it says as JSON)."""
    code, text = invoke("verify", *words, "--json")
    return code, json.loads(text)


def read_output(*words: object) -> str:
    """What it says to people."""
    return invoke("verify", *words)[1]


def chunk(path: Path, number: int) -> tuple[int, int]:
    places = [span[1:] for span in spans(path.read_bytes()) if span[0] == CHUNK]
    assert len(places) > 3
    return places[number]


def flip(path: Path, at: int) -> None:
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.write_bytes(content)


def test_a_whole_log_is_whole(log: Path, recording: Recording) -> None:
    code, report = verify(log)
    assert (code, report["sound"]) == (0, True)
    assert report["damage"] == report["gaps"] == report["altered"] == []
    assert (report["content"], report["schema"]) == ("same", 4)
    assert report["samples"]["acquired"] == 1000
    assert report["topics"]["/rig/meas"] == {"messages": 50, "missing": 0}
    assert report["replay"] == {"possible": True, "identical": True, "because": []}
    assert report["run"] == recording.run
    assert read_output(log).splitlines()[-2:] == ["can be replayed, to the bit", "whole"]


def test_a_flipped_bit_costs_a_chunk_and_is_found_there(log: Path) -> None:
    first, end = chunk(log, 2)
    flip(log, (first + end) // 2)
    code, report = verify(log)
    assert code == 4
    assert [(damage["byte"], damage["bytes"]) for damage in report["damage"][:1]] == [
        (first, end - first)
    ]
    (gap,) = report["gaps"]
    missing = report["topics"]["/rig/meas"]["missing"]
    assert gap["count"] == 20 * missing == report["samples"]["missing"] > 0
    assert report["content"] == "differs"
    assert report["replay"]["possible"]
    assert not report["replay"]["identical"]
    text = read_output(log)
    assert f"bytes {first} to {end}" in text
    assert f"samples {gap['first']} to {gap['first'] + gap['count'] - 1} " in text
    assert "damaged; `--repair NEW`" in text


def repair_log(log: Path) -> Path:
    """The new file; the old one is as it was."""
    before = log.read_bytes()
    new = log.with_name("new.mcap")
    assert verify(log, "--repair", new)[0] == 4
    assert log.read_bytes() == before
    return new


def test_a_repaired_log_holds_all_that_was_left_and_says_what_was_not(
    log: Path, recording: Recording
) -> None:
    for number in (1, 3):
        first, end = chunk(log, number)
        flip(log, (first + end) // 2)
    left, report = recover_log(log).messages, verify(log)[1]
    new = repair_log(log)
    again = recover_log(new)
    assert again.is_intact
    old = {
        (message.topic, message.payload, message.log_time, message.publish_time) for message in left
    }
    have = {
        (message.topic, message.payload, message.log_time, message.publish_time)
        for message in again.messages
    }
    assert old <= have
    assert sorted(topic for topic, *_ in have - old) == ["/rig/gap"] * 2 + ["/run/event"]
    lost = [(gap["first"], gap["count"]) for gap in report["gaps"]]
    gaps = read_recording(new).records(SampleGap)
    assert [(gap.index, gap.count, gap.channel, gap.reason) for gap in gaps] == [
        (*gap, "", "lost") for gap in lost
    ]
    assert again.metadata["repaired"]["from_1"] == "run.mcap"
    assert again.metadata["repaired"]["lost_samples"] == str(report["samples"]["missing"])
    code, report = verify(new)
    assert (code, report["damage"], report["content"]) == (4, [], "same")
    assert report["gaps"] == [
        {"first": first, "count": count, "channel": "", "reason": "lost"} for first, count in lost
    ]
    assert not report["replay"]["identical"]
    assert "the file is whole, the recording has dropouts" in read_output(new)
    assert read_recording(new).start == recording.start


def test_a_killed_recording_is_made_whole(log: Path, recording: Recording) -> None:
    log.write_bytes(log.read_bytes()[: chunk(log, -1)[1]])
    code, report = verify(log)
    assert (code, report["content"], report["gaps"]) == (4, "unknown", [])
    assert [damage["reason"][:27] for damage in report["damage"]] == ["the file was never finished"]
    new = read_recording(repair_log(log))
    assert new.is_intact
    assert new.missing_samples == 0
    for stream in ("meas", "pred"):
        (mine,), (whole_one,) = new.contiguous_blocks(stream), recording.contiguous_blocks(stream)
        assert mine.is_identical(whole_one)


def test_repair_never_writes_over_anything(log: Path) -> None:
    before = log.read_bytes()
    with raises_input_error(where=log):
        verify(log, "--repair", log)
    assert log.read_bytes() == before


def test_missing_log_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("time_s\n1\n")
    with raises_input_error(where=tmp_path / "a.csv", remedy="run.mcap"):
        verify(tmp_path / "a.csv")
    missing = os.strerror(errno.ENOENT)
    with raises_input_error(where=tmp_path / "b.mcap", problem=missing):
        verify(tmp_path / "b.mcap")
    with raises_input_error(where=tmp_path, problem="no recording"):
        verify(tmp_path)


def test_a_gap_of_the_test_is_no_damage(recording: Recording, tmp_path: Path) -> None:
    items = [
        item
        for item in recording.items
        if not (isinstance(item, Block) and 400 <= item.index < 440)
    ]
    gap = SampleGap(400, 40, "", "lost")
    write_items(
        tmp_path / "a.mcap", [*items, gap, SampleGap(7, 1, "force_r1_n", "late")], recording.start
    )
    code, report = verify(tmp_path / "a.mcap")
    assert (code, report["damage"]) == (4, [])
    assert [(gap["first"], gap["count"], gap["channel"]) for gap in report["gaps"]] == [
        (7, 1, "force_r1_n"),
        (400, 40, ""),
    ]
    assert report["replay"]["because"] == ["40 samples are missing"]


def test_altered_texts_and_messages_are_seen(log: Path, recording: Recording) -> None:
    writer = LogWriter(log.with_name("b.mcap"), recording.start.rate_hz)
    writer.write_run_description(
        replace(recording.start, model_toml=recording.start.model_toml + "#")
    )
    for item in recording.items:
        writer.write(topic_for(item), encode_item(item, recording.run), item.index)
    writer._content.add("/run/event", 0, b"")  # which is not there
    writer.close()
    code, report = verify(log.with_name("b.mcap"))
    assert (code, report["content"]) == (4, "differs")
    assert [damage["reason"] for damage in report["damage"]] == [
        "the messages are not those that were written"
    ]
    content = log.read_bytes()
    at = next(first for opcode, first, _ in spans(content) if opcode == ATTACHMENT)
    flip(log, at + 80)
    code, report = verify(log)
    assert (code, report["altered"]) == (4, ["profile.toml"])


def test_verify_reports_a_missing_attachment(recording: Recording, tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap", recording.start.rate_hz)
    writer.write_metadata("attachments", {"profile.toml": "0" * 64})
    for item in recording.items:
        writer.write(topic_for(item), encode_item(item, recording.run), item.index)
    writer.close()
    code, report = verify(tmp_path / "a.mcap")
    assert (code, report["altered"]) == (4, ["profile.toml"])
    assert report["damage"] == report["gaps"] == []


def test_other_versions_are_named(recording: Recording, tmp_path: Path) -> None:
    versions = {**recording.start.versions, "numpy": "1.0.0"}
    start = replace(recording.start, versions=versions)
    write_items(tmp_path / "a.mcap", [start, *recording.items[1:]], start)
    code, report = verify(tmp_path / "a.mcap")
    installed = report["versions"]["numpy"]["installed"]
    assert code == 0
    assert report["versions"]["numpy"] == {"recorded": "1.0.0", "installed": np.__version__}
    assert report["replay"]["because"] == [f"versions differ: numpy 1.0.0 -> {installed}"]


def test_a_model_that_cannot_be_built_cannot_be_replayed(
    recording: Recording, tmp_path: Path
) -> None:
    start = replace(recording.start, model_toml="[base]\n")
    write_items(tmp_path / "a.mcap", [start, *recording.items[1:]], start)
    code, report = verify(tmp_path / "a.mcap")
    assert (code, report["replay"]["possible"]) == (0, False)
    assert "base.stiffness_n_m" in report["replay"]["because"][0]


def test_the_parts_of_a_recording_are_read_as_one(recording: Recording, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    (folder / PARTS_FOLDER).mkdir(parents=True)
    items, start = list(recording.items), recording.start
    write_items(folder / PARTS_FOLDER / "part-001.mcap", items[:200], start)
    write_items(folder / PARTS_FOLDER / "part-002.mcap", [start, *items[180:]], start)
    code, report = verify(folder)
    assert code == 4
    assert [damage["reason"] for damage in report["damage"]] == [
        "2 parts that were not put together"
    ]
    assert (report["gaps"], report["content"], report["samples"]["missing"]) == ([], "same", 0)
    new = tmp_path / "new.mcap"
    assert verify(folder, "--repair", new)[0] == 4
    assert verify(new)[0] == 0
    assert (
        read_recording(new)
        .contiguous_blocks("meas")[0]
        .is_identical(recording.contiguous_blocks("meas")[0])
    )
    assert sorted(path.name for path in (folder / PARTS_FOLDER).iterdir()) == [
        "part-001.mcap",
        "part-002.mcap",
    ]


def test_logs_of_different_runs_are_no_parts_of_one(recording: Recording, tmp_path: Path) -> None:
    other = replace(recording.start, run="another")
    write_items(tmp_path / "b.mcap", [other, *recording.items[1:]], other)
    with raises_input_error(
        where=f"{recording.path} and {tmp_path / 'b.mcap'}", problem="(another, r)"
    ):
        verify(recording.path, tmp_path / "b.mcap")


def test_what_is_left_after_any_accident_can_be_repaired(log: Path) -> None:
    content = log.read_bytes()
    made = 0
    for seed in range(12):
        bad, new = log.with_name(f"{seed}.mcap"), log.with_name(f"{seed}.new.mcap")
        bad.write_bytes(damage(content, random.Random(seed)))
        with suppress(InputError):
            verify(bad, "--repair", new)
            made += 1
            assert examine_logs([new]).report.damage == []
            assert recover_log(new).is_intact
    assert made > 6


PLANNED = START.planned_samples


@pytest.fixture
def cut(tmp_path: Path) -> Path:
    """A log of which the second half is gone."""
    path = tmp_path / "run.mcap"
    sizes = write(path, run(), flush_every=10)
    path.write_bytes(path.read_bytes()[: sizes[len(sizes) // 2]])
    return path


def test_half_a_test_is_not_whole_even_if_its_file_is(cut: Path) -> None:
    code, report = verify(cut)
    end = read_recording(cut).contiguous_blocks("meas")[-1].end
    lost = {"first": end, "count": PLANNED - end, "channel": "", "reason": "no end was recorded"}
    assert 0 < end < PLANNED
    assert (code, report["gaps"].count(lost)) == (4, 1)
    new = cut.with_name("new.mcap")
    assert verify(cut, "--repair", new)[0] == 4
    code, report = verify(new)
    assert (code, report["sound"], report["damage"]) == (4, False, [])
    assert report["gaps"].count(lost) == 1
    assert read_recording(new).is_intact  # the file; the test is not
    assert not [
        gap for gap in read_recording(new).records(SampleGap) if not gap.channel
    ]  # nobody knows what was lost
    lines = read_output(new).splitlines()
    assert lines[-1] == "the file is whole, the recording has dropouts"
    assert any(f"samples {end} to {PLANNED - 1} " in line and "no end" in line for line in lines)


def test_a_repaired_log_says_of_what(cut: Path) -> None:
    new = cut.with_name("new.mcap")
    assert any("`--repair NEW`" in line for line in read_output(cut).splitlines())
    lines = read_output(cut, "--repair", new).splitlines()
    assert new.exists()
    assert "damaged" in lines
    assert not any("--repair NEW" in line for line in lines)  # it was given
    assert any(
        line.startswith("repaired: from run.mcap: the file was never")
        for line in read_output(new).splitlines()
    )
    assert verify(new)[1]["repaired"]["from_1"] == "run.mcap"
    assert verify(cut)[1]["repaired"] == {}


def test_no_end_is_a_gap_even_of_no_samples(tmp_path: Path) -> None:
    items = [item for item in run() if not isinstance(item, RunStop)]
    write(tmp_path / "run.mcap", [*items, block(PLANNED)])  # more than was planned
    assert find_missing_end(read_recording(tmp_path / "run.mcap")) == [(PLANNED + BLOCK_SAMPLES, 0)]
    code, report = verify(tmp_path)
    assert (code, report["gaps"][0]["count"]) == (4, 0)
    assert any(
        f"from sample {PLANNED + BLOCK_SAMPLES} (at " in line
        for line in read_output(tmp_path).splitlines()
    )


def test_parts_alone_are_no_log_yet(tmp_path: Path) -> None:
    """One sentence says what to do, whoever is asked; `verify` says what is in them, and that."""
    folder = tmp_path / "killed"
    (folder / PARTS_FOLDER).mkdir(parents=True)
    write(folder / PARTS_FOLDER / "part-001.mcap", run())
    words = f"{folder}: its recorder was killed: `shaketwin report {folder}` merges the parts"
    for reader in (
        resolve_log_path,
        open_log,
        lambda place: export_log(ExportOptions(place, ("csv",))),
    ):
        with pytest.raises(InputError) as caught:
            reader(folder)
        assert str(caught.value) == words
    code, report = verify(folder)
    assert (code, report["sound"], report["apart"]) == (4, False, [words])
    assert report["samples"]["acquired"] == PLANNED
    assert read_output(folder).splitlines()[-1] == words
    (folder / PARTS_FOLDER / "part-001.mcap").rename(folder / "run.mcap")
    assert "apart" in verify(folder)[1]
    assert verify(folder)[1]["apart"] == []
    assert resolve_log_path(folder) == folder / "run.mcap"
