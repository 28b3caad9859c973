"""Step detection: the steps of a stepped sine in the table motion of an unlabeled recording.

A sine is tracked along the record: every quarter cycle a weighted least-squares fit over two cycles
gives phase, amplitude and residual. Where the phase is a straight line, the drive holds a
frequency. The lines of two adjacent holds intersect in the middle of the blend between them, which
is known far better than the start of the blend; so a hold is the interval between two such
middles, less half a blend at either end. The PRC point is computed from its last whole cycles.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from table_io.block import Float1D, Int1D, Label
from table_io.config.excitation.stepped_sine import Sweep
from table_io.records import Step
from twin.compare.hum import subtract_hum
from twin.compare.sine_tracking import FITS_PER_CYCLE, SineTrack, detect_rest, track_sines

MIN_CYCLES = 3  # shortest hold that is a step
GRID_TOLERANCE = 0.01  # relative frequency error within which a hold takes the profile's frequency
LEVEL_TOLERANCE = 0.1  # relative level error within which a hold takes the profile's level
MAX_CHECK_LEVEL_SHARE = 0.2  # of the largest level: a burst below it is a loop check
MIN_HELD_SHARE = 0.4  # of the moving time of a stepped sine
MIN_TOTAL_HELD_SHARE = 0.15  # of all motion, loop checks included
MIN_TUNED_CYCLES, NEIGHBOUR_STEPS = 0.5, 3  # cycles; steps on either side
# by which a hold may extend beyond the straight part of its phase
MAX_OVERREACH_CYCLES = 1.5
RAMP_CYCLES, RAMP_S = 2.0, 0.5  # assumed soft start and stop; an abrupt one only loses these edges

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


@dataclass(frozen=True, slots=True)
class Hold:
    """Steady motion from sample `start` to `end` (fractional), with peak acceleration in m/s2."""

    start: float
    end: float
    frequency_hz: float
    level_m_s2: float
    burst: int = 0


@dataclass(frozen=True, eq=False)
class DetectedSteps:
    """Step, label and cycle of every sample, (sample,) each, with the steps and user messages."""

    step: Int1D
    label: Int1D
    cycle: Int1D
    steps: tuple[Step, ...]
    messages: tuple[str, ...]


def find_steps(
    signal: Float1D, rate_hz: float, sweep: Sweep, *, is_acc: bool = False, on_grid: bool = True
) -> DetectedSteps:
    """Detect steps, labels and cycles in the table motion, (sample,).

    `signal` is the table displacement in m, or with `is_acc` its acceleration in m/s2; NaN where
    samples are lost. `on_grid`: frequencies within 1 % and levels within 10 % of the sweep are set
    to those of the sweep, and the last `cycles` of a hold are its held cycles; otherwise only the
    number of measured cycles is taken from the sweep.
    """
    # else the hum of a sensor is a sine at rest
    signal = subtract_hum(signal, rate_hz)
    moving = ~detect_rest(signal, rate_hz)
    holds: list[Hold] = []
    for burst, track in enumerate(track_sines(signal, moving, rate_hz)):
        holds += [replace(hold, burst=burst) for hold in _find_holds(track, rate_hz, sweep, is_acc)]
    holds, messages, sweep_start = _drop_loop_checks(holds, rate_hz)
    held_samples = sum(hold.end - hold.start for hold in holds)
    if held_samples < max(
        MIN_HELD_SHARE * moving[sweep_start:].sum(), MIN_TOTAL_HELD_SHARE * moving.sum()
    ):
        holds = []
    if on_grid:
        holds = [_snap_to_sweep(hold, sweep) for hold in holds]
    holds = split_turns(holds, rate_hz, sweep, on_grid)
    label = np.where(moving, int(Label.BLEND if holds else Label.SETTLE), int(Label.REST))
    step, cycle = np.full((2, signal.size), -1)
    if not holds:
        messages.append("no steps: the table motion is no stepped sine")
    steps = []
    for index, (hold, direction) in enumerate(zip(holds, _assign_directions(holds), strict=True)):
        steps.append(Step(index, direction, hold.frequency_hz, hold.level_m_s2))
        length = rate_hz / hold.frequency_hz
        whole_cycles = int((hold.end - hold.start) / length + 0.1)
        count = min(whole_cycles, sweep.cycles) if on_grid else whole_cycles
        first, end = round(hold.start), min(round(hold.end), signal.size)
        window = slice(max(min(first, round(end - count * length)), 0), end)
        number = np.floor((np.arange(window.start, end) - (end - count * length)) / length + 1e-9)
        number = np.clip(number.astype(np.int64), -1, count - 1)
        step[window], cycle[window] = index, number
        label[window] = np.where(
            number >= count - sweep.measured_cycles, int(Label.MEASURE), int(Label.SETTLE)
        )
    return DetectedSteps(step, label.astype(np.int64), cycle, tuple(steps), tuple(messages))


def _find_holds(track: SineTrack, rate_hz: float, sweep: Sweep, is_acc: bool) -> list[Hold]:
    """Return the holds of one tracked burst."""
    lines = find_straight_lines(track)
    if not lines:
        return []
    middles = [intersect(a, b) for a, b in pairwise(lines)]
    half = [half_blend_length(track, a, b, sweep.blend_cycles) for a, b in pairwise(lines)]
    begin, end = _burst_edges(track, lines, rate_hz)
    starts = [begin, *(m + h for m, h in zip(middles, half, strict=True))]
    ends = [*(m - h for m, h in zip(middles, half, strict=True)), end]
    holds = []
    for line, first, last in zip(lines, starts, ends, strict=True):
        overreach = MAX_OVERREACH_CYCLES / line.f  # noise may end a line early, by at most this
        start = max(first, float(track.sample[line.first]) - overreach)
        stop = min(last, float(track.sample[line.last - 1]) + overreach)
        inside = (track.sample >= start) & (track.sample <= stop)
        hz = line.f * rate_hz
        if (stop - start) * line.f < MIN_CYCLES - 0.1 or not inside.any():
            continue
        level = float(np.median(track.amplitude[inside])) * (1 if is_acc else (2 * np.pi * hz) ** 2)
        holds.append(Hold(start, stop, hz, level))
    return holds


def _burst_edges(
    track: SineTrack, lines: Sequence[PhaseLine], rate_hz: float
) -> tuple[float, float]:
    """Return the first and last steady sample: half a soft start beyond half the amplitude."""
    edges = []
    for line, sign in ((lines[0], 1), (lines[-1], -1)):
        full = float(np.median(track.amplitude[line.first : line.last]))
        # outside the burst the amplitude falls to zero, unless the record begins or ends there
        below = np.flatnonzero(track.amplitude < 0.5 * full)
        middle = (line.first + line.last) // 2
        candidates = below[below < middle] if sign > 0 else below[below > middle]
        half = 0.5 * max(RAMP_CYCLES / line.f, RAMP_S * rate_hz)
        if not candidates.size:
            edges.append(float(track.first if sign > 0 else track.last))
            continue
        k = candidates.max() if sign > 0 else candidates.min()
        if not 0 <= k + sign < track.sample.size:
            edges.append(float(track.sample[k]))
            continue
        low, high = track.amplitude[k], track.amplitude[k + sign]
        share = (0.5 * full - low) / (high - low)
        edges.append(
            float(
                track.sample[k] + share * (track.sample[k + sign] - track.sample[k]) + sign * half
            )
        )
    return edges[0], edges[1]


def _drop_loop_checks(holds: list[Hold], rate_hz: float) -> tuple[list[Hold], list[str], int]:
    """Drop low-level bursts; return (holds kept, message per dropped burst, sweep start sample)."""
    levels: dict[int, float] = {}
    for hold in holds:
        levels[hold.burst] = max(levels.get(hold.burst, 0.0), hold.level_m_s2)
    top = max(levels.values(), default=0.0)
    messages, sweep_start = [], 0
    for burst, level in levels.items():
        if level < MAX_CHECK_LEVEL_SHARE * top:
            burst_holds = [hold for hold in holds if hold.burst == burst]
            span = f"{burst_holds[0].start / rate_hz:.2f} to {burst_holds[-1].end / rate_hz:.2f} s"
            sweep_start = round(burst_holds[-1].end)
            share = f"{100 * level / top:.0f} % of the level"
            messages.append(f"{span}: {share} of the sweep; taken as a loop check, not as steps")
    return (
        [hold for hold in holds if levels[hold.burst] >= MAX_CHECK_LEVEL_SHARE * top],
        messages,
        sweep_start,
    )


def _snap_to_sweep(hold: Hold, sweep: Sweep) -> Hold:
    """Return the hold with the sweep's frequency and level where they agree within tolerance."""
    grid = np.array(sweep.frequencies_hz)
    nearest = float(grid[np.argmin(np.abs(grid - hold.frequency_hz))])
    on_grid = abs(hold.frequency_hz / nearest - 1) <= GRID_TOLERANCE
    level = sweep.steps[0].acceleration_m_s2
    same_level = abs(hold.level_m_s2 / level - 1) <= LEVEL_TOLERANCE
    return replace(
        hold,
        frequency_hz=nearest if on_grid else hold.frequency_hz,
        level_m_s2=level if same_level else hold.level_m_s2,
    )


def split_turns(holds: Sequence[Hold], rate_hz: float, sweep: Sweep, on_grid: bool) -> list[Hold]:
    """Split each hold at a turning point of the sweep into its two steps.

    On the grid the second step consists of the held cycles; otherwise both are equally long.
    """
    cycles = [(hold.end - hold.start) * hold.frequency_hz / rate_hz for hold in holds]
    split = []
    for index, hold in enumerate(holds):
        is_turn = 0 < index < len(holds) - 1 and (
            (hold.frequency_hz - holds[index - 1].frequency_hz)
            * (holds[index + 1].frequency_hz - hold.frequency_hz)
            < 0
        )
        is_sweep_end = on_grid and hold.frequency_hz in (sweep.start_hz, sweep.stop_hz)
        # amplitude tuning lengthens a step before its held cycles: as long as in adjacent steps
        neighbours = (
            cycles[max(index - NEIGHBOUR_STEPS, 0) : index]
            + cycles[index + 1 : index + 1 + NEIGHBOUR_STEPS]
        )
        tuned = min(neighbours, default=0.0) - sweep.cycles
        tuning = tuned + 0.5 * sweep.blend_cycles if tuned > MIN_TUNED_CYCLES else 0.0
        if is_turn and is_sweep_end and cycles[index] > 2 * sweep.cycles + tuning - 0.2:
            cut = hold.end - (sweep.cycles + tuning) * rate_hz / hold.frequency_hz
        elif is_turn and cycles[index] > 1.6 * max(cycles[index - 1], cycles[index + 1]):
            cut = 0.5 * (hold.start + hold.end)
        else:
            split.append(hold)
            continue
        split += [replace(hold, end=cut), replace(hold, start=cut)]
    return split


def _assign_directions(holds: Sequence[Hold]) -> list[str]:
    """Return "forward" or "backward" for each hold: frequency above or below the previous one."""
    signs = [np.sign(b.frequency_hz - a.frequency_hz) for a, b in pairwise(holds)]
    nonzero = [sign for sign in signs if sign]
    last = nonzero[0] if nonzero else 1
    directions = []
    for index in range(len(holds)):
        sign = signs[index - 1] if index else last
        if sign == 0:  # the same frequency twice: the sweep turns between the two
            sign = next((sign for sign in signs[index:] if sign), last)
        last = sign
        directions.append("forward" if sign > 0 else "backward")
    return directions
