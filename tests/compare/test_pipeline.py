"""The whole twin on a short measured stream: the cut of the samples changes no bit."""

import pickle
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from table_io.backends import open_backend
from table_io.block import Block, Label, join, recut
from table_io.card import PROFILES
from table_io.clock import ManualClock
from table_io.records import (
    Agreement,
    Ahead,
    Comparison,
    Cycle,
    Decided,
    Estimate,
    Event,
    Params,
    Point,
)
from table_io.session import Order, play
from twin.compare import pipeline
from twin.service.bundle import Bundle, from_texts
from twin.stream.wire import Item, encode

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
def bundle() -> Bundle:
    texts = [(PROFILES / name).read_text() for name in ("rigs/simulated.toml", "models/snm.toml")]
    return from_texts("short", PROFILE, texts[0], texts[1], "short")


@pytest.fixture(scope="module")
def setup(bundle: Bundle) -> pipeline.Setup:
    return bundle.twin()


@pytest.fixture(scope="module")
def measured(bundle: Bundle) -> Block:
    """Every measured sample of the test on the simulated table."""
    return table(bundle)


def table(bundle: Bundle, stop_at: int | None = None) -> Block:
    clock, seen = ManualClock(), 0
    blocks = []

    def order() -> Order | None:
        return Order("stop", "enough") if stop_at is not None and seen >= stop_at else None

    backend = open_backend(bundle.rig, bundle.profile, clock)
    for item in play(bundle.session, backend, clock, bundle.describe("r", "table"), order):
        if isinstance(item, Block):
            blocks.append(item)
            seen = item.end
    return join(blocks)


def said(
    setup: pipeline.Setup, blocks: Iterable[Block], state: pipeline.State | None = None
) -> list[Item]:
    """All that the twin says about consecutive blocks."""
    items: list[Item] = []
    for block in blocks:
        if state is None:
            state, _ = pipeline.start(setup, block.index)
        state, made = pipeline.step(setup, state, block)
        items.extend(made)
    return items


def predicted(items: Sequence[Item]) -> Block:
    return join([one for one in items if isinstance(one, Block)])


def records(items: Sequence[Item]) -> list[tuple[type, bytes]]:
    """Everything but blocks, as bytes in order of index and kind."""
    found = [one for one in items if not isinstance(one, Block)]
    found.sort(key=lambda one: (one.index, type(one).__name__))
    return [(type(one), encode(one, "")) for one in found]


def of(items: Sequence[Item], kind: type) -> list:
    return [one for one in items if isinstance(one, kind)]


# The law of cuts


@pytest.mark.parametrize("samples", [1, 7, 64, 500])
def test_cutting_the_samples_changes_no_bit(
    setup: pipeline.Setup, measured: Block, samples: int
) -> None:
    whole = said(setup, [measured])
    cut = said(setup, recut([measured], samples))
    assert encode(predicted(cut), "") == encode(predicted(whole), "")
    assert records(cut) == records(whole)
    kinds = {kind for kind, _ in records(whole)}
    assert kinds >= {Comparison, Cycle, Point, Event, Agreement, Estimate, Ahead}, (
        "the case must have every kind of item"
    )
    assert np.isfinite(predicted(whole).values[:, 1000:]).all()


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_any_cut_of_a_stretch_changes_no_bit(
    setup: pipeline.Setup, measured: Block, data: st.DataObject
) -> None:
    """From the end of one step over the blend into the next: a point, cycles, restarts."""
    first = int(np.flatnonzero(measured.step == 1)[0]) - 700
    stretch = measured.cut(first, first + 1500)
    inner = st.integers(first + 1, first + 1499)
    cuts = sorted(data.draw(st.sets(inner, max_size=12)))
    edges = [first, *cuts, first + 1500]
    cut = said(setup, [stretch.cut(a, b) for a, b in pairwise(edges)])
    whole = said(setup, [stretch])
    assert predicted(cut).identical(predicted(whole))
    assert records(cut) == records(whole)


def test_lost_samples_are_lost_whatever_the_cut(setup: pipeline.Setup, measured: Block) -> None:
    values = measured.values.copy()
    values[:, 2500:2507] = np.nan
    holed = replace(measured, values=values)
    pieces = [holed.cut(0, 4000), holed.cut(4100, measured.end)]
    whole = said(setup, pieces)
    for samples in (7, 64):
        cut = said(setup, [one for piece in pieces for one in recut([piece], samples)])
        assert records(cut) == records(whole)
        for a, b in ((0, 4000), (4100, measured.end)):
            got, want = (
                join([one for one in of(items, Block) if a <= one.index < b])
                for items in (cut, whole)
            )
            assert got.identical(want)


# Pure


def test_step_is_pure(setup: pipeline.Setup, measured: Block) -> None:
    state, _ = pipeline.start(setup)
    for block in recut([measured], 997):
        before = pickle.dumps(state)
        after, items = pipeline.step(setup, state, block)
        assert pickle.dumps(state) == before
        again, same = pipeline.step(setup, state, block)
        assert [encode(one, "") for one in same] == [encode(one, "") for one in items]
        assert pickle.dumps(again) == pickle.dumps(after)
        state = after


def test_a_state_that_travelled_goes_on_the_same(setup: pipeline.Setup, measured: Block) -> None:
    """The state is the whole memory: pickled in the middle, nothing is lost."""
    middle = 3333
    state, _ = pipeline.start(setup)
    state, first = pipeline.step(setup, state, measured.cut(0, middle))
    travelled = pickle.loads(pickle.dumps(state))
    rest = said(setup, [measured.cut(middle, measured.end)], travelled)
    assert records([*first, *rest]) == records(said(setup, [measured]))


def test_start_says_the_parameters(setup: pipeline.Setup) -> None:
    state, (params,) = pipeline.start(setup, 1234)
    assert state.tracks.index == 1234
    assert params == Params(1234, setup.twin.parameters.as_dict(), "start")


# Cycles and points


def test_every_held_cycle_and_every_step_once(setup: pipeline.Setup, measured: Block) -> None:
    items = said(setup, [measured])
    cycles, points = of(items, Cycle), of(items, Point)
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
    setup: pipeline.Setup, measured: Block
) -> None:
    """Forward 3.0 Hz after a soft start; backward the same frequency in free flight or not: the
    twin, from no more than the table's acceleration, is where the rig is."""
    for one in of(said(setup, [measured]), Point):
        assert one.twin is not None
        assert one.twin.eta_d == pytest.approx(one.measured.eta_d, rel=0.03)
        assert one.twin.impacts_right == one.measured.impacts_right


@pytest.mark.parametrize("late", [1, 50, 200])
def test_a_twin_that_wakes_within_a_held_cycle_says_nothing_about_it(
    setup: pipeline.Setup, measured: Block, late: int
) -> None:
    first = int(np.flatnonzero((measured.step == 1) & (measured.cycle == 1))[0])
    items = said(setup, recut([measured.cut(first + late, measured.end)], 64))
    assert [(one.step, one.cycle) for one in of(items, Cycle)][:2] == [(1, 2), (1, 3)]
    assert [one.step for one in of(items, Point)] == [1, 2, 3]


def test_a_twin_that_wakes_within_the_measured_cycles_makes_no_point_of_them(
    setup: pipeline.Setup, measured: Block
) -> None:
    first = int(np.flatnonzero((measured.step == 1) & (measured.cycle == 3))[0])
    items = said(setup, recut([measured.cut(first + 5, measured.end)], 64))
    assert next((one.step, one.cycle) for one in of(items, Cycle)) == (1, 4)
    assert [one.step for one in of(items, Point)] == [2, 3]


def test_missing_samples_leave_no_cycle_and_no_point_across_them(
    setup: pipeline.Setup, measured: Block
) -> None:
    first = int(np.flatnonzero((measured.step == 1) & (measured.cycle == 3))[0])
    pieces = [measured.cut(0, first + 50), measured.cut(first + 60, measured.end)]
    items = said(setup, pieces)
    assert (1, 3) not in {(one.step, one.cycle) for one in of(items, Cycle)}
    assert [one.step for one in of(items, Point)] == [0, 2, 3]


@pytest.mark.parametrize("into", [30, 150, 250])
def test_a_stop_in_a_cycle_leaves_no_partial_cycle(
    bundle: Bundle, setup: pipeline.Setup, measured: Block, into: int
) -> None:
    asked = int(np.flatnonzero((measured.step == 0) & (measured.cycle == 2))[0]) + into
    stopped = table(bundle, stop_at=asked)
    assert (stopped.label == Label.STOP).any()
    items = said(setup, recut([stopped], 20))
    assert not of(items, Point)
    for one in of(items, Cycle):
        assert one.count >= 1000.0 / 3.0 - 1
        assert not (stopped.label[one.index - one.count : one.index] == Label.STOP).any()
    assert {one.cycle for one in of(items, Cycle)} <= {0, 1, 2}


def test_contact_at_the_start_of_a_held_cycle_is_no_impact_by_itself(
    setup: pipeline.Setup, measured: Block
) -> None:
    """Permanent contact, as of a precompressed bumper, is never an onset."""
    values = measured.values.copy()
    values[measured.channels.index("force_r1_n")] = 400.0
    items = said(setup, [replace(measured, values=values)])
    assert not any(one.measured.onsets_r for one in of(items, Cycle))


def test_lost_load_cells_and_accelerometer_leave_the_displacement(
    setup: pipeline.Setup, measured: Block
) -> None:
    lost = ("mass_acc_m_s2", "force_l1_n", "force_l2_n")
    kept = [place for place, name in enumerate(measured.channels) if name not in lost]
    names = tuple(measured.channels[place] for place in kept)
    items = said(setup, [replace(measured, channels=names, values=measured.values[kept])])
    whole = of(said(setup, [measured]), Point)
    for got, want in zip(of(items, Point), whole, strict=True):
        assert got.twin is None  # it never had a state to start from
        assert got.measured.eta_d == want.measured.eta_d
        assert got.measured.r_r == want.measured.r_r
        assert np.isnan([got.measured.eta_a, got.measured.r_l]).all()


def test_a_leap_is_an_event(setup: pipeline.Setup, measured: Block) -> None:
    events = of(said(setup, [measured]), Event)
    assert {one.kind for one in events} == {"jump"}
    assert "forward: the jump down between 3 and 4.6 Hz came" in events[0].text


# Steps that are decided on while the test runs


@pytest.fixture(scope="module")
def decided(bundle: Bundle) -> list[Decided]:
    """The test's steps but the first, as if a tool had decided on them."""
    return [
        Decided(0, one.index, one.direction, one.frequency_hz, one.acceleration_m_s2, "because")
        for one in bundle.steps[1:]
    ]


@pytest.fixture(scope="module")
def first_only(bundle: Bundle) -> pipeline.Setup:
    return pipeline.prepare(bundle.profile, bundle.model, bundle.steps[:1])


def but_events(items: Sequence[Item]) -> list[tuple[type, bytes]]:
    """Without what is said of jumps."""
    return records([one for one in items if not isinstance(one, (Event, Ahead))])


def test_a_decided_step_has_its_cycles_and_its_point_but_no_leap(
    setup: pipeline.Setup, first_only: pipeline.Setup, measured: Block, decided: list[Decided]
) -> None:
    """Visits come at odd frequencies, on either branch: what differs there is no jump."""
    whole = said(setup, [measured])
    items = said(pipeline.knowing(first_only, *decided), [measured])
    assert but_events(items) == but_events(whole)
    assert of(whole, Event)
    assert not of(items, Event)


def test_it_does_not_matter_when_and_how_often_a_step_is_told_of(
    first_only: pipeline.Setup, measured: Block, decided: list[Decided]
) -> None:
    at_once = said(pipeline.knowing(first_only, *decided), recut([measured], 250))
    one_by_one, setup = [], first_only
    state, _ = pipeline.start(setup)
    begins = {one.step: int(np.flatnonzero(measured.step == one.step)[0]) for one in decided}
    for block in recut([measured], 250):
        for one in decided:
            if begins[one.step] < block.end + 250:
                setup = pipeline.knowing(setup, one)
        state, made = pipeline.step(setup, state, block)
        one_by_one.extend(made)
    assert len(setup.decided) == len(decided)
    assert records(one_by_one) == records(at_once)


def test_a_step_that_nobody_told_of_is_passed_over(
    setup: pipeline.Setup, first_only: pipeline.Setup, measured: Block
) -> None:
    items = said(first_only, [measured])
    assert {one.step for one in (*of(items, Cycle), *of(items, Point))} == {0}
    assert predicted(items).identical(predicted(said(setup, [measured])))
