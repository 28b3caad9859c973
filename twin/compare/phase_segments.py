"""Straight segments of the phase of a tracked sine: held frequencies and their intersections."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.compare.sine_tracking import FITS_PER_CYCLE, SineTrack

MIN_FITS = 11  # fits on a straight line that make a hold
# tolerance about a straight line; `NOISE_FACTOR` times the phase noise where that is larger
PHASE_TOLERANCE_CYCLES = 0.002
NOISE_FACTOR = 6.0
MAX_PHASE_OFFSET_CYCLES = 0.015  # between two segments of one line
MAX_CHIRP_SHARE = 0.3  # frequency change within a line over that to the next; more is a chirp


@dataclass(frozen=True, slots=True)
class PhaseLine:
    """Line fitted to the phase, in cycles: c + f (sample - origin), fits first .. last - 1."""

    first: int
    last: int
    f: float
    c: float
    origin: float
    frequency_change: float = 0.0  # change of f over the line


def _fit_line(track: SineTrack, first: int, last: int) -> PhaseLine:
    sample, phase = track.sample[first:last], track.phase[first:last]
    origin = float(sample.mean())
    curvature = float(np.polyfit(sample - origin, phase, 2)[0])
    f, c = map(float, np.polyfit(sample - origin, phase, 1))
    return PhaseLine(first, last, f, c, origin, 2 * curvature * float(sample[-1] - sample[0]))


def intersect(a: PhaseLine, b: PhaseLine) -> float:
    """Return the sample at which two lines intersect; midway between them if parallel."""
    middle = 0.5 * (a.origin + b.origin)
    if abs(a.f - b.f) < 1e-4 * a.f:
        return middle
    phase_a, phase_b = a.c + a.f * (middle - a.origin), b.c + b.f * (middle - b.origin)
    return middle + (phase_b - phase_a) / (a.f - b.f)


def half_blend_length(track: SineTrack, a: PhaseLine, b: PhaseLine, min_cycles: float) -> float:
    """Return half the length in samples of the blend between two lines.

    Halfway through a quintic blend of T cycles the phase is 0.078 T df/f off both lines; the
    window of the fits adds 0.122/T. Small frequency changes are hidden by noise: for them the
    minimum length is assumed.
    """
    f, middle, cycles = 0.5 * (a.f + b.f), intersect(a, b), min_cycles
    if abs(a.f - b.f) > 0.1 * f:
        phase = float(np.interp(middle, track.sample, track.phase))
        offset = abs(phase - a.c - a.f * (middle - a.origin)) * f / abs(a.f - b.f)
        if offset > 0.29:
            cycles = max(cycles, (offset + np.sqrt(offset**2 - 4 * 0.078 * 0.122)) / (2 * 0.078))
    return 0.5 * cycles / f


def find_straight_lines(track: SineTrack) -> list[PhaseLine]:
    """Find the straight segments of the phase, each fitted to its core; none for a chirp."""
    tolerance = np.maximum(PHASE_TOLERANCE_CYCLES, NOISE_FACTOR * track.phase_noise)
    seed, lines, first = 2 * FITS_PER_CYCLE, [], 0
    while first + seed <= track.sample.size:
        last, line = first + seed, _fit_line(track, first, first + seed)
        t, phase = track.sample[first:last] - line.origin, track.phase[first:last]
        if (np.abs(phase - line.c - line.f * t) > tolerance[first:last]).any():
            first += 1
            continue
        while last < track.sample.size:
            next_fits = slice(last, last + FITS_PER_CYCLE)
            offset = (
                track.phase[next_fits] - line.c - line.f * (track.sample[next_fits] - line.origin)
            )
            if (np.abs(offset) > tolerance[next_fits]).sum() > FITS_PER_CYCLE // 2:
                break
            last += 1
            if (last - first) % FITS_PER_CYCLE == 0 or last - first < 4 * FITS_PER_CYCLE:
                line = _fit_line(track, first, last)
        if last - first < MIN_FITS:  # too short: may be the nearly straight middle of a blend
            first += 1
            continue
        lines.append(_fit_core(track, first, last))
        first = last
    return _join_lines(track, lines)


def _fit_core(track: SineTrack, first: int, last: int) -> PhaseLine:
    """Fit the core of a segment; its ends reach into the adjacent blends."""
    margin = min(FITS_PER_CYCLE + FITS_PER_CYCLE // 2, (last - first - FITS_PER_CYCLE - 1) // 2)
    return replace(_fit_line(track, first + margin, last - margin), first=first, last=last)


def _is_same_line(a: PhaseLine, b: PhaseLine) -> bool:
    """Return True if two segments, split by noise or lost samples, lie on one line."""
    distance = b.origin - a.origin
    longer = a.f if a.last - a.first > b.last - b.first else b.f
    return (
        abs(a.f / b.f - 1) < 0.02 and abs(b.c - a.c - longer * distance) < MAX_PHASE_OFFSET_CYCLES
    )


def _join_lines(track: SineTrack, lines: Sequence[PhaseLine]) -> list[PhaseLine]:
    """Join the segments of one line; return no lines if they are pieces of a chirp."""
    joined: list[PhaseLine] = []
    for line in lines:
        same = bool(joined) and _is_same_line(joined[-1], line)
        joined.append(_fit_core(track, joined.pop().first, line.last) if same else line)
    if len(joined) < 3:
        return joined
    # signed, so that noise averages out
    frequency_step = np.gradient([line.f for line in joined])
    chirp = np.median(
        np.array([line.frequency_change for line in joined])[frequency_step != 0]
        / frequency_step[frequency_step != 0]
    )
    return [] if chirp > MAX_CHIRP_SHARE else joined
