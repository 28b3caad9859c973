"""What is decided from what was measured: after the loop check, a look, the measured cycles."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from table_io import loop_check
from table_io.block import Float1D, Label, join
from table_io.channels import rel_disp
from table_io.conductor.moves import approach, measure, tune
from table_io.conductor.state import Conductor, Stage
from table_io.control import Tuning, updated, within
from table_io.limits import recheck
from table_io.policies import Decision, Result
from table_io.policies.result import swing
from table_io.records import Check, Decided, Event, Level, Record, Step
from table_io.tracking import HARMONICS, Tracked, track


def checked(now: Conductor) -> Conductor:
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
    return approach(now, one.profile.first_step)


def _line(check: Check) -> str:
    value = f"{check.value:.4g} {check.unit}".rstrip()
    return f"{check.name} of {check.channel} is {value} ({loop_check.remedy(check)})"


def looked(now: Conductor) -> Conductor:
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
        return accepted(replace(now, tuning=now.tuning.learnt(aim)))
    blend = now.score.profile.sweep.blend_cycles
    course = now.course.blended(new, level.step, blend, Label.BLEND)
    now = replace(now, course=course, changed=now.course.at)
    return tune(now, replace(stage, update=stage.update + 1, look=first))


def accepted(now: Conductor) -> Conductor:
    """The level is right: measure, and on to what follows, if it is known."""
    place, changed = now.stage.step, now.course.at
    now = replace(measure(now, place), changed=changed)
    if now.stage.kind == "end" and place + 1 < len(now.steps):
        now = replace(approach(now, place + 1), changed=changed)
    return now


def decided(now: Conductor) -> Conductor:
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
        return approach(now, step.index)
    if following is None and stage.step + 1 < len(now.steps):
        return approach(now, stage.step + 1)
    if following is not None:
        now = replace(now, records=(*now.records, Event(stage.last, "found", following)))
    return replace(now, stage=Stage("end"))


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


DECIDE: dict[str, Callable[[Conductor], Conductor]] = {
    "check": checked,
    "tune": looked,
    "hold": decided,
}
