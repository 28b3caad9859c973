"""Plots that scale themselves: phase plane, damper loop, and reference levels of time series.

Rerun labels an axis in steps of a power of ten only, and shows no number but zero if the steps do
not fit. Invisible points then extend the axis to the next power of ten.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from table_io.block import Float1D, Float2D, Int1D
from twin.viewer.motion import BlockMotion, Trail
from twin.viewer.plots import PLANE_WIDTH, AxisRange, PlotAxes
from twin.viewer.scene import Scene
from twin.viewer.sink import RerunSink

PEAK_WINDOW_S, PEAK_HOLD_S = 0.5, 5.0  # window of a peak, and time for which it counts
MAX_NUMBERED_SHARE = 0.55  # of a power of ten: above it Rerun does not label its tenths
RANGE_HOLD_S = 4.0  # before an axis shrinks
AXES_RESEND_STRIPS = 400  # strips after which the axes are sent again, for viewers that join late


@dataclass(frozen=True, slots=True)
class PlaneSpec:
    """Plane plot: y axis label, minimum half ranges (u in mm, y), span of the slope in s."""

    entity: str
    y_label: str
    min_half_ranges: tuple[float, float]
    slope_s: float


PHASE_PLANE = PlaneSpec("phase", "u' [mm/s]", (1.0, 10.0), 0.01)
DAMPER_LOOP = PlaneSpec("loop", "F [kN]", (1.0, 0.1), 0.0)


class PlanePlot:
    """Plot of 1e3 times `BlockMotion.v` over `BlockMotion.u` in mm.

    With `spec.slope_s` > 0 the measured velocity is the slope of u.
    """

    def __init__(
        self, sink: RerunSink, spec: PlaneSpec, rate_hz: float, gaps_m: tuple[float, float]
    ) -> None:
        self._sink = sink
        self._spec = spec
        self._rate_hz = rate_hz
        right, left = gaps_m
        self._gaps_mm = 1e3 * right, -1e3 * left
        stride, slope_samples = max(1, round(rate_hz / 400)), round(rate_hz * spec.slope_s / 2)
        self._length = 20 * stride
        margin = max(1, slope_samples) if spec.slope_s else 0
        self._trails = {
            "measured": Trail(self._length, stride, margin),
            "twin": Trail(self._length, stride, 0),
        }
        hold_strips = round(RANGE_HOLD_S * rate_hz / self._length)
        self._axis_ranges = tuple(
            AxisRange(min_half_range, hold_strips) for min_half_range in spec.min_half_ranges
        )
        self._send_axes(0)

    def add(self, source: str, motion: BlockMotion) -> None:
        """Draw a part of a stream; the measured one sets the axis ranges."""
        strips = list(self._trails[source].add(motion, self._rate_hz))
        if not strips:
            return
        ends, lines = zip(*strips, strict=True)
        self._sink.send_trail(f"{self._spec.entity}/data/{source}", ends, lines)
        for end, strip in strips if source == "measured" else ():
            peaks = np.abs(strip).max(axis=0)
            changed = [
                axis_range.update(peak)
                for axis_range, peak in zip(self._axis_ranges, peaks, strict=True)
            ]
            if any(changed) or end // self._length % AXES_RESEND_STRIPS == 0:
                self._send_axes(end)

    def _send_axes(self, index: int) -> None:
        """Send the axes and the bumper positions, valid from sample `index`."""
        u, v = (axis_range.value for axis_range in self._axis_ranges)
        axes = PlotAxes((-u, u), (-v, v), "u [mm]", self._spec.y_label, PLANE_WIDTH)
        self._sink.send_axes(self._spec.entity, index, axes)
        self._sink.send_strips(
            f"{self._spec.entity}/gaps", index, axes.vertical_lines(self._gaps_mm)
        )


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
