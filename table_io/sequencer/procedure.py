"""Test procedure: runs the loop check, then tunes and measures each step, or plays a history.

The state is an immutable value. `advance_test(state, block)` adds measured samples; at fixed
samples it evaluates whole cycles and decides, and the decision changes the command `margin` samples
later. The same samples therefore give the same command however they are cut into blocks. The table
never waits for a decision: the drive always continues as if the level were accepted, and always
ends at rest.

    check --(passes)--> tune --(level accepted)---> hold, then tune at the next step, ...
                        tune --(not accepted)-----> blend to the corrected level, tune again
                        hold --(policy decides)---> the next step, or the end
    check --(passes)--> orbit, evaluated and corrected, then release: a continuation (`orbits.py`)
    check --(passes)--> sweep, updated part by part: a swept sine (`swept_sine.py`)
    check --(passes)--> the end, with a displacement history played as it is, if that is the test
    open: the operator holds the test at its step; on resume the step is tuned and measured again.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from table_io.adaptive.policy import make_policy
from table_io.adaptive.result import Decision, StepResult
from table_io.block import Block, Float1D, Label, join_blocks
from table_io.channels import relative_displacement
from table_io.config.excitation.continuation import Continuation
from table_io.config.profile import Profile, check_limited_channels
from table_io.config.rig import RigConfig
from table_io.control.amplitude_control import Tuning, is_within_tolerance, update_target
from table_io.errors import InputError
from table_io.excitation.drive import Drive, Segment
from table_io.excitation.trajectory import (
    SineTarget,
    Trajectory,
    append_whole_sweep,
    cycles_to_samples,
    start_trajectory,
)
from table_io.harmonics import HARMONIC_COUNT, HarmonicFit, mean_swing, track_harmonics
from table_io.records import Check, Event, Level, Record, Step, StepAdded
from table_io.safety import loop_check
from table_io.safety.preflight import check_corrected_drive, find_correction_room
from table_io.sequencer.orbits import (
    apply_feedback,
    begin_continuation,
    check_latency,
    decide_multiplier,
    decide_orbit,
    resume_continuation,
)
from table_io.sequencer.state import MAX_HOLD_S, SequencerState, Stage, TestPlan
from table_io.sequencer.swept_sine import (
    begin_swept_sine,
    check_swept_channels,
    decide_sweep_level,
    hold_sweep,
    resume_sweep,
)

MIN_TUNING_WINDOW_S = 0.3  # shortest evaluation window, rounded up to whole cycles
MIN_SETTLE_S = 0.3  # from a blend to the window; at least one cycle


def begin_excitation(state: SequencerState) -> SequencerState:
    """Approach the first step, begin a swept sine, or play the displacement history to its end."""
    profile = state.plan.profile
    if state.steps:
        return approach_step(state, profile.first_step)
    if profile.swept_sine is not None:
        return begin_swept_sine(state)
    plan = profile.plan
    trajectory = state.trajectory.append_history(plan.history_m, plan.windows)
    return replace(state, trajectory=trajectory, drive=trajectory.to_drive(()), stage=Stage("end"))


def approach_step(state: SequencerState, position: int) -> SequencerState:
    """Blend to the step at `position` and tune there; without control, measure it at once."""
    profile = state.plan.profile
    while True:
        step = state.steps[position]
        target = (
            state.tuning.predict_target(step) if profile.control.enabled else _nominal_target(step)
        )
        trajectory = state.trajectory.append_blend(
            target, step.index, profile.sweep.blend_cycles, Label.BLEND
        )
        state = replace(state, trajectory=trajectory)
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


def decide_after_check(state: SequencerState) -> SequencerState:
    """Start the excitation if the loop check passed, else end the test with a refusal."""
    plan, index = state.plan, state.stage.last
    block = join_blocks(state.blocks).cut(0, index)
    checks, response = loop_check.evaluate(
        block, state.drive, plan.profile, plan.rig, state.noise, state.preload_n
    )
    records = loop_check.list_check_records(checks, index)
    failed = [check for check in checks if not check.passed]
    if response is not None:
        records.append(replace(response, index=index))
    tuning = replace(state.tuning, response=response)
    reason = "; ".join(_format_failure(check) for check in failed)
    is_corrected = plan.profile.control.enabled or plan.profile.continuation is not None
    if not failed and response is not None and is_corrected:
        reason = "; ".join(check_corrected_drive(plan.profile, state.steps, response, plan.rig))
    if reason:
        reason = f"the loop check failed: {reason}"
    elif plan.profile.continuation is not None:
        reason = check_latency(replace(state, tuning=tuning))
    if reason:
        return replace(
            state, stage=Stage("end"), refusal=reason, records=(*state.records, *records)
        )
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
    return start_tuning(
        replace(state, trajectory=trajectory),
        replace(stage, update=stage.update + 1, first_fit=first),
    )


def accept_level(state: SequencerState) -> SequencerState:
    """Measure the step at the accepted level, then approach the next step if it is known."""
    position = state.stage.step
    state = measure_step(state, position)
    if state.stage.kind == "end" and position + 1 < len(state.steps):
        return approach_step(state, position + 1)
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
    "sweep": decide_sweep_level,
}

DECISION_HORIZON_S = 0.25  # from an evaluation to the change of the command; a block is shorter
FEEDBACK_HORIZON_S = 0.01  # from a block to its correction: to compute it, to transfer it, jitter


def make_test_plan(profile: Profile, rig: RigConfig, replace_after: int = 0) -> TestPlan:
    """Return the plan of a test on a backend that can change samples `replace_after` ahead."""
    rate = profile.acquisition.rate_hz
    horizon = max(math.ceil(DECISION_HORIZON_S * rate), profile.acquisition.block_samples)
    feedback_horizon = replace_after + math.ceil(FEEDBACK_HORIZON_S * rate)
    check_limited_channels(profile.limits, rig)
    if profile.swept_sine is not None:
        check_swept_channels(profile.swept_sine, rig)
    if profile.continuation is not None:
        _check_horizon(profile.continuation, rig, feedback_horizon / rate)
        _check_sensors(rig)
    return TestPlan(
        profile, rig, replace_after + horizon + 1, make_policy(profile), feedback_horizon
    )


def find_lag_ms(config: Continuation, rig: RigConfig) -> float:
    """Return the lag of the table in ms that the gains of a feedback allow for."""
    return rig.table_response.lag_ms if config.table_lag_ms is None else config.table_lag_ms


def _check_horizon(config: Continuation, rig: RigConfig, horizon_s: float) -> None:
    """Raise InputError if the feedback comes too late with the stated lag of the table."""
    plan = config.orbit_plan
    lag_ms, allowed_s = find_lag_ms(config, rig), plan.latency_s + plan.jitter_s
    latency_s = horizon_s + 1e-3 * lag_ms
    if latency_s > allowed_s:
        raise InputError(
            f"the table answers {1e3 * latency_s:.1f} ms after a block at the soonest: "
            f"{1e3 * horizon_s:.1f} ms until its command can change and a lag of "
            f"{lag_ms:g} ms",
            where="continuation",
            key="latency_s",
            value=plan.latency_s,
            allowed=f"at most {1e3 * allowed_s:.1f} ms, for which the orbit plan was made",
            remedy="use a rig whose queue can be replaced later, or make the plan for this one",
        )


def _check_sensors(rig: RigConfig) -> None:
    """Raise InputError if the rig does not measure the displacement of the mass."""
    names = set(rig.channels)
    if not ("mass_disp_m" in names or {"rel_disp_m", "table_disp_m"} <= names):
        raise InputError(
            "the displacement of the mass is not measured, but the feedback needs it",
            where=f"rig {rig.name}",
            key="sensors",
            allowed="mass_disp_m, or rel_disp_m with table_disp_m",
        )


def start_test(plan: TestPlan) -> SequencerState:
    """Return the state of a test at rest; a loop check comes first if the profile enables it."""
    profile = plan.profile
    trajectory, steps = start_trajectory(profile), profile.steps
    blend_cycles = profile.plan.blend_cycles
    targets = loop_check.plan_targets(profile, plan.rig) if profile.loop_check.enabled else ()
    tuning = Tuning(
        max_correction=plan.rig.table_response.max_correction,
        find_room=partial(find_correction_room, profile, plan.rig),
    )
    if not targets:
        initial = SequencerState(
            plan, trajectory, trajectory.to_drive(steps), Stage("end"), steps, tuning
        )
        begin = begin_continuation if profile.continuation is not None else begin_excitation
        return begin(initial)
    for target in targets:
        trajectory = trajectory.append_blend(target, -1, blend_cycles, Label.BLEND)
        cycles = loop_check.count_hold_cycles(target, profile)
        count = math.ceil(cycles * trajectory.rate_hz / target.frequency_hz)
        trajectory = trajectory.append_hold(count, -1, Label.CHECK)
    trajectory = trajectory.append_blend(
        replace(trajectory.target, level_m_s2=0.0), -1, blend_cycles, Label.BLEND
    )
    trajectory = trajectory.append_rest(
        math.ceil(profile.loop_check.rest_s * trajectory.rate_hz) + plan.margin
    )
    stage = Stage("check", -1, 0, trajectory.end - plan.margin)
    return SequencerState(plan, trajectory, trajectory.to_drive(steps), stage, steps, tuning)


def advance_test(state: SequencerState, block: Block) -> tuple[SequencerState, tuple[Record, ...]]:
    """Return (state, new records) after a measured block; blocks must come in order."""
    return answer_block(decide_block(state, block), block, 0)


def decide_block(state: SequencerState, block: Block) -> SequencerState:
    """Return the state after the decisions that a measured block makes due, without feedback."""
    state = replace(state.mark_queued(), blocks=(*state.blocks, block), records=())
    while state.stage.kind in DECISION_FUNCTIONS and state.stage.last <= block.end:
        state = DECISION_FUNCTIONS[state.stage.kind](state)
    return state


def answer_block(
    state: SequencerState, block: Block, earliest: int
) -> tuple[SequencerState, tuple[Record, ...]]:
    """Return (state, new records) with the feedback's answer to a block that was decided on."""
    if state.search is not None:
        state = apply_feedback(state, block, earliest)
    if state.stage.kind in ("open", "end"):  # nothing is evaluated; a hold may last for an hour
        return replace(state, blocks=(), records=()), state.records
    blocks = state.blocks
    while blocks and blocks[0].end <= state.stage.first:
        blocks = blocks[1:]
    return replace(state, blocks=blocks, records=()), state.records


def hold_test(state: SequencerState, index: int) -> SequencerState:
    """Hold the step or frequency at sample `index`; return the state unchanged without one."""
    if state.stage.kind == "sweep":
        return hold_sweep(state, index)
    if not state.steps or state.stage.kind in ("check", "open") or index >= state.drive.planned_end:
        return state
    trajectory = state.mark_queued().trajectory.cut(index)
    last = trajectory.segments[-1] if trajectory.segments else None
    if trajectory.end < index or not isinstance(last, Segment) or last.step < 0:
        return state  # the drive is already ending, or the sweep has not begun
    return hold_step(replace(state.mark_queued(), trajectory=trajectory), last.step)


def resume_test(state: SequencerState, index: int) -> SequencerState:
    """Resume from a hold: tune and measure the step again, or go on with the sweep."""
    if state.sweep is not None:
        return resume_sweep(state, index)
    if state.stage.kind != "open":
        return state
    state = state.mark_queued()
    state = replace(state, trajectory=state.trajectory.cut(index))
    if state.search is not None:
        return resume_continuation(state)
    return approach_step(state, state.stage.step)


def nominal_drive(plan: TestPlan) -> Drive:
    """Return the nominal drive: every level accepted at once and no operator command."""
    state = start_test(plan)
    while not state.is_finished:
        if plan.profile.swept_sine is not None:
            is_checked = state.stage.kind == "check"
            trajectory = state.trajectory if is_checked else start_trajectory(plan.profile)
            return append_whole_sweep(trajectory, plan.profile.swept_sine).to_drive(())
        if state.stage.kind == "check" and plan.profile.continuation is not None:
            state = begin_continuation(state)
        elif state.stage.kind == "check":
            state = begin_excitation(state)
        elif state.stage.kind == "tune":
            state = accept_level(state)
        elif state.stage.kind == "orbit":
            state = replace(state, stage=Stage("end"))  # the others depend on what is measured
        elif state.stage.step + 1 < len(state.steps):
            state = approach_step(state, state.stage.step + 1)
        else:
            state = replace(state, stage=Stage("end"))  # a policy needs measured results
    return state.drive
