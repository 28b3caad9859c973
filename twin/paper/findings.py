"""Numerical findings: folds, grazing, coexisting orbits, impacts, chaos, permanent contact."""

import math
from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq, minimize_scalar

from table_io.block import Float1D
from twin.dynamics.closed_form_map import ClosedFormMap
from twin.dynamics.continuation import continue_branch
from twin.dynamics.orbits import Orbit, settle_to_orbit
from twin.dynamics.period_map import FREQUENCY
from twin.model.model import Model
from twin.model.parameters import free_flight_resonance
from twin.paper.slow_passage import (
    FINE_EFFORT,
    MAX_DIRECTION_DIFFERENCE,
    SlowSweep,
    choose_effort,
)
from twin.results.paper_cases import PaperCase
from twin.results.players import HarmonicSimulator, SystemMotion, make_simulator

# Limit and tolerance of the search for permanent contact.
MIN_GAP_MM = -40.0
GAP_TOLERANCE_MM = 0.005
MAX_HYSTERESIS_HZ = 2.0  # from a frequency within a hysteresis to its end
BRANCH_MARGIN_HZ = 0.5  # by which a branch is followed beyond a hysteresis
MIN_BAND_VALUE = 0.05  # of an exponent or a share in a band of a curve
SETTLE_CYCLES = 400  # cycles until the motion is steady
FLIGHT_CYCLES = 4  # cycles over which the share of flight is measured
FLIGHT_SAMPLES = 40000  # of such a cycle: a share is known to 0.01 %


@dataclass(frozen=True, slots=True)
class Folds:
    """Fold frequencies of a hysteresis in Hz: ends of the forward and of the backward branch.

    `method`: "folds" (continuation) or "slow passage", in which the jumps come slightly later.
    """

    forward_hz: float
    backward_hz: float
    kind: str  # "right": the forward branch is the larger one
    method: str = "folds"


def find_folds(case: PaperCase, sweep: SlowSweep) -> Folds | None:
    """Find the folds of the primary hysteresis by continuation; None if there is no hysteresis.

    Each branch is followed from outside the interval, where the solution is unique. For a model
    without a one-period map in closed form the jumps of the slow passage are used.
    """
    eta_d, frequencies = sweep.eta_d, sweep.frequency
    differs = np.abs(eta_d["forward"] - eta_d["backward"]) > MAX_DIRECTION_DIFFERENCE * np.maximum(
        *eta_d.values()
    )
    differs &= frequencies > _chaos_limit_hz(case)
    if not differs.any():
        return None
    low, high = max(
        find_bands(frequencies, differs.astype(float)),
        key=lambda interval: interval[1] - interval[0],
    )
    middle = int(np.abs(frequencies - (low + high) / 2).argmin())
    kind = "right" if eta_d["forward"][middle] > eta_d["backward"][middle] else "left"
    if not case.simulator.is_exact:
        resolved = high - low > 2 * choose_effort(case).fine_hz
        return Folds(high, low, kind, "slow passage") if resolved else None
    low_hz, high_hz = low - 5 * FINE_EFFORT.fine_hz, high + 5 * FINE_EFFORT.fine_hz
    limits = low_hz - BRANCH_MARGIN_HZ, high_hz + BRANCH_MARGIN_HZ
    folds_hz = []
    for start_hz, direction, sign in ((low_hz, "forward", 1), (high_hz, "backward", -1)):
        orbit = _settle(case, sweep, start_hz, direction)
        if orbit is None:
            return None
        folds = continue_branch(orbit, FREQUENCY, limits, sign).folds
        if not folds:
            return None
        folds_hz.append(folds[0].value)
    return Folds(folds_hz[0], folds_hz[1], kind)


def _settle(case: PaperCase, sweep: SlowSweep, frequency_hz: float, direction: str) -> Orbit | None:
    """Return the orbit to which the motion of a slow sweep settles at a frequency."""
    period_map = ClosedFormMap(Model(case.parameters), frequency_hz, case.acceleration)
    start = sweep.state_at(frequency_hz, direction).take(period_map.indices)
    return settle_to_orbit(period_map, start)


def _chaos_limit_hz(case: PaperCase) -> float:
    """Return the frequency in Hz above which the directions can differ only by hysteresis."""
    return 1.42 if case.parameters.gap_r > 0 else 2.0


def find_graze_hz(case: PaperCase, sweep: SlowSweep) -> float:
    """Return the grazing frequency in Hz: with falling frequency, flight first touches a bumper.

    Linear flight has the amplitude a/|w0^2 - w^2 + 2 i z w0 w|; for other models the first contact
    of the backward slow passage is used.
    """
    p, a = case.parameters, case.acceleration
    if not case.simulator.is_exact:
        contact_hz = sweep.frequency[sweep.has_contact["backward"]]
        return float(contact_hz.max()) if contact_hz.size else math.nan

    def grazing_margin(hz: float) -> float:
        w = 2 * math.pi * hz
        flight = a / abs(p.stiffness / p.mass - w * w + 1j * w * p.damping / p.mass)
        return flight - min(p.gap_r, p.gap_l)

    return float(brentq(grazing_margin, free_flight_resonance(p, a)[2], 20.0))


@dataclass(frozen=True, slots=True, eq=False)
class CoexistingOrbits:
    """Largest u in m of the forward and the backward orbit, and the unstable orbit between them.

    `unstable` is None for models without a one-period map in closed form.
    """

    forward_m: float
    backward_m: float
    unstable: Orbit | None


def find_coexisting_orbits(
    case: PaperCase, sweep: SlowSweep, frequency_hz: float
) -> CoexistingOrbits | None:
    """Find the coexisting orbits at a frequency; None if both directions lead to the same one."""
    if not case.simulator.is_exact:
        forward_m, backward_m = (
            steady_amplitude_m(case, sweep, frequency_hz, direction)
            for direction in ("forward", "backward")
        )
        return (
            None
            if abs(forward_m - backward_m) < MAX_DIRECTION_DIFFERENCE * forward_m
            else CoexistingOrbits(forward_m, backward_m, None)
        )
    forward_orbit = _settle(case, sweep, frequency_hz, "forward")
    backward_orbit = _settle(case, sweep, frequency_hz, "backward")
    if (
        forward_orbit is None
        or backward_orbit is None
        or abs(forward_orbit.u_max - backward_orbit.u_max)
        < MAX_DIRECTION_DIFFERENCE * forward_orbit.u_max
    ):
        return None
    ends = sorted((forward_orbit.u_max, backward_orbit.u_max))
    limits = frequency_hz - MAX_HYSTERESIS_HZ, frequency_hz + MAX_HYSTERESIS_HZ
    branch = continue_branch(forward_orbit, FREQUENCY, (max(limits[0], 0.1), limits[1]))
    for orbit in branch.orbits_at(frequency_hz):
        if not orbit.stable and ends[0] < orbit.u_max < ends[1]:
            return CoexistingOrbits(forward_orbit.u_max, backward_orbit.u_max, orbit)
    return None


def steady_amplitude_m(
    case: PaperCase, sweep: SlowSweep, frequency_hz: float, direction: str
) -> float:
    """Return the largest u in m of the steady motion reached in one sweep direction."""
    return float(simulate_steady_motion(case, sweep, frequency_hz, direction, 1).u.max())


def simulate_steady_motion(
    case: PaperCase, sweep: SlowSweep, frequency_hz: float, direction: str, cycles: int
) -> SystemMotion:
    """Simulate the steady motion that slow passage in this direction leads to."""
    a, simulator = case.acceleration, case.simulator
    start = sweep.state_at(frequency_hz, direction)
    state = simulator.sweep([frequency_hz], a, SETTLE_CYCLES, start).states[0]
    return simulator.simulate_motion(frequency_hz, a, state, cycles)


def find_permanent_contact_mm(case: PaperCase) -> float:
    """Find the total gap in mm (negative) below which contact is permanent at all frequencies.

    With both bumpers in contact the motion U is linear; contact with a bumper is lost where
    |(K_j + i w C_j) U| reaches K_j p, with the precompression p. For nonlinear or unequal bumpers
    by bisection; NaN beyond `MIN_GAP_MM`.
    """
    p, a = case.parameters, case.acceleration
    kj, cj = p.bumper_stiffness_r, p.bumper_damping_r
    symmetric = (kj, cj, p.gap_r) == (p.bumper_stiffness_l, p.bumper_damping_l, p.gap_l)
    if not (case.simulator.is_exact and symmetric):
        return _bisect_permanent_contact(case)

    def release_gap_m(hz: float) -> float:
        w = 2 * math.pi * hz
        k, c = p.stiffness + 2 * kj, p.damping + 2 * cj
        return -abs(kj + 1j * w * cj) * p.mass * a / abs(k - p.mass * w * w + 1j * w * c) / kj

    optimum = minimize_scalar(
        release_gap_m, bounds=(1.0, 20.0), method="bounded", options={"xatol": 1e-9}
    )
    return float(2e3 * optimum.fun)


def _bisect_permanent_contact(case: PaperCase) -> float:
    detaching_mm, permanent_mm = 0.0, MIN_GAP_MM
    if detaches(case, permanent_mm) or not detaches(case, detaching_mm):
        return math.nan
    while detaching_mm - permanent_mm > GAP_TOLERANCE_MM:
        middle_mm = (detaching_mm + permanent_mm) / 2
        detaching_mm, permanent_mm = (
            (middle_mm, permanent_mm) if detaches(case, middle_mm) else (detaching_mm, middle_mm)
        )
    return permanent_mm


def detaches(case: PaperCase, gap_mm: float) -> bool:
    """Return whether the mass leaves a bumper in a slow sweep at this total gap."""
    is_exact = case.simulator.is_exact
    frequencies = np.arange(600, 801) / 100 if is_exact else np.arange(80, 241) / 20
    if is_exact:  # around the resonance with both bumpers in contact
        p = case.parameters
        stiffness = p.stiffness + p.bumper_stiffness_r + p.bumper_stiffness_l
        frequencies += math.sqrt(stiffness / p.mass) / (2 * math.pi) - 6.95
    sweep = case.simulator.copy_with_gap(gap_mm).sweep(frequencies, case.acceleration, 20)
    return bool(sweep.column("onsets_r").sum() + sweep.column("onsets_l").sum())


@dataclass(frozen=True, slots=True)
class ZeroGapFlight:
    """Flight at G0: its share of the time, and what the bumper has not yet recovered at release.

    `elastic_share` is the share of flight with a tenth of the bumpers' damping.
    """

    share: float
    elastic_share: float
    remaining: float  # deformation at release, of the largest


def measure_zero_gap_flight(case: PaperCase, frequency_hz: float) -> ZeroGapFlight:
    """Measure the flight between the two contacts of each cycle, in steady motion."""
    share, remaining = _measure_flight(case.simulator, frequency_hz, case.acceleration)
    base = case.simulator.model.base
    elastic = replace(
        base,
        bumper_damping_r=base.bumper_damping_r / 10,
        bumper_damping_l=base.bumper_damping_l / 10,
    )
    simulator = make_simulator(Model(elastic, case.simulator.model.effects))
    return ZeroGapFlight(
        share, _measure_flight(simulator, frequency_hz, case.acceleration)[0], remaining
    )


def _measure_flight(
    simulator: HarmonicSimulator, hz: float, acceleration: float
) -> tuple[float, float]:
    """Return (share of flight, right deformation at release over its largest)."""
    state = simulator.sweep([hz], acceleration, SETTLE_CYCLES).states[0]
    simulator = replace(simulator, fine_samples=FLIGHT_SAMPLES)
    motion = simulator.simulate_motion(hz, acceleration, state, FLIGHT_CYCLES)
    in_flight = (motion.force_r <= 0) & (motion.force_l >= 0)
    force, deformation = motion.force_r, motion.v_r - simulator.parameters.gap_r
    last = np.flatnonzero((force[1:-1] > 0) & (force[2:] <= 0)) + 1  # samples of each contact
    samples_left = force[last] / (force[last - 1] - force[last])  # until the force is zero
    remaining = deformation[last] + samples_left * (deformation[last] - deformation[last - 1])
    return float(in_flight.mean()), float(remaining.mean() / deformation.max())


def measure_contact_shares(
    case: PaperCase, sweep: SlowSweep, frequency_hz: float, direction: str
) -> tuple[float, float, float]:
    """Return the shares of the time in contact with both bumpers, one, none, in steady motion."""
    motion = simulate_steady_motion(case, sweep, frequency_hz, direction, 1)
    contacts = (motion.force_r > 0).astype(int) + (motion.force_l < 0)
    both, single, none = (float((contacts == count).mean()) for count in (2, 1, 0))
    return both, single, none


@dataclass(frozen=True, slots=True)
class ImpactDistribution:
    """Distribution of impacts: share of cycles by (right, left), most frequent first."""

    shares: tuple[tuple[tuple[int, int], float], ...]

    def share(self, *pairs: tuple[int, int]) -> float:
        """Return the share of cycles with one of these impact counts (right, left)."""
        return sum(share for pair, share in self.shares if pair in pairs)

    def share_at_least(self, count: int) -> float:
        """Return the share of cycles with at least `count` impacts on one side."""
        return sum(share for pair, share in self.shares if max(pair) >= count)

    @property
    def most_frequent(self) -> tuple[int, int]:
        """Most frequent impact counts (right, left)."""
        return self.shares[0][0]


def compute_impact_distribution(case: PaperCase, frequency_hz: float) -> ImpactDistribution:
    """Return the distribution of impacts per forcing cycle, from rest, without the transient."""
    effort, a = choose_effort(case), case.acceleration
    state = case.simulator.sweep([frequency_hz], a, effort.transient_cycles).states[0]
    right, left, _ = case.simulator.find_onsets(frequency_hz, a, state, effort.counted_cycles)
    impacts_by_cycle = zip(
        count_onsets_per_cycle(right, effort.counted_cycles),
        count_onsets_per_cycle(left, effort.counted_cycles),
        strict=True,
    )
    counts = Counter((int(r), int(l_)) for r, l_ in impacts_by_cycle)
    total = sum(counts.values())
    return ImpactDistribution(tuple((pair, n / total) for pair, n in counts.most_common()))


def count_onsets_per_cycle(times: Float1D, cycles: int) -> Float1D:
    """Count contact onsets (times in cycles) per cycle, except the last; return (cycle,).

    Cycles are cut at the phase with the fewest onsets, so that no group of impacts is split.
    """
    phases = np.sort(times % 1.0)
    if not phases.size:
        return np.zeros(cycles - 1)
    counts, edges = np.histogram(phases, bins=50, range=(0.0, 1.0))
    periodic_counts = np.concatenate([counts, counts])
    sparse = [periodic_counts[k : k + 5].sum() for k in range(50)]
    cut_phase = edges[(int(np.argmin(sparse)) + 2) % 50]
    return np.histogram(times, bins=cut_phase + np.arange(cycles))[0].astype(float)


def compute_lyapunov_exponent(
    case: PaperCase, frequency_hz: float, cycles: int | None = None
) -> float:
    """Return the largest Lyapunov exponent per cycle, from rest, without the transient."""
    effort, a = choose_effort(case), case.acceleration
    state = case.simulator.sweep([frequency_hz], a, effort.transient_cycles).states[0]
    cycle_count = min(cycles or effort.lyapunov_cycles, effort.lyapunov_cycles)
    return case.simulator.lyapunov_exponent(frequency_hz, a, state, cycle_count)[0]


def find_bands(frequency: Float1D, values: Float1D) -> list[list[float]]:
    """Return [from, to] in Hz of each run of the grid with values above `MIN_BAND_VALUE`."""
    intervals: list[list[float]] = []
    for index in np.flatnonzero(values > MIN_BAND_VALUE):
        frequency_hz = float(frequency[index])
        if intervals and index and intervals[-1][1] == float(frequency[index - 1]):
            intervals[-1][1] = frequency_hz
        else:
            intervals.append([frequency_hz, frequency_hz])
    return intervals


def find_two_impact_gap_mm(case: PaperCase, frequency_hz: float) -> float:
    """Return the largest total gap in mm on a grid with at least 2/2 impacts in every cycle.

    The motion at `frequency_hz` is reached by a forward sweep; NaN if there is no such gap.
    """
    frequencies, a = np.linspace(frequency_hz - 0.2, frequency_hz, 21), case.acceleration
    for gap_mm in np.arange(4.0, 0.0, -choose_effort(case).gap_step_mm).tolist():
        simulator = case.simulator.copy_with_gap(gap_mm)
        state = simulator.sweep(frequencies, a, 60).states[-1]
        right, left, _ = simulator.find_onsets(frequency_hz, a, state, 200)
        if (
            min(count_onsets_per_cycle(right, 200).min(), count_onsets_per_cycle(left, 200).min())
            >= 2
        ):
            return round(gap_mm, 2)
    return math.nan
