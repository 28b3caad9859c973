"""Hashes of the twin's output, so that most of it need not be recorded: a replay recomputes it."""

from collections.abc import Mapping
from hashlib import blake2b

import numpy as np

from table_io.block import Float2D
from table_io.records import PredictionHash
from twin.compare.twins import SavedStates

DIGEST_BYTES = 16


def hash_cells(
    pending: Float2D,
    end: int,
    new: Float2D,
    cell_samples: int,
    saved: Mapping[int, SavedStates],
) -> tuple[Float2D, list[PredictionHash]]:
    """Return (values of the unfinished cell, hashes of the completed ones).

    Cells end at multiples of `cell_samples`; the first is shorter if the twin started inside it.
    `pending` and `new` are (channel, sample); sample `end` follows the last of `new`. `saved` has
    the solvers' states by the end of the cell that states them.
    """
    known = np.where(np.isnan(new), np.nan, new) if np.isnan(new).any() else new
    values = np.concatenate([pending, known], axis=1) if pending.shape[1] else known
    first, start, hashes = end - values.shape[1], 0, []
    for stop in range(-first % cell_samples or cell_samples, values.shape[1] + 1, cell_samples):
        digest, states = _digest(values[:, start:stop]), saved.get(first + stop, ((), ()))
        hashes.append(PredictionHash(first + start, stop - start, digest, *states))
        start = stop
    return values[:, start:], hashes


def _digest(values: Float2D) -> bytes:
    """Return the hash of (channel, sample), as in an encoded block but with one kind of NaN."""
    return blake2b(values.astype("<f8", copy=False).tobytes(), digest_size=DIGEST_BYTES).digest()
