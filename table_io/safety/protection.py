"""Two-rate protection: findings that stop the table and findings that raise an alarm.

Every sample (`sample_checks.py`): limits, lost and broken sensors, deviation of the command read
back and of the table from the queued command. Every half cycle, over the last whole cycle
(`cycle_checks.py`): level, response, drift, and consistency of displacement,
acceleration and forces.

    state = start_protection(profile, rig, noise_from(tare_volts, rig.sensors))
    state, findings = inspect_samples(state, Observation.from_drive(block, clipped, drive))

A displacement history has no cycles: of it only the samples are checked. The limits of the profile
on its channels are checked at every sample of every test.

Findings do not depend on how the samples are divided into blocks: the phase of the drive alone
selects the samples of a cycle check. A fault of a sensor that the
controller needs stops the table; for other sensors `protection.sensor` of the profile decides.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from table_io.block import Block, Bool2D, Float1D, Float2D, Label
from table_io.config.excitation import History, history_acceleration
from table_io.config.profile import NOTCH, Profile
from table_io.config.rig import RigConfig
from table_io.control.table_response import evaluate_transfer
from table_io.excitation.drive import Drive
from table_io.records import FrequencyResponse
from table_io.safety import cycle_checks
from table_io.safety.consistency import SENSOR_PAIRS
from table_io.safety.cycle_checks import (
    DriveCycle,
    ForceShare,
    PairBaseline,
    ProtectionContext,
    SwingAverage,
)
from table_io.safety.findings import Finding, Suspicion, confirm_suspicion, format_si, to_finding
from table_io.safety.sample_checks import (
    HALF_CYCLE,
    LOOP_CHECK_KEY,
    TABLE_GAIN,
    TABLE_LAG,
    SampleCheckState,
    Thresholds,
    check_samples,
    compute_thresholds,
    make_sample_state,
)
from table_io.sensor_errors import highpass
from table_io.units import GRAVITY_M_S2

FIRST_HOLD_KEY = 2  # keys from here on are motions of constant frequency and level
MIN_CYCLE_COUNT = 1.0 - 1e-3  # cycles that count as a whole one
# Of a table whose position is predicted sample by sample.
PLAUSIBLE_GAIN_RANGE = (0.5, 1.5)
MAX_LAG_S = 0.1
MAX_GAIN_STEP_RATIO = 0.1  # change of the gain between two checks up to which it is adopted


@dataclass(frozen=True, slots=True, eq=False)
class SampleSpan:
    """Samples between two marks: values (channel, sample), command and phase (sample,).

    `level` and `label` are those of the last sample. `key` identifies the motion (0 rest, -1 loop
    check). `is_half_cycle` is True if the span is half a cycle long. `filtered` holds the
    displacement of each sensor pair behind the low cut of its accelerometer, (sample,).
    """

    values: Float2D
    command: Float1D
    phase: Float1D
    level: float
    label: int
    key: int
    is_half_cycle: bool
    filtered: Mapping[str, Float1D] = field(default_factory=lambda: MappingProxyType({}))


def _empty_mapping() -> Mapping[Any, Any]:
    return MappingProxyType({})


@dataclass(frozen=True)
class CycleCheckState:
    """State of the cycle checks; `gain` and `lag_s` (NaN: unknown) are those of the table."""

    spans: tuple[SampleSpan, ...] = ()
    response: FrequencyResponse | None = None
    visited_responses: Mapping[float, complex] = field(default_factory=_empty_mapping)
    pair_baselines: Mapping[str, PairBaseline] = field(default_factory=_empty_mapping)
    force_shares: Mapping[str, ForceShare] = field(default_factory=_empty_mapping)
    streaks: Mapping[tuple[str, str, str], int] = field(default_factory=_empty_mapping)
    swing: SwingAverage = field(default_factory=SwingAverage)
    gain: float = 1.0
    lag_s: float = math.nan

    def update_table_response(self, table: complex, frequency_hz: float) -> "CycleCheckState":
        """Return the state with gain and lag of this table response, if it is plausible."""
        lag_s = cycle_checks.phase_lag_s(table, 2 * math.pi * frequency_hz)
        plausible = (
            PLAUSIBLE_GAIN_RANGE[0] < abs(table) < PLAUSIBLE_GAIN_RANGE[1]
            and 0.0 <= lag_s < MAX_LAG_S
        )
        if not plausible or (
            self.lag_s >= 0 and abs(abs(table) / self.gain - 1.0) > MAX_GAIN_STEP_RATIO
        ):
            return self
        return replace(self, gain=abs(table), lag_s=lag_s)


def check_cycle(
    context: ProtectionContext, state: CycleCheckState, span: SampleSpan
) -> tuple[CycleCheckState, tuple[Suspicion, ...]]:
    """Run the cycle checks after one more span: return (state, newly confirmed suspicions)."""
    if span.key <= 0:
        return replace(state, spans=(), streaks=_empty_mapping()), ()
    kept = [_filter_displacements(context, state, span)]
    for earlier in reversed(state.spans):
        if _count_cycles(kept) > MIN_CYCLE_COUNT:
            break
        kept.insert(0, earlier)
    state = replace(state, spans=tuple(kept))
    if _count_cycles(kept) < MIN_CYCLE_COUNT:
        return state, ()
    state, suspicions = _check_any_motion(state, _join_spans(context, kept), kept)
    last = kept[-2:]
    steady = span.key >= FIRST_HOLD_KEY and all(
        part.is_half_cycle and part.key == span.key for part in last
    )
    if len(last) == 2 and steady:
        cycle = _join_spans(context, last)
        if context.profile.swept_sine is not None:  # the level of a notch moves: that in the middle
            cycle = replace(cycle, level=last[0].level)
        state, steady_suspicions = _check_steady_motion(state, cycle)
        suspicions += steady_suspicions
    streaks = {suspicion.key: state.streaks.get(suspicion.key, 0) + 1 for suspicion in suspicions}
    confirmed = [
        suspicion for suspicion in suspicions if streaks[suspicion.key] == suspicion.required_checks
    ]
    return replace(state, streaks=MappingProxyType(streaks)), tuple(confirmed)


def _filter_displacements(
    context: ProtectionContext, state: CycleCheckState, span: SampleSpan
) -> SampleSpan:
    """Return the span with its filtered displacements, continued from the span before."""
    filtered = {}
    for names, acceleration in SENSOR_PAIRS:
        if not {*names, acceleration} <= {*context.rig.channels}:
            continue
        x = cycle_checks.sum_channels(context.rig, span.values, names)
        last = None
        if state.spans:
            before = cycle_checks.sum_channels(context.rig, state.spans[-1].values[:, -1:], names)
            last = float(before[0]), float(state.spans[-1].filtered[names[0]][-1])
        baseline = state.pair_baselines.get(names[0], PairBaseline())
        filtered[names[0]] = highpass(x, baseline.errors.low_cut, context.rate_hz, last)
    return replace(span, filtered=filtered)


def _check_any_motion(
    state: CycleCheckState, cycle: DriveCycle, spans: list[SampleSpan]
) -> tuple[CycleCheckState, list[Suspicion]]:
    """Run the checks that apply to any motion: consistency of sensors and load cells."""
    suspicions: list[Suspicion] = []
    baselines = dict(state.pair_baselines)
    for names, acceleration in SENSOR_PAIRS:
        if not cycle.has(*names, acceleration):
            continue
        baseline = baselines.get(names[0], PairBaseline())
        filtered = np.concatenate([span.filtered[names[0]] for span in spans])
        pair = cycle_checks.compare_sensor_pair(
            cycle, names, acceleration, filtered, baseline.errors.low_cut
        )
        mismatches = list(
            cycle_checks.check_sensor_pair(cycle, names, acceleration, pair, baseline)
        )
        if not mismatches:
            baselines[names[0]] = baseline.update(pair, cycle.omega)
        suspicions += mismatches
    cell_suspicions, shares = cycle_checks.check_cell_pairs(cycle, state.force_shares)
    return replace(
        state, pair_baselines=baselines, force_shares=shares
    ), suspicions + cell_suspicions


def _check_steady_motion(
    state: CycleCheckState, cycle: DriveCycle
) -> tuple[CycleCheckState, list[Suspicion]]:
    """Run the checks for constant frequency and level: level, command, drift, response."""
    if cycle.context.profile.swept_sine is not None and cycle.label == Label.MEASURE:
        return _check_swept_motion(state, cycle)
    swing = cycle_checks.update_swing(cycle, state.swing)
    state = replace(state, swing=swing)
    suspicions = [*cycle_checks.check_level(cycle), *cycle_checks.check_command_gain(cycle)]
    suspicions += [
        *cycle_checks.check_table_mean(cycle),
        *cycle_checks.check_mass_mean(cycle, swing),
    ]
    table_errors = state.pair_baselines.get("table_disp_m", PairBaseline()).errors
    transfers = cycle_checks.measure_transfer(cycle, table_errors.low_cut)
    frequency_hz = round(cycle.omega / (2 * math.pi), 3)
    reference = state.visited_responses.get(frequency_hz)
    if state.response is not None:
        reference = evaluate_transfer(state.response, frequency_hz)
    if reference is not None:
        suspicions += cycle_checks.check_response(cycle, transfers, reference)
    table = transfers[0]
    if not suspicions and math.isfinite(abs(table)):
        responses = (
            state.visited_responses
            if frequency_hz in state.visited_responses
            else {**state.visited_responses, frequency_hz: table}
        )
        state = replace(state, visited_responses=responses)
    return state.update_table_response(table, frequency_hz), suspicions


def _check_swept_motion(
    state: CycleCheckState, cycle: DriveCycle
) -> tuple[CycleCheckState, list[Suspicion]]:
    """Run the checks of a steady motion that hold while the frequency moves.

    The band goes beyond that of the servo, so its response is followed, not judged: what it must
    keep is the level.
    """
    suspicions = [
        *cycle_checks.check_level(cycle),
        *cycle_checks.check_command_gain(cycle),
        *cycle_checks.check_table_mean(cycle),
    ]
    table_errors = state.pair_baselines.get("table_disp_m", PairBaseline()).errors
    table, _ = cycle_checks.measure_transfer(cycle, table_errors.low_cut)
    if suspicions or not math.isfinite(abs(table)):
        return state, suspicions
    turn_s = 2 * math.pi / cycle.omega
    lag_s = cycle_checks.phase_lag_s(table, cycle.omega) % turn_s
    if lag_s >= MAX_LAG_S:
        return state, suspicions
    return replace(state, gain=abs(table), lag_s=lag_s), suspicions


def _count_cycles(spans: list[SampleSpan]) -> float:
    """Count the cycles of the drive over spans."""
    return sum(float(_phase_steps(span.phase).sum()) for span in spans)


def _phase_steps(phase: Float1D) -> Float1D:
    """Return the phase increments in cycles, the last one repeated, (sample,)."""
    steps = np.diff(phase)
    steps -= np.floor(steps + 0.5)  # the cycle count of a drive may restart
    return np.append(steps, steps[-1:])


def _join_spans(context: ProtectionContext, spans: list[SampleSpan]) -> DriveCycle:
    last = spans[-1]
    phase = np.concatenate([span.phase for span in spans])
    cycles = np.cumsum(_phase_steps(phase)[:-1])
    return DriveCycle(
        context,
        np.concatenate([span.values for span in spans], axis=1),
        np.concatenate([span.command for span in spans]),
        phase[0] + np.concatenate([[0.0], cycles]),
        last.level,
        last.label,
    )


MAX_FINDINGS = 256  # per call of `check_samples`
MAX_RECORD_RATIO = 1.3  # of the table's acceleration over the envelope of its target
# The envelope of a target is its largest acceleration within this time before and after, and no
# less than this share of its peak: impacts and friction add to quiet parts.
ENVELOPE_S, MIN_ENVELOPE_RATIO = 0.25, 0.5
FRICTION_SHARE = 0.5  # of the least level that a rig with friction asks for: its friction
HISTORY_KEY = 0.5  # motion without cycles
NEVER = -(2**62)  # sample before any episode
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
    record_limit: Float1D = field(
        default_factory=lambda: np.empty(0)
    )  # m/s2, from its first sample
    record_samples: int = 0  # of the record that are played
    is_off_target: bool = False  # found once a run
    last_beyond: tuple[int, ...] = ()  # last sample beyond each limit of the profile


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
        record_limit=_limit_record(profile, rig),
        last_beyond=(NEVER,) * len(profile.limits),
    )
    _warm_up_kernel(state)
    return state


def _limit_record(profile: Profile, rig: RigConfig) -> Float1D:
    """Return the largest acceleration of the table that a drive allows in m/s2, (sample,).

    Friction adds to it what is in no proportion to the target. Empty without a drive: a history
    played open loop is off its target as the table is.
    """
    excitation, rate_hz = profile.excitation, profile.acquisition.rate_hz
    if not isinstance(excitation, History) or excitation.drive is None:
        return np.empty(0)
    from scipy.ndimage import maximum_filter1d  # slow to import, and few tests have a drive

    size = np.abs(history_acceleration(profile.plan.target_m, rate_hz))
    envelope = maximum_filter1d(size, 2 * math.ceil(ENVELOPE_S * rate_hz) + 1)
    friction = FRICTION_SHARE * rig.table_response.least_level_g * GRAVITY_M_S2
    return MAX_RECORD_RATIO * np.maximum(envelope, MIN_ENVELOPE_RATIO * size.max()) + friction


def _check_channel_limits(
    state: ProtectionState, values: Float2D, block: Block
) -> tuple[ProtectionState, list[Finding]]:
    """Compare channels with the limits of the profile that warn or stop, once per episode.

    `values` (channel, history + sample); of three samples the median counts, as in other limits.
    """
    findings, last_beyond = [], []
    for entry, last in zip(state.context.profile.limits, state.last_beyond, strict=True):
        beyond = np.empty(0, dtype=np.int64)
        if entry.action != NOTCH and entry.channel in block.channels:
            newest = values[block.channels.index(entry.channel), -len(block) - 2 :]
            medians = np.median(np.lib.stride_tricks.sliding_window_view(newest, 3), axis=1)
            beyond = np.flatnonzero(np.abs(medians) > entry.limit_si)
        before = np.concatenate([[last], block.index + beyond])
        is_first = np.diff(before) > state.thresholds.episode_samples
        for row in beyond[is_first].tolist():
            unit = state.context.rig.channel_by_name[entry.channel].unit
            value, index = float(medians[row]), block.index + row
            text = (
                f"{entry.channel}: {format_si(value, unit)} at sample {index} exceeds the limit of "
                f"the test, {format_si(entry.limit_si, unit)}"
            )
            stop = entry.action == "stop"
            findings.append(
                Finding(index, "limit", entry.channel, value, entry.limit_si, text, stop)
            )
        last_beyond.append(int(before[-1]))
    return replace(state, last_beyond=tuple(last_beyond)), findings


def _check_record(
    state: ProtectionState, values: Float2D, block: Block
) -> tuple[ProtectionState, list[Finding]]:
    """Compare the table's acceleration with the target of a drive while it is played.

    `values` (channel, history + sample); of three samples the median counts, as in other limits.
    """
    if not state.record_limit.size:
        return state, []
    played = np.flatnonzero(block.is_history)
    first = state.record_samples
    state = replace(state, record_samples=state.record_samples + played.size)
    count = min(played.size, state.record_limit.size - first)
    if count <= 0 or state.is_off_target:
        return state, []
    row = state.thresholds.acceleration_row
    newest = values[row, values.shape[1] - len(block) - 2 :]
    medians = np.median(np.lib.stride_tricks.sliding_window_view(newest, 3), axis=1)
    acceleration, limit = medians[played[:count]], state.record_limit[first : first + count]
    beyond = np.flatnonzero(np.abs(acceleration) > limit)
    if beyond.size == 0:
        return state, []
    worst = int(beyond[0])
    value, allowed = float(acceleration[worst]), float(limit[worst])
    excitation, index = state.context.profile.excitation, block.index + int(played[worst])
    name = getattr(excitation, "file", state.context.profile.title)
    ratio = MAX_RECORD_RATIO * abs(value) / allowed
    text = (
        f"{name}: the table is at {ratio:.2f} times the envelope of its target at sample {index}; "
        f"allowed: {MAX_RECORD_RATIO:g}; compute the drive for this table and level"
    )
    finding = Finding(index, "record", block.channels[row], value, allowed, text, stop=True)
    return replace(state, is_off_target=True), [finding]


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
    swept = state.context.profile.swept_sine
    frequency_hz = (
        plan.steps[0].frequency_hz if plan.steps else math.sqrt(plan.low_hz * plan.high_hz)
    )
    if swept is not None:
        frequency_hz = swept.ends_hz(0)[0]
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
    clipped = np.ascontiguousarray(observation.clipped)
    demanded = np.ascontiguousarray(observation.acceleration_m_s2)
    keys = _motion_keys(block, state.context.profile.swept_sine is not None)
    state = replace(state, sample_state=state.sample_state.copy())
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
    state, record_findings = _check_record(state, values, block)
    findings += record_findings
    if state.last_beyond:
        state, limit_findings = _check_channel_limits(state, values, block)
        findings += limit_findings
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


def _motion_keys(block: Block, is_swept: bool) -> Float1D:
    """Return the key of each sample's motion, (sample,): 0 rest, 1 blend, 2 and up a held step.

    A history has the key HISTORY_KEY: it has no cycles, so there are no cycle checks. The parts of
    a swept sine count as held steps: their frequency moves by a percent in a cycle. Motions
    before the first step have key -1: the loop check judges the sensors itself, so the protection
    must not stop it first.
    """
    keys = _LABEL_KEYS[block.label]
    keys = np.where(keys == FIRST_HOLD_KEY, FIRST_HOLD_KEY + block.step, keys)
    if not is_swept:
        keys = np.where(block.is_history, HISTORY_KEY, keys)
    return np.where((block.step < 0) & (keys != 0), LOOP_CHECK_KEY, keys)
