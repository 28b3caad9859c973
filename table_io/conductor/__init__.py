"""How a test goes on: loop check, then step by step tune, hold, next; what is decided and when.

A conductor is a value. `advance(conductor, block)` hands it what was measured; at fixed samples it
looks at whole cycles and decides, and what it decides changes the command `margin` samples later.
So the same samples give the same command however they are cut into blocks, and the table never
waits for a decision: the drive always goes on as if the last look was good, and always ends at
rest.

    check --(passes)--> tune --(level is right)--> hold, then tune at the next step, ...
                        tune --(it is not)-------> a blend to the corrected level, tune again
                        hold --(a policy decides)-> the next step, or the end
    open: a person holds the test at its step; on resume the step is tuned and measured anew.
"""

import math
from dataclasses import replace

from table_io import loop_check
from table_io.block import Block, Label
from table_io.conductor.looks import DECIDE, accepted
from table_io.conductor.moves import approach, stay
from table_io.conductor.state import Conductor, Score, Stage
from table_io.course import begin
from table_io.drive import Drive
from table_io.policies import policy_of
from table_io.profile import Profile
from table_io.records import Record
from table_io.rig import Rig

__all__ = [
    "Conductor", "Score", "Stage", "advance", "hold", "rehearsed", "resume", "score", "start",
]  # fmt: skip

MARGIN_S = 0.25  # from a look to the change that follows it; a block is shorter


def score(profile: Profile, rig: Rig, replace_after: int = 0) -> Score:
    """The score of a test on a backend that can change what lies `replace_after` samples ahead."""
    rate = profile.acquisition.rate_hz
    block = max(math.ceil(MARGIN_S * rate), profile.acquisition.block_samples)
    return Score(profile, rig, replace_after + block + 1, policy_of(profile))


def start(one: Score) -> Conductor:
    """A test at rest: with a loop check first, if the profile wants one."""
    profile = one.profile
    course, steps = begin(profile), profile.sweep.steps
    aims = loop_check.aims(profile, one.rig) if profile.loop_check.enabled else ()
    if not aims:
        blank = Conductor(one, course, course.drive(steps), Stage("end"), steps)
        return replace(approach(blank, profile.first_step), changed=0)
    for aim in aims:
        course = course.blended(aim, -1, profile.sweep.blend_cycles, Label.BLEND)
        cycles = loop_check.cycles_at(aim, profile)
        count = math.ceil(cycles * course.rate_hz / aim.frequency_hz)
        course = course.held(count, -1, Label.CHECK)
    course = course.blended(
        replace(course.now, level_m_s2=0.0), -1, profile.sweep.blend_cycles, Label.BLEND
    )
    course = course.rested(math.ceil(profile.loop_check.rest_s * course.rate_hz) + one.margin)
    stage = Stage("check", -1, 0, course.at - one.margin)
    return Conductor(one, course, course.drive(steps), stage, steps)


def advance(now: Conductor, block: Block) -> tuple[Conductor, tuple[Record, ...]]:
    """The conductor after a measured block, and what it says; blocks come in order."""
    now = replace(now, heard=(*now.heard, block), records=())
    while now.stage.kind in DECIDE and now.stage.last <= block.end:
        now = DECIDE[now.stage.kind](now)
    kept = tuple(one for one in now.heard if one.end > now.stage.first)
    return replace(now, heard=kept if not now.over else (), records=()), now.records


def hold(now: Conductor, at: int) -> Conductor:
    """Stay at the step that sample `at` lies in, from there on; unchanged where there is none."""
    if now.stage.kind in ("check", "open") or at >= now.drive.planned_end:
        return now
    course = now.course.cut(at)
    if course.at < at or not course.segments or course.segments[-1].step < 0:
        return now  # it ends already, or has not begun
    step = course.segments[-1].step
    return stay(replace(now, course=course, changed=course.at), step)


def resume(now: Conductor, at: int) -> Conductor:
    """Go on from a hold: the step is tuned and measured anew."""
    if now.stage.kind != "open":
        return now
    now = replace(now, course=now.course.cut(at))
    return replace(approach(now, now.stage.step), changed=at)


def rehearsed(one: Score) -> Drive:
    """The drive that is played if every look is good and nobody intervenes."""
    now = start(one)
    while not now.over:
        if now.stage.kind == "check":
            now = approach(now, one.profile.first_step)
        elif now.stage.kind == "tune":
            now = accepted(now)
        elif now.stage.step + 1 < len(now.steps):
            now = approach(now, now.stage.step + 1)
        else:
            now = replace(now, stage=Stage("end"))  # a policy needs what only a test tells
    return now.drive
