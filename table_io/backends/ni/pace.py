"""Where sample 0 lies on the session's clock, as the device's own clock runs on beside it.

A device's clock differs from the computer's by some 10 to 50 ppm: 36 to 180 ms in an hour. So the
time of sample 0 follows: no sample comes before it is taken, and the quickest of a window of
samples is as late as the quickest of the first window was.
"""

import math

WINDOW_S = 5.0
MOST_S = 1e-3  # that one window may shift it: 200 ppm


class Pace:
    """Time of sample 0, in s, of a device that samples at `rate_hz`; told what comes, and when."""

    def __init__(self, rate_hz: float, epoch_s: float) -> None:
        self.epoch_s = epoch_s
        self._rate_hz = rate_hz
        self._usual_s: float | None = None
        self._quickest_s = math.inf
        self._window = 0

    def came(self, last: int, now: float) -> None:
        """Sample `last` was in hand at `now`."""
        late_s = now - last / self._rate_hz - self.epoch_s
        if late_s < 0:
            self.epoch_s += late_s
            late_s = 0.0
        self._quickest_s = min(self._quickest_s, late_s)
        if last < self._window + WINDOW_S * self._rate_hz:
            return
        if self._usual_s is None:
            self._usual_s = self._quickest_s
        shift_s = self._quickest_s - self._usual_s
        self.epoch_s += max(-MOST_S, min(shift_s, MOST_S))
        self._window, self._quickest_s = last, math.inf
