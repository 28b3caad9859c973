"""Test sequencer: runs the loop check, then tunes and measures each step, or plays a history.

The state is an immutable value. `advance_test(state, block)` adds measured samples; at fixed
samples it evaluates whole cycles and decides, and the decision changes the command `margin` samples
later. The same samples therefore give the same command however they are cut into blocks. The table
never waits for a decision: the drive always continues as if the level were accepted, and always
ends at rest.

    check --(passes)--> tune --(level accepted)---> hold, then tune at the next step, ...
                        tune --(not accepted)-----> blend to the corrected level, tune again
                        hold --(policy decides)---> the next step, or the end
    check --(passes)--> orbit, evaluated and corrected, then release: a continuation (`orbits.py`)
    check --(passes)--> the end, with a displacement history played as it is, if that is the test
    open: the operator holds the test at its step; on resume the step is tuned and measured again.
"""

import math
from dataclasses import replace

from table_io.adaptive.policy import make_policy
from table_io.block import Block, Label
from table_io.config.excitation.continuation import Continuation
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.excitation.drive import Drive, Segment
from table_io.excitation.trajectory import start_trajectory
from table_io.records import Record
from table_io.safety import loop_check
from table_io.sequencer.actions import approach_step, begin_excitation, hold_step
from table_io.sequencer.decisions import DECISION_FUNCTIONS, accept_level
from table_io.sequencer.orbits import apply_feedback, begin_continuation, resume_continuation
from table_io.sequencer.state import SequencerState, Stage, TestPlan

__all__ = [
    "SequencerState", "Stage", "TestPlan", "advance_test", "answer_block", "decide_block",
    "hold_test", "make_test_plan", "nominal_drive", "resume_test", "start_test",
]  # fmt: skip

DECISION_HORIZON_S = 0.25  # from an evaluation to the change of the command; a block is shorter
FEEDBACK_HORIZON_S = 0.01  # from a block to its correction: to compute it, to transfer it, jitter


def make_test_plan(profile: Profile, rig: RigConfig, replace_after: int = 0) -> TestPlan:
    """Return the plan of a test on a backend that can change samples `replace_after` ahead."""
    rate = profile.acquisition.rate_hz
    horizon = max(math.ceil(DECISION_HORIZON_S * rate), profile.acquisition.block_samples)
    feedback_horizon = replace_after + math.ceil(FEEDBACK_HORIZON_S * rate)
    if profile.continuation is not None:
        _check_horizon(profile.continuation, feedback_horizon / rate)
        _check_sensors(rig)
    return TestPlan(
        profile, rig, replace_after + horizon + 1, make_policy(profile), feedback_horizon
    )


def _check_horizon(config: Continuation, horizon_s: float) -> None:
    """Raise InputError if the feedback comes too late with the stated lag of the table."""
    plan = config.orbit_plan
    latency_s, allowed_s = horizon_s + 1e-3 * config.table_lag_ms, plan.latency_s + plan.jitter_s
    if latency_s > allowed_s:
        raise InputError(
            f"the table answers {1e3 * latency_s:.1f} ms after a block at the soonest: "
            f"{1e3 * horizon_s:.1f} ms until its command can change and a lag of "
            f"{config.table_lag_ms:g} ms",
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
    if not targets:
        initial = SequencerState(plan, trajectory, trajectory.to_drive(steps), Stage("end"), steps)
        begin = begin_continuation if profile.continuation is not None else begin_excitation
        return replace(begin(initial), changed_from=0)
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
    return SequencerState(plan, trajectory, trajectory.to_drive(steps), stage, steps)


def advance_test(
    state: SequencerState, block: Block, earliest: int = 0
) -> tuple[SequencerState, tuple[Record, ...]]:
    """Return (state, new records) after a measured block; blocks must come in order.

    A feedback changes the command from sample `earliest` on at the soonest.
    """
    return answer_block(decide_block(state, block), block, earliest)


def decide_block(state: SequencerState, block: Block) -> SequencerState:
    """Return the state after the decisions that a measured block makes due, without feedback."""
    drive = state.drive
    state = replace(state, blocks=(*state.blocks, block), records=())
    while state.stage.kind in DECISION_FUNCTIONS and state.stage.last <= block.end:
        state = DECISION_FUNCTIONS[state.stage.kind](state)
    if state.search is not None and state.drive is drive:
        state = replace(state, changed_from=state.drive.planned_end)
    return state


def answer_block(
    state: SequencerState, block: Block, earliest: int
) -> tuple[SequencerState, tuple[Record, ...]]:
    """Return (state, new records) with the feedback's answer to a block that was decided on."""
    if state.search is not None:
        state = apply_feedback(state, block, earliest)
    if state.stage.kind in ("open", "end"):  # nothing is evaluated; a hold may last for an hour
        return replace(state, blocks=(), records=()), state.records
    blocks = tuple(kept_block for kept_block in state.blocks if kept_block.end > state.stage.first)
    return replace(state, blocks=blocks, records=()), state.records


def hold_test(state: SequencerState, index: int) -> SequencerState:
    """Hold the step that contains sample `index`; return the state unchanged without one."""
    if not state.steps or state.stage.kind in ("check", "open") or index >= state.drive.planned_end:
        return state
    trajectory = state.trajectory.cut(index)
    last = trajectory.segments[-1] if trajectory.segments else None
    if trajectory.end < index or not isinstance(last, Segment) or last.step < 0:
        return state  # the drive is already ending, or the sweep has not begun
    return hold_step(replace(state, trajectory=trajectory, changed_from=trajectory.end), last.step)


def resume_test(state: SequencerState, index: int) -> SequencerState:
    """Resume from a hold: tune and measure the step again."""
    if state.stage.kind != "open":
        return state
    state = replace(state, trajectory=state.trajectory.cut(index))
    if state.search is not None:
        return resume_continuation(state)
    return replace(approach_step(state, state.stage.step), changed_from=index)


def nominal_drive(plan: TestPlan) -> Drive:
    """Return the nominal drive: every level accepted at once and no operator command."""
    state = start_test(plan)
    while not state.is_finished:
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
