"""The last samples of a run, for its peaks, its level and the errors of its twin."""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Block, Float2D
from table_io.records import Comparison

SECOND = 1.0
LONGEST_S = 20.0  # of samples kept for the level: one cycle at 0.05 Hz


@dataclass(slots=True)
class Recent:
    """Measured blocks without a gap between them, and comparisons; as many as are looked at."""

    blocks: deque[Block] = field(default_factory=deque)
    compared: deque[Comparison] = field(default_factory=deque)

    @property
    def end(self) -> int:
        return self.blocks[-1].end if self.blocks else 0

    def add(self, block: Block, cycle_s: float) -> None:
        """Take a block; keep a second, or the `cycle_s` that one cycle lasts."""
        if self.blocks and (block.index != self.end or block.channels != self.blocks[-1].channels):
            self.blocks.clear()
        self.blocks.append(block)
        keep = block.rate_hz * min(max(SECOND, cycle_s), LONGEST_S)
        while self.blocks[0].end < block.end - keep:
            self.blocks.popleft()

    def compare(self, comparison: Comparison, rate_hz: float) -> None:
        """Take a comparison; keep those of a second."""
        if self.compared and (
            comparison.index < self.compared[-1].index
            or comparison.channels != self.compared[-1].channels
        ):
            self.compared.clear()
        self.compared.append(comparison)
        while self.compared[0].index < comparison.index - SECOND * rate_hz:
            self.compared.popleft()

    def second(self) -> tuple[tuple[str, ...], Float2D]:
        """(channels, values (channel, sample)) of the last second, SI."""
        if not self.blocks:
            return (), np.empty((0, 0))
        rate = self.blocks[-1].rate_hz
        newest = [one.values for one in self.blocks if one.end > self.end - SECOND * rate]
        return self.blocks[-1].channels, np.concatenate(newest, axis=1)

    def level(self, frequency_hz: float) -> float | None:
        """Fundamental of the table's acceleration over the last whole cycles, m/s2, peak.

        None where the table has not been held at this frequency for a cycle.
        """
        held = list(_held(self.blocks))
        if not held or "table_acc_m_s2" not in held[0].channels:
            return None
        acc = np.concatenate([one.channel("table_acc_m_s2") for one in reversed(held)])
        cycle = held[0].rate_hz / frequency_hz
        if acc.size < cycle:
            return None
        count = round(acc.size // cycle * cycle)
        if not np.isfinite(acc[-count:]).all():
            return None
        turn = np.exp(-2j * np.pi * np.arange(count) / cycle)
        return float(2.0 * abs(acc[-count:] @ turn) / count)

    def errors(self) -> dict[str, tuple[float, float, float]]:
        """(rms, rms error of the restarted twin, of the free one) by channel, last second, SI."""
        if not self.compared:
            return {}
        count = sum(one.count for one in self.compared)
        sums = np.array(
            [(one.measured_ss, one.window_error_ss, one.free_error_ss) for one in self.compared]
        ).sum(axis=0)
        rms = np.sqrt(sums / max(count, 1))
        return {
            name: (float(rms[0, k]), float(rms[1, k]), float(rms[2, k]))
            for k, name in enumerate(self.compared[-1].channels)
        }


def _held(blocks: Iterable[Block]) -> Iterable[Block]:
    """The newest blocks that are held at one step all through, the newest first."""
    step = None
    for block in reversed(list(blocks)):
        step = int(block.step[-1]) if step is None else step
        if not ((block.cycle >= 0).all() and (block.step == step).all()):
            return
        yield block
