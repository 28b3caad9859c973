"""A drive under construction: blends, holds and rests put one after another, phase continuous.

A course is a value and knows nothing of what was measured; what decides how it goes on is in
`conductor.py`. Whatever its last segment, `drive()` ends it by a soft stop.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from table_io.block import Label
from table_io.drive import RAMP_CYCLES, RAMP_S, Drive, Segment, worst_ratio
from table_io.profile import Profile
from table_io.records import Step

PEAK_RATIO = 1.05  # of the larger level: the most acceleration that a blend may ask for


@dataclass(frozen=True, slots=True)
class Aim:
    """A steady motion: frequency, peak table acceleration, and how the command is corrected."""

    frequency_hz: float
    level_m_s2: float
    correction: float = 1.0
    shape: tuple[complex, ...] = ()

    @property
    def corrected_m_s2(self) -> float:
        return self.level_m_s2 * self.correction


@dataclass(frozen=True)
class Course:
    """Segments so far; `now` is the motion at sample `at`, where the next segment begins."""

    rate_hz: float
    at: int
    now: Aim
    phase: float = 0.0  # in cycles, at `at`
    segments: tuple[Segment, ...] = ()

    def rested(self, count: int) -> "Course":
        """`count` samples of rest; only where the motion has come to rest."""
        if self.now.level_m_s2 != 0.0:
            raise ValueError(f"the course moves at sample {self.at}; blend to rest first")
        return replace(self, at=self.at + count)

    def blended(self, aim: Aim, step: int, least_cycles: float, label: Label) -> "Course":
        """The shortest blend to `aim` whose acceleration stays below 1.05 of the larger level.

        Nothing at all where the motion is that of `aim` already.
        """
        if aim == self.now:
            return self
        now = self.now if self.now.level_m_s2 else replace(aim, level_m_s2=0.0)
        if not aim.level_m_s2:
            aim = replace(now, level_m_s2=0.0)
        ramp = min(now.level_m_s2, aim.level_m_s2) == 0.0
        mean_hz = 0.5 * (now.frequency_hz + aim.frequency_hz)
        seconds = max(RAMP_CYCLES / mean_hz, RAMP_S) if ramp else least_cycles / mean_hz
        while True:
            segment = Segment(
                self.at,
                math.ceil(seconds * self.rate_hz),
                label,
                step,
                now.frequency_hz,
                aim.frequency_hz,
                now.level_m_s2,
                aim.level_m_s2,
                self.phase,
                correction0=now.correction,
                correction1=aim.correction,
                shape0=now.shape,
                shape1=aim.shape,
            )
            if worst_ratio(segment, self.rate_hz) <= PEAK_RATIO:
                return self._with(segment, aim)
            seconds += 0.25 / mean_hz

    def held(
        self, count: int, step: int, label: Label, cycles: int = 0, settle: int = 0
    ) -> "Course":
        """`count` samples of the motion as it is; with `cycles`, numbered and measured ones."""
        aim = self.now
        segment = Segment(
            self.at,
            count,
            label,
            step,
            aim.frequency_hz,
            aim.frequency_hz,
            aim.level_m_s2,
            aim.level_m_s2,
            self.phase,
            cycles,
            settle,
            aim.correction,
            aim.correction,
            aim.shape,
            aim.shape,
        )
        return self._with(segment, aim)

    def cut(self, at: int) -> "Course":
        """The course up to sample `at`, or up to the end of the blend that lies there."""
        kept = tuple(one for one in self.segments if one.start < at)
        if not kept:
            return replace(self, at=at, segments=(), phase=0.0, now=replace(self.now, level_m_s2=0))
        last = kept[-1]
        if last.end <= at or not _steady(last):
            at = last.end
        x = np.array([(at - last.start) / last.count])
        phase = float(last.phase(x, self.rate_hz)[0]) % 1.0
        aim = Aim(last.f1, last.level1, last.correction1, last.shape1)
        return replace(self, at=at, now=aim, phase=phase, segments=kept)

    def drive(self, steps: tuple[Step, ...]) -> Drive:
        """The course with a soft stop at its end."""
        step = self.segments[-1].step if self.segments else -1
        rest = replace(self.now, level_m_s2=0.0)
        whole = self.blended(rest, step, RAMP_CYCLES, Label.BLEND) if self.now.level_m_s2 else self
        return Drive(self.rate_hz, whole.segments, steps)

    def _with(self, segment: Segment, aim: Aim) -> "Course":
        phase = float(segment.phase(np.ones(1), self.rate_hz)[0]) % 1.0
        return replace(
            self, at=segment.end, now=aim, phase=phase, segments=(*self.segments, segment)
        )


def _steady(segment: Segment) -> bool:
    """True where a segment is one motion throughout, so that it may be cut anywhere."""
    before = (segment.f0, segment.level0, segment.correction0, segment.shape0)
    return before == (segment.f1, segment.level1, segment.correction1, segment.shape1)


def begin(profile: Profile) -> Course:
    """A course at rest, its first `rest_s` behind it."""
    rate = profile.acquisition.rate_hz
    return Course(
        rate, math.ceil(profile.acquisition.rest_s * rate), Aim(profile.sweep.start_hz, 0.0)
    )


def cycles_of(step: Step, cycles: int, rate_hz: float) -> int:
    """Samples of a number of cycles of a step."""
    return math.ceil(cycles * rate_hz / step.frequency_hz)


def plan(profile: Profile) -> Drive:
    """The sweep alone on an ideal table: rest, soft start, the steps with blends, soft stop."""
    sweep, course = profile.sweep, begin(profile)
    for step in sweep.steps[profile.first_step :]:
        aim = Aim(step.frequency_hz, step.acceleration_m_s2)
        course = course.blended(aim, step.index, sweep.blend_cycles, Label.BLEND)
        course = course.held(
            cycles_of(step, sweep.cycles, course.rate_hz),
            step.index,
            Label.MEASURE,
            sweep.cycles,
            sweep.cycles - sweep.measured_cycles,
        )
    return course.drive(sweep.steps)
