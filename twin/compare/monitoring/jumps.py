"""Jump monitoring: where the model jumps along the sweep, and whether the specimen does.

The model alone is driven slowly up and down; its jumps lie where the two directions differ
(`curves`). The specimen has jumped too if measured eta_d changes in the same sense by at least half
of the model's change (as logarithms).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np

from table_io.block import Float1D
from table_io.config.profile import Profile
from table_io.records import Event, JumpForecast, NormalizedResponse, PrcPoint, Record, Step
from twin.compare.curves import PrcJump, describe_sudden_change, detect_hysteresis
from twin.model.ideal_response import simulate_sweep
from twin.model.model import Model

MIN_LOG_CHANGE = 0.15  # of log eta_d: smaller changes of the model are no visible jumps
MIN_CHANGE_RATIO = 0.5  # of the model's change, for the same jump
# Slow drive of the model: frequency step, cycles at each, last cycles that are averaged.
MAX_STEP_HZ, CYCLES_PER_STEP, AVERAGED_CYCLES = 0.02, 20, 5
MAX_CYCLES = 4000  # of an integrated model, at 0.3 ms each
BRANCH_EXIT_POINTS = 3  # points on which a motion leaves its branch
# Of the frequency of a jump: gaps are known to 0.05 mm each, which moves the jumps of a gap of 4 mm
# by half a per cent, and masses and lasers add to it.
JUMP_TOLERANCE = 0.01
MAX_STEPS_LATE = 1  # steps that a jump may be late before it is missed
STEPS_NEAR_JUMP = 3  # steps around a jump in which the model's own response is no reference


@dataclass(frozen=True, slots=True)
class ExpectedJump:
    """A jump of the model at `at_hz`, between two steps of the test; `change` of log eta_d."""

    before: Step
    after: Step
    change: float
    at_hz: float

    @property
    def kind(self) -> str:
        return "up" if self.change > 0 else "down"


@dataclass(frozen=True, slots=True)
class JumpPrediction:
    """Jumps of the model in driving order, and the logarithm of its eta_d by step."""

    jumps: tuple[ExpectedJump, ...] = ()
    log_amplitudes: Mapping[int, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class JumpTracking:
    """Upcoming and overdue jumps, and the last point of the sweep."""

    log_amplitudes: Mapping[int, float] = field(default_factory=dict)
    upcoming: tuple[ExpectedJump, ...] = ()
    overdue: tuple[ExpectedJump, ...] = ()
    last_point: PrcPoint | None = None
    last_jump_step: int = -2  # step of the last jump


def predict_jumps(
    profile: Profile, model: Model, steps: tuple[Step, ...], u_star_m: float
) -> JumpPrediction:
    """Predict the jumps of the model, driven slowly up and down the sweep's range.

    Of a schedule, at each of its levels.
    """
    groups = _group_by_level(profile, steps)
    predictions = [_predict_at_level(profile, model, group, u_star_m) for group in groups]
    jumps = (jump for prediction in predictions for jump in prediction.jumps)
    return JumpPrediction(
        tuple(sorted(jumps, key=lambda jump: jump.after.index)),
        {
            index: log_amplitude
            for prediction in predictions
            for index, log_amplitude in prediction.log_amplitudes.items()
        },
    )


def _group_by_level(profile: Profile, steps: tuple[Step, ...]) -> list[tuple[Step, ...]]:
    """Return the steps of each level of a schedule; all of them in one group without a schedule."""
    schedule_db = profile.sweep.schedule_db
    if len(schedule_db) < 2:
        return [steps]
    stated = profile.sweep.levels_m_s2(np.array([step.frequency_hz for step in steps]))
    driven = np.array([step.acceleration_m_s2 for step in steps])
    distance_db = np.abs(20.0 * np.log10(driven / stated) - np.array(schedule_db)[:, None])
    nearest = np.argmin(distance_db, axis=0)
    groups = (
        tuple(step for step, row in zip(steps, nearest, strict=True) if row == level)
        for level in range(len(schedule_db))
    )
    return [group for group in groups if group]


def _predict_at_level(
    profile: Profile, model: Model, steps: tuple[Step, ...], u_star_m: float
) -> JumpPrediction:
    """Predict the jumps between steps of one level, from a slow drive up and down their range.

    In steps of at most `MAX_STEP_HZ`; where effects make cycles expensive, in those of the test or
    coarser ones, so that about `MAX_CYCLES` cycles are computed at most.
    """
    grid = np.array(profile.sweep.frequencies_hz)
    if model.changes_only_parameters:
        substeps, cycles = max(1, math.ceil(profile.sweep.step_hz / MAX_STEP_HZ)), CYCLES_PER_STEP
        up = np.interp(
            np.arange((grid.size - 1) * substeps + 1) / substeps, np.arange(grid.size), grid
        )
    else:
        cycles = min(profile.sweep.cycles, CYCLES_PER_STEP // 2)
        up = grid[:: math.ceil(2 * grid.size * cycles / MAX_CYCLES)]
    frequencies_hz = np.concatenate([up, up[::-1]])
    acceleration: float | Float1D = max(step.acceleration_m_s2 for step in steps)
    if profile.sweep.level_points:
        levels = profile.sweep.levels_m_s2(frequencies_hz)
        stated = profile.sweep.levels_m_s2(np.array([steps[0].frequency_hz]))[0]
        acceleration = levels * steps[0].acceleration_m_s2 / stated
    response = simulate_sweep(model, frequencies_hz, acceleration, cycles, AVERAGED_CYCLES)
    amplitudes = 0.5 * (response.column("u_max") - response.column("u_min"))
    directions = ["forward"] * up.size + ["backward"] * up.size
    points = [
        _model_point(*arguments)
        for arguments in zip(directions, frequencies_hz.tolist(), amplitudes, strict=True)
    ]
    expected = [
        expected_jump for jump in detect_hysteresis(points, "measured")[0]
        if (expected_jump := _between_steps(jump, points, steps)) is not None
    ]  # fmt: skip
    sizes = {(point.direction, point.frequency_hz): _amplitude(point) for point in points}
    by_step = {step.index: sizes.get((step.direction, step.frequency_hz), 0.0) for step in steps}
    return JumpPrediction(
        tuple(sorted(expected, key=lambda jump: jump.after.index)),
        {index: math.log(size / u_star_m) for index, size in by_step.items() if size > 0},
    )


def _model_point(direction: str, frequency_hz: float, amplitudes: Float1D) -> PrcPoint:
    """Return a PRC point of the model: amplitude of u over the last cycles, in m, as eta_d."""
    nan, mean = float("nan"), float(amplitudes.mean())
    # A mass that sticks has zero amplitude.
    spread = float(np.ptp(amplitudes)) / mean if mean > 0 else 0.0
    response = NormalizedResponse(mean, nan, nan, nan, nan, nan, (), (), nan, spread)
    return PrcPoint(0, 0, direction, frequency_hz, response, None, nan, nan, nan)


def _amplitude(point: PrcPoint) -> float:
    return point.measured.eta_d if point.measured is not None else 0.0


def _between_steps(
    jump: PrcJump, points: Sequence[PrcPoint], steps: tuple[Step, ...]
) -> ExpectedJump | None:
    """Return the jump with the two test steps around it; None without such steps, or if small.

    Its change is from the last point before it to the farthest of the next few: with few cycles at
    each, a motion takes several points to leave its branch.
    """
    at_hz = 0.5 * (jump.from_hz + jump.to_hz)
    branch = [point for point in points if point.direction == jump.direction]
    index = next(i for i, point in enumerate(branch) if point.frequency_hz == jump.from_hz)
    size, after = (
        _amplitude(branch[index]),
        [_amplitude(point) for point in branch[index + 1 : index + 1 + BRANCH_EXIT_POINTS]],
    )
    if size <= 0 or min(after) <= 0:
        return None
    change = math.log((max(after) if jump.kind == "up" else min(after)) / size)
    sign = 1.0 if jump.to_hz > jump.from_hz else -1.0
    for step, next_step in pairwise(steps):
        same_direction = step.direction == next_step.direction == jump.direction
        if (
            same_direction
            and sign * step.frequency_hz < sign * at_hz <= sign * next_step.frequency_hz
        ):
            return (
                ExpectedJump(step, next_step, change, at_hz)
                if abs(change) > MIN_LOG_CHANGE
                else None
            )
    return None


def start_tracking(prediction: JumpPrediction) -> JumpTracking:
    """Return the tracking state before the first step."""
    return JumpTracking(prediction.log_amplitudes, prediction.jumps)


def track_jumps(tracking: JumpTracking, point: PrcPoint) -> tuple[JumpTracking, list[Record]]:
    """Update with a planned step; return jump Events and the forecast of the next jump."""
    last = tracking.last_point
    tracking = replace(tracking, last_point=point)
    items: list[Record] = []
    if (
        last is not None
        and last.direction == point.direction
        and _amplitude(last) > 0 < _amplitude(point)
    ):
        change = math.log(_amplitude(point) / _amplitude(last))
        tracking, messages = _match_jumps(tracking, last, point, change)
        items = [Event(point.index, kind, text) for kind, text in messages]
    elif last is not None and tracking.last_jump_step == last.step:
        # At the turn the motion goes on at the same frequency.
        tracking = replace(tracking, last_jump_step=point.step)
    late = tuple(
        jump for jump in tracking.upcoming if jump.after.index + MAX_STEPS_LATE <= point.step
    )
    # A jump that the end of a direction cut off may come after the turn.
    turned = tuple(jump for jump in late if jump.after.direction != point.direction)
    tracking = replace(
        tracking,
        upcoming=tuple(jump for jump in tracking.upcoming if jump not in late),
        overdue=(*tracking.overdue, *turned),
    )
    return tracking, [*items, forecast_jump(tracking, point)]


def _is_smooth_change(
    tracking: JumpTracking, last: PrcPoint, point: PrcPoint, change: float
) -> bool:
    """Return whether the model changes as much: the flank of a resonance is no jump."""
    if not {last.step, point.step} <= tracking.log_amplitudes.keys():
        return False
    jumps = (*tracking.upcoming, *tracking.overdue)
    near = any(abs(jump.after.index - point.step) <= STEPS_NEAR_JUMP for jump in jumps)
    model_change = tracking.log_amplitudes[point.step] - tracking.log_amplitudes[last.step]
    return not near and abs(change - model_change) < MIN_CHANGE_RATIO * abs(change)


def _match_jumps(
    tracking: JumpTracking, last: PrcPoint, point: PrcPoint, change: float
) -> tuple[JumpTracking, list[tuple[str, str]]]:
    """Match a change of log eta_d with expected jumps; return (tracking, (kind, text) pairs)."""
    messages: list[tuple[str, str]] = []
    upcoming_same = [jump for jump in tracking.upcoming if jump.after.direction == point.direction]
    overdue = [jump for jump in tracking.overdue if jump.after.direction == point.direction]
    turned = [jump for jump in tracking.overdue if jump.after.direction != point.direction]
    due = [
        jump for jump in upcoming_same
        if jump.after.index <= point.step or _is_at_step(jump, point)
    ]  # fmt: skip
    sudden_change = describe_sudden_change(last, point)
    arrived = [
        jump
        for jump in due
        if _is_same_jump(jump, change) or (sudden_change and change * jump.change > 0)
    ]
    for jump in arrived:
        where = "where the model expects it"
        if jump.after.index <= last.step:
            where = f"one step after where the model expects it ({jump.at_hz:.3f} Hz)"
        elif jump.after.index > point.step:
            where = f"one step before where the model expects it ({jump.at_hz:.3f} Hz)"
        messages.append(("jump", f"{_describe_jump(jump)} came {where}"))
    for jump in due:
        is_late = jump not in arrived and jump.after.index + MAX_STEPS_LATE <= point.step
        if is_late and not _is_on_branch_after(tracking, jump, point):
            messages.append(
                ("no jump", f"{_describe_jump(jump)}, expected by the model, did not come")
            )
            overdue.append(jump)
    hint = None if arrived or _is_smooth_change(tracking, last, point, change) else sudden_change
    # A jump during the measured cycles shows only in part and continues at the next step.
    if hint is not None and point.step != tracking.last_jump_step + 1:
        early = [jump for jump in upcoming_same if jump not in due]
        matched = next((jump for jump in (*overdue, *early) if _is_same_jump(jump, change)), None)
        after_turn = next((jump for jump in turned if change * jump.change > 0), None)
        if after_turn is not None:
            place = f"after the turn, where the model expects it before ({after_turn.at_hz:.3f} Hz)"
            messages.append(("jump", f"{_describe_jump(after_turn)} came {place}"))
            turned.remove(after_turn)
        else:
            messages.append(("unexpected jump", f"{hint}; {_describe_distance(matched, point)}"))
            arrived = [] if matched is None else [matched]
    if arrived or hint is not None:
        tracking = replace(tracking, last_jump_step=point.step)
    upcoming = tuple(jump for jump in tracking.upcoming if jump not in arrived)
    overdue = [jump for jump in overdue if jump not in arrived]
    return replace(tracking, upcoming=upcoming, overdue=(*overdue, *turned)), messages


def _is_at_step(jump: ExpectedJump, point: PrcPoint) -> bool:
    """Return whether a jump expected just after a step may come with it."""
    distance_hz = abs(jump.at_hz - point.frequency_hz)
    return jump.before.index == point.step and distance_hz <= JUMP_TOLERANCE * jump.at_hz


def _is_same_jump(jump: ExpectedJump, change: float) -> bool:
    return change * jump.change > 0 and abs(change) >= MIN_CHANGE_RATIO * abs(jump.change)


def _is_on_branch_after(tracking: JumpTracking, jump: ExpectedJump, point: PrcPoint) -> bool:
    """Return whether the motion at a step is that of the model after a jump.

    Where motions of a model differ little, the specimen may reach it on another way.
    """
    expected = tracking.log_amplitudes.get(point.step)
    deviation = math.inf if expected is None else math.log(_amplitude(point)) - expected
    return abs(deviation) < MIN_CHANGE_RATIO * abs(jump.change)


def _describe_distance(jump: ExpectedJump | None, point: PrcPoint) -> str:
    """Describe the distance of a measured jump from a jump of the model."""
    if jump is None:
        return "the model expects none here"
    steps = point.step - jump.after.index
    sense = "later" if steps > 0 else "earlier"
    distance = f"{abs(steps)} steps" if abs(steps) > 1 else "one step"
    return f"{distance} {sense} than the model ({jump.at_hz:.3f} Hz)"


def _describe_jump(jump: ExpectedJump) -> str:
    return (
        f"{jump.after.direction}: the jump {jump.kind} between {jump.before.frequency_hz:g} and "
        f"{jump.after.frequency_hz:g} Hz"
    )


def forecast_jump(tracking: JumpTracking, point: PrcPoint) -> JumpForecast:
    """Return the forecast of the next jump along the sweep, as of a step."""
    nan = float("nan")
    position = (point.index, point.step, point.direction, point.frequency_hz)
    jump = next((jump for jump in tracking.upcoming if jump.after.index > point.step), None)
    if jump is None:
        return JumpForecast(*position, "", nan, nan, nan)
    ends = sorted((jump.before.frequency_hz, jump.after.frequency_hz))
    return JumpForecast(*position, jump.kind, jump.at_hz, *ends)
