"""Symbolic regression alone (pyoperon) on the residual of the refitted base model.

It has the same engine, functions and length as the second stage of the law search, but its own
choice of the expression (minimum description length), and no refit of base and expression together.
"""

from typing import Any

import numpy as np

from table_io.block import Float1D
from tests.studies.blind.baseline_terms import ForceRegression, RegressionProblem
from twin.discovery.screening import FOLD_COUNT
from twin.discovery.symbolic_regression import fit_regressor

Json = dict[str, Any]


def fit_expressions(problem: RegressionProblem) -> Json:
    """Fit expressions of motion; return a verdict as in verdict.json that contains only the error.

    Functions of u and u', or of a bumper's compression and its rate.
    """
    residuals = [cross_validate_expressions(regression) for regression in problem.regressions]
    return {"verdict": "unexplained", "effects": [], "gap": problem.gap(residuals)}


def cross_validate_expressions(regression: ForceRegression) -> Float1D:
    """Return the cross-validation residual (entry,) of an expression for each fold."""
    motion = regression.base[:, :2] / regression.base[:, 2:]
    motion /= np.abs(motion).max(axis=0)
    residual = np.zeros(regression.force.size)
    for fold in range(FOLD_COUNT):
        is_training = regression.fold != fold
        weights = np.linalg.lstsq(
            regression.base[is_training], regression.force[is_training], rcond=None
        )[0]
        remainder = regression.force - regression.base @ weights
        regressor = fit_regressor([*motion[is_training].T], remainder[is_training])
        residual[~is_training] = remainder[~is_training] - regressor.predict(motion[~is_training])
    return residual
