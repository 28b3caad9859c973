"""What the log of a replay says of itself: who made it, of what, and where its beginning is."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from table_io.records import Comparison, Event, Fault, Timing
from tests.replay.in_memory import again, recorded_in
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.replay.command import ReplayRequest, replay_logs
from twin.replay.pipeline_replay import SampleRange
from twin.replay.verify import ReplayOutlook, examine_logs, verify_logs
from twin.setup.run_config import RunConfig
from twin.system.exit_codes import EXIT_ABORTED, EXIT_NOT_IDENTICAL
from twin.system.versions import read_installed_versions
from twin.transport.codec import Item


def notes(recording: Recording, kind: str) -> list[str]:
    return [event.text for event in recording.records(Event) if event.kind == kind]


def without_comparisons(recording: Recording, path: Path, *, ended: bool) -> Path:
    items: list[Item] = [
        item for item in recording.items
        if not isinstance(item, Comparison) and (ended or item is not recording.stop)
    ]  # fmt: skip
    write_items(path, items, recording.start)
    return path


def drop_comparisons(recording: Recording, lost: set[int]) -> list[Item]:
    """Return the items without the comparisons that begin at these samples."""
    return [
        item
        for item in recording.items
        if not (isinstance(item, Comparison) and item.index in lost)
    ]


@pytest.fixture
def some_steps(recording: Recording, bundle: RunConfig, tmp_path: Path) -> Recording:
    span = SampleRange.of_steps(recording, 2, 3)
    return again(recorded_in(recording), bundle, tmp_path / "some.mcap", span, run="some")[1]


def test_replay_states_versions_and_source(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    start = replace(
        recording.start, versions={"numpy": "0.1"}, host="elsewhere", started_at="long ago"
    )
    write_items(tmp_path / "old.mcap", [start, *recording.items[1:]], start)
    old = read_recording(tmp_path / "old.mcap")
    _, made = again(recorded_in(old), bundle, tmp_path / "new.mcap", run="new")
    assert made.start.versions == read_installed_versions()
    assert made.start.host == recording.start.host
    assert made.start.started_at > "2"
    content = old.metadata["content"]["sha256"]
    assert notes(made, "replay") == [f"replay of {old.run}, sha256 of its content {content}"]
    assert notes(made, "cut") == []
    _, third = again(recorded_in(made), bundle, tmp_path / "third.mcap", run="third")
    assert len(notes(third, "replay")) == 2  # of a replay: the whole chain
    assert notes(third, "replay")[0] != notes(third, "replay")[1]


def test_some_steps_are_a_sound_recording(some_steps: Recording, recording: Recording) -> None:
    first = some_steps.start.index
    assert notes(some_steps, "cut") == [f"from {recording.run} at sample {first}"]
    assert verify_logs([some_steps.path], False, None) == 0
    report = examine_logs([some_steps.path]).report
    assert (report.gaps, report.damage, report.sound) == ([], [], True)
    assert report.replay == ReplayOutlook(True, False, [f"its beginning is in {recording.run}"])


def test_a_gap_before_the_first_of_some_steps_is_one(some_steps: Recording, tmp_path: Path) -> None:
    first = some_steps.start.index
    write_items(tmp_path / "a.mcap", [
        item for item in some_steps.items if item.index != first or item is some_steps.start
    ], some_steps.start)  # fmt: skip
    (gap,) = examine_logs([tmp_path / "a.mcap"]).report.gaps
    assert gap.first == first


def test_some_steps_replayed_are_not_said_to_differ(
    some_steps: Recording,
    recording: Recording,
    tmp_path: Path,
    report: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Alone and among many: the twin comes to them from before their first sample."""
    assert replay_logs(ReplayRequest([some_steps.path], [], tmp_path / "one")) == 0
    output = " ".join(capsys.readouterr().out.split())
    assert report["differing"] > 0
    assert (report["identical"], report["beginning"]) == (None, recording.run)
    assert f"its beginning is in {recording.run}; " in output
    made = read_recording(tmp_path / "one" / "run.mcap")
    assert notes(made, "cut") == notes(some_steps, "cut")  # as true of this one
    logs = [some_steps.path, recording.path]
    assert replay_logs(ReplayRequest(logs, [], tmp_path / "many")) == 0
    rows = json.loads((tmp_path / "many" / "comparison.json").read_text())["replays"]
    assert [row["identical"] for row in rows] == [None, True]


@pytest.mark.parametrize("ended", [True, False])
def test_replay_without_recorded_comparisons_is_not_different(
    recording: Recording,
    tmp_path: Path,
    report: dict[str, Any],
    capsys: pytest.CaptureFixture[str],
    ended: bool,
) -> None:
    """Nor is it said that none are made."""
    log = without_comparisons(recording, tmp_path / "a.mcap", ended=ended)
    code = replay_logs(ReplayRequest([log], [], tmp_path / "one"))
    assert code == (0 if ended else EXIT_ABORTED)
    made = len(read_recording(tmp_path / "one" / "run.mcap").records(Comparison))
    assert made > 300
    output = " ".join(capsys.readouterr().out.split())
    assert f"no comparisons were recorded; {made} are made" in output
    assert report["identical"] is None


@pytest.mark.parametrize("is_faulted", [True, False])
def test_comparisons_lost_with_the_twin_are_no_difference(
    recording: Recording, tmp_path: Path, report: dict[str, Any], is_faulted: bool
) -> None:
    """Twin and recorder, or twin and supervisor, killed at once: its last results are lost."""
    comparisons, stop = recording.records(Comparison), recording.stop
    assert stop is not None
    lost = {item.index for item in comparisons[290:]}
    made_count = 10 if is_faulted else len(lost)
    mark = (
        Fault(stop.index, "twin", comparisons[300].index, stop.index, "it died")
        if is_faulted
        else Timing(comparisons[280].index, "twin", 1.0, 1.0, 1.0, 0, 10, 0.1, "")
    )
    items = drop_comparisons(recording, lost)
    end = items.index(stop)
    write_items(tmp_path / "a.mcap", [*items[:end], mark, *items[end:]], recording.start)
    assert replay_logs(ReplayRequest([tmp_path / "a.mcap"], [], tmp_path / "one")) == 0
    counts = [report[name] for name in ("identical", "unrecorded", "lost_with_twin")]
    assert counts == [True, 0, made_count]


@pytest.mark.parametrize("marked", ["fault", "timing"])
def test_comparisons_of_a_living_twin_are_missed(
    recording: Recording, tmp_path: Path, report: dict[str, Any], marked: str
) -> None:
    """Comparisons long before its death, or while it reported latencies, are not excused."""
    comparisons, stop = recording.records(Comparison), recording.stop
    assert stop is not None
    end = stop.index
    marks: dict[str, Item] = {
        "fault": Fault(end, "twin", comparisons[-1].index, end, "it died"),
        "timing": Timing(end - 1, "twin", 1.0, 1.0, 1.0, 0, 10, 0.1, ""),
    }
    items = drop_comparisons(recording, {item.index for item in comparisons[200:]})
    place = items.index(stop)
    write_items(
        tmp_path / "a.mcap", [*items[:place], marks[marked], *items[place:]], recording.start
    )
    asked = ReplayRequest([tmp_path / "a.mcap"], [], tmp_path / "one")
    assert replay_logs(asked) == EXIT_NOT_IDENTICAL
    assert report["unrecorded"] > 300


def test_differing_replay_has_its_exit_code_alone_and_in_a_table(
    recording: Recording, tmp_path: Path, report: dict[str, Any]
) -> None:
    """A recording that ended and lacks a comparison that the replay makes."""
    lost = {recording.records(Comparison)[300].index}
    log = tmp_path / "a.mcap"
    write_items(log, drop_comparisons(recording, lost), recording.start)
    assert replay_logs(ReplayRequest([log], [], tmp_path / "one")) == EXIT_NOT_IDENTICAL
    assert (report["identical"], report["unrecorded"]) == (False, 1)
    asked = ReplayRequest([log, recording.path], [], tmp_path / "many")
    assert replay_logs(asked) == EXIT_NOT_IDENTICAL
