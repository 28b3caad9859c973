"""Black-box baseline: gradient-boosted trees on the residual of the refitted base model.

It names no effect and gives an error floor. Features are the current and delayed motion, the table
and the time, so that effects with memory can be learned.
"""

from typing import Any

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from table_io.block import Float1D, Float2D
from tests.studies.blind.baseline_terms import ForceRegression, RegressionProblem
from twin.discovery.screening import FOLD_COUNT

Json = dict[str, Any]
DELAYS_S = (0.01, 0.03, 0.1, 0.3)
TREE_COUNT, MIN_LEAF_SAMPLES = 150, 40


def fit_boosted_trees(problem: RegressionProblem) -> Json:
    """Fit boosted trees; return a verdict as in verdict.json that contains only the error."""
    features = _make_features(problem)
    residuals = [
        cross_validate_trees(
            regression, features[problem.residuals.entry_sample[regression.entries]], problem
        )
        for regression in problem.regressions
    ]
    return {"verdict": "unexplained", "effects": [], "gap": problem.gap(residuals)}


def cross_validate_trees(
    regression: ForceRegression, sample_features: Float2D, problem: RegressionProblem
) -> Float1D:
    """Return the cross-validation residual (entry,); `sample_features` is (entry, feature)."""
    row = problem.residuals.entry_row[regression.entries]
    features = np.column_stack([sample_features, row])
    residual = np.zeros(regression.force.size)
    for fold in range(FOLD_COUNT):
        is_training = regression.fold != fold
        weights = np.linalg.lstsq(
            regression.base[is_training], regression.force[is_training], rcond=None
        )[0]
        remainder = regression.force - regression.base @ weights
        trees = HistGradientBoostingRegressor(
            max_iter=TREE_COUNT, min_samples_leaf=MIN_LEAF_SAMPLES, random_state=0
        )
        trees.fit(features[is_training], remainder[is_training])
        residual[~is_training] = remainder[~is_training] - trees.predict(features[~is_training])
    return residual


def _make_features(problem: RegressionProblem) -> Float2D:
    """Return features (sample, feature): u, u', table, time, and delayed u and u'."""
    m = problem.motion
    delayed = [
        np.concatenate([np.full(delay, signal[0]), signal[:-delay]])
        for signal in (m.u, m.v)
        for delay in (max(round(delay_s * m.rate_hz), 1) for delay_s in DELAYS_S)
    ]
    return np.stack([m.u, m.v, m.table_disp, m.time_s, *delayed], axis=1)
