"""Track: find the resonance that the sweep meets first, then follow it, by phase or by peak.

The sweep is left as soon as the resonance lies within its next step, or behind: so a branch that
ends in a jump is still held. From there no visit moves by more than the card's step.
"""

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from table_io.policies.result import SUDDEN, Decision, Move, Result, Tool, Visit, visited
from table_io.profile import Profile
from table_io.tool_cards import Track

PHASE_DEG = 90.0
Points = Sequence[tuple[float, float]]  # (Hz, degrees or mm/g), newest last
Results = Generator[Move, Result, list[Result]]


class Lost(Exception):
    """What was looked for is not there, or the motion left its branch."""


@dataclass(frozen=True, slots=True)
class Way:
    """Where a search may go, in Hz."""

    low: float
    high: float
    step: float

    def from_to(self, at: float, to: float) -> float:
        """The next frequency on the way; from outside of the range it comes in step by step."""
        near = min(max(to, at - self.step), at + self.step)
        return round(min(max(near, min(self.low, at)), max(self.high, at)), 9)


def words(card: Track, profile: Profile) -> str:
    """The plan in words."""
    sweep, way = profile.sweep, _way(card, profile)
    follow = f", then follow it for {card.follow} visits" if card.follow else ""
    return (
        f"leave the sweep where {_what(card)} is near, find it to {card.resolution_hz:g} Hz in "
        f"{way.low:g} to {way.high:g} Hz, in at most {card.visits} visits of {sweep.cycles} held "
        f"cycles, each at most {card.step_hz:g} Hz from the one before{follow}"
    )


def begin(card: Track, profile: Profile) -> Tool:
    """The tool; it says where the resonance lies, or why it was not found."""
    search = _by_phase if card.by == "phase" else _by_peak
    try:
        found = yield from search(card, profile)
    except Lost as error:
        found = str(error)
    return f"track by {card.by}: {found}"


def _what(card: Track) -> str:
    if card.by == "peak":
        return "the peak of u over the level"
    return f"the phase of u, {_target(card):g} deg,"


def _target(card: Track) -> float:
    return PHASE_DEG if card.phase_deg is None else card.phase_deg


def _way(card: Track, profile: Profile) -> Way:
    return Way(*card.range_hz(profile.sweep.start_hz, profile.sweep.stop_hz), card.step_hz)


def _by_phase(card: Track, profile: Profile) -> Tool:
    """Visits at the frequency where the phase should be right, by those before."""
    target, way = _target(card), _way(card, profile)

    def crossing(results: Sequence[Result]) -> float | None:
        points = [(one.step.frequency_hz, one.phase_deg) for one in results]
        return crossed(points, target, card.resolution_hz)

    seen = yield from _met(card, profile, crossing)
    met, found = len(seen), list[float]()
    while len(found) <= card.follow:
        at = seen[-1].step.frequency_hz
        to = crossing(seen)
        if to is None:
            to = at + math.copysign(way.step, seen[-1].phase_deg - target)
        f = way.from_to(at, to)
        if f == at in (way.low, way.high):
            raise Lost(f"at {at:g} Hz the phase is still {seen[-1].phase_deg:.1f} deg")
        why = f"{seen[-1].phase_deg:.1f} deg at {at:g} Hz, {target:g} deg are near {to:.4f} Hz"
        seen.append((yield from _visit(seen[-1], f, why)))
        new = crossing(seen)
        if found or (new is not None and abs(new - f) <= card.resolution_hz):
            found.append(f if new is None else new)
        elif len(seen) - met >= card.visits:
            raise Lost(f"{target:g} deg were not found in {card.visits} visits, last {f:g} Hz")
    what = f"u is {target:g} deg ahead of the table's acceleration at"
    return _told(what, found, seen[met:], card, profile)


def _by_peak(card: Track, profile: Profile) -> Tool:
    """Rounds of three visits, up and down in turn, and the parabola through each."""
    way, h = _way(card, profile), card.step_hz

    def vertex(results: Sequence[Result]) -> float | None:
        return summit([(one.step.frequency_hz, one.gain_mm_g) for one in results[-3:]])

    seen = yield from _met(card, profile, vertex)
    met, found = len(seen), list[float]()
    centre = max(seen[-3:], key=lambda one: one.gain_mm_g).step.frequency_hz
    while len(found) <= math.ceil(card.follow / 3):
        centre = round(min(max(centre, way.low + h), way.high - h), 9)
        around = (centre - h, centre, centre + h)
        up = seen[-1].step.frequency_hz <= centre
        for f in around if up else around[::-1]:
            why = f"around {centre:.4f} Hz, for the peak of u over the level"
            yield from _walk(seen, round(f, 9), why, way)
        top = vertex(seen)
        if top is None or abs(top - centre) > h:
            top = max(seen[-3:], key=lambda one: one.gain_mm_g).step.frequency_hz
        if found or abs(top - centre) <= card.resolution_hz:
            found.append(top)
        elif len(seen) - met + 3 > card.visits:
            raise Lost(f"the peak was not found in {card.visits} visits, last {top:.4f} Hz")
        centre = top
    return _told("the peak of u over the level is at", found, seen[met:], card, profile)


def _met(
    card: Track, profile: Profile, estimate: Callable[[Sequence[Result]], float | None]
) -> Results:
    """Results of the sweep, of one direction, up to where the resonance is near."""
    sweep, way = profile.sweep, _way(card, profile)
    seen: list[Result] = []
    for step in sweep.steps[profile.first_step :]:
        if seen and seen[-1].step.direction != step.direction:
            seen = []
        seen.append((yield from visited(None)))
        if len(seen) < 2:
            continue
        _held(seen[-2], seen[-1])
        up = 1.0 if step.direction == "forward" else -1.0
        to = estimate(seen)
        if to is not None and way.low <= to <= way.high:
            first = seen[-min(len(seen), 3)].step.frequency_hz
            if up * first <= up * to <= up * step.frequency_hz + sweep.step_hz:
                return seen
    raise Lost(f"{_what(card)} was not met in the sweep")


def _walk(seen: list[Result], to: float, why: str, way: Way) -> Generator[Move, Result, None]:
    """Visits until the frequency is reached, at most a step each; at least one."""
    while True:
        f = way.from_to(seen[-1].step.frequency_hz, to)
        seen.append((yield from _visit(seen[-1], f, why)))
        if f == to:
            return


def _visit(before: Result, f: float, why: str) -> Visit:
    """The result at a frequency; Lost where the motion left its branch on the way."""
    direction = "forward" if f >= before.step.frequency_hz else "backward"
    result = yield from visited(Decision(f, direction, why))
    _held(before, result)
    return result


def _held(before: Result, after: Result) -> None:
    low, high = sorted((before.swing_m, after.swing_m))
    if high > SUDDEN * low:
        f, g = before.step.frequency_hz, after.step.frequency_hz
        swings = f"{1e3 * before.swing_m:.4g} to {1e3 * after.swing_m:.4g} mm"
        raise Lost(
            f"the swing of u jumps from {swings} between {f:g} and {g:g} Hz, where this branch "
            "ends; take smaller steps, or [refine]"
        )


def _told(
    what: str, found: list[float], visits: list[Result], card: Track, profile: Profile
) -> str:
    """What was found, in words."""
    last = visits[-1]
    text = (
        f"{what} {found[0]:.4f} Hz (to {card.resolution_hz:g} Hz), in "
        f"{len(visits) - (len(found) - 1) * (1 if card.by == 'phase' else 3)} visits of "
        f"{profile.sweep.cycles} held cycles"
    )
    if len(found) > 1:
        text += f"; followed from {found[0]:.4f} to {found[-1]:.4f} Hz, within "
        text += f"{min(found):.4f} to {max(found):.4f} Hz"
    return (
        f"{text}; swing of u {1e3 * last.swing_m:.4g} mm, {last.phase_deg:.1f} deg, at "
        f"{last.step.frequency_hz:g} Hz and {last.level_g:.4f} g"
    )


def crossed(points: Points, target: float, apart: float) -> float | None:
    """Frequency in Hz at which a phase that falls with frequency reaches a target; None if unknown.

    From the newest points that lie at least `apart` from each other. The frequency is interpolated
    over the phase, not the phase over the frequency: it is single-valued and smooth even where a
    branch turns back in a fold, which a Newton step over frequency would always overshoot. Where
    the target lies beyond the fold, on the part that nobody can stay on, it is extrapolated.
    """
    chosen: list[tuple[float, float]] = []
    for f, phase in reversed(points):
        if all(abs(f - other) >= 0.999 * apart for other, _ in chosen):
            chosen.append((f, phase))
    for count in (3, 2):
        some = chosen[:count]
        if len(some) == count and all(b[1] < a[1] for a, b in pairwise(sorted(some))):
            f, slope = _interpolated(some, target)
            if slope < 0.0:
                return f
    return None


def _interpolated(points: Points, target: float) -> tuple[float, float]:
    """(frequency in Hz, its slope over the phase) at a phase, by two or three points."""
    (f0, p0), (f1, p1) = points[:2]
    first = (f1 - f0) / (p1 - p0)
    f, slope = f0 + first * (target - p0), first
    if len(points) > 2:
        f2, p2 = points[2]
        bend = ((f2 - f1) / (p2 - p1) - first) / (p2 - p0)
        f += bend * (target - p0) * (target - p1)
        slope += bend * (2.0 * target - p0 - p1)
    return f, slope


def summit(points: Points) -> float | None:
    """Frequency of the top of the parabola through three points; None where it has none."""
    if len(points) < 3:
        return None
    (x0, y0), (x1, y1), (x2, y2) = sorted(points)
    if x1 in (x0, x2):
        return None
    first, second = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    bend = (second - first) / (x2 - x0)
    return 0.5 * (x0 + x1) - 0.5 * first / bend if bend < 0.0 else None
