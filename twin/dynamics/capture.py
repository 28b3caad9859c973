"""Capture of motions by attractors: compiled, for maps that are compiled and for others.

A point is the coordinates x at phase 0 and the contacts there. It is captured by an attractor once
it lies in a region around a periodic orbit from which nothing returns, or `CAPTURE_HITS` times in a
row in cells that only one chaotic attractor visits.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import boolean, float64, int64, types

from table_io.block import Float1D, Float2D, Int1D
from table_io.compilation import jit_helper
from twin.model.stepped_sine import Float3D

Bool3D = npt.NDArray[np.bool_]

CAPTURE_HITS = 3  # points in a row in the cells of a chaotic attractor
UNDECIDED = -1  # label of a start that no attractor has captured


class CaptureRegions(NamedTuple):
    """Where a point is captured, and by which attractor (`owners`, `cell_owners`).

    Region: a point x (n,) with the contacts of `contacts` (m, 2) and |factor (x - center)| <= 1;
    extents (m, 2): its half widths in u and v. Cells (k, l, l) of (u, v) in boxes (k, 4): least u,
    cells per m, least v, cells per m/s.
    """

    centers: Float2D
    factors: Float3D
    extents: Float2D
    contacts: Float2D
    owners: Int1D
    cells: Bool3D
    boxes: Float2D
    cell_owners: Int1D


_MATRIX, _LABELS = float64[:, ::1], int64[::1]
REGIONS_TYPE = types.NamedTuple(
    [
        _MATRIX,
        float64[:, :, ::1],
        _MATRIX,
        _MATRIX,
        _LABELS,
        boolean[:, :, ::1],
        _MATRIX,
        _LABELS,
    ],
    CaptureRegions,
)


@jit_helper()
def capturing_region(
    x: Float1D, contact_r: float, contact_l: float, regions: CaptureRegions
) -> int:
    """Return the attractor whose region holds a point, or `UNDECIDED`."""
    u, v, size = x[0], x[1], x.size
    for i in range(regions.owners.size):
        if (
            abs(u - regions.centers[i, 0]) > regions.extents[i, 0]
            or abs(v - regions.centers[i, 1]) > regions.extents[i, 1]
            or contact_r != regions.contacts[i, 0]
            or contact_l != regions.contacts[i, 1]
        ):
            continue
        distance2 = 0.0
        for j in range(size):
            component = 0.0
            for k in range(size):
                component += regions.factors[i, j, k] * (x[k] - regions.centers[i, k])
            distance2 += component * component
        if distance2 <= 1.0:
            return regions.owners[i]
    return UNDECIDED


@jit_helper()
def visiting_attractor(x: Float1D, regions: CaptureRegions) -> int:
    """Return the chaotic attractor that alone visits the cell of a point, or `UNDECIDED`."""
    label, count = UNDECIDED, regions.cells.shape[1]
    for k in range(regions.cell_owners.size):
        row = (x[0] - regions.boxes[k, 0]) * regions.boxes[k, 1]
        column = (x[1] - regions.boxes[k, 2]) * regions.boxes[k, 3]
        if 0 <= row < count and 0 <= column < count and regions.cells[k, int(row), int(column)]:
            if label != UNDECIDED:
                return UNDECIDED
            label = regions.cell_owners[k]
    return label


@jit_helper()
def update_capture(
    x: Float1D,
    contact_r: float,
    contact_l: float,
    regions: CaptureRegions,
    visited: int,
    hits: int,
) -> tuple[int, int, int]:
    """Return (attractor that captures a point or `UNDECIDED`, attractor visited, hits in a row)."""
    label = capturing_region(x, contact_r, contact_l, regions)
    if label != UNDECIDED:
        return label, label, 0
    visitor = visiting_attractor(x, regions)
    if visitor == UNDECIDED:
        return UNDECIDED, UNDECIDED, 0
    hits = hits + 1 if visitor == visited else 1
    return (visitor if hits >= CAPTURE_HITS else UNDECIDED), visitor, hits
