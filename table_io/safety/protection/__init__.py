"""Two-rate protection: findings that stop the table and findings that raise an alarm.

Every sample (`sample_checks.py`): limits, lost and broken sensors, deviation of the command read
back and of the table from the queued command. Every half cycle, over the last whole cycle
(`confirmation.py`, `cycle_checks.py`): level, response, drift, and consistency of displacement,
acceleration and forces.

    state = start_protection(profile, rig, noise_from(tare_volts, rig.sensors))
    state, findings = inspect_samples(state, Observation.from_drive(block, clipped, drive))

A displacement history has no cycles: of it only the samples are checked.

Findings do not depend on how the samples are divided into blocks. A fault of a sensor that the
controller needs stops the table; for other sensors `protection.sensor` of the profile decides.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from table_io.block import Block, Bool2D, Float1D, Float2D, Label
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.control.order_tracking import evaluate_transfer
from table_io.excitation.drive import Drive
from table_io.records import FrequencyResponse
from table_io.safety.protection.confirmation import (
    FIRST_HOLD_KEY,
    CycleCheckState,
    SampleSpan,
    check_cycle,
)
from table_io.safety.protection.cycle import ProtectionContext
from table_io.safety.protection.findings import Finding, confirm_suspicion, to_finding
from table_io.safety.protection.sample_checks import (
    HALF_CYCLE,
    LOOP_CHECK_KEY,
    TABLE_GAIN,
    TABLE_LAG,
    check_samples,
)
from table_io.safety.protection.thresholds import (
    SampleCheckState,
    Thresholds,
    compute_thresholds,
    make_sample_state,
)

__all__ = [
    "Finding",
    "Observation",
    "ProtectionState",
    "inspect_samples",
    "sample_demand",
    "set_response",
    "start_protection",
]

MAX_FINDINGS = 256  # per call of `check_samples`
HISTORY_KEY = 0.5  # motion without cycles
HELD_LABELS = (Label.SETTLE, Label.MEASURE, Label.CHECK)
_LABEL_KEYS = np.array(
    [float(FIRST_HOLD_KEY if label in HELD_LABELS else label != Label.REST) for label in Label]
)


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """Consecutive samples: measured (SI, tared, NaN = lost) and demanded by the drive."""

    block: Block
    clipped: Bool2D  # (channel, sample): True at the sensor's range
    command_m: Float1D  # displacement, as queued
    phase: Float1D  # of the drive, in cycles
    level_m_s2: Float1D  # demanded peak acceleration, 0 in a history
    acceleration_m_s2: Float1D  # demanded, with its sign

    @classmethod
    def from_drive(cls, block: Block, clipped: Bool2D, drive: Drive) -> "Observation":
        """Make an observation from a block and the drive during it."""
        span = block.index, len(block)
        return cls(block, clipped, *sample_demand(drive, *span))


def sample_demand(drive: Drive, first: int, count: int) -> tuple[Float1D, ...]:
    """Return (command, phase, level, acceleration) that a drive demands of samples, (count,)."""
    quantities = drive.command, drive.phase, drive.level, drive.demanded_acceleration
    return tuple(quantity(first, count) for quantity in quantities)


@dataclass(frozen=True, slots=True, eq=False)
class ProtectionState:
    """State of the protection before sample `index`.

    `history` holds earlier samples: values (channel, sample), command and phase (sample,).
    `span_parts` holds those since the last mark.
    """

    context: ProtectionContext
    thresholds: Thresholds
    sample_state: SampleCheckState
    index: int
    history: tuple[Float2D, Float1D, Float1D]
    span_parts: tuple[tuple[Float2D, Float1D, Float1D], ...] = ()
    last_sample: tuple[float, int, int] = (0.0, 0, 0)  # level, label, key of the newest sample
    cycle_state: CycleCheckState = field(default_factory=CycleCheckState)


def start_protection(
    profile: Profile, rig: RigConfig, noise: Mapping[str, tuple[float, int]]
) -> ProtectionState:
    """Return the state before the first sample of a run.

    `noise`: (rms in SI, longest run of equal samples) at rest of the channels where it is known.
    """
    thresholds = compute_thresholds(profile, rig, noise)
    sigma = np.array([noise[name][0] if name in noise else 0.0 for name in rig.channels])
    channel_count = len(rig.channels)
    history = (
        np.full((channel_count, thresholds.history), np.nan),
        np.zeros(thresholds.history),
        np.zeros(thresholds.history),
    )
    state = ProtectionState(
        ProtectionContext(profile, rig, sigma, thresholds.spike_limit),
        thresholds,
        make_sample_state(channel_count),
        0,
        history,
    )
    _warm_up_kernel(state)
    return state


def _warm_up_kernel(state: ProtectionState) -> None:
    """Compile the kernel of the sample checks, so that the first block is not late."""
    flags, empty = np.zeros((state.history[0].shape[0], 0), dtype=np.bool_), np.zeros(0)
    findings = np.empty((MAX_FINDINGS, 5))
    values, *history = state.history
    check_samples(
        values, flags, *history, empty, empty, 0, 0, state.thresholds, state.sample_state, findings
    )


def set_response(state: ProtectionState, response: FrequencyResponse) -> ProtectionState:
    """Return the state with the response of the loop check as reference for the table."""
    plan = state.context.profile.plan
    frequency_hz = (
        plan.steps[0].frequency_hz if plan.steps else math.sqrt(plan.low_hz * plan.high_hz)
    )
    cycle_state = replace(state.cycle_state, response=response)
    return _update_table_response(
        state,
        cycle_state.update_table_response(evaluate_transfer(response, frequency_hz), frequency_hz),
    )


def inspect_samples(
    state: ProtectionState, observation: Observation
) -> tuple[ProtectionState, tuple[Finding, ...]]:
    """Check the next samples: return (state, findings); ValueError if samples are skipped."""
    block, history = observation.block, state.thresholds.history
    if block.index != state.index:
        raise ValueError(f"samples from {state.index} on are next, not from {block.index}")
    values = np.ascontiguousarray(np.concatenate([state.history[0], block.values], axis=1))
    command = np.concatenate([state.history[1], observation.command_m])
    phase = np.concatenate([state.history[2], observation.phase])
    clipped, demanded = (
        np.ascontiguousarray(observation.clipped),
        np.ascontiguousarray(observation.acceleration_m_s2),
    )
    keys = _motion_keys(block)
    sample_state = state.sample_state
    state = replace(
        state,
        sample_state=SampleCheckState(
            sample_state.channels.copy(), sample_state.scalars.copy(), sample_state.last_true.copy()
        ),
    )
    rows = np.empty((MAX_FINDINGS, 5))
    findings: list[Finding] = []
    offset = 0
    while offset < len(block):
        first = offset
        offset, mark, count = check_samples(
            values, clipped, command, phase, demanded, keys, block.index, offset,
            state.thresholds, state.sample_state, rows,
        )  # fmt: skip
        for index, code, row, value, limit in rows[:count].tolist():
            channel = state.context.rig.channel_by_name[block.channels[int(row)]]
            arguments = int(code), int(index), channel, value, limit
            findings.append(to_finding(*arguments, state.context.profile))
        if offset > first and keys[first] != HISTORY_KEY:
            span = slice(history + first, history + offset)
            part = values[:, span], command[span], phase[span]
            last_sample = (
                float(observation.level_m_s2[offset - 1]),
                int(block.label[offset - 1]),
                int(keys[offset - 1]),
            )
            state = replace(state, span_parts=(*state.span_parts, part), last_sample=last_sample)
        if mark:
            state, cycle_findings = _check_last_span(
                state, mark == HALF_CYCLE, block.index + offset
            )
            findings += cycle_findings
    tail = slice(len(block), None)
    kept_history = values[:, tail].copy(), command[tail].copy(), phase[tail].copy()
    return replace(state, index=block.end, history=kept_history), tuple(findings)


def _check_last_span(
    state: ProtectionState, is_half_cycle: bool, index: int
) -> tuple[ProtectionState, list[Finding]]:
    """Run the cycle checks on the span that ended before sample `index`: (state, findings)."""
    cycle_state, findings = state.cycle_state, []
    if state.span_parts:
        values = np.concatenate([part[0] for part in state.span_parts], axis=1)
        command, phase = (np.concatenate([part[k] for part in state.span_parts]) for k in (1, 2))
        span = SampleSpan(values, command, phase, *state.last_sample, is_half_cycle)
        cycle_state, suspicions = check_cycle(state.context, cycle_state, span)
        findings = [
            confirm_suspicion(suspicion, index, state.context.profile) for suspicion in suspicions
        ]
    return replace(_update_table_response(state, cycle_state), span_parts=()), findings


def _update_table_response(state: ProtectionState, cycle_state: CycleCheckState) -> ProtectionState:
    """Return the state with a new cycle state and its gain and lag of the table, if known."""
    scalars = state.sample_state.scalars.copy()
    if cycle_state.lag_s >= 0:
        scalars[TABLE_GAIN], scalars[TABLE_LAG] = cycle_state.gain, cycle_state.lag_s
    return replace(
        state, cycle_state=cycle_state, sample_state=state.sample_state._replace(scalars=scalars)
    )


def _motion_keys(block: Block) -> Float1D:
    """Return the key of each sample's motion, (sample,): 0 rest, 1 blend, 2 and up a held step.

    A history has the key HISTORY_KEY: it has no cycles, so there are no cycle checks. Motions
    before the first step have key -1: the loop check judges the sensors itself, so the protection
    must not stop it first.
    """
    keys = _LABEL_KEYS[block.label]
    keys = np.where(keys == FIRST_HOLD_KEY, FIRST_HOLD_KEY + block.step, keys)
    keys = np.where(block.is_history, HISTORY_KEY, keys)
    return np.where((block.step < 0) & (keys != 0), LOOP_CHECK_KEY, keys)
