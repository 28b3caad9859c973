"""The error floor: gradient-boosted trees on what the refitted base leaves; names nothing.

They see the motion now and a while ago, the table and the time, so a memory is in their reach.
"""

from typing import Any

import numpy as np
from sklearn.ensemble import HistGradientBoostingRegressor

from table_io.block import Float1D, Float2D
from twin.learn.search import FOLDS
from twin.service.study.rivals_terms import Bench, Regression

Json = dict[str, Any]
PAST_S = (0.01, 0.03, 0.1, 0.3)
TREES, LEAST_LEAF = 150, 40


def floored(bench: Bench) -> Json:
    """A verdict as in verdict.json that only says how far down the error goes."""
    seen = _seen(bench)
    left = [held(one, seen[bench.sheet.sample_of[one.entries]], bench) for one in bench.regressions]
    return {"verdict": "unexplained", "effects": [], "gap": bench.gap(left)}


def held(one: Regression, seen: Float2D, bench: Bench) -> Float1D:
    """(entry,) what is left of each step when it was held out; `seen` is (entry, feature)."""
    side = bench.sheet.row_of[one.entries]
    features = np.column_stack([seen, side])
    left = np.zeros(one.force.size)
    for fold in range(FOLDS):
        train = one.fold != fold
        weights = np.linalg.lstsq(one.base[train], one.force[train], rcond=None)[0]
        beyond = one.force - one.base @ weights
        trees = HistGradientBoostingRegressor(
            max_iter=TREES, min_samples_leaf=LEAST_LEAF, random_state=0
        )
        trees.fit(features[train], beyond[train])
        left[~train] = beyond[~train] - trees.predict(features[~train])
    return left


def _seen(bench: Bench) -> Float2D:
    """(sample, feature): u, u', the table and the time now, u and u' at times past."""
    m = bench.motion
    past = [
        np.concatenate([np.full(back, one[0]), one[:-back]])
        for one in (m.u, m.v)
        for back in (max(round(ago * m.rate_hz), 1) for ago in PAST_S)
    ]
    return np.stack([m.u, m.v, m.table_disp, m.time_s, *past], axis=1)
