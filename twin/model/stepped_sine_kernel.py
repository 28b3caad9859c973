"""Compiled kernel of `stepped_sine`: whole cycles of A = peak sin(w t) at each frequency."""

import math

import numpy as np
import numpy.typing as npt
from numba import float64, int64, types

from table_io.block import Float1D, Float2D, Int1D
from table_io.compilation import jit_helper, jit_kernel
from twin.model.contact_regime import (
    CONTACT_R,
    E_L,
    E_R,
    MASS,
    MAX_EVENTS_PER_STEP,
    MODE_SIZE,
    MODES,
    R_L,
    R_R,
    U_L,
    U_R,
    Kinematics,
    ModeSolution,
    Quantity,
    U,
    V,
    advance_to_event,
    bumper_forces,
    contact_guard,
    contact_mode,
    evaluate_quantity,
    find_root,
    flush_denormal,
    mode_solution,
    solution_at,
    stays_positive,
    step_guard,
    transition_matrix,
)  # fmt: skip

Float3D = npt.NDArray[np.float64]


@jit_helper()
def extremum(h: float, m: ModeSolution, q: Quantity, slope0: float, slope1: float) -> float:
    """Return q where its slope, given at both ends, changes sign within h s of one mode."""
    t = find_root(0.0, h, h * slope0 / (slope0 - slope1), slope1, m, q, 1)
    return evaluate_quantity(t, solution_at(t, m), q)[0]


@jit_helper()
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


@jit_helper()
def total_acceleration(params: Float1D, mode: int) -> Quantity:
    """Return the total acceleration in m/s2 as a `Quantity`: (f0 - k u - c u')/M."""
    b, mass = MODES + mode * MODE_SIZE, params[MASS]
    return params[b + 2] / mass, -params[b] / mass, -params[b + 1] / mass, 0.0, 0.0


@jit_helper()
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
def widen_through_events(
    state: Float1D, params: Float1D, h: float, peak: float, w: float, phase: float, row: Float1D,
    measured: bool,
) -> None:  # fmt: skip
    """Advance `state` over a step through any events; widen `row` by its extremes if `measured`."""
    t = 0.0
    for attempt in range(MAX_EVENTS_PER_STEP):
        mode = contact_mode(state)
        search = attempt + 1 < MAX_EVENTS_PER_STEP
        dt, side, m, x0, x1 = advance_to_event(
            state, params, h - t, 0.0, 0.0, (peak, w, phase + w * t), search
        )
        if measured:
            widen_extremes(row, params, mode, dt, m, x0, x1)
        t += dt
        if side < 0:
            break
        row[6 + side] += state[CONTACT_R + side]


@jit_helper()
def prepare_frequency(
    params: Float1D, table: Float2D, particular: Float2D, peak: float, w: float, steps: int
) -> None:
    """Compute transition matrices, sine table and particular solutions of one frequency.

    particular (4 modes, 3): u = q0 + alpha sin + beta cos, re = k - M w^2, im = c w,
    alpha = -M peak re / (re^2 + im^2), beta = +M peak im / (re^2 + im^2).
    """
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
        scale = mass * peak / (re * re + im * im)
        particular[mode, 0] = params[b + 2] / params[b]
        particular[mode, 1], particular[mode, 2] = -re * scale, im * scale


@jit_helper()
def reset_extremes(row: Float1D, state: Float1D, params: Float1D) -> None:
    """Set the extremes of a cycle to the values at its start."""
    u, v, mode = state[U], state[V], contact_mode(state)
    b = MODES + mode * MODE_SIZE
    row[0] = row[1] = u
    row[2] = row[3] = (params[b + 2] - params[b + 1] * v - params[b] * u) / params[MASS]
    row[4], row[5] = bumper_forces(params, mode, v, state[U_R], state[U_L], 0.0)
    row[6] = row[7] = 0.0


@jit_helper()
def advance_cycle(
    state: Float1D, params: Float1D, table: Float2D, particular: Float2D,
    peak: float, w: float, steps: int, row: Float1D, measured: bool,
) -> None:  # fmt: skip
    """Advance `state` through one cycle in `steps` steps; row (8,) becomes its `EXTREME_NAMES`.

    Unless `measured`, row is undefined afterwards: roots are sought of events only.

    A step whose guards r, l (slopes rs, ls) may have turned negative is repeated in
    `widen_through_events`. Otherwise a quantity has its extremum at an end of the step, or where
    its slope changes sign; only then is a root sought.
    """
    h, phase_step, mass = 2 * math.pi / (w * steps), 2 * math.pi / steps, params[MASS]
    reset_extremes(row, state, params)
    u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
    mode = contact_mode(state)
    for i in range(steps):
        b = MODES + mode * MODE_SIZE
        k, c, f0 = params[b], params[b + 1], params[b + 2]
        q0, alpha, beta = particular[mode, 0], particular[mode, 1], particular[mode, 2]
        s0, c0, s1, c1 = table[0, i], table[1, i], table[0, i + 1], table[1, i + 1]
        y, z = u - q0 - alpha * s0 - beta * c0, v - w * (alpha * c0 - beta * s0)
        u1 = q0 + alpha * s1 + beta * c1 + params[b + 5] * y + params[b + 6] * z
        v1 = w * (alpha * c1 - beta * s1) + params[b + 7] * y + params[b + 8] * z
        a1 = (f0 - c * v1 - k * u1) / mass
        d0, d1 = (f0 - c * v - k * u) / mass - peak * s0, a1 - peak * s1
        x0, x1 = (u, v, d0), (u1, v1, d1)
        ur1, r0, r1, rs0, rs1 = step_guard(params, mode, 0, x0, x1, ur)
        ul1, l0, l1, ls0, ls1 = step_guard(params, mode, 1, x0, x1, ul)
        if stays_positive(h, r0, r1, rs0, rs1) and stays_positive(h, l0, l1, ls0, ls1):
            row[0], row[1] = max(row[0], u1), min(row[1], u1)
            row[2], row[3] = max(row[2], a1), min(row[3], a1)
            row[4] = max(row[4], r1) if mode & 1 else row[4]
            row[5] = min(row[5], -l1) if mode & 2 else row[5]
            has_extremum = measured and (
                v * v1 < 0
                or (c * d0 + k * v) * (c * d1 + k * v1) < 0
                or (mode & 1) * rs0 > 0 > rs1
                or (mode & 2) * ls0 > 0 > ls1
            )
            if has_extremum:
                m, start = mode_solution(params, mode, u, v, 0.0, 0.0, (peak, w, phase_step * i))
                widen_extremes(row, params, mode, h, m, start, solution_at(h, m))
            u, v, ur, ul = u1, v1, flush_denormal(ur1), flush_denormal(ul1)
        else:
            state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul
            widen_through_events(state, params, h, peak, w, phase_step * i, row, measured)
            u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
            mode = contact_mode(state)
    state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul


@jit_kernel(
    types.void(
        float64[::1], float64[::1], float64[::1], float64[::1], int64, int64[::1],
        float64[:, ::1], float64[:, ::1], float64[:, :, ::1], float64[:, ::1],
    ),
    cache=True,
)  # fmt: skip
def run_stepped_sine(
    state: Float1D,
    params: Float1D,
    w: Float1D,
    peaks: Float1D,
    cycles: int,
    steps: Int1D,
    table: Float2D,
    particular: Float2D,
    extremes: Float3D,
    end_states: Float2D,
) -> None:
    """Run whole cycles of A = peak sin(w t) at each w in 1/s in turn, `steps` steps per cycle.

    The last cycles at each w, as many as `extremes` has, are measured.

    table (2, max steps + 1) and particular (4, 3) are workspace, `params` is updated for each w.
    extremes (w, measured cycle, 8), `EXTREME_NAMES`; end_states (w, STATE_SIZE): the state after
    each w.
    """
    for i in range(w.size):
        if i == 0 or w[i] != w[i - 1] or peaks[i] != peaks[i - 1] or steps[i] != steps[i - 1]:
            prepare_frequency(params, table, particular, peaks[i], w[i], steps[i])
        unmeasured = cycles - extremes.shape[1]
        for cycle in range(cycles):
            row = extremes[i, max(cycle - unmeasured, 0)]
            measured = cycle >= unmeasured
            advance_cycle(state, params, table, particular, peaks[i], w[i], steps[i], row, measured)
        # Entry by entry: copying a row makes numba compile an error message for unequal lengths.
        for index in range(state.size):
            end_states[i, index] = state[index]
