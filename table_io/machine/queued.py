"""What a machine has been told to play, and the smooth way to its mean where that ends too soon."""

import math

import numpy as np

from table_io.block import Float1D

STILL_M_S2 = 0.02  # an end is still where stopping there asks for no more than this
GENTLE_M_S2 = 0.5  # of a landing, unless what it follows was rougher
SHORTEST_S, LONGEST_S, LONGER = 0.1, 60.0, 1.2  # landings that are tried
GENTLE_S = 0.5  # the shortest where nothing is in the way
LOOKS = 100  # at each that is tried


class Queued:
    """Values sample by sample: zero before sample 0, the last value beyond the end."""

    def __init__(self) -> None:
        self._origin = 0
        self._values = np.zeros(1)

    @property
    def end(self) -> int:
        """Index from which the last value is held."""
        return self._origin + self._values.size

    def put(self, index: int, values: Float1D) -> None:
        """Replace everything from sample `index` on."""
        first = min(self._origin, index)
        self._values = np.concatenate([self.take(first, index), values])
        self._origin = first

    def take(self, first: int, last: int) -> Float1D:
        """Values of samples first .. last - 1, (sample,)."""
        at = np.arange(first, last) - self._origin
        values: Float1D = self._values[np.clip(at, 0, self._values.size - 1)]
        values[at + self._origin < 0] = 0.0
        return values

    def forget(self, before: int) -> None:
        """Drop what lies before a sample; it must not be asked for again."""
        drop = min(before - self._origin, self._values.size - 1)
        if drop > 0:
            self._values = self._values[drop:]
            self._origin += drop


def is_still(last: Float1D, rate_hz: float) -> bool:
    """True where holding the last of these values, m, (>= 2,), is no jolt."""
    return abs(float(last[-1] - last[-2])) * rate_hz**2 <= STILL_M_S2


def landing(last: Float1D, rate_hz: float, span_m: float = math.inf) -> Float1D:
    """Displacement in m, (sample,), that goes on from the three `last` values to rest at 0.

    x(t) = x0 + v0 t + a0 t^2/2 + c3 t^3 + c4 t^4 + c5 t^5 with x, x', x'' = 0 at its end. It stays
    within +-span_m, or where it is: the shortest from 0.5 s on whose acceleration stays below
    max(0.5 m/s2, 1.05 |a0|); where none does, that of the least acceleration; where none stays
    within the span, it stops dead where it is and goes home from there.
    """
    x = float(last[-1])
    a = float(last[-1] - 2.0 * last[-2] + last[-3]) * rate_hz**2
    v = float(last[-1] - last[-2]) * rate_hz + 0.5 * a / rate_hz
    most = max(abs(x), span_m)
    seconds = _seconds(x, v, a, most)
    if not seconds:
        v = a = 0.0
        seconds = _seconds(x, v, a, most) or LONGEST_S
    count = int(np.ceil(seconds * rate_hz))
    path = _quintic(x, v, a, seconds)
    landed: Float1D = path(np.minimum(np.arange(1, count + 1) / rate_hz, seconds))
    landed[-1] = 0.0
    return np.clip(landed, -most, most)


def _seconds(x: float, v: float, a: float, most_m: float) -> float:
    """How long the landing from there takes; 0 where none stays within +-most_m."""
    gentle, least, best = max(GENTLE_M_S2, 1.05 * abs(a)), math.inf, 0.0
    seconds = SHORTEST_S
    while seconds < LONGER * LONGEST_S:
        path, t = _quintic(x, v, a, seconds), np.linspace(0.0, seconds, LOOKS + 1)
        peak = float(np.abs(path.deriv(2)(t)).max())
        if float(np.abs(path(t)).max()) <= most_m * (1.0 + 1e-9):
            if seconds >= GENTLE_S and peak <= gentle:
                return seconds
            if peak < least:
                least, best = peak, seconds
        seconds *= LONGER
    return best


def _quintic(x: float, v: float, a: float, seconds: float) -> np.polynomial.Polynomial:
    """The polynomial in t from (x, v, a) at 0 to rest at 0 at `seconds`."""
    t = seconds
    c3 = -(20.0 * x + 12.0 * v * t + 3.0 * a * t**2) / (2.0 * t**3)
    c4 = (30.0 * x + 16.0 * v * t + 3.0 * a * t**2) / (2.0 * t**4)
    c5 = -(12.0 * x + 6.0 * v * t + a * t**2) / (2.0 * t**5)
    return np.polynomial.Polynomial([x, v, 0.5 * a, c3, c4, c5])
