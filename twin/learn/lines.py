"""Straight stretches of a sine's phase: where a drive is held, and where the holds meet."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from twin.learn.sine import QUARTER, Track

LEAST_FITS = 11  # on a straight line, for a hold
PHASE_TOLERANCE = 0.002  # cycles off a straight line, at least; more where the noise is larger
NOISE_FACTOR = 6.0
SAME_PHASE = 0.015  # cycles between two lines that are one
CURVED = 0.3  # of the way to the next frequency within a hold: a chirp, no step


@dataclass(frozen=True, slots=True)
class Line:
    """Phase in cycles = c + f (sample - first): hops first .. last - 1 of a track."""

    first: int
    last: int
    f: float
    c: float
    origin: float
    curved: float = 0.0  # change of f over the line


def _fit(track: Track, first: int, last: int) -> Line:
    t, phase = track.at[first:last], track.phase[first:last]
    origin = float(t.mean())
    bend = float(np.polyfit(t - origin, phase, 2)[0])
    f, c = map(float, np.polyfit(t - origin, phase, 1))
    return Line(first, last, f, c, origin, 2 * bend * float(t[-1] - t[0]))


def meet(a: Line, b: Line) -> float:
    """Sample at which two lines meet; half way between them where they are parallel."""
    between = 0.5 * (a.origin + b.origin)
    if abs(a.f - b.f) < 1e-4 * a.f:
        return between
    here, there = a.c + a.f * (between - a.origin), b.c + b.f * (between - b.origin)
    return between + (there - here) / (a.f - b.f)


def half_blend(track: Track, a: Line, b: Line, least_cycles: float) -> float:
    """Half the length in samples of the blend between two lines.

    Half way through a quintic blend of T cycles the phase is 0.078 T df/f off both lines; the
    window of the fits adds 0.122/T. Small blends drown in the noise, and are of the least length.
    """
    f, middle, cycles = 0.5 * (a.f + b.f), meet(a, b), least_cycles
    if abs(a.f - b.f) > 0.1 * f:
        seen = float(np.interp(middle, track.at, track.phase))
        off = abs(seen - a.c - a.f * (middle - a.origin)) * f / abs(a.f - b.f)
        if off > 0.29:
            cycles = max(cycles, (off + np.sqrt(off**2 - 4 * 0.078 * 0.122)) / (2 * 0.078))
    return 0.5 * cycles / f


def straight_lines(track: Track) -> list[Line]:
    """Straight stretches of the phase, each fitted on what lies well inside it; none of a chirp."""
    tolerance = np.maximum(PHASE_TOLERANCE, NOISE_FACTOR * track.phase_noise)
    seed, lines, first = 2 * QUARTER, [], 0
    while first + seed <= track.at.size:
        last, line = first + seed, _fit(track, first, first + seed)
        t, phase = track.at[first:last] - line.origin, track.phase[first:last]
        if (np.abs(phase - line.c - line.f * t) > tolerance[first:last]).any():
            first += 1
            continue
        while last < track.at.size:
            ahead = slice(last, last + QUARTER)
            off = track.phase[ahead] - line.c - line.f * (track.at[ahead] - line.origin)
            if (np.abs(off) > tolerance[ahead]).sum() > QUARTER // 2:
                break
            last += 1
            if (last - first) % QUARTER == 0 or last - first < 4 * QUARTER:
                line = _fit(track, first, last)
        if last - first < LEAST_FITS:  # as straight as a blend is in its middle
            first += 1
            continue
        lines.append(_core(track, first, last))
        first = last
    return _joined(track, lines)


def _core(track: Track, first: int, last: int) -> Line:
    """The line of the middle of a stretch: its ends lie in the blends beside it."""
    spare = min(QUARTER + QUARTER // 2, (last - first - QUARTER - 1) // 2)
    return replace(_fit(track, first + spare, last - spare), first=first, last=last)


def _one(a: Line, b: Line) -> bool:
    """True where two lines, broken by noise or by lost samples, are the same motion."""
    apart = b.origin - a.origin
    longer = a.f if a.last - a.first > b.last - b.first else b.f
    return abs(a.f / b.f - 1) < 0.02 and abs(b.c - a.c - longer * apart) < SAME_PHASE


def _joined(track: Track, lines: Sequence[Line]) -> list[Line]:
    """Lines that are one line, made one; all of them dropped where they are pieces of a chirp."""
    out: list[Line] = []
    for line in lines:
        same = bool(out) and _one(out[-1], line)
        out.append(_core(track, out.pop().first, line.last) if same else line)
    if len(out) < 3:
        return out
    way = np.gradient([line.f for line in out])  # signed, so that noise does not add up
    chirp = np.median(np.array([line.curved for line in out])[way != 0] / way[way != 0])
    return [] if chirp > CURVED else out
