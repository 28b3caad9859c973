"""Numerical findings below the primary resonance: secondary resonances, impacts one by one, chaos.

A secondary resonance is the upper end of a left hysteresis: there the forward sweep jumps up to the
motion with one impact less on a side, which it has just lost by grazing.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from table_io.block import Float1D
from table_io.records import Step
from twin.compare.curves import Hysteresis, detect_hysteresis
from twin.paper.slow_passage import SettledSweep, choose_effort
from twin.results import ideal_points
from twin.results.paper_cases import PaperCase
from twin.results.players import SystemMotion
from twin.results.report_data import DIRECTIONS

SCANNED_HZ = 0.45, 1.7  # from below the range of the tests to above the last secondary resonance
EVALUATED_CYCLES = 6  # of each frequency of the scan
MIN_WIDTH_HZ = 0.005  # a narrower interval is a detail within a chaotic band
EXPONENT_BLOCKS = 20  # consecutive blocks whose scatter gives the error of a mean
BLOCK_CYCLES = 20  # of a block in which internal loops are counted
SEQUENCE_CYCLES = 60  # cycles of which impacts are measured one by one


@dataclass(frozen=True, slots=True, eq=False)
class SecondaryResonances(SettledSweep):
    """Scan of the low frequencies, with the left hystereses below 1.7 Hz, in Hz."""

    intervals: tuple[Hysteresis, ...]

    @property
    def resonances_hz(self) -> list[float]:
        """Upper ends of the intervals: the last frequency before the forward sweep jumps up."""
        return [interval.to_hz for interval in self.intervals]


def find_secondary_resonances(case: PaperCase) -> SecondaryResonances:
    """Scan the low frequency range slowly, forward and backward, and judge it as `prc` does."""
    effort, a, simulator = choose_effort(case), case.acceleration, case.simulator
    count = round((SCANNED_HZ[1] - SCANNED_HZ[0]) / effort.secondary_hz) + 1
    grid_hz = np.linspace(*SCANNED_HZ, count).round(6)
    frequencies_hz = np.concatenate([grid_hz, grid_hz[::-1]])
    response = simulator.sweep(frequencies_hz, a, effort.fine_cycles)
    steps = [
        Step(index, DIRECTIONS[index >= count], hz, a)
        for index, hz in enumerate(frequencies_hz.tolist())
    ]
    points = ideal_points.compute_prc_points(
        simulator.model, steps, response, effort.fine_cycles, EVALUATED_CYCLES, case.scale
    )
    intervals = [
        interval
        for interval in detect_hysteresis(points, "twin")[1]
        if interval.kind == "left" and interval.to_hz - interval.from_hz > MIN_WIDTH_HZ
    ]
    states = {"forward": response.states[:count], "backward": response.states[count:][::-1]}
    return SecondaryResonances(grid_hz, states, tuple(intervals))


def nearest_hz(frequencies_hz: list[float], frequency_hz: float) -> float | None:
    """Return the frequency nearest to a given one; None if there is none within 15 %."""
    near = [hz for hz in frequencies_hz if abs(hz / frequency_hz - 1) < 0.15]
    return min(near, key=lambda hz: abs(hz - frequency_hz), default=None)


def simulate_secondary_motion(
    case: PaperCase, scan: SecondaryResonances, hz: float, direction: str, cycles: int
) -> SystemMotion:
    """Simulate the motion of a step of the scan, at its end."""
    state = scan.state_at(hz, direction)
    return case.simulator.simulate_motion(hz, case.acceleration, state, cycles)


@dataclass(frozen=True, slots=True)
class ImpactSequence:
    """Impacts of a side within a cycle, in order: mean peak force in N and mean duration in s."""

    peaks_n: list[float]
    durations_s: list[float]
    share: float  # of the cycles, those with this number of impacts


def measure_impact_sequence(
    case: PaperCase, frequency_hz: float, state: Float1D, impacts: int
) -> ImpactSequence | None:
    """Measure the right impacts of the cycles that have `impacts` of them; None without any.

    A cycle begins with the contact that ends the longest flight of that side.
    """
    motion = case.simulator.simulate_motion(frequency_hz, case.acceleration, state, SEQUENCE_CYCLES)
    contact = (motion.force_r > 0).astype(int)
    onsets = np.flatnonzero(np.diff(contact) == 1) + 1
    releases = np.flatnonzero(np.diff(contact) == -1) + 1
    if onsets.size < 2 or releases.size < 2:
        return None
    releases = releases[releases > onsets[0]]
    onsets = onsets[: releases.size]
    flights = np.concatenate([[np.inf], (onsets[1:] - releases[:-1]).astype(float)])
    samples_per_cycle = motion.u.size / SEQUENCE_CYCLES
    starts = np.flatnonzero(flights > 0.35 * samples_per_cycle).tolist()
    groups = [range(*pair) for pair in pairwise(starts)]
    chosen = [list(group) for group in groups if len(group) == impacts]
    if not chosen:
        return None
    dt = float(motion.time[1] - motion.time[0])
    peaks = [[float(motion.force_r[onsets[k] : releases[k]].max()) for k in g] for g in chosen]
    durations = [[float(releases[k] - onsets[k]) * dt for k in group] for group in chosen]
    return ImpactSequence(
        np.mean(peaks, axis=0).tolist(), np.mean(durations, axis=0).tolist(),
        len(chosen) / len(groups),
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class InternalLoops:
    """Internal loops of the phase portrait per cycle, (right, left): mean and standard error.

    `reaching`: share of them that intersect the line of the obstacle.
    """

    mean: tuple[float, float]
    error: tuple[float, float]
    reaching: float


def count_internal_loops(case: PaperCase, frequency_hz: float) -> InternalLoops:
    """Count the turning points of u beyond the first on each side, over the cycles of a motion.

    From rest, without the transient. The error is that of the mean of consecutive blocks.
    """
    a, simulator = case.acceleration, case.simulator
    state = simulator.sweep([frequency_hz], a, choose_effort(case).transient_cycles).states[0]
    u = simulator.simulate_motion(frequency_hz, a, state, EXPONENT_BLOCKS * BLOCK_CYCLES).u
    turns, reached = np.empty((2, EXPONENT_BLOCKS)), np.empty(2)
    for side, position in enumerate((u, -u)):
        before, here, after = position[:-2], position[1:-1], position[2:]
        is_turn = (here > before) & (here >= after) & (here > 0)
        blocks = np.array_split(is_turn, EXPONENT_BLOCKS)
        turns[side] = [block.sum() / BLOCK_CYCLES - 1 for block in blocks]
        is_inner = is_turn & (here > case.gaps_m[side])
        reached[side] = is_inner.sum() / (EXPONENT_BLOCKS * BLOCK_CYCLES) - 1
    mean, error = turns.mean(axis=1), turns.std(axis=1, ddof=1) / np.sqrt(EXPONENT_BLOCKS)
    share = float(reached.clip(min=0).sum() / mean.sum()) if mean.sum() > 0 else 0.0
    return InternalLoops(
        (float(mean[0]), float(mean[1])), (float(error[0]), float(error[1])), share
    )


@dataclass(frozen=True, slots=True)
class ChaosMeasure:
    """Largest Lyapunov exponent per cycle with its standard error, and the scatter of eta_d."""

    exponent: float
    error: float
    scatter: float  # standard deviation of eta_d over cycles, of its mean


def measure_chaos(case: PaperCase, frequency_hz: float) -> ChaosMeasure:
    """Measure the exponent over consecutive blocks of cycles, from rest, without the transient.

    The error is that of the mean of the blocks, which are long against the correlation time.
    """
    effort, a, simulator = choose_effort(case), case.acceleration, case.simulator
    state = simulator.sweep([frequency_hz], a, effort.transient_cycles).states[0]
    motion = simulator.sweep([frequency_hz], a, effort.counted_cycles, state)
    excursion = (motion.column("u_max") - motion.column("u_min"))[0]
    exponents = []
    for _ in range(EXPONENT_BLOCKS):
        exponent, state = simulator.lyapunov_exponent(
            frequency_hz, a, state, effort.lyapunov_cycles
        )
        exponents.append(exponent)
    return ChaosMeasure(
        float(np.mean(exponents)),
        float(np.std(exponents, ddof=1) / np.sqrt(EXPONENT_BLOCKS)),
        float(excursion.std() / excursion.mean()),
    )
