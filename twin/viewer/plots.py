"""Plots with drawn axes: tick values, grids, ranges, and the PRC curves."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.excitation.orbit_plan import OrbitPlan
from table_io.records import JumpForecast, OrbitPoint, PrcPoint
from twin.viewer.style import PLUM, PRC_COLOURS, VIOLET, Rgb

PRC_WIDTH, PLANE_WIDTH = 2.9, 1.5  # relative to a height of 1


def nice_ceil(value: float) -> float:
    """Round up to 1, 1.5, 2, 3, 4, 5, 6, 8 or 10 times a power of ten; value > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)
    return next((step * power for step in steps if step * power >= value * (1 - 1e-9)), 10 * power)


def nice_floor(value: float) -> float:
    """Round down to 1, 2 or 5 times a power of ten; value > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))


@dataclass(frozen=True, slots=True)
class PlotAxes:
    """Axes of a plot drawn `width` by HEIGHT, y downward as in 2D views; x, y in data units."""

    x: tuple[float, float]
    y: tuple[float, float]
    x_label: str
    y_label: str
    width: float

    HEIGHT: ClassVar = 1.0

    @property
    def scale(self) -> tuple[float, float]:
        """Drawn length of one data unit (x, y); y is negative, because drawn y is downward."""
        return self.width / (self.x[1] - self.x[0]), -self.HEIGHT / (self.y[1] - self.y[0])

    @property
    def origin(self) -> tuple[float, float]:
        """Drawn position of data (0, 0)."""
        return -self.x[0] * self.scale[0], self.HEIGHT - self.y[0] * self.scale[1]

    @staticmethod
    def ticks(low: float, high: float) -> Float1D:
        """Return four to ten round numbers within low .. high."""
        step = nice_floor((high - low) / 4)
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        return np.arange(first, last + 1, dtype=np.float64) * step

    def grid_lines(self) -> list[Float2D]:
        """Return the frame and a line at every tick, drawn units, (point, 2) each."""
        (sx, sy), (ox, oy), w, h = self.scale, self.origin, self.width, self.HEIGHT
        lines = [np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]], dtype=np.float64)]
        lines += [np.array([[ox + sx * x, 0], [ox + sx * x, h]]) for x in self.ticks(*self.x)]
        lines += [np.array([[0, oy + sy * y], [w, oy + sy * y]]) for y in self.ticks(*self.y)]
        return lines

    def vertical_lines(self, values: Iterable[float]) -> list[Float2D]:
        """Return a vertical line at each x value within the axes, drawn units, (2, 2) each."""
        positions = [
            self.origin[0] + self.scale[0] * x for x in values if self.x[0] <= x <= self.x[1]
        ]
        return [np.array([[x, 0.0], [x, self.HEIGHT]]) for x in positions]

    def labels(self) -> tuple[Float2D, list[str]]:
        """Return positions (label, 2) in drawn units and texts of tick labels and axis names."""
        (sx, sy), (ox, oy), w, h = self.scale, self.origin, self.width, self.HEIGHT
        positions = [(ox + sx * x, h + 0.03) for x in self.ticks(*self.x)]
        positions += [(-0.08, oy + sy * y - 0.035) for y in self.ticks(*self.y)]
        texts = [f"{tick:.6g}" for tick in (*self.ticks(*self.x), *self.ticks(*self.y))]
        names = [((w / 2, h + 0.12), self.x_label), ((0.0, -0.13), self.y_label)]
        return (
            np.array([*positions, *(position for position, _ in names)]),
            [*texts, *(text for _, text in names)],
        )


class AxisRange:
    """Half range of an axis: grows at once, shrinks if `hold_peaks` peaks fill less than 40 %."""

    def __init__(self, min_value: float, hold_peaks: int) -> None:
        self.value = min_value
        self._min_value = min_value
        self._peaks = np.zeros(hold_peaks)
        self._peak_count = 0

    def update(self, peak: float) -> bool:
        """Add a peak; return True if the range changed."""
        self._peaks[self._peak_count % self._peaks.size] = peak
        self._peak_count += 1
        highest = max(float(self._peaks.max()), self._min_value / 1.05)
        if 0.4 * self.value <= highest <= self.value:
            return False
        previous, self.value = self.value, nice_ceil(1.05 * highest)
        return self.value != previous


class PrcCurves:
    """PRC points so far: eta_d over frequency."""

    def __init__(self, low_hz: float, high_hz: float) -> None:
        margin = max(0.03 * (high_hz - low_hz), 0.05)
        self._frequency_range = (low_hz - margin, high_hz + margin)
        self._points: dict[tuple[int, int], PrcPoint] = {}
        self._max_eta_d = 0.1

    @property
    def axes(self) -> PlotAxes:
        return PlotAxes(
            self._frequency_range, (0.0, self._max_eta_d), "f [Hz]", "η_d [-]", PRC_WIDTH
        )

    def add(self, point: PrcPoint) -> None:
        """Add a point and extend the axes."""
        self._points[point.index, point.step] = point  # a repeated point counts once
        etas = [values.eta_d for values in (point.measured, point.twin) if values is not None]
        highest = max((eta for eta in etas if math.isfinite(eta)), default=0.0)
        if highest > self._max_eta_d:
            self._max_eta_d = nice_ceil(1.1 * highest)

    def get_curves(self, source: str) -> list[tuple[Rgb, Float2D]]:
        """Return (color, (point, 2) in Hz and eta_d) of each direction that has points."""
        curves = []
        for direction, colour in zip(("forward", "backward"), PRC_COLOURS[source], strict=True):
            rows = [
                (point.frequency_hz, quantities.eta_d)
                for point in self._points.values()
                if point.direction == direction
                and (quantities := getattr(point, source)) is not None
            ]
            curve = np.array(rows, dtype=np.float64).reshape(-1, 2)
            curve = curve[np.isfinite(curve).all(axis=1)]
            if len(curve):
                curves.append((colour, curve))
        return curves


class OrbitCurves:
    """Orbits of a continuation so far: amplitude of u in mm over frequency, over the planned."""

    def __init__(self, plan: OrbitPlan) -> None:
        self._planned = np.array([[o.frequency_hz, 1e3 * o.amplitude_m] for o in plan.points])
        self._measured: dict[int, tuple[float, float]] = {}
        low_hz, high_hz = self._planned[:, 0].min(), self._planned[:, 0].max()
        margin = max(0.03 * (high_hz - low_hz), 0.05)
        self._frequency_range = (float(low_hz - margin), float(high_hz + margin))
        self._max_mm = nice_ceil(1.1 * float(self._planned[:, 1].max()))

    @property
    def axes(self) -> PlotAxes:
        return PlotAxes(
            self._frequency_range, (0.0, self._max_mm), "f [Hz]", "amplitude of u [mm]", PRC_WIDTH
        )

    def add(self, orbit: OrbitPoint) -> None:
        """Add an accepted orbit; one measured again replaces the earlier."""
        if orbit.accepted:
            self._measured[orbit.step] = orbit.frequency_hz, 1e3 * orbit.amplitude_m

    def get_curves(self, source: str) -> list[tuple[Rgb, Float2D]]:
        """Return (color, (orbit, 2) in Hz and mm) of the plan ("twin") or of what is "measured"."""
        measured = np.array([self._measured[step] for step in sorted(self._measured)])
        curve = self._planned if source == "twin" else measured.reshape(-1, 2)
        return [(PRC_COLOURS[source][0], curve)] if len(curve) else []


def forecast_lines(axes: PlotAxes, forecast: JumpForecast) -> list[tuple[Rgb, Float2D]]:
    """Return (color, vertical line) at the forecast jump and the ends of its interval."""
    if not forecast.kind:
        return []
    markers = (forecast.low_hz, PLUM), (forecast.high_hz, PLUM), (forecast.jump_hz, VIOLET)
    return [
        (colour, line)
        for frequency_hz, colour in markers
        for line in axes.vertical_lines([frequency_hz])
    ]
