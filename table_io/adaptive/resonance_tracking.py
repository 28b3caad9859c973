"""Track policy: find the first resonance of the sweep, then follow it, by phase or by peak.

The sweep ends as soon as the resonance lies within its next step or behind it, so that a branch
that ends in a jump is still held. From there no visit moves by more than `step_hz`.
"""

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from table_io.adaptive.result import (
    Decision,
    PolicyGenerator,
    StepRequest,
    StepResult,
    VisitGenerator,
    request_step,
)
from table_io.config.adaptive import TrackConfig
from table_io.config.profile import Profile
from table_io.records import MIN_JUMP_RATIO

PHASE_DEG = 90.0
Points = Sequence[tuple[float, float]]  # (Hz, degrees or mm/g), newest last
ResultsGenerator = Generator[StepRequest, StepResult, list[StepResult]]


class TrackingLost(Exception):
    """The resonance was not found, or the motion left its branch."""


@dataclass(frozen=True, slots=True)
class SearchRange:
    """Allowed range of a search and its largest step, in Hz."""

    low: float
    high: float
    step: float

    def next_frequency(self, current: float, goal: float) -> float:
        """Return the next frequency in Hz toward `goal`, at most one step away and in the range.

        From outside the range it approaches the range step by step.
        """
        stepped = min(max(goal, current - self.step), current + self.step)
        return round(min(max(stepped, min(self.low, current)), max(self.high, current)), 9)


def describe_policy(config: TrackConfig, profile: Profile) -> str:
    """Describe the planned tracking in one sentence."""
    sweep, limits = profile.sweep, _search_range(config, profile)
    follow = f", then follow it for {config.follow} visits" if config.follow else ""
    return (
        f"leave the sweep where {_describe_target(config)} is near, find it to "
        f"{config.resolution_hz:g} Hz in {limits.low:g} to {limits.high:g} Hz, in at most "
        f"{config.visits} visits of {sweep.cycles} held cycles, each at most "
        f"{config.step_hz:g} Hz from the one before{follow}"
    )


def run_policy(config: TrackConfig, profile: Profile) -> PolicyGenerator:
    """Request visits around the resonance; return where it lies, or why it was not found."""
    search = _track_phase if config.by == "phase" else _track_peak
    try:
        text = yield from search(config, profile)
    except TrackingLost as error:
        text = str(error)
    return f"track by {config.by}: {text}"


def _describe_target(config: TrackConfig) -> str:
    if config.by == "peak":
        return "the peak of u over the level"
    return f"the phase of u, {_target_phase_deg(config):g} deg,"


def _target_phase_deg(config: TrackConfig) -> float:
    return PHASE_DEG if config.phase_deg is None else config.phase_deg


def _search_range(config: TrackConfig, profile: Profile) -> SearchRange:
    return SearchRange(
        *config.range_hz(profile.sweep.start_hz, profile.sweep.stop_hz), config.step_hz
    )


def _track_phase(config: TrackConfig, profile: Profile) -> PolicyGenerator:
    """Visit the estimated frequency of the target phase until it is found, then follow it."""
    target, limits = _target_phase_deg(config), _search_range(config, profile)

    def crossing(results: Sequence[StepResult]) -> float | None:
        points = [(result.step.frequency_hz, result.phase_deg) for result in results]
        return interpolate_phase_crossing(points, target, config.resolution_hz)

    results = yield from _approach_resonance(config, profile, crossing)
    sweep_count, estimates = len(results), list[float]()
    while len(estimates) <= config.follow:
        current = results[-1].step.frequency_hz
        estimate = crossing(results)
        if estimate is None:
            estimate = current + math.copysign(limits.step, results[-1].phase_deg - target)
        frequency_hz = limits.next_frequency(current, estimate)
        if frequency_hz == current in (limits.low, limits.high):
            raise TrackingLost(
                f"at {current:g} Hz, the end of the range, the phase is still "
                f"{results[-1].phase_deg:.1f} deg; widen lowest_hz or highest_hz"
            )
        reason = (
            f"{results[-1].phase_deg:.1f} deg at {current:g} Hz, "
            f"{target:g} deg expected near {estimate:.4f} Hz"
        )
        results.append((yield from _visit_frequency(results[-1], frequency_hz, reason)))
        new_estimate = crossing(results)
        if estimates or (
            new_estimate is not None and abs(new_estimate - frequency_hz) <= config.resolution_hz
        ):
            estimates.append(frequency_hz if new_estimate is None else new_estimate)
        elif len(results) - sweep_count >= config.visits:
            raise TrackingLost(
                f"{target:g} deg were not found in {config.visits} visits, last {frequency_hz:g} Hz"
            )
    label = f"u is {target:g} deg ahead of the table's acceleration at"
    return _format_resonance(label, estimates, results[sweep_count:], config, profile)


def _track_peak(config: TrackConfig, profile: Profile) -> PolicyGenerator:
    """Visit three frequencies per round, alternately up and down, and fit a parabola to each."""
    limits, spacing = _search_range(config, profile), config.step_hz

    def vertex(results: Sequence[StepResult]) -> float | None:
        return parabola_vertex(
            [(result.step.frequency_hz, result.gain_mm_g) for result in results[-3:]]
        )

    results = yield from _approach_resonance(config, profile, vertex)
    sweep_count, estimates = len(results), list[float]()
    centre = max(results[-3:], key=lambda result: result.gain_mm_g).step.frequency_hz
    while len(estimates) <= math.ceil(config.follow / 3):
        centre = round(min(max(centre, limits.low + spacing), limits.high - spacing), 9)
        frequencies = (centre - spacing, centre, centre + spacing)
        up = results[-1].step.frequency_hz <= centre
        for frequency_hz in frequencies if up else frequencies[::-1]:
            reason = f"around {centre:.4f} Hz, for the peak of u over the level"
            yield from _walk_to(results, round(frequency_hz, 9), reason, limits)
        peak = vertex(results)
        if peak is None or abs(peak - centre) > spacing:
            peak = max(results[-3:], key=lambda result: result.gain_mm_g).step.frequency_hz
        if estimates or abs(peak - centre) <= config.resolution_hz:
            estimates.append(peak)
        elif len(results) - sweep_count + 3 > config.visits:
            raise TrackingLost(
                f"the peak was not found in {config.visits} visits, last {peak:.4f} Hz"
            )
        centre = peak
    return _format_resonance(
        "the peak of u over the level is at", estimates, results[sweep_count:], config, profile
    )


def _approach_resonance(
    config: TrackConfig, profile: Profile, estimate: Callable[[Sequence[StepResult]], float | None]
) -> ResultsGenerator:
    """Run the sweep until the resonance is near; return its results in that direction."""
    sweep, limits = profile.sweep, _search_range(config, profile)
    results: list[StepResult] = []
    for step in sweep.steps[profile.first_step :]:
        if results and results[-1].step.direction != step.direction:
            results = []
        results.append((yield from request_step(None)))
        if len(results) < 2:
            continue
        _check_branch(results[-2], results[-1])
        sign = 1.0 if step.direction == "forward" else -1.0
        resonance = estimate(results)
        if resonance is not None and limits.low <= resonance <= limits.high:
            first = results[-min(len(results), 3)].step.frequency_hz
            if sign * first <= sign * resonance <= sign * step.frequency_hz + sweep.step_hz:
                return results
    raise TrackingLost(f"{_describe_target(config)} was not met in the sweep")


def _walk_to(
    results: list[StepResult], goal: float, reason: str, limits: SearchRange
) -> Generator[StepRequest, StepResult, None]:
    """Visit frequencies at most one step apart until `goal` is reached; at least one visit."""
    while True:
        frequency_hz = limits.next_frequency(results[-1].step.frequency_hz, goal)
        results.append((yield from _visit_frequency(results[-1], frequency_hz, reason)))
        if frequency_hz == goal:
            return


def _visit_frequency(previous: StepResult, frequency_hz: float, reason: str) -> VisitGenerator:
    """Return the result at a frequency; TrackingLost if the motion left its branch."""
    direction = "forward" if frequency_hz >= previous.step.frequency_hz else "backward"
    result = yield from request_step(Decision(frequency_hz, direction, reason))
    _check_branch(previous, result)
    return result


def _check_branch(previous: StepResult, result: StepResult) -> None:
    low, high = sorted((previous.swing_m, result.swing_m))
    if high > MIN_JUMP_RATIO * low:
        previous_hz, current_hz = previous.step.frequency_hz, result.step.frequency_hz
        swings = f"{1e3 * previous.swing_m:.4g} to {1e3 * result.swing_m:.4g} mm"
        raise TrackingLost(
            f"the swing of u jumps from {swings} between {previous_hz:g} and {current_hz:g} Hz, "
            "where this branch ends; use a smaller step_hz, or [refine]"
        )


def _format_resonance(
    label: str,
    estimates: list[float],
    visits: list[StepResult],
    config: TrackConfig,
    profile: Profile,
) -> str:
    """Describe the resonance in one sentence."""
    last = visits[-1]
    text = (
        f"{label} {estimates[0]:.4f} Hz (to {config.resolution_hz:g} Hz), in "
        f"{len(visits) - (len(estimates) - 1) * (1 if config.by == 'phase' else 3)} visits of "
        f"{profile.sweep.cycles} held cycles"
    )
    if len(estimates) > 1:
        text += f"; followed from {estimates[0]:.4f} to {estimates[-1]:.4f} Hz, within "
        text += f"{min(estimates):.4f} to {max(estimates):.4f} Hz"
    return (
        f"{text}; swing of u {1e3 * last.swing_m:.4g} mm, {last.phase_deg:.1f} deg, at "
        f"{last.step.frequency_hz:g} Hz and {last.level_g:.4f} g"
    )


def interpolate_phase_crossing(points: Points, target: float, min_spacing: float) -> float | None:
    """Interpolate the frequency in Hz at which a falling phase reaches a target; None if unknown.

    Uses the newest points that are at least `min_spacing` apart. The frequency is interpolated over
    the phase, not the phase over the frequency: it is single-valued and smooth even where a branch
    turns back in a fold, which a Newton step over frequency would always overshoot. If the target
    lies beyond the fold, on the unstable part, it is extrapolated.
    """
    chosen: list[tuple[float, float]] = []
    for frequency_hz, phase in reversed(points):
        if all(abs(frequency_hz - chosen_hz) >= 0.999 * min_spacing for chosen_hz, _ in chosen):
            chosen.append((frequency_hz, phase))
    for count in (3, 2):
        selected = chosen[:count]
        if len(selected) == count and all(b[1] < a[1] for a, b in pairwise(sorted(selected))):
            frequency_hz, slope = _interpolate_frequency(selected, target)
            if slope < 0.0:
                return frequency_hz
    return None


def _interpolate_frequency(points: Points, target: float) -> tuple[float, float]:
    """Interpolate (frequency in Hz, slope over the phase) at a phase from two or three points."""
    (f0, p0), (f1, p1) = points[:2]
    first = (f1 - f0) / (p1 - p0)
    f, slope = f0 + first * (target - p0), first
    if len(points) > 2:
        f2, p2 = points[2]
        bend = ((f2 - f1) / (p2 - p1) - first) / (p2 - p0)
        f += bend * (target - p0) * (target - p1)
        slope += bend * (2.0 * target - p0 - p1)
    return f, slope


def parabola_vertex(points: Points) -> float | None:
    """Return the frequency in Hz of the maximum of the parabola through three points, or None."""
    if len(points) < 3:
        return None
    (x0, y0), (x1, y1), (x2, y2) = sorted(points)
    if x1 in (x0, x2):
        return None
    first, second = (y1 - y0) / (x1 - x0), (y2 - y1) / (x2 - x1)
    bend = (second - first) / (x2 - x0)
    return 0.5 * (x0 + x1) - 0.5 * first / bend if bend < 0.0 else None
