"""Continuation in the sequencer: hold, evaluate and correct each orbit; retry where it is lost.

    approach --> hold --(window complete)--> update of the reference, hold again, ...
                                       |---> accepted --> release (`releases.py`): the next point
                                       `---> updates used up: the next point
    lost --> decay to rest, capture of the first orbit, along the measured ones to this point, or
             to the next one when its retries are used up
    last point, three in a row or all so far lost --> the end, with the feedback blended out

The feedback acts on every block (`control/orbit_feedback.py`); what is decided here are its
references, ahead of time, like every other change of the drive.
"""

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from table_io.adaptive.continuation import (
    MeasuredOrbit,
    OrbitMeasurement,
    OrbitTarget,
    correct_target,
    find_feedback_motion,
    fundamental,
    is_on_branch,
    measure_phase,
    plan_target,
    planned_reference,
    rotate_harmonics,
    table_harmonics,
)
from table_io.block import Block, Float1D, Label, join_blocks
from table_io.channels import measure_mass, relative_displacement
from table_io.config.excitation.continuation import (
    CAPTURE_CYCLES,
    UPDATE_BLEND_CYCLES,
    Continuation,
    OrbitPlan,
    pack_harmonics,
    unpack_harmonics,
)
from table_io.control.orbit_feedback import (
    MAX_COMMAND_RATIO,
    FeedbackState,
    ReferenceSegment,
    advance_feedback,
    evaluate_harmonics,
)
from table_io.control.table_response import evaluate_transfer
from table_io.excitation.trajectory import SineTarget, Trajectory
from table_io.harmonics import HarmonicFit, estimate_harmonic_error, mean_swing, track_harmonics
from table_io.records import Event, FrequencyResponse, OrbitPoint
from table_io.sequencer.releases import (
    advance_releases,
    end_releases,
    estimate_from_releases,
    find_departure_limit,
)
from table_io.sequencer.state import OrbitSearch, ReleaseSeries, SequencerState, Stage

RELEASE_S = 0.1  # of the feedback when an orbit is lost, or when it begins to act
REST_S = 4.0  # until the motion has decayed, before an orbit is captured again
MAX_SATURATED_CYCLES = 2.0  # at the limit of the feedback: the orbit is lost
MAX_DEVIATION = 0.25  # of the amplitude of u from the reference: the orbit is lost
PHASE_TOLERANCE_DEG = 1.0  # of phase resonance
LEVEL_TOLERANCE = 0.003  # of the fundamental of the table's acceleration
MAX_LEVEL_FACTOR = 1.25  # of the command in one update
LATENCY_TOLERANCE_S = 0.003  # of the measured latency, beyond that of the plan
MAX_LOST_POINTS = 3  # in a row, before the test ends
NOISE_FACTOR = 1.5  # accepted feedback over its standard error by the scatter between cycles


class Waypoint(NamedTuple):
    """Orbit on the way to the sought one: reference, frequency, planned point, feedback's share.

    Where rest leads to no other solution the share is 0: a feedback at its limit would hold the
    motion off the orbit.
    """

    reference: Float1D
    frequency_hz: float
    step: int
    share: float = 1.0


def begin_continuation(state: SequencerState) -> SequencerState:
    """Capture the first orbit from rest."""
    config, response = _config(state), state.tuning.response
    plan = config.orbit_plan
    target = plan_target(plan, 0, ())
    records = state.records
    if response is not None:
        timing = (
            f"the table answers {1e3 * measure_latency(state):.1f} ms after a block; the gains are "
            f"for {1e3 * plan.latency_s:.1f} ms and a jitter of {1e3 * plan.jitter_s:g} ms"
        )
        records = (*records, Event(state.stage.last, "feedback", timing))
    search = OrbitSearch(
        FeedbackState(state.plan.feedback_horizon),
        target,
        (),
        since=state.trajectory.end,
    )
    state = replace(state, search=search, records=records)
    return _approach(state, state.trajectory, _list_leads(plan), CAPTURE_CYCLES)


def _list_leads(plan: OrbitPlan) -> tuple[Waypoint, ...]:
    """Return the orbits that lead from rest to the first point, as they are planned."""
    return tuple(
        Waypoint(planned_reference(orbit), orbit.frequency_hz, 0, 0.0) for orbit in plan.leads
    )


def measure_latency(state: SequencerState) -> float:
    """Return the latency in s from the end of a block to the table's answer; NaN if not known.

    It is that of the feedback's horizon and of the table that the loop check measured.
    """
    response = state.tuning.response
    if response is None:
        return math.nan
    lag_s = _find_lag(response, _config(state).orbit_plan.points[0].frequency_hz)
    return state.plan.feedback_horizon / state.trajectory.rate_hz + lag_s


def check_latency(state: SequencerState) -> str:
    """Return why the table answers too late for the plan of the orbits; "" if it does not."""
    plan, latency_s = _config(state).orbit_plan, measure_latency(state)
    allowed_s = plan.latency_s + plan.jitter_s + LATENCY_TOLERANCE_S
    if not latency_s > allowed_s:
        return ""
    lag_s = latency_s - state.plan.feedback_horizon / state.trajectory.rate_hz
    return (
        f"the latency of the feedback is {1e3 * latency_s:.1f} ms, its gains are for at most "
        f"{1e3 * allowed_s:.1f} ms: the table lags by {1e3 * lag_s:.1f} ms, state it as "
        f"table_response.lag_ms = {math.ceil(1e3 * lag_s)} in the rig file, for which the orbit "
        "plan is then computed"
    )


def _find_lag(response: FrequencyResponse, frequency_hz: float) -> float:
    """Return the lag in s of the table behind its command."""
    transfer = evaluate_transfer(response, frequency_hz)
    return -math.atan2(transfer.imag, transfer.real) / (2 * math.pi * frequency_hz)


def _find_table_lag(state: SequencerState, frequency_hz: float) -> float:
    """Return the lag in s of the table behind its command, as the last orbit corrected it."""
    response, change_s = state.tuning.response, _search(state).lag_change_s
    return change_s if response is None else change_s + _find_lag(response, frequency_hz)


def _correct_sine(
    state: SequencerState, frequency_hz: float, level_m_s2: float, level_factor: float
) -> SineTarget:
    """Return a sine whose command gives so many times the level, within its limits."""
    correction = level_factor / abs(state.tuning.transfer(frequency_hz))
    return state.tuning.correct(SineTarget(frequency_hz, level_m_s2), correction)


def _config(state: SequencerState) -> Continuation:
    config = state.plan.profile.continuation
    assert config is not None
    return config


def _approach(
    state: SequencerState,
    trajectory: Trajectory,
    waypoints: tuple[Waypoint, ...],
    capture_cycles: float = 0.0,
    blend_cycles: float | None = None,
) -> SequencerState:
    """Blend through other orbits to the target, and hold it for one evaluation.

    capture_cycles: held at the first of them. The periods of a point count from the last blend
    on, without a capture.
    """
    search, config = _search(state), _config(state)
    target, position = search.target, search.target.position
    feedback, since = search.feedback, search.since
    for waypoint in (*waypoints, Waypoint(target.reference, target.frequency_hz, position)):
        since = trajectory.end if waypoints else since
        trajectory, feedback = _append_orbit(
            state, trajectory, feedback, waypoint,
            config.blend_cycles if blend_cycles is None else blend_cycles,
        )  # fmt: skip
        if capture_cycles:
            trajectory = _append_cycles(trajectory, capture_cycles, waypoint.step)
            since = trajectory.end
            capture_cycles = 0.0
    rate_hz, cycle = trajectory.rate_hz, trajectory.rate_hz / target.frequency_hz
    first = trajectory.end + math.ceil(config.settle_cycles * cycle)
    last = first + math.ceil(config.measured_cycles * cycle)
    trajectory = trajectory.append_hold(
        last + state.plan.margin - trajectory.end, position, Label.SETTLE
    )
    assert trajectory.rate_hz == rate_hz
    return replace(
        state,
        trajectory=trajectory,
        drive=replace(trajectory.to_drive(state.steps), correction=state.drive.correction),
        stage=Stage("orbit", position, first, last, target.update),
        search=replace(search, feedback=feedback, since=since),
    )


def _append_cycles(trajectory: Trajectory, cycles: float, step: int) -> Trajectory:
    count = math.ceil(cycles * trajectory.rate_hz / trajectory.target.frequency_hz)
    return trajectory.append_hold(count, step, Label.SETTLE)


def _append_orbit(
    state: SequencerState,
    trajectory: Trajectory,
    feedback: FeedbackState,
    waypoint: Waypoint,
    blend_cycles: float,
) -> tuple[Trajectory, FeedbackState]:
    """Return the trajectory and the references with a blend to an orbit appended."""
    config = _config(state)
    reference, frequency_hz, step, share = waypoint
    if feedback.segments and trajectory.target.level_m_s2 and feedback.segments[-1].share1 < share:
        trajectory, feedback = _engage(trajectory, feedback, step, blend_cycles)
    orbit, start = config.orbit_plan.points[step], trajectory.end
    from_rest = trajectory.target.level_m_s2 == 0.0
    level_factor = _search(state).level_factor
    sine = _correct_sine(state, frequency_hz, orbit.acceleration_m_s2, level_factor)
    trajectory = trajectory.append_blend(sine, step, blend_cycles, Label.BLEND)
    count = math.ceil(blend_cycles * trajectory.rate_hz / frequency_hz)
    if not from_rest and trajectory.end - start < count:
        trajectory = trajectory.append_hold(count - trajectory.end + start, step, Label.BLEND)
    lag_s = _find_table_lag(state, frequency_hz)
    after = rotate_harmonics(reference, -2 * math.pi * frequency_hz * lag_s)
    command_m = sine.corrected_m_s2 / (2 * math.pi * frequency_hz) ** 2
    segment = ReferenceSegment(
        start,
        trajectory.end - start,
        np.zeros_like(after) if from_rest or not feedback.segments else feedback.segments[-1].after,
        after,
        0.0 if from_rest or not feedback.segments else feedback.segments[-1].share1,
        share,
        orbit.gain,
        orbit.rate_gain_s,
        config.max_feedback * command_m,
        MAX_COMMAND_RATIO * sine.corrected_m_s2,
    )
    return trajectory, feedback.append(segment)


def _engage(
    trajectory: Trajectory, feedback: FeedbackState, step: int, cycles: float
) -> tuple[Trajectory, FeedbackState]:
    """Return the trajectory held for some cycles, in which the feedback begins to act.

    At once: a part of the gain may be unstable where the whole gain and none are stable.
    """
    last = feedback.segments[-1]
    count = round(RELEASE_S * trajectory.rate_hz)
    engaged = replace(last, start=trajectory.end, count=count, before=last.after, share1=1.0)
    return _append_cycles(trajectory, cycles, step), feedback.append(engaged)


def resume_continuation(state: SequencerState) -> SequencerState:
    """Evaluate the sought orbit again after an operator's hold."""
    return _approach(state, state.trajectory, (), blend_cycles=UPDATE_BLEND_CYCLES)


def _search(state: SequencerState) -> OrbitSearch:
    assert state.search is not None
    return state.search


def apply_feedback(state: SequencerState, block: Block, earliest: int) -> SequencerState:
    """Return the state with the feedback's answer to a block, from `earliest` on at the soonest.

    An orbit that stays at the limit of the feedback is lost.
    """
    if state.stage.kind == "release":
        state = advance_releases(state, block)
    elif _search(state).releases is not None:  # the operator holds the test
        state = replace(state, search=end_releases(_search(state), block.end, state.drive.rate_hz))
    search, drive = _search(state), state.drive
    feedback, correction, first = advance_feedback(
        search.feedback, drive, block.index, measure_mass(block), earliest,
        min(state.stage.first, block.index) if state.stage.kind == "orbit" else block.index,
    )  # fmt: skip
    state = replace(
        state,
        search=replace(search, feedback=feedback),
        drive=replace(drive, correction=correction),
        corrected_from=first,
    )
    cycles = feedback.saturated_samples * search.target.frequency_hz / drive.rate_hz
    is_held = state.stage.kind in ("orbit", "release")
    if cycles > MAX_SATURATED_CYCLES and search.is_captured and is_held:
        return retry_orbit(state, block.end, "the feedback stayed at its limit")
    return state


def decide_orbit(state: SequencerState) -> SequencerState:
    """Evaluate the held orbit: accept it, correct its reference, or approach it again."""
    search, config, stage = _search(state), _config(state), state.stage
    plan, target = config.orbit_plan, search.target
    orbit = plan.points[target.position]
    window = join_blocks(
        [b for b in state.blocks if b.end > stage.first and b.index < stage.last]
    ).cut(stage.first, stage.last)
    phase = state.drive.phase(stage.first, stage.last - stage.first)
    table = track_harmonics(window.channel("table_acc_m_s2"), phase, plan.harmonics)
    u_m = relative_displacement(window)
    correction_m = state.drive.correction.displacement(stage.first, stage.last - stage.first)
    fits = [
        track_harmonics(values, phase, plan.harmonics)
        for values in (u_m, measure_mass(window), correction_m)
    ]
    if not all(np.isfinite(fit.residual_rms) for fit in (table, *fits)):
        return retry_orbit(state, stage.last, "samples were lost")
    response = _table_response(state.tuning.response, target.frequency_hz, plan.harmonics)
    # What the table would do without the feedback: its level and phase define the orbit.
    w = 2 * math.pi * target.frequency_hz
    nominal = complex(table.amplitudes[0] + w**2 * response[1] * fits[2].amplitudes[0])
    lag_angle = math.atan2(nominal.imag, nominal.real)
    lag_s = _find_table_lag(state, target.frequency_hz)
    late_s = -lag_angle / (2 * math.pi * target.frequency_hz) - lag_s
    played = rotate_harmonics(target.reference, 2 * math.pi * target.frequency_hz * late_s)
    target = replace(target, reference=played)
    u, x, feedback = (rotate_harmonics(_to_vector(fit), -lag_angle) for fit in fits)
    noise_m = estimate_harmonic_error(correction_m, phase, plan.harmonics)
    # A table that stands elsewhere moves the mass along: where it stands is no part of the orbit.
    place = np.append(feedback[0], np.zeros(feedback.size - 1))
    measured = OrbitMeasurement(u, x - place, feedback - place, response, noise_m)
    search = replace(
        search,
        lag_change_s=search.lag_change_s + late_s,
        target=target,
        is_captured=True,
        periods=search.periods
        + round((stage.last - search.since) * target.frequency_hz / window.rate_hz),
        since=stage.last,
    )
    deviation = fundamental(measured.x - target.reference)
    if deviation > MAX_DEVIATION * fundamental(orbit.harmonics_m):
        reason = (
            f"it is {1e3 * deviation:.2g} mm from its reference, of an amplitude of "
            f"{1e3 * fundamental(orbit.harmonics_m):.2g} mm"
        )
        return retry_orbit(replace(state, search=search), stage.last, reason)
    level_m_s2 = orbit.acceleration_m_s2
    sine = _correct_sine(state, target.frequency_hz, level_m_s2, search.level_factor)
    command_m = sine.corrected_m_s2 / w**2
    level_ratio = abs(nominal) / level_m_s2
    reason = _find_fault(config, target, measured, command_m, level_ratio)
    has_ended = not reason or target.update >= config.updates
    if has_ended:
        # What feedback within its noise or tolerance moves u by is known to the first order.
        moved = np.zeros_like(u) if reason else find_feedback_motion(orbit, measured)
        u = u - moved
        moved_m = evaluate_harmonics(moved, phase + lag_angle / math.tau)
        point = OrbitPoint(
            stage.last,
            target.position,
            target.frequency_hz,
            table.fundamental,
            mean_swing(u_m - moved_m, phase),
            tuple(np.array([u[0], 0.0, *u[1:]]).tolist()),
            tuple(np.abs(unpack_harmonics(feedback)).tolist()),
            noise_m,
            command_m,
            search.periods,
            target.update,
            orbit.stable,
            math.nan,
            not reason,
            reason,
        )
        if not reason:
            accepted = MeasuredOrbit(target.position, measured.x, target.frequency_hz)
            search = replace(search, measured=(*search.measured, accepted), losses=0, lost_points=0)
            if config.multiplier_periods:
                motion = _to_vector(fits[1])
                return _begin_releases(replace(state, search=search), point, motion)
        state = replace(state, search=search, records=(*state.records, point))
        return _next_orbit(state)
    return _correct_orbit(replace(state, search=search), measured, nominal)


def _correct_orbit(
    state: SequencerState, measured: OrbitMeasurement, nominal: complex
) -> SequencerState:
    """Correct reference and level of an orbit, and approach it again.

    `nominal` is the fundamental of the table's acceleration in m/s2 without the feedback.
    """
    search, plan = _search(state), _config(state).orbit_plan
    target, level_m_s2 = search.target, plan.points[search.target.position].acceleration_m_s2
    level_ratio = abs(nominal) / level_m_s2
    factor = min(max(1.0 / level_ratio, 1.0 / MAX_LEVEL_FACTOR), MAX_LEVEL_FACTOR)
    # no more than the command can change
    sine = _correct_sine(state, target.frequency_hz, level_m_s2, search.level_factor * factor)
    gain = abs(state.tuning.transfer(target.frequency_hz))
    factor = sine.correction * gain / search.level_factor
    # The motion is corrected for the level that the table will have, not for that which it had.
    table_change = table_harmonics(
        target.frequency_hz, (factor - 1.0) * abs(nominal), plan.harmonics
    )
    search = replace(
        search,
        target=correct_target(plan, target, measured, table_change),
        level_factor=search.level_factor * factor,
    )
    return _approach(
        replace(state, search=search), state.trajectory, (), blend_cycles=UPDATE_BLEND_CYCLES
    )


def _begin_releases(state: SequencerState, point: OrbitPoint, motion: Float1D) -> SequencerState:
    """Hold an accepted orbit on for the releases that give its Floquet multiplier."""
    search, stage, trajectory = _search(state), state.stage, state.trajectory
    period = trajectory.rate_hz / point.frequency_hz
    last = stage.last + math.ceil(_config(state).multiplier_periods * period)
    trajectory = trajectory.append_hold(
        last + state.plan.margin - trajectory.end, point.step, Label.SETTLE
    )
    series = ReleaseSeries(
        point,
        search.feedback.segment_at(stage.last).after,
        motion,
        max(_config(state).orbit_plan.points[point.step].multiplier_size, 1.0),
        find_departure_limit(point, state.plan.profile.specimen.gaps_m),
        next_start=stage.last,
    )
    return replace(
        state,
        trajectory=trajectory,
        drive=replace(trajectory.to_drive(state.steps), correction=state.drive.correction),
        stage=Stage("release", point.step, stage.last, last),
        search=replace(search, releases=series),
    )


def decide_multiplier(state: SequencerState) -> SequencerState:
    """Record the accepted orbit with its multiplier and approach the next one."""
    return _next_orbit(_record_multiplier(state, state.stage.last))


def _record_multiplier(state: SequencerState, index: int) -> SequencerState:
    """Return the state with the accepted orbit recorded at sample `index`."""
    search = _search(state)
    assert search.releases is not None
    point, estimate = search.releases.point, estimate_from_releases(state)
    cycles = (index - search.since) * point.frequency_hz / state.trajectory.rate_hz
    point = replace(
        point,
        index=index,
        periods=point.periods + round(cycles),
        multiplier=estimate.value,
        multiplier_sd=estimate.sd if math.isfinite(estimate.sd) else None,
    )
    search = replace(search, releases=None, since=index)
    return replace(state, search=search, records=(*state.records, point))


def _to_vector(fit: HarmonicFit) -> Float1D:
    """Return a fit of Im(c_k exp(i k phi)) as a real vector of harmonics Re(X_k exp(i k phi))."""
    return pack_harmonics(np.concatenate([[fit.offset], -1j * fit.amplitudes]))


def _table_response(
    response: FrequencyResponse | None, frequency_hz: float, harmonics: int
) -> np.ndarray:
    """Return the table's motion over its command at harmonics 0, 1, ..., complex."""
    if response is None:
        return np.ones(harmonics + 1, dtype=np.complex128)
    return np.array(
        [1.0, *(evaluate_transfer(response, k * frequency_hz) for k in range(1, harmonics + 1))]
    )


def _find_fault(
    config: Continuation,
    target: OrbitTarget,
    measured: OrbitMeasurement,
    command_m: float,
    level_ratio: float,
) -> str:
    """Return why a held motion is not an orbit of the table without feedback; "" if it is."""
    if measured.feedback_m > max(config.tolerance * command_m, NOISE_FACTOR * measured.noise_m):
        return f"the feedback is {100 * measured.feedback_m / command_m:.2g} % of the command"
    if not is_on_branch(config.orbit_plan, target, measured):
        return "the amplitude is not that of the sought branch"
    phase_deg = measure_phase(measured.u)
    if config.orbit_plan.condition == "phase" and abs(phase_deg - 90.0) > PHASE_TOLERANCE_DEG:
        return f"u leads the table's acceleration by {phase_deg:.4g} degrees, not by 90"
    if abs(level_ratio - 1.0) > LEVEL_TOLERANCE:
        return f"the table is at {100 * level_ratio:.4g} % of its level"
    return ""


def _next_orbit(state: SequencerState) -> SequencerState:
    """Approach the next planned orbit, or end the test."""
    search, config = _search(state), _config(state)
    position = search.target.position + 1
    if position == len(config.orbit_plan.points):
        return end_continuation(state, state.trajectory)
    target = plan_target(config.orbit_plan, position, search.measured)
    search = replace(search, target=target, losses=0, periods=0)
    return _approach(replace(state, search=search), state.trajectory, ())


def retry_orbit(state: SequencerState, index: int, reason: str) -> SequencerState:
    """Bring the table to rest and approach the lost orbit along those measured before."""
    is_measured = state.stage.kind == "release"
    if is_measured:
        state = _record_multiplier(state, index)
    search, config = _search(state), _config(state)
    position = search.target.position
    is_given_up = is_measured or search.losses >= config.retries
    lost_points = search.lost_points + (is_given_up and not is_measured)
    next_position = position + is_given_up
    has_none = is_given_up and not search.measured
    is_last = (
        has_none or lost_points >= MAX_LOST_POINTS or next_position == len(config.orbit_plan.points)
    )
    action = "it is approached again from rest"
    if is_given_up:
        action = "the test ends" if is_last else "the next one is approached from rest"
    event = Event(index, "lost", f"orbit {position} is lost: {reason}; {action}")
    feedback = _release(search.feedback, index + state.plan.feedback_horizon, state)
    trajectory = state.trajectory.cut(index + state.plan.margin)
    state = replace(state, records=(*state.records, event))
    search = replace(
        search,
        feedback=feedback,
        losses=0 if is_given_up else search.losses + 1,
        lost_points=lost_points,
        is_captured=False,
    )
    if has_none:
        state = replace(
            state,
            refusal=f"no orbit can be held (orbit {position}: {reason}): the model departs too far "
            "from the specimen, or the table from its level; identify the model from a sweep first",
        )
    if is_last:
        return end_continuation(replace(state, search=search), trajectory)
    at_rest = replace(trajectory.target, level_m_s2=0.0)
    trajectory = trajectory.append_blend(at_rest, position, config.blend_cycles, Label.BLEND)
    trajectory = trajectory.append_rest(round(REST_S * trajectory.rate_hz))
    target = plan_target(config.orbit_plan, next_position, search.measured)
    search = replace(search, target=target, periods=0, since=trajectory.end)
    measured = (Waypoint(m.reference, m.frequency_hz, m.position) for m in search.measured)
    waypoints = (*_list_leads(config.orbit_plan), *measured)
    return _approach(replace(state, search=search), trajectory, waypoints, CAPTURE_CYCLES)


def end_continuation(state: SequencerState, trajectory: Trajectory) -> SequencerState:
    """Blend the feedback out and end the test at rest."""
    search = _search(state)
    drive = trajectory.to_drive(state.steps)
    return replace(
        state,
        trajectory=trajectory,
        drive=replace(drive, correction=state.drive.correction),
        stage=Stage("end"),
        search=replace(search, feedback=_release(search.feedback, trajectory.end, state)),
    )


def _release(feedback: FeedbackState, start: int, state: SequencerState) -> FeedbackState:
    """Return the feedback blended out within RELEASE_S from sample `start` on."""
    last = feedback.segment_at(start)
    count = round(RELEASE_S * state.trajectory.rate_hz)
    return feedback.append(
        replace(last, start=start, count=count, before=last.after, share0=last.share1, share1=0.0)
    )
