"""How punctual a component is: a histogram of latencies, so that a long run costs no more."""

from dataclasses import dataclass, field

import numpy as np

from table_io.clock import Clock, cpu_seconds
from table_io.records import Timing

BIN_S = 1e-5
TIMING_BLOCKS = 100  # between two records of a component
BINS = 50_000  # up to 0.5 s; what is later falls into the last one


@dataclass(slots=True)
class Stopwatch:
    """Latencies of one component; `deadline_s` late is a missed deadline."""

    component: str
    clock: Clock
    deadline_s: float
    scheduler: str = "normal"
    _counts: np.ndarray[tuple[int], np.dtype[np.int64]] = field(
        default_factory=lambda: np.zeros(BINS, dtype=np.int64)
    )
    _largest_s: float = 0.0
    _missed: int = 0
    _began: tuple[float, float] | None = None

    def begin(self) -> None:
        """Count processor time from here."""
        self._began = (self.clock.now(), cpu_seconds())

    def add(self, latency_s: float) -> None:
        """One block's latency in s."""
        self._counts[min(max(int(latency_s / BIN_S), 0), BINS - 1)] += 1
        self._largest_s = max(self._largest_s, latency_s)
        self._missed += latency_s > self.deadline_s

    def record(self, index: int) -> Timing:
        """Everything so far, as it stands at sample `index`; latencies resolved to 10 us."""
        blocks = int(self._counts.sum())
        below = np.cumsum(self._counts)
        p50, p99 = (
            (float(np.searchsorted(below, share * blocks) + 1) * BIN_S * 1e3 if blocks else 0.0)
            for share in (0.50, 0.99)
        )
        share = 0.0
        if self._began is not None:
            elapsed = self.clock.now() - self._began[0]
            share = (cpu_seconds() - self._began[1]) / elapsed if elapsed > 0 else 0.0
        return Timing(
            index, self.component, p50, p99, self._largest_s * 1e3, self._missed, blocks, share,
            self.scheduler,
        )  # fmt: skip
