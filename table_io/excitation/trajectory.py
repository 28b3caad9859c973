"""Trajectory builder: appends phase-continuous blend, hold and rest segments.

A trajectory is immutable and independent of measurements; `sequencer` decides what to append.
`to_drive()` always ends it with a soft stop.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Float1D, Label
from table_io.config.excitation.swept_sine import SweptSine
from table_io.config.profile import Profile
from table_io.excitation.drive import (
    RAMP_CYCLES,
    RAMP_S,
    Drive,
    HistorySegment,
    Segment,
    peak_acceleration_ratio,
)
from table_io.records import Step

PEAK_RATIO = 1.05  # largest acceleration of a blend, over the larger level
SETTLE_UPDATES = 8  # of the level of a swept sine, before its frequency moves
UNCHANGED = sys.maxsize  # no sample of a drive that is queued changes
NOMINAL_UPDATE_S = 1.0  # between updates that change nothing: fewer, longer segments


@dataclass(frozen=True, slots=True)
class SineTarget:
    """Steady sine motion: frequency, peak table acceleration and correction of the command."""

    frequency_hz: float
    level_m_s2: float
    correction: float = 1.0
    shape: tuple[complex, ...] = ()

    @property
    def corrected_m_s2(self) -> float:
        return self.level_m_s2 * self.correction


@dataclass(frozen=True)
class Trajectory:
    """Segments so far; `target` is the motion at sample `end`, where the next one begins.

    Samples before `changed_from` are those of the drive that is queued.
    """

    rate_hz: float
    end: int
    target: SineTarget
    phase: float = 0.0  # in cycles, at `end`
    log_rate_1_s: float = 0.0  # slope of ln f at `end`, of a swept sine
    segments: tuple[Segment | HistorySegment, ...] = ()
    changed_from: int = UNCHANGED

    def append_rest(self, count: int) -> "Trajectory":
        """Append `count` samples of rest; ValueError if the motion is not at rest."""
        if self.target.level_m_s2 != 0.0:
            raise ValueError(f"the trajectory moves at sample {self.end}; blend to rest first")
        return replace(self, end=self.end + count, changed_from=min(self.changed_from, self.end))

    def append_blend(
        self, target: SineTarget, step: int, min_cycles: float, label: Label
    ) -> "Trajectory":
        """Append the shortest blend to `target` with acceleration up to 1.05 of the larger level.

        Appends nothing if the motion already is that of `target`.
        """
        if target == self.target:
            return self
        start = self.target if self.target.level_m_s2 else replace(target, level_m_s2=0.0)
        if not target.level_m_s2:
            target = replace(start, level_m_s2=0.0)
        from_rest = min(start.level_m_s2, target.level_m_s2) == 0.0
        mean_hz = 0.5 * (start.frequency_hz + target.frequency_hz)
        duration_s = max(RAMP_CYCLES / mean_hz, RAMP_S) if from_rest else min_cycles / mean_hz
        while True:
            count = math.ceil(duration_s * self.rate_hz)
            segment = self._make_segment(start, target, count, step, label)
            if peak_acceleration_ratio(segment, self.rate_hz) <= PEAK_RATIO:
                return self._append(segment, target)
            duration_s += 0.25 / mean_hz

    def append_sweep(
        self, target: SineTarget, count: int, step: int, log_rate_1_s: float, label: Label
    ) -> "Trajectory":
        """Append `count` samples of a swept sine that end at `target` with this slope of ln f."""
        segment = self._make_segment(self.target, target, count, step, label)
        return self._append(replace(segment, rate1=log_rate_1_s), target)

    def append_hold(
        self, count: int, step: int, label: Label, cycles: int = 0, settle: int = 0
    ) -> "Trajectory":
        """Append `count` samples of the current motion; `cycles` > 0 numbers and measures them."""
        target = self.target
        segment = Segment(
            self.end,
            count,
            label,
            step,
            target.frequency_hz,
            target.frequency_hz,
            target.level_m_s2,
            target.level_m_s2,
            self.phase,
            cycles,
            settle,
            target.correction,
            target.correction,
            target.shape,
            target.shape,
        )
        return self._append(segment, target)

    def append_history(self, history_m: Float1D, windows: int) -> "Trajectory":
        """Append a displacement history in m from rest to rest; ValueError if not at rest."""
        at_rest = self.append_rest(history_m.size)
        segment = HistorySegment(self.end, history_m, windows)
        return replace(at_rest, segments=(*self.segments, segment))

    def cut(self, index: int) -> "Trajectory":
        """Return the trajectory cut at sample `index`, or at the end of a blend around it.

        ValueError at a history, which is played whole.
        """
        segments = tuple(segment for segment in self.segments if segment.start < index)
        if not segments:
            return replace(
                self, end=index, segments=(), phase=0.0, target=replace(self.target, level_m_s2=0),
                changed_from=min(self.changed_from, index),
            )  # fmt: skip
        last = segments[-1]
        if isinstance(last, HistorySegment):
            raise ValueError(f"a history is played at sample {index}; it cannot be cut")
        if last.end <= index or not _is_steady(last):
            index = last.end
        x = np.array([(index - last.start) / last.count])
        phase = float(last.phase(x, self.rate_hz)[0]) % 1.0
        target = SineTarget(last.f1, last.level1, last.correction1, last.shape1)
        return replace(
            self, end=index, target=target, phase=phase, log_rate_1_s=last.rate1, segments=segments,
            changed_from=min(self.changed_from, index),
        )  # fmt: skip

    def to_drive(self, steps: tuple[Step, ...]) -> Drive:
        """Return the drive of the trajectory with a soft stop at its end."""
        last = self.segments[-1] if self.segments else None
        at_rest = replace(self.target, level_m_s2=0.0)
        trajectory = (
            self.append_blend(at_rest, last.step, RAMP_CYCLES, Label.BLEND)
            if self.target.level_m_s2 and isinstance(last, Segment)
            else self
        )
        return Drive(self.rate_hz, trajectory.segments, steps)

    def _make_segment(
        self, start: SineTarget, target: SineTarget, count: int, step: int, label: Label
    ) -> Segment:
        """Return the segment of `count` samples that leads from one motion to another from here."""
        return Segment(
            self.end,
            count,
            label,
            step,
            start.frequency_hz,
            target.frequency_hz,
            start.level_m_s2,
            target.level_m_s2,
            self.phase,
            correction0=start.correction,
            correction1=target.correction,
            shape0=start.shape,
            shape1=target.shape,
            rate0=self.log_rate_1_s,
        )

    def _append(self, segment: Segment, target: SineTarget) -> "Trajectory":
        phase = float(segment.phase(np.ones(1), self.rate_hz)[0]) % 1.0
        return replace(
            self,
            end=segment.end,
            target=target,
            phase=phase,
            log_rate_1_s=segment.rate1,
            segments=(*self.segments, segment),
            changed_from=min(self.changed_from, self.end),
        )


def _is_steady(segment: Segment) -> bool:
    """Return True if the segment is a steady motion, which may be cut anywhere."""
    start = (segment.f0, segment.level0, segment.correction0, segment.shape0)
    return start == (segment.f1, segment.level1, segment.correction1, segment.shape1)


def start_trajectory(profile: Profile) -> Trajectory:
    """Return a trajectory at rest after the initial `rest_s`."""
    rate_hz = profile.acquisition.rate_hz
    return Trajectory(
        rate_hz,
        math.ceil(profile.acquisition.rest_s * rate_hz),
        SineTarget(profile.plan.low_hz, 0.0),
    )


def cycles_to_samples(step: Step, cycles: int, rate_hz: float) -> int:
    """Convert a number of cycles of a step to samples, rounded up."""
    return math.ceil(cycles * rate_hz / step.frequency_hz)


def plan_excitation(profile: Profile) -> Drive:
    """Return the drive of the excitation alone for an ideal table, which needs no other command."""
    plan = profile.plan
    if plan.steps:
        return plan_sweep(profile)
    if profile.swept_sine is not None:
        return append_whole_sweep(start_trajectory(profile), profile.swept_sine).to_drive(())
    return start_trajectory(profile).append_history(plan.target_m, plan.windows).to_drive(())


@dataclass(frozen=True, slots=True)
class SweptPosition:
    """Place at the end of a trajectory in a swept sine: pass, frequency, and updates held before.

    The pass is that which goes on; behind the last one it is the number of passes.
    """

    sweep: int
    frequency_hz: float
    held: int = 0


def append_swept(
    trajectory: Trajectory,
    config: SweptSine,
    position: SweptPosition,
    choose_level: Callable[[float], tuple[float, float]],
    min_s: float = 0.0,
) -> tuple[Trajectory, SweptPosition]:
    """Append the next part of a swept sine, to its next update: return (trajectory, position).

    It lasts `min_s` at least. `choose_level` returns (level in m/s2, correction of the command) at
    a frequency in Hz. At the begin of the first pass the frequency is held for SETTLE_UPDATES.
    """
    f, rate_hz = position.frequency_hz, trajectory.rate_hz
    seconds = max(config.update_s(f), min_s)
    rate = config.log_rate_1_s(position.sweep)
    step = config.find_window(position.sweep, f)
    if position.held < SETTLE_UPDATES:
        target = SineTarget(f, *choose_level(f))
        count = math.ceil(seconds * rate_hz)
        held = replace(position, held=position.held + 1)
        return trajectory.append_sweep(target, count, step, 0.0, Label.SETTLE), held
    end_hz = config.ends_hz(position.sweep)[1]
    left = abs(math.log(end_hz / f))  # of the way in ln f
    mean = 0.5 * (abs(trajectory.log_rate_1_s) + abs(rate)) / abs(rate)
    is_last = left <= (mean + 0.5) * abs(rate) * seconds
    if is_last:  # slow down to a stand; at a stand already, over a part of the way alone
        share = 0.5 * (abs(trajectory.log_rate_1_s) / abs(rate))
        seconds = left / (share * abs(rate)) if share else seconds
        rate = 0.0
    count = math.ceil(seconds * rate_hz)
    way = 0.5 * (trajectory.log_rate_1_s + rate) * count / rate_hz
    next_hz = end_hz if is_last else f * math.exp(way)
    target = SineTarget(next_hz, *choose_level(next_hz))
    trajectory = trajectory.append_sweep(target, count, step, rate, Label.MEASURE)
    after = position.sweep + is_last
    return trajectory, replace(position, sweep=after, frequency_hz=next_hz)


def append_whole_sweep(trajectory: Trajectory, config: SweptSine) -> Trajectory:
    """Append a swept sine at its nominal level, from its soft start to the end of its passes.

    Of dwells nothing is known before.
    """
    trajectory, position = start_swept(trajectory, config, 1.0)

    def choose_level(frequency_hz: float) -> tuple[float, float]:
        return config.level_m_s2(frequency_hz), 1.0

    while position.sweep < config.passes:
        trajectory, position = append_swept(
            trajectory, config, position, choose_level, NOMINAL_UPDATE_S
        )
    return trajectory


def start_swept(
    trajectory: Trajectory, config: SweptSine, correction: float
) -> tuple[Trajectory, SweptPosition]:
    """Append the soft start of a swept sine at its first frequency: (trajectory, position)."""
    f = config.ends_hz(0)[0]
    target = SineTarget(f, config.level_m_s2(f), correction)
    return trajectory.append_blend(target, 0, RAMP_CYCLES, Label.BLEND), SweptPosition(0, f)


def plan_sweep(profile: Profile) -> Drive:
    """Return the drive of the sweep alone: rest, soft start, steps with blends, soft stop."""
    plan, trajectory = profile.plan, start_trajectory(profile)
    if profile.continuation is not None:  # each orbit as if it were found at once
        settle = profile.continuation.settle_cycles
        cycles = settle + profile.continuation.measured_cycles
    else:
        cycles = profile.sweep.cycles
        settle = cycles - profile.sweep.measured_cycles
    for step in plan.steps[profile.first_step :]:
        target = SineTarget(step.frequency_hz, step.acceleration_m_s2)
        trajectory = trajectory.append_blend(target, step.index, plan.blend_cycles, Label.BLEND)
        trajectory = trajectory.append_hold(
            cycles_to_samples(step, cycles, trajectory.rate_hz),
            step.index,
            Label.MEASURE,
            cycles,
            settle,
        )
    return trajectory.to_drive(plan.steps)
