"""PySINDy baseline: sequentially thresholded least squares on the residual of the base model.

The base is refitted with every choice of terms: it is projected out of the force and of each column
(Frisch, Waugh and Lovell), and each column is scaled to rms 1, so that a threshold is a force over
the noise. The threshold is chosen by cross-validation over steps: the sparsest model whose error
exceeds the best by at most one standard error, over blocks.
Source: Kaheman et al. 2019, arXiv 1909.08574.
"""

import warnings
from typing import Any

import numpy as np
from pysindy.optimizers import STLSQ

from table_io.block import Bool2D, Float1D, Float2D
from tests.studies.blind.baseline_terms import ForceRegression, RegressionProblem
from twin.discovery.screening import FOLD_COUNT

Json = dict[str, Any]
THRESHOLDS = tuple(
    float(threshold) for threshold in np.geomspace(0.01, 30.0, 22)
)  # forces over the noise
MAX_STANDARD_ERRORS = 1.0  # by which a sparser model may be worse


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
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # selecting no term is a valid result
        fit = STLSQ(threshold=threshold, alpha=0.0, max_iter=50).fit(columns, force[:, None])
    return np.asarray(fit.coef_, dtype=np.float64)[0]


def _residual_squares(columns: Float2D, force: Float1D) -> float:
    """Return the sum of squared residuals of a least-squares fit."""
    weights = np.linalg.lstsq(columns, force, rcond=None)[0]
    residual = force - columns @ weights
    return float(residual @ residual)
