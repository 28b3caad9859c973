"""Levels in the time series: where the bumpers stand, what counts as contact, a round number.

Rerun numbers an axis in powers of ten only, and where nine of them do not fit, not at all but for
the zero. There, dots that cannot be seen stretch the axis to the next power of ten.
"""

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.stream.rerun.moving import Motion
from twin.stream.rerun.scene import Scene
from twin.stream.rerun.sink import Sink

LOOK_S, HOLD_S = 0.5, 5.0  # peaks of so long, and how long one is in sight
UNNUMBERED = 0.55  # of a power of ten: beyond, its tenths are too many to be numbered


class Peaks:
    """Cuts samples into windows that begin at multiples of `length`, the same for any blocks."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._window = -1
        self._highest = np.empty(0)

    def add(self, index: Int1D, values: Float2D) -> Iterator[tuple[int, Float1D]]:
        """(sample index of its end, highest (row,)) of every window now whole; 0 for NaN."""
        sizes = np.nan_to_num(np.abs(values))
        for window in np.unique(index // self._length):
            if window != self._window:
                if self._window >= 0:
                    yield (self._window + 1) * self._length, self._highest
                self._window, self._highest = int(window), np.zeros(len(sizes))
            inside = index // self._length == window
            self._highest = np.maximum(self._highest, sizes[:, inside].max(axis=1))


def stretch(peak: float) -> float:
    """The next power of ten where an axis up to `peak` would have no number but 0; else NaN."""
    if peak <= 0:
        return math.nan
    power = 10.0 ** math.ceil(math.log10(peak) - 1e-9)
    return power if peak > UNNUMBERED * power else math.nan


class Levels:
    """Draws the levels beside the measured motion of a rig."""

    def __init__(self, sink: Sink, scene: Scene, rate_hz: float) -> None:
        self._sink = sink
        self._sides = scene.sides
        self._contact_kn = 1e-3 * scene.contact_n
        self._peaks = Peaks(max(1, round(rate_hz * LOOK_S)))
        self._recent: deque[Float1D] = deque(maxlen=round(HOLD_S / LOOK_S))
        self._sign = 1.0

    def add(self, moves: Motion) -> None:
        """Take in a piece of the measured stream."""
        acc = np.fmax(np.abs(moves.acc), np.abs(moves.table_acc))
        force = np.fmax(np.abs(moves.force_r), np.abs(moves.force_l))
        sizes = np.stack([1e3 * moves.u, acc, 1e-3 * force, 1e-3 * moves.damper])
        rows: dict[str, list[list[float]]] = {}
        ends = []
        for end, highest in self._peaks.add(moves.index, sizes):
            self._recent.append(highest)
            ends.append(end)
            for entity, row in self._levels(*np.max(self._recent, axis=0).tolist()):
                rows.setdefault(entity, []).append(row)
        for entity, values in rows.items():
            self._sink.scalars(entity, ends, values)

    def _levels(
        self, u: float, acc: float, force: float, damper: float
    ) -> Iterator[tuple[str, list[float]]]:
        """(entity, its values) where these are the highest in sight, in the units of the plots."""
        if self._sides:
            places = [1e3 * sign * gap for _, sign, gap in self._sides]
            near = [place if abs(place) < 1.5 * u else math.nan for place in places]
            yield "u/gaps", near
            u = max(u, *(abs(place) for place in near if not math.isnan(place)), 0.0)
            yield "force/threshold", [sign * self._contact_kn for _, sign, _ in self._sides]
            force = max(force, self._contact_kn)
        self._sign = -self._sign
        for plot, peak in (("u", u), ("a", acc), ("force", force), ("damper", damper)):
            yield f"{plot}/scale", [self._sign * stretch(peak)]
