"""Buffers of a machine: its command, with a smooth stop of one in motion, and its samples."""

import math

import numpy as np

from table_io.block import Float1D, Float2D

MAX_END_ACC_M_S2 = 0.02  # a command is at rest if holding its end needs no more
GENTLE_ACC_M_S2 = 0.5  # limit of a stop, unless the command before it was rougher
MIN_STOP_S, MAX_STOP_S, STOP_GROWTH_FACTOR = 0.1, 60.0, 1.2  # durations that are tried
MIN_GENTLE_STOP_S = 0.5  # shortest stop, unless the span requires a shorter one
STOP_GRID_INTERVALS = 100  # of the time grid on which each duration is evaluated


class CommandBuffer:
    """Command by sample index: zero before sample 0, the last value held beyond the end."""

    def __init__(self) -> None:
        self._origin = 0
        self._values = np.zeros(1)

    @property
    def end(self) -> int:
        """Index from which the last value is held."""
        return self._origin + self._values.size

    def replace_from(self, index: int, values: Float1D) -> None:
        """Replace everything from sample `index` on."""
        first = min(self._origin, index)
        self._values = np.concatenate([self.values(first, index), values])
        self._origin = first

    def values(self, first: int, last: int) -> Float1D:
        """Return the values of samples first .. last - 1, (sample,)."""
        indices = np.arange(first, last) - self._origin
        values: Float1D = self._values[np.clip(indices, 0, self._values.size - 1)]
        values[indices + self._origin < 0] = 0.0
        return values

    def discard_before(self, index: int) -> None:
        """Discard the values before sample `index`, which must not be read again."""
        count = min(index - self._origin, self._values.size - 1)
        if count > 0:
            self._values = self._values[count:]
            self._origin += count


class SampleBuffer:
    """Samples that were received in order and not yet read; `received` counts all of them."""

    def __init__(self, channels: int) -> None:
        self.received = 0
        self._next_read = 0
        self._channels = channels
        self._blocks: list[Float2D] = []

    @property
    def next_read(self) -> int:
        """Index of the next sample to read."""
        return self._next_read

    @property
    def unread(self) -> int:
        """Number of samples to read."""
        return self.received - self._next_read

    def put(self, samples: Float2D) -> None:
        """Add the next samples, (channel, sample)."""
        self._blocks.append(samples)
        self.received += samples.shape[1]

    def take(self, count: int) -> Float2D:
        """Remove and return up to `count` samples, (channel, sample)."""
        unread = np.concatenate([np.empty((self._channels, 0)), *self._blocks], axis=1)
        self._blocks = [unread[:, count:]]
        taken = unread[:, :count]
        self._next_read += taken.shape[1]
        return taken


def find_newest_sample(received: int, elapsed_s: float, rate_hz: float) -> int:
    """Return the index of the newest sample taken `elapsed_s` after sample 0, received or not."""
    return max(received - 1, math.floor(elapsed_s * rate_hz + 1e-6))


def refuse_late_command(index: int, earliest: int, replace_after: int, holder: str) -> None:
    """Raise ValueError if output from sample `index` on, before `earliest`, cannot be replaced.

    The `holder`, such as "device", has it already.
    """
    if index < earliest:
        raise ValueError(
            f"the command from sample {index} on is already in the {holder}; allowed: from "
            f"{earliest} on ({replace_after} after the newest sample taken)"
        )


def can_hold(last: Float1D, rate_hz: float) -> bool:
    """Return True if holding the last of these values, m, (>= 2,), causes no jolt."""
    return abs(float(last[-1] - last[-2])) * rate_hz**2 <= MAX_END_ACC_M_S2


def plan_stop(last: Float1D, rate_hz: float, span_m: float = math.inf) -> Float1D:
    """Return displacement in m, (sample,), from the three `last` values smoothly to rest at 0.

    Quintic x(t) = x0 + v0 t + a0 t^2/2 + c3 t^3 + c4 t^4 + c5 t^5 with x, x', x'' = 0 at its end,
    limited to +-max(span_m, |x0|). Chosen is the shortest duration from 0.5 s on whose acceleration
    stays below max(0.5 m/s2, 1.05 |a0|); if there is none, the duration of least peak acceleration;
    if none stays within the span, the command stops abruptly at x0 and returns to 0 from there.
    """
    x = float(last[-1])
    a = float(last[-1] - 2.0 * last[-2] + last[-3]) * rate_hz**2
    v = float(last[-1] - last[-2]) * rate_hz + 0.5 * a / rate_hz
    limit_m = max(abs(x), span_m)
    seconds = _stop_duration_s(x, v, a, limit_m)
    if not seconds:
        v = a = 0.0
        seconds = _stop_duration_s(x, v, a, limit_m) or MAX_STOP_S
    count = int(np.ceil(seconds * rate_hz))
    path = _quintic(x, v, a, seconds)
    displacement: Float1D = path(np.minimum(np.arange(1, count + 1) / rate_hz, seconds))
    displacement[-1] = 0.0
    return np.clip(displacement, -limit_m, limit_m)


def _stop_duration_s(x: float, v: float, a: float, limit_m: float) -> float:
    """Return the duration of the stop in s; 0 if no quintic stays within +-limit_m."""
    gentle_acc, min_peak, best_s = max(GENTLE_ACC_M_S2, 1.05 * abs(a)), math.inf, 0.0
    seconds = MIN_STOP_S
    while seconds < STOP_GROWTH_FACTOR * MAX_STOP_S:
        path, t = _quintic(x, v, a, seconds), np.linspace(0.0, seconds, STOP_GRID_INTERVALS + 1)
        peak = float(np.abs(path.deriv(2)(t)).max())
        if float(np.abs(path(t)).max()) <= limit_m * (1.0 + 1e-9):
            if seconds >= MIN_GENTLE_STOP_S and peak <= gentle_acc:
                return seconds
            if peak < min_peak:
                min_peak, best_s = peak, seconds
        seconds *= STOP_GROWTH_FACTOR
    return best_s


def _quintic(x: float, v: float, a: float, seconds: float) -> np.polynomial.Polynomial:
    """Return the quintic in t from (x, v, a) at t = 0 to rest at 0 at t = `seconds`."""
    t = seconds
    c3 = -(20.0 * x + 12.0 * v * t + 3.0 * a * t**2) / (2.0 * t**3)
    c4 = (30.0 * x + 16.0 * v * t + 3.0 * a * t**2) / (2.0 * t**4)
    c5 = -(12.0 * x + 6.0 * v * t + a * t**2) / (2.0 * t**5)
    return np.polynomial.Polynomial([x, v, 0.5 * a, c3, c4, c5])
