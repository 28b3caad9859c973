"""A recording played again: the same to the bit with its model, not so with another."""

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from table_io.block import Block
from table_io.records import Comparison, Event, Fault, Params, PrcPoint, Record, RunStart, RunStop
from tests.builders.blocks import drop_measured, select_blocks
from tests.builders.recordings import store_items
from tests.replay.in_memory import recorded_in
from twin.compare import pipeline
from twin.recording.mcap_log import write_items
from twin.recording.reader import Recording, read_recording
from twin.replay.pipeline_replay import ReplayComparison, replay_recording
from twin.results.summary import summarise
from twin.setup.run_config import RunConfig, from_texts, read_run_config
from twin.setup.unpaced import simulate_ideal
from twin.transport.codec import Item, encode_item


def again(
    recording: Recording, bundle: RunConfig, folder: Path
) -> tuple[ReplayComparison, Recording]:
    """What a replay found, and the log that it wrote."""
    path = folder / f"again-{len(list(folder.iterdir()))}.mcap"
    identity = replay_recording(recorded_in(recording), bundle, path, "again", lambda _: None)
    return identity, read_recording(path)


def comparisons(recording: Recording) -> list[bytes]:
    return [encode_item(comparison, "") for comparison in recording.records(Comparison)]


def records(recording: Recording) -> list[bytes]:
    """Every record but the start and what it is a replay of, which differ from run to run."""
    return [
        encode_item(item, "") for item in recording.items
        if not isinstance(item, (Block, RunStart))
        and not (isinstance(item, Event) and item.kind == "replay")
    ]  # fmt: skip


def bundle_of(recording: Recording, model_toml: str | None = None) -> RunConfig:
    """The bundle from the recording and nothing else."""
    start = recording.start
    model = start.model_toml if model_toml is None else model_toml
    return from_texts(start.name, start.profile_toml, start.rig_toml, model, "recording")


def test_the_recorded_model_gives_the_recorded_comparisons(
    recording: Recording, tmp_path: Path
) -> None:
    """From the file alone: profile, machine card and model are in it."""
    identity, made = again(recording, bundle_of(recording), tmp_path)
    assert identity.is_identical
    assert identity.recorded == identity.compared == len(recording.records(Comparison)) > 300
    assert (identity.differing, identity.missing, identity.first_difference) == (0, 0, None)
    assert comparisons(made) == comparisons(recording)
    assert made.records(PrcPoint) == recording.records(PrcPoint)
    for stream in ("meas", "pred"):
        assert made.contiguous_blocks(stream)[0].is_identical(
            recording.contiguous_blocks(stream)[0]
        )
    assert made.start == replace(recording.start, run="again", started_at=made.start.started_at)
    assert made.stop == recording.stop


def test_a_replay_of_a_replay_is_identical(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    _, first = again(recording, bundle, tmp_path)
    identity, second = again(first, bundle, tmp_path)
    assert identity.is_identical
    assert records(first) == records(second)
    for stream in ("meas", "pred"):
        assert first.contiguous_blocks(stream)[0].is_identical(second.contiguous_blocks(stream)[0])


def test_a_stiffer_model_differs_and_is_worse(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    other = bundle_of(recording, bundle.model_toml.replace("36000.0", "37800.0"))
    identity, made = again(recording, other, tmp_path)
    assert not identity.is_identical
    assert identity.compared == identity.recorded
    # the first restart is at 250: before the next cell of 20 samples there is nothing to differ
    assert identity.first_difference == 260
    assert identity.differing > 0.9 * (identity.recorded - 13)
    assert identity.largest["rel_disp_m"] > 0
    assert made.start.model_toml == other.model_toml
    assert made.records(Params)[0].values["stiffness"] == 37800.0
    before: Any = summarise(recording, bundle.parameters).comparison
    after: Any = summarise(made, other.parameters).comparison
    for name in ("rel_disp_m", "mass_acc_m_s2"):
        assert after[name].nrmse > 2 * before[name].nrmse
        assert after[name].free_nrmse > 2 * before[name].free_nrmse


def test_a_bit_in_the_recording_is_noticed(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    """One sample of one channel, changed by one unit in the last place."""
    items = list(recording.items)
    place, block = next(
        (k, item) for k, item in enumerate(items)
        if isinstance(item, Block) and item.stream == "meas" and item.index >= 3000
    )  # fmt: skip
    values = block.values.copy()
    values[recording.start.channels.index("mass_disp_m"), 3] *= 1 + 2**-52
    items[place] = replace(block, values=values)
    write_items(tmp_path / "bent.mcap", items, recording.start)
    identity, _ = again(read_recording(tmp_path / "bent.mcap"), bundle, tmp_path)
    assert not identity.is_identical
    assert identity.first_difference == items[place].index


def test_a_lost_comparison_is_noticed(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    """A recording may lack what the twin said: what is there must agree, what is not is not asked;
    but one that a replay does not make again is missing."""
    extra = replace(recording.records(Comparison)[300], index=3007)
    write_items(tmp_path / "extra.mcap", [*recording.items, extra], recording.start)
    identity, _ = again(read_recording(tmp_path / "extra.mcap"), bundle, tmp_path)
    assert not identity.is_identical
    assert identity.missing == 1


# A twin that died


def recorded_with_faults(
    recording: Recording, bundle: RunConfig, spans: list[tuple[int, int]], path: Path
) -> Recording:
    """The recording as it would be had the twin been dead over `spans` of samples.

    Made with nothing but the pipeline: fed up to the death, started afresh at the end of it.
    """
    kept: list[Item] = [
        item
        for item in recording.items
        if (isinstance(item, Block) and item.stream == "meas")
        or isinstance(item, (RunStart, RunStop))
    ]
    setup = bundle.prepare_twin()
    whole = recording.contiguous_blocks("meas")[0]
    items: list[Record | Block] = []
    lives = [0, *(edge for span in spans for edge in span), whole.end]
    for first, last in list(pairwise(lives))[::2]:
        state, begun = pipeline.start_pipeline(setup, first)
        items.extend(begun)
        for at in range(first, last, 20):
            state, made = pipeline.step(setup, state, whole.cut(at, min(at + 20, last)))
            items.extend(made)
    items.extend(Fault(b, "twin", a, b, "the process died and was restarted") for a, b in spans)
    write_items(path, [*kept, *items], recording.start)
    return read_recording(path)


@pytest.mark.parametrize(
    "spans",
    [
        [(2013, 3007)],  # within blocks and cycles, so that grid cells are cut
        [(1000, 1520), (3500, 4520)],
        [(0, 1250)],  # dead from the start
    ],
)
def test_replay_is_dead_where_the_twin_was(
    recording: Recording, bundle: RunConfig, tmp_path: Path, spans: list[tuple[int, int]]
) -> None:
    died = recorded_with_faults(recording, bundle, spans, tmp_path / "died.mcap")
    identity, made = again(died, bundle, tmp_path)
    assert identity.is_identical
    assert identity.recorded == len(died.records(Comparison)) < len(recording.records(Comparison))
    assert comparisons(made) == comparisons(died)
    assert records(made) == records(died)
    for a, b in spans:
        assert not any(
            block.index < b and block.end > a for block in made.contiguous_blocks("pred")
        )
    # after the fresh start it differs from a twin that never died, so the fault mattered
    never, _ = again(replace(died, items=store_items(
        item for item in died.items if not isinstance(item, Fault)
    )), bundle, tmp_path)  # fmt: skip
    assert not never.is_identical
    identity, _ = again(made, bundle, tmp_path)
    assert identity.is_identical


def test_a_fault_of_another_component_leaves_the_twin_alive(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    fault = Fault(3000, "recorder", 2000, 3000, "the process died and was restarted")
    write_items(tmp_path / "run.mcap", [*recording.items, fault], recording.start)
    identity, made = again(read_recording(tmp_path / "run.mcap"), bundle, tmp_path)
    assert identity.is_identical
    assert made.records(Fault) == (fault,)


def test_missing_samples_are_replayed_as_they_were(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    measured = drop_measured(select_blocks(recording.items, "meas"), 2500, 2600)
    kept: list[Item] = [recording.start, *measured, *recording.records(RunStop)]
    write_items(tmp_path / "holed.mcap", kept, recording.start)
    _, first = again(read_recording(tmp_path / "holed.mcap"), bundle, tmp_path)
    identity, second = again(first, bundle, tmp_path)
    assert identity.is_identical
    assert identity.recorded > 200
    assert first.missing_samples == second.missing_samples == 100


def test_rig_events_are_kept_and_jump_events_recomputed(
    recording: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    note = Event(2500, "note", "the operator coughed")
    write_items(tmp_path / "run.mcap", [*recording.items, note], recording.start)
    _, made = again(read_recording(tmp_path / "run.mcap"), bundle, tmp_path)
    assert note in made.records(Event)
    hints = [event for event in recording.records(Event) if event.kind == "jump"]
    assert hints
    assert [event for event in made.records(Event) if event.kind == "jump"] == hints


# The model alone


@pytest.fixture(scope="module")
def simulated_run(bundle: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> Recording:
    path = tmp_path_factory.mktemp("simulate") / "run.mcap"
    simulate_ideal(bundle, "model", path, lambda _: None)
    return read_recording(path)


def test_a_simulation_has_measured_nothing(simulated_run: Recording, bundle: RunConfig) -> None:
    assert simulated_run.start.source == "model"
    summary: Any = summarise(simulated_run, bundle.parameters)
    assert len(summary.steps) == 6
    for step in summary.steps:
        assert step.measured is None
        assert step.twin.eta_d > 0
        assert step.table_acc_fundamental_m_s2 == pytest.approx(0.05 * 9.80665, rel=1e-3)
        assert step.thd < 1e-3
    assert all(point.measured is None for point in simulated_run.records(PrcPoint))
    assert all({error.nrmse, error.free_nrmse} == {None} for error in summary.comparison.values())
    assert "NaN" not in summary.to_json()
    assert summary.run.branches_from == "twin"


def test_a_simulated_point_is_that_of_physics_md(simulated_run: Recording) -> None:
    """Impacting at 3.4 Hz with neither servo nor noise, as far as the drift leaves it."""
    twins = {
        (point.direction, point.frequency_hz): point.twin
        for point in simulated_run.records(PrcPoint)
    }
    values = twins["forward", 3.4]
    assert values is not None
    assert abs(values.drift) < 0.05
    assert 30.537 * values.eta_d == pytest.approx(5.123, rel=1e-3 + abs(values.drift))
    assert (values.impacts_right, values.impacts_left) == ((1, 1), (1, 1))


def test_a_simulated_curve_of_free_flight_is_the_closed_form(
    bundle: RunConfig, tmp_path: Path
) -> None:
    """Smooth, the same both ways, |u| = A / |K/M - w^2 + i w C/M|, within the transient left."""
    free = bundle.profile_toml.replace("gap_mm = 4.0", "gap_mm = inf").replace(
        "cycles = 4\n", "cycles = 30\n"
    )
    free = free.replace("start_hz = 2.4", "start_hz = 1.4")
    (tmp_path / "free.toml").write_text(free)
    bundle = read_run_config(tmp_path / "free.toml")
    simulate_ideal(bundle, "free", tmp_path / "run.mcap", lambda _: None)
    summary: Any = summarise(read_recording(tmp_path / "run.mcap"), bundle.parameters)
    p = bundle.parameters
    assert len(summary.steps) == 8
    for step in summary.steps:
        w = 2 * math.pi * step.frequency_hz
        u = 0.05 * 9.80665 / abs(complex(p.stiffness / p.mass - w**2, p.damping * w / p.mass))
        assert step.twin.eta_d == pytest.approx(u / summary.u_star_m, rel=2e-3)
        assert (step.twin.r_r, step.twin.eta_l) == (0, 0)
    assert summary.jumps == summary.hysteresis == []


def test_a_simulation_predicts_from_its_first_sample(simulated_run: Recording) -> None:
    (predicted,) = simulated_run.contiguous_blocks("pred")
    assert np.isfinite(predicted.channel("free/rel_disp_m")).all()
    assert np.isnan(predicted.channel("window/rel_disp_m")).all()


def test_the_replay_of_a_simulation_is_identical(
    simulated_run: Recording, bundle: RunConfig, tmp_path: Path
) -> None:
    identity, made = again(simulated_run, bundle_of(simulated_run), tmp_path)
    assert identity.is_identical
    assert identity.recorded > 300
    assert made.records(PrcPoint) == simulated_run.records(PrcPoint) or all(
        encode_item(a, "") == encode_item(b, "")
        for a, b in zip(made.records(PrcPoint), simulated_run.records(PrcPoint), strict=True)
    )
    assert made.contiguous_blocks("pred")[0].is_identical(
        simulated_run.contiguous_blocks("pred")[0]
    )
    assert all(math.isnan(comparison.free_error_ss[0]) for comparison in made.records(Comparison))
