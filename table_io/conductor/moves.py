"""How the drive goes on: approach a step, hold still for a look, measure, stay."""

import math
from dataclasses import replace

from table_io.block import Label
from table_io.conductor.state import Conductor, Stage
from table_io.course import Aim, Course, cycles_of
from table_io.profile import Profile
from table_io.records import Step

LOOK_S = 0.3  # a look is at least so long, in whole cycles
LOOKS_BEFORE_S = 0.3  # and comes so long, and a cycle, after a blend
OPEN_S = 3600.0  # a person's hold ends by itself


def approach(now: Conductor, place: int) -> Conductor:
    """Blend to the step at `place` and tune there, or hold it at once where there is no control."""
    profile, changed = now.score.profile, now.course.at
    while True:
        step = now.steps[place]
        aim = now.tuning.predicted(step) if profile.control.enabled else _plain(step)
        course = now.course.blended(aim, step.index, profile.sweep.blend_cycles, Label.BLEND)
        now = replace(now, course=course, changed=changed)
        if profile.control.enabled:
            return tune(now, Stage("tune", place))
        now = measure(now, place)
        if now.stage.kind == "hold" or place + 1 == len(now.steps):
            return now
        place += 1


def _plain(step: Step) -> Aim:
    return Aim(step.frequency_hz, step.acceleration_m_s2)


def tune(now: Conductor, stage: Stage) -> Conductor:
    """Hold still for a look; if nothing follows from it the measured cycles begin."""
    course, rate = now.course, now.course.rate_hz
    f = course.now.frequency_hz
    first = course.at + math.ceil(max(rate / f, LOOKS_BEFORE_S * rate))
    last = first + math.ceil(max(math.ceil(LOOK_S * f), 1) * rate / f)
    step = now.steps[stage.step]
    course = course.held(last + now.score.margin - course.at, step.index, Label.SETTLE)
    stage = replace(stage, first=first, last=last)
    ahead = _measured(course, step, now.score.profile).drive(now.steps)
    return replace(now, course=course, drive=ahead, stage=stage)


def _measured(course: Course, step: Step, profile: Profile) -> Course:
    """The course with the held cycles of a step."""
    sweep = profile.sweep
    count = cycles_of(step, sweep.cycles, course.rate_hz)
    settle = sweep.cycles - sweep.measured_cycles
    return course.held(count, step.index, Label.MEASURE, sweep.cycles, settle)


def measure(now: Conductor, place: int) -> Conductor:
    """Measure the step; a policy then looks at it, or the drive may end here."""
    step, sweep = now.steps[place], now.score.profile.sweep
    begun = now.course.at
    course = _measured(now.course, step, now.score.profile)
    stage = Stage("end")
    if now.score.policy is not None:
        settle = cycles_of(step, sweep.cycles - sweep.measured_cycles, course.rate_hz)
        stage = Stage("hold", place, begun + settle, course.at)
        course = course.held(now.score.margin, step.index, Label.SETTLE)
    return replace(now, course=course, drive=course.drive(now.steps), stage=stage)


def stay(now: Conductor, step: int) -> Conductor:
    """Stay as it is until a person says otherwise."""
    place = next(k for k, one in enumerate(now.steps) if one.index == step)
    count = round(OPEN_S * now.course.rate_hz)
    course = now.course.held(count, step, Label.SETTLE)
    return replace(now, course=course, drive=course.drive(now.steps), stage=Stage("open", place))
