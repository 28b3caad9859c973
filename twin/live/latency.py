"""Latency statistics of a component: a histogram of fixed size, whatever the run's length."""

from dataclasses import dataclass, field

import numpy as np

from table_io.clock import Clock, cpu_seconds
from table_io.records import Timing

BIN_WIDTH_S = 1e-5
TIMING_INTERVAL_BLOCKS = 100  # between two Timing records of a component
BIN_COUNT = 50_000  # up to 0.5 s; larger latencies are counted in the last bin


@dataclass(slots=True)
class LatencyHistogram:
    """Histogram of one component's latencies; above `deadline_s` a deadline is missed."""

    component: str
    clock: Clock
    deadline_s: float
    scheduler: str = "normal"
    _counts: np.ndarray[tuple[int], np.dtype[np.int64]] = field(
        default_factory=lambda: np.zeros(BIN_COUNT, dtype=np.int64)
    )
    _largest_s: float = 0.0
    _missed: int = 0
    _started: tuple[float, float] | None = None

    def start(self) -> None:
        """Start measuring processor time."""
        self._started = (self.clock.now(), cpu_seconds())

    def add(self, latency_s: float) -> None:
        """Add the latency of one block, in s."""
        self._counts[min(max(int(latency_s / BIN_WIDTH_S), 0), BIN_COUNT - 1)] += 1
        self._largest_s = max(self._largest_s, latency_s)
        self._missed += latency_s > self.deadline_s

    def to_timing(self, index: int) -> Timing:
        """Return the statistics up to sample `index` as a Timing; latencies resolved to 10 us."""
        blocks = int(self._counts.sum())
        cumulative = np.cumsum(self._counts)
        p50, p99 = (
            (
                float(np.searchsorted(cumulative, quantile * blocks) + 1) * BIN_WIDTH_S * 1e3
                if blocks
                else 0.0
            )
            for quantile in (0.50, 0.99)
        )
        cpu_share = 0.0
        if self._started is not None:
            elapsed = self.clock.now() - self._started[0]
            cpu_share = (cpu_seconds() - self._started[1]) / elapsed if elapsed > 0 else 0.0
        return Timing(
            index, self.component, p50, p99, self._largest_s * 1e3, self._missed, blocks, cpu_share,
            self.scheduler,
        )  # fmt: skip
