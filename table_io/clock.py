"""Clocks that pace loops and measure latency; the only module that imports `time`.

No calculation depends on a clock.
"""

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

SPIN_S = 0.0002  # sleep() overshoots by about this much, so the remainder is a busy wait


class Clock(Protocol):
    """Monotonic clock in s from an arbitrary origin."""

    def now(self) -> float:
        """Return the current time in s."""

    def wait_until(self, when: float) -> None:
        """Return at time `when` in s, or at once if that has passed."""


@dataclass(frozen=True, slots=True)
class RealClock:
    """Monotonic clock of this computer, in s times `pace`: at pace 2 it runs twice as fast."""

    pace: float = 1.0

    def now(self) -> float:
        return time.monotonic() * self.pace

    def wait_until(self, when: float) -> None:
        while (remaining_s := when / self.pace - time.monotonic()) > 0:
            if remaining_s > SPIN_S:
                time.sleep(remaining_s - SPIN_S)


@dataclass(slots=True)
class ManualClock:
    """Virtual clock that jumps to the awaited time: same samples, as fast as possible."""

    time_s: float = 0.0

    def now(self) -> float:
        return self.time_s

    def wait_until(self, when: float) -> None:
        self.time_s = max(self.time_s, when)


def cpu_seconds() -> float:
    """Return the processor time used by all threads of this process in s."""
    return time.process_time()


def local_datetime() -> datetime:
    """Return the wall-clock time with the local time zone, for names and provenance only."""
    return datetime.now(UTC).astimezone()


def wall_clock_ns() -> int:
    """Return the wall-clock time in ns since 1970, for publish times in logs only."""
    return time.time_ns()
