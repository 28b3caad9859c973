"""Stepped sine of constant peak acceleration -> displacement command, sample by sample.

A drive is a value: a tuple of segments, each a closed form of the sample index, so any sample can
be had at any time and cutting it into blocks changes no bit. Phase is continuous throughout;
amplitude and frequency change by quintic blends (C2), because switching at a zero crossing would
jump the table's velocity.

In a segment, with s(x) = 6x^5 - 15x^4 + 10x^3 over its length,
    f = f0 + (f1 - f0) s,   level = l0 + (l1 - l0) s,   theta = 2 pi (phase0 + integral f dt)
    displacement = -level / (2 pi f)^2 sin(theta), so that in a held segment the acceleration is
    level sin(theta).
The command is that of a corrected level, level * correction, which blends like the level itself;
`shape` adds what cancels harmonics: sin(theta) + sum over k >= 2 of Im(shape_k exp(i k theta)).
"""

import math
from bisect import bisect_right
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Int1D, Label
from table_io.records import Step

RAMP_CYCLES = 2.0  # a soft start over one cycle would peak at 1.12, over two at 1.02
RAMP_S = 0.5


@dataclass(frozen=True, slots=True)
class Segment:
    """`count` samples from `start` on; frequencies in Hz, levels in m/s2, phase0 in cycles."""

    start: int
    count: int
    label: Label
    step: int
    f0: float
    f1: float
    level0: float
    level1: float
    phase0: float
    cycles: int = 0  # held cycles, 0 in a blend
    settle: int = 0  # the first of them that are not measured
    correction0: float = 1.0  # of the command
    correction1: float = 1.0
    shape0: tuple[complex, ...] = ()  # orders 2, 3, ... of the command, relative
    shape1: tuple[complex, ...] = ()

    @property
    def end(self) -> int:
        return self.start + self.count

    def phase(self, x: Float1D, rate_hz: float) -> Float1D:
        """Phase in cycles at the fractions x of the segment."""
        ramp = x**4 * (2.5 + x * (-3.0 + x))
        return self.phase0 + self.count / rate_hz * (self.f0 * x + (self.f1 - self.f0) * ramp)


def smoothstep(x: Float1D) -> Float1D:
    """Quintic blend from 0 at x = 0 to 1 at x = 1, first and second derivative 0 at both ends."""
    return x**3 * (10.0 + x * (-15.0 + 6.0 * x))


def displacement(segment: Segment, x: Float1D, rate_hz: float) -> Float1D:
    """Commanded displacement in m at the fractions x of a segment."""
    s = smoothstep(x)
    f = segment.f0 + (segment.f1 - segment.f0) * s
    low, high = _corrected(segment)
    theta = 2 * math.pi * segment.phase(x, rate_hz)
    wave = np.sin(theta)
    for k in range(max(len(segment.shape0), len(segment.shape1))):
        before, after = _order(segment.shape0, k), _order(segment.shape1, k)
        wave += np.imag((before + (after - before) * s) * np.exp(1j * (k + 2) * theta))
    return -(low + (high - low) * s) / (2 * math.pi * f) ** 2 * wave


def _corrected(segment: Segment) -> tuple[float, float]:
    """Level of the command in m/s2 at the ends of a segment."""
    return segment.level0 * segment.correction0, segment.level1 * segment.correction1


def _order(shape: tuple[complex, ...], k: int) -> complex:
    return shape[k] if k < len(shape) else 0j


def _quadratures(
    segment: Segment, x: Float1D, rate_hz: float, levels: tuple[float, float]
) -> tuple[Float1D, Float1D, Float1D, Float1D]:
    """(v_sin, v_cos, a_sin, a_cos): velocity = v_sin sin + v_cos cos, acceleration likewise.

    `levels` in m/s2 at the ends of the segment: the demanded ones, or those of the command.
    """
    duration = segment.count / rate_hz
    s = smoothstep(x)
    ds = 30 * x**2 * (1 - x) ** 2 / duration
    dds = 60 * x * (1 - x) * (1 - 2 * x) / duration**2
    df, dl = segment.f1 - segment.f0, levels[1] - levels[0]
    f, level = segment.f0 + df * s, levels[0] + dl * s
    w = 2 * math.pi * f
    g = level / w**2
    dg = (dl * ds - 2 * level * df * ds / f) / w**2
    ddg = (
        dl * dds
        - 4 * dl * df * ds**2 / f
        - 2 * level * df * dds / f
        + 6 * level * (df * ds / f) ** 2
    ) / w**2
    dw = 2 * math.pi * df * ds
    return -dg, -g * w, g * w**2 - ddg, -(2 * dg * w + g * dw)


def motion(segment: Segment, x: Float1D, rate_hz: float) -> tuple[Float1D, Float1D]:
    """(velocity in m/s, acceleration in m/s2) of the ideal table at the fractions x."""
    levels = (segment.level0, segment.level1)
    v_sin, v_cos, a_sin, a_cos = _quadratures(segment, x, rate_hz, levels)
    theta = 2 * math.pi * segment.phase(x, rate_hz)
    sin, cos = np.sin(theta), np.cos(theta)
    return v_sin * sin + v_cos * cos, a_sin * sin + a_cos * cos


def worst_ratio(segment: Segment, rate_hz: float) -> float:
    """Largest acceleration that the segment can ask for at its worst phase, over the larger level.

    The larger of two ratios: of the demanded motion to the demanded level, and of the corrected
    command to the corrected level.
    """
    x = np.linspace(0.0, 1.0, 401)
    ratios = []
    for levels in ((segment.level0, segment.level1), _corrected(segment)):
        _, _, a_sin, a_cos = _quadratures(segment, x, rate_hz, levels)
        ratios.append(float(np.hypot(a_sin, a_cos).max()) / max(levels))
    return max(ratios)


@dataclass(frozen=True)
class Drive:
    """The command as far as it is known: it always ends at rest.

    Where segments overlap the later one holds: so a hold is cut short. From sample `decay_at` on,
    if set, all is multiplied down to rest.
    """

    rate_hz: float
    segments: tuple[Segment, ...]
    steps: tuple[Step, ...]
    decay_at: int | None = None

    @cached_property
    def _starts(self) -> list[int]:
        return [segment.start for segment in self.segments]

    def segment_at(self, index: int) -> Segment:
        """The segment that sample `index` lies in; the first or last one outside the drive."""
        return self.segments[max(bisect_right(self._starts, index) - 1, 0)]

    @property
    def planned_end(self) -> int:
        """Index from which the drive would be at rest if it were not stopped."""
        return self.segments[-1].end if self.segments else 0

    @cached_property
    def decay_samples(self) -> int:
        """Length of the decay: max(2 cycles, 0.5 s) at the frequency where it begins.

        One sample before the soft start: a table that does not move yet never begins to.
        """
        if self.decay_at is None:
            return 0
        if not self.segments or self.decay_at < self.segments[0].start:
            return 1
        segment = self.segment_at(self.decay_at)
        x = np.clip(np.array([(self.decay_at - segment.start) / segment.count]), 0.0, 1.0)
        f = segment.f0 + (segment.f1 - segment.f0) * float(smoothstep(x)[0])
        return math.ceil(max(RAMP_CYCLES / f, RAMP_S) * self.rate_hz)

    @property
    def rest_from(self) -> int:
        """Index from which the command is exactly zero."""
        if self.decay_at is None:
            return self.planned_end
        return min(self.decay_at + self.decay_samples, max(self.planned_end, self.decay_at))

    def decayed(self, at: int) -> "Drive":
        """The same drive, brought to rest smoothly from sample `at` on."""
        return replace(self, decay_at=at if self.decay_at is None else min(at, self.decay_at))

    def command(self, first: int, count: int) -> Float1D:
        """Displacement in m of samples first .. first + count - 1; zero before and after."""
        out = np.zeros(count)
        for segment, window, x in self._pieces(first, count):
            out[window] = displacement(segment, x, self.rate_hz)
        return out * self._left(first, count)

    def acceleration(self, first: int, count: int) -> Float1D:
        """Acceleration in m/s2 of an ideal table on the undecayed drive, (count,)."""
        out = np.zeros(count)
        for segment, window, x in self._pieces(first, count):
            out[window] = motion(segment, x, self.rate_hz)[1]
        return out

    def phase(self, first: int, count: int) -> Float1D:
        """Phase in cycles of each sample, (count,); 0 outside the drive."""
        out = np.zeros(count)
        for segment, window, x in self._pieces(first, count):
            out[window] = segment.phase(x, self.rate_hz)
        return out

    def level(self, first: int, count: int) -> Float1D:
        """Demanded peak acceleration in m/s2 at each sample, (count,), the decay included."""
        out = np.zeros(count)
        for segment, window, x in self._pieces(first, count):
            low, high = segment.level0, segment.level1
            out[window] = low + (high - low) * smoothstep(x)
        return out * self._left(first, count)

    def _left(self, first: int, count: int) -> Float1D:
        """What a decay has left of the command at each sample, 1 before it, (count,)."""
        if self.decay_at is None:
            return np.ones(count)
        x = (np.arange(first, first + count) - self.decay_at) / self.decay_samples
        return 1.0 - smoothstep(np.clip(x, 0.0, 1.0))

    def labels(self, first: int, count: int) -> tuple[Int1D, Int1D, Int1D]:
        """(step, label, held cycle) of each sample, (count,) each; -1 outside the sweep."""
        step = np.full(count, -1, dtype=np.int64)
        label = np.full(count, int(Label.REST), dtype=np.int64)
        cycle = np.full(count, -1, dtype=np.int64)
        for segment, window, x in self._pieces(first, count):
            step[window] = segment.step
            label[window] = segment.label
            if segment.cycles:
                turns = x * segment.count * segment.f0 / self.rate_hz
                # A cycle may begin exactly on a sample, where rounding must not decide.
                done = np.floor(turns + 1e-9).astype(np.int64)
                cycle[window] = np.minimum(done, segment.cycles - 1)
                label[window] = np.where(
                    cycle[window] >= segment.settle, int(Label.MEASURE), int(Label.SETTLE)
                )
        if self.decay_at is not None:
            index = np.arange(first, first + count)
            stopping = (index >= self.decay_at) & (index < self.rest_from)
            label[stopping] = int(Label.STOP)
            label[index >= self.rest_from] = int(Label.REST)
            cycle[index >= self.decay_at] = -1
            step[index >= self.rest_from] = -1
        return step, label, cycle

    def _pieces(self, first: int, count: int) -> list[tuple[Segment, slice, Float1D]]:
        """(segment, window in the asked samples, fractions of the segment) for what overlaps."""
        last = first + count
        pieces = []
        place = max(bisect_right(self._starts, first) - 1, 0)
        for segment in self.segments[place:]:
            if segment.start >= last:
                break
            lo, hi = max(first, segment.start), min(last, segment.end)
            if lo < hi:
                x = (np.arange(lo, hi) - segment.start) / segment.count
                pieces.append((segment, slice(lo - first, hi - first), x))
        return pieces
