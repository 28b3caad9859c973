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
from table_io.block import Block, Label, join_blocks, recut_blocks
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
from twin.compare import pipeline
from twin.run.run_config import RunConfig, from_texts
from twin.transport.codec import Item, encode_item

PROFILE = """
title = "Two frequencies on either side of the down-jump, up and back"
[specimen]
mass_kg = 550.0
gap_mm = 4.0
[sweep]
start_hz = 3.0
stop_hz = 4.6
step_hz = 1.6
cycles = 5
measured_cycles = 2
[acquisition]
rate_hz = 1000.0
"""


@pytest.fixture(scope="module")
def bundle() -> RunConfig:
    texts = [
        (PROFILES_DIR / name).read_text() for name in ("rigs/simulated.toml", "models/snm.toml")
    ]
    return from_texts("short", PROFILE, texts[0], texts[1], "short")


@pytest.fixture(scope="module")
def setup(bundle: RunConfig) -> pipeline.PipelineSetup:
    return bundle.prepare_twin()


@pytest.fixture(scope="module")
def measured(bundle: RunConfig) -> Block:
    """Every measured sample of the test on the simulated table."""
    return table(bundle)


def table(bundle: RunConfig, stop_at: int | None = None) -> Block:
    clock, seen = ManualClock(), 0
    blocks = []

    def order() -> OperatorCommand | None:
        return (
            OperatorCommand("stop", "enough") if stop_at is not None and seen >= stop_at else None
        )

    backend = open_backend(bundle.rig, bundle.profile, clock)
    for item in run_session(
        bundle.session_setup, backend, clock, bundle.make_start_factory("r", "table"), order
    ):
        if isinstance(item, Block):
            blocks.append(item)
            seen = item.end
    return join_blocks(blocks)


def said(
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


def predicted(items: Sequence[Item]) -> Block:
    return join_blocks([one for one in items if isinstance(one, Block)])


def records(items: Sequence[Item]) -> list[tuple[type, bytes]]:
    """Everything but blocks, as bytes in order of index and kind."""
    found = [one for one in items if not isinstance(one, Block)]
    found.sort(key=lambda one: (one.index, type(one).__name__))
    return [(type(one), encode_item(one, "")) for one in found]


def of(items: Sequence[Item], kind: type) -> list:
    return [one for one in items if isinstance(one, kind)]


# The law of cuts


@pytest.mark.parametrize("samples", [1, 7, 64, 500])
def test_cutting_the_samples_changes_no_bit(
    setup: pipeline.PipelineSetup, measured: Block, samples: int
) -> None:
    whole = said(setup, [measured])
    cut = said(setup, recut_blocks([measured], samples))
    assert encode_item(predicted(cut), "") == encode_item(predicted(whole), "")
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
    assert np.isfinite(predicted(whole).values[:, 1000:]).all()


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_cut_of_a_stretch_changes_no_bit(
    setup: pipeline.PipelineSetup, measured: Block, data: st.DataObject
) -> None:
    """From the end of one step over the blend into the next: a point, cycles, restarts."""
    first = int(np.flatnonzero(measured.step == 1)[0]) - 700
    stretch = measured.cut(first, first + 1500)
    inner = st.integers(first + 1, first + 1499)
    cuts = sorted(data.draw(st.sets(inner, max_size=12)))
    edges = [first, *cuts, first + 1500]
    cut = said(setup, [stretch.cut(a, b) for a, b in pairwise(edges)])
    whole = said(setup, [stretch])
    assert predicted(cut).is_identical(predicted(whole))
    assert records(cut) == records(whole)


def test_lost_samples_are_lost_whatever_the_cut(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    values = measured.values.copy()
    values[:, 2500:2507] = np.nan
    holed = replace(measured, values=values)
    pieces = [holed.cut(0, 4000), holed.cut(4100, measured.end)]
    whole = said(setup, pieces)
    for samples in (7, 64):
        cut = said(setup, [one for piece in pieces for one in recut_blocks([piece], samples)])
        assert records(cut) == records(whole)
        for a, b in ((0, 4000), (4100, measured.end)):
            got, want = (
                join_blocks([one for one in of(items, Block) if a <= one.index < b])
                for items in (cut, whole)
            )
            assert got.is_identical(want)


# Pure


def test_step_is_pure(setup: pipeline.PipelineSetup, measured: Block) -> None:
    state, _ = pipeline.start_pipeline(setup)
    for block in recut_blocks([measured], 997):
        before = pickle.dumps(state)
        after, items = pipeline.step(setup, state, block)
        assert pickle.dumps(state) == before
        again, same = pipeline.step(setup, state, block)
        assert [encode_item(one, "") for one in same] == [encode_item(one, "") for one in items]
        assert pickle.dumps(again) == pickle.dumps(after)
        state = after


def test_a_state_that_travelled_goes_on_the_same(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    """The state is the whole memory: pickled in the middle, nothing is lost."""
    middle = 3333
    state, _ = pipeline.start_pipeline(setup)
    state, first = pipeline.step(setup, state, measured.cut(0, middle))
    travelled = pickle.loads(pickle.dumps(state))
    rest = said(setup, [measured.cut(middle, measured.end)], travelled)
    assert records([*first, *rest]) == records(said(setup, [measured]))


def test_start_says_the_parameters(setup: pipeline.PipelineSetup) -> None:
    state, (params,) = pipeline.start_pipeline(setup, 1234)
    assert state.twins.index == 1234
    assert params == Params(1234, setup.twin.parameters.as_dict(), "start")


# Cycles and points


def test_every_held_cycle_and_every_step_once(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    items = said(setup, [measured])
    cycles, points = of(items, CycleExtremes), of(items, PrcPoint)
    assert [(one.step, one.cycle) for one in cycles] == [(s, c) for s in range(4) for c in range(5)]
    assert [one.step for one in points] == [0, 1, 2, 3]
    for one in cycles:
        window = slice(one.index - one.count, one.index)
        assert set(measured.step[window]) == {one.step}
        assert set(measured.cycle[window]) == {one.cycle}
        assert one.label == (Label.SETTLE if one.cycle < 3 else Label.MEASURE)
        assert one.measured is not None
        for place in (*one.measured.onsets_r, *one.measured.onsets_l):
            assert one.index - one.count <= place < one.index
    last = {one.step: one.index for one in cycles}
    assert [one.index for one in points] == [last[step] for step in range(4)]


def test_a_twin_beside_the_table_says_what_is_measured(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    """Forward 3.0 Hz after a soft start; backward the same frequency in free flight or not: the
    twin, from no more than the table's acceleration, is where the rig is."""
    for one in of(said(setup, [measured]), PrcPoint):
        assert one.twin is not None
        assert one.twin.eta_d == pytest.approx(one.measured.eta_d, rel=0.03)
        assert one.twin.impacts_right == one.measured.impacts_right


@pytest.mark.parametrize("late", [1, 50, 200])
def test_a_twin_that_wakes_within_a_held_cycle_says_nothing_about_it(
    setup: pipeline.PipelineSetup, measured: Block, late: int
) -> None:
    first = int(np.flatnonzero((measured.step == 1) & (measured.cycle == 1))[0])
    items = said(setup, recut_blocks([measured.cut(first + late, measured.end)], 64))
    assert [(one.step, one.cycle) for one in of(items, CycleExtremes)][:2] == [(1, 2), (1, 3)]
    assert [one.step for one in of(items, PrcPoint)] == [1, 2, 3]


def test_a_twin_that_wakes_within_the_measured_cycles_makes_no_point_of_them(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    first = int(np.flatnonzero((measured.step == 1) & (measured.cycle == 3))[0])
    items = said(setup, recut_blocks([measured.cut(first + 5, measured.end)], 64))
    assert next((one.step, one.cycle) for one in of(items, CycleExtremes)) == (1, 4)
    assert [one.step for one in of(items, PrcPoint)] == [2, 3]


def test_missing_samples_leave_no_cycle_and_no_point_across_them(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    first = int(np.flatnonzero((measured.step == 1) & (measured.cycle == 3))[0])
    pieces = [measured.cut(0, first + 50), measured.cut(first + 60, measured.end)]
    items = said(setup, pieces)
    assert (1, 3) not in {(one.step, one.cycle) for one in of(items, CycleExtremes)}
    assert [one.step for one in of(items, PrcPoint)] == [0, 2, 3]


@pytest.mark.parametrize("into", [30, 150, 250])
def test_a_stop_in_a_cycle_leaves_no_partial_cycle(
    bundle: RunConfig, setup: pipeline.PipelineSetup, measured: Block, into: int
) -> None:
    asked = int(np.flatnonzero((measured.step == 0) & (measured.cycle == 2))[0]) + into
    stopped = table(bundle, stop_at=asked)
    assert (stopped.label == Label.STOP).any()
    items = said(setup, recut_blocks([stopped], 20))
    assert not of(items, PrcPoint)
    for one in of(items, CycleExtremes):
        assert one.count >= 1000.0 / 3.0 - 1
        assert not (stopped.label[one.index - one.count : one.index] == Label.STOP).any()
    assert {one.cycle for one in of(items, CycleExtremes)} <= {0, 1, 2}


def test_contact_at_the_start_of_a_held_cycle_is_no_impact_by_itself(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    """Permanent contact, as of a precompressed bumper, is never an onset."""
    values = measured.values.copy()
    values[measured.channels.index("force_r1_n")] = 400.0
    items = said(setup, [replace(measured, values=values)])
    assert not any(one.measured.onsets_r for one in of(items, CycleExtremes))


def test_lost_load_cells_and_accelerometer_leave_the_displacement(
    setup: pipeline.PipelineSetup, measured: Block
) -> None:
    lost = ("mass_acc_m_s2", "force_l1_n", "force_l2_n")
    kept = [place for place, name in enumerate(measured.channels) if name not in lost]
    names = tuple(measured.channels[place] for place in kept)
    items = said(setup, [replace(measured, channels=names, values=measured.values[kept])])
    whole = of(said(setup, [measured]), PrcPoint)
    for got, want in zip(of(items, PrcPoint), whole, strict=True):
        assert got.twin is None  # it never had a state to start from
        assert got.measured.eta_d == want.measured.eta_d
        assert got.measured.r_r == want.measured.r_r
        assert np.isnan([got.measured.eta_a, got.measured.r_l]).all()


def test_a_leap_is_an_event(setup: pipeline.PipelineSetup, measured: Block) -> None:
    events = of(said(setup, [measured]), Event)
    assert {one.kind for one in events} == {"jump"}
    assert "forward: the jump down between 3 and 4.6 Hz came" in events[0].text


# Steps that are decided on while the test runs


@pytest.fixture(scope="module")
def decided(bundle: RunConfig) -> list[StepAdded]:
    """The test's steps but the first, as if a tool had decided on them."""
    return [
        StepAdded(0, one.index, one.direction, one.frequency_hz, one.acceleration_m_s2, "because")
        for one in bundle.steps[1:]
    ]


@pytest.fixture(scope="module")
def first_only(bundle: RunConfig) -> pipeline.PipelineSetup:
    return pipeline.prepare_pipeline(bundle.profile, bundle.model, bundle.steps[:1])


def but_events(items: Sequence[Item]) -> list[tuple[type, bytes]]:
    """Without what is said of jumps."""
    return records([one for one in items if not isinstance(one, (Event, JumpForecast))])


def test_a_decided_step_has_its_cycles_and_its_point_but_no_leap(
    setup: pipeline.PipelineSetup,
    first_only: pipeline.PipelineSetup,
    measured: Block,
    decided: list[StepAdded],
) -> None:
    """Visits come at odd frequencies, on either branch: what differs there is no jump."""
    whole = said(setup, [measured])
    items = said(pipeline.add_steps(first_only, *decided), [measured])
    assert but_events(items) == but_events(whole)
    assert of(whole, Event)
    assert not of(items, Event)


def test_it_does_not_matter_when_and_how_often_a_step_is_told_of(
    first_only: pipeline.PipelineSetup, measured: Block, decided: list[StepAdded]
) -> None:
    at_once = said(pipeline.add_steps(first_only, *decided), recut_blocks([measured], 250))
    one_by_one, setup = [], first_only
    state, _ = pipeline.start_pipeline(setup)
    begins = {one.step: int(np.flatnonzero(measured.step == one.step)[0]) for one in decided}
    for block in recut_blocks([measured], 250):
        for one in decided:
            if begins[one.step] < block.end + 250:
                setup = pipeline.add_steps(setup, one)
        state, made = pipeline.step(setup, state, block)
        one_by_one.extend(made)
    assert len(setup.added_steps) == len(decided)
    assert records(one_by_one) == records(at_once)


def test_a_step_that_nobody_told_of_is_passed_over(
    setup: pipeline.PipelineSetup, first_only: pipeline.PipelineSetup, measured: Block
) -> None:
    items = said(first_only, [measured])
    assert {one.step for one in (*of(items, CycleExtremes), *of(items, PrcPoint))} == {0}
    assert predicted(items).is_identical(predicted(said(setup, [measured])))
