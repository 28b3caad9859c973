"""PySINDy on the forces of a log: sequentially thresholded least squares on what the base leaves.

The base is refitted with every choice of terms: it is projected out of the force and of each column
(Frisch, Waugh and Lovell), and each column scaled to rms 1, so that a threshold is a force over the
noise. Thresholds are chosen on held-out steps: the sparsest that is no worse than the best by more
than one standard error, over blocks. Source: Kaheman et al. 2019, arXiv 1909.08574.
"""

import warnings
from typing import Any

import numpy as np
from pysindy.optimizers import STLSQ

from table_io.block import Bool2D, Float1D, Float2D
from twin.learn.search import FOLDS
from twin.service.study.rivals_terms import Bench, Regression

Json = dict[str, Any]
THRESHOLDS = tuple(float(one) for one in np.geomspace(0.01, 30.0, 22))  # of the noise
ERRORS = 1.0  # standard errors by which a sparser choice may be worse


def named(bench: Bench) -> Json:
    """A verdict as in verdict.json: the effects whose term survives, the largest share first."""
    shares: dict[str, float] = {}
    left = []
    for one in bench.regressions:
        held_out = [held(one, threshold) for threshold in THRESHOLDS]
        chosen = sparsest(one, held_out)
        left.append(held_out[chosen])
        shares |= surviving(one, THRESHOLDS[chosen])
    names = sorted(shares, key=lambda name: -shares[name])
    effects = [{"id": name, "confidence": 1.0, "share": shares[name]} for name in names]
    return {
        "verdict": "named" if names else "none", "effects": effects, "gap": bench.gap(left)
    }  # fmt: skip


def held(one: Regression, threshold: float) -> Float1D:
    """(entry,) what is left of each step when it was held out."""
    left = np.zeros(one.force.size)
    for fold in range(FOLDS):
        train = one.fold != fold
        force, columns = _beyond_base(one, train)
        found = _coefficients(columns[train], force[train], threshold)
        left[~train] = (force - columns @ found)[~train]
    return left


def sparsest(one: Regression, held_out: list[Float1D]) -> int:
    """The place of the largest threshold that is as good as the best."""
    squares = [np.bincount(one.block, weights=left**2) for left in held_out]
    best = min(squares, key=lambda some: float(some.sum()))
    apart = [some - best for some in squares]
    return max(
        place for place, some in enumerate(apart) if some.sum() <= ERRORS * np.sqrt(some @ some)
    )


def surviving(one: Regression, threshold: float) -> dict[str, float]:
    """Of each effect whose term survives on all of it: what it alone adds to the squares that all
    of them explain, less being explained without it, in parts of the forces' squares."""
    force, columns = _beyond_base(one, np.ones(one.force.size, dtype=bool))
    kept = np.flatnonzero(_coefficients(columns, force, threshold))
    whole = _left(columns[:, kept], force)
    return {
        one.names[k]: (_left(columns[:, kept[kept != k]], force) - whole) for k in kept.tolist()
    }


def _beyond_base(one: Regression, train: Bool2D) -> tuple[Float1D, Float2D]:
    """(force, columns) less what the base fitted on `train` makes of them, columns of rms 1."""
    both = np.column_stack([one.force, one.columns])
    weights = np.linalg.lstsq(one.base[train], both[train], rcond=None)[0]
    beyond = both - one.base @ weights
    rms = np.sqrt(np.mean(beyond[train, 1:] ** 2, axis=0))
    return beyond[:, 0], beyond[:, 1:] / np.maximum(rms, 1e-300)


def _coefficients(columns: Float2D, force: Float1D, threshold: float) -> Float1D:
    """(column,), zero where a term has not survived."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that nothing survives is an answer
        found = STLSQ(threshold=threshold, alpha=0.0, max_iter=50).fit(columns, force[:, None])
    return np.asarray(found.coef_, dtype=np.float64)[0]


def _left(columns: Float2D, force: Float1D) -> float:
    """Squares that least squares leaves."""
    found = np.linalg.lstsq(columns, force, rcond=None)[0]
    left = force - columns @ found
    return float(left @ left)
