"""Motion of the rig extracted from blocks as arrays, and the trail of the phase plane."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Float2D
from table_io.channels import contact_forces, relative_displacement


@dataclass(frozen=True, slots=True)
class BlockMotion:
    """Motion and forces in one part of a stream, SI, right positive, (sample,) each.

    NaN for missing channels; `force_l` <= 0.
    """

    index: npt.NDArray[np.int64]
    u: Float1D
    v: Float1D
    table_disp: Float1D
    acc: Float1D
    table_acc: Float1D
    force_r: Float1D
    force_l: Float1D
    damper_force: Float1D

    def select_frames(self, stride: int) -> "BlockMotion":
        """Return the samples at multiples of `stride` at which the position is known."""
        known = np.isfinite(self.u) & np.isfinite(self.table_disp)
        indices = np.flatnonzero((self.index % stride == 0) & known)
        return BlockMotion(*(getattr(self, name)[indices] for name in BlockMotion.__slots__))


def extract_motion(block: Block) -> BlockMotion:
    """Extract the motion from a block with canonical channel names."""

    def get_channel(name: str) -> Float1D:
        missing = np.full(len(block), np.nan)
        return block.channel(name) if name in block.channels else missing

    u = relative_displacement(block)
    table = get_channel("table_disp_m")
    if "table_disp_m" not in block.channels:
        table = get_channel("mass_disp_m") - u
    return BlockMotion(
        np.arange(block.index, block.end),
        u,
        get_channel("rel_vel_m_s"),
        table,
        get_channel("mass_acc_m_s2"),
        get_channel("table_acc_m_s2"),
        *contact_forces(block),
        get_channel("damper_force_n"),
    )


def extract_track(block: Block, name: str) -> Block:
    """Return the channels `name/...` of a predicted block under their canonical names."""
    prefix = f"{name}/"
    rows = [row for row, channel in enumerate(block.channels) if channel.startswith(prefix)]
    names = tuple(block.channels[row].removeprefix(prefix) for row in rows)
    labels = (block.step, block.label, block.cycle)
    return Block(block.stream, block.index, block.rate_hz, names, block.values[rows], *labels)


class Trail:
    """Trail of u and u' in short joined strips, independent of the block boundaries.

    With a `margin` > 0 the velocity is the centered difference of u over `2 * margin` samples.
    """

    def __init__(self, length: int, stride: int, margin: int) -> None:
        self._length, self._stride, self._margin = length, stride, margin
        self._first = 0
        self._u = np.empty(0)
        self._v = np.empty(0)

    def add(self, motion: BlockMotion, rate_hz: float) -> Iterator[tuple[int, Float2D]]:
        """Yield (end sample index, strip (point, 2) in mm and mm/s) of each completed strip."""
        first = int(motion.index[0])
        if first != self._first + self._u.size:
            self._first, self._u, self._v = first, np.empty(0), np.empty(0)
        self._u = np.concatenate([self._u, motion.u])
        self._v = np.concatenate([self._v, motion.v])
        margin, length = self._margin, self._length
        start = -(-(self._first + margin) // length) * length
        while start + length + margin < self._first + self._u.size:
            indices = np.arange(start, start + length + 1, self._stride) - self._first
            rise = self._u[indices + margin] - self._u[indices - margin]
            v = rise * (rate_hz / (2 * margin)) if margin else self._v[indices]
            strip = 1e3 * np.stack([self._u[indices], v], axis=1)
            strip = strip[np.isfinite(strip).all(axis=1)]
            start += length
            if len(strip) > 1:
                yield start, strip
        drop = max(start - margin - self._first, 0)
        self._first += drop
        self._u, self._v = self._u[drop:], self._v[drop:]
