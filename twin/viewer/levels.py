"""Reference levels in the time series: bumper positions, contact threshold, axis scale.

Rerun labels an axis in steps of a power of ten only, and shows no number but zero if the steps
do not fit. Invisible points then extend the axis to the next power of ten.
"""

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.viewer.motion import BlockMotion
from twin.viewer.scene import Scene
from twin.viewer.sink import RerunSink

PEAK_WINDOW_S, PEAK_HOLD_S = 0.5, 5.0  # window of a peak, and time for which it counts
MAX_NUMBERED_SHARE = 0.55  # of a power of ten: above it Rerun does not label its tenths


class WindowPeaks:
    """Peak detector over windows at multiples of `length`, independent of the block boundaries."""

    def __init__(self, length: int) -> None:
        self._length = length
        self._window = -1
        self._highest = np.empty(0)

    def add(self, index: Int1D, values: Float2D) -> Iterator[tuple[int, Float1D]]:
        """Yield (end sample index, largest magnitude (row,)) of each completed window; NaN as 0."""
        magnitudes = np.nan_to_num(np.abs(values))
        for window in np.unique(index // self._length):
            if window != self._window:
                if self._window >= 0:
                    yield (self._window + 1) * self._length, self._highest
                self._window, self._highest = int(window), np.zeros(len(magnitudes))
            in_window = index // self._length == window
            self._highest = np.maximum(self._highest, magnitudes[:, in_window].max(axis=1))


def next_power_of_ten(peak: float) -> float:
    """Return the next power of ten if an axis up to `peak` would show no number but 0, else NaN."""
    if peak <= 0:
        return math.nan
    power = 10.0 ** math.ceil(math.log10(peak) - 1e-9)
    return power if peak > MAX_NUMBERED_SHARE * power else math.nan


class ReferenceLevels:
    """Reference levels drawn with the measured motion of a rig."""

    def __init__(self, sink: RerunSink, scene: Scene, rate_hz: float) -> None:
        self._sink = sink
        self._sides = scene.sides
        self._contact_kn = 1e-3 * scene.contact_n
        self._peaks = WindowPeaks(max(1, round(rate_hz * PEAK_WINDOW_S)))
        self._recent_peaks: deque[Float1D] = deque(maxlen=round(PEAK_HOLD_S / PEAK_WINDOW_S))
        self._sign = 1.0

    def add(self, motion: BlockMotion) -> None:
        """Add a part of the measured stream."""
        acc = np.fmax(np.abs(motion.acc), np.abs(motion.table_acc))
        force = np.fmax(np.abs(motion.force_r), np.abs(motion.force_l))
        magnitudes = np.stack([1e3 * motion.u, acc, 1e-3 * force, 1e-3 * motion.damper_force])
        rows: dict[str, list[list[float]]] = {}
        ends = []
        for end, highest in self._peaks.add(motion.index, magnitudes):
            self._recent_peaks.append(highest)
            ends.append(end)
            for entity, row in self._compute_levels(*np.max(self._recent_peaks, axis=0).tolist()):
                rows.setdefault(entity, []).append(row)
        for entity, values in rows.items():
            self._sink.send_scalars(entity, ends, values)

    def _compute_levels(
        self, u: float, acc: float, force: float, damper: float
    ) -> Iterator[tuple[str, list[float]]]:
        """Yield (entity, levels) for these largest visible magnitudes, in units of the plots."""
        if self._sides:
            positions = [1e3 * sign * gap for _, sign, gap in self._sides]
            visible = [position if abs(position) < 1.5 * u else math.nan for position in positions]
            yield "u/gaps", visible
            u = max(u, *(abs(position) for position in visible if not math.isnan(position)), 0.0)
            yield "force/threshold", [sign * self._contact_kn for _, sign, _ in self._sides]
            force = max(force, self._contact_kn)
        self._sign = -self._sign
        for plot, peak in (("u", u), ("a", acc), ("force", force), ("damper", damper)):
            yield f"{plot}/scale", [self._sign * next_power_of_ten(peak)]
