"""What a stream draws of the rig's motion, as plain arrays; the trail of the phase plane."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from table_io.block import Block, Float1D, Float2D, join
from table_io.channels import contact_forces, rel_disp


@dataclass(frozen=True, slots=True)
class Motion:
    """What one piece of a stream draws, SI, right positive; every array (sample,).

    NaN where there is no such channel. `force_l` <= 0.
    """

    index: npt.NDArray[np.int64]
    u: Float1D
    v: Float1D
    table: Float1D
    acc: Float1D
    table_acc: Float1D
    force_r: Float1D
    force_l: Float1D
    damper: Float1D

    def known_every(self, stride: int) -> "Motion":
        """Every sample whose index is a multiple of `stride`, where the rig's place is known."""
        known = np.isfinite(self.u) & np.isfinite(self.table)
        at = np.flatnonzero((self.index % stride == 0) & known)
        return Motion(*(getattr(self, name)[at] for name in Motion.__slots__))


def motion(block: Block) -> Motion:
    """What a block of measured or stripped predicted channels draws."""

    def of(name: str) -> Float1D:
        missing = np.full(len(block), np.nan)
        return block.channel(name) if name in block.channels else missing

    u = rel_disp(block)
    table = of("table_disp_m")
    if "table_disp_m" not in block.channels:
        table = of("mass_disp_m") - u
    return Motion(
        np.arange(block.index, block.end),
        u,
        of("rel_vel_m_s"),
        table,
        of("mass_acc_m_s2"),
        of("table_acc_m_s2"),
        *contact_forces(block),
        of("damper_force_n"),
    )


def track(block: Block, name: str) -> Block:
    """The channels `name/...` of a predicted block under their canonical names."""
    mark = f"{name}/"
    rows = [row for row, channel in enumerate(block.channels) if channel.startswith(mark)]
    names = tuple(block.channels[row].removeprefix(mark) for row in rows)
    labels = (block.step, block.label, block.cycle)
    return Block(block.stream, block.index, block.rate_hz, names, block.values[rows], *labels)


def pieces(blocks: Iterable[Block]) -> list[Block]:
    """The blocks joined where they follow each other with the same channels."""
    runs: list[list[Block]] = []
    for block in blocks:
        last = runs[-1][-1] if runs else None
        if last and last.end == block.index and last.channels == block.channels:
            runs[-1].append(block)
        else:
            runs.append([block])
    return [join(run) for run in runs]


class Trail:
    """Cuts u and u' into short strips, each ending where the next begins; the same for any blocks.

    Where no velocity is given it is the slope of u over `2 * margin` samples, centred.
    """

    def __init__(self, length: int, stride: int, margin: int) -> None:
        self._length, self._stride, self._margin = length, stride, margin
        self._first = 0
        self._u = np.empty(0)
        self._v = np.empty(0)

    def add(self, moves: Motion, rate_hz: float) -> Iterator[tuple[int, Float2D]]:
        """(sample index of its end, strip (point, 2) in mm and mm/s) of every strip now whole."""
        first = int(moves.index[0])
        if first != self._first + self._u.size:
            self._first, self._u, self._v = first, np.empty(0), np.empty(0)
        self._u = np.concatenate([self._u, moves.u])
        self._v = np.concatenate([self._v, moves.v])
        margin, length = self._margin, self._length
        start = -(-(self._first + margin) // length) * length
        while start + length + margin < self._first + self._u.size:
            at = np.arange(start, start + length + 1, self._stride) - self._first
            rise = self._u[at + margin] - self._u[at - margin]
            v = rise * (rate_hz / (2 * margin)) if margin else self._v[at]
            strip = 1e3 * np.stack([self._u[at], v], axis=1)
            strip = strip[np.isfinite(strip).all(axis=1)]
            start += length
            if len(strip) > 1:
                yield start, strip
        drop = max(start - margin - self._first, 0)
        self._first += drop
        self._u, self._v = self._u[drop:], self._v[drop:]
