"""The steps of a stepped sine, found in the table's motion: for recordings that carry no labels.

A sine is tracked along the record: every quarter cycle a weighted least-squares fit over two cycles
gives phase, amplitude and what is no sine. Where the phase is a straight line the drive is held.
The lines of two neighbours meet in the middle of the blend between them, and that is known far
better than where a blend begins; so a hold is what lies between two such middles, less half a blend
at either end. Its last whole cycles are those that a PRC point is made of.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from table_io.block import Float1D, Int1D, Label
from table_io.profile import Sweep
from table_io.records import Step
from twin.learn.lines import Line, half_blend, meet, straight_lines
from twin.learn.sine import Track, at_rest, tracks

LEAST_CYCLES = 3  # held, for a step
GRID_SHARE = 0.01  # a frequency this near to the profile's grid is the grid's
LEVEL_SHARE = 0.1  # likewise of the level
LOW_LEVEL = 0.2  # of the largest: a burst of less is a loop check, no part of the sweep
HELD_SHARE = 0.4  # of the time that it moves, in a stepped sine
HELD_LEAST = 0.15  # of all motion, whatever was taken for a loop check
LEAST_TUNED, NEAR = 0.5, 3  # cycles; steps to either side
BEYOND = 1.5  # cycles that a hold may reach beyond where its phase was seen to be straight
RAMP_CYCLES, RAMP_S = 2.0, 0.5  # soft start and stop; an abrupt one only loses these edges


@dataclass(frozen=True, slots=True)
class Hold:
    """Steady motion from sample `start` to `end` (fractional): Hz, and peak acceleration, m/s2."""

    start: float
    end: float
    frequency_hz: float
    level_m_s2: float
    burst: int = 0


@dataclass(frozen=True, eq=False)
class Found:
    """Labels of every sample, (sample,) each, the steps they name, and what a person is told."""

    step: Int1D
    label: Int1D
    cycle: Int1D
    steps: tuple[Step, ...]
    said: tuple[str, ...]


def find_steps(
    signal: Float1D, rate_hz: float, sweep: Sweep, *, is_acc: bool = False, on_grid: bool = True
) -> Found:
    """Steps, labels and cycles of a table's motion, (sample,): its displacement in m, or its
    acceleration in m/s2 (`is_acc`); NaN where samples are lost.

    `on_grid`: frequencies and level within 1 and 10 % of the sweep's are the sweep's, and a hold's
    last `cycles` are its held ones; else the sweep only says how many cycles are measured.
    """
    moving = ~at_rest(signal, rate_hz)
    holds: list[Hold] = []
    for burst, track in enumerate(tracks(signal, moving, rate_hz)):
        holds += [replace(hold, burst=burst) for hold in _holds(track, rate_hz, sweep, is_acc)]
    holds, said, begins = _without_check(holds, rate_hz)
    held = sum(hold.end - hold.start for hold in holds)
    if held < max(HELD_SHARE * moving[begins:].sum(), HELD_LEAST * moving.sum()):
        holds = []
    if on_grid:
        holds = [_nominal(hold, sweep) for hold in holds]
    holds = _split_turns(holds, rate_hz, sweep, on_grid)
    label = np.where(moving, int(Label.BLEND if holds else Label.SETTLE), int(Label.REST))
    step, cycle = np.full((2, signal.size), -1)
    if not holds:
        said.append("the table's motion is no stepped sine: no steps in it")
    steps = []
    for index, (hold, direction) in enumerate(zip(holds, _directions(holds), strict=True)):
        steps.append(Step(index, direction, hold.frequency_hz, hold.level_m_s2))
        length = rate_hz / hold.frequency_hz
        whole = int((hold.end - hold.start) / length + 0.1)
        count = min(whole, sweep.cycles) if on_grid else whole
        first, end = round(hold.start), min(round(hold.end), signal.size)
        window = slice(max(min(first, round(end - count * length)), 0), end)
        number = np.floor((np.arange(window.start, end) - (end - count * length)) / length + 1e-9)
        number = np.clip(number.astype(np.int64), -1, count - 1)
        step[window], cycle[window] = index, number
        label[window] = np.where(
            number >= count - sweep.measured_cycles, int(Label.MEASURE), int(Label.SETTLE)
        )
    return Found(step, label.astype(np.int64), cycle, tuple(steps), tuple(said))


def _holds(track: Track, rate_hz: float, sweep: Sweep, is_acc: bool) -> list[Hold]:
    """The holds of one tracked burst."""
    lines = straight_lines(track)
    if not lines:
        return []
    middles = [meet(a, b) for a, b in pairwise(lines)]
    half = [half_blend(track, a, b, sweep.blend_cycles) for a, b in pairwise(lines)]
    begin, end = _edges(track, lines, rate_hz)
    starts = [begin, *(m + h for m, h in zip(middles, half, strict=True))]
    ends = [*(m - h for m, h in zip(middles, half, strict=True)), end]
    found = []
    for line, first, last in zip(lines, starts, ends, strict=True):
        beyond = BEYOND / line.f  # a line may end early in noise, but not by more
        start = max(first, float(track.at[line.first]) - beyond)
        stop = min(last, float(track.at[line.last - 1]) + beyond)
        inside = (track.at >= start) & (track.at <= stop)
        hz = line.f * rate_hz
        if (stop - start) * line.f < LEAST_CYCLES - 0.1 or not inside.any():
            continue
        level = float(np.median(track.amplitude[inside])) * (1 if is_acc else (2 * np.pi * hz) ** 2)
        found.append(Hold(start, stop, hz, level))
    return found


def _edges(track: Track, lines: Sequence[Line], rate_hz: float) -> tuple[float, float]:
    """First and last steady sample of a burst: half a soft start beyond half its amplitude."""
    out = []
    for line, way in ((lines[0], 1), (lines[-1], -1)):
        full = float(np.median(track.amplitude[line.first : line.last]))
        # Before and after it the amplitude falls to nothing; where it does not the record ends.
        below = np.flatnonzero(track.amplitude < 0.5 * full)
        middle = (line.first + line.last) // 2
        side = below[below < middle] if way > 0 else below[below > middle]
        half = 0.5 * max(RAMP_CYCLES / line.f, RAMP_S * rate_hz)
        if not side.size:
            out.append(float(track.first if way > 0 else track.last))
            continue
        k = side.max() if way > 0 else side.min()
        if not 0 <= k + way < track.at.size:
            out.append(float(track.at[k]))
            continue
        low, high = track.amplitude[k], track.amplitude[k + way]
        share = (0.5 * full - low) / (high - low)
        out.append(float(track.at[k] + share * (track.at[k + way] - track.at[k]) + way * half))
    return out[0], out[1]


def _without_check(holds: list[Hold], rate_hz: float) -> tuple[list[Hold], list[str], int]:
    """The holds without the bursts of low level, a sentence for each of those, where they end."""
    levels: dict[int, float] = {}
    for hold in holds:
        levels[hold.burst] = max(levels.get(hold.burst, 0.0), hold.level_m_s2)
    top = max(levels.values(), default=0.0)
    said, begins = [], 0
    for burst, level in levels.items():
        if level < LOW_LEVEL * top:
            own = [hold for hold in holds if hold.burst == burst]
            span = f"{own[0].start / rate_hz:.2f} to {own[-1].end / rate_hz:.2f} s"
            begins = round(own[-1].end)
            share = f"{100 * level / top:.0f} % of the level"
            said.append(f"{span}: {share}; a loop check, no part of the sweep")
    return [hold for hold in holds if levels[hold.burst] >= LOW_LEVEL * top], said, begins


def _nominal(hold: Hold, sweep: Sweep) -> Hold:
    """The hold with frequency and level of the sweep where they are the sweep's."""
    grid = np.array(sweep.frequencies_hz)
    nearest = float(grid[np.argmin(np.abs(grid - hold.frequency_hz))])
    near = abs(hold.frequency_hz / nearest - 1) <= GRID_SHARE
    level = sweep.steps[0].acceleration_m_s2
    same = abs(hold.level_m_s2 / level - 1) <= LEVEL_SHARE
    return replace(
        hold,
        frequency_hz=nearest if near else hold.frequency_hz,
        level_m_s2=level if same else hold.level_m_s2,
    )


def _split_turns(holds: Sequence[Hold], rate_hz: float, sweep: Sweep, on_grid: bool) -> list[Hold]:
    """The holds, those at which a sweep turns round cut into the two steps that they are.

    On the grid the second of them is the held cycles; else the two are alike.
    """
    cycles = [(hold.end - hold.start) * hold.frequency_hz / rate_hz for hold in holds]
    out = []
    for place, hold in enumerate(holds):
        turn = 0 < place < len(holds) - 1 and (
            (hold.frequency_hz - holds[place - 1].frequency_hz)
            * (holds[place + 1].frequency_hz - hold.frequency_hz)
            < 0
        )
        end = on_grid and hold.frequency_hz in (sweep.start_hz, sweep.stop_hz)
        # Where a level is tuned, a step is held before its held cycles too: as long as those near.
        near = cycles[max(place - NEAR, 0) : place] + cycles[place + 1 : place + 1 + NEAR]
        tuned = min(near, default=0.0) - sweep.cycles
        before = tuned + 0.5 * sweep.blend_cycles if tuned > LEAST_TUNED else 0.0
        if turn and end and cycles[place] > 2 * sweep.cycles + before - 0.2:
            middle = hold.end - (sweep.cycles + before) * rate_hz / hold.frequency_hz
        elif turn and cycles[place] > 1.6 * max(cycles[place - 1], cycles[place + 1]):
            middle = 0.5 * (hold.start + hold.end)
        else:
            out.append(hold)
            continue
        out += [replace(hold, end=middle), replace(hold, start=middle)]
    return out


def _directions(holds: Sequence[Hold]) -> list[str]:
    """ "forward" or "backward" of each hold: upwards or downwards from the one before it."""
    signs = [np.sign(b.frequency_hz - a.frequency_hz) for a, b in pairwise(holds)]
    known = [sign for sign in signs if sign]
    last = known[0] if known else 1
    out = []
    for place in range(len(holds)):
        way = signs[place - 1] if place else last
        if way == 0:  # twice the same: the sweep turns round between them
            way = next((sign for sign in signs[place:] if sign), last)
        last = way
        out.append("forward" if way > 0 else "backward")
    return out
