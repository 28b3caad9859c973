"""Condition monitoring of a running test: warnings derived from its samples alone.

Pure, at sample indices, independent of the division into blocks, so that a replay gives the same
warnings. It warns; it never trips a table.
"""

from dataclasses import dataclass, field, replace

from table_io.block import Block
from table_io.records import PrcPoint, Record
from twin.compare.monitoring import jumps
from twin.compare.monitoring.agreement import AgreementState, check_agreement
from twin.compare.monitoring.attractor_change import AttractorState, detect_attractor_change
from twin.compare.monitoring.cycle import ChannelNoise, CycleData, MonitoringSetup
from twin.compare.monitoring.jumps import ExpectedJump, JumpTracking
from twin.compare.monitoring.parameter_drift import DriftState, update_estimate
from twin.compare.monitoring.sensor_consistency import ConsistencyState, check_consistency

# Kinds of its Events. A "jump" came with that of the twin; all others are warnings.
EVENT_KINDS = (
    "jump", "unexpected jump", "no jump", "disagreement", "drift", "attractor", "instrument",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class MonitoringState:
    """State carried from cycle to cycle."""

    noise: ChannelNoise = field(default_factory=ChannelNoise)
    agreement: AgreementState = field(default_factory=AgreementState)
    drift: DriftState = field(default_factory=DriftState)
    attractor: AttractorState = field(default_factory=AttractorState)
    consistency: ConsistencyState = field(default_factory=ConsistencyState)
    jump_tracking: JumpTracking = field(default_factory=JumpTracking)


def start_monitoring(expected_jumps: tuple[ExpectedJump, ...]) -> MonitoringState:
    """Return the state before the first sample, with the jumps that the twin will show."""
    return MonitoringState(jump_tracking=JumpTracking(expected_jumps))


def update_noise(state: MonitoringState, block: Block) -> MonitoringState:
    """Update the sensor noise with a block; only its samples at rest count."""
    return replace(state, noise=state.noise.add_block(block))


def monitor_cycle(
    setup: MonitoringSetup, state: MonitoringState, cycle: CycleData
) -> tuple[MonitoringState, list[Record]]:
    """Update the state with a held cycle; return it with the new records."""
    consistency, consistency_events = check_consistency(
        setup, state.consistency, state.noise, cycle
    )
    agreement_state, agreement_records = check_agreement(
        setup, state.agreement, state.noise, cycle, is_input_right=consistency.is_settled
    )
    drift, estimates = state.drift, list[Record]()
    if consistency.is_settled:
        drift, estimates = update_estimate(
            setup,
            state.drift,
            state.noise,
            cycle,
            trusted=not agreement_state.ever_reported,
            doubt=consistency.any,
        )
    attractor, attractor_events = detect_attractor_change(state.attractor, cycle)
    after = replace(
        state, agreement=agreement_state, drift=drift, attractor=attractor, consistency=consistency
    )
    return after, [*agreement_records, *estimates, *attractor_events, *consistency_events]


def monitor_step(
    state: MonitoringState, point: PrcPoint, u_star_m: float
) -> tuple[MonitoringState, list[Record]]:
    """Update the state with a planned step of the sweep; return it with the new records."""
    is_apart = jumps.measure_separation(point, state.noise, u_star_m) > 1
    tracking, items = jumps.track_jumps(state.jump_tracking, point, is_apart)
    return replace(state, jump_tracking=tracking), items
