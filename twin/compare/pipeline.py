"""`step(setup, state, block) -> state, items`: everything that the twin says about a block.

Pure: the same samples give the same items to the bit, however they are cut into blocks. Live,
replay and `--speed max` call this same function.
"""

from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from table_io.block import Block, Float1D, Label, join
from table_io.channels import contact_forces, rel_disp
from table_io.profile import Profile
from table_io.records import Cycle, Decided, Params, Record, Step
from twin.compare import watch
from twin.compare.cycles import UNKNOWN, Motion, Scale, Touching, extremes, point
from twin.compare.sensors import corrected
from twin.compare.watch import Watch
from twin.compare.watch.held import Held, WatchSetup
from twin.compare.watch.jumps import Foreseen, foreseen
from twin.compare.windows import Tracks, TwinSetup, begin, follow
from twin.model.model import Model
from twin.model.parameters import resonance

Piece = tuple[Block, Block]  # the same samples measured and predicted
SHORT = 3  # samples by which a held cycle may miss its length and still be whole


@dataclass(frozen=True, slots=True)
class Setup:
    """All that a twin needs to know of a run: the planned steps, and those decided on so far.

    Only planned steps make the curves; the others are visits, at odd frequencies and repeated.
    """

    twin: TwinSetup
    scale: Scale
    steps: tuple[Step, ...]
    measured_cycles: int
    foreseen: Foreseen = field(default_factory=Foreseen)
    decided: tuple[Step, ...] = ()

    @property
    def watched(self) -> WatchSetup:
        """What the watch is told."""
        twin = self.twin
        return WatchSetup(twin.model, twin.rate_hz, twin.contact_n, self.scale.gaps_m)

    def step(self, index: int) -> Step | None:
        """The step of this index; None where nobody told of it."""
        if 0 <= index < len(self.steps):
            return self.steps[index]
        return next((one for one in self.decided if one.index == index), None)


@dataclass(frozen=True, slots=True)
class State:
    """Before sample `tracks.index`. `held` are the pieces of the unfinished held cycle.

    Pieces are (measured, predicted); the first one holds what leads up to the cycle too.
    """

    tracks: Tracks
    key: tuple[int, int] | None = None  # (step, cycle) of the last sample seen; None = unknown
    recent: Piece | None = None  # the last samples seen, as many as lead up to a cycle
    first: int = 0  # sample at which the held cycle began
    held: tuple[Piece, ...] = ()
    cycles: tuple[Cycle, ...] = ()  # of the step under way
    base_acc: tuple[Float1D, ...] = ()  # of its measured cycles
    touching: tuple[Touching, Touching] = (UNKNOWN, UNKNOWN)  # measured, twin
    watch: Watch = field(default_factory=Watch)


def prepare(
    profile: Profile, model: Model, steps: tuple[Step, ...], from_rest: bool = False
) -> Setup:
    """The setup of a run. u* and a* are the free-flight maxima, continuous in frequency, of the
    model's linear part: one scale, whatever the effects on top of it."""
    rate = profile.acquisition.rate_hz
    level = max(step.acceleration_m_s2 for step in steps)
    u_star, a_star, _ = resonance(model.parameters, level)
    contact_n = profile.comparison.contact_n
    twin = TwinSetup(
        model,
        rate,
        round(profile.comparison.window_s * rate),
        profile.acquisition.block_samples,
        contact_n,
        from_rest,
    )
    scale = Scale(model.parameters, rate, contact_n, u_star, a_star, profile.specimen.gaps_m)
    known = foreseen(profile, model, steps)
    return Setup(twin, scale, steps, profile.sweep.measured_cycles, known)


def knowing(setup: Setup, *decided: Decided) -> Setup:
    """The setup with steps that were decided on; to be told of each before its first sample.

    More than is known at a time changes nothing, nor does telling twice.
    """
    for one in decided:
        if setup.step(one.step) is None:
            step = Step(one.step, one.direction, one.frequency_hz, one.acceleration_m_s2)
            setup = replace(setup, decided=(*setup.decided, step))
    return setup


def adopting(setup: Setup, params: Params) -> Setup:
    """The setup whose model has these values from now on; u* and a* stay those of the run."""
    model = Model.from_flat(params.values)
    scale = replace(setup.scale, parameters=model.parameters)
    return replace(setup, twin=replace(setup.twin, model=model), scale=scale)


def start(setup: Setup, index: int = 0) -> tuple[State, list[Record]]:
    """The state of a twin that starts at sample `index`, and the parameters it starts with."""
    params = Params(index, setup.twin.model.flat(), "start")
    return State(begin(setup.twin, index), watch=watch.begin(setup.foreseen)), [params]


def step(setup: Setup, state: State, block: Block) -> tuple[State, list[Block | Record]]:
    """State after the block; predicted Block, Comparisons, Cycles, Points, Events it completes."""
    if block.index != state.tracks.index:
        state = State(begin(setup.twin, block.index), watch=state.watch)
    tracks, predicted, comparisons = follow(setup.twin, state.tracks, block)
    items: list[Block | Record] = [predicted, *comparisons]
    state = replace(state, tracks=tracks)
    known = _joined(state.recent, (block, predicted))
    changes = np.flatnonzero(np.diff(block.step) | np.diff(block.cycle)) + 1
    edges = [0, *changes.tolist(), len(block)]
    for first, last in pairwise(edges):
        key = (int(block.step[first]), int(block.cycle[first]))
        if key != state.key:
            state, made = _finish(setup, state, key)
            items.extend(made)
        at, end = block.index + first, block.index + last
        if not state.watch.noise.known:
            state = replace(state, watch=watch.rested(state.watch, block.cut(at, end)))
        if key[1] >= 0 and state.held:
            state = replace(state, held=(*state.held, _cut(known, at, end)))
        elif key[1] >= 0 and _begins(state, key):
            state = replace(state, first=at, held=(_cut(known, at - setup.scale.lead, end),))
        state = replace(state, key=key)
    return replace(state, recent=_cut(known, block.end - setup.scale.lead, block.end)), items


def _joined(before: Piece | None, new: Piece) -> Piece:
    return new if before is None else (join([before[0], new[0]]), join([before[1], new[1]]))


def _cut(piece: Piece, first: int, end: int) -> Piece:
    """The samples first .. end - 1 of a piece, as far as it has them."""
    first = max(first, piece[0].index)
    return piece[0].cut(first, end), piece[1].cut(first, end)


def _begins(state: State, key: tuple[int, int]) -> bool:
    """True at the true first sample of a held cycle, not where the twin woke up inside it."""
    return state.key is not None and state.key != key


def _finish(setup: Setup, state: State, key: tuple[int, int]) -> tuple[State, list[Block | Record]]:
    """Close the cycle that ended, and the step with it if another step or no cycle follows."""
    items: list[Block | Record] = []
    if state.held and state.key is not None:
        state, cycle = _cycle(setup, state, *state.key)
        items.extend(cycle)
    if state.key is not None and state.cycles and (key[1] < 0 or key[0] != state.key[0]):
        state, made = _point(setup, state)
        items.extend(made)
    return state, items


def _motions(measured: Block, predicted: Block) -> tuple[Motion, Motion]:
    """(measured, free twin) motion over a cycle and what leads up to it."""
    right, left = contact_forces(measured)
    has_acc = "mass_acc_m_s2" in measured.channels
    return Motion(
        rel_disp(measured),
        measured.channel("mass_acc_m_s2") if has_acc else np.full(len(measured), np.nan),
        right,
        -left,
    ), Motion(
        predicted.channel("free/rel_disp_m"),
        predicted.channel("free/mass_acc_m_s2"),
        2 * predicted.channel("free/force_r1_n"),
        2 * predicted.channel("free/force_l1_n"),
    )


def _cycle(setup: Setup, state: State, step: int, number: int) -> tuple[State, list[Record]]:
    """The finished cycle, unless it was cut short by a stop or belongs to a step unheard of."""
    first, end = state.first, state.held[-1][0].end
    held, state = state.held, replace(state, held=())
    known = setup.step(step)
    if known is None or end - first < setup.twin.rate_hz / known.frequency_hz - SHORT:
        return state, []
    measured, predicted = (join(blocks) for blocks in zip(*held, strict=True))
    motion_m, motion_t = _motions(measured, predicted)
    lead = first - measured.index
    from_measured, touch_m = extremes(motion_m, first, setup.scale, state.touching[0], lead)
    from_twin, touch_t = extremes(motion_t, first, setup.scale, state.touching[1], lead)
    label = int(measured.label[lead])
    cycle = Cycle(end, step, number, label, end - first, from_measured, from_twin)
    base_acc = state.base_acc
    if label == Label.MEASURE:
        base_acc = (*base_acc, measured.channel("table_acc_m_s2")[lead:])
    whole = measured.cut(first, end)
    true = corrected(setup.twin.model.sensors, whole)
    one = Held(known, number, whole, true, predicted.cut(first, end))
    watching, said = watch.looked(setup.watched, state.watch, one)
    return replace(
        state,
        cycles=(*state.cycles, cycle),
        base_acc=base_acc,
        touching=(touch_m, touch_t),
        watch=watching,
    ), [cycle, *said]


def _point(setup: Setup, state: State) -> tuple[State, list[Record]]:
    """The step's PRC point, where all its measured cycles were seen, and what it says of jumps."""
    items: list[Record] = []
    watching = state.watch
    seen = sum(cycle.label == Label.MEASURE for cycle in state.cycles)
    step = setup.step(state.cycles[-1].step)
    if step is not None and seen == setup.measured_cycles:
        base_acc = np.concatenate(state.base_acc)
        made = point(step, list(state.cycles), base_acc, setup.scale)
        items.append(made)
        if step not in setup.decided:
            watching, said = watch.passed(watching, made)
            items.extend(said)
    # The contact state is not followed through the blend to the next step.
    return replace(
        state, cycles=(), base_acc=(), touching=(UNKNOWN, UNKNOWN), watch=watching
    ), items
