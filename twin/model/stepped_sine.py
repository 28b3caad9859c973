"""Closed-form response of the SNM to the ideal stepped sine, for `simulate` and ideal PRCs.

One propagator takes whole steps of a cycle of A = peak sin(w t) in closed form; what is recorded on
the way, such as extremes, is given to it as a `Recorder` and an `Observer`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import float64, int64, types

from table_io.block import Float1D, Float2D, Int1D
from table_io.compilation import jit_helper, jit_kernel
from table_io.errors import InputError
from twin.model.closed_form import continuous_params, rest_state, substep_count
from twin.model.contact_regime import (
    BASE,
    CONTACT_R,
    E_L,
    E_R,
    MASS,
    MODE_SIZE,
    MODES,
    R_L,
    R_R,
    STATE_SIZE,
    U_L,
    U_R,
    Kinematics,
    ModeSegment,
    ModeSolution,
    ModeStep,
    Observer,
    Quantity,
    Sinusoid,
    U,
    V,
    advance_through_events,
    bumper_forces,
    contact_guard,
    contact_mode,
    evaluate_motion,
    evaluate_quantity,
    find_extremum,
    flush_denormal,
    mode_solution,
    solution_at,
    take_step,
    transition_matrix,
)
from twin.model.parameters import Parameters
from twin.model.valid_range import RangeExit

Float3D = npt.NDArray[np.float64]

EXTREME_NAMES = ("u_max", "u_min", "a_max", "a_min", "f_r_max", "f_l_min", "onsets_r", "onsets_l")
MIN_STEPS_PER_CYCLE = 8  # with fewer, a contact could begin and end undetected


class SineDrive(NamedTuple):
    """A = peak sin(w t) in `steps` steps per cycle, with what `prepare_drive` computes of it.

    table (2, steps + 1 or more): sine and cosine at the steps; particular (4 modes, 3).
    """

    peak: float
    w: float
    steps: int
    table: Float2D
    particular: Float2D


DRIVE_TYPE = types.NamedTuple(
    [float64, float64, int64, float64[:, ::1], float64[:, ::1]], SineDrive
)
# (what is recorded, parameters, length of the step in s, A, u and u' at its start, mode, step) ->
# whether that is done; otherwise the step is taken again with an observer
Recorder = Callable[[Any, Float1D, float, Sinusoid, tuple[float, float], int, ModeStep], bool]


@jit_helper()
def prepare_drive(params: Float1D, drive: SineDrive) -> None:
    """Compute transition matrices, sine table and particular solutions of a drive.

    u = q0 + alpha sin + beta cos, re = k - M w^2, im = c w, alpha = -M peak re / (re^2 + im^2),
    beta = +M peak im / (re^2 + im^2).
    """
    w, steps, table, particular = drive.w, drive.steps, drive.table, drive.particular
    phase_step = 2 * math.pi / steps
    h = phase_step / w
    for k in range(steps + 1):
        table[0, k], table[1, k] = math.sin(phase_step * k), math.cos(phase_step * k)
    params[E_R], params[E_L] = math.exp(-params[R_R] * h), math.exp(-params[R_L] * h)
    for mode in range(4):
        b, mass = MODES + mode * MODE_SIZE, params[MASS]
        params[b + 5], params[b + 6], params[b + 7], params[b + 8] = transition_matrix(
            h, params[b + 3], params[b + 4]
        )
        re, im = params[b] - mass * w * w, params[b + 1] * w
        scale = mass * drive.peak / (re * re + im * im)
        particular[mode, 0] = params[b + 2] / params[b]
        particular[mode, 1], particular[mode, 2] = -re * scale, im * scale


@jit_helper()
def advance_steps(
    state: Float1D,
    params: Float1D,
    drive: SineDrive,
    steps: int,
    accept: Recorder,
    observe: Observer,
    record: Any,
    count: int,
) -> int:
    """Advance `state` by the first steps of a cycle, through every event; return the count.

    `accept` is called after a step without events; one whose guards may have turned negative, or
    that it does not accept, is taken by `advance_through_events` with `observe`.
    """
    peak, w, table, particular = drive.peak, drive.w, drive.table, drive.particular
    h, phase_step = 2 * math.pi / (w * drive.steps), 2 * math.pi / drive.steps
    u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
    mode = contact_mode(state)
    for i in range(steps):
        q0, alpha, beta = particular[mode, 0], particular[mode, 1], particular[mode, 2]
        s0, c0, s1, c1 = table[0, i], table[1, i], table[0, i + 1], table[1, i + 1]
        departure = u - q0 - alpha * s0 - beta * c0, v - w * (alpha * c0 - beta * s0)
        at_end = q0 + alpha * s1 + beta * c1, w * (alpha * c1 - beta * s1)
        base, wave = (peak * s0, peak * s1), (peak, w, phase_step * i)
        step = take_step(params, mode, h, (u, v, ur, ul), departure, at_end, base)
        if step.is_clear and accept(record, params, h, wave, (u, v), mode, step):
            u, v, ur, ul = step.u, step.v, flush_denormal(step.u_r), flush_denormal(step.u_l)
            continue
        state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul
        count = advance_through_events(state, params, h, 0.0, 0.0, wave, observe, record, count)
        u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
        mode = contact_mode(state)
    state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul
    return count


@jit_helper(inlined=True)
def accept_step(
    record: None,
    params: Float1D,
    h: float,
    wave: Sinusoid,
    start: tuple[float, float],
    mode: int,
    step: ModeStep,
) -> bool:
    """Record nothing of a step without events; see `Recorder`."""
    return True


@jit_helper()
def ignore_segment(
    record: None, count: int, state: Float1D, params: Float1D, segment: ModeSegment
) -> int:
    """Record nothing of a segment; see `Observer`."""
    return count


@jit_helper(inlined=True)
def extremum(h: float, m: ModeSolution, q: Quantity, slope0: float, slope1: float) -> float:
    """Return q where its slope, given at both ends, changes sign within h s of one mode."""
    t = find_extremum(0.0, h, h * slope0 / (slope0 - slope1), slope1, m, q)
    return evaluate_motion(t, m, q)[0]


@jit_helper(inlined=True)
def value_range(
    h: float, m: ModeSolution, q: Quantity, x0: Kinematics, x1: Kinematics
) -> tuple[float, float]:
    """Return (min, max) of q over h s of one mode, from the root of its slope; x at both ends."""
    a, da, _ = evaluate_quantity(0.0, x0, q)
    b, db, _ = evaluate_quantity(h, x1, q)
    lo, hi = min(a, b), max(a, b)
    if da * db < 0:
        a = extremum(h, m, q, da, db)
        lo, hi = min(a, lo), max(a, hi)
    return lo, hi


@jit_helper(inlined=True)
def total_acceleration(params: Float1D, mode: int) -> Quantity:
    """Return the total acceleration in m/s2 as a `Quantity`: (f0 - k u - c u')/M."""
    b, mass = MODES + mode * MODE_SIZE, params[MASS]
    return params[b + 2] / mass, -params[b] / mass, -params[b + 1] / mass, 0.0, 0.0


@jit_helper(inlined=True)
def widen_extremes(
    extremes: Float1D,
    params: Float1D,
    mode: int,
    h: float,
    m: ModeSolution,
    x0: Kinematics,
    x1: Kinematics,
) -> None:
    """Widen `extremes` (`EXTREME_NAMES`) by h s of motion in one mode."""
    lo, hi = value_range(h, m, (0.0, 1.0, 0.0, 0.0, 0.0), x0, x1)
    extremes[0], extremes[1] = max(extremes[0], hi), min(extremes[1], lo)
    lo, hi = value_range(h, m, total_acceleration(params, mode), x0, x1)
    extremes[2], extremes[3] = max(extremes[2], hi), min(extremes[3], lo)
    if mode & 1:
        extremes[4] = max(
            extremes[4], value_range(h, m, contact_guard(params, mode, 0, 0.0), x0, x1)[1]
        )
    if mode & 2:
        extremes[5] = min(
            extremes[5], -value_range(h, m, contact_guard(params, mode, 1, 0.0), x0, x1)[1]
        )


@jit_helper()
def widen_by_segment(
    extremes: Float1D, count: int, state: Float1D, params: Float1D, segment: ModeSegment
) -> int:
    """Widen the extremes of a cycle by a segment of its motion; see `Observer`."""
    mode, _, dt, side, _, m, x0, x1 = segment
    widen_extremes(extremes, params, mode, dt, m, x0, x1)
    if side >= 0:
        extremes[6 + side] += state[CONTACT_R + side]
    return count


@jit_helper(inlined=True)
def widen_by_step(
    extremes: Float1D,
    params: Float1D,
    h: float,
    wave: Sinusoid,
    start: tuple[float, float],
    mode: int,
    step: ModeStep,
) -> bool:
    """Widen the extremes of a cycle by a step without events; see `Recorder`.

    A quantity has its extremum at an end of the step, or where its slope changes sign; only then is
    a root sought.
    """
    u, v = start
    _, _, r1, rs0, rs1 = step.right
    _, _, l1, ls0, ls1 = step.left
    extremes[0], extremes[1] = max(extremes[0], step.u), min(extremes[1], step.u)
    extremes[2], extremes[3] = max(extremes[2], step.a), min(extremes[3], step.a)
    extremes[4] = max(extremes[4], r1) if mode & 1 else extremes[4]
    extremes[5] = min(extremes[5], -l1) if mode & 2 else extremes[5]
    b = MODES + mode * MODE_SIZE
    k, c = params[b], params[b + 1]
    has_extremum = (
        v * step.v < 0
        or (c * step.d0 + k * v) * (c * step.d1 + k * step.v) < 0
        or (mode & 1) * rs0 > 0 > rs1
        or (mode & 2) * ls0 > 0 > ls1
    )
    if has_extremum:
        m, x0 = mode_solution(params, mode, u, v, 0.0, 0.0, wave)
        widen_extremes(extremes, params, mode, h, m, x0, solution_at(h, m))
    return True


@jit_helper()
def reset_extremes(row: Float1D, state: Float1D, params: Float1D) -> None:
    """Set the extremes of a cycle to the values at its start."""
    u, v, mode = state[U], state[V], contact_mode(state)
    b = MODES + mode * MODE_SIZE
    row[0] = row[1] = u
    row[2] = row[3] = (params[b + 2] - params[b + 1] * v - params[b] * u) / params[MASS]
    row[4], row[5] = bumper_forces(params, mode, v, state[U_R], state[U_L], 0.0)
    row[6] = row[7] = 0.0


@jit_kernel(
    types.void(
        float64[::1],
        float64[::1],
        float64[::1],
        float64[::1],
        int64,
        int64[::1],
        DRIVE_TYPE,
        float64[:, :, ::1],
        float64[:, ::1],
    ),
)
def run_stepped_sine(
    state: Float1D,
    params: Float1D,
    w: Float1D,
    peaks: Float1D,
    cycles: int,
    steps: Int1D,
    work: SineDrive,
    extremes: Float3D,
    end_states: Float2D,
) -> None:
    """Run whole cycles of A = peak sin(w t) at each w in 1/s in turn, `steps` steps per cycle.

    The last cycles at each w, as many as `extremes` has, are measured. The tables of `work`, for
    the most steps, are workspace; `params` is updated for each w. extremes (w, measured cycle, 8),
    `EXTREME_NAMES`; end_states (w, STATE_SIZE): the state after each w.
    """
    unmeasured = cycles - extremes.shape[1]
    for i in range(w.size):
        drive = SineDrive(peaks[i], w[i], steps[i], work.table, work.particular)
        if i == 0 or w[i] != w[i - 1] or peaks[i] != peaks[i - 1] or steps[i] != steps[i - 1]:
            prepare_drive(params, drive)
        for cycle in range(cycles):
            if cycle < unmeasured:
                advance_steps(
                    state, params, drive, drive.steps, accept_step, ignore_segment, None, 0
                )
                continue
            row = extremes[i, cycle - unmeasured]
            reset_extremes(row, state, params)
            advance_steps(
                state, params, drive, drive.steps, widen_by_step, widen_by_segment, row, 0
            )
        # Entry by entry: copying a row makes numba compile an error message for unequal lengths.
        for index in range(state.size):
            end_states[i, index] = state[index]


@dataclass(frozen=True, slots=True, eq=False)
class SteppedSineResponse:
    """Extremes of each cycle and final state of each step of a stepped sine, SI.

    extremes (step, measured cycle, 8), `EXTREME_NAMES`; states (step, STATE_SIZE). Extremes are
    true ones, from roots of the slope and from both sides of a jump, not samples. F_R >= 0,
    F_L <= 0; onsets are counted in the cycle in which they happen. `range_exits`: of each step, the
    first exit of each range of a law; empty for models without such laws.
    """

    extremes: Float3D
    states: Float2D
    range_exits: tuple[tuple[RangeExit, ...], ...] = ()

    def column(self, name: str) -> Float2D:
        """Return one of `EXTREME_NAMES`, (step, cycle)."""
        return self.extremes[:, :, EXTREME_NAMES.index(name)]


def validate_frequencies(
    frequencies_hz: Sequence[float] | Float1D, acceleration: float | Float1D, cycles: int
) -> Float1D:
    """Return the frequencies of a sweep in Hz, (n,); InputError if it cannot be driven."""
    frequencies = np.asarray(frequencies_hz, dtype=np.float64)
    valid = np.isfinite(frequencies) & (frequencies > 0)
    if not valid.all():
        first = int(np.argmin(valid))
        raise InputError(
            "not a drive frequency",
            key=f"frequencies_hz[{first}]",
            value=float(frequencies[first]),
            allowed="above 0 Hz, finite",
        )
    if not np.isfinite(acceleration).all():
        raise InputError(
            "not an acceleration", key="acceleration", value=acceleration, allowed="m/s2, finite"
        )
    if cycles < 1:
        raise InputError("too few cycles", key="cycles", value=cycles, allowed="1 or more")
    return frequencies


def simulate_stepped_sine(
    parameters: Parameters,
    frequencies_hz: Sequence[float] | Float1D,
    acceleration: float | Float1D,
    cycles: int,
    steps_per_cycle: int = 16,
    state: Float1D | None = None,
    measured_cycles: int | None = None,
) -> SteppedSineResponse:
    """Simulate whole `cycles` of A = acceleration sin(2 pi f t) in m/s2 at each frequency in turn.

    `acceleration` is one, or one at each frequency, (frequency,).
    Starts from `state` (not modified) or from rest. A is continuous at a change of frequency; the
    velocity of the table is not, so this is the ideal sweep, which no table can drive.
    `steps_per_cycle` is raised where a mode turns more than `closed_form.MAX_PHASE_STEP_RAD` in a
    step; the result does not depend on it unless the motion is chaotic. Extremes are computed of
    the last `measured_cycles` of each step, by default of all. InputError names inputs that cannot
    be driven.
    """
    frequencies = validate_frequencies(frequencies_hz, acceleration, cycles)
    if steps_per_cycle < MIN_STEPS_PER_CYCLE:
        raise InputError(
            "a contact could begin and end undetected",
            key="steps_per_cycle",
            value=steps_per_cycle,
            allowed=f"{MIN_STEPS_PER_CYCLE} or more",
        )
    params = continuous_params(parameters)
    steps = np.array(
        [steps_per_cycle * substep_count(params, 1 / (f * steps_per_cycle)) for f in frequencies],
        dtype=np.int64,
    )
    current = rest_state(parameters) if state is None else state.copy()
    current[BASE] = 0.0
    measured = cycles if measured_cycles is None else min(measured_cycles, cycles)
    extremes = np.empty((frequencies.size, measured, len(EXTREME_NAMES)))
    end_states = np.empty((frequencies.size, STATE_SIZE))
    peaks = np.broadcast_to(np.float64(acceleration), frequencies.shape).copy()
    work = SineDrive(0.0, 0.0, 0, np.empty((2, int(steps.max(initial=0)) + 1)), np.empty((4, 3)))
    w = 2 * math.pi * frequencies
    run_stepped_sine(current, params, w, peaks, cycles, steps, work, extremes, end_states)
    return SteppedSineResponse(extremes, end_states)
