"""Drive: displacement command, made of segments of a sine and of displacement histories.

A drive is an immutable tuple of segments, each a pure function of the sample index, so any sample
can be computed at any time and cutting it into blocks changes no bit.

A stepped sine has constant peak acceleration and a continuous phase; amplitude and frequency change
by quintic blends (C2), because switching at a zero crossing would cause a jump of the table
velocity. In a segment of it, with s(x) = 6x^5 - 15x^4 + 10x^3 over its length,
    f = f0 + (f1 - f0) s,   level = l0 + (l1 - l0) s,   theta = 2 pi (phase0 + integral f dt)
    displacement = -level / (2 pi f)^2 sin(theta), so that in a held segment the acceleration is
    level sin(theta).
The command uses the corrected level, level * correction, which blends like the level itself.
`shape` adds harmonics that cancel those of the table: sin(theta) is replaced by sin(theta) + sum
over k >= 2 of Im(shape_k exp(i k theta)).

In a swept sine f is the quintic polynomial with the values, slopes and curvatures of a logarithmic
sweep at both ends: df/dt = rate f, d2f/dt2 = rate^2 f. Over a segment it differs from the
exponential by less than 1e-9, and where a rate is 0 the frequency comes smoothly to a stand.
"""

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from table_io.block import Float1D, Int1D, Label
from table_io.config.excitation.waveform import smoothstep
from table_io.records import Step


@dataclass(frozen=True, eq=False)
class Correction:
    """Displacement in m added from sample `start` on, (sample,); 0 before and after it."""

    start: int
    values_m: Float1D

    @property
    def end(self) -> int:
        """Index of the first sample after the correction."""
        return self.start + self.values_m.size

    def displacement(self, first: int, count: int) -> Float1D:
        """Return the correction in m of samples first .. first + count - 1, (count,)."""
        displacement_m = np.zeros(count)
        low, high = max(first, self.start), min(first + count, self.end)
        if low < high:
            values = self.values_m[low - self.start : high - self.start]
            displacement_m[low - first : high - first] = values
        return displacement_m

    def replace_from(self, first: int, values_m: Float1D, keep_from: int) -> "Correction":
        """Return the correction with other values from sample `first` on.

        Values before sample `keep_from` are discarded.
        """
        start = min(max(self.start, keep_from), first)
        return Correction(
            start, np.concatenate([self.displacement(start, first - start), values_m])
        )


NO_CORRECTION = Correction(0, np.empty(0))

RAMP_CYCLES = 2.0  # a soft start over one cycle would peak at 1.12, over two at 1.02
RAMP_S = 0.5
MAX_BLEND_SLOPE, MAX_BLEND_CURVATURE = 1.875, 5.7736  # of the quintic blend over its length
MAX_STOP_RATIO = 1.25  # peak acceleration of a history that is stopped, over its own
# Quintic Hermite polynomials over x = 0 to 1, coefficients of x, x^2 .. x^5: unit slope at the
# begin and at the end, unit curvature at the begin and at the end, all else 0.
HERMITE = np.array([
    [1.0, 0.0, -6.0, 8.0, -3.0],
    [0.0, 0.0, -4.0, 7.0, -3.0],
    [0.0, 0.5, -1.5, 1.5, -0.5],
    [0.0, 0.0, 0.5, -1.0, 0.5],
])  # fmt: skip
POWERS = np.arange(1.0, 6.0)


@dataclass(frozen=True, slots=True)
class Segment:
    """Segment of `count` samples from `start`; f in Hz, level in m/s2, phase0 in cycles."""

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
    settle: int = 0  # the first held cycles, which are not measured
    correction0: float = 1.0  # factor on the command
    correction1: float = 1.0
    shape0: tuple[complex, ...] = ()  # orders 2, 3, ... of the command, relative
    shape1: tuple[complex, ...] = ()
    rate0: float = 0.0  # of a swept sine, 1/s: slope of ln f
    rate1: float = 0.0

    @property
    def end(self) -> int:
        return self.start + self.count

    def phase(self, x: Float1D, rate_hz: float) -> Float1D:
        """Return the phase in cycles at the fractions x of the segment, (x,)."""
        ramp = x**4 * (2.5 + x * (-3.0 + x))
        cycles = self.f0 * x + (self.f1 - self.f0) * ramp
        if self.rate0 or self.rate1:
            integral = self.sweep_coefficients(rate_hz) / (POWERS + 1.0)
            cycles += x * _evaluate_powers(integral, x)
        return self.phase0 + self.count / rate_hz * cycles

    def frequency(self, x: Float1D, rate_hz: float) -> Float1D:
        """Return the frequency in Hz at the fractions x of the segment, (x,)."""
        frequency_hz = self.f0 + (self.f1 - self.f0) * smoothstep(x)
        if self.rate0 or self.rate1:
            frequency_hz += _evaluate_powers(self.sweep_coefficients(rate_hz), x)
        return frequency_hz

    def sweep_coefficients(self, rate_hz: float) -> Float1D:
        """Return what the rates of a sweep add to f, as coefficients of x .. x^5 in Hz, (5,)."""
        turns = np.array([self.rate0, self.rate1]) * self.count / rate_hz
        ends = np.array([self.f0, self.f1])
        return np.concatenate([turns * ends, turns**2 * ends]) @ HERMITE

    def displacement(self, x: Float1D, rate_hz: float) -> Float1D:
        """Return the commanded displacement in m at the fractions x, (x,)."""
        return segment_displacement(self, x, rate_hz)

    def motion(self, x: Float1D, rate_hz: float) -> tuple[Float1D, Float1D]:
        """Return (velocity in m/s, acceleration in m/s2) of an ideal table at the fractions x."""
        return segment_motion(self, x, rate_hz)

    def level(self, x: Float1D) -> Float1D:
        """Return the demanded peak acceleration in m/s2 at the fractions x, (x,)."""
        return self.level0 + (self.level1 - self.level0) * smoothstep(x)

    def demanded_acceleration(self, x: Float1D, rate_hz: float) -> Float1D:
        """Return the acceleration in m/s2 at the fractions x as in a held motion, (x,)."""
        return self.level(x) * np.sin(2.0 * math.pi * self.phase(x, rate_hz))

    def labels(self, x: Float1D, rate_hz: float) -> tuple[Int1D, Int1D, Int1D]:
        """Return (step, label, held cycle) at the fractions x, (x,) each."""
        step = np.full(x.size, self.step, dtype=np.int64)
        label = np.full(x.size, int(self.label), dtype=np.int64)
        cycle = np.full(x.size, -1, dtype=np.int64)
        if self.cycles:
            turns = x * self.count * self.f0 / rate_hz
            # A cycle may begin exactly on a sample: the tolerance absorbs rounding.
            done = np.floor(turns + 1e-9).astype(np.int64)
            cycle = np.minimum(done, self.cycles - 1)
            label = np.where(cycle >= self.settle, int(Label.MEASURE), int(Label.SETTLE))
        return step, label, cycle

    def decay_samples(self, x: float, rate_hz: float) -> int:
        """Return the length of a decay from fraction x: max(2 cycles, 0.5 s) at its frequency."""
        f = float(self.frequency(np.array([x]), rate_hz)[0])
        return math.ceil(max(RAMP_CYCLES / f, RAMP_S) * rate_hz)


@dataclass(frozen=True, eq=False)
class HistorySegment:
    """Displacement history in m from rest to rest, (sample,), from sample `start`.

    It has no phase. `windows` equal parts of it count as steps 0, 1, ... and are measured.
    """

    start: int
    history_m: Float1D
    windows: int

    @property
    def count(self) -> int:
        return self.history_m.size

    @property
    def end(self) -> int:
        return self.start + self.count

    @cached_property
    def peaks(self) -> tuple[float, float, float]:
        """Peak displacement, velocity and acceleration per sample interval, in m."""
        padded = np.concatenate([np.zeros(2), self.history_m, np.zeros(2)])
        d, v, a = (float(np.abs(np.diff(padded, order)).max()) for order in (0, 1, 2))
        return d, v, a

    def displacement(self, x: Float1D, _: float) -> Float1D:
        """Return the commanded displacement in m at the fractions x, (x,)."""
        return self._at(x)

    def motion(self, x: Float1D, rate_hz: float) -> tuple[Float1D, Float1D]:
        """Return (velocity in m/s, acceleration in m/s2) at the fractions x, by differences."""
        before, here, after = (self._at(x, shift) for shift in (-1, 0, 1))
        return 0.5 * (after - before) * rate_hz, (after - 2.0 * here + before) * rate_hz**2

    def demanded_acceleration(self, x: Float1D, rate_hz: float) -> Float1D:
        """Return the acceleration in m/s2 at the fractions x, (x,)."""
        return self.motion(x, rate_hz)[1]

    def level(self, x: Float1D) -> Float1D:
        """Return 0: a history has no constant level, (x,)."""
        return np.zeros(x.size)

    def phase(self, x: Float1D, _: float) -> Float1D:
        """Return 0: a history has no phase, (x,)."""
        return np.zeros(x.size)

    def labels(self, x: Float1D, _: float) -> tuple[Int1D, Int1D, Int1D]:
        """Return (window, label, -1 for no held cycle) at the fractions x, (x,) each."""
        window = self._indices(x) * self.windows // self.count
        label = np.full(x.size, int(Label.MEASURE), dtype=np.int64)
        return window, label, np.full(x.size, -1, dtype=np.int64)

    def decay_samples(self, _: float, rate_hz: float) -> int:
        """Return the length of a decay that raises the peak acceleration by a quarter at most.

        With the decay factor g over n samples, |(d g)''| <= A + 2 V max|g'| / n + D max|g''| / n^2.
        """
        d, v, a = self.peaks
        b = 2.0 * MAX_BLEND_SLOPE * v
        room = (MAX_STOP_RATIO - 1.0) * a
        n = (b + math.sqrt(b**2 + 4.0 * room * MAX_BLEND_CURVATURE * d)) / (2.0 * room)
        return math.ceil(max(n, RAMP_S * rate_hz))

    def _indices(self, x: Float1D) -> Int1D:
        return np.rint(x * self.count).astype(np.int64)

    def _at(self, x: Float1D, shift: int = 0) -> Float1D:
        """Return the history `shift` samples after the fractions x, 0 outside it, (x,)."""
        index = self._indices(x) + shift
        inside = (index >= 0) & (index < self.count)
        return np.where(inside, self.history_m[np.clip(index, 0, self.count - 1)], 0.0)


def _evaluate_powers(coefficients: Float1D, x: Float1D) -> Float1D:
    """Return the sum of coefficients of x, x^2, ... at x, (x,)."""
    total = np.zeros(x.size)
    for coefficient in coefficients[::-1]:
        total = (total + coefficient) * x
    return total


def segment_displacement(segment: Segment, x: Float1D, rate_hz: float) -> Float1D:
    """Return the commanded displacement in m at the fractions x of a segment, (x,)."""
    s = smoothstep(x)
    f = segment.frequency(x, rate_hz)
    low, high = _command_levels(segment)
    theta = 2 * math.pi * segment.phase(x, rate_hz)
    wave = np.sin(theta)
    for k in range(max(len(segment.shape0), len(segment.shape1))):
        before, after = _harmonic(segment.shape0, k), _harmonic(segment.shape1, k)
        wave += np.imag((before + (after - before) * s) * np.exp(1j * (k + 2) * theta))
    return -(low + (high - low) * s) / (2 * math.pi * f) ** 2 * wave


def _command_levels(segment: Segment) -> tuple[float, float]:
    """Return the levels of the command in m/s2 at the two ends of a segment."""
    return segment.level0 * segment.correction0, segment.level1 * segment.correction1


def _harmonic(shape: tuple[complex, ...], k: int) -> complex:
    return shape[k] if k < len(shape) else 0j


def _quadratures(
    segment: Segment, x: Float1D, rate_hz: float, levels: tuple[float, float]
) -> tuple[Float1D, Float1D, Float1D, Float1D]:
    """Return (v_sin, v_cos, a_sin, a_cos): velocity = v_sin sin + v_cos cos, acceleration alike.

    `levels` in m/s2 at the ends of the segment: the demanded ones, or those of the command.
    """
    duration = segment.count / rate_hz
    s = smoothstep(x)
    ds = 30 * x**2 * (1 - x) ** 2 / duration
    dds = 60 * x * (1 - x) * (1 - 2 * x) / duration**2
    df, dl = segment.f1 - segment.f0, levels[1] - levels[0]
    f, level = segment.frequency(x, rate_hz), levels[0] + dl * s
    w = 2 * math.pi * f
    g = level / w**2
    # First and second derivative of what the rates of a sweep add to f.
    added1, added2 = np.zeros(x.size), np.zeros(x.size)
    if segment.rate0 or segment.rate1:
        slopes = segment.sweep_coefficients(rate_hz) * POWERS / duration
        curvatures = slopes[1:] * POWERS[:-1] / duration
        added1 = slopes[0] + _evaluate_powers(slopes[1:], x)
        added2 = curvatures[0] + _evaluate_powers(curvatures[1:], x)
    dg = (dl * ds - (2 * level * df * ds + 2 * level * added1) / f) / w**2
    ddg = (
        dl * dds
        - (4 * dl * df * ds**2 + 4 * dl * ds * added1) / f
        - (2 * level * df * dds + 2 * level * added2) / f
        + 6 * level * ((df * ds + added1) / f) ** 2
    ) / w**2
    dw = 2 * math.pi * df * ds + 2 * math.pi * added1
    return -dg, -g * w, g * w**2 - ddg, -(2 * dg * w + g * dw)


def segment_motion(segment: Segment, x: Float1D, rate_hz: float) -> tuple[Float1D, Float1D]:
    """Return (velocity in m/s, acceleration in m/s2) of an ideal table at the fractions x."""
    levels = (segment.level0, segment.level1)
    v_sin, v_cos, a_sin, a_cos = _quadratures(segment, x, rate_hz, levels)
    theta = 2 * math.pi * segment.phase(x, rate_hz)
    sin, cos = np.sin(theta), np.cos(theta)
    return v_sin * sin + v_cos * cos, a_sin * sin + a_cos * cos


def envelope_acceleration(
    segment: Segment, x: Float1D, rate_hz: float, levels: tuple[float, float] | None = None
) -> Float1D:
    """Return the acceleration in m/s2 at the worst phase at the fractions x of a segment, (x,).

    levels: in m/s2 at the ends of the segment; None: the demanded ones.
    """
    levels = (segment.level0, segment.level1) if levels is None else levels
    _, _, a_sin, a_cos = _quadratures(segment, x, rate_hz, levels)
    return np.hypot(a_sin, a_cos)


def peak_acceleration_ratio(segment: Segment, rate_hz: float) -> float:
    """Return the peak acceleration of a segment at its worst phase over the larger of its levels.

    The larger of two ratios: demanded motion to demanded level, and corrected command to corrected
    level.
    """
    x = np.linspace(0.0, 1.0, 401)
    ratios = []
    for levels in ((segment.level0, segment.level1), _command_levels(segment)):
        envelope = envelope_acceleration(segment, x, rate_hz, levels)
        ratios.append(float(envelope.max()) / max(levels))
    return max(ratios)


@dataclass(frozen=True)
class Drive:
    """Displacement command as far as it is known; it always ends at rest.

    Where segments overlap the later one applies, which cuts a hold short. The correction of a
    feedback is added to the command only: levels and accelerations are nominal. From sample
    `decay_start` on, if set, the command decays to rest.
    """

    rate_hz: float
    segments: tuple[Segment | HistorySegment, ...]
    steps: tuple[Step, ...]
    decay_start: int | None = None
    correction: Correction = NO_CORRECTION

    @cached_property
    def _starts(self) -> list[int]:
        return [segment.start for segment in self.segments]

    @cached_property
    def _last_overlaps(
        self,
    ) -> dict[tuple[int, int], list[tuple[Segment | HistorySegment, slice, Float1D]]]:
        return {}

    @property
    def sine_segments(self) -> tuple[Segment, ...]:
        """Segments of the loop check and of a stepped sine."""
        return tuple(segment for segment in self.segments if isinstance(segment, Segment))

    def segment_at(self, index: int) -> Segment | HistorySegment:
        """Return the segment that contains sample `index`; outside, the first or last one."""
        return self.segments[max(bisect_right(self._starts, index) - 1, 0)]

    @property
    def planned_end(self) -> int:
        """Index from which the drive would be at rest if it were not stopped."""
        return self.segments[-1].end if self.segments else 0

    @cached_property
    def decay_samples(self) -> int:
        """Length of the decay in samples, by the segment where it begins.

        One sample if it begins before the soft start, so that the table never starts to move.
        """
        if self.decay_start is None:
            return 0
        if not self.segments or self.decay_start < self.segments[0].start:
            return 1
        segment = self.segment_at(self.decay_start)
        x = min(max((self.decay_start - segment.start) / segment.count, 0.0), 1.0)
        return segment.decay_samples(x, self.rate_hz)

    @property
    def rest_start(self) -> int:
        """Index from which the command is exactly zero."""
        if self.decay_start is None:
            return self.planned_end
        return min(self.decay_start + self.decay_samples, max(self.planned_end, self.decay_start))

    def decay_from(self, at: int) -> "Drive":
        """Return the same drive with a smooth decay to rest from sample `at` on."""
        return replace(
            self, decay_start=at if self.decay_start is None else min(at, self.decay_start)
        )

    def command(self, first: int, count: int) -> Float1D:
        """Return the displacement in m of samples first .. first + count - 1; 0 outside."""
        displacement_m = np.zeros(count)
        for segment, window, x in self._overlaps(first, count):
            displacement_m[window] = segment.displacement(x, self.rate_hz)
        displacement_m += self.correction.displacement(first, count)
        return displacement_m * self._decay_factor(first, count)

    def acceleration(self, first: int, count: int) -> Float1D:
        """Return the acceleration in m/s2 of an ideal table, without decay, (count,)."""
        acceleration = np.zeros(count)
        for segment, window, x in self._overlaps(first, count):
            acceleration[window] = segment.motion(x, self.rate_hz)[1]
        return acceleration

    def phase(self, first: int, count: int) -> Float1D:
        """Return the phase of each sample in cycles, (count,); 0 outside the drive."""
        phase = np.zeros(count)
        for segment, window, x in self._overlaps(first, count):
            phase[window] = segment.phase(x, self.rate_hz)
        return phase

    def frequency_hz(self, index: int) -> float:
        """Return the frequency in Hz at sample `index`; 0 at rest and in a history."""
        segment = self.segment_at(index)
        if not isinstance(segment, Segment) or not segment.start <= index < segment.end:
            return 0.0
        x = np.array([(index - segment.start) / segment.count])
        return float(segment.frequency(x, self.rate_hz)[0])

    def level(self, first: int, count: int) -> Float1D:
        """Return the demanded peak acceleration in m/s2, decay included, (count,)."""
        level = np.zeros(count)
        for segment, window, x in self._overlaps(first, count):
            level[window] = segment.level(x)
        return level * self._decay_factor(first, count)

    def demanded_acceleration(self, first: int, count: int) -> Float1D:
        """Return the acceleration in m/s2 that sensors should show, decay included, (count,)."""
        acceleration = np.zeros(count)
        for segment, window, x in self._overlaps(first, count):
            acceleration[window] = segment.demanded_acceleration(x, self.rate_hz)
        return acceleration * self._decay_factor(first, count)

    def _decay_factor(self, first: int, count: int) -> Float1D:
        """Return the factor of the decay on the command, 1 before it, (count,)."""
        if self.decay_start is None:
            return np.ones(count)
        x = (np.arange(first, first + count) - self.decay_start) / self.decay_samples
        return 1.0 - smoothstep(x)

    def labels(self, first: int, count: int) -> tuple[Int1D, Int1D, Int1D]:
        """Return (step, label, held cycle) of each sample, (count,) each; -1 outside the sweep."""
        step = np.full(count, -1, dtype=np.int64)
        label = np.full(count, int(Label.REST), dtype=np.int64)
        cycle = np.full(count, -1, dtype=np.int64)
        for segment, window, x in self._overlaps(first, count):
            step[window], label[window], cycle[window] = segment.labels(x, self.rate_hz)
        if self.decay_start is not None:
            index = np.arange(first, first + count)
            stopping = (index >= self.decay_start) & (index < self.rest_start)
            label[stopping] = int(Label.STOP)
            label[index >= self.rest_start] = int(Label.REST)
            cycle[index >= self.decay_start] = -1
            step[index >= self.rest_start] = -1
        return step, label, cycle

    def _overlaps(
        self, first: int, count: int
    ) -> list[tuple[Segment | HistorySegment, slice, Float1D]]:
        """List (segment, window in the requested samples, segment fractions) of each overlap.

        Those of the last request are kept: command, phase, level and labels follow one another.
        """
        if (kept := self._last_overlaps.get((first, count))) is not None:
            return kept
        last = first + count
        overlaps: list[tuple[Segment | HistorySegment, slice, Float1D]] = []
        first_segment = max(bisect_right(self._starts, first) - 1, 0)
        for number in range(first_segment, bisect_left(self._starts, last)):
            segment = self.segments[number]
            end = min([segment.end, *self._starts[number + 1 : number + 2]])
            lo, hi = max(first, segment.start), min(last, end)
            if lo < hi:
                x = (np.arange(lo, hi) - segment.start) / segment.count
                overlaps.append((segment, slice(lo - first, hi - first), x))
        self._last_overlaps.clear()
        self._last_overlaps[first, count] = overlaps
        return overlaps
