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
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from table_io import loop_check
from table_io.block import Block, Float1D, Label, join
from table_io.channels import rel_disp
from table_io.control import Tuning, updated, within
from table_io.course import Aim, Course, begin, cycles_of
from table_io.drive import Drive
from table_io.limits import recheck
from table_io.policies import Decision, Policy, Result, policy_of
from table_io.policies.result import swing
from table_io.profile import Profile
from table_io.records import Check, Decided, Event, Level, Record, Step
from table_io.rig import Rig
from table_io.tracking import HARMONICS, NOTHING, Tracked, track

MARGIN_S = 0.25  # from a look to the change that follows it; a block is shorter
LOOK_S = 0.3  # a look is at least so long, in whole cycles
LOOKS_BEFORE_S = 0.3  # and comes so long, and a cycle, after a blend
OPEN_S = 3600.0  # a person's hold ends by itself


@dataclass(frozen=True, slots=True)
class Score:
    """What does not change: the test, the machine, and how a test finds its way, if it does."""

    profile: Profile
    rig: Rig
    margin: int
    policy: Policy | None = None


def score(profile: Profile, rig: Rig, replace_after: int = 0) -> Score:
    """The score of a test on a backend that can change what lies `replace_after` samples ahead."""
    rate = profile.acquisition.rate_hz
    block = max(math.ceil(MARGIN_S * rate), profile.acquisition.block_samples)
    return Score(profile, rig, replace_after + block + 1, policy_of(profile))


@dataclass(frozen=True, slots=True)
class Stage:
    """What is decided next: on samples first .. last - 1, when `last` is there."""

    kind: str  # check, tune, hold, open, end
    step: int = -1
    first: int = 0
    last: int = 0
    update: int = 0
    look: Tracked = NOTHING  # the first one at this step


@dataclass(frozen=True)
class Conductor:
    """State of a test under way. `drive` differs from what it was only from `changed` on."""

    score: Score
    course: Course
    drive: Drive
    stage: Stage
    steps: tuple[Step, ...]
    tuning: Tuning = field(default_factory=Tuning)
    changed: int = 0
    refused: str = ""  # why the run must not go on
    noise: dict[str, float] | None = None  # rms of each channel at the tare, SI
    heard: tuple[Block, ...] = ()
    results: tuple[Result, ...] = ()
    records: tuple[Record, ...] = field(default=())

    @property
    def over(self) -> bool:
        """True where nothing is left to decide: the drive is known to its end."""
        return self.stage.kind == "end"


def start(one: Score) -> Conductor:
    """A test at rest: with a loop check first, if the profile wants one."""
    profile = one.profile
    course, steps = begin(profile), profile.sweep.steps
    aims = loop_check.aims(profile, one.rig) if profile.loop_check.enabled else ()
    if not aims:
        blank = Conductor(one, course, course.drive(steps), Stage("end"), steps)
        return replace(_approach(blank, profile.first_step), changed=0)
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
    while now.stage.kind in _DECIDE and now.stage.last <= block.end:
        now = _DECIDE[now.stage.kind](now)
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
    return _open(replace(now, course=course, changed=course.at), step)


def resume(now: Conductor, at: int) -> Conductor:
    """Go on from a hold: the step is tuned and measured anew."""
    if now.stage.kind != "open":
        return now
    now = replace(now, course=now.course.cut(at))
    return replace(_approach(now, now.stage.step), changed=at)


def rehearsed(one: Score) -> Drive:
    """The drive that is played if every look is good and nobody intervenes."""
    now = start(one)
    while not now.over:
        if now.stage.kind == "check":
            now = _approach(now, one.profile.first_step)
        elif now.stage.kind == "tune":
            now = _accepted(now)
        elif now.stage.step + 1 < len(now.steps):
            now = _approach(now, now.stage.step + 1)
        else:
            now = replace(now, stage=Stage("end"))  # a policy needs what only a test tells
    return now.drive


def _approach(now: Conductor, place: int) -> Conductor:
    """Blend to the step at `place` and tune there, or hold it at once where there is no control."""
    profile, changed = now.score.profile, now.course.at
    while True:
        step = now.steps[place]
        aim = now.tuning.predicted(step) if profile.control.enabled else _plain(step)
        course = now.course.blended(aim, step.index, profile.sweep.blend_cycles, Label.BLEND)
        now = replace(now, course=course, changed=changed)
        if profile.control.enabled:
            return _tune(now, Stage("tune", place))
        now = _hold(now, place)
        if now.stage.kind == "hold" or place + 1 == len(now.steps):
            return now
        place += 1


def _plain(step: Step) -> Aim:
    return Aim(step.frequency_hz, step.acceleration_m_s2)


def _tune(now: Conductor, stage: Stage) -> Conductor:
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


def _hold(now: Conductor, place: int) -> Conductor:
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


def _open(now: Conductor, step: int) -> Conductor:
    """Stay as it is until a person says otherwise."""
    place = next(k for k, one in enumerate(now.steps) if one.index == step)
    count = round(OPEN_S * now.course.rate_hz)
    course = now.course.held(count, step, Label.SETTLE)
    return replace(now, course=course, drive=course.drive(now.steps), stage=Stage("open", place))


def _checked(now: Conductor) -> Conductor:
    """After the loop check: on to the sweep, or nothing more."""
    one, index = now.score, now.stage.last
    heard = join(now.heard).cut(0, index)
    checks, response = loop_check.evaluate(heard, now.drive, one.profile, one.rig, now.noise)
    said: list[Record] = [replace(check, index=index) for check in checks]
    failed = [check for check in checks if not check.passed]
    if response is not None:
        said.append(replace(response, index=index))
    why = "; ".join(_line(check) for check in failed)
    if not failed and response is not None and one.profile.control.enabled:
        why = "; ".join(recheck(now.steps, response, one.rig))
    if why:
        why = f"the loop check failed: {why}"
        return replace(now, stage=Stage("end"), refused=why, records=(*now.records, *said))
    tuning = Tuning(response)
    now = replace(now, tuning=tuning, records=(*now.records, *said))
    return _approach(now, one.profile.first_step)


def _line(check: Check) -> str:
    value = f"{check.value:.4g} {check.unit}".rstrip()
    return f"{check.name} of {check.channel} is {value} ({loop_check.remedy(check)})"


def _looked(now: Conductor) -> Conductor:
    """After a look at a step that is being tuned."""
    stage, card = now.stage, now.score.profile.control
    aim = now.course.now
    seen = _tracked(now, "table_acc_m_s2")
    first = stage.look if stage.update else seen
    most = card.harmonic_updates if card.harmonics else card.updates
    known = np.isfinite(seen.fundamental)
    new = updated(aim, seen, first, now.tuning, card) if known and stage.update < most else aim
    level = Level(
        stage.last,
        now.steps[stage.step].index,
        aim.level_m_s2,
        seen.fundamental,
        aim.correction,
        stage.update,
        new == aim,
        tuple(float(abs(one)) for one in seen.amplitudes[1:5]),
    )
    now = replace(now, records=(*now.records, level))
    if new == aim:
        if not known or not within(aim, seen, card):
            text = (
                f"step {level.step}: {level.measured_m_s2:.4g} m/s2 after {stage.update} updates, "
                f"demanded {level.demanded_m_s2:.4g} m/s2 +-{100 * card.tolerance:g} %"
            )
            now = replace(now, records=(*now.records, Event(stage.last, "level", text)))
        return _accepted(replace(now, tuning=now.tuning.learnt(aim)))
    blend = now.score.profile.sweep.blend_cycles
    course = now.course.blended(new, level.step, blend, Label.BLEND)
    now = replace(now, course=course, changed=now.course.at)
    return _tune(now, replace(stage, update=stage.update + 1, look=first))


def _accepted(now: Conductor) -> Conductor:
    """The level is right: measure, and on to what follows, if it is known."""
    place, changed = now.stage.step, now.course.at
    now = replace(_hold(now, place), changed=changed)
    if now.stage.kind == "end" and place + 1 < len(now.steps):
        now = replace(_approach(now, place + 1), changed=changed)
    return now


def _decided(now: Conductor) -> Conductor:
    """After the measured cycles of a test that finds its way: its policy says what follows."""
    stage, policy = now.stage, now.score.policy
    assert policy is not None
    step = now.steps[stage.step]
    u, phase = _window(now, "rel_disp")
    found = Result(
        step,
        _tracked(now, "table_acc_m_s2"),
        _tracked(now, "rel_disp"),
        _tracked(now, "mass_acc_m_s2"),
        swing(u, phase),
    )
    others = tuple(one for one in now.results if one.step != step)
    now = replace(now, results=(*others, found))
    following = policy(now.results)
    if isinstance(following, Decision):
        step = Step(
            len(now.steps), following.direction, following.frequency_hz, step.acceleration_m_s2
        )
        said = Decided(
            stage.last,
            step.index,
            step.direction,
            step.frequency_hz,
            step.acceleration_m_s2,
            following.reason,
        )
        now = replace(now, steps=(*now.steps, step), records=(*now.records, said))
        return _approach(now, step.index)
    if following is None and stage.step + 1 < len(now.steps):
        return _approach(now, stage.step + 1)
    if following is not None:
        now = replace(now, records=(*now.records, Event(stage.last, "found", following)))
    return replace(now, stage=Stage("end"))


_DECIDE: dict[str, Callable[[Conductor], Conductor]] = {
    "check": _checked,
    "tune": _looked,
    "hold": _decided,
}


def _window(now: Conductor, channel: str) -> tuple[Float1D, Float1D]:
    """(values, the drive's phase in cycles) over the stage's window; empty without the channel."""
    stage = now.stage
    heard = join([one for one in now.heard if one.end > stage.first and one.index < stage.last])
    window = heard.cut(stage.first, stage.last)
    if channel == "rel_disp":
        values = rel_disp(window)
    elif channel in window.channels:
        values = window.channel(channel)
    else:
        return np.empty(0), np.empty(0)
    return values, now.drive.phase(stage.first, stage.last - stage.first)


def _tracked(now: Conductor, channel: str) -> Tracked:
    """Harmonics of a channel over the stage's window; all NaN where there is no such channel."""
    return track(*_window(now, channel), HARMONICS)
