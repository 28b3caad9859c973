"""Plots of the view: colors and names of lines, drawn axes, ranges, and curves over frequency."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from operator import attrgetter
from typing import ClassVar

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.config.excitation.continuation import OrbitPlan
from table_io.records import JumpForecast, OrbitPoint, PrcPoint
from twin.viewer.view_model import list_orbit_curves, list_prc_curves

PRC_WIDTH, PLANE_WIDTH = 2.9, 1.5  # relative to a height of 1
Rgb = tuple[int, int, int]
# Lines contrast at least 3 : 1 with white and with BACKGROUND_COLOUR: time series have the theme of
# the viewer, light or dark, as background, drawn plots and the rig BACKGROUND_COLOUR.
BACKGROUND_COLOUR = (14, 16, 20)
RED, BLUE, TEAL = (240, 80, 75), (45, 130, 235), (0, 150, 136)
GREY, DARK_GREY, WHITE = (125, 131, 143), (58, 62, 70), (245, 245, 245)
STEEL_COLOUR = (104, 110, 122)
MASS_COLOUR = (66, 126, 148)
RUBBER_COLOUR = (40, 42, 48)
CONTACT_COLOUR = (205, 120, 0)
IDLE_COLOUR = (146, 150, 160)
GREEN, VIOLET, PLUM = (60, 150, 60), (165, 100, 225), (104, 76, 130)

# Legend name, color and width of every line, in the order of the columns of an entity. Lines with
# the same name share one legend entry.
LineStyle = tuple[str, Rgb, float]
RESTARTED_LABEL, FREE_LABEL = "twin, restarted", "twin, free-running"
LINE_STYLES: dict[str, tuple[LineStyle, ...]] = {
    "u/measured": (("measured", RED, 3.5),),
    "u/twin": ((FREE_LABEL, GREY, 1.5), (RESTARTED_LABEL, TEAL, 1.3)),
    "a/measured": (("measured", RED, 3.5), ("table, measured", BLUE, 1.5)),
    "a/twin": ((FREE_LABEL, GREY, 1.5), (RESTARTED_LABEL, TEAL, 1.3)),
    "force/measured": (("right, measured", RED, 3.5), ("left, measured", BLUE, 3.5)),
    "force/twin": ((RESTARTED_LABEL, TEAL, 1.5), (RESTARTED_LABEL, TEAL, 1.5)),
    "damper/measured": (("measured", RED, 3.5),),
    "damper/twin": ((FREE_LABEL, GREY, 1.5), (RESTARTED_LABEL, TEAL, 1.3)),
    "error": ((f"u, {FREE_LABEL}", GREY, 2.0), (f"u, {RESTARTED_LABEL}", TEAL, 2.0)),
    "impacts": (
        ("right, measured", RED, 3.5),
        ("left, measured", BLUE, 3.5),
        ("right, twin free", TEAL, 1.5),
        ("left, twin free", GREY, 1.2),
    ),
    "disagreement/band": (("band", CONTACT_COLOUR, 1.5),),
}
PRC_COLOURS = {"measured": (RED, BLUE), "twin": (TEAL, GREY)}
# Line of each compared channel; "": not drawn, because x differs in the same way as u.
CHANNEL_LINES = {
    "rel_disp_m": "u",
    "mass_disp_m": "",
    "mass_acc_m_s2": "a",
    "force_r1_n": "F right",
    "force_r2_n": "F right",
    "force_l1_n": "F left",
    "force_l2_n": "F left",
}
LINE_COLOURS = {
    "u": RED,
    "a": GREEN,
    "F right": VIOLET,
    "F left": BLUE,
    "stiffness": RED,
    "damping": BLUE,
    "gap_r": RED,
    "gap_l": BLUE,
}


def disagreement_style(name: str) -> tuple[LineStyle, ...]:
    """Return the line style of a disagreement ratio."""
    return ((name, LINE_COLOURS.get(name, GREY), 2.0),)


def drift_styles(parameter: str) -> tuple[LineStyle, ...]:
    """Return the line styles of a parameter drift and of the bounds of its interval."""
    colour = LINE_COLOURS.get(parameter, GREY)
    name = {"gap_r": "gap, right", "gap_l": "gap, left"}.get(parameter, parameter)
    return (name, colour, 2.5), ("± 2 sd", colour, 0.7), ("± 2 sd", colour, 0.7)


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


class FrequencyCurves:
    """Curves over frequency so far: eta_d of the PRC, or amplitudes of orbits in mm over a plan."""

    def __init__(self, low_hz: float, high_hz: float, orbit_plan: OrbitPlan | None = None) -> None:
        self._orbit_plan = orbit_plan
        self._points: dict[int, PrcPoint] = {}
        self._orbits: dict[int, OrbitPoint] = {}
        self._highest = 0.1
        if orbit_plan is not None:
            frequencies_hz = [orbit.frequency_hz for orbit in orbit_plan.points]
            low_hz, high_hz = min(frequencies_hz), max(frequencies_hz)
            highest_mm = 1e3 * max(orbit.amplitude_m for orbit in orbit_plan.points)
            self._highest = nice_ceil(1.1 * highest_mm)
        margin = max(0.03 * (high_hz - low_hz), 0.05)
        self._frequency_range = low_hz - margin, high_hz + margin

    @property
    def axes(self) -> PlotAxes:
        label = "η_d [-]" if self._orbit_plan is None else "amplitude of u [mm]"
        return PlotAxes(self._frequency_range, (0.0, self._highest), "f [Hz]", label, PRC_WIDTH)

    def add(self, point: PrcPoint | OrbitPoint) -> None:
        """Add a point or an accepted orbit and extend the axes; one measured again replaces it."""
        if isinstance(point, PrcPoint):
            self._points[point.step] = point
            etas = [values.eta_d for values in (point.measured, point.twin) if values is not None]
            highest = max((eta for eta in etas if math.isfinite(eta)), default=0.0)
            if highest > self._highest and self._orbit_plan is None:
                self._highest = nice_ceil(1.1 * highest)
        elif point.accepted:
            self._orbits[point.step] = point

    def get_curves(self, source: str) -> list[tuple[Rgb, Float2D]]:
        """Return (color, (point, 2) in Hz and shown values) of the curves "measured" or "twin"."""
        if self._orbit_plan is None:
            curves = list_prc_curves(self._points.values(), attrgetter("eta_d"))
        else:
            orbits = (self._orbits[step] for step in sorted(self._orbits))
            curves = list_orbit_curves(self._orbit_plan, orbits)
        strips = []
        for curve in curves:
            if (curve.source == "twin") == (source == "twin"):
                strip = np.array(curve.points, dtype=np.float64).reshape(-1, 2)
                strip = strip[np.isfinite(strip).all(axis=1)]
                if len(strip):
                    strips.append((PRC_COLOURS[source][curve.direction == "backward"], strip))
        return strips


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
