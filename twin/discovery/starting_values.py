"""Starting values of a fit, read from the recordings: a model may be that of another specimen.

Along the measured motion the forces are linear in the parameters of the base: the damper's in K
and C, a bumper's in K_j, C_j and K_j times its gap, wherever its load cells show contact.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from table_io.block import Float1D, Float2D
from twin.discovery.contact import find_contact_thresholds, read_contact
from twin.discovery.motion import MeasuredMotion
from twin.discovery.parameters import BASE_PARAMETERS, GapKey, ParameterKey, ParameterSet
from twin.discovery.residuals import LogResiduals
from twin.discovery.selection import mean_square
from twin.discovery.signals import LogSignals

MIN_SAMPLES = 20  # of a regression of a few columns


def choose_start(log_residuals: Sequence[LogResiduals], parameters: ParameterSet) -> ParameterSet:
    """Return the parameters, or those that the recordings themselves suggest if they fit better."""
    read = _read_start(log_residuals, parameters)
    costs = [
        mean_square([residuals.evaluate(start) for residuals in log_residuals])
        for start in (parameters, read)
    ]
    return read if costs[1] < costs[0] else parameters


def measure_gaps(signals: LogSignals, contact_n: float) -> LogSignals:
    """Return the signals with the gaps that the load cells show where none is stated.

    `contact_n` is a least contact threshold in N.
    """
    if all(map(math.isfinite, signals.gaps_m)):
        return signals
    m = signals.fuse_motion()
    if not m.has_load_cells:
        return signals
    contact = read_contact(signals, m, find_contact_thresholds(signals, m, contact_n))
    gaps, measured = list(m.gaps_m), []
    for side, stated in enumerate(m.gaps_m):
        fitted = _fit_push(m, side, contact[side] > 0)
        if math.isinf(stated) and fitted is not None and fitted[2] < float(np.nanmax(np.abs(m.u))):
            gaps[side] = fitted[2]
            measured.append(("right", "left")[side])
    return replace(signals, gaps_m=(gaps[0], gaps[1]), measured_sides=tuple(measured))


def _read_start(log_residuals: Sequence[LogResiduals], parameters: ParameterSet) -> ParameterSet:
    """Return the parameters with what a linear regression finds, where that is positive."""
    columns, forces, pushes = [], [], []
    read: dict[ParameterKey, float] = {}
    for residuals in log_residuals:
        m = residuals.motion()
        force = residuals.measured_forces(m, m.mass_kg)[0]
        used = m.moving & m.good & np.isfinite(force)
        own = np.array([m.u, m.v, np.ones(m.u.size), *_press(m)])
        columns.append(own[:, used])
        forces.append(force[used])
        sides = [_fit_push(m, side, residuals.contact_state[side] > 0) for side in range(2)]
        fitted = [(fit, gap) for fit, gap in zip(sides, m.gaps_m, strict=True) if fit is not None]
        pushes += [fit for fit, _ in fitted]
        errors = [fit[2] - stated for fit, stated in fitted if math.isfinite(stated)]
        if errors:
            read[GapKey(residuals.log_number)] = float(np.mean(errors))
    linear = solve_columns(np.concatenate(columns, axis=1), np.concatenate(forces))
    if linear is None:
        return parameters
    bumper = np.mean([fit[:2] for fit in pushes], axis=0) if pushes else linear[3:]
    for (key, _, tied), value in zip(BASE_PARAMETERS, (*linear[:2], *bumper), strict=True):
        if value > 0.0:
            read |= dict.fromkeys(tied or (key,), float(value))
    return parameters.with_values(read)


def _press(m: MeasuredMotion) -> Float2D:
    """Return depth and its rate in bumpers that no load cell measures, (2, sample), signed."""
    if m.has_load_cells or m.damper is not None:
        return np.zeros((2, m.u.size))
    right, left = m.gaps_m
    depth = np.clip(m.u - right, 0.0, None) - np.clip(-m.u - left, 0.0, None)
    return np.array([depth, np.where(depth != 0.0, m.v, 0.0)])


def _fit_push(
    m: MeasuredMotion, side: int, in_contact: npt.NDArray[np.bool_]
) -> tuple[float, float, float] | None:
    """Return K_j, C_j and the gap in m of a side; None unless its cells show a bumper."""
    sign, push = ((1.0, m.right), (-1.0, m.left))[side]
    used = in_contact & m.moving & m.good & np.isfinite(push)
    fit = solve_columns(np.array([sign * m.u, sign * m.v, -np.ones(m.u.size)])[:, used], push[used])
    if fit is None or fit[0] <= 0.0:
        return None
    return float(fit[0]), float(fit[1]), float(fit[2] / fit[0])


def solve_columns(columns: Float2D, force: Float1D) -> Float1D | None:
    """Return the coefficients of the columns, (column,); None with too few samples, (sample,)."""
    if force.size < MIN_SAMPLES:
        return None
    size = np.abs(columns).max(axis=1, keepdims=True)
    size[size == 0.0] = 1.0
    solution: Float1D = np.linalg.lstsq((columns / size).T, force, rcond=None)[0] / size[:, 0]
    return solution
