"""Phase-plane plot: trail of u and another quantity over the last seconds, with autoscaling."""

from dataclasses import dataclass

import numpy as np

from twin.viewer.motion import BlockMotion, Trail
from twin.viewer.plots import PLANE_WIDTH, AxisRange, PlotAxes
from twin.viewer.sink import RerunSink

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
