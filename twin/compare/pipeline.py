"""Twin pipeline: `step(setup, state, block) -> state, items` derives all records of a block.

Pure: the same samples give bit-identical items for any division into blocks. Live, replay and
`--speed max` call this same function.
"""

from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from table_io.block import Block, Float1D, Float2D, Label, join_blocks
from table_io.channels import Channel, contact_forces, relative_displacement
from table_io.config.profile import Profile
from table_io.records import Comparison, CycleExtremes, Event, Params, Record, Step, StepAdded
from twin.compare import TWIN_CHANNELS, monitoring
from twin.compare.cycles import (
    UNKNOWN_CONTACT,
    ContactState,
    CycleMotion,
    OnsetDepths,
    PrcScale,
    build_prc_point,
    cycle_extremes,
    extract_onset_depths,
)
from twin.compare.extra_channels import select_predicted
from twin.compare.monitoring import MonitoringState
from twin.compare.monitoring.cycle import CycleData, MonitoringSetup
from twin.compare.monitoring.jumps import ExpectedJump, predict_jumps
from twin.compare.monitoring.low_cut import LowCutRemoval
from twin.compare.prediction_hash import hash_cells
from twin.compare.sensors import remove_sensor_errors
from twin.compare.twins import TwinSetup, TwinStates, advance_twins, start_twins
from twin.model import valid_range
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.model.valid_range import RangeKey, find_range_exits, list_ranges

CycleBlocks = tuple[Block, ...]  # the same samples measured, predicted, and without low cuts
FAILURE_KIND = "twin_failed"  # a prediction that is not finite, on finite input
EVENT_KINDS = (*monitoring.EVENT_KINDS, valid_range.EVENT_KIND, FAILURE_KIND)  # of the pipeline
TWIN_TITLES = {"free": "the free-running twin", "window": "the restarted twin"}
MAX_MISSING_SAMPLES = 3  # samples that a whole held cycle may lack


@dataclass(frozen=True, slots=True)
class PipelineSetup:
    """Setup of a twin for one run, with the planned steps and those added so far.

    Only planned steps enter the curves; added ones lie between grid frequencies and may repeat.
    """

    twin: TwinSetup
    scale: PrcScale
    steps: tuple[Step, ...]
    measured_cycles: int
    expected_jumps: tuple[ExpectedJump, ...] = ()
    added_steps: tuple[Step, ...] = ()

    @property
    def monitoring_setup(self) -> MonitoringSetup:
        """Setup of the monitoring."""
        twin = self.twin
        return MonitoringSetup(twin.model, twin.rate_hz, twin.contact_n, self.scale.gaps_m)

    def find_step(self, index: int) -> Step | None:
        """Return the step with this index; None if it is unknown."""
        if 0 <= index < len(self.steps):
            return self.steps[index]
        return next((step for step in self.added_steps if step.index == index), None)


@dataclass(frozen=True, slots=True)
class PipelineState:
    """State before sample `twins.index`; `cycle_blocks` are pieces of the unfinished held cycle.

    The first piece includes the lead samples of the cycle.
    """

    twins: TwinStates
    cycle_key: tuple[int, int] | None = None  # (step, cycle) of the last sample; None = unknown
    recent: CycleBlocks | None = None  # the last samples, as many as a cycle's lead
    cycle_start: int = 0  # sample at which the held cycle began
    cycle_blocks: tuple[CycleBlocks, ...] = ()
    cycles: tuple[CycleExtremes, ...] = ()  # of the current step
    base_acc: tuple[Float1D, ...] = ()  # of its measured cycles
    u_m: tuple[Float1D, ...] = ()  # the same, measured
    onsets: tuple[OnsetDepths, ...] = ()  # of its held cycles, measured
    contact: tuple[ContactState, ContactState] = (
        UNKNOWN_CONTACT,
        UNKNOWN_CONTACT,
    )  # measured, twin
    monitoring: MonitoringState = field(default_factory=MonitoringState)
    low_cuts: LowCutRemoval = field(default_factory=LowCutRemoval)
    range_exits: frozenset[RangeKey] = frozenset()  # reported so far
    unhashed: Float2D = field(default_factory=lambda: np.empty((len(TWIN_CHANNELS), 0)))


def prepare_twins(
    profile: Profile, model: Model, from_rest: bool = False, extra_channels: Iterable[Channel] = ()
) -> TwinSetup:
    """Prepare the setup of the twins; of the extra channels the predicted ones are compared."""
    rate_hz = profile.acquisition.rate_hz
    return TwinSetup(
        model,
        rate_hz,
        round(profile.comparison.window_s * rate_hz),
        profile.acquisition.block_samples,
        profile.comparison.contact_n,
        from_rest,
        select_predicted(extra_channels),
    )


def prepare_pipeline(
    profile: Profile,
    model: Model,
    steps: tuple[Step, ...],
    from_rest: bool = False,
    extra_channels: Iterable[Channel] = (),
) -> PipelineSetup:
    """Prepare the setup of a run, of its twins as `prepare_twins` does.

    u* and a* are the free-flight maxima, continuous in frequency, of the model's linear part: one
    scale, independent of its effects.
    """
    level = max((step.acceleration_m_s2 for step in steps), default=profile.plan.level_m_s2)
    u_star, a_star, _ = free_flight_resonance(model.parameters, level)
    twin = prepare_twins(profile, model, from_rest, extra_channels)
    scale = PrcScale(
        model.parameters, twin.rate_hz, twin.contact_n, u_star, a_star, profile.specimen.gaps_m
    )
    if not steps or profile.continuation is not None:  # no numbered cycles, no curves
        return PipelineSetup(twin, scale, steps, measured_cycles=0)
    expected_jumps = predict_jumps(profile, model, steps)
    return PipelineSetup(twin, scale, steps, profile.sweep.measured_cycles, expected_jumps)


def add_steps(setup: PipelineSetup, *decisions: StepAdded) -> PipelineSetup:
    """Return the setup with added steps; call it before the first sample of each.

    Adding a step earlier, or twice, changes no result.
    """
    for decision in decisions:
        if setup.find_step(decision.step) is None:
            step = Step(
                decision.step, decision.direction, decision.frequency_hz, decision.acceleration_m_s2
            )
            setup = replace(setup, added_steps=(*setup.added_steps, step))
    return setup


def adopt_params(setup: PipelineSetup, params: Params) -> PipelineSetup:
    """Return the setup with a model of these values; u* and a* stay those of the run."""
    model = setup.twin.model.with_flat(params.values)
    scale = replace(setup.scale, parameters=model.parameters)
    return replace(setup, twin=replace(setup.twin, model=model), scale=scale)


def start_pipeline(setup: PipelineSetup, index: int = 0) -> tuple[PipelineState, list[Record]]:
    """Return the state of a twin that starts at sample `index`, and its initial parameters."""
    params = Params(index, setup.twin.model.flatten(), "start")
    return PipelineState(
        start_twins(setup.twin, index),
        monitoring=monitoring.start_monitoring(setup.expected_jumps),
    ), [params]


def step(
    setup: PipelineSetup, state: PipelineState, block: Block
) -> tuple[PipelineState, list[Block | Record]]:
    """Return the state after a block, and the predicted Block with the records it completes.

    Records: Comparison, PredictionHash, CycleExtremes, PrcPoint and those of the monitoring.
    """
    known_failures = state.twins.failures
    if block.index != state.twins.index:
        twins = replace(start_twins(setup.twin, block.index), failures=known_failures)
        state = PipelineState(
            twins,
            monitoring=state.monitoring,
            low_cuts=state.low_cuts,
            range_exits=state.range_exits,
        )
    pieces: list[Block] = []
    compared: list[Comparison] = []
    records: list[Block | Record] = []
    changes = np.flatnonzero(np.diff(block.step) | np.diff(block.cycle)) + 1
    edges = [0, *changes.tolist(), len(block)]
    for first, last in pairwise(edges):
        piece = block.cut(block.index + first, block.index + last)
        cycle_key = (int(block.step[first]), int(block.cycle[first]))
        if cycle_key != state.cycle_key:
            state, items = _finish_cycle(setup, state, cycle_key)
            records.extend(items)
        state, predicted, comparisons = _advance_piece(setup, state, piece, cycle_key)
        pieces.append(predicted)
        compared.extend(comparisons)
    predicted = join_blocks(pieces)
    state, events = _watch_ranges(setup, state, block, predicted)
    events += _list_failures(setup, state, known_failures)
    unhashed, hashes = hash_cells(
        state.unhashed, block.end, predicted.values, setup.twin.hash_samples, state.twins.saved
    )
    state = replace(state, unhashed=unhashed, twins=replace(state.twins, saved={}))
    return state, [predicted, *compared, *hashes, *records, *events]


def _list_failures(
    setup: PipelineSetup, state: PipelineState, known: Container[str]
) -> list[Record]:
    """Return an event for each twin that has failed and is not among the known."""
    return [
        Event(
            sample,
            FAILURE_KIND,
            f"{TWIN_TITLES[name]} failed from sample {sample} ({sample / setup.twin.rate_hz:.3f} "
            "s): its prediction is not finite",
        )
        for name, sample in state.twins.failures.items()
        if name not in known
    ]


def _watch_ranges(
    setup: PipelineSetup, state: PipelineState, block: Block, predicted: Block
) -> tuple[PipelineState, list[Record]]:
    """Return the state and an event for each law that the free twin takes out of its range."""
    model = setup.twin.model
    if not list_ranges(model):
        return state, []
    motion = {
        "u": predicted.channel("free/rel_disp_m"),
        "v": predicted.channel("free/rel_vel_m_s"),
        "t": np.arange(block.index, block.end) / setup.twin.rate_hz,
    }
    measured = {"a": "table_acc_m_s2", "y": "table_disp_m"}
    motion |= {
        variable: block.channel(name)
        for variable, name in measured.items()
        if name in block.channels
    }
    exits = [*find_range_exits(model, motion, state.range_exits)]
    reported = state.range_exits | {range_exit.key for range_exit in exits}
    return replace(state, range_exits=reported), [
        Event(block.index + range_exit.sample, valid_range.EVENT_KIND, str(range_exit))
        for range_exit in exits
    ]


def _advance_piece(
    setup: PipelineSetup, state: PipelineState, piece: Block, cycle_key: tuple[int, int]
) -> tuple[PipelineState, Block, list[Comparison]]:
    """Advance the twins over samples of one cycle: return (state, predicted, Comparisons)."""
    low_cuts, corrected = state.low_cuts.apply(piece)
    twins, predicted, comparisons = advance_twins(setup.twin, state.twins, corrected)
    if state.low_cuts.is_active:  # then the solvers' states are not all that is needed
        twins = replace(twins, saved=state.twins.saved)
    blocks = (piece, predicted, corrected)
    available = [blocks] if state.recent is None else [state.recent, blocks]
    start, end, lead = piece.index, piece.end, setup.scale.lead_samples
    monitoring_state = state.monitoring
    if not monitoring_state.noise.is_known:
        monitoring_state = monitoring.update_noise(monitoring_state, piece)
    cycle_start, cycle_blocks = state.cycle_start, state.cycle_blocks
    if cycle_key[1] >= 0 and cycle_blocks:
        cycle_blocks = (*cycle_blocks, blocks)
    elif cycle_key[1] >= 0 and _is_cycle_start(state, cycle_key):
        cycle_start, cycle_blocks = start, (_cut_pieces(available, start - lead, end),)
    return (
        replace(
            state,
            twins=twins,
            low_cuts=low_cuts,
            monitoring=monitoring_state,
            cycle_start=cycle_start,
            cycle_blocks=cycle_blocks,
            cycle_key=cycle_key,
            recent=_cut_pieces(available, end - lead, end),
        ),
        predicted,
        comparisons,
    )


def _join_pieces(pieces: Iterable[CycleBlocks]) -> CycleBlocks:
    """Return consecutive pieces joined."""
    return tuple(join_blocks(list(blocks)) for blocks in zip(*pieces, strict=True))


def _cut_pieces(pieces: Sequence[CycleBlocks], first: int, end: int) -> CycleBlocks:
    """Return the samples first .. end - 1 of consecutive pieces, as far as they have them."""
    *earlier, last = pieces
    used = [*(piece for piece in earlier if piece[0].end > first), last]
    return _join_pieces(
        tuple(block.cut(max(first, block.index), min(end, block.end)) for block in piece)
        for piece in used
    )


def _is_cycle_start(state: PipelineState, cycle_key: tuple[int, int]) -> bool:
    """Return whether a held cycle begins here, rather than the twin starting inside it."""
    return state.cycle_key is not None and state.cycle_key != cycle_key


def _finish_cycle(
    setup: PipelineSetup, state: PipelineState, cycle_key: tuple[int, int]
) -> tuple[PipelineState, list[Block | Record]]:
    """Close the cycle that ended, and the step with it if another step or no cycle follows."""
    items: list[Block | Record] = []
    if state.cycle_blocks and state.cycle_key is not None:
        state, cycle = _evaluate_cycle(setup, state, *state.cycle_key)
        items.extend(cycle)
    if (
        state.cycle_key is not None
        and state.cycles
        and (cycle_key[1] < 0 or cycle_key[0] != state.cycle_key[0])
    ):
        state, records = _evaluate_step(setup, state)
        items.extend(records)
    return state, items


def _cycle_motions(measured: Block, predicted: Block) -> tuple[CycleMotion, CycleMotion]:
    """Return (measured, free twin) motion over a cycle and its lead samples."""
    right, left = contact_forces(measured)
    has_acc = "mass_acc_m_s2" in measured.channels
    return CycleMotion(
        relative_displacement(measured),
        measured.channel("mass_acc_m_s2") if has_acc else np.full(len(measured), np.nan),
        right,
        -left,
    ), CycleMotion(
        predicted.channel("free/rel_disp_m"),
        predicted.channel("free/mass_acc_m_s2"),
        2 * predicted.channel("free/force_r1_n"),
        2 * predicted.channel("free/force_l1_n"),
    )


def _evaluate_cycle(
    setup: PipelineSetup, state: PipelineState, step: int, number: int
) -> tuple[PipelineState, list[Record]]:
    """Evaluate the finished cycle, unless a stop cut it short or its step is unknown."""
    first, end = state.cycle_start, state.cycle_blocks[-1][0].end
    cycle_blocks, state = state.cycle_blocks, replace(state, cycle_blocks=())
    planned_step = setup.find_step(step)
    if (
        planned_step is None
        or end - first < setup.twin.rate_hz / planned_step.frequency_hz - MAX_MISSING_SAMPLES
    ):
        return state, []
    measured, predicted, no_low_cuts = _join_pieces(cycle_blocks)
    measured_motion, twin_motion = _cycle_motions(measured, predicted)
    lead = first - measured.index
    measured_extremes, measured_contact = cycle_extremes(
        measured_motion, first, setup.scale, state.contact[0], lead
    )
    twin_extremes, twin_contact = cycle_extremes(
        twin_motion, first, setup.scale, state.contact[1], lead
    )
    label = int(measured.label[lead])
    cycle = CycleExtremes(end, step, number, label, end - first, measured_extremes, twin_extremes)
    base_acc, u_m = state.base_acc, state.u_m
    if label == Label.MEASURE:
        base_acc = (*base_acc, measured.channel("table_acc_m_s2")[lead:])
        u_m = (*u_m, measured_motion.u[lead:])
    recorded, cycle_block = measured.cut(first, end), no_low_cuts.cut(first, end)
    sensors = setup.twin.model.sensors
    cycle_data = CycleData(
        planned_step,
        number,
        cycle_block,
        remove_sensor_errors(sensors, cycle_block),
        predicted.cut(first, end),
        remove_sensor_errors(sensors, recorded),
    )
    monitoring_state, events = monitoring.monitor_cycle(
        setup.monitoring_setup, state.monitoring, cycle_data
    )
    return replace(
        state,
        cycles=(*state.cycles, cycle),
        base_acc=base_acc,
        u_m=u_m,
        onsets=(
            *state.onsets,
            extract_onset_depths(measured_motion, measured_extremes, measured.index),
        ),
        contact=(measured_contact, twin_contact),
        monitoring=monitoring_state,
        low_cuts=state.low_cuts.settle(recorded, monitoring_state.consistency.low_cuts),
    ), [cycle, *events]


def _evaluate_step(
    setup: PipelineSetup, state: PipelineState
) -> tuple[PipelineState, list[Record]]:
    """Return the step's PRC point, if all measured cycles were seen, and jump events."""
    items: list[Record] = []
    monitoring_state = state.monitoring
    measured_cycles = sum(cycle.label == Label.MEASURE for cycle in state.cycles)
    step = setup.find_step(state.cycles[-1].step)
    if step is not None and measured_cycles == setup.measured_cycles:
        base_acc, u_m = np.concatenate(state.base_acc), np.concatenate(state.u_m)
        point = build_prc_point(step, list(state.cycles), base_acc, setup.scale, state.onsets, u_m)
        items.append(point)
        if step not in setup.added_steps:
            monitoring_state, events = monitoring.monitor_step(
                monitoring_state, point, setup.scale.u_star_m
            )
            items.extend(events)
    # The contact state is not tracked through the blend to the next step.
    return replace(
        state,
        cycles=(),
        base_acc=(),
        u_m=(),
        onsets=(),
        contact=(UNKNOWN_CONTACT, UNKNOWN_CONTACT),
        monitoring=monitoring_state,
    ), items
