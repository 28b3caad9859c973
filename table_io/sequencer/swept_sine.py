"""Swept sine in the sequencer: every update measures the level and appends the next part.

    soft start --> held at the first frequency --> passes, part by part --> soft stop
                                                       `--> dwell at each resonance found

A part acts `margin` samples after the window that decided on it. What is queued meanwhile goes on
with the last level and correction, and ends at rest, whatever becomes of the decisions.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from table_io.block import Label, join_blocks
from table_io.config.excitation.swept_sine import MAX_DWELLS, SweptSine
from table_io.config.profile import NOTCH, LimitConfig
from table_io.config.rig import RigConfig
from table_io.control.sweep_control import (
    JUMP_CHANGE,
    LIMIT_SHARE,
    MAX_SWEEP_CORRECTION,
    MIN_RATIO,
    RISE_SHARE,
    SLOPE_POINTS,
    Curve,
    choose_curve,
    combine_levels,
    extrapolate_ratio,
    find_pass_resonances,
    list_gain_points,
    list_ratio_points,
    make_curve,
)
from table_io.control.table_response import evaluate_gain
from table_io.errors import InputError
from table_io.excitation.drive import RAMP_CYCLES, Drive
from table_io.excitation.trajectory import (
    NOMINAL_UPDATE_S,
    SETTLE_UPDATES,
    SineTarget,
    SweptPosition,
    Trajectory,
    append_swept,
    start_swept,
)
from table_io.harmonics import track_channels, track_harmonics
from table_io.records import Event, SweepLevel
from table_io.sequencer.state import MAX_HOLD_S, SequencerState, Stage, SweepSearch

PREVIEW_LEADS = 3.0  # lead times of the queue that are planned ahead of a decision
COMMAND_SHARE = 0.98  # of the limits of the rig that a corrected command may use
MAX_RESONANCE_LAG = 0.2  # in ln f between the peaks of one resonance, up and down
# Of a limit, up to which the level that the twin predicted is played. The twin aims at LIMIT_SHARE;
# beside a jump the response hardly changes with the level, and to aim there too by what is measured
# would take five per cent of the level for one of the response.
FORESEEN_SHARE = 0.985
KNOWN_SPAN = 0.3  # in ln f, of what an earlier pass says about the next part
NOTCHED_SHARE = 0.998  # of the level of the profile: below it is reduced by a limit


def check_swept_channels(config: SweptSine, rig: RigConfig) -> None:
    """Raise InputError if the rig does not measure a channel of the level or of the resonances."""
    wanted = [("control_channels", name) for name in config.control_channels]
    if config.dwell_s or "response_channel" in config.model_fields_set:
        wanted.append(("response_channel", config.response_channel))
    for key, name in wanted:
        if name not in rig.channels:
            raise InputError(
                f"rig {rig.name!r} does not measure this channel",
                key=f"excitation.{key}",
                value=name,
                allowed=", ".join(rig.channels),
            )


def begin_swept_sine(state: SequencerState) -> SequencerState:
    """Start softly at the first frequency."""
    config = _config(state)
    gain = _known_gain(state, [], ())(math.log(config.ends_hz(0)[0]))
    trajectory, position = start_swept(state.trajectory, config, math.exp(-gain))
    sweep = SweepSearch(position, trajectory.end)
    return _append_parts(replace(state, trajectory=trajectory, sweep=sweep))


def decide_sweep_level(state: SequencerState) -> SequencerState:
    """Measure the level over the last window, and append the next part of the test."""
    level = _measure_level(state)
    if level is not None:
        sweep, number = _sweep(state), _config(state).find_pass(level.step)
        passes = {**sweep.passes, number: (*sweep.passes.get(number, ()), level)}
        sweep = replace(sweep, passes=passes)
        state = replace(state, sweep=sweep, records=(*state.records, level))
    return _append_parts(state)


def _config(state: SequencerState) -> SweptSine:
    config = state.plan.profile.swept_sine
    assert config is not None
    return config


def _sweep(state: SequencerState) -> SweepSearch:
    assert state.sweep is not None
    return state.sweep


def _append_parts(state: SequencerState) -> SequencerState:
    """Append what follows up to the next decision, or the end of the test."""
    config = _config(state)
    while True:
        position, end = _sweep(state).position, state.trajectory.end
        if end - (_sweep(state).held_from or end) > MAX_HOLD_S * state.trajectory.rate_hz:
            return replace(state, stage=Stage("open"), drive=state.trajectory.to_drive(()))
        if position.sweep < config.passes or end < _sweep(state).until or _sweep(state).is_held:
            state = _append_part(state)
        else:
            state = _approach_next_dwell(state)
            if state.stage.kind == "end":
                return state
        sweep, rate_hz = _sweep(state), state.trajectory.rate_hz
        last = state.trajectory.end - state.plan.margin
        first = last - math.ceil(config.tracked_s(sweep.position.frequency_hz) * rate_hz)
        if first >= sweep.since:
            stage = Stage("sweep", first=first, last=last)
            return replace(state, stage=stage, drive=_plan_ahead(state))


def _append_part(state: SequencerState) -> SequencerState:
    """Append a part of a pass or of a dwell, with the level and correction that are due."""
    config, position, trajectory = _config(state), _sweep(state).position, state.trajectory
    levels = _select_levels(state, position.sweep)
    before = trajectory.target

    def choose(frequency_hz: float) -> tuple[float, float]:
        level = _limit_level(state, levels, frequency_hz, before)
        return level, _choose_correction(state, levels, frequency_hz, level, before)

    if position.sweep < config.passes and not _sweep(state).is_held:
        trajectory, position = append_swept(trajectory, config, position, choose)
    else:
        trajectory, position = _append_stand(state, trajectory, position, choose)
    sweep = replace(_sweep(state), position=position)
    return replace(state, trajectory=trajectory, sweep=sweep)


def _append_stand(
    state: SequencerState,
    trajectory: Trajectory,
    position: SweptPosition,
    choose_level: Callable[[float], tuple[float, float]],
    min_s: float = 0.0,
) -> tuple[Trajectory, SweptPosition]:
    """Append a part at one frequency, or one in which the frequency comes to a stand."""
    config, f, rate_1_s = _config(state), position.frequency_hz, trajectory.log_rate_1_s
    step = config.find_window(position.sweep, f)
    seconds = max(config.update_s(f), min_s)
    if rate_1_s:
        left = math.log(config.ends_hz(position.sweep)[1] / f)
        seconds = min(seconds, 2.0 * left / rate_1_s)
        f *= math.exp(0.5 * rate_1_s * seconds)
    target = SineTarget(f, *choose_level(f))
    count = math.ceil(seconds * trajectory.rate_hz)
    label = Label.SETTLE if _sweep(state).is_held else Label.MEASURE
    trajectory = trajectory.append_sweep(target, count, step, 0.0, label)
    return trajectory, replace(position, frequency_hz=f)


def hold_sweep(state: SequencerState, index: int) -> SequencerState:
    """Bring the frequency to a stand behind sample `index`; unchanged if the drive ends before.

    The level is controlled further.
    """
    trajectory, position = _go_on(state, index)
    is_over = position.sweep >= _config(state).passes and not _sweep(state).until
    if trajectory.end < index or is_over or _sweep(state).is_held:
        return state
    sweep = replace(_sweep(state), position=position, held_from=trajectory.end)
    return _change_plan(replace(state, trajectory=trajectory, sweep=sweep))


def resume_sweep(state: SequencerState, index: int) -> SequencerState:
    """Go on behind sample `index`; a dwell gets the time that the hold took of it."""
    held_from = _sweep(state).held_from
    if held_from is None or state.stage.kind != "sweep":
        return state
    trajectory, position = _go_on(state, index)
    until = _sweep(state).until
    until += trajectory.end - held_from if until else 0
    sweep = replace(_sweep(state), position=position, until=until, held_from=None)
    return _change_plan(replace(state, trajectory=trajectory, sweep=sweep))


def _change_plan(state: SequencerState) -> SequencerState:
    """Plan again what is queued behind the trajectory; the next decision is made as before."""
    trajectory = replace(state.trajectory, changed_from=state.trajectory.end)
    state = replace(state.mark_queued(), trajectory=trajectory)
    return replace(state, drive=_plan_ahead(state))


def _approach_next_dwell(state: SequencerState) -> SequencerState:
    """Rest, then start softly at the next resonance; end the test if there is none."""
    config, sweep, trajectory = _config(state), _sweep(state), state.trajectory
    if sweep.dwells is None:  # the passes are over
        sweep = replace(sweep, dwells=_find_dwells(config, sweep.passes))
        if config.dwell_s:
            text = ", ".join(f"{hz:.4g} Hz" for hz in sweep.dwells or ()) or "none"
            event = Event(state.stage.last, "found", f"resonances: {text}")
            state = replace(state, records=(*state.records, event))
    state = replace(state, sweep=sweep)
    if not sweep.dwells:
        return replace(state, drive=trajectory.to_drive(()), stage=Stage("end"))
    f = sweep.dwells[0]
    number = sweep.position.sweep + (sweep.until > 0)
    at_rest, before = replace(trajectory.target, level_m_s2=0.0), sweep.position
    step = config.find_window(min(before.sweep, config.passes - 1), before.frequency_hz)
    trajectory = trajectory.append_blend(at_rest, step, RAMP_CYCLES, Label.BLEND)
    ahead = replace(sweep, position=replace(before, frequency_hz=f))
    levels = _select_levels(replace(state, sweep=ahead), number)
    level = _limit_level(state, levels, f, None)
    target = SineTarget(f, level, _choose_correction(state, levels, f, level, None))
    step = config.find_window(number, f)
    trajectory = trajectory.append_blend(target, step, RAMP_CYCLES, Label.BLEND)
    sweep = SweepSearch(
        SweptPosition(number, f, SETTLE_UPDATES),
        trajectory.end,
        sweep.passes,
        sweep.dwells[1:],
        trajectory.end + round(config.dwell_s * trajectory.rate_hz),
    )
    return replace(state, trajectory=trajectory, sweep=sweep)


def _plan_ahead(state: SequencerState) -> Drive:
    """Return the drive that goes on with the last level and correction, then stops softly."""
    seconds = PREVIEW_LEADS * state.plan.rig.output.lead_s + NOMINAL_UPDATE_S
    end = state.trajectory.end + math.ceil(seconds * state.trajectory.rate_hz)
    return _go_on(state, end)[0].to_drive(())


def _go_on(state: SequencerState, end: int) -> tuple[Trajectory, SweptPosition]:
    """Return trajectory and position that go on to sample `end`, but not beyond passes or dwell."""
    config, position, trajectory = _config(state), _sweep(state).position, state.trajectory
    before = trajectory.target
    share = before.level_m_s2 / config.level_m_s2(before.frequency_hz)

    def hold(frequency_hz: float) -> tuple[float, float]:
        return share * config.level_m_s2(frequency_hz), before.correction

    is_held = _sweep(state).is_held
    while position.sweep < config.passes and trajectory.end < end and not is_held:
        trajectory, position = append_swept(trajectory, config, position, hold, NOMINAL_UPDATE_S)
    while trajectory.end < (end if is_held else min(end, _sweep(state).until)):
        trajectory, position = _append_stand(state, trajectory, position, hold, NOMINAL_UPDATE_S)
    return trajectory, position


def _find_dwells(
    config: SweptSine, passes: Mapping[int, Sequence[SweepLevel]]
) -> tuple[float, ...]:
    """Return the frequencies in Hz at which to dwell, the largest resonances of the last pass.

    The response lags behind a moving frequency: where the pass before went the other way, the mean
    of both is taken.
    """
    if not config.dwell_s:
        return ()
    last = config.passes - 1
    peaks, before = find_pass_resonances(config, passes.get(last, ())), []
    if last and config.direction(last - 1) != config.direction(last):
        before = [hz for hz, _ in find_pass_resonances(config, passes.get(last - 1, ()))]
    dwells = []
    for hz, _ in peaks[:MAX_DWELLS]:
        other = min(before, key=lambda f: abs(math.log(f / hz)), default=hz)
        is_same = abs(math.log(other / hz)) < MAX_RESONANCE_LAG
        dwells.append(math.sqrt(hz * other) if is_same else hz)
    return tuple(dwells)


def _measure_level(state: SequencerState) -> SweepLevel | None:
    """Return the level over the stage's window; None if samples are lost or a channel is dead."""
    config, stage, drive = _config(state), state.stage, state.drive
    blocks = [b for b in state.blocks if b.end > stage.first and b.index < stage.last]
    window = join_blocks(blocks).cut(stage.first, stage.last)
    count = len(window)
    phase = drive.phase(stage.first, count)
    notches = _list_notches(state)
    names = [*config.control_channels, *(entry.channel for entry in notches)]
    names = [
        name for name in dict.fromkeys([*names, config.response_channel]) if name in window.channels
    ]
    fits = track_channels(np.array([window.channel(name) for name in names]), phase)
    amplitudes = {name: fit.fundamental for name, fit in zip(names, fits, strict=True)}
    frequency_hz = drive.frequency_hz((stage.first + stage.last) // 2)
    w = math.tau * frequency_hz
    command = track_harmonics(drive.command(stage.first, count), phase).fundamental * w**2
    measured = combine_levels(config, amplitudes, w)
    if not all(map(math.isfinite, amplitudes.values())) or not measured > MIN_RATIO * command:
        return None
    reference = config.level_m_s2(frequency_hz)
    demanded = float(drive.level(stage.first, count).mean())
    limited_by = ""
    if demanded < NOTCHED_SHARE * reference and notches:
        nearest = max(notches, key=lambda entry: amplitudes[entry.channel] / entry.limit_si)
        limited_by = nearest.channel
    return SweepLevel(
        stage.last, int(window.step[count // 2]), frequency_hz, reference, demanded, measured,
        command / demanded, limited_by, tuple(names), tuple(amplitudes[name] for name in names),
    )  # fmt: skip


def _list_notches(state: SequencerState) -> list[LimitConfig]:
    return [entry for entry in state.plan.profile.limits if entry.action == NOTCH]


class _PassLevels(NamedTuple):
    """Levels measured in a pass or dwell so far, and those of the pass before it."""

    sweep: int
    own: list[SweepLevel]
    earlier: list[SweepLevel]


def _select_levels(state: SequencerState, sweep: int) -> _PassLevels:
    config, passes = _config(state), _sweep(state).passes
    f, before = _sweep(state).position.frequency_hz, min(sweep, config.passes) - 1
    earlier = [
        level
        for level in passes.get(before, ())
        if abs(math.log(level.frequency_hz / f)) < KNOWN_SPAN
    ]
    return _PassLevels(sweep, list(passes.get(sweep, ())[-SLOPE_POINTS:]), earlier)


def _known_gain(
    state: SequencerState, points: list[tuple[float, float]], earlier: Sequence[SweepLevel]
) -> Curve:
    """Return what is known of the table's gain: by an earlier pass, else by the loop check."""
    response = state.tuning.response
    if earlier:
        return choose_curve(points, make_curve(list_gain_points(earlier)))
    if response is None:
        return make_curve(())
    ends = np.log([min(response.frequencies_hz), max(response.frequencies_hz)])
    return lambda ln_f: math.log(evaluate_gain(response, math.exp(np.clip(ln_f, *ends))))


def _limit_level(
    state: SequencerState,
    levels: _PassLevels,
    frequency_hz: float,
    before: SineTarget | None,
) -> float:
    """Return the level in m/s2 that keeps every notched channel within its limit."""
    config, share = _config(state), 1.0
    reference = config.level_m_s2(frequency_hz)
    for entry in _list_notches(state):
        points = list_ratio_points(levels.own, entry.channel)
        earlier = make_curve(list_ratio_points(levels.earlier, entry.channel))
        if points or levels.earlier:
            ln_f = math.log(frequency_hz)
            ratio = extrapolate_ratio(points, choose_curve(points, earlier), ln_f)
            foreseen = foresee_ratio(config, levels.sweep, entry.channel, points, ln_f)
            aim = LIMIT_SHARE
            if math.isfinite(foreseen):
                ratio, aim = foreseen, FORESEEN_SHARE
            share = min(share, aim * entry.limit_si / (math.exp(ratio) * reference))
    if config.predicted_sweep is not None:
        predicted = config.predicted_sweep.level_m_s2(levels.sweep, frequency_hz)
        share = min(share, predicted / reference) if math.isfinite(predicted) else share
    if before is not None and before.level_m_s2:
        last = before.level_m_s2 / config.level_m_s2(before.frequency_hz)
        fall = 10.0 ** (config.clamp_db / 20.0)
        share = min(max(share, last / fall), last * fall**RISE_SHARE)
    return reference * share


def foresee_ratio(
    config: SweptSine,
    sweep: int,
    channel: str,
    points: list[tuple[float, float]],
    ln_f: float,
) -> float:
    """Return ln of a channel over the level at ln f by the twin and the measured difference to it.

    NaN without a prediction, or where that jumps on the way: the specimen jumps at another place.
    What was measured before a jump of the twin says nothing about its other branch.
    """
    if config.predicted_sweep is None or not points:
        return math.nan

    predict = partial(config.predicted_sweep.log_ratio, sweep, channel)
    near = [point for point in points if abs(predict(ln_f) - predict(point[0])) < JUMP_CHANGE]
    if points[-1] not in near:
        return math.nan
    return extrapolate_ratio(near, predict, ln_f)


def _choose_correction(
    state: SequencerState,
    levels: _PassLevels,
    frequency_hz: float,
    level_m_s2: float,
    before: SineTarget | None,
) -> float:
    """Return the correction that gives a level, within the clamp and the limits of the rig."""
    config = _config(state)
    points = list_gain_points(levels.own)
    known = _known_gain(state, points, levels.earlier)
    correction = math.exp(-extrapolate_ratio(points, known, math.log(frequency_hz)))
    if before is not None and before.level_m_s2:
        factor = (correction / before.correction) ** config.compression
        largest = 10.0 ** (config.clamp_db / 20.0)
        correction = before.correction * min(max(factor, 1.0 / largest), largest)
    limits, output = state.plan.rig.limits, state.plan.rig.output
    w = math.tau * frequency_hz
    stroke_m = 1e-3 * min(limits.stroke_mm, output.span_mm)
    room = COMMAND_SHARE * min(stroke_m * w**2, 1e-3 * limits.velocity_mm_s * w) / level_m_s2
    return min(max(correction, 1.0 / MAX_SWEEP_CORRECTION), MAX_SWEEP_CORRECTION, room)
