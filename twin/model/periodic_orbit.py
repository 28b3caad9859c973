"""Whole cycles of the SNM under A = a sin(2 pi f t), with exact variations of the motion.

A state is that of `closed_form`, at a zero upcrossing of A. A variation of it is (u, v, u_r, u_l)
in m and m/s; within a mode it follows the mode's linear flow, through an event the saltation:
    onset on j      delta_v += (C_j / M) (delta_uj - delta_face), then delta_uj = delta_face
    detachment      no change: force and clearance rate are zero there
where the face in contact lies at u_R = u - G0R, u_L = u + G0L. A derivative by a parameter is a
variation with a source: the derivative of the mode's particular solution. The Jacobian is the
product of flows and saltations. At a grazing contact it jumps by a finite amount, then grows with
the square root of the depth.
"""

import math

import numpy as np
from numba import float64, int64, types

from table_io.block import Float1D, Float2D
from table_io.compilation import jit_helper, jit_kernel
from twin.model.closed_form import (
    MAX_PHASE_STEP_RAD,
    continuous_params,
    highest_angular_frequency,
)
from twin.model.contact_regime import (
    BASE,
    C_R,
    CONTACT_R,
    DENORMAL_LIMIT,
    G_R,
    K_R,
    MASS,
    MAX_EVENTS_PER_STEP,
    MODE_SIZE,
    MODES,
    R_R,
    U_L,
    U_R,
    Kinematics,
    ModeSolution,
    Quantity,
    Sinusoid,
    U,
    V,
    advance_to_event,
    contact_guard,
    contact_mode,
    evaluate_quantity,
    find_root,
    solution_at,
    transition_matrix,
)  # fmt: skip
from twin.model.parameters import Parameters
from twin.model.stepped_sine import validate_frequencies

ORBIT_STEPS_PER_CYCLE = 16
MAX_ONSETS_PER_CYCLE = 40  # per side; room in `contact_events`
# Time in s of a segment, side of the event at its end, side released at its start (or -1), motion.
Segment = tuple[float, int, int, ModeSolution, Kinematics, Kinematics]
PARAMETER_COUNT = 4  # last columns of variations: by frequency, peak, right and left gap


@jit_helper()
def flow_variations(
    variations: Float2D, params: Float1D, mode: int, wave: Sinusoid, start: float, stop: float
) -> None:
    """Advance `variations` (4, n + 4) within one mode from `start` to `stop` in s.

    The last four columns have sources: derivatives by frequency, peak, right and left gap.
    """
    b = MODES + mode * MODE_SIZE
    k, c, a, w2 = params[b], params[b + 1], params[b + 3], params[b + 4]
    peak, w, _ = wave
    e11, e12, e21, e22 = transition_matrix(stop - start, a, w2)
    decay_r = math.exp(-params[R_R] * (stop - start))
    decay_l = math.exp(-params[R_R + 1] * (stop - start))
    free = variations.shape[1] - PARAMETER_COUNT
    for i in range(variations.shape[1]):
        u, v = variations[0, i], variations[1, i]
        u0 = v0 = u1 = v1 = gap_r = gap_l = 0.0  # of the particular solution, at both ends
        if i == free:
            u0, v0 = vary_frequency(params[MASS], k, c, peak, w, start)
            u1, v1 = vary_frequency(params[MASS], k, c, peak, w, stop)
        elif i == free + 1:
            re, im = k - params[MASS] * w * w, c * w
            scale = params[MASS] / (re * re + im * im)
            alpha, beta = -re * scale, im * scale
            s, co = math.sin(w * start), math.cos(w * start)
            u0, v0 = alpha * s + beta * co, w * (alpha * co - beta * s)
            s, co = math.sin(w * stop), math.cos(w * stop)
            u1, v1 = alpha * s + beta * co, w * (alpha * co - beta * s)
        elif i == free + 2:
            gap_r = 1.0
            u0 = u1 = params[K_R] / k if mode & 1 else 0.0
        elif i == free + 3:
            gap_l = 1.0
            u0 = u1 = -params[K_R + 1] / k if mode & 2 else 0.0
        u, v = u - u0, v - v0
        u, v = u1 + e11 * u + e12 * v, v1 + e21 * u + e22 * v
        variations[0, i], variations[1, i] = u, v
        variations[2, i] = u - gap_r if mode & 1 else decay_r * variations[2, i]
        variations[3, i] = u + gap_l if mode & 2 else decay_l * variations[3, i]


@jit_helper()
def vary_frequency(
    mass: float, k: float, c: float, peak: float, w: float, t: float
) -> tuple[float, float]:
    """Return d(p, p')/df at t s of the particular solution p = alpha sin(w t) + beta cos(w t)."""
    re, im = k - mass * w * w, c * w
    d = re * re + im * im
    d_re = -2 * mass * w
    d_d = 2 * (re * d_re + im * c)
    alpha, beta = -mass * peak * re / d, mass * peak * im / d
    d_alpha = -mass * peak * (d_re - re * d_d / d) / d
    d_beta = mass * peak * (c - im * d_d / d) / d
    s, co = math.sin(w * t), math.cos(w * t)
    p_w = d_alpha * s + d_beta * co + t * (alpha * co - beta * s)
    v_w = (alpha + w * d_alpha) * co - (beta + w * d_beta) * s - w * t * (alpha * s + beta * co)
    return 2 * math.pi * p_w, 2 * math.pi * v_w


@jit_helper()
def jump_variations(variations: Float2D, params: Float1D, side: int, onset: bool) -> None:
    """Pass `variations` (4, n + 4) through an onset or release on `side`."""
    gap = variations.shape[1] - 2 + side
    sign = 1.0 - 2.0 * side
    if onset:
        for i in range(variations.shape[1]):
            face = variations[0, i] - (sign if i == gap else 0.0)
            variations[1, i] += params[C_R + side] / params[MASS] * (variations[2 + side, i] - face)
            variations[2 + side, i] = face
    elif params[R_R + side] == 0.0:  # without a dashpot the face is back at once
        variations[2 + side, :] = 0.0


@jit_helper()
def vary_guard(row: Float1D, variations: Float2D, params: Float1D, mode: int, side: int) -> None:
    """Write the derivatives in m of the guard on `side` by the columns of `variations`."""
    gap = variations.shape[1] - 2 + side
    sign = 1.0 - 2.0 * side
    relaxation_s = params[C_R + side] / params[K_R + side]
    for i in range(variations.shape[1]):
        u, v, uj = variations[0, i], variations[1, i], variations[2 + side, i]
        if (mode >> side) & 1:
            row[i] = sign * (u + relaxation_s * v) - (1.0 if i == gap else 0.0)
        else:
            row[i] = sign * (uj - u) + (1.0 if i == gap else 0.0)


@jit_helper()
def find_guard_minimum(
    h: float, m: ModeSolution, q: Quantity, x0: Kinematics, x1: Kinematics, crosses: bool
) -> float:
    """Return the time in s of the minimum of a guard within h s of a mode, else inf.

    Where it `crosses` zero at h, the minimum that it would reach in the same mode after that;
    sought for another 2 h, and 3 h if it lies beyond.
    """
    d0 = evaluate_quantity(0.0, x0, q)[1]
    d1 = evaluate_quantity(h, x1, q)[1]
    lo, hi = 0.0, h
    if crosses:
        lo = h
        while d1 <= 0.0:
            lo, hi, d0 = hi, hi + 0.25 * h, d1
            if hi >= 3 * h:
                return hi
            d1 = evaluate_quantity(hi, solution_at(hi, m), q)[1]
    if not d0 < 0.0 < d1:
        return math.inf
    return find_root(lo, hi, lo + (hi - lo) * d0 / (d0 - d1), 1.0, m, q, 1)


@jit_helper()
def record_minima(
    minima: Float2D, count: int, params: Float1D, mode: int, uj: Float1D, segment: Segment,
    variations: Float2D, work: Float2D, since: float, begin: float, wave: Sinusoid, period: float,
) -> int:  # fmt: skip
    """Append the minima of both guards in a segment of a mode to `minima`; return their number.

    `begin` is the time in s of the segment's start; `work` is workspace of the size of
    `variations`, which are those at `since`.
    """
    dt, event_side, released, m, x0, x1 = segment
    for side in range(2):
        if side == released or params[G_R + side] == math.inf:
            continue  # just released: it starts at its minimum
        q = contact_guard(params, mode, side, uj[side])
        at = find_guard_minimum(dt, m, q, x0, x1, side == event_side)
        if at == math.inf or count >= minima.shape[0]:
            continue
        row, in_contact = minima[count], (mode >> side) & 1
        row[0], row[1] = (begin + at) / period, side + 2 * in_contact
        row[2] = evaluate_quantity(at, solution_at(at, m), q)[0]
        row[2] /= params[K_R + side] if in_contact else 1.0
        work[:] = variations
        flow_variations(work, params, mode, wave, since, begin + at)
        vary_guard(row[3:], work, params, mode, side)
        count += 1
    return count


@jit_helper()
def normalize_growth(variations: Float2D) -> float:
    """Scale variation 0 to 1 m; return the logarithm of its size before."""
    size = 0.0
    for j in range(4):
        size += variations[j, 0] ** 2
    size = max(math.sqrt(size), DENORMAL_LIMIT)
    for j in range(4):
        variations[j, 0] /= size
    return math.log(size)


@jit_helper()
def end_at_period(variations: Float2D, state: Float1D, params: Float1D, w: float, t: float) -> None:
    """Turn the derivative by frequency at fixed time t s into that at the end of the cycles."""
    mode = contact_mode(state)
    b, column = MODES + mode * MODE_SIZE, variations.shape[1] - PARAMETER_COUNT
    u, v, dt = state[U], state[V], -2 * math.pi * t / w
    acceleration = (params[b + 2] - params[b + 1] * v - params[b] * u) / params[MASS]
    variations[0, column] += v * dt
    variations[1, column] += acceleration * dt
    for side in range(2):
        rate = v if (mode >> side) & 1 else -params[R_R + side] * state[U_R + side]
        variations[2 + side, column] += rate * dt


@jit_kernel(
    types.UniTuple(int64, 2)(
        float64[::1], float64[::1], float64, float64, int64, int64, float64[:, ::1],
        float64[::1], float64[:, ::1], float64[:, ::1],
    ),
    cache=True,
)  # fmt: skip
def advance_cycles(
    state: Float1D, params: Float1D, peak: float, w: float, steps: int, cycles: int,
    variations: Float2D, growth: Float1D, events: Float2D, minima: Float2D,
) -> tuple[int, int]:  # fmt: skip
    """Advance `state` and `variations` (4, n + 4) through whole cycles; return (events, minima).

    The last four columns of `variations` are derivatives by frequency in Hz, peak, right and left
    gap, at the end of the cycles. `variations` may have no column at all.
    events (m, 3): time in cycles, side (0 right, 1 left) and onset 1 or release 0 of each. growth
    (cycles,), unless empty: logarithm of the growth of variation 0 over each cycle, which is then
    normalized to 1 m.
    minima (l, 3 + n + 4): local minima of the guards, from which contacts appear and disappear:
    time in cycles; side, + 2 if it is in contact; clearance, or push over K_j, in m, negative where
    the minimum was cut off by the event that it caused; its derivatives.
    """
    h, phase_step, period = 2 * math.pi / (w * steps), 2 * math.pi / steps, 2 * math.pi / w
    event_count, minimum_count, since = 0, 0, 0.0  # s: variations are those at `since`
    work, uj, wave = np.empty_like(variations), np.empty(2), (peak, w, 0.0)
    for cycle in range(cycles):
        for k in range(steps):
            t, released = 0.0, -1
            for attempt in range(MAX_EVENTS_PER_STEP):
                mode, begin = contact_mode(state), (cycle * steps + k) * h + t
                uj[0], uj[1] = state[U_R], state[U_L]
                dt, side, m, x0, x1 = advance_to_event(
                    state, params, h - t, 0.0, 0.0, (peak, w, phase_step * k + w * t),
                    attempt + 1 < MAX_EVENTS_PER_STEP,
                )  # fmt: skip
                t += dt
                if minima.shape[0]:
                    minimum_count = record_minima(
                        minima, minimum_count, params, mode, uj, (dt, side, released, m, x0, x1),
                        variations, work, since, begin, wave, period,
                    )  # fmt: skip
                if side < 0:
                    break
                onset = state[CONTACT_R + side] > 0
                released = -1 if onset else side
                if variations.shape[1]:
                    flow_variations(variations, params, mode, wave, since, begin + dt)
                    jump_variations(variations, params, side, onset)
                    since = begin + dt
                if event_count < events.shape[0]:
                    events[event_count, 0] = cycle + (k + t / h) / steps
                    events[event_count, 1], events[event_count, 2] = side, state[CONTACT_R + side]
                event_count += 1
        if growth.size:
            end = (cycle + 1) * period
            flow_variations(variations, params, contact_mode(state), wave, since, end)
            since, growth[cycle] = end, normalize_growth(variations)
    if variations.shape[1]:
        end = cycles * period
        flow_variations(variations, params, contact_mode(state), wave, since, end)
        end_at_period(variations, state, params, w, end)
    return event_count, minimum_count


def steps_per_cycle(highest_w: float, frequency_hz: float) -> int:
    """Return the steps of a cycle in which no event is missed, by `highest_angular_frequency`."""
    phase = highest_w / (frequency_hz * ORBIT_STEPS_PER_CYCLE)
    return ORBIT_STEPS_PER_CYCLE * max(1, math.ceil(phase / MAX_PHASE_STEP_RAD))


def _run_cycles(
    parameters: Parameters,
    frequency_hz: float,
    acceleration: float,
    state: Float1D,
    cycles: int,
    variations: Float2D,
    growth: Float1D,
    events: Float2D,
) -> tuple[Float1D, int]:
    """Return (the state `cycles` later, the number of events)."""
    validate_frequencies([frequency_hz], acceleration, cycles)
    params, end_state = continuous_params(parameters), state.copy()
    end_state[BASE] = 0.0
    count, _ = advance_cycles(
        end_state, params, acceleration, 2 * math.pi * frequency_hz,
        steps_per_cycle(highest_angular_frequency(params), frequency_hz), cycles, variations,
        growth, events, NO_MINIMA,
    )  # fmt: skip
    return end_state, int(count)


NO_GROWTH, NO_EVENTS, NO_MINIMA = np.empty(0), np.empty((0, 3)), np.empty((0, 3))


def lyapunov_exponent(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[float, Float1D]:
    """Return (largest Lyapunov exponent per cycle, state `cycles` later) from a settled state."""
    variation, growth = np.zeros((4, 1 + PARAMETER_COUNT)), np.empty(cycles)
    variation[:2, 0] = 1.0
    end_state, _ = _run_cycles(
        parameters, frequency_hz, acceleration, state, cycles, variation, growth, NO_EVENTS
    )
    return float(growth.mean()), end_state


def contact_events(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[Float2D, Float1D]:
    """Return (contact events (n, 3) in order of time, the state `cycles` later).

    Columns: time in cycles, side 0 right or 1 left, onset 1 or release 0.
    """
    events = np.empty((4 * MAX_ONSETS_PER_CYCLE * cycles, 3))
    end_state, count = _run_cycles(
        parameters, frequency_hz, acceleration, state, cycles, np.empty((4, 0)), NO_GROWTH, events
    )
    return events[:count], end_state


def contact_onset_times(
    parameters: Parameters, frequency_hz: float, acceleration: float, state: Float1D, cycles: int
) -> tuple[Float1D, Float1D, Float1D]:
    """Return (right and left contact onset times in cycles, the state `cycles` later)."""
    events, end_state = contact_events(parameters, frequency_hz, acceleration, state, cycles)
    right, left = (events[(events[:, 1] == side) & (events[:, 2] == 1), 0] for side in (0, 1))
    return right, left, end_state
