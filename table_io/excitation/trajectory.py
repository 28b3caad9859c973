"""Trajectory builder: appends phase-continuous blend, hold and rest segments.

A trajectory is immutable and independent of measurements; `sequencer` decides what to append.
`to_drive()` always ends it with a soft stop.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Float1D, Label
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
    """Segments so far; `target` is the motion at sample `end`, where the next one begins."""

    rate_hz: float
    end: int
    target: SineTarget
    phase: float = 0.0  # in cycles, at `end`
    segments: tuple[Segment | HistorySegment, ...] = ()

    def append_rest(self, count: int) -> "Trajectory":
        """Append `count` samples of rest; ValueError if the motion is not at rest."""
        if self.target.level_m_s2 != 0.0:
            raise ValueError(f"the trajectory moves at sample {self.end}; blend to rest first")
        return replace(self, end=self.end + count)

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
            segment = Segment(
                self.end,
                math.ceil(duration_s * self.rate_hz),
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
            )
            if peak_acceleration_ratio(segment, self.rate_hz) <= PEAK_RATIO:
                return self._append(segment, target)
            duration_s += 0.25 / mean_hz

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
                self, end=index, segments=(), phase=0.0, target=replace(self.target, level_m_s2=0)
            )
        last = segments[-1]
        if isinstance(last, HistorySegment):
            raise ValueError(f"a history is played at sample {index}; it cannot be cut")
        if last.end <= index or not _is_steady(last):
            index = last.end
        x = np.array([(index - last.start) / last.count])
        phase = float(last.phase(x, self.rate_hz)[0]) % 1.0
        target = SineTarget(last.f1, last.level1, last.correction1, last.shape1)
        return replace(self, end=index, target=target, phase=phase, segments=segments)

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

    def _append(self, segment: Segment, target: SineTarget) -> "Trajectory":
        phase = float(segment.phase(np.ones(1), self.rate_hz)[0]) % 1.0
        return replace(
            self, end=segment.end, target=target, phase=phase, segments=(*self.segments, segment)
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
    return start_trajectory(profile).append_history(plan.target_m, plan.windows).to_drive(())


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
