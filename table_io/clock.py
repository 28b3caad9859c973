"""Clocks: the only import of `time`. A clock paces and measures; it never enters a calculation."""

import time
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

SPIN_S = 0.0002  # sleep() wakes up late by about this; the rest is waited out awake


class Clock(Protocol):
    """What paces a loop: seconds from an arbitrary origin, never going back."""

    def now(self) -> float:
        """Seconds now."""

    def wait_until(self, when: float) -> None:
        """Return at `when` or, if that is past, at once."""


@dataclass(frozen=True, slots=True)
class RealClock:
    """The machine's monotonic clock, shared by all processes on it; `pace` times as fast."""

    pace: float = 1.0

    def now(self) -> float:
        return time.monotonic() * self.pace

    def wait_until(self, when: float) -> None:
        while (left := when / self.pace - time.monotonic()) > 0:
            if left > SPIN_S:
                time.sleep(left - SPIN_S)


@dataclass(slots=True)
class ManualClock:
    """A clock that jumps to wherever it is waited for: the same samples, as fast as possible."""

    time_s: float = 0.0

    def now(self) -> float:
        return self.time_s

    def wait_until(self, when: float) -> None:
        self.time_s = max(self.time_s, when)


def cpu_seconds() -> float:
    """Processor time that this process has used, in s, all threads."""
    return time.process_time()


def today() -> datetime:
    """Wall clock in local time, for names and provenance only."""
    return datetime.now(UTC).astimezone()


def wall_ns() -> int:
    """Wall clock in ns since 1970, for publish times in logs only."""
    return time.time_ns()
