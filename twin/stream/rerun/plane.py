"""A plane of u and another quantity: the trail of the last seconds on axes that follow its size."""

from dataclasses import dataclass

import numpy as np

from twin.stream.rerun.moving import Motion, Trail
from twin.stream.rerun.plots import PLANE_WIDTH, Axes, Reach
from twin.stream.rerun.sink import Sink

HOLD_S = 4.0  # that an axis waits before it shrinks
AGAIN = 400  # strips after which the axes are sent again, for a viewer that comes late


@dataclass(frozen=True, slots=True)
class Kind:
    """What stands on the y axis, the least half range of both axes, what the slope spans."""

    entity: str
    y_label: str
    least: tuple[float, float]
    slope_s: float


PHASE = Kind("phase", "u' [mm/s]", (1.0, 10.0), 0.01)
LOOP = Kind("loop", "F [kN]", (1.0, 0.1), 0.0)


class Plane:
    """Draws `Motion.u` in mm against 1e3 times `Motion.v`; for the measured one v is the slope."""

    def __init__(self, sink: Sink, kind: Kind, rate_hz: float, gaps_m: tuple[float, float]) -> None:
        self._sink = sink
        self._kind = kind
        self._rate_hz = rate_hz
        right, left = gaps_m
        self._gaps_mm = 1e3 * right, -1e3 * left
        stride, slope = max(1, round(rate_hz / 400)), round(rate_hz * kind.slope_s / 2)
        self._length = 20 * stride
        margin = max(1, slope) if kind.slope_s else 0
        self._trails = {
            "measured": Trail(self._length, stride, margin),
            "twin": Trail(self._length, stride, 0),
        }
        hold = round(HOLD_S * rate_hz / self._length)
        self._reach = tuple(Reach(least, hold) for least in kind.least)
        self._axes(0)

    def add(self, who: str, moves: Motion) -> None:
        """Draw a piece of a stream; the size of the measured one sets the axes."""
        strips = list(self._trails[who].add(moves, self._rate_hz))
        if not strips:
            return
        ends, lines = zip(*strips, strict=True)
        self._sink.trail(f"{self._kind.entity}/data/{who}", ends, lines)
        for end, strip in strips if who == "measured" else ():
            peaks = np.abs(strip).max(axis=0)
            changed = [one.see(peak) for one, peak in zip(self._reach, peaks, strict=True)]
            if any(changed) or end // self._length % AGAIN == 0:
                self._axes(end)

    def _axes(self, index: int) -> None:
        """The axes, and where the bumpers stand, from sample `index` on."""
        u, v = (one.value for one in self._reach)
        axes = Axes((-u, u), (-v, v), "u [mm]", self._kind.y_label, PLANE_WIDTH)
        self._sink.axes(self._kind.entity, index, axes)
        self._sink.strips(f"{self._kind.entity}/gaps", index, axes.uprights(self._gaps_mm))
