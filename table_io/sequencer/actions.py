"""Actions of the sequencer: approach a step, tune its level, measure it, hold it."""

import math
from dataclasses import replace

from table_io.block import Label
from table_io.config.profile import Profile
from table_io.excitation.trajectory import SineTarget, Trajectory, cycles_to_samples
from table_io.records import Step
from table_io.sequencer.state import SequencerState, Stage

MIN_TUNING_WINDOW_S = 0.3  # shortest evaluation window, rounded up to whole cycles
MIN_SETTLE_S = 0.3  # from a blend to the window; at least one cycle
MAX_HOLD_S = 3600.0  # an operator's hold times out after this


def begin_excitation(state: SequencerState) -> SequencerState:
    """Approach the first step, or play the displacement history to its end."""
    profile, changed = state.plan.profile, state.trajectory.end
    if state.steps:
        return approach_step(state, profile.first_step)
    plan = profile.plan
    trajectory = state.trajectory.append_history(plan.history_m, plan.windows)
    return replace(
        state,
        trajectory=trajectory,
        drive=trajectory.to_drive(()),
        stage=Stage("end"),
        changed_from=changed,
    )


def approach_step(state: SequencerState, position: int) -> SequencerState:
    """Blend to the step at `position` and tune there; without control, measure it at once."""
    profile, changed = state.plan.profile, state.trajectory.end
    while True:
        step = state.steps[position]
        target = (
            state.tuning.predict_target(step) if profile.control.enabled else _nominal_target(step)
        )
        trajectory = state.trajectory.append_blend(
            target, step.index, profile.sweep.blend_cycles, Label.BLEND
        )
        state = replace(state, trajectory=trajectory, changed_from=changed)
        if profile.control.enabled:
            return start_tuning(state, Stage("tune", position))
        state = measure_step(state, position)
        if state.stage.kind == "hold" or position + 1 == len(state.steps):
            return state
        position += 1


def _nominal_target(step: Step) -> SineTarget:
    return SineTarget(step.frequency_hz, step.acceleration_m_s2)


def start_tuning(state: SequencerState, stage: Stage) -> SequencerState:
    """Hold the step for one level evaluation; the measured cycles follow if it is accepted."""
    trajectory, rate_hz = state.trajectory, state.trajectory.rate_hz
    frequency_hz = trajectory.target.frequency_hz
    first = trajectory.end + math.ceil(max(rate_hz / frequency_hz, MIN_SETTLE_S * rate_hz))
    last = first + math.ceil(
        max(math.ceil(MIN_TUNING_WINDOW_S * frequency_hz), 1) * rate_hz / frequency_hz
    )
    step = state.steps[stage.step]
    trajectory = trajectory.append_hold(
        last + state.plan.margin - trajectory.end, step.index, Label.SETTLE
    )
    stage = replace(stage, first=first, last=last)
    drive = _append_measured_cycles(trajectory, step, state.plan.profile).to_drive(state.steps)
    return replace(state, trajectory=trajectory, drive=drive, stage=stage)


def _append_measured_cycles(trajectory: Trajectory, step: Step, profile: Profile) -> Trajectory:
    """Return the trajectory with the held cycles of a step appended."""
    sweep = profile.sweep
    count = cycles_to_samples(step, sweep.cycles, trajectory.rate_hz)
    settle = sweep.cycles - sweep.measured_cycles
    return trajectory.append_hold(count, step.index, Label.MEASURE, sweep.cycles, settle)


def measure_step(state: SequencerState, position: int) -> SequencerState:
    """Measure the step; a policy then evaluates it, or the drive ends here."""
    step, sweep = state.steps[position], state.plan.profile.sweep
    first = state.trajectory.end
    trajectory = _append_measured_cycles(state.trajectory, step, state.plan.profile)
    stage = Stage("end")
    if state.plan.policy is not None:
        settle = cycles_to_samples(step, sweep.cycles - sweep.measured_cycles, trajectory.rate_hz)
        stage = Stage("hold", position, first + settle, trajectory.end)
        trajectory = trajectory.append_hold(state.plan.margin, step.index, Label.SETTLE)
    return replace(
        state, trajectory=trajectory, drive=trajectory.to_drive(state.steps), stage=stage
    )


def hold_step(state: SequencerState, step: int) -> SequencerState:
    """Hold the current motion until the operator resumes or stops, for `MAX_HOLD_S` at most."""
    position = next(
        position for position, step_at in enumerate(state.steps) if step_at.index == step
    )
    count = round(MAX_HOLD_S * state.trajectory.rate_hz)
    trajectory = state.trajectory.append_hold(count, step, Label.SETTLE)
    return replace(
        state,
        trajectory=trajectory,
        drive=replace(trajectory.to_drive(state.steps), correction=state.drive.correction),
        stage=Stage("open", position),
    )
