"""How far the predictions of two recordings of one test lie apart, as shares of the signal."""

import math
from pathlib import Path

import numpy as np

from table_io.block import Block
from twin.compare import PREDICTED
from twin.service.summary import Json
from twin.stream.recording import read
from twin.stream.wire import PRED_TOPIC


def deviation(old: Path, new: Path) -> Json:
    """By predicted channel: rms of the difference over rms of the old one, both finite; or None.

    None too where one of the two predicts nothing.
    """
    before, after = (read(path, (PRED_TOPIC,)).pieces("pred") for path in (old, new))
    squares = np.zeros((2, len(PREDICTED)))
    for a in before:
        for b in after:
            first, last = max(a.index, b.index), min(a.end, b.end)
            if first < last and a.channels == b.channels == PREDICTED:
                squares += _squares(a.cut(first, last), b.cut(first, last))
    return {
        name: math.sqrt(difference / signal) if signal > 0 else None
        for name, difference, signal in zip(PREDICTED, *squares.tolist(), strict=True)
    }


def _squares(old: Block, new: Block) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Sums of squares of difference and signal where both are known, (2, channel)."""
    known = np.isfinite(old.values) & np.isfinite(new.values)
    signal = np.where(known, old.values, 0.0)
    difference = signal - np.where(known, new.values, 0.0)
    return np.array([(difference**2).sum(axis=1), (signal**2).sum(axis=1)])


def sentence(shares: Json) -> str:
    """The channel that differs most, of the restarted twin and of the free one."""
    parts = []
    for track, title in (("window", "restarted twin"), ("free", "free-running twin")):
        own = {name: share for name, share in shares.items() if name.startswith(track) and share}
        if own:
            name = max(own, key=lambda one: own[one])
            parts.append(f"the {title} by up to {own[name]:.2g} of {name.split('/')[1]} (rms)")
    return " and ".join(parts) or "the predictions are the same"
