"""Releases of the feedback at an accepted orbit, to measure its Floquet multiplier.

    push the reference, to and fro in turn --> release: the departure grows by itself
                    ^                             |
                    `------ recover <-- catch ----'   at the largest departure, or after MAX_FREE

The releases of one orbit fill `multiplier_periods`; what was measured in them gives the multiplier
(`adaptive/floquet_multiplier.py`). A departure is caught long before the feedback reaches its
limit; if the orbit is lost all the same, it is left for rest as at any other time.
"""

import math
from dataclasses import replace

import numpy as np

from table_io.adaptive.floquet_multiplier import (
    Departure,
    MultiplierEstimate,
    estimate_multiplier,
)
from table_io.block import Block, Float1D, join_blocks
from table_io.channels import measure_mass
from table_io.control.orbit_feedback import FeedbackState, evaluate_harmonics
from table_io.records import OrbitPoint
from table_io.sequencer.state import OrbitSearch, ReleaseSeries, SequencerState

MAX_DEPARTURE = 0.02  # of the amplitude of u: the feedback acts again
MAX_CONTACT_CHANGE = 0.3  # the same, of the way from a turning point of u to a bumper
MAX_PUSH = 0.003  # of the fundamental of x
GROWTH_PERIODS = 2.5  # from a push to the largest departure, by the planned multiplier
PUSH_PERIODS = 1.0
RELEASE_S = 0.05  # of the feedback
SETTLE_PERIODS = 1.5  # after it, over the square root of the multiplier: a smaller one decays
MIN_FREE_PERIODS = 1.5
MAX_FREE_PERIODS = 4.0
CATCH_S = 0.03
RECOVERY_PERIODS = 2.0


def find_departure_limit(point: OrbitPoint, gaps_m: tuple[float, float]) -> float:
    """Return the departure in m up to which the motion is taken as linear about an orbit.

    gaps_m: of the right and the left bumper. The law of growth changes where an impact begins to
    vanish or to appear, which limits the departure close to grazing.
    """
    mean_m = point.u_m[0]
    turning_points = (point.amplitude_m + mean_m, point.amplitude_m - mean_m)
    ways = [abs(gap - turn) for gap, turn in zip(gaps_m, turning_points, strict=True)]
    return min(MAX_DEPARTURE * point.amplitude_m, MAX_CONTACT_CHANGE * min(ways))


def advance_releases(state: SequencerState, block: Block) -> SequencerState:
    """Return the state with the next release, or the end of the present one, after a block."""
    search, rate_hz = state.search, state.trajectory.rate_hz
    assert search is not None
    assert search.releases is not None
    series, period = search.releases, rate_hz / search.target.frequency_hz
    index = block.end + search.feedback.horizon
    if series.is_released:
        first, _ = series.spans[-1]
        departure = measure_departure(state, block, series)
        is_large = abs(departure.mean()) > series.limit_m
        is_over = index >= first + MAX_FREE_PERIODS * period
        is_last = index >= state.stage.last - RECOVERY_PERIODS * period
        if is_large or is_over or is_last or not np.isfinite(departure).all():
            return replace(state, search=_catch_orbit(search, index, rate_hz))
        return state
    settle = SETTLE_PERIODS / math.sqrt(series.multiplier)
    needed = (PUSH_PERIODS + settle + MIN_FREE_PERIODS + RECOVERY_PERIODS) * period
    needed += RELEASE_S * rate_hz
    if index < series.next_start or index + needed > state.stage.last:
        return state
    return replace(state, search=_release_orbit(search, index, rate_hz))


def measure_departure(state: SequencerState, block: Block, series: ReleaseSeries) -> Float1D:
    """Return x minus that of the accepted orbit in m, (sample,)."""
    phase = state.drive.phase(block.index, len(block))
    return measure_mass(block) - evaluate_harmonics(series.motion, phase)


def _release_orbit(search: OrbitSearch, index: int, rate_hz: float) -> OrbitSearch:
    """Push the motion from sample `index` on, in turn to either side, and release it."""
    series = search.releases
    assert series is not None
    period = rate_hz / search.target.frequency_hz
    held = search.feedback.segment_at(index)
    pushed = series.reference.copy()
    push_share = min(MAX_PUSH, MAX_DEPARTURE / series.multiplier**GROWTH_PERIODS)
    pushed[1:3] *= 1.0 + push_share * (-1.0) ** len(series.spans)
    release = index + round(PUSH_PERIODS * period)
    count = round(RELEASE_S * rate_hz)
    push = replace(held, start=index, count=round(0.5 * PUSH_PERIODS * period),
                   before=series.reference, after=pushed, share0=1.0, share1=1.0)  # fmt: skip
    free = replace(push, start=release, count=count, before=pushed, after=series.reference,
                   share1=0.0)  # fmt: skip
    first = release + count + round(SETTLE_PERIODS / math.sqrt(series.multiplier) * period)
    feedback = search.feedback.append(push).append(free)
    series = replace(series, spans=(*series.spans, (first, first)), is_released=True)
    return replace(search, feedback=feedback, releases=series)


def _catch_orbit(search: OrbitSearch, index: int, rate_hz: float) -> OrbitSearch:
    """Let the feedback act again from sample `index` on."""
    series = search.releases
    assert series is not None
    first, _ = series.spans[-1] if series.spans else (index, index)
    recovery = round(RECOVERY_PERIODS * rate_hz / search.target.frequency_hz)
    series = replace(
        series,
        spans=(*series.spans[:-1], (first, max(index, first))),
        is_released=False,
        next_start=index + recovery,
    )
    return replace(
        search, feedback=_restore(search.feedback, index, rate_hz, series), releases=series
    )


def end_releases(search: OrbitSearch, index: int, rate_hz: float) -> OrbitSearch:
    """Let the feedback act again and end the series, after block end `index`."""
    search = _catch_orbit(search, index + search.feedback.horizon, rate_hz)
    return replace(search, releases=None)


def _restore(
    feedback: FeedbackState, index: int, rate_hz: float, series: ReleaseSeries
) -> FeedbackState:
    """Return the feedback that holds the reference again from sample `index` on."""
    held = feedback.segment_at(index)
    share, reference = float(held.share(np.array([index]))[0]), series.reference
    caught = replace(held, start=index, count=round(CATCH_S * rate_hz), share0=share, share1=1.0)
    return feedback.append(replace(caught, before=reference, after=reference))


def estimate_from_releases(state: SequencerState) -> MultiplierEstimate:
    """Return the Floquet multiplier by the releases so far; NaN if they are too few."""
    search = state.search
    assert search is not None
    assert search.releases is not None
    series = search.releases
    departures = []
    for first, last in series.spans:
        parts = [b for b in state.blocks if b.end > first and b.index < last]
        if last <= first or not parts:
            continue
        window = join_blocks(parts)
        window = window.cut(max(first, window.index), min(last, window.end))
        phase = np.unwrap(state.drive.phase(window.index, len(window)), period=1.0)
        departures.append(Departure(phase, measure_departure(state, window, series)))
    return estimate_multiplier(departures)
