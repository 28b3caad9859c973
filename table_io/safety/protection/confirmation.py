"""Scheduling and confirmation of the cycle checks: every half cycle, over the last whole cycle.

The phase of the drive alone selects the samples of a check, so results do not depend on the
division into blocks.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.control.order_tracking import evaluate_transfer
from table_io.records import FrequencyResponse
from table_io.safety.protection import cycle_checks, load_cells
from table_io.safety.protection.cycle import DriveCycle, ProtectionContext, Suspicion
from table_io.safety.protection.cycle_checks import PairBaseline, SwingAverage
from table_io.safety.protection.load_cells import ForceShare
from table_io.sensor_errors import highpass

FIRST_HOLD_KEY = 2  # keys from here on are motions of constant frequency and level
MIN_CYCLE_COUNT = 1.0 - 1e-3  # cycles that count as a whole one
PLAUSIBLE_GAIN_RANGE, MAX_LAG_S = (
    (0.5, 1.5),
    0.1,
)  # of a table whose position is predicted sample by sample
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
        state, steady_suspicions = _check_steady_motion(state, _join_spans(context, last))
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
    for names, acceleration in cycle_checks.SENSOR_PAIRS:
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
    for names, acceleration in cycle_checks.SENSOR_PAIRS:
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
    cell_suspicions, shares = load_cells.check_cell_pairs(cycle, state.force_shares)
    return replace(
        state, pair_baselines=baselines, force_shares=shares
    ), suspicions + cell_suspicions


def _check_steady_motion(
    state: CycleCheckState, cycle: DriveCycle
) -> tuple[CycleCheckState, list[Suspicion]]:
    """Run the checks for constant frequency and level: level, command, drift, response."""
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
