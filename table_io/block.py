"""Block: consecutive samples of several channels, labeled with the state of the drive.

The sample index is the time base: sample i is taken i / rate_hz seconds after the start of the run.
No calculation reads a wall clock.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from itertools import pairwise

import numpy as np
import numpy.typing as npt

Float1D = npt.NDArray[np.float64]
Float2D = npt.NDArray[np.float64]
Int1D = npt.NDArray[np.int64]
Int2D = npt.NDArray[np.int64]
Bool1D = npt.NDArray[np.bool_]
Bool2D = npt.NDArray[np.bool_]


class Label(IntEnum):
    """State of the drive at a sample."""

    REST = 0  # no motion commanded
    BLEND = 1  # soft start, soft stop or change of step; never measured
    SETTLE = 2  # held at the step but not measured: settling, tuning or an operator's hold
    MEASURE = 3  # held cycle that enters the PRC point, or a sample of a displacement history
    STOP = 4  # decay to rest after a stop or a trip
    CHECK = 5  # held cycle of the loop check, at low level, before the sweep


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Samples index .. index + n - 1 of one stream: `values` in SI, float64 (channel, sample).

    `step`, `label` and `cycle` are int64 (sample,): the sweep step or the window of a displacement
    history (-1 outside), the Label, and the number of the held cycle within the step (-1 outside
    held cycles).
    """

    stream: str
    index: int
    rate_hz: float
    channels: tuple[str, ...]
    values: Float2D
    step: Int1D
    label: Int1D
    cycle: Int1D

    def __post_init__(self) -> None:
        shape = (len(self.channels), self.step.size)
        if self.values.shape != shape or self.label.size != shape[1] or self.cycle.size != shape[1]:
            raise ValueError(f"block values {self.values.shape} and labels do not fit {shape}")
        for array in (self.values, self.step, self.label, self.cycle):
            array.setflags(write=False)

    def __len__(self) -> int:
        return self.step.size

    @property
    def end(self) -> int:
        """Index of the first sample after this block."""
        return self.index + self.step.size

    @property
    def time_s(self) -> Float1D:
        """Time of each sample since the start of the run in s, (sample,)."""
        return (self.index + np.arange(len(self), dtype=np.float64)) / self.rate_hz

    @property
    def is_history(self) -> Bool1D:
        """Whether each sample belongs to a displacement history that is played, (sample,)."""
        return (self.label == Label.MEASURE) & (self.cycle < 0)

    def channel(self, name: str) -> Float1D:
        """Return the samples of one channel, (sample,); a KeyError lists the available channels."""
        try:
            return self.values[self.channels.index(name)]
        except ValueError:
            raise KeyError(f"{name} is not in {self.stream}: {', '.join(self.channels)}") from None

    def cut(self, first: int, last: int) -> "Block":
        """Return samples first <= i < last as a view; ValueError if they exceed the block."""
        if not self.index <= first <= last <= self.end:
            raise ValueError(
                f"samples {first} to {last} do not lie in the block {self.index} to {self.end}"
            )
        window = slice(first - self.index, last - self.index)
        return Block(
            self.stream,
            first,
            self.rate_hz,
            self.channels,
            self.values[:, window],
            self.step[window],
            self.label[window],
            self.cycle[window],
        )

    def is_identical(self, other: "Block") -> bool:
        """Return True if every field is bitwise equal (NaN equals the same NaN)."""
        return (
            (self.stream, self.index, self.rate_hz, self.channels)
            == (other.stream, other.index, other.rate_hz, other.channels)
            and self.values.tobytes() == other.values.tobytes()
            and all(
                np.array_equal(getattr(self, name), getattr(other, name))
                for name in ("step", "label", "cycle")
            )
        )


def join_blocks(blocks: Sequence[Block]) -> Block:
    """Concatenate consecutive blocks of one stream; ValueError if samples are missing."""
    for left, right in pairwise(blocks):
        if (left.stream, left.end, left.rate_hz, left.channels) != (
            right.stream,
            right.index,
            right.rate_hz,
            right.channels,
        ):
            raise ValueError(
                f"block at {right.index} does not continue the one that ends at {left.end}"
            )
    head = blocks[0]
    if len(blocks) == 1:
        return head
    return Block(
        head.stream,
        head.index,
        head.rate_hz,
        head.channels,
        np.concatenate([b.values for b in blocks], axis=1),
        np.concatenate([b.step for b in blocks]),
        np.concatenate([b.label for b in blocks]),
        np.concatenate([b.cycle for b in blocks]),
    )


def join_with_gaps(blocks: Sequence[Block]) -> Block:
    """Join blocks of one stream, in order; missing samples between them are NaN, outside steps."""
    parts: list[Block] = []
    for block in blocks:
        if parts and parts[-1].end < block.index:
            parts.append(_make_missing_block(parts[-1], block.index))
        parts.append(block)
    return join_blocks(parts)


def _make_missing_block(before: Block, until: int) -> Block:
    count = until - before.end
    outside = np.full(count, -1, dtype=np.int64)
    values = np.full((len(before.channels), count), np.nan)
    label = np.zeros(count, dtype=np.int64)
    return Block(
        before.stream, before.end, before.rate_hz, before.channels, values, outside, label, outside
    )


def find_stretches(is_in: npt.ArrayLike) -> list[tuple[int, int]]:
    """Return (first, end) of each stretch of True, in order; is_in is (sample,)."""
    edges = np.flatnonzero(np.diff(is_in, prepend=False, append=False))
    return [(int(first), int(end)) for first, end in edges.reshape(-1, 2)]


def finite_mean(samples: Float1D) -> float:
    """Return the mean of the samples that are not lost, (sample,); NaN if all are."""
    finite = samples[np.isfinite(samples)]
    return float(finite.mean()) if finite.size else math.nan


def finite_std(samples: Float1D) -> float:
    """Return the standard deviation of the samples that are not lost, (sample,); NaN if all are."""
    finite = samples[np.isfinite(samples)]
    return float(finite.std()) if finite.size else math.nan


def interpolate_missing(samples: Float1D) -> Float1D:
    """Interpolate lost samples linearly, (sample,); return zeros if all are lost."""
    finite = np.isfinite(samples)
    if finite.all() or not finite.any():
        return np.nan_to_num(samples)
    places = np.arange(samples.size)
    return np.interp(places, places[finite], samples[finite])


def join_contiguous(blocks: Iterable[Block]) -> tuple[Block, ...]:
    """Join the blocks of one stream, in order, where they are contiguous with equal channels."""
    runs: list[list[Block]] = []
    for block in blocks:
        last = runs[-1][-1] if runs else None
        if last and last.end == block.index and last.channels == block.channels:
            runs[-1].append(block)
        else:
            runs.append([block])
    return tuple(join_blocks(run) for run in runs)
