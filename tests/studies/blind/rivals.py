"""Rivals of discovery on the same recordings (`pip install shaketwin[rivals,laws]`).

They regress forces over their noise on columns, one for each effect:

    damper     -M a - F_R - F_L  =  K u + C u' + const            + sum of columns
    bumpers    F_R, -F_L         =  K_j d + C_j d' + const        + sum of columns, in contact

with d the depth past the gap on either side. Motion, forces, noise, gaps and valid entries are
those of discovery, so that a rival sees the same states. Effects with memory (hysteresis,
relaxation) are no function of the state and have no column.

PySINDy: sequentially thresholded least squares on the residual of the base model. The base is
refitted with every choice of terms: it is projected out of the force and of each column (Frisch,
Waugh and Lovell), and each column is scaled to rms 1, so that a threshold is a force over the
noise. The threshold is chosen by cross-validation over steps: the sparsest model whose error
exceeds the best by at most one standard error, over blocks. Source: Kaheman et al. 2019, arXiv
1909.08574.

pyoperon: symbolic regression alone, with the engine, functions and length of the second stage of
the law search, but its own choice of the expression (minimum description length), and no refit of
base and expression together.

blackbox: gradient-boosted trees, of current and delayed motion, the table and the time, so that
effects with memory can be learned. It names no effect and gives an error floor.
"""

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from table_io.block import Bool2D, Float1D, Float2D, Int1D
from twin.discovery.discover import PreparedLog, prepare_problem
from twin.discovery.loading import load_logs
from twin.discovery.motion import MeasuredMotion
from twin.discovery.nuisances import resolve_samples
from twin.discovery.parameters import ParameterSet
from twin.discovery.residuals import FORCE_ROWS, LogResiduals
from twin.discovery.units import FOLD_COUNT, assign_folds
from twin.model.model import Model
from twin.setup.run_config import read_model_template

Json = dict[str, Any]
METRIC = (
    "rms of measured minus predicted forces along the measured motion, over the sensor noise, "
    "on held-out steps; the entries are those of discovery"
)
REQUIRED_PACKAGES = {"pysindy": "pysindy", "pyoperon": "pyoperon", "blackbox": "sklearn"}
MISSING_MESSAGE = "rivals skipped, packages not installed: {}; pip install 'shaketwin[rivals,laws]'"
THRESHOLDS = tuple(np.geomspace(0.01, 30.0, 22).tolist())  # forces over the noise
MAX_STANDARD_ERRORS = 1.0  # by which a sparser model may be worse
DELAYS_S = (0.01, 0.03, 0.1, 0.3)
TREE_COUNT, MIN_LEAF_SAMPLES = 150, 40


def load_case(case_dir: Path) -> tuple[Sequence[PreparedLog], Sequence[str], Model]:
    """Return the recording, notes on it, and the start model of a case."""
    logs, notes = load_logs([case_dir / "log.mcap"])
    return logs, notes, read_model_template(str(case_dir / "model.toml"))[0]


def find_rivals() -> dict[str, Callable[[Path], Json]]:
    """Return the rivals by name whose package is installed, each a function of a case's folder."""

    def run_on_case(fit: Callable[[RegressionProblem], Json]) -> Callable[[Path], Json]:
        def run(case_dir: Path) -> Json:
            logs, _, model = load_case(case_dir)
            return fit(make_regression_problem(logs[0], model))

        return run

    fits = {"pysindy": select_terms, "pyoperon": fit_expressions, "blackbox": fit_boosted_trees}
    return {
        name: run_on_case(fit) for name, fit in fits.items() if find_spec(REQUIRED_PACKAGES[name])
    }


def describe_missing() -> str:
    """Return a message about rivals that are not installed; empty if all are."""
    missing_packages = [package for package in REQUIRED_PACKAGES.values() if not find_spec(package)]
    return MISSING_MESSAGE.format(", ".join(missing_packages)) if missing_packages else ""


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
        samples = self.residuals.entry_sample[entries]
        side = np.where(rows[entries] == 1, 1.0, -1.0)
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
        noise = residuals.force_noise(m, mass)[rows] * residuals.entry_weight[entries]
        values = np.stack([*base, *columns.values()], axis=1)
        values = (values[samples] if by_sample else values) / noise[:, None]
        forces = np.array(residuals.measured_forces(m, mass, self.parameters))
        force = forces[rows, samples] / noise
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
    sampled = resolve_samples(prepared.problem.log_residuals[0], prepared.parameters)
    residuals = replace(sampled, weights={})
    assert residuals.whitening is None, "baselines use unwhitened residuals"
    assert residuals.rows[: len(FORCE_ROWS)] == FORCE_ROWS
    return RegressionProblem(residuals, prepared.parameters)


def _rms(values: Float1D) -> float:
    return math.sqrt(float(values @ values) / max(values.size, 1))


def select_terms(problem: RegressionProblem) -> Json:
    """Select terms; return a verdict as in verdict.json, effects sorted by explained share."""
    shares: dict[str, float] = {}
    residuals = []
    for regression in problem.regressions:
        held_out = [cross_validate_threshold(regression, threshold) for threshold in THRESHOLDS]
        chosen = choose_threshold(regression, held_out)
        residuals.append(held_out[chosen])
        shares |= explained_shares(regression, THRESHOLDS[chosen])
    names = sorted(shares, key=lambda name: -shares[name])
    effects = [{"id": name, "confidence": 1.0, "share": shares[name]} for name in names]
    return {
        "verdict": "named" if names else "none", "effects": effects, "gap": problem.gap(residuals)
    }  # fmt: skip


def cross_validate_threshold(regression: ForceRegression, threshold: float) -> Float1D:
    """Return the cross-validation residual (entry,) of a threshold."""
    residual = np.zeros(regression.force.size)
    for fold in range(FOLD_COUNT):
        is_training = regression.fold != fold
        force, columns = _project_out_base(regression, is_training)
        weights = _fit_coefficients(columns[is_training], force[is_training], threshold)
        residual[~is_training] = (force - columns @ weights)[~is_training]
    return residual


def choose_threshold(regression: ForceRegression, held_out: list[Float1D]) -> int:
    """Return the index of the largest threshold within one standard error of the best."""
    squares = [np.bincount(regression.block, weights=residual**2) for residual in held_out]
    best = min(squares, key=lambda block_squares: float(block_squares.sum()))
    excesses = [block_squares - best for block_squares in squares]
    return max(
        index
        for index, excess in enumerate(excesses)
        if excess.sum() <= MAX_STANDARD_ERRORS * np.sqrt(excess @ excess)
    )


def explained_shares(regression: ForceRegression, threshold: float) -> dict[str, float]:
    """Return the squared residual that each selected effect alone removes, fitted on all data."""
    force, columns = _project_out_base(regression, np.ones(regression.force.size, dtype=bool))
    kept = np.flatnonzero(_fit_coefficients(columns, force, threshold))
    full = _residual_squares(columns[:, kept], force)
    return {
        regression.names[k]: (_residual_squares(columns[:, kept[kept != k]], force) - full)
        for k in kept.tolist()
    }


def _project_out_base(regression: ForceRegression, is_training: Bool2D) -> tuple[Float1D, Float2D]:
    """Return (force, columns) minus the base fitted on `is_training`, columns scaled to rms 1."""
    targets = np.column_stack([regression.force, regression.columns])
    weights = np.linalg.lstsq(regression.base[is_training], targets[is_training], rcond=None)[0]
    projected = targets - regression.base @ weights
    rms = np.sqrt(np.mean(projected[is_training, 1:] ** 2, axis=0))
    return projected[:, 0], projected[:, 1:] / np.maximum(rms, 1e-300)


def _fit_coefficients(columns: Float2D, force: Float1D, threshold: float) -> Float1D:
    """Return the STLSQ coefficients (column,), zero for rejected terms."""
    from pysindy.optimizers import STLSQ

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # selecting no term is a valid result
        fit = STLSQ(threshold=threshold, alpha=0.0, max_iter=50).fit(columns, force[:, None])
    return np.asarray(fit.coef_, dtype=np.float64)[0]


def _residual_squares(columns: Float2D, force: Float1D) -> float:
    """Return the sum of squared residuals of a least-squares fit."""
    weights = np.linalg.lstsq(columns, force, rcond=None)[0]
    residual = force - columns @ weights
    return float(residual @ residual)


def _cross_validate_remainder(
    regression: ForceRegression, features: Float2D, fit: Callable[[Float2D, Float1D], Any]
) -> Float1D:
    """Return the cross-validation residual (entry,) of what a method makes of the remainder.

    The base is fitted to the training folds first. `features` is (entry, feature); `fit` returns
    what predicts the remainder from them.
    """
    residual = np.zeros(regression.force.size)
    for fold in range(FOLD_COUNT):
        is_training = regression.fold != fold
        weights = np.linalg.lstsq(
            regression.base[is_training], regression.force[is_training], rcond=None
        )[0]
        remainder = regression.force - regression.base @ weights
        fitted = fit(features[is_training], remainder[is_training])
        residual[~is_training] = remainder[~is_training] - fitted.predict(features[~is_training])
    return residual


def _judge_remainders(
    problem: RegressionProblem,
    features: Sequence[Float2D],
    fit: Callable[[Float2D, Float1D], Any],
) -> Json:
    """Return a verdict as in verdict.json that contains only the error."""
    residuals = [
        _cross_validate_remainder(regression, columns, fit)
        for regression, columns in zip(problem.regressions, features, strict=True)
    ]
    return {"verdict": "unexplained", "effects": [], "gap": problem.gap(residuals)}


def fit_expressions(problem: RegressionProblem) -> Json:
    """Fit expressions of u and u', or of a bumper's compression and its rate, scaled to 1."""
    from twin.discovery.symbolic_regression import fit_regressor

    motions = [
        regression.base[:, :2] / regression.base[:, 2:] for regression in problem.regressions
    ]
    scaled = [motion / np.abs(motion).max(axis=0) for motion in motions]
    return _judge_remainders(
        problem, scaled, lambda motion, remainder: fit_regressor([*motion.T], remainder)
    )


def fit_boosted_trees(problem: RegressionProblem) -> Json:
    """Fit boosted trees of u, u', table, time, and delayed u and u'."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    m = problem.motion
    delayed = [
        np.concatenate([np.full(delay, signal[0]), signal[:-delay]])
        for signal in (m.u, m.v)
        for delay in (max(round(delay_s * m.rate_hz), 1) for delay_s in DELAYS_S)
    ]
    by_sample = np.stack([m.u, m.v, m.table_disp, m.time_s, *delayed], axis=1)
    residuals = problem.residuals
    features = [
        np.column_stack(
            [
                by_sample[residuals.entry_sample[regression.entries]],
                residuals.entry_row[regression.entries],
            ]
        )
        for regression in problem.regressions
    ]

    def fit(columns: Float2D, remainder: Float1D) -> Any:
        trees = HistGradientBoostingRegressor(
            max_iter=TREE_COUNT, min_samples_leaf=MIN_LEAF_SAMPLES, random_state=0
        )
        return trees.fit(columns, remainder)

    return _judge_remainders(problem, features, fit)
