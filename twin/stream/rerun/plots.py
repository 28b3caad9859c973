"""Plots with drawn axes: round numbers, grids, ranges, and the curves of the PRC."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from table_io.block import Float1D, Float2D
from table_io.records import Ahead, Point
from twin.stream.rerun.looks import PLUM, PRC_COLOURS, VIOLET, Rgb

PRC_WIDTH, PLANE_WIDTH = 2.9, 1.5  # to the height of 1


def nice(value: float) -> float:
    """Smallest of 1, 1.5, 2, 3, 4, 5, 6, 8, 10 times a power of ten that is >= value > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    steps = (1, 1.5, 2, 3, 4, 5, 6, 8, 10)
    return next((step * power for step in steps if step * power >= value * (1 - 1e-9)), 10 * power)


def nice_below(value: float) -> float:
    """Largest of 1, 2, 5 times a power of ten that is <= value > 0."""
    power = 10.0 ** math.floor(math.log10(value))
    return max(step * power for step in (1, 2, 5) if step * power <= value * (1 + 1e-9))


@dataclass(frozen=True, slots=True)
class Axes:
    """A plot drawn `width` by HEIGHT, y downward as 2D views have it; x and y in data units."""

    x: tuple[float, float]
    y: tuple[float, float]
    x_label: str
    y_label: str
    width: float

    HEIGHT: ClassVar = 1.0

    @property
    def scale(self) -> tuple[float, float]:
        """Drawn length of one data unit; y negative, because up is up in a plot."""
        return self.width / (self.x[1] - self.x[0]), -self.HEIGHT / (self.y[1] - self.y[0])

    @property
    def origin(self) -> tuple[float, float]:
        """Where data (0, 0) is drawn."""
        return -self.x[0] * self.scale[0], self.HEIGHT - self.y[0] * self.scale[1]

    @staticmethod
    def ticks(low: float, high: float) -> Float1D:
        """Four to ten round numbers within low .. high."""
        step = nice_below((high - low) / 4)
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        return np.arange(first, last + 1, dtype=np.float64) * step

    def grid(self) -> list[Float2D]:
        """The frame and a line at every tick, drawn units, each (point, 2)."""
        (sx, sy), (ox, oy), w, h = self.scale, self.origin, self.width, self.HEIGHT
        lines = [np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]], dtype=np.float64)]
        lines += [np.array([[ox + sx * x, 0], [ox + sx * x, h]]) for x in self.ticks(*self.x)]
        lines += [np.array([[0, oy + sy * y], [w, oy + sy * y]]) for y in self.ticks(*self.y)]
        return lines

    def uprights(self, values: Iterable[float]) -> list[Float2D]:
        """A vertical line at each value of x within the axes, drawn units, each (2, 2)."""
        places = [self.origin[0] + self.scale[0] * x for x in values if self.x[0] <= x <= self.x[1]]
        return [np.array([[x, 0.0], [x, self.HEIGHT]]) for x in places]

    def labels(self) -> tuple[Float2D, list[str]]:
        """Where the numbers and names stand, drawn units (label, 2), and what they say."""
        (sx, sy), (ox, oy), w, h = self.scale, self.origin, self.width, self.HEIGHT
        places = [(ox + sx * x, h + 0.03) for x in self.ticks(*self.x)]
        places += [(-0.08, oy + sy * y - 0.035) for y in self.ticks(*self.y)]
        texts = [f"{tick:.6g}" for tick in (*self.ticks(*self.x), *self.ticks(*self.y))]
        names = [((w / 2, h + 0.12), self.x_label), ((0.0, -0.13), self.y_label)]
        return (
            np.array([*places, *(place for place, _ in names)]),
            [*texts, *(text for _, text in names)],
        )


class Reach:
    """The half range of an axis: grows at once, shrinks when `hold` peaks fill less than 40 %."""

    def __init__(self, least: float, hold: int) -> None:
        self.value = least
        self._least = least
        self._peaks = np.zeros(hold)
        self._at = 0

    def see(self, peak: float) -> bool:
        """True if the range changed with this peak."""
        self._peaks[self._at % self._peaks.size] = peak
        self._at += 1
        highest = max(float(self._peaks.max()), self._least / 1.05)
        if 0.4 * self.value <= highest <= self.value:
            return False
        before, self.value = self.value, nice(1.05 * highest)
        return self.value != before


class Curves:
    """The PRC as it grows: eta_d over frequency."""

    def __init__(self, low_hz: float, high_hz: float) -> None:
        room = max(0.03 * (high_hz - low_hz), 0.05)
        self._range = (low_hz - room, high_hz + room)
        self._points: dict[tuple[int, int], Point] = {}
        self._top = 0.1

    @property
    def axes(self) -> Axes:
        return Axes(self._range, (0.0, self._top), "f [Hz]", "η_d [-]", PRC_WIDTH)

    def add(self, point: Point) -> None:
        """One more point; the axes grow with it."""
        self._points[point.index, point.step] = point  # the same one twice is one
        etas = [who.eta_d for who in (point.measured, point.twin) if who is not None]
        highest = max((eta for eta in etas if math.isfinite(eta)), default=0.0)
        if highest > self._top:
            self._top = nice(1.1 * highest)

    def of(self, who: str) -> list[tuple[Rgb, Float2D]]:
        """(colour, (point, 2) Hz and eta_d) of each direction that has points."""
        found = []
        for way, colour in zip(("forward", "backward"), PRC_COLOURS[who], strict=True):
            rows = [
                (point.frequency_hz, quantities.eta_d)
                for point in self._points.values()
                if point.direction == way and (quantities := getattr(point, who)) is not None
            ]
            curve = np.array(rows, dtype=np.float64).reshape(-1, 2)
            curve = curve[np.isfinite(curve).all(axis=1)]
            if len(curve):
                found.append((colour, curve))
        return found


def foreseen(axes: Axes, ahead: Ahead) -> list[tuple[Rgb, Float2D]]:
    """(colour, upright) at the ends of the next jump's interval and where it is expected."""
    if not ahead.kind:
        return []
    places = (ahead.low_hz, PLUM), (ahead.high_hz, PLUM), (ahead.jump_hz, VIOLET)
    return [(colour, line) for place, colour in places for line in axes.uprights([place])]
