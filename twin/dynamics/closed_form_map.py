"""Period map of a model whose motion has a closed form between events; exact derivatives.

A variation of the state is (u, v, u_r, u_l) in m and m/s; within a mode it follows the mode's
linear flow, through an event the saltation:
    onset on j      delta_v += (C_j / M) (delta_uj - delta_face), then delta_uj = delta_face
    detachment      no change: force and clearance rate are zero there
where the face in contact lies at u_R = u - G0R, u_L = u + G0L. A derivative by a parameter is a
variation with a source: the derivative of the mode's particular solution. The Jacobian is the
product of flows and saltations. At a grazing contact it jumps by a finite amount, then grows with
the square root of the depth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np
from numba import float64, int64, types

from table_io.block import Float1D, Float2D, Int1D
from table_io.compilation import jit_helper, jit_kernel
from twin.dynamics.capture import REGIONS_TYPE, UNDECIDED, CaptureRegions, update_capture
from twin.dynamics.period_map import FREQUENCY, LEVEL, TOUCH_TOL_M, MapResult, PeriodMap
from twin.model.closed_form import (
    MAX_PHASE_STEP_RAD,
    advance_state,
    continuous_params,
    discretized_params,
    highest_angular_frequency,
    rest_state,
)
from twin.model.contact_regime import (
    C_R,
    CONTACT_R,
    DENORMAL_LIMIT,
    G_R,
    K_R,
    MASS,
    MODE_SIZE,
    MODES,
    R_R,
    STATE_SIZE,
    U_R,
    Kinematics,
    ModeSegment,
    ModeSolution,
    ModeStep,
    Quantity,
    Sinusoid,
    U,
    V,
    contact_guard,
    contact_mode,
    evaluate_motion,
    evaluate_quantity,
    find_extremum,
    transition_matrix,
)
from twin.model.parameters import Parameters
from twin.model.solver import OUTPUT_COUNT
from twin.model.stepped_sine import (
    DRIVE_TYPE,
    SineDrive,
    accept_step,
    advance_steps,
    ignore_segment,
    prepare_drive,
    simulate_stepped_sine,
)

STEPS_PER_CYCLE = 16
MAX_ONSETS_PER_CYCLE = 40  # per side; room for events and minima
MAX_CHATTER = 6  # events at once, by rounding at a graze, up to which a map is differentiable
PARAMETER_COUNT = 4  # last columns of variations: by frequency, peak, right and left gap
SAMPLES_PER_CYCLE = 4000  # of a sampled motion: its drive is linear between them
# Indices of `Variations.progress`
SINCE, CYCLE_START, MINIMUM_COUNT, RELEASED = range(4)

_NO_GROWTH, _NO_ROWS = np.empty(0), np.empty((0, 3))


class Variations(NamedTuple):
    """Variations (4, n + 4) of a motion, and what is recorded of it: see `advance_variations`.

    `work` is workspace of the size of `variations`. progress: time in s at which the variations
    are, start of the cycle in s, number of minima, side that was released last or -1. With
    `takes_all` every step is taken from the mode's solution, as chaotic motions show the last bit.
    """

    variations: Float2D
    work: Float2D
    events: Float2D
    minima: Float2D
    progress: Float1D
    wave: Sinusoid
    takes_all: bool


@jit_helper()
def place_state(state: Float1D, x: Float1D, indices: Int1D, params: Float1D) -> int:
    """Write the state at coordinates x; return the sides whose u_j touches the mass.

    Right counts 1, left 2. A contact passes through the onset that brings u_j to the mass, so that
    the map is smooth where an onset passes through the start.
    """
    state.fill(0.0)
    for j in range(indices.size):
        state[indices[j]] = x[j]
    touching = 0
    for side in range(2):
        sign, k, c = 1.0 - 2.0 * side, params[K_R + side], params[C_R + side]
        depth = sign * state[U] - params[G_R + side]
        lag = depth - sign * state[U_R + side]
        if depth < 0.0 or lag < -TOUCH_TOL_M:
            continue
        onset_v = state[V] - sign * c / params[MASS] * lag
        state[U_R + side] = sign * depth
        if c * sign * onset_v + k * depth > 0.0:
            state[CONTACT_R + side], state[V] = 1.0, onset_v
        touching += 1 + side
    return touching


@jit_helper()
def start_variations(
    variations: Float2D, state: Float1D, touching: int, indices: Int1D, params: Float1D
) -> None:
    """Set `variations` to those of the coordinates at a state, as from `place_state`."""
    n = indices.size
    variations.fill(0.0)
    for column in range(n):
        variations[indices[column], column] = 1.0
    for side in range(2):
        if not (touching >> side) & 1:
            continue
        if state[CONTACT_R + side] > 0 and params[R_R + side] > 0:
            jump_variations(variations, params, side, True)
        else:
            variations[U_R + side] = variations[U]
            variations[U_R + side, n + 2 + side] = 2.0 * side - 1.0


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
        variations[2 + side].fill(0.0)


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
            d1 = evaluate_motion(hi, m, q)[1]
    if not d0 < 0.0 < d1:
        return math.inf
    return find_extremum(lo, hi, lo + (hi - lo) * d0 / (d0 - d1), 1.0, m, q)


@jit_helper()
def record_minima(record: Variations, params: Float1D, begin: float, segment: ModeSegment) -> None:
    """Append the minima of both guards in a segment that begins at `begin` s."""
    mode, _, dt, event_side, faces, m, x0, x1 = segment
    minima, progress = record.minima, record.progress
    for side in range(2):
        if side == int(progress[RELEASED]) or params[G_R + side] == math.inf:
            continue  # just released: it starts at its minimum
        q = contact_guard(params, mode, side, faces[side])
        at, count = find_guard_minimum(dt, m, q, x0, x1, side == event_side), int(progress[2])
        if at == math.inf or count >= minima.shape[0]:
            continue
        row, in_contact = minima[count], (mode >> side) & 1
        row[0], row[1] = (begin + at) * record.wave[1] / (2 * math.pi), side + 2 * in_contact
        row[2] = evaluate_motion(at, m, q)[0] / (params[K_R + side] if in_contact else 1.0)
        for i in range(4):
            for j in range(record.work.shape[1]):
                record.work[i, j] = record.variations[i, j]
        flow_variations(record.work, params, mode, record.wave, progress[SINCE], begin + at)
        vary_guard(row[3:], record.work, params, mode, side)
        progress[MINIMUM_COUNT] += 1


@jit_helper()
def vary_by_segment(
    record: Variations, count: int, state: Float1D, params: Float1D, segment: ModeSegment
) -> int:
    """Carry variations through the event of a segment; return the number of events."""
    mode, t, dt, side, _, m, _, _ = segment
    _, w, phase = m[6]
    progress, variations = record.progress, record.variations
    begin = progress[CYCLE_START] + phase / w
    if t == 0.0:
        progress[RELEASED] = -1.0
    if record.minima.shape[0]:
        record_minima(record, params, begin, segment)
    if side < 0:
        return count
    onset, at = state[CONTACT_R + side] > 0, begin + dt
    progress[RELEASED] = -1.0 if onset else side
    flow_variations(variations, params, mode, record.wave, progress[SINCE], at)
    jump_variations(variations, params, side, onset)
    progress[SINCE] = at
    if count < record.events.shape[0]:
        event = record.events[count]
        event[0], event[1], event[2] = at * w / (2 * math.pi), side, state[CONTACT_R + side]
    return count + 1


@jit_helper(inlined=True)
def accept_without_minimum(
    record: Variations,
    params: Float1D,
    h: float,
    wave: Sinusoid,
    start: tuple[float, float],
    mode: int,
    step: ModeStep,
) -> bool:
    """Return whether no guard has a minimum within a step; see `stepped_sine.Recorder`."""
    _, _, _, right0, right1 = step.right
    _, _, _, left0, left1 = step.left
    return not (record.takes_all or right0 < 0.0 < right1 or left0 < 0.0 < left1)


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


_VECTOR, _MATRIX, _INTEGERS = float64[::1], float64[:, ::1], int64[::1]


@jit_kernel(
    types.UniTuple(int64, 3)(
        _VECTOR, _INTEGERS, _VECTOR, DRIVE_TYPE, int64, _VECTOR, _MATRIX, _VECTOR, _MATRIX, _MATRIX
    ),
)
def advance_variations(
    x: Float1D,
    indices: Int1D,
    params: Float1D,
    drive: SineDrive,
    periods: int,
    state: Float1D,
    variations: Float2D,
    growth: Float1D,
    events: Float2D,
    minima: Float2D,
) -> tuple[int, int, int]:
    """Advance x through whole periods to `state`; return (regime at x, events, minima).

    variations (4, n + 4) become derivatives of u, v, u_r and u_l by the coordinates, by frequency
    in Hz, peak, right and left gap, at the end of the periods.
    growth (periods,), unless empty: logarithm of the growth of the given variation 0 over each
    period, which is then normalized to 1 m.
    events (m, 3): time in periods, side (0 right, 1 left) and onset 1 or release 0 of each.
    minima (l, 3 + n + 4): as in `MapResult`, derivatives by the columns of `variations`.
    """
    prepare_drive(params, drive)
    touching = place_state(state, x, indices, params)
    if not growth.size:
        start_variations(variations, state, touching, indices, params)
    regime, count, period = contact_mode(state), 0, 2 * math.pi / drive.w
    progress, wave = np.zeros(4), (drive.peak, drive.w, 0.0)
    record = Variations(
        variations, np.empty_like(variations), events, minima, progress, wave, growth.size > 0
    )
    for i in range(periods):
        progress[CYCLE_START] = i * period
        count = advance_steps(
            state,
            params,
            drive,
            drive.steps,
            accept_without_minimum,
            vary_by_segment,
            record,
            count,
        )
        if growth.size or i + 1 == periods:
            end, mode = (i + 1) * period, contact_mode(state)
            flow_variations(variations, params, mode, wave, progress[SINCE], end)
            progress[SINCE] = end
        if growth.size:
            growth[i] = normalize_growth(variations)
    end_at_period(variations, state, params, drive.w, periods * period)
    return regime, count, int(progress[MINIMUM_COUNT])


@jit_kernel(
    types.void(_VECTOR, _INTEGERS, _VECTOR, DRIVE_TYPE, int64, _MATRIX),
)
def record_points(
    x: Float1D, indices: Int1D, params: Float1D, drive: SineDrive, steps: int, points: Float2D
) -> None:
    """Advance x by `steps` of a cycle for each row of points (m, n): the coordinates after it."""
    state = np.empty(STATE_SIZE)
    prepare_drive(params, drive)
    place_state(state, x, indices, params)
    for i in range(points.shape[0]):
        advance_steps(state, params, drive, steps, accept_step, ignore_segment, None, 0)
        for j in range(indices.size):
            points[i, j] = state[indices[j]]


@jit_kernel(
    types.void(_MATRIX, _INTEGERS, _VECTOR, DRIVE_TYPE, REGIONS_TYPE, int64, _INTEGERS, _INTEGERS),
)
def capture_points(
    starts: Float2D,
    indices: Int1D,
    params: Float1D,
    drive: SineDrive,
    regions: CaptureRegions,
    max_periods: int,
    labels: Int1D,
    periods: Int1D,
) -> None:
    """Advance starts until captured: see `PeriodMap.capture`."""
    state = np.empty(STATE_SIZE)
    prepare_drive(params, drive)
    for i in range(labels.size):
        if labels[i] != UNDECIDED:
            continue
        x, visited, hits = starts[i], UNDECIDED, 0
        place_state(state, x, indices, params)
        for _ in range(max_periods):
            advance_steps(state, params, drive, drive.steps, accept_step, ignore_segment, None, 0)
            for j in range(indices.size):
                x[j] = state[indices[j]]
            periods[i] += 1
            labels[i], visited, hits = update_capture(
                x, state[CONTACT_R], state[CONTACT_R + 1], regions, visited, hits
            )
            if labels[i] != UNDECIDED:
                break


class _ClosedFormConstants(NamedTuple):
    """What a map needs of the parameters: for the kernels, and by coordinate."""

    params: Float1D
    highest_w: float
    indices: Int1D
    scales: Float1D


@lru_cache(maxsize=64)
def _make_constants(p: Parameters) -> _ClosedFormConstants:
    """Return what the maps of a model at all frequencies and levels have in common."""
    sides = (p.bumper_damping_r, p.gap_r), (p.bumper_damping_l, p.gap_l)
    memory = [
        U_R + side
        for side, (damping, gap) in enumerate(sides)
        if damping > 0 and math.isfinite(gap)
    ]
    scales = np.ones(2 + len(memory))
    scales[V] = math.sqrt(p.stiffness / p.mass)
    params = continuous_params(p)
    return _ClosedFormConstants(
        params, highest_angular_frequency(params), np.array([U, V, *memory]), scales
    )


@dataclass(frozen=True, eq=False)
class ClosedFormMap(PeriodMap):
    """Map of a model whose effects only change parameters; exact derivatives.

    x = (u, v), then u_r, u_l of the sides that have a bumper with a dashpot.
    """

    @cached_property
    def _constants(self) -> _ClosedFormConstants:
        return _make_constants(self.model.parameters)

    @property
    def indices(self) -> Sequence[int]:
        return self._constants.indices.tolist()

    @property
    def size(self) -> int:
        return self._constants.indices.size

    @property
    def scales(self) -> Float1D:
        return self._constants.scales

    @property
    def derivatives(self) -> tuple[str, ...]:
        if self.model.present_effects:  # may change the gaps in their own way
            return FREQUENCY, LEVEL
        return FREQUENCY, LEVEL, "gap_r", "gap_l"

    @cached_property
    def _inputs(self) -> tuple[Int1D, Float1D, SineDrive]:
        """Indices, parameters and drive, of which the kernels fill in what depends on the drive."""
        params, highest_w, indices, _ = self._constants
        phase_step = highest_w / (self.frequency_hz * STEPS_PER_CYCLE)
        steps = STEPS_PER_CYCLE * max(1, math.ceil(phase_step / MAX_PHASE_STEP_RAD))
        table, particular = np.empty((2, steps + 1)), np.empty((4, 3))
        w = 2 * math.pi * self.frequency_hz
        drive = SineDrive(float(self.acceleration_m_s2), w, steps, table, particular)
        return indices, params.copy(), drive

    def to_state(self, x: Float1D) -> Float1D:
        state = np.empty(STATE_SIZE)
        place_state(state, x, self._constants.indices, self._constants.params)
        return state

    def evaluate(self, x: Float1D, periods: int = 1) -> MapResult:
        n, rows = x.size, 4 * MAX_ONSETS_PER_CYCLE * periods
        state, variations = np.empty(STATE_SIZE), np.empty((4, n + PARAMETER_COUNT))
        events, minima = np.empty((rows, 3)), np.empty((rows, 3 + n + PARAMETER_COUNT))
        regime, event_count, minimum_count = advance_variations(
            x, *self._inputs, periods, state, variations, _NO_GROWTH, events, minima
        )
        at_once = np.diff(events[:event_count, 0]) == 0.0
        if np.count_nonzero(at_once) > MAX_CHATTER:
            variations[:] = math.nan
            state[:] = math.nan
        indices, stop = self._constants.indices, n + len(self.derivatives)
        derivatives = variations.take(indices, axis=0)
        codes = [4 + side + 2 * onset for _, side, onset in events[:event_count].tolist()]
        return MapResult(
            state.take(indices),
            derivatives[:, :n],
            derivatives[:, n:stop],
            (regime, *map(int, codes)),
            minima[:minimum_count, : 3 + stop],
        )

    def record(self, x: Float1D, periods: int) -> Float2D:
        points = np.empty((periods, x.size))
        record_points(x, *self._inputs, self._inputs[2].steps, points)
        return points

    def advance_half(self, x: Float1D) -> Float1D:
        points = np.empty((1, x.size))
        record_points(x, *self._inputs, self._inputs[2].steps // 2, points)
        return points[0]

    def rest(self) -> Float1D:
        return rest_state(self.model.parameters).take(self._constants.indices)

    def measure_periods(self, x: Float1D, periods: int) -> Float2D:
        return simulate_stepped_sine(
            self.model.parameters,
            [self.frequency_hz],
            self.acceleration_m_s2,
            periods,
            state=self.to_state(x),
        ).extremes[0]

    def sample_motion(self, x: Float1D, periods: int, count: int) -> Float2D:
        each = max(1, math.ceil(SAMPLES_PER_CYCLE * periods / count))
        phases = 2 * math.pi * periods * np.arange(1, each * count + 1) / (each * count)
        out = np.empty((OUTPUT_COUNT, each * count))
        rate_hz = each * count * self.frequency_hz / periods
        params = discretized_params(self.model.parameters, rate_hz)
        advance_state(self.to_state(x), params, self.acceleration_m_s2 * np.sin(phases), out)
        return out[:, each - 1 :: each]

    def measure_growth(self, x: Float1D, periods: int) -> tuple[Float1D, Float1D]:
        growth, variation = np.empty(periods), np.zeros((4, 1 + PARAMETER_COUNT))
        variation[: V + 1, 0] = 1.0
        state = np.empty(STATE_SIZE)
        advance_variations(x, *self._inputs, periods, state, variation, growth, _NO_ROWS, _NO_ROWS)
        return growth, state.take(self._constants.indices)

    def find_contacts(self, x: Float1D, periods: int) -> tuple[Float2D, Float1D]:
        """Return (contact events (n, 3) in order of time, the coordinates at the end).

        Columns: time in periods, side 0 right or 1 left, onset 1 or release 0.
        """
        state, variation = np.empty(STATE_SIZE), np.zeros((4, 1 + PARAMETER_COUNT))
        growth, events = np.empty(periods), np.empty((4 * MAX_ONSETS_PER_CYCLE * periods, 3))
        _, count, _ = advance_variations(
            x, *self._inputs, periods, state, variation, growth, events, _NO_ROWS
        )
        return events[:count], state.take(self._constants.indices)

    def capture(
        self,
        starts: Float2D,
        regions: CaptureRegions,
        max_periods: int,
        labels: Int1D,
        periods: Int1D,
    ) -> None:
        capture_points(starts, *self._inputs, regions, max_periods, labels, periods)
