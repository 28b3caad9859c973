"""Regression problem for the baselines: forces over their noise, and one column per effect.

    damper     -M a - F_R - F_L  =  K u + C u' + const            + sum of columns
    bumpers    F_R, -F_L         =  K_j d + C_j d' + const        + sum of columns, in contact

with d the depth past the gap on either side. Motion, forces, noise, gaps and valid entries are
those of discovery, so that a baseline sees the same states. Effects with memory (hysteresis,
relaxation) are no function of the state and have no column.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.discovery.discover import PreparedLog, prepare_problem
from twin.discovery.motion import MeasuredMotion
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import FORCE_ROWS, LogResiduals
from twin.discovery.screening import assign_folds
from twin.model.model import Model

Json = dict[str, Any]
METRIC = (
    "rms of measured minus predicted forces along the measured motion, over the sensor noise, "
    "on held-out steps; the entries are those of discovery"
)


@dataclass(frozen=True, eq=False)
class ForceRegression:
    """Force over its noise (entry,), base terms and candidate terms (entry, column).

    `entries` are indices into the entries of the log residuals; `fold` and `block` are per entry.
    """

    force: Float1D
    base: Float2D
    names: tuple[str, ...]
    columns: Float2D
    entries: Int1D
    fold: Int1D
    block: Int1D


@dataclass(frozen=True, eq=False)
class RegressionProblem:
    """A log with the refitted base model, from which a baseline starts."""

    residuals: LogResiduals
    parameters: ParameterSet

    @cached_property
    def motion(self) -> MeasuredMotion:
        """Measured motion with the sensor errors that discovery assumes at the start."""
        return self.residuals.motion(self.parameters.assumed_sensors())

    @cached_property
    def u(self) -> Float1D:
        """Relative displacement (sample,) in m, corrected for the estimated tare error."""
        return self.motion.u - self.parameters.tare_error(self.residuals.log_number, "u")

    @cached_property
    def regressions(self) -> tuple[ForceRegression, ...]:
        """Regressions of the damper force and, if there are contacts, of the bumper forces."""
        regressions = [self._damper()]
        return (
            (*regressions, self._bumpers())
            if (self.residuals.entry_row == 1).any()
            else tuple(regressions)
        )

    def _damper(self) -> ForceRegression:
        m = self.motion
        u, v = self.u, m.v
        columns = {
            "cubic_stiffness": u**3, "quadratic_damping": v * np.abs(v),
            "position_damping": u**2 * v, "coulomb_friction": np.sign(v),
            "table_tilt": m.table_disp, "mass_error": m.acc,
        }  # fmt: skip
        entries = np.flatnonzero(self.residuals.entry_row == 0)
        return self._regression(entries, [u, v], columns)

    def _bumpers(self) -> ForceRegression:
        m, rows = self.motion, self.residuals.entry_row
        p = self.parameters.model_for_log(self.residuals.log_number, m).parameters
        entries = np.flatnonzero((rows == 1) | (rows == 2))
        samples, side = (
            self.residuals.entry_sample[entries],
            np.where(rows[entries] == 1, 1.0, -1.0),
        )
        depth = side * self.u[samples] - np.where(side > 0, p.gap_r, p.gap_l)
        speed = side * m.v[samples]
        columns = {
            "bumper_hardening": depth * np.abs(depth), "bumper_cubic": depth**3,
            "hunt_crossley": np.abs(depth) * speed,
            "bumper_asymmetry": side * depth, "gap_offset": side, "gap_drift": m.time_s[samples],
        }  # fmt: skip
        return self._regression(entries, [depth, speed], columns, by_sample=False)

    def _regression(
        self, entries: Int1D, base: Sequence[Float1D], columns: dict[str, Float1D],
        by_sample: bool = True,
    ) -> ForceRegression:  # fmt: skip
        """Build the regression of `entries`; base and columns are per sample or per entry."""
        residuals, m = self.residuals, self.motion
        samples, rows = residuals.entry_sample[entries], residuals.entry_row[entries]
        mass = self.parameters.model_for_log(residuals.log_number, m).parameters.mass
        noise = residuals.force_noise(m, mass)[rows] * residuals.weight
        values = np.stack([*base, *columns.values()], axis=1)
        values = (values[samples] if by_sample else values) / noise[:, None]
        force = residuals.measured_forces(m, mass, self.parameters)[rows, samples] / noise
        return ForceRegression(
            force, np.column_stack([values[:, : len(base)], 1.0 / noise]), tuple(columns),
            values[:, len(base) :], entries, assign_folds(residuals)[entries],
            residuals.entry_block[entries],
        )  # fmt: skip

    def gap(self, residuals: Sequence[Float1D]) -> Json:
        """Return the gap as in verdict.json from the held-out residuals of each regression.

        Other entries (sensor consistency, values at rest) keep the residuals of the base model.
        """
        values_all = self.residuals.evaluate(self.parameters)
        is_force = self.residuals.entry_row < len(self.residuals.rows)
        before = _rms(values_all[is_force])
        for regression, values in zip(self.regressions, residuals, strict=True):
            values_all[regression.entries] = values
        return {
            "metric": METRIC, "held_out_before": before,
            "held_out_after": _rms(values_all[is_force]), "noise_floor": 1.0,
        }  # fmt: skip


def make_regression_problem(log: PreparedLog, model: Model) -> RegressionProblem:
    """Build the problem of a log, with the base model refitted; InputError as in discovery."""
    prepared = prepare_problem([log], model)
    residuals = prepared.problem.log_residuals[0]
    assert residuals.whitening is None, "baselines use unwhitened residuals"
    assert residuals.rows[: len(FORCE_ROWS)] == FORCE_ROWS
    return RegressionProblem(residuals, prepared.parameters)


def _rms(values: Float1D) -> float:
    return math.sqrt(float(values @ values) / max(values.size, 1))
