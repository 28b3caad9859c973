"""Compiled kernels of `stroboscopic`: states once per cycle of A = peak sin(w t), and capture.

A point is a state at phase 0. It is captured by an attractor once it lies in a region around a
periodic orbit from which nothing returns, or `CAPTURE_HITS` times in a row in cells that only one
chaotic attractor visits.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import boolean, float64, int64, types

from table_io.block import Float1D, Float2D, Int1D
from table_io.compilation import jit_helper, jit_kernel
from twin.model.contact_regime import (
    CONTACT_R,
    MASS,
    MAX_EVENTS_PER_STEP,
    MODE_SIZE,
    MODES,
    U_L,
    U_R,
    U,
    V,
    advance_to_event,
    contact_mode,
    flush_denormal,
    stays_positive,
    step_guard,
)
from twin.model.stepped_sine_kernel import Float3D

Bool3D = npt.NDArray[np.bool_]

CAPTURE_HITS = 3  # points in a row in the cells of a chaotic attractor
UNDECIDED = -1  # label of a start that no attractor has captured


class SineDrive(NamedTuple):
    """A = peak sin(w t) in `steps` steps per cycle, with what `prepare_frequency` computes of it.

    table (2, steps + 1): sine and cosine; particular (4 modes, 3).
    """

    peak: float
    w: float
    steps: int
    table: Float2D
    particular: Float2D


class CaptureRegions(NamedTuple):
    """Where a point is captured, and by which attractor (`owners`, `cell_owners`).

    Region: a point with the contacts of `contacts` (m, 2) whose `coordinates` (d,) of the state
    fulfil |factor (z - center)| <= 1; extents (m, 2): its half widths in u and v. Cells (k, n, n)
    of (u, v) in boxes (k, 4): least u, cells per m, least v, cells per m/s.
    """

    coordinates: Int1D
    centers: Float2D
    factors: Float3D
    extents: Float2D
    contacts: Float2D
    owners: Int1D
    cells: Bool3D
    boxes: Float2D
    cell_owners: Int1D


_VECTOR, _MATRIX, _LABELS = float64[::1], float64[:, ::1], int64[::1]
_DRIVE_TYPE = types.NamedTuple([float64, float64, int64, _MATRIX, _MATRIX], SineDrive)
_REGIONS_TYPE = types.NamedTuple(
    [
        _LABELS, _MATRIX, float64[:, :, ::1], _MATRIX, _MATRIX, _LABELS,
        boolean[:, :, ::1], _MATRIX, _LABELS,
    ],
    CaptureRegions,
)  # fmt: skip


@jit_helper()
def advance_phase_steps(
    state: Float1D, params: Float1D, drive: SineDrive, first: int, last: int
) -> None:
    """Advance `state` from one step of the cycle to another, in closed form through every event.

    As `stepped_sine_kernel.advance_cycle`, but without extremes.
    """
    peak, w, table, particular = drive.peak, drive.w, drive.table, drive.particular
    h, phase_step, mass = 2 * math.pi / (w * drive.steps), 2 * math.pi / drive.steps, params[MASS]
    u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
    mode = contact_mode(state)
    for i in range(first, last):
        b = MODES + mode * MODE_SIZE
        k, c, f0 = params[b], params[b + 1], params[b + 2]
        q0, alpha, beta = particular[mode, 0], particular[mode, 1], particular[mode, 2]
        s0, c0, s1, c1 = table[0, i], table[1, i], table[0, i + 1], table[1, i + 1]
        y, z = u - q0 - alpha * s0 - beta * c0, v - w * (alpha * c0 - beta * s0)
        u1 = q0 + alpha * s1 + beta * c1 + params[b + 5] * y + params[b + 6] * z
        v1 = w * (alpha * c1 - beta * s1) + params[b + 7] * y + params[b + 8] * z
        x0 = u, v, (f0 - c * v - k * u) / mass - peak * s0
        x1 = u1, v1, (f0 - c * v1 - k * u1) / mass - peak * s1
        ur1, r0, r1, rs0, rs1 = step_guard(params, mode, 0, x0, x1, ur)
        ul1, l0, l1, ls0, ls1 = step_guard(params, mode, 1, x0, x1, ul)
        if stays_positive(h, r0, r1, rs0, rs1) and stays_positive(h, l0, l1, ls0, ls1):
            u, v, ur, ul = u1, v1, flush_denormal(ur1), flush_denormal(ul1)
            continue
        state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul
        t = 0.0
        for attempt in range(MAX_EVENTS_PER_STEP):
            wave, search = (peak, w, phase_step * i + w * t), attempt + 1 < MAX_EVENTS_PER_STEP
            dt, side, _, _, _ = advance_to_event(state, params, h - t, 0.0, 0.0, wave, search)
            t += dt
            if side < 0:
                break
        u, v, ur, ul = state[U], state[V], state[U_R], state[U_L]
        mode = contact_mode(state)
    state[U], state[V], state[U_R], state[U_L] = u, v, ur, ul


@jit_helper()
def capturing_region(state: Float1D, regions: CaptureRegions) -> int:
    """Return the attractor whose region holds a point, or `UNDECIDED`."""
    u, v, size = state[U], state[V], regions.coordinates.size
    for i in range(regions.owners.size):
        if (
            abs(u - regions.centers[i, 0]) > regions.extents[i, 0]
            or abs(v - regions.centers[i, 1]) > regions.extents[i, 1]
            or state[CONTACT_R] != regions.contacts[i, 0]
            or state[CONTACT_R + 1] != regions.contacts[i, 1]
        ):
            continue
        distance2 = 0.0
        for j in range(size):
            component = 0.0
            for k in range(size):
                difference = state[regions.coordinates[k]] - regions.centers[i, k]
                component += regions.factors[i, j, k] * difference
            distance2 += component * component
        if distance2 <= 1.0:
            return regions.owners[i]
    return UNDECIDED


@jit_helper()
def visiting_attractor(state: Float1D, regions: CaptureRegions) -> int:
    """Return the chaotic attractor that alone visits the cell of a point, or `UNDECIDED`."""
    label, count = UNDECIDED, regions.cells.shape[1]
    for k in range(regions.cell_owners.size):
        row = (state[U] - regions.boxes[k, 0]) * regions.boxes[k, 1]
        column = (state[V] - regions.boxes[k, 2]) * regions.boxes[k, 3]
        if 0 <= row < count and 0 <= column < count and regions.cells[k, int(row), int(column)]:
            if label != UNDECIDED:
                return UNDECIDED
            label = regions.cell_owners[k]
    return label


@jit_helper()
def update_capture(
    state: Float1D, regions: CaptureRegions, visited: int, hits: int
) -> tuple[int, int, int]:
    """Return (attractor that captures a point or `UNDECIDED`, attractor visited, hits in a row)."""
    label = capturing_region(state, regions)
    if label != UNDECIDED:
        return label, label, 0
    visitor = visiting_attractor(state, regions)
    if visitor == UNDECIDED:
        return UNDECIDED, UNDECIDED, 0
    hits = hits + 1 if visitor == visited else 1
    return (visitor if hits >= CAPTURE_HITS else UNDECIDED), visitor, hits


@jit_kernel(
    types.void(_VECTOR, _VECTOR, _DRIVE_TYPE, int64, int64, _MATRIX),
    cache=True,
)
def record_points(
    state: Float1D, params: Float1D, drive: SineDrive, first: int, last: int, points: Float2D
) -> None:
    """Advance `state` over steps `first` to `last` of a cycle, once per row of points.

    Row i of points (n, state): the state after pass i.
    """
    for i in range(points.shape[0]):
        advance_phase_steps(state, params, drive, first, last)
        for j in range(points.shape[1]):
            points[i, j] = state[j]


@jit_kernel(
    types.void(_MATRIX, _VECTOR, _DRIVE_TYPE, _REGIONS_TYPE, int64, _LABELS, _LABELS),
    cache=True,
)
def capture_states(
    states: Float2D, params: Float1D, drive: SineDrive, regions: CaptureRegions,
    max_cycles: int, labels: Int1D, cycles: Int1D,
) -> None:  # fmt: skip
    """Advance each undecided state (n, state) until it is captured, at most `max_cycles`.

    labels (n,) become the attractor or stay `UNDECIDED`; cycles (n,) count up. Allocates
    nothing, so that threads scale.
    """
    for i in range(labels.size):
        if labels[i] != UNDECIDED:
            continue
        state, visited, hits = states[i], UNDECIDED, 0
        for _ in range(max_cycles):
            advance_phase_steps(state, params, drive, 0, drive.steps)
            cycles[i] += 1
            labels[i], visited, hits = update_capture(state, regions, visited, hits)
            if labels[i] != UNDECIDED:
                break
