"""What a replay can do more: any cut, a range of steps, changed parameters, planted differences."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import (
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    Event,
    JumpForecast,
    Params,
    PrcPoint,
    RunStart,
    RunStop,
)
from tests.builders.recordings import store_items
from tests.input_errors import raises_input_error
from tests.replay.in_memory import again, recorded_in
from twin.compare import pipeline, twins
from twin.compare.monitoring import EVENT_KINDS
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.recording.tabular import parse_step_range
from twin.replay.command import ReplayRequest, replay_logs
from twin.replay.pipeline_replay import RecordedRun, SampleRange
from twin.setup.run_config import RunConfig
from twin.system.exit_codes import EXIT_NOT_IDENTICAL
from twin.transport.codec import Item, encode_item


def encode_records(recording: Recording, *kinds: type) -> list[bytes]:
    """All records of these kinds, as bytes without the run's name."""
    return [encode_item(item, "") for item in recording.items if isinstance(item, kinds)]


def with_values(items: Iterable[Item], old: Item, new: Item) -> list[Item]:
    return [new if item is old else item for item in items]


# How it is cut and read


@pytest.mark.parametrize("cut", [7, 20, 333, 0])
def test_replay_does_not_depend_on_block_size(
    recording: Recording, bundle: RunConfig, tmp_path: Path, cut: int
) -> None:
    identity, made = again(recorded_in(recording), bundle, tmp_path / "run.mcap", cut=cut)
    assert identity.is_identical
    assert identity.compared == len(recording.records(Comparison)) > 300
    for kind in (
        Comparison,
        CycleExtremes,
        PrcPoint,
        Agreement,
        Estimate,
        JumpForecast,
        Params,
        RunStop,
    ):
        assert encode_records(made, kind) == encode_records(recording, kind) != [], kind
    warnings = [
        [event for event in log.records(Event) if event.kind in EVENT_KINDS]
        for log in (made, recording)
    ]
    assert warnings[0] == warnings[1] != []
    for stream in ("meas", "pred"):
        assert made.contiguous_blocks(stream)[0].is_identical(
            recording.contiguous_blocks(stream)[0]
        )


def test_read_for_a_replay_is_the_same_as_read_whole(log_file: Path, recording: Recording) -> None:
    quick, whole = RecordedRun.open(log_file), recorded_in(recording)
    assert quick.comparisons == whole.comparisons
    assert len(quick.recording.comparisons) == len(whole.comparisons)
    assert not quick.recording.contiguous_blocks("pred")
    assert quick.recording.contiguous_blocks("meas")[0].is_identical(
        recording.contiguous_blocks("meas")[0]
    )


# A range of steps


def test_steps_are_equal_to_the_recorded_ones_for_both_twins(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    """From the first sample on: the twin comes there with the state that it had."""
    span = SampleRange.of_steps(recording, 2, 3)
    (piece,) = recording.contiguous_blocks("meas")
    assert set(piece.cut(span.first, span.last).step.tolist()) == {2, 3}
    assert piece.step[span.first - 1] != 2
    assert piece.step[span.last] != 3
    identity, made = again(recorded_in(recording), bundle, tmp_path / "run.mcap", span)
    assert identity.is_identical
    whole = [
        comparison for comparison in recording.records(Comparison)
        if span.first <= comparison.index and comparison.index + comparison.count <= span.last
    ]  # fmt: skip
    assert len(whole) == identity.compared > 100
    assert encode_records(made, Comparison) == [encode_item(comparison, "") for comparison in whole]
    assert [point.step for point in made.records(PrcPoint)] == [2, 3]
    assert encode_records(made, PrcPoint) == [
        encode_item(point, "") for point in recording.records(PrcPoint)[2:4]
    ]
    kinds: tuple[type[Agreement | Estimate], ...] = (Agreement, Estimate)
    for kind in kinds:
        inside = [record for record in recording.records(kind) if record.step in (2, 3)]
        assert encode_records(made, kind) == [encode_item(record, "") for record in inside], kind
    assert [(cycle.step, cycle.cycle) for cycle in made.records(CycleExtremes)] == [
        (cycle.step, cycle.cycle)
        for cycle in recording.records(CycleExtremes)
        if cycle.step in (2, 3)
    ]
    for stream in ("meas", "pred"):
        (shown,) = made.contiguous_blocks(stream)
        assert shown.is_identical(recording.contiguous_blocks(stream)[0].cut(span.first, span.last))
    assert made.start.index == span.first
    assert made.stop is not None
    assert made.stop.index == span.last
    assert made.missing_samples == 0


def test_the_last_step_ends_with_the_run(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    last = len(recording.start.steps) - 1
    span = SampleRange.of_steps(recording, last, last)
    identity, made = again(recorded_in(recording), bundle, tmp_path / "run.mcap", span)
    assert identity.is_identical
    assert encode_records(made, PrcPoint) == [encode_item(recording.records(PrcPoint)[-1], "")]


def test_steps_that_are_not_there_are_refused(recording: Recording) -> None:
    with raises_input_error(where="--steps 6:9", allowed="0 to 5"):
        SampleRange.of_steps(recording, 6, 9)


@pytest.mark.parametrize("text", ["5:3", "a:b", "", "1:2:3", "-1:2"])
def test_malformed_step_range_is_refused(text: str) -> None:
    with raises_input_error(where=f"--steps {text}", allowed="FIRST:LAST"):
        parse_step_range(text)
    assert parse_step_range("4") == (4, 4)
    assert parse_step_range("3:12") == (3, 12)


# Parameters that changed during the run


def change_parameters(recording: Recording, bundle: RunConfig, index: int, path: Path) -> Recording:
    """The recording as it would be had stiffness and gap changed at sample `index`.

    Made with the pipeline alone, fed in blocks of 20 up to the change and from there on.
    """
    setup = bundle.prepare_twin()
    values = setup.twin.model.flatten()
    params = Params(index, {**values, "stiffness": 1.02 * values["stiffness"]}, "identified")
    (whole,) = recording.contiguous_blocks("meas")
    state, begun = pipeline.start_pipeline(setup)
    events: list[Item] = [*begun, params]
    for first, last in ((0, index), (index, whole.end)):
        for at in range(first, last, 20):
            state, made = pipeline.step(setup, state, whole.cut(at, min(at + 20, last)))
            events.extend(made)
        setup = pipeline.adopt_params(setup, params)
    kept = [
        item
        for item in recording.items
        if (isinstance(item, Block) and item.stream == "meas")
        or isinstance(item, (RunStart, RunStop))
    ]
    write_items(path, [*kept, *events], recording.start)
    return read_recording(path)


@pytest.mark.parametrize("index", [2000, 2013])
def test_parameters_that_changed_are_changed_again(
    recording: Recording, bundle: RunConfig, tmp_path: Path, index: int
) -> None:
    other = change_parameters(recording, bundle, index, tmp_path / "changed.mcap")
    identity, made = again(recorded_in(other), bundle, tmp_path / "run.mcap")
    assert identity.is_identical
    assert encode_records(made, Params, PrcPoint) == encode_records(other, Params, PrcPoint)
    # without the change the twin goes another way from there on
    ignored = replace(other, items=store_items(
        item for item in other.items
        if not (isinstance(item, Params) and item.reason == "identified")
    ))  # fmt: skip
    identity, _ = again(recorded_in(ignored), bundle, tmp_path / "ignored.mcap")
    assert identity.first_difference is not None
    assert index - 20 < identity.first_difference < index + 250


def test_steps_after_a_change_start_with_its_parameters(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    """The parameters that changed before the first sample stand at it."""
    other = change_parameters(recording, bundle, 2013, tmp_path / "changed.mcap")
    span = SampleRange.of_steps(other, 4, 4)
    assert span.first > 2013
    identity, made = again(recorded_in(other), bundle, tmp_path / "run.mcap", span)
    assert identity.is_identical
    assert [params.index for params in made.records(Params)] == [span.first, span.first]
    assert made.records(Params)[-1].reason == "identified"


def test_a_change_within_a_gap_holds_after_it(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    other = change_parameters(recording, bundle, 2013, tmp_path / "changed.mcap")
    holed = replace(other, items=store_items(
        item for item in other.items if not isinstance(item, Block) or not 2000 <= item.index < 2100
    ))  # fmt: skip
    _, made = again(recorded_in(holed), bundle, tmp_path / "run.mcap")
    assert [params.reason for params in made.records(Params)] == ["start", "identified"]
    assert made.records(Params)[-1].index == 2013


def test_a_damaged_comparison_is_one_that_differs(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    """Told, in a range of steps too, and nothing else happens."""
    recorded = recorded_in(recording)
    span = SampleRange.of_steps(recording, 2, 2)
    last = max(index for index in recorded.comparisons if index < span.last - 20)
    broken = RecordedRun(recording, {**recorded.comparisons, last: b"\x80"})
    identity, _ = again(broken, bundle, tmp_path / "run.mcap", span)
    assert (identity.differing, identity.missing) == (1, 0)
    assert identity.first_difference == last


# What differs, and how much


def plant_versions(log_file: Path, folder: Path, **versions: str) -> Path:
    """The log as if it had been recorded with other versions."""
    recording = read_recording(log_file)
    start = replace(recording.start, versions={**recording.start.versions, **versions})
    path = folder / "planted.mcap"
    write_items(path, with_values(recording.items, recording.start, start), start)
    return path


def test_another_version_alone_makes_no_difference(
    log_file: Path, tmp_path: Path, report: dict[str, Any]
) -> None:
    path = plant_versions(log_file, tmp_path, numpy="0.1")
    assert replay_logs(ReplayRequest([path], [], tmp_path / "out")) == 0
    assert report["identical"] is True
    assert set(report["versions_differing"]) == {"numpy"}


def test_differing_kernel_is_reported_with_versions_and_size(
    log_file: Path,
    tmp_path: Path,
    report: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """A constant of the restart changed by a millionth, as a new library might."""
    path = plant_versions(log_file, tmp_path, numpy="0.1", kernels="0123456789ab")
    exact = twins.estimate_motion

    def other(*given: object) -> tuple[float, float]:
        u, v = exact(*given)  # type: ignore[arg-type]
        return u * (1 + 1e-6), v

    monkeypatch.setattr(twins, "estimate_motion", other)
    code = replay_logs(ReplayRequest([path], [], tmp_path / "out"))
    output = " ".join(capsys.readouterr().out.split())
    assert code == EXIT_NOT_IDENTICAL
    assert "numpy 0.1 -> " in output
    assert "kernels 0123456789ab -> " in output
    assert "scipy" not in output
    assert report["differing"] > 100
    sizes = report["relative_difference"]
    # the difference fades within a window, so it is a part of the millionth
    assert 1e-8 < sizes["window/rel_disp_m"] < 1e-6
    assert f"{max(v for k, v in sizes.items() if k.startswith('window')):.2g}" in output


def test_the_size_is_the_rms_of_the_difference_over_the_signal(
    recording: Recording, bundle: RunConfig, log_file: Path, tmp_path: Path, report: dict[str, Any]
) -> None:
    stiff = tmp_path / "stiff.toml"
    stiff.write_text(bundle.model_toml.replace("36000.0", "37800.0"))
    replay_logs(ReplayRequest([log_file], [str(stiff)], tmp_path / "out"))
    (old,) = recording.contiguous_blocks("pred")
    (new,) = read_recording(tmp_path / "out" / "run.mcap").contiguous_blocks("pred")
    sizes = report["relative_difference"]
    for name in ("free/rel_disp_m", "window/force_r1_n"):
        a, b = old.channel(name), new.channel(name)
        known = np.isfinite(a) & np.isfinite(b)
        expected = np.sqrt(np.sum((a - b)[known] ** 2) / np.sum(a[known] ** 2))
        assert sizes[name] == pytest.approx(expected, rel=1e-12)
        assert expected > 0.01
