"""Sobol indices of the outcomes: which share of their variance each parameter explains.

First order: alone; total: with all its interactions. Source: Saltelli et al., Comput. Phys. Commun.
181 (2010) 259, for the first order Eq. (b) of Table 2, for the total Jansen's, Eq. (f).
"""

from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D
from twin.compare.curves import FloatND

RESAMPLE_COUNT = 500
INTERVAL_LEVEL = 0.95


@dataclass(frozen=True)
class SensitivityIndices:
    """Indices of each parameter, (parameter,), with intervals (2, parameter) by the bootstrap.

    `used_share`: of the base samples, those whose cases all have a number.
    """

    first: Float1D
    total: Float1D
    first_interval: Float2D
    total_interval: Float2D
    used_share: float


def compute_sensitivity(values: Float1D, parameter_count: int, seed: int) -> SensitivityIndices:
    """Compute the Sobol indices of an outcome over the cases of a sensitivity design, (case,).

    The order of the cases is that of `sampling.sample_parameters`. NaN without usable samples.
    """
    blocks = values.reshape(parameter_count + 2, -1)
    usable = np.isfinite(blocks).all(axis=0)
    blocks = blocks[:, usable]
    count, share = blocks.shape[1], float(usable.mean())
    nan = np.full(parameter_count, np.nan)
    if count < 2 or not np.ptp(blocks[:2]) > 0:
        return SensitivityIndices(nan, nan, np.stack([nan, nan]), np.stack([nan, nan]), share)
    first, total = _estimate_indices(blocks[:, None])
    rng = np.random.default_rng(seed)
    samples = [
        _estimate_indices(blocks[:, rng.integers(0, count, (1, count))])
        for _ in range(RESAMPLE_COUNT)
    ]
    tails = [(1 - INTERVAL_LEVEL) / 2, (1 + INTERVAL_LEVEL) / 2]
    first_interval, total_interval = (
        np.nanquantile(np.concatenate([sample[kind] for sample in samples]), tails, axis=0)
        for kind in range(2)
    )
    return SensitivityIndices(first[0], total[0], first_interval, total_interval, share)


def _estimate_indices(blocks: FloatND) -> tuple[FloatND, FloatND]:
    """Return (first order, total), each (set, parameter), of blocks (block, set, sample)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        centred = blocks - blocks[:2].mean(axis=(0, 2))[:, None]
        a, b, mixed = centred[0], centred[1], centred[2:]
        variance = centred[:2].var(axis=(0, 2))
        first = (b * (mixed - a)).mean(axis=2) / variance
        total = ((a - mixed) ** 2).mean(axis=2) / (2 * variance)
    return first.T, total.T
