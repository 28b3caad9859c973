"""What the processes of a live run share: configuration, scheduling, latency, dead supervisor."""

import gc
import json
import os
import select
import sys
import tomllib
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from table_io.clock import Clock, cpu_seconds
from table_io.records import Timing
from twin.setup.run_config import RunConfig, from_texts

CONNECT_TIMEOUT_S = 15.0
INBOX_CAPACITY = 50_000  # fragments queued in an inbox
LINGER_S = 10.0  # for which a publisher stays up after the run for retransmission
BIN_WIDTH_S = 1e-5
TIMING_INTERVAL_BLOCKS = 100  # between two Timing records of a component
BIN_COUNT = 50_000  # up to 0.5 s; larger latencies are counted in the last bin
MAX_QUIET_S = 3.0  # of silence, after which a process stops waiting for final messages


@dataclass(frozen=True, slots=True)
class ProcessConfig:
    """Configuration of a run's processes; `folder` is the run's folder, the texts are TOML.

    `endpoint` is the internal bus, `listen` the public endpoint for observers, `keys` a folder of
    keys or "".
    """

    run: str
    name: str
    folder: str
    listen: str
    profile_toml: str
    rig_toml: str
    model_toml: str
    serve_view: str = ""  # address of the live Rerun view, if requested
    keys: str = ""
    remote_twin: bool = False  # no twin is started here; a remote one may publish its output
    router: str = ""  # endpoint of a router through which observers connect, if any
    endpoint: str = ""

    def write(self, path: Path) -> None:
        path.write_text(json.dumps(asdict(self)))

    @staticmethod
    def read(path: Path) -> "ProcessConfig":
        return ProcessConfig(**json.loads(path.read_text()))

    @property
    def rig_name(self) -> str:
        """Name of the rig."""
        return str(tomllib.loads(self.rig_toml)["name"])

    def make_run_config(self) -> RunConfig:
        return from_texts(self.name, self.profile_toml, self.rig_toml, self.model_toml, self.name)


def process_token(config: ProcessConfig, component: str) -> str:
    """Return the liveliness token of a process, unique to this run."""
    return f"{config.run}.{component}"


def is_orphaned() -> bool:
    """Return True once the supervisor's end of our standard input is closed."""
    ready, _, _ = select.select([sys.stdin], [], [], 0.0)
    return bool(ready) and not os.read(sys.stdin.fileno(), 64)


def request_realtime(priority: int) -> str:
    """Request real-time scheduling and return the policy granted.

    Call it before any thread is created, so that the link's threads inherit the policy. Objects
    created by imports are frozen out of garbage collection: a full collection of them takes 15 ms
    in the middle of a run.
    """
    gc.collect()
    gc.freeze()
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError):
        return "normal"
    return f"fifo {priority}"


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
