"""Clock synchronization: the time of sample 0 on the session's clock, corrected for clock drift.

The device's clock differs from the computer's by 10 to 50 ppm, 36 to 180 ms in an hour. The time of
sample 0 therefore follows two rules: no sample arrives before it is taken, and the smallest delay
in each window of samples equals the smallest delay in the first window.
"""

import math

WINDOW_S = 5.0
MAX_SHIFT_S = 1e-3  # correction per window, at most: 200 ppm


class ClockSync:
    """Estimate of `epoch_s`, the time of sample 0 in s, from the arrival times of samples."""

    def __init__(self, rate_hz: float, epoch_s: float) -> None:
        self.epoch_s = epoch_s
        self._rate_hz = rate_hz
        self._reference_delay_s: float | None = None
        self._min_delay_s = math.inf
        self._window_start = 0

    def update(self, last: int, now_s: float) -> None:
        """Update the estimate: sample `last` had arrived at `now_s`, in s."""
        delay_s = now_s - last / self._rate_hz - self.epoch_s
        if delay_s < 0:
            self.epoch_s += delay_s
            delay_s = 0.0
        self._min_delay_s = min(self._min_delay_s, delay_s)
        if last < self._window_start + WINDOW_S * self._rate_hz:
            return
        if self._reference_delay_s is None:
            self._reference_delay_s = self._min_delay_s
        shift_s = self._min_delay_s - self._reference_delay_s
        self.epoch_s += max(-MAX_SHIFT_S, min(shift_s, MAX_SHIFT_S))
        self._window_start, self._min_delay_s = last, math.inf
