"""Decisions of the sequencer after the loop check, a level evaluation or the measured cycles."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from table_io.adaptive.result import Decision, StepResult, mean_swing
from table_io.block import Float1D, Label, join_blocks
from table_io.channels import relative_displacement
from table_io.control.amplitude_control import Tuning, is_within_tolerance, update_target
from table_io.control.order_tracking import HARMONIC_COUNT, HarmonicFit, track_harmonics
from table_io.records import Check, Event, Level, Record, Step, StepAdded
from table_io.safety import loop_check
from table_io.safety.preflight import check_corrected_drive
from table_io.sequencer.actions import approach_step, begin_excitation, measure_step, start_tuning
from table_io.sequencer.orbits import (
    begin_continuation,
    check_latency,
    decide_multiplier,
    decide_orbit,
)
from table_io.sequencer.state import SequencerState, Stage


def decide_after_check(state: SequencerState) -> SequencerState:
    """Start the excitation if the loop check passed, else end the test with a refusal."""
    plan, index = state.plan, state.stage.last
    block = join_blocks(state.blocks).cut(0, index)
    checks, response = loop_check.evaluate(block, state.drive, plan.profile, plan.rig, state.noise)
    records: list[Record] = [replace(check, index=index) for check in checks]
    failed = [check for check in checks if not check.passed]
    if response is not None:
        records.append(replace(response, index=index))
    reason = "; ".join(_format_failure(check) for check in failed)
    if not failed and response is not None and plan.profile.control.enabled:
        reason = "; ".join(check_corrected_drive(state.steps, response, plan.rig))
    if reason:
        reason = f"the loop check failed: {reason}"
    elif plan.profile.continuation is not None:
        reason = check_latency(replace(state, tuning=Tuning(response)))
    if reason:
        return replace(
            state, stage=Stage("end"), refusal=reason, records=(*state.records, *records)
        )
    tuning = Tuning(response)
    state = replace(state, tuning=tuning, records=(*state.records, *records))
    if plan.profile.continuation is not None:
        return begin_continuation(state)
    return begin_excitation(state)


def _format_failure(check: Check) -> str:
    value = f"{check.value:.4g} {check.unit}".rstrip()
    return f"{check.name} of {check.channel} is {value} ({loop_check.find_remedy(check)})"


def decide_tuning(state: SequencerState) -> SequencerState:
    """Evaluate the level of a step: accept it, or correct the command and tune again."""
    stage, config = state.stage, state.plan.profile.control
    target = state.trajectory.target
    measured = _track_channel(state, "table_acc_m_s2")
    first = stage.first_fit if stage.update else measured
    max_updates = config.harmonic_updates if config.harmonics else config.updates
    is_measured = np.isfinite(measured.fundamental)
    new_target = (
        update_target(target, measured, first, state.tuning, config)
        if is_measured and stage.update < max_updates
        else target
    )
    level = Level(
        stage.last,
        state.steps[stage.step].index,
        target.level_m_s2,
        measured.fundamental,
        target.correction,
        stage.update,
        new_target == target,
        tuple(float(abs(amplitude)) for amplitude in measured.amplitudes[1:5]),
    )
    state = replace(state, records=(*state.records, level))
    if new_target == target:
        if not is_measured or not is_within_tolerance(target, measured, config):
            text = (
                f"step {level.step}: {level.measured_m_s2:.4g} m/s2 after {stage.update} updates, "
                f"demanded {level.demanded_m_s2:.4g} m/s2 +-{100 * config.tolerance:g} %"
            )
            state = replace(state, records=(*state.records, Event(stage.last, "level", text)))
        return accept_level(replace(state, tuning=state.tuning.add_accepted(target)))
    blend_cycles = state.plan.profile.sweep.blend_cycles
    trajectory = state.trajectory.append_blend(new_target, level.step, blend_cycles, Label.BLEND)
    state = replace(state, trajectory=trajectory, changed_from=state.trajectory.end)
    return start_tuning(state, replace(stage, update=stage.update + 1, first_fit=first))


def accept_level(state: SequencerState) -> SequencerState:
    """Measure the step at the accepted level, then approach the next step if it is known."""
    position, changed = state.stage.step, state.trajectory.end
    state = replace(measure_step(state, position), changed_from=changed)
    if state.stage.kind == "end" and position + 1 < len(state.steps):
        state = replace(approach_step(state, position + 1), changed_from=changed)
    return state


def decide_next_step(state: SequencerState) -> SequencerState:
    """Ask the adaptive policy for the next step after the measured cycles."""
    stage, policy = state.stage, state.plan.policy
    assert policy is not None
    step = state.steps[stage.step]
    u, phase = _select_window(state, "rel_disp")
    result = StepResult(
        step,
        _track_channel(state, "table_acc_m_s2"),
        _track_channel(state, "rel_disp"),
        _track_channel(state, "mass_acc_m_s2"),
        mean_swing(u, phase),
    )
    previous = tuple(earlier for earlier in state.results if earlier.step != step)
    state = replace(state, results=(*previous, result))
    decision = policy(state.results)
    if isinstance(decision, Decision):
        step = Step(
            len(state.steps), decision.direction, decision.frequency_hz, step.acceleration_m_s2
        )
        added = StepAdded(
            stage.last,
            step.index,
            step.direction,
            step.frequency_hz,
            step.acceleration_m_s2,
            decision.reason,
        )
        state = replace(state, steps=(*state.steps, step), records=(*state.records, added))
        return approach_step(state, step.index)
    if decision is None and stage.step + 1 < len(state.steps):
        return approach_step(state, stage.step + 1)
    if decision is not None:
        state = replace(state, records=(*state.records, Event(stage.last, "found", decision)))
    return replace(state, stage=Stage("end"))


def _select_window(state: SequencerState, channel: str) -> tuple[Float1D, Float1D]:
    """Return (values, drive phase in cycles) over the stage's window; empty without the channel."""
    stage = state.stage
    block = join_blocks(
        [
            past_block
            for past_block in state.blocks
            if past_block.end > stage.first and past_block.index < stage.last
        ]
    )
    window = block.cut(stage.first, stage.last)
    if channel == "rel_disp":
        values = relative_displacement(window)
    elif channel in window.channels:
        values = window.channel(channel)
    else:
        return np.empty(0), np.empty(0)
    return values, state.drive.phase(stage.first, stage.last - stage.first)


def _track_channel(state: SequencerState, channel: str) -> HarmonicFit:
    """Fit the harmonics of a channel over the stage's window; all NaN without the channel."""
    return track_harmonics(*_select_window(state, channel), HARMONIC_COUNT)


DECISION_FUNCTIONS: dict[str, Callable[[SequencerState], SequencerState]] = {
    "check": decide_after_check,
    "tune": decide_tuning,
    "hold": decide_next_step,
    "orbit": decide_orbit,
    "release": decide_multiplier,
}
