"""Recent samples of a run, for peaks, table level and twin errors."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Block, Float2D
from table_io.records import Comparison

WINDOW_S = 1.0
MAX_CYCLE_S = 20.0  # samples kept for the level, at most one cycle at 0.05 Hz


@dataclass(slots=True)
class RecentSamples:
    """Contiguous measured blocks and comparisons, as far back as needed."""

    blocks: deque[Block] = field(default_factory=deque)
    comparisons: deque[Comparison] = field(default_factory=deque)

    @property
    def end(self) -> int:
        return self.blocks[-1].end if self.blocks else 0

    def add(self, block: Block, cycle_s: float) -> None:
        """Add a block; keep `WINDOW_S` or one cycle of `cycle_s`, whichever is longer."""
        if self.blocks and (block.index != self.end or block.channels != self.blocks[-1].channels):
            self.blocks.clear()
        self.blocks.append(block)
        kept_samples = block.rate_hz * min(max(WINDOW_S, cycle_s), MAX_CYCLE_S)
        while self.blocks[0].end < block.end - kept_samples:
            self.blocks.popleft()

    def add_comparison(self, comparison: Comparison, rate_hz: float) -> None:
        """Add a comparison; keep those of the last `WINDOW_S`."""
        if self.comparisons and (
            comparison.index < self.comparisons[-1].index
            or comparison.channels != self.comparisons[-1].channels
        ):
            self.comparisons.clear()
        self.comparisons.append(comparison)
        while self.comparisons[0].index < comparison.index - WINDOW_S * rate_hz:
            self.comparisons.popleft()

    def last_second(self) -> tuple[tuple[str, ...], Float2D]:
        """Return (channels, values (channel, sample)) of the last second, SI."""
        if not self.blocks:
            return (), np.empty((0, 0))
        rate = self.blocks[-1].rate_hz
        newest = [block.values for block in self.blocks if block.end > self.end - WINDOW_S * rate]
        return self.blocks[-1].channels, np.concatenate(newest, axis=1)

    def table_level(self, frequency_hz: float) -> float | None:
        """Return the fundamental amplitude of the table acceleration over whole cycles, in m/s2.

        None if the step has not been held for one cycle yet.
        """
        steady = list(_select_steady(self.blocks))
        if not steady or "table_acc_m_s2" not in steady[0].channels:
            return None
        acc = np.concatenate([block.channel("table_acc_m_s2") for block in reversed(steady)])
        cycle = steady[0].rate_hz / frequency_hz
        if acc.size < cycle:
            return None
        count = round(acc.size // cycle * cycle)
        if not np.isfinite(acc[-count:]).all():
            return None
        rotation = np.exp(-2j * np.pi * np.arange(count) / cycle)
        return float(2.0 * abs(acc[-count:] @ rotation) / count)

    def twin_errors(self) -> dict[str, tuple[float, float, float]]:
        """Return (RMS, RMS error of restarted twin, of free twin) by channel, last second, SI."""
        if not self.comparisons:
            return {}
        count = sum(comparison.count for comparison in self.comparisons)
        sums = np.array(
            [
                (comparison.measured_ss, comparison.window_error_ss, comparison.free_error_ss)
                for comparison in self.comparisons
            ]
        ).sum(axis=0)
        rms = np.sqrt(sums / max(count, 1))
        return {
            name: (float(rms[0, k]), float(rms[1, k]), float(rms[2, k]))
            for k, name in enumerate(self.comparisons[-1].channels)
        }


def _select_steady(blocks: Iterable[Block]) -> Iterable[Block]:
    """Yield the newest blocks that lie entirely in held cycles of one step, newest first."""
    step = None
    for block in reversed(list(blocks)):
        step = int(block.step[-1]) if step is None else step
        if not ((block.cycle >= 0).all() and (block.step == step).all()):
            return
        yield block
