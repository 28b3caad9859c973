"""The whole twin on a short measured stream: the cut of the samples changes no bit."""

import pickle
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.acquisition.session import OperatorCommand, run_session
from table_io.backends import open_backend
from table_io.block import Block, Label, join_blocks
from table_io.clock import ManualClock
from table_io.config.base import PROFILES_DIR
from table_io.records import (
    Agreement,
    Comparison,
    CycleExtremes,
    Estimate,
    Event,
    JumpForecast,
    Params,
    PrcPoint,
    StepAdded,
)
from tests.builders.blocks import recut_blocks
from tests.builders.profiles import AT_1_KHZ, format_test
from twin.compare import pipeline
from twin.compare.monitoring.jumps import ExpectedJump
from twin.setup.run_config import RunConfig, from_texts
from twin.transport.codec import Item, encode_item

PROFILE = format_test(3.0, 4.6, 1.6, cycles=5, tables=AT_1_KHZ)


@pytest.fixture(scope="module")
def bundle() -> RunConfig:
    texts = [
        (PROFILES_DIR / name).read_text() for name in ("rigs/simulated.toml", "models/snm.toml")
    ]
    return from_texts("short", PROFILE, texts[0], texts[1], "short")


@pytest.fixture(scope="module")
def setup(bundle: RunConfig) -> pipeline.PipelineSetup:
    """With a jump of the model between both frequencies, which so coarse a grid hides."""
    jump = ExpectedJump(bundle.steps[0], bundle.steps[1], "down")
    return replace(bundle.prepare_twin(), expected_jumps=(jump,))


@pytest.fixture(scope="module")
def measured_block(bundle: RunConfig) -> Block:
    """Every measured sample of the test on the simulated table."""
    return table(bundle)


def table(bundle: RunConfig, stop_at: int | None = None) -> Block:
    clock, played_end = ManualClock(), 0
    blocks = []

    def order() -> OperatorCommand | None:
        return (
            OperatorCommand("stop", "enough")
            if stop_at is not None and played_end >= stop_at
            else None
        )

    backend = open_backend(bundle.rig, bundle.profile, clock)
    for item in run_session(
        bundle.session_setup, backend, clock, bundle.make_start_factory("r", "table"), order
    ):
        if isinstance(item, Block):
            blocks.append(item)
            played_end = item.end
    return join_blocks(blocks)


def run_pipeline(
    setup: pipeline.PipelineSetup,
    blocks: Iterable[Block],
    state: pipeline.PipelineState | None = None,
) -> list[Item]:
    """All that the twin says about consecutive blocks."""
    items: list[Item] = []
    for block in blocks:
        if state is None:
            state, _ = pipeline.start_pipeline(setup, block.index)
        state, made = pipeline.step(setup, state, block)
        items.extend(made)
    return items


def join_predictions(items: Sequence[Item]) -> Block:
    return join_blocks([item for item in items if isinstance(item, Block)])


def records(items: Sequence[Item]) -> list[tuple[type, bytes]]:
    """Everything but blocks, as bytes in order of index and kind."""
    kept = [item for item in items if not isinstance(item, Block)]
    kept.sort(key=lambda item: (item.index, type(item).__name__))
    return [(type(item), encode_item(item, "")) for item in kept]


def of(items: Sequence[Item], kind: type) -> list:
    return [item for item in items if isinstance(item, kind)]


# The law of cuts


@pytest.mark.parametrize("samples", [7, 64, 500])
def test_cutting_the_samples_changes_no_bit(
    setup: pipeline.PipelineSetup, measured_block: Block, samples: int
) -> None:
    whole = run_pipeline(setup, [measured_block])
    cut = run_pipeline(setup, recut_blocks([measured_block], samples))
    assert encode_item(join_predictions(cut), "") == encode_item(join_predictions(whole), "")
    assert records(cut) == records(whole)
    kinds = {kind for kind, _ in records(whole)}
    assert kinds >= {
        Comparison,
        CycleExtremes,
        PrcPoint,
        Event,
        Agreement,
        Estimate,
        JumpForecast,
    }, "the case must have every kind of item"
    assert np.isfinite(join_predictions(whole).values[:, 1000:]).all()


@settings(max_examples=40)
@given(data=st.data())
def test_any_cut_of_a_stretch_changes_no_bit(
    setup: pipeline.PipelineSetup, measured_block: Block, data: st.DataObject
) -> None:
    """From the end of one step over the blend into the next: a point, cycles, restarts."""
    first = int(np.flatnonzero(measured_block.step == 1)[0]) - 700
    stretch = measured_block.cut(first, first + 1500)
    inner = st.integers(first + 1, first + 1499)
    cuts = sorted(data.draw(st.sets(inner, max_size=12)))
    edges = [first, *cuts, first + 1500]
    cut = run_pipeline(setup, [stretch.cut(a, b) for a, b in pairwise(edges)])
    whole = run_pipeline(setup, [stretch])
    assert join_predictions(cut).is_identical(join_predictions(whole))
    assert records(cut) == records(whole)


def test_lost_samples_are_lost_whatever_the_cut(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    values = measured_block.values.copy()
    values[:, 2500:2507] = np.nan
    holed = replace(measured_block, values=values)
    pieces = [holed.cut(0, 4000), holed.cut(4100, measured_block.end)]
    whole = run_pipeline(setup, pieces)
    for samples in (7, 64):
        cut = run_pipeline(
            setup, [block for piece in pieces for block in recut_blocks([piece], samples)]
        )
        assert records(cut) == records(whole)
        for a, b in ((0, 4000), (4100, measured_block.end)):
            got, want = (
                join_blocks([block for block in of(items, Block) if a <= block.index < b])
                for items in (cut, whole)
            )
            assert got.is_identical(want)


# Pure


def test_step_is_pure(setup: pipeline.PipelineSetup, measured_block: Block) -> None:
    state, _ = pipeline.start_pipeline(setup)
    for block in recut_blocks([measured_block], 997):
        before = pickle.dumps(state)
        after, items = pipeline.step(setup, state, block)
        assert pickle.dumps(state) == before
        again, same = pipeline.step(setup, state, block)
        assert [encode_item(item, "") for item in same] == [encode_item(item, "") for item in items]
        assert pickle.dumps(again) == pickle.dumps(after)
        state = after


def test_a_state_that_travelled_goes_on_the_same(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    """The state is the whole memory: pickled in the middle, nothing is lost."""
    middle = 3333
    state, _ = pipeline.start_pipeline(setup)
    state, first = pipeline.step(setup, state, measured_block.cut(0, middle))
    travelled = pickle.loads(pickle.dumps(state))
    rest = run_pipeline(setup, [measured_block.cut(middle, measured_block.end)], travelled)
    assert records([*first, *rest]) == records(run_pipeline(setup, [measured_block]))


def test_start_says_the_parameters(setup: pipeline.PipelineSetup) -> None:
    state, (params,) = pipeline.start_pipeline(setup, 1234)
    assert state.twins.index == 1234
    assert params == Params(1234, setup.twin.parameters.as_dict(), "start")


# Cycles and points


def test_every_held_cycle_and_every_step_once(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    items = run_pipeline(setup, [measured_block])
    cycles, points = of(items, CycleExtremes), of(items, PrcPoint)
    assert [(cycle.step, cycle.cycle) for cycle in cycles] == [
        (s, c) for s in range(4) for c in range(5)
    ]
    assert [point.step for point in points] == [0, 1, 2, 3]
    for cycle in cycles:
        window = slice(cycle.index - cycle.count, cycle.index)
        assert set(measured_block.step[window]) == {cycle.step}
        assert set(measured_block.cycle[window]) == {cycle.cycle}
        assert cycle.label == (Label.SETTLE if cycle.cycle < 3 else Label.MEASURE)
        assert cycle.measured is not None
        for place in (*cycle.measured.onsets_r, *cycle.measured.onsets_l):
            assert cycle.index - cycle.count <= place < cycle.index
    last = {cycle.step: cycle.index for cycle in cycles}
    assert [point.index for point in points] == [last[step] for step in range(4)]


def test_a_twin_beside_the_table_says_what_is_measured(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    """Forward 3.0 Hz after a soft start; backward the same frequency in free flight or not: the
    twin, from no more than the table's acceleration, is where the rig is."""
    for point in of(run_pipeline(setup, [measured_block]), PrcPoint):
        assert point.twin is not None
        assert point.twin.eta_d == pytest.approx(point.measured.eta_d, rel=0.03)
        assert point.twin.impacts_right == point.measured.impacts_right


def test_the_gap_at_onset_corrects_a_gap_that_is_stated_wrong(bundle: RunConfig) -> None:
    profile = PROFILE.replace("= 3.0", "= 2.4").replace("= 4.6", "= 2.5").replace("= 1.6", "= 0.1")
    impacting = from_texts("short", profile, bundle.rig_toml, bundle.model_toml, "short")
    setup, block = impacting.prepare_twin(), table(impacting)
    wrong = replace(setup, scale=replace(setup.scale, gaps_m=(0.0025, 0.0015)))
    want, got = (of(run_pipeline(each, [block]), PrcPoint)[0].measured for each in (setup, wrong))
    assert want.eta_r > 0.03
    for side in ("eta_r", "eta_l"):  # the error is 0.016 of u*, half a sample of closing 0.003
        assert getattr(got, side) == pytest.approx(getattr(want, side), abs=0.005)


@pytest.mark.parametrize("late", [1, 50, 200])
def test_a_twin_that_wakes_within_a_held_cycle_says_nothing_about_it(
    setup: pipeline.PipelineSetup, measured_block: Block, late: int
) -> None:
    first = int(np.flatnonzero((measured_block.step == 1) & (measured_block.cycle == 1))[0])
    items = run_pipeline(
        setup, recut_blocks([measured_block.cut(first + late, measured_block.end)], 64)
    )
    assert [(cycle.step, cycle.cycle) for cycle in of(items, CycleExtremes)][:2] == [(1, 2), (1, 3)]
    assert [point.step for point in of(items, PrcPoint)] == [1, 2, 3]


def test_a_twin_that_wakes_within_the_measured_cycles_makes_no_point_of_them(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    first = int(np.flatnonzero((measured_block.step == 1) & (measured_block.cycle == 3))[0])
    items = run_pipeline(
        setup, recut_blocks([measured_block.cut(first + 5, measured_block.end)], 64)
    )
    assert next((cycle.step, cycle.cycle) for cycle in of(items, CycleExtremes)) == (1, 4)
    assert [point.step for point in of(items, PrcPoint)] == [2, 3]


def test_missing_samples_leave_no_cycle_and_no_point_across_them(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    first = int(np.flatnonzero((measured_block.step == 1) & (measured_block.cycle == 3))[0])
    pieces = [measured_block.cut(0, first + 50), measured_block.cut(first + 60, measured_block.end)]
    items = run_pipeline(setup, pieces)
    assert (1, 3) not in {(cycle.step, cycle.cycle) for cycle in of(items, CycleExtremes)}
    assert [point.step for point in of(items, PrcPoint)] == [0, 2, 3]


@pytest.mark.parametrize("into", [30, 150, 250])
def test_a_stop_in_a_cycle_leaves_no_partial_cycle(
    bundle: RunConfig, setup: pipeline.PipelineSetup, measured_block: Block, into: int
) -> None:
    asked = int(np.flatnonzero((measured_block.step == 0) & (measured_block.cycle == 2))[0]) + into
    stopped = table(bundle, stop_at=asked)
    assert (stopped.label == Label.STOP).any()
    items = run_pipeline(setup, recut_blocks([stopped], 20))
    assert not of(items, PrcPoint)
    for cycle in of(items, CycleExtremes):
        assert cycle.count >= 1000.0 / 3.0 - 1
        assert not (stopped.label[cycle.index - cycle.count : cycle.index] == Label.STOP).any()
    assert {cycle.cycle for cycle in of(items, CycleExtremes)} <= {0, 1, 2}


def test_contact_at_the_start_of_a_held_cycle_is_no_impact_by_itself(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    """Permanent contact, as of a precompressed bumper, is never an onset."""
    values = measured_block.values.copy()
    values[measured_block.channels.index("force_r1_n")] = 400.0
    items = run_pipeline(setup, [replace(measured_block, values=values)])
    assert not any(cycle.measured.onsets_r for cycle in of(items, CycleExtremes))


def test_lost_load_cells_and_accelerometer_leave_the_displacement(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    lost = ("mass_acc_m_s2", "force_l1_n", "force_l2_n")
    kept = [place for place, name in enumerate(measured_block.channels) if name not in lost]
    names = tuple(measured_block.channels[place] for place in kept)
    items = run_pipeline(
        setup, [replace(measured_block, channels=names, values=measured_block.values[kept])]
    )
    whole = of(run_pipeline(setup, [measured_block]), PrcPoint)
    for got, want in zip(of(items, PrcPoint), whole, strict=True):
        assert got.twin is None  # it never had a state to start from
        assert got.measured.eta_d == want.measured.eta_d
        assert got.measured.r_r == want.measured.r_r
        assert np.isnan([got.measured.eta_a, got.measured.r_l]).all()


def test_jump_of_the_curve_is_an_event(
    setup: pipeline.PipelineSetup, measured_block: Block
) -> None:
    events = of(run_pipeline(setup, [measured_block]), Event)
    assert {event.kind for event in events} == {"jump"}
    assert "forward, 3 to 4.6 Hz: eta_d" in events[0].text


# Steps that are decided on while the test runs


@pytest.fixture(scope="module")
def added_steps(bundle: RunConfig) -> list[StepAdded]:
    """The test's steps but the first, as if a tool had decided on them."""
    return [
        StepAdded(
            0, step.index, step.direction, step.frequency_hz, step.acceleration_m_s2, "because"
        )
        for step in bundle.steps[1:]
    ]


@pytest.fixture(scope="module")
def first_only(bundle: RunConfig) -> pipeline.PipelineSetup:
    return pipeline.prepare_pipeline(bundle.profile, bundle.model, bundle.steps[:1])


def but_events(items: Sequence[Item]) -> list[tuple[type, bytes]]:
    """Without what is said of jumps."""
    return records([item for item in items if not isinstance(item, (Event, JumpForecast))])


def test_a_decided_step_has_its_cycles_and_its_point_but_no_leap(
    setup: pipeline.PipelineSetup,
    first_only: pipeline.PipelineSetup,
    measured_block: Block,
    added_steps: list[StepAdded],
) -> None:
    """Visits come at odd frequencies, on either branch: what differs there is no jump."""
    whole = run_pipeline(setup, [measured_block])
    items = run_pipeline(pipeline.add_steps(first_only, *added_steps), [measured_block])
    assert but_events(items) == but_events(whole)
    assert of(whole, Event)
    assert not of(items, Event)


def test_comparison_does_not_depend_on_when_and_how_often_a_step_is_announced(
    first_only: pipeline.PipelineSetup, measured_block: Block, added_steps: list[StepAdded]
) -> None:
    at_once = run_pipeline(
        pipeline.add_steps(first_only, *added_steps), recut_blocks([measured_block], 250)
    )
    one_by_one, setup = [], first_only
    state, _ = pipeline.start_pipeline(setup)
    begins = {
        added_step.step: int(np.flatnonzero(measured_block.step == added_step.step)[0])
        for added_step in added_steps
    }
    for block in recut_blocks([measured_block], 250):
        for added_step in added_steps:
            if begins[added_step.step] < block.end + 250:
                setup = pipeline.add_steps(setup, added_step)
        state, made = pipeline.step(setup, state, block)
        one_by_one.extend(made)
    assert len(setup.added_steps) == len(added_steps)
    assert records(one_by_one) == records(at_once)


def test_step_that_was_not_announced_is_skipped(
    setup: pipeline.PipelineSetup, first_only: pipeline.PipelineSetup, measured_block: Block
) -> None:
    items = run_pipeline(first_only, [measured_block])
    assert {record.step for record in (*of(items, CycleExtremes), *of(items, PrcPoint))} == {0}
    assert join_predictions(items).is_identical(
        join_predictions(run_pipeline(setup, [measured_block]))
    )
